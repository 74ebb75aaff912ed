"""Thresholds of the sensor monitor: derived from the bench's noise, time grid, declared bounds and set of brakes.

The derivation of each is in ``docs/explanation/sensor-monitor.md``, the measured false alarms too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_runtime.config.bench import Bench
from emb_runtime.safety.shield_design import ShieldLaw

FALSE_ALARMS = 1e-9  # Probability, per experiment and at most, that noise alone passes the threshold of the travel
CORRELATION = 2.0  # Standard deviation of the velocity's error that the travel allows for, in multiples of the bench's
TOLERATED_OFFSET = 0.5
"""Steady difference between angle and velocity that is no fault, in standard deviations of the velocity."""
LAG = 0.75
"""Samples by which a velocity that is derived from the angle may lag: forward Euler leads by a half, an observer with
the noise of the bench's sensors lags by 0.6."""
FIRST_MOVE = 1.5
"""Current of the first move, in multiples of what moves the weakest motor against the greatest friction."""


class SensorThresholds(NamedTuple):
    """Numbers that the monitor compares with; floats only, so that what uses it compiles."""

    travel: float  # Angle travelled beyond the integral of the velocity [rad]
    offset: float  # Difference between the rate of the angle and the velocity that does not count [rad/s]
    lag: float  # Time by which the velocity may lag the angle [s]
    lead: float  # Time by which it may lead the angle [s]
    motion: float  # Change of the velocity beyond that of any brake of the set [rad/s]
    current_error: float  # By which a reported current may differ from the command [A]
    first_current: float  # Largest current until the motion has confirmed the polarity [A]


def sensor_thresholds(bench: Bench, law: ShieldLaw) -> SensorThresholds:
    """Thresholds of a bench and the law of its shield."""
    ts, box, deviation = law.sample_time, law.box, bench.noise.velocity
    offset = TOLERATED_OFFSET * deviation
    # Of a random walk with the standard deviation s per step and the mean -m, P(it ever reaches h) < exp(-2 m h / s^2);
    # it may begin anew at each sample, and in either direction.
    walk = ts * CORRELATION * deviation
    noise = math.log(2.0 * bench.timing.horizon / FALSE_ALARMS) * walk * walk / (2.0 * ts * offset)
    mistaken = ts * (box.friction_low + box.friction_high)  # the sign of a lagging velocity, for one sample
    return SensorThresholds(
        travel=2.0 * law.angle_noise + noise,
        offset=offset,
        lag=max(LAG, 2.0 / law.delay.observer) * ts if law.delay.observer > 0.0 else LAG * ts,
        lead=LAG * ts,
        motion=2.0 * law.velocity_noise + mistaken,
        current_error=bench.guard.current_error,
        first_current=min(FIRST_MOVE * box.friction_high / box.motor_low, law.current),
    )
