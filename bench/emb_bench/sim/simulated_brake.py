"""The simulated brake: one sample period of the closed loop, a brake behind a device, and its command-line options.

The node and every experiment of a training use :func:`sent_current` for the current of a measurement, and
:func:`pass_period` for the motion and the next measurement. They are plain scalar Python; the batch runs them compiled
by :func:`emb_bench.compiled.compiled`, with the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import index
from typing import Any, Final, NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats, Integers, advance, no_sensitivity, rest
from emb_bench.config.bench import with_tables
from emb_bench.config.conditions import CONDITIONS
from emb_bench.config.plants import DEFAULT_PLANT, Instruments, Mechanics, Plant
from emb_bench.sim.instruments import MEMORY, command, measure, settle
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.config.bench import Noise as SensorNoise
from emb_runtime.errors import UsageError, near
from emb_runtime.safety.command_limits import shielded
from emb_runtime.safety.shield import Past
from emb_runtime.safety.shield_design import ShieldLaw


def clipped(requested: float, limit: float) -> float:
    """A current within ±limit [A]; one that is not finite counts as 0 A, as it does for the shield."""
    return min(max(requested, -limit), limit) if math.isfinite(requested) else 0.0


def sent_current(
    law: ShieldLaw, shield: bool, angle: float, velocity: float, requested: float, past: Past, step: int, limit: float
) -> tuple[float, int]:
    """Current for a measurement [A], NaN for none, and the :class:`~emb_runtime.records.Reason` bits.

    As :func:`emb_runtime.safety.command_limits.decide` without a limit of the slope. ``limit`` [A] is at most the
    law's; without the shield the current is clipped to the law's, no more.
    """
    if not shield:
        return clipped(requested, law.current), 0
    return shielded(law, angle, velocity, clipped(requested, limit), past, step, -limit, limit)


def pass_period(
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    t_s: float,
    current: float,
    errors: tuple[float, float, float],
    x: Floats,
    unknowns: Integers,
    s: Floats,
    memory: Any,
) -> tuple[float, float]:
    """Let one sample period pass, in place; gives measured angle [rad] and velocity [rad/s] at its end.

    Errors are of the angle [rad], the velocity [rad/s] and the instant of the sample [s]. ``x`` is the state, shape
    [4], ``unknowns`` has the indices of the n unknowns, ``s`` their sensitivities, shape [n, 4].
    """
    before = float(x[1])
    advance(mechanics, p, x, current, t_s, unknowns, s)
    x1, x2 = float(x[0]), float(x[1])
    return measure(instruments, memory, t_s, x1, x2, (x2 - before) / t_s, errors[2], errors[0], errors[1])


Noise = Callable[[], tuple[float, float, float]]
"""Draws one error of the angle [rad], one of the velocity [rad/s] and one of the instant of sampling [s]."""


class SimulatedBrake:
    """A brake at rest in its origin, driven with one current per sampling period [s]."""

    def __init__(self, theta: BrakeParameters, noise: Noise, plant: Plant, sample_time: float) -> None:
        self._mechanics, self._instruments = plant.mechanics, plant.instruments
        self._x = rest()
        self._unknowns, self._sensitivity = no_sensitivity(())
        self._memory = np.zeros(MEMORY)
        settle(self._instruments, self._memory, 0.0)
        self._theta = theta
        self._noise = noise
        self._t_s: Final = sample_time
        self.periods = 0  # Sampling periods passed, those without a sample (the device was late) included
        self.angle_range = (0.0, 0.0)  # Lowest and highest true angle so far [rad]
        self.top_speed = 0.0  # Highest true speed so far [rad/s]

    @property
    def angle(self) -> float:
        """True angle [rad]; it can be set, as by a hand that turns the brake."""
        return float(self._x[0])

    @angle.setter
    def angle(self, angle: float) -> None:
        self._x[0] = angle

    @property
    def velocity(self) -> float:
        """True velocity [rad/s]."""
        return float(self._x[1])

    def _delayed(self, commanded: float) -> float:
        """Current that acts in the coming period for a ``commanded`` one [A]; NaN without a command, in both."""
        return command(self._instruments, self._memory, commanded)

    def _advance(self, current: float) -> tuple[float, float]:
        """Let one period pass; what is measured at its end, angle [rad] and velocity [rad/s]."""
        measured = pass_period(
            self._mechanics,
            self._instruments,
            self._theta,
            self._t_s,
            current,
            self._noise(),
            self._x,
            self._unknowns,
            self._sensitivity,
            self._memory,
        )
        self.periods += 1
        self.angle_range = (min(self.angle_range[0], self.angle), max(self.angle_range[1], self.angle))
        self.top_speed = max(self.top_speed, abs(self.velocity))
        return measured


NOISES = ("angle_noise", "velocity_noise")  # Options for sensors with other noise than in the bench file
LONGEST_SEED = 18  # Digits of a seed
FARTHEST = 100.0  # A brake that is farther from nominal, by this factor, is a typing error


def parse_assignments(text: str, option: str = "") -> dict[str, str]:
    """``name=value,name=value`` as a dictionary; ``option`` begins a message."""
    pairs: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not name or not value:
            point = "; write numbers with a point" if item[:1].isdigit() else ""
            raise UsageError(f"{option}expected name=value,name=value, got '{item}'{point}")
        if name in pairs:
            raise UsageError(f"{option}'{name}' is given twice")
        pairs[name] = value
    return pairs


def true_parameters(
    bench: Bench, assignments: Mapping[str, Any], besides: Sequence[str] = (), option: str = ""
) -> BrakeParameters:
    """The bench's nominal brake with some parameters replaced, by numbers or texts; ``option`` begins a message."""
    theta = bench.brake
    for name, given in assignments.items():
        if name not in PARAMETER_NAMES:
            names = (*PARAMETER_NAMES, *besides)
            expected = f"expected one of {', '.join(names)}{near(name, names)}"
            raise UsageError(f"{option}'{name}' is not a parameter; {expected}")
        value = _number(given)
        check_near_nominal(bench, name, value, option, got=f"'{given}'")
        theta = theta._replace(**{name: value})
    return theta


def check_near_nominal(bench: Bench, name: str, value: float, where: str = "", got: str = "") -> None:
    """Refuse a parameter that must be a typing error: so fast a brake would take very long to simulate."""
    nominal = getattr(bench.brake, name)
    low, high = nominal / FARTHEST, nominal * FARTHEST
    if not low <= value <= high:  # this way round, NaN is refused
        raise UsageError(f"{where}{name}: expected a number from {low:g} to {high:g}, got {got or repr(value)}")


class BrakeToSimulate(NamedTuple):
    """A brake with its plant and sensors."""

    theta: BrakeParameters  # True parameters
    plant: Plant
    noise: Noise
    seed: int
    charge: bool  # The node sends the integral of its current along
    conditions: tuple[float, ...] = ()  # Temperature [degC] and supply voltage [V] that it sends; none if empty

    @property
    def truth(self) -> dict[str, float | str]:
        """True parameters, seed and plant, for the log."""
        return {**self.theta._asdict(), "seed": self.seed, "plant": self.plant.name}


def read_brake(text: str, bench: Bench, option: str) -> BrakeToSimulate:
    """Reads ``plant=exact,seed=3,f_v=3e-5``; what is not given is the default plant, seed 1, nominal.

    ``charge=1`` has the node send the integral of its current; ``angle_noise`` [rad] and ``velocity_noise`` [rad/s] are
    standard deviations of sensors that differ from the bench file. ``temperature`` [degC] with ``supply_voltage`` [V]
    has the node send them. ``option`` begins a message.
    """
    return brake_of(parse_assignments(text, option), bench, option)


def brake_of(options: Mapping[str, Any], bench: Bench, option: str) -> BrakeToSimulate:
    """The brake of options by name, of numbers or texts; see :func:`read_brake`."""
    given = dict(options)
    plant = with_tables(bench, "bench file").plant(str(given.pop("plant", DEFAULT_PLANT)))
    told, charge = given.pop("seed", 1), str(given.pop("charge", 0))
    if (seed := _seed(told)) is None:
        raise UsageError(f"{option}seed: expected a whole number from 0 of up to {LONGEST_SEED} digits, got '{told}'")
    if charge not in ("0", "1"):
        raise UsageError(f"{option}charge: expected 0 or 1, got '{charge}'")
    angle, velocity = (_deviation(given, name, option) for name in NOISES)
    conditions = _conditions(given, option)
    sensors = replace(
        bench.noise,
        angle=bench.noise.angle if angle is None else angle,
        velocity=bench.noise.velocity if velocity is None else velocity,
    )
    theta = true_parameters(bench, given, ("plant", "seed", "charge", *NOISES, *CONDITIONS), option)
    noise = gaussian_noise(sensors, seed, plant.instruments.clock_jitter)
    return BrakeToSimulate(theta, plant, noise, seed, charge == "1", conditions)


def _number(given: Any) -> float:
    """NaN for what is none."""
    try:
        return float(given)
    except (TypeError, ValueError):
        return math.nan


def _seed(given: Any) -> int | None:
    """None for what is none."""
    if isinstance(given, str):
        return int(given) if given.isdecimal() and len(given) <= LONGEST_SEED else None
    try:
        return seed if 0 <= (seed := index(given)) < 10**LONGEST_SEED else None
    except TypeError:
        return None


def _deviation(given: dict[str, Any], name: str, option: str) -> float | None:
    if name not in given:
        return None
    told = given.pop(name)
    value = _number(told)
    if not 0.0 <= value < math.inf:
        raise UsageError(f"{option}{name}: expected a standard deviation from 0 on, got '{told}'")
    return value


def _conditions(given: dict[str, Any], option: str) -> tuple[float, ...]:
    """Temperature [degC] and supply voltage [V], or nothing: one frame carries both."""
    told = {name: given.pop(name) for name in CONDITIONS if name in given}
    for name, text in told.items():
        signal = load_layout().optional["EMB_Conditions"].signal(CONDITIONS[name].signal)
        if not signal.minimum <= _number(text) <= signal.maximum:  # this way round, NaN is refused
            raise UsageError(f"{option}{name}: expected {signal.range_text}, got '{text}'")
    if len(told) == 1:
        other = next(name for name in CONDITIONS if name not in told)
        raise UsageError(f"{option}{other}: missing; one frame carries {' and '.join(CONDITIONS)}: give both")
    return tuple(_number(told[name]) for name in CONDITIONS if name in told)


def gaussian_noise(sensors: SensorNoise, seed: int, clock_jitter: float = 0.0) -> Noise:
    """White Gaussian errors of sensors and clock [s]; the same seed gives the same errors."""
    generator = np.random.default_rng(seed)
    angle_std, velocity_std = sensors.angle, sensors.velocity

    def draw() -> tuple[float, float, float]:
        first, second = generator.standard_normal(2)
        late = generator.normal(0.0, clock_jitter) if clock_jitter > 0.0 else 0.0
        return float(first) * angle_std, float(second) * velocity_std, float(late)

    return draw
