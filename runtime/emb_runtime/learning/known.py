"""The brakes and states that are possible now: one record, and the head that the state of each currency begins with.

A *currency* is a way to be sure: :mod:`emb_runtime.learning.bounded` pays with bounds of the errors,
:mod:`emb_runtime.learning.gaussian` with a probability. Both are four functions:

    start(assumptions) -> State
    hear(assumptions, state, angle, velocity, applied) -> None      a sample, one period after the one before
    lose(assumptions, state) -> None                                a period of which nothing is known
    known(assumptions, state) -> Known                              see below: the same for both

A state is a flat row of floats that ``hear`` and ``lose`` change in place: its first :data:`HEAD` numbers are the same
for both. ``list[float]`` in the loop, a numpy row in the batch.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from emb_runtime.learning.assumptions import Assumptions

State = list[float]

HEARD: Final = 0  # Index of the number of samples heard
FALSIFIED: Final = 1  # Index of 1.0 where the samples contradict the assumptions, else 0.0. It stays so.
BUDGET: Final = 2  # Index of the square of the ellipsoid's radius; 1.0 where a currency has none
LOW: Final = 3
HIGH: Final = 7  # Indices of the first of the four least and of the four greatest relative parameters
ANGLE_LOW: Final = 11
ANGLE_HIGH: Final = 12
VELOCITY_LOW: Final = 13
VELOCITY_HIGH: Final = 14  # Indices of the box of states at the newest sample [rad, rad/s]
HEAD: Final = 15  # Length of the head


class Known(NamedTuple):
    """Brakes and states that the samples so far leave possible. Parameters are relative."""

    k_m_low: float
    k_m_high: float
    k_1_low: float
    k_1_high: float
    t_c_low: float
    t_c_high: float
    f_v_low: float
    f_v_high: float
    angle_low: float  # [rad]
    angle_high: float
    velocity_low: float  # [rad/s]
    velocity_high: float
    falsified: bool  # True if an assumption is wrong: then the set is the one that was known beforehand
    budget: float  # Square of the ellipsoid's radius


def start_head(assumptions: Assumptions, state: State) -> None:
    """Put what is known of the brake before the first sample into the head of a state."""
    state[HEARD], state[FALSIFIED], state[BUDGET] = 0.0, 0.0, 1.0
    low, high = assumptions.low, assumptions.high
    state[LOW], state[LOW + 1], state[LOW + 2], state[LOW + 3] = low
    state[HIGH], state[HIGH + 1], state[HIGH + 2], state[HIGH + 3] = high


def falsify(assumptions: Assumptions, state: State, angle: float, velocity: float) -> None:
    """Give up what was learnt: the set known beforehand, and the states around the newest sample [rad, rad/s]."""
    start_head(assumptions, state)
    state[FALSIFIED] = 1.0
    state[ANGLE_LOW], state[ANGLE_HIGH] = angle - assumptions.angle_noise, angle + assumptions.angle_noise
    state[VELOCITY_LOW] = velocity - assumptions.velocity_noise
    state[VELOCITY_HIGH] = velocity + assumptions.velocity_noise


def known(assumptions: Assumptions, state: State) -> Known:
    """Brakes and states that are possible at the newest sample; arguments as for the currencies."""
    return Known(
        state[LOW],
        state[HIGH],
        state[LOW + 1],
        state[HIGH + 1],
        state[LOW + 2],
        state[HIGH + 2],
        state[LOW + 3],
        state[HIGH + 3],
        state[ANGLE_LOW],
        state[ANGLE_HIGH],
        state[VELOCITY_LOW],
        state[VELOCITY_HIGH],
        state[FALSIFIED] != 0.0,
        state[BUDGET],
    )


def numbers(known: Known, age: int) -> tuple[float, ...]:
    """Numbers for the log: ranges of the four parameters, of angle and velocity; the budget, and the law's age."""
    return (*known[:12], known.budget, float(age))
