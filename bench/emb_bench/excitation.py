"""Reference excitations: what the learned ones are compared with, behind one interface.

``excitation("chirp", bench, f1=80.0)`` or ``parse_excitation("chirp:f1=80", bench)`` gives an :class:`Excitation`. Most
are sequences of currents, one is a feedback law; all return a current for a measurement, as a policy does, so that the
runtime's loop can use any of them as its actor. :func:`run_excitation` simulates one on a brake, optionally behind the
envelope shield of the runtime: then the limits are kept and the brake is home at the end, whatever the excitation
requests.

| name | what it is |
|---|---|
| constant-speed | feedback: as fast as allowed, best for f_v (thesis 5.1.1); backwards from ``turn`` on |
| square | the thesis's manual ±6 A, 20 ms square wave (6.2.2), which beat its agents on two parameters |
| chirp | swept sine, linear in time (Pintelon and Schoukens, System Identification, 2nd ed. 2012, chapter 5) |
| prbs | maximum-length binary sequence (Golomb, Shift Register Sequences, 1967) |
| multisine | equal harmonics with Schroeder's phases (IEEE Trans. Information Theory 16, 1970, p. 85) |
| ramp, step | what the thesis tried first (4.4) |

All except prbs, which needs scipy, run on the base install.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.euler import sign, stiffness
from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Mechanics
from emb_bench.sim.open_loop import feedback
from emb_bench.sim.simulated_brake import clipped, parse_assignments, sent_current
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.control.actor import Actor
from emb_runtime.errors import UsageError, near
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.safety.response import OPEN, PROVEN, begin_response, response_model, take, unproven_law
from emb_runtime.safety.response import State as ProofState
from emb_runtime.safety.sensor_monitor import begin_monitor, judge, largest_current
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST, damped_current
from emb_runtime.safety.shield_design import make_law

Law = Callable[[float, float, int], float]  # Measured angle [rad], measured velocity [rad/s] and step to a current [A]

ACTOR = "actor"  # Name of the shipped actor in a list of excitations
COMPARED = (
    *("square", "chirp", "prbs", "multisine", "ramp", "step", "constant-speed"),
    *("square:period=0.36", "constant-speed:turn=0.15"),
)
"""Excitations that an actor is compared with. The last two reverse once."""

SPEED_GAIN = 0.5
"""Share of a speed error that constant-speed removes per sample on the nominal brake; up to 2 would be stable."""

LONGEST_REGISTER = 16  # Order of the longest binary sequence


class Parameter(NamedTuple):
    """One number that an excitation takes."""

    name: str
    unit: str
    default: float
    low: float
    high: float
    whole: bool = False


@dataclass(frozen=True, eq=False)
class Excitation:
    """Excitation as a sequence of currents or as feedback. It is an actor for ``emb_runtime.control.loop``."""

    name: str
    parameters: Mapping[str, float]  # All of them, the defaults included
    law: Law  # Defined for the steps of the experiment; within the bench's current limit
    currents: Floats | None  # The sequence [A], shape (horizon,), read-only; None for a feedback law

    @property
    def text(self) -> str:
        """Text for :func:`parse_excitation`, defaults included."""
        return f"{self.name}:{','.join(f'{name}={value!r}' for name, value in self.parameters.items())}"

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Current for a measurement at a step of the experiment [A]; the estimator is not used."""
        return self.law(angle, velocity, int(step))


@dataclass(frozen=True, eq=False)
class Response:
    """A simulated experiment of n periods; period k begins at sample k."""

    wanted: Floats  # Current that the excitation requested [A], shape (n,)
    currents: Floats  # Current that acted [A], shape (n,)
    reasons: NDArray[np.int64]  # Reasons for which the two differ: bits of ``emb_runtime.records.Reason``, shape (n,)
    states: Floats  # True angle [rad] and velocity [rad/s], shape (n + 1, 2)
    kept: bool  # True if angle and velocity stayed within the bench's limits
    home: bool  # True if the brake ended at the origin, as the bench defines it


def excitation(name: str, bench: Bench, **parameters: float) -> Excitation:
    """A reference excitation for the bench's sample time, horizon, limits and brake, by a name of the table above.

    ``Excitation.parameters`` has all parameters with their defaults.
    """
    known = {parameter.name: parameter for parameter in parameters_of(name, bench)}
    for given in parameters:
        if given not in known:
            expected = f"expected some of {', '.join(known)}{near(given, known)}"
            raise UsageError(f"{name}: no parameter '{given}'; {expected}")
    values = {key: _checked(name, known[key], parameters.get(key, known[key].default)) for key in known}
    built = _SIGNALS[name](bench, **values)
    if not isinstance(built, np.ndarray):
        return Excitation(name, MappingProxyType(values), built, None)
    built.setflags(write=False)
    return Excitation(name, MappingProxyType(values), _played(built), built)


def parameters_of(name: str, bench: Bench) -> tuple[Parameter, ...]:
    """Parameters of an excitation, with the defaults and ranges that the bench gives."""
    t_s, current, speed = bench.timing.sample_time, bench.limits.current, bench.limits.velocity
    lasting, nyquist = bench.timing.horizon * t_s, 0.5 / t_s

    def amplitude(share: float, name: str = "amplitude") -> Parameter:
        return Parameter(name, "A", share * current, -current, current)

    def frequency(name: str, default: float) -> Parameter:
        return Parameter(name, "Hz", min(default, nyquist), 0.01 / lasting, nyquist)

    def time(name: str, default: float, low: float) -> Parameter:
        return Parameter(name, "s", max(default, low), low, max(100.0 * lasting, low))

    table = {
        "constant-speed": (Parameter("speed", "rad/s", speed, -speed, speed), time("turn", lasting, 0.0)),
        "square": (amplitude(1.0), time("period", 0.020, 2.0 * t_s)),
        "chirp": (amplitude(0.5), frequency("f0", 1.0), frequency("f1", 50.0)),
        "prbs": (
            amplitude(0.5),
            time("hold", 0.008, t_s),
            Parameter("order", "", 6, 2, LONGEST_REGISTER, whole=True),
            Parameter("seed", "", 1, 1, 2**LONGEST_REGISTER - 1, whole=True),
        ),
        "multisine": (amplitude(0.5), frequency("f0", 1.0 / lasting), frequency("f1", 50.0)),
        "ramp": (amplitude(0.5), amplitude(0.0, "start")),
        "step": (amplitude(0.25), time("at", 0.0, 0.0)),
    }
    if name not in table:
        raise UsageError(f"no excitation is called '{name}'; expected one of {', '.join(table)}{near(name, table)}")
    return table[name]


def parse_excitation(text: str, bench: Bench) -> Excitation:
    """The excitation that a text such as ``square`` or ``chirp:f0=1,f1=50,amplitude=3`` names."""
    name, _, options = text.partition(":")
    values = {}
    for key, number in parse_assignments(options).items():
        try:
            values[key] = float(number)
        except ValueError:
            raise UsageError(f"{name}: {key}: expected a number, got '{number}'") from None
    return excitation(name.strip(), bench, **values)


def run_excitation(
    bench: Bench,
    excited: Actor,
    mechanics: Mechanics,
    p: BrakeParameters,
    *,
    shielded: bool,
    noise: Floats | None = None,
) -> Response:
    """Simulate an excitation on a brake as in the runtime: measure, request, shield if ``shielded``, move.

    The shield keeps the limits for the brakes in ``bench.shield.ranges``; it includes the first move of
    :mod:`emb_runtime.safety.sensor_monitor`. Without it only the current limit is kept. Bus and instruments are not
    simulated: the current has no quantisation, and no frame is late or lost. The brake starts at rest at the origin.
    The noise is the errors of each sample's angle [rad] and velocity [rad/s], shape (horizon + 1, 2).
    """
    count = bench.timing.horizon
    errors = np.zeros((count + 1, 2)) if noise is None else np.asarray(noise, dtype=np.float64)
    if errors.shape != (count + 1, 2):
        raise UsageError(f"expected noise of shape ({count + 1}, 2), got {errors.shape}")
    limit, t_s = bench.limits.current, bench.timing.sample_time
    law = make_law(bench) if shielded else None
    thresholds, monitor = None if law is None else sensor_thresholds(bench, law), begin_monitor(0.0, 0.0)
    proof = None if law is None else (response_model(bench, law), unproven_law(bench, law))
    response: ProofState | None = None
    verdict = OPEN
    states = np.zeros((count + 1, 2))
    wanted, currents = np.empty(count), np.empty(count)
    reasons, obeyed = np.zeros(count, np.int64), np.ones(count, np.bool_)
    past, estimator = NO_PAST, Estimator(bench)

    def answer(x1: float, x2: float, k: int) -> float:
        nonlocal past, monitor, response, verdict
        y1, y2 = x1 + float(errors[k, 0]), x2 + float(errors[k, 1])
        estimator.add_sample(y1, y2, k, float(currents[k - 1]) if k else 0.0)
        wanted[k] = excited.act(y1, y2, k, estimator)
        if law is None or thresholds is None or proof is None:
            u = clipped(float(wanted[k]), limit)
        else:
            model, slow = proof
            if k == 0:
                monitor, response = begin_monitor(y1, y2), begin_response(model, y1, y2)
            elif response is not None and verdict == OPEN:
                response, verdict = take(model, response, bool(obeyed[k - 1]), y1, y2, past[0])
            if k > 0 and not monitor.confirmed:
                told = bool(obeyed[k - 1]), past[0], float(currents[k - 1])
                monitor, _ = judge(law, thresholds, monitor, t_s, y1, y2, *told)
            most = largest_current(law, thresholds, monitor, limit)
            allowed = slow if monitor.obeys and verdict != PROVEN else law
            u, reasons[k] = sent_current(allowed, True, y1, y2, float(wanted[k]), past, k, most)
        obeyed[k] = not math.isnan(u)
        past = (u if obeyed[k] else 0.0, *past[:4])
        return u if obeyed[k] else damped_current(x2, limit, bench.node.damping_velocity)

    for k, (u, x1, x2) in enumerate(islice(feedback(mechanics, p, answer, t_s), count)):
        currents[k], states[k + 1] = u, (x1, x2)
    low, high = bench.limits.angle
    inside = (states[:, 0] >= low) & (states[:, 0] <= high) & (np.abs(states[:, 1]) <= bench.limits.velocity)
    x1, x2 = np.abs(states[-1])
    home = x1 <= bench.shield.home_angle and x2 <= bench.shield.home_velocity
    return Response(wanted, currents, reasons, states, bool(inside.all()), bool(home))


def schroeder_phases(count: int) -> Floats:
    """Phases of equal harmonics 1..count that give a low crest factor, −π j (j − 1) / count [rad]."""
    j = np.arange(1.0, count + 1.0)
    return -math.pi * j * (j - 1.0) / count


def _checked(name: str, parameter: Parameter, value: float) -> float:
    number = float(value)
    if not parameter.low <= number <= parameter.high:  # this way round, NaN is refused
        unit = f" {parameter.unit}" if parameter.unit else ""
        raise UsageError(
            f"{name}: {parameter.name}: expected a number from {parameter.low:g} to {parameter.high:g}{unit}, "
            f"got {value:g}"
        )
    if parameter.whole and number != int(number):
        raise UsageError(f"{name}: {parameter.name}: expected a whole number, got {value:g}")
    return number


def _played(currents: Floats) -> Law:
    sequence = currents.tolist()
    return lambda _angle, _velocity, k: sequence[k]


def _times(bench: Bench) -> Floats:
    """Begin of each period [s], shape (horizon,)."""
    times: Floats = bench.timing.sample_time * np.arange(bench.timing.horizon, dtype=np.float64)
    return times


def _elapsed(bench: Bench, seconds: float) -> NDArray[np.int64]:
    """Number of complete intervals of ``seconds`` [s] before each period, in spite of rounding at a border."""
    return np.floor(_times(bench) / seconds + 1e-9).astype(np.int64)


def _periods(bench: Bench, seconds: float) -> int:
    """The first period that begins at a time or after it."""
    return math.ceil(seconds / bench.timing.sample_time - 1e-9)


def _constant_speed(bench: Bench, speed: float, turn: float) -> Law:
    """Feed-forward of the nominal brake at this speed and angle, and proportional feedback of the speed error."""
    p, limit = bench.brake, bench.limits.current
    gain = SPEED_GAIN * p.J / bench.timing.sample_time
    back = _periods(bench, turn)

    def law(angle: float, velocity: float, k: int) -> float:
        wanted = speed if k < back else -speed
        torque = p.T_c * sign(wanted) + p.f_v * wanted + stiffness(p, angle) * angle + gain * (wanted - velocity)
        return min(max(torque / p.k_m, -limit), limit)

    return law


def _square(bench: Bench, amplitude: float, period: float) -> Floats:
    """Positive half first."""
    return np.where(_elapsed(bench, 0.5 * period) % 2 == 0, amplitude, -amplitude)


def _chirp(bench: Bench, amplitude: float, f0: float, f1: float) -> Floats:
    """Swept sine from f0 to f1, which it reaches at the end of the experiment; either may be the higher one."""
    t = _times(bench)
    return amplitude * np.sin(2.0 * math.pi * (f0 + 0.5 * (f1 - f0) * t / bench.timing.duration) * t)


def _prbs(bench: Bench, amplitude: float, hold: float, order: float, seed: float) -> Floats:
    """Maximum-length sequence, repeated; the seed is its start within the cycle."""
    from scipy.signal import max_len_seq  # slow to import, and for this one only

    if seed > 2**order - 1:
        raise UsageError(f"prbs: seed: expected at most {2**order - 1:g} for order={order:g}, got {seed:g}")
    register = [int(seed) >> i & 1 for i in range(int(order))]
    bits, _ = max_len_seq(int(order), state=register)
    return np.where(bits[_elapsed(bench, hold) % len(bits)] == 1, amplitude, -amplitude)


def _multisine(bench: Bench, amplitude: float, f0: float, f1: float) -> Floats:
    """Equal harmonics of f0 up to f1, scaled so that ``amplitude`` is the peak."""
    if f1 < f0:
        raise UsageError(f"multisine: f1: expected at least f0 = {f0:g} Hz, got {f1:g} Hz")
    count = math.floor(f1 / f0 + 1e-9)
    harmonics = f0 * np.arange(1.0, count + 1.0)
    angles = 2.0 * math.pi * np.outer(_times(bench), harmonics) + schroeder_phases(count)
    total = np.cos(angles).sum(axis=1)
    result: Floats = amplitude * total / np.abs(total).max()
    return result


def _ramp(bench: Bench, amplitude: float, start: float) -> Floats:
    """Ramp from ``start`` to ``amplitude``, which it would reach at the end of the experiment."""
    return start + (amplitude - start) / bench.timing.duration * _times(bench)


def _step(bench: Bench, amplitude: float, at: float) -> Floats:
    return np.where(np.arange(bench.timing.horizon) >= _periods(bench, at), amplitude, 0.0)


_SIGNALS: Mapping[str, Callable[..., Floats | Law]] = MappingProxyType(
    {
        "constant-speed": _constant_speed,
        "square": _square,
        "chirp": _chirp,
        "prbs": _prbs,
        "multisine": _multisine,
        "ramp": _ramp,
        "step": _step,
    }
)

EXCITATIONS: tuple[str, ...] = tuple(_SIGNALS)  # The names
