"""Plants: brakes that can stand on the bench, with their mechanics and instruments, by name.

Every bench has the plants ``euler`` and ``exact``: the thesis's equations stepped as it does, and solved exactly. The
latter, which sticks at rest as a real brake does, is meant wherever none is named. A
bench file adds others, ``[plants.NAME]``, to see what happens on a brake that the model does not match. They are what
is simulated and evaluated: neither node nor policy is concerned.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args

from msgspec import Meta

from emb_runtime.config.typed import excerpt, key_text, read
from emb_runtime.errors import BenchFileError, near

Solver = Literal["euler", "exact"]
SOLVERS: tuple[Solver, ...] = get_args(Solver)
EULER = 0
EXACT = 1
SHORTEST_LAG = 1e-5  # Least time constant of a current that lags at all [s]
LONGEST_DELAY = 10  # Samples
FASTEST_LOOP = 6000.0  # Largest bandwidth of an observer [rad/s]


class Mechanics(NamedTuple):
    """Mechanics of a brake: the solver, and the features beyond the thesis's simplified equations.

    A named tuple of numbers, so that numba takes it. Shares and ratios rather than torques: they stay sensible when
    T_c and k_1 are drawn.
    """

    solver: int = EXACT  # Index in ``SOLVERS``: Euler with sign(), or exact between events
    break_away: Annotated[float, Meta(ge=1, le=5)] = 1.0  # T_s0 / T_c: static over Coulomb friction
    stribeck_velocity: Annotated[float, Meta(ge=1, le=500)] = 0.0
    """Speed at which the static friction has decayed, eq. 3.5 [rad/s]; 0: it acts at rest only."""
    stribeck_exponent: Annotated[float, Meta(ge=1, le=4)] = 2.0  # δ_σ of eq. 3.5
    f_l: Annotated[float, Meta(ge=0, le=1e-4)] = 0.0  # Static friction by load, T_s = T_s0 + f_l F_cl, eq. 3.6 [m]
    quadratic: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    """F_cl = k_1 x (1 + quadratic x + cubic x²), eq. 3.9 with k_1 as the slope at contact [1/rad]."""
    cubic: Annotated[float, Meta(ge=-1, le=1)] = 0.0  # [1/rad²]
    hysteresis: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    """Share by which the clamping force is higher on applying and lower on releasing (section 3.2.1)."""
    hysteresis_travel: Annotated[float, Meta(ge=0.01, le=100)] = 1.0  # From the middle to one side [rad]
    current_lag: Annotated[float, Meta(ge=SHORTEST_LAG, le=0.1)] = 0.0  # Time constant of the current [s]; 0: none
    play: Annotated[float, Meta(ge=0, le=10)] = 0.0
    """Travel of the motor after a turn until the clamp, and with it the clamping force, follows it [rad]."""
    viscous_asymmetry: Annotated[float, Meta(ge=-0.9, le=0.9)] = 0.0
    """Share by which f_v is larger in the positive direction and smaller in the negative; with no other feature."""
    tolerance: Annotated[float, Meta(gt=0, le=1e-8)] = 1e-8
    """Local error of the velocity per step, where features are integrated [rad/s], [m/s] of a linear machine."""


class Instruments(NamedTuple):
    """Instruments between the brake and the bus."""

    command_delay: Annotated[int, Meta(ge=0, le=LONGEST_DELAY)] = 0  # Samples that a command waits before it acts
    measurement_delay: Annotated[int, Meta(ge=0, le=LONGEST_DELAY)] = 0  # The same of a measurement
    encoder_offset: Annotated[float, Meta(ge=-10, le=10)] = 0.0  # Reading of the encoder at the true origin [rad]
    clock_jitter: Annotated[float, Meta(ge=0, le=1e-3)] = 0.0  # Deviation of the instant of a measurement, white [s]
    observer_bandwidth: Annotated[float, Meta(ge=300, le=FASTEST_LOOP)] = 0.0
    """The velocity is that of a tracking observer of the measured angle with this bandwidth [rad/s]; 0: it is a
    measurement of its own, as in the thesis. Below 300 the noise of its velocity is correlated over so long that a fit
    cannot be judged by its size; sampled at 1 kHz, 6000 is the difference of two angles within 2 % of its gains."""


@dataclass(frozen=True)
class Plant:
    """A brake that can be simulated and evaluated with."""

    name: str
    mechanics: Mechanics
    instruments: Instruments


DEFAULT_PLANT = "exact"  # Plant where none is named: it sticks at rest, as a real brake does
THESIS_PLANT = "euler"  # The thesis's plant; that of logs and trainings of versions that knew no other
RECORDED_PLANT = "recorded"  # Name of the machine in the bench file of a recording of others
DIRECTED = "viscous_asymmetry"
BUILT_IN = {
    THESIS_PLANT: Plant(THESIS_PLANT, Mechanics(solver=EULER), Instruments()),
    DEFAULT_PLANT: Plant(DEFAULT_PLANT, Mechanics(solver=EXACT), Instruments()),
}

EVERY = "all"  # Name for all plants together, which no plant may have
_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")  # it stands in tables and in sim:plant=NAME,f_v=3e-5
_NEEDED = {"stribeck_exponent": "stribeck_velocity", "hysteresis_travel": "hysteresis"}  # Keys without effect alone


def read_plant(name: str, document: Mapping[str, Any], source: str) -> Plant:
    """A plant of a bench file's ``[plants]`` table."""
    at = f"{source}: plants.{key_text((name,))}"
    if name in BUILT_IN:
        raise BenchFileError(f"{at}: this name is taken by the built-in plant")
    if name == EVERY or not _NAME.fullmatch(name):
        expected = f"expected a name of 1 to 40 letters, digits, '-' and '_', other than '{EVERY}'"
        raise BenchFileError(f"{at}: {expected}")
    solver = document.get("solver", "exact")
    if solver not in SOLVERS:
        raise BenchFileError(f"{at}.solver: expected one of {', '.join(SOLVERS)}, got {excerpt(solver)}")
    keys = {*Mechanics._fields, *Instruments._fields}
    if unknown := [key for key in document if key not in keys]:
        expected = f"expected some of {', '.join(sorted(keys))}{near(unknown[0], keys)}"
        raise BenchFileError(f"{at}.{key_text((unknown[0],))}: unknown key; {expected}")
    features = {key: value for key, value in document.items() if key in Mechanics._fields}
    features["solver"] = SOLVERS.index(solver)
    others = {key: value for key, value in document.items() if key not in Mechanics._fields}
    place = ("plants", name)
    mechanics = read(Mechanics, features, source, BenchFileError, at=place)
    instruments = read(Instruments, others, source, BenchFileError, at=place)
    for key, reason in _contradictions(document):
        raise BenchFileError(f"{at}.{key}: {reason}")
    return Plant(name, mechanics, instruments)


def _contradictions(given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys that do not go with others, and why."""
    features = sorted({*given} & {*Mechanics._fields} - {"solver", "tolerance"})
    for key in features:
        if (solver := given.get("solver", "exact")) != "exact":
            yield key, f'goes with solver = "exact", not with "{solver}"'
        if DIRECTED in given and key != DIRECTED:
            yield key, f"does not go with {DIRECTED}: expected one of the two"
        if (needed := _NEEDED.get(key, key)) not in given:
            yield key, f"has no effect without {needed}"
    if {"play", "hysteresis"} <= {*given}:
        yield "play", "does not go with hysteresis: expected one of the two"
