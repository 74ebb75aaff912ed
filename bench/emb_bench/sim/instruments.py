"""Instruments between a brake and the bus: delays, an encoder that was not homed, clock jitter, an observer.

Plain scalar functions on one small row of memory per brake: the node calls them as they are, the environments compile
them for the batch. Ideal instruments change nothing, bit for bit.

**The observer.** A drive has no sensor of velocity: it tracks the measured angle with a phase-locked loop of second
order (Lorenz and Van Patten, High-resolution velocity estimation for all-digital, AC servo drives, IEEE Trans. Industry
Applications 27(4), 1991), whose poles have the bandwidth ω_o and the damping ζ = 0.7. Sampled once a period T it is an
α-β filter (Kalata, The tracking index, IEEE Trans. Aerospace and Electronic Systems 20(2), 1984), and with the poles at
z = exp((−ζ ± j √(1 − ζ²)) ω_o T), which :func:`observer_gains` places exactly,

- white noise of the angle with the standard deviation σ becomes noise of the velocity with the standard deviation
  σ/T √(2 β² / (α (4 − 2α − β))), see :func:`observer_noise`; it is coloured, and no second opinion about the angle;
- under a constant acceleration the velocity lags by a T (α/β − 1/2).

The limit of a large bandwidth is the difference of two angles, √2 σ/T with a lag of half a period.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from emb_bench.brake.parameters import OFFSET, VELOCITY_GAIN
from emb_bench.config.plants import LONGEST_DELAY, Instruments
from emb_runtime.estimator.observer import observer_gains

_COMMANDS = 0
_ANGLES = LONGEST_DELAY
_VELOCITIES = 2 * LONGEST_DELAY
MEMORY = 3 * LONGEST_DELAY + 2
"""Length of a row of memory: commands on their way, measurements on theirs, and last what the observer tracks."""


class Tracked(NamedTuple):
    """Angle and velocity that an observer tracks."""

    angle: float  # [rad]
    velocity: float  # [rad/s]


def settle(instruments: Instruments, memory: Any, angle: float) -> None:
    """Begin with a brake that has long rested at an angle [rad] without a command; overwrites ``memory``."""
    shown = angle + instruments.encoder_offset
    for i in range(LONGEST_DELAY):
        memory[_COMMANDS + i], memory[_ANGLES + i], memory[_VELOCITIES + i] = 0.0, shown, 0.0
    memory[-2], memory[-1] = shown, 0.0


def command(instruments: Instruments, memory: Any, requested: float) -> float:
    """Current that acts in the period of a ``requested`` one [A]. To be called once a period."""
    return _delayed(memory, _COMMANDS, instruments.command_delay, requested)


def reading(x1: Any, x2: Any, acceleration: Any, late: Any, offset: float, velocity_scale: float) -> tuple[Any, Any]:
    """Angle [rad] and velocity [rad/s] that sensors show ``late`` [s] after a period, of one sample or of rows of them.

    The brake goes on as it went through the period: the angle is right to second order and the velocity to first. The
    error is late²/2 respectively late times the difference between the mean acceleration of the period [rad/s²] and the
    one at its end, for 20 µs at most 6e-6 rad and 0.6 rad/s, where full braking ends in standstill. No new command can
    act before the sample is sent.

    The encoder shows ``offset`` [rad] at the origin, and the velocity's scale is ``velocity_scale``.
    """
    return x1 + late * (x2 + 0.5 * late * acceleration) + offset, velocity_scale * (x2 + late * acceleration)


def sensor_share(unknown: int, output: int, shown: Any) -> Any:
    """Derivative of a reading to an unknown of the sensors, per unit; 0 for others.

    ``output`` is 0 for the angle, 1 for the velocity; ``shown`` is the reading with the right scale.
    """
    if unknown == OFFSET and output == 0:
        return 1.0
    if unknown == VELOCITY_GAIN and output == 1:
        return shown
    return 0.0


def measure(
    instruments: Instruments,
    memory: Any,
    t_s: float,
    x1: float,
    x2: float,
    acceleration: float,
    late: float,
    angle_error: float,
    velocity_error: float,
) -> tuple[float, float]:
    """Angle [rad] and velocity [rad/s] that are sent at the end of a period, the sensors' noise added.

    To be called once a period. A sample is taken ``late`` [s], see :func:`reading`.
    """
    y1, y2 = reading(x1, x2, acceleration, late, instruments.encoder_offset, 1.0)
    y1, y2 = y1 + angle_error, y2 + velocity_error
    if instruments.observer_bandwidth > 0.0:
        before = Tracked(float(memory[-2]), float(memory[-1]))
        memory[-2], y2 = observe(instruments.observer_bandwidth, before, t_s, y1)
        memory[-1] = y2
    delay = instruments.measurement_delay
    return _delayed(memory, _ANGLES, delay, y1), _delayed(memory, _VELOCITIES, delay, y2)


def observe(bandwidth: float, tracked: Tracked, t_s: float, y1: float) -> Tracked:
    """Angle and velocity that the observer tracks after one more measured angle [rad]."""
    alpha, beta = observer_gains(bandwidth, t_s)
    ahead = tracked.angle + t_s * tracked.velocity
    surprise = y1 - ahead
    return Tracked(ahead + alpha * surprise, tracked.velocity + beta / t_s * surprise)


def observer_noise(bandwidth: float, t_s: float, angle_noise: float) -> float:
    """Standard deviation [rad/s] of an observer's velocity under white noise of the angle [rad]."""
    alpha, beta = observer_gains(bandwidth, t_s)
    return angle_noise / t_s * math.sqrt(2.0 * beta * beta / (alpha * (4.0 - 2.0 * alpha - beta)))


def _delayed(memory: Any, first: int, count: int, value: float) -> float:
    """Put ``value`` into the line of ``count`` places that begins at ``first``, and take out what went in before."""
    if count == 0:
        return value
    out = float(memory[first])
    for i in range(first, first + count - 1):
        memory[i] = memory[i + 1]
    memory[first + count - 1] = value
    return out
