"""The brakes and states that are possible now, and the head of the learner's state that they are read from.

A state is a flat row of floats that :mod:`emb_runtime.learning.bounded` changes in place: ``list[float]`` in the loop,
a numpy row in the batch.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from emb_runtime.learning.assumptions import Assumptions

State = list[float]

HEARD: Final = 0  # Index of the number of samples heard
FALSIFIED: Final = 1  # Index of 1.0 where the samples contradict the assumptions, else 0.0. It stays so.
LOW: Final = 2
HIGH: Final = 6  # Indices of the first of the four least and of the four greatest relative parameters
ANGLE_LOW: Final = 10
ANGLE_HIGH: Final = 11
VELOCITY_LOW: Final = 12
VELOCITY_HIGH: Final = 13  # Indices of the box of states at the newest sample [rad, rad/s]
HEAD: Final = 14  # Length of the head


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


def start_head(assumptions: Assumptions, state: State) -> None:
    """Put what is known of the brake before the first sample into the head of a state."""
    state[HEARD], state[FALSIFIED] = 0.0, 0.0
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


def known(state: State) -> Known:
    """Brakes and states that are possible at the newest sample."""
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
    )


def numbers(known: Known, age: int) -> tuple[float, ...]:
    """Numbers for the log: ranges of the four parameters, of angle and velocity; the law's age."""
    return (*known[:12], float(age))
