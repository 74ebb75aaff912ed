"""Plants: brakes that can stand on the bench, with their mechanics and instruments, by name.

Every bench has the plants ``euler`` and ``exact``: the thesis's equations stepped as it does, and solved exactly. The
latter, which sticks at rest as a real brake does, is meant wherever none is named. A
bench file adds others, ``[plants.NAME]``, to see what happens on a brake that the model does not match. They are what
is simulated and evaluated, not what a policy depends on, so that they are not part of the contract hash.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from emb_runtime.config.validation import Table

SOLVERS = ("euler", "exact")
EULER = 0
EXACT = 1


class Mechanics(NamedTuple):
    """Mechanics of a brake: the solver, and the features beyond the thesis's simplified equations.

    A named tuple of numbers, so that numba takes it. Shares and ratios rather than torques: they stay sensible when
    T_c and k_1 are drawn.
    """

    solver: int = EXACT  # Index in ``SOLVERS``: Euler with sign(), or exact between events
    break_away: float = 1.0  # T_s0 / T_c: the static friction, at least the Coulomb friction
    stribeck_velocity: float = 0.0
    """Speed at which the static friction has decayed, eq. 3.5 [rad/s]; 0: it acts at rest only."""
    stribeck_exponent: float = 2.0  # δ_σ of eq. 3.5.
    f_l: float = 0.0  # Load-dependent static friction, T_s = T_s0 + f_l F_cl, eq. 3.6 [m].
    quadratic: float = 0.0
    """F_cl = k_1 x (1 + quadratic x + cubic x²), eq. 3.9 with k_1 as the slope at contact [1/rad]."""
    cubic: float = 0.0  # [1/rad²]
    hysteresis: float = 0.0
    """Share by which the clamping force is higher on applying and lower on releasing (section 3.2.1)."""
    hysteresis_travel: float = 1.0  # Travel over which it goes from the middle to one side [rad]
    current_lag: float = 0.0  # Time constant of the current loop [s]; 0: the current is there at once
    coulomb_asymmetry: float = 0.0  # T_c (1 + it) in the positive direction, T_c (1 − it) in the negative
    viscous_asymmetry: float = 0.0  # f_v (1 + it) in the positive direction, f_v (1 − it) in the negative
    play: float = 0.0
    """Travel of the motor after a turn until the clamp, and with it the clamping force, follows it [rad]."""


class Instruments(NamedTuple):
    """Instruments between the brake and the bus."""

    command_delay: int = 0  # Samples that a command waits before it acts
    measurement_delay: int = 0  # Samples that a measurement waits before it is sent
    encoder_offset: float = 0.0  # Reading of the encoder at the true origin [rad]
    clock_jitter: float = 0.0  # Standard deviation of the instant of a measurement, white [s]
    observer_bandwidth: float = 0.0
    """The velocity is that of a tracking observer of the measured angle with this bandwidth [rad/s]; 0: it is a
    measurement of its own, as in the thesis."""


@dataclass(frozen=True)
class Plant:
    """A brake that can be simulated and evaluated with."""

    name: str
    mechanics: Mechanics
    instruments: Instruments


DEFAULT_PLANT = "exact"  # Plant where none is named: it sticks at rest, as a real brake does
THESIS_PLANT = "euler"  # The thesis's plant; that of logs and trainings of versions that knew no other
IMPORTED_PLANT = "recorded"  # Name of the machine in the bench file of a recording that was imported
BUILT_IN = (
    Plant(THESIS_PLANT, Mechanics(solver=EULER), Instruments()),
    Plant(DEFAULT_PLANT, Mechanics(solver=EXACT), Instruments()),
)

SHORTEST_LAG = 1e-5  # Least time constant of a current that lags at all [s]
_Check = tuple[Callable[[float], bool], str]
_MECHANICS: Mapping[str, _Check] = {
    "break_away": (lambda v: 1 <= v <= 5, "a ratio from 1 to 5"),
    "stribeck_velocity": (lambda v: 1 <= v <= 500, "a speed from 1 to 500 rad/s"),
    "stribeck_exponent": (lambda v: 1 <= v <= 4, "a number from 1 to 4"),
    "f_l": (lambda v: 0 <= v <= 1e-4, "a length from 0 to 1e-4 m"),
    "quadratic": (lambda v: 0 <= v <= 1, "a number from 0 to 1 /rad"),
    "cubic": (lambda v: 0 <= v <= 1, "a number from 0 to 1 /rad²"),
    "hysteresis": (lambda v: 0 <= v <= 0.5, "a share from 0 to 0.5"),
    "hysteresis_travel": (lambda v: 0.01 <= v <= 100, "an angle from 0.01 to 100 rad"),
    "current_lag": (lambda v: SHORTEST_LAG <= v <= 0.1, "a time from 1e-5 to 0.1 s"),
    "coulomb_asymmetry": (lambda v: abs(v) <= 0.9, "a share from -0.9 to 0.9"),
    "viscous_asymmetry": (lambda v: abs(v) <= 0.9, "a share from -0.9 to 0.9"),
    "play": (lambda v: 0 <= v <= 10, "an angle from 0 to 10 rad"),
}
_INSTRUMENTS: Mapping[str, _Check] = {
    "encoder_offset": (lambda v: abs(v) <= 10, "an angle from -10 to 10 rad"),
    "clock_jitter": (lambda v: 0 <= v <= 1e-3, "a time from 0 to 1e-3 s"),
    # Below, the noise of its velocity is correlated over so long that a fit cannot be judged by its size.
    "observer_bandwidth": (lambda v: 300 <= v <= 2000, "a bandwidth from 300 to 2000 rad/s"),
}
ASYMMETRIES = ("coulomb_asymmetry", "viscous_asymmetry")
"""Friction by direction, which goes with no other feature of the mechanics."""
_DELAYS = ("command_delay", "measurement_delay")
LONGEST_DELAY = 10  # Samples
EVERY = "all"  # Name for all plants together, which no plant may have
_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")  # it stands in tables and in sim:plant=NAME,f_v=3e-5


def read_plants(table: Table | None) -> dict[str, Plant]:
    """The built-in plants and those of a bench file's ``[plants]`` table.

    Raises:
        BenchFileError: a key is unknown, of the wrong type or out of range, or a feature does not go with the solver.
    """
    plants = {plant.name: plant for plant in BUILT_IN}
    for name in table.names() if table else ():
        assert table is not None
        if name in plants:
            raise table.fail(name, "this name is taken by the built-in plant")
        if name == EVERY or not _NAME.fullmatch(name):
            raise table.fail(name, f"expected a name of 1 to 40 letters, digits, '-' and '_', other than '{EVERY}'")
        plants[name] = _plant(name, table.table(name))
    return plants


def _plant(name: str, table: Table) -> Plant:
    given = set(table.names())
    solver = table.text("solver", SOLVERS) if "solver" in given else "exact"
    mechanics = Mechanics(**{"solver": SOLVERS.index(solver), **_numbers(table, _MECHANICS)})
    delays = {key: table.integer(key, 0, LONGEST_DELAY) for key in _DELAYS if key in given}
    instruments = Instruments(**{**delays, **_numbers(table, _INSTRUMENTS)})
    table.nothing_else(("solver", *_MECHANICS, *_INSTRUMENTS, *_DELAYS))
    for key in sorted(given & set(_MECHANICS)):
        if solver != "exact":
            raise table.fail(key, f'goes with solver = "exact", not with "{solver}"')
    if {*ASYMMETRIES} & given and (others := sorted(given & set(_MECHANICS) - {*ASYMMETRIES})):
        raise table.fail(others[0], f"does not go with {' or '.join(ASYMMETRIES)}: expected one of the two")
    if {"play", "hysteresis"} <= given:
        raise table.fail("play", "does not go with hysteresis: expected one of the two")
    for key, needed in (("stribeck_exponent", "stribeck_velocity"), ("hysteresis_travel", "hysteresis")):
        if key in given and needed not in given:
            raise table.fail(key, f"has no effect without {needed}")
    return Plant(name, mechanics, instruments)


def _numbers(table: Table, checks: Mapping[str, _Check]) -> dict[str, Any]:
    return {key: table.number(key, *check) for key, check in checks.items() if key in table.names()}
