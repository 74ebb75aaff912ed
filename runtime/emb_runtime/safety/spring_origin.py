"""Angle at which the spring begins, by the motion of a whole run: is the zero of the angle right?

A zero that is wrong by z adds the torque γ k_1 z wherever the spring presses, whatever the angle; so does a current
that is not reported. While the brake slides, its velocity is that at the begin of the stretch and the sum of the
regressors of :mod:`emb_runtime.safety.motion_balance`, times their coefficients. The constant torque is one more
regressor. Least squares takes the velocities less their mean in each stretch: the errors of velocities are independent,
those of their changes are not.

Plain scalar functions on one row of numbers, as there.
"""

from __future__ import annotations

import math
from typing import Any, Final

COEFFICIENTS: Final = 9  # Those of the motion balance, and the spring's origin as a share of the travel
PHYSICAL: Final = 4  # Coefficients of the brake, which are 1 on the nominal one
WIDTH: Final = COEFFICIENTS + 1  # And the velocity
PRODUCTS: Final = COEFFICIENTS * (COEFFICIENTS + 3) // 2

ALLOWED: Final = 2.2  # Distance from 0 that an honest run may show, beside what follows [rad]
ERRORS: Final = 6.0  # Errors of the origin that are allowed, in standard deviations
LATE: Final = 20.0  # Allowed where all of the current acts late, or the velocity lags [rad]

# Places in the row.
COUNT: Final = 0  # Velocities in the present stretch
SUM: Final = 1  # Sums of the regressors since its begin, and the change of the velocity
FIRST: Final = SUM + WIDTH  # Sums of these over its velocities
SECOND: Final = FIRST + WIDTH  # Sums of their products: upper triangle by rows
NORMAL: Final = SECOND + PRODUCTS  # The same of earlier stretches, less the means
WORK: Final = NORMAL + PRODUCTS  # Equations during elimination
SOLUTION: Final = WORK + COEFFICIENTS * WIDTH  # Coefficients
MEMORY: Final = SOLUTION + COEFFICIENTS  # Length of the row


def begin(memory: Any) -> None:
    """Begin a run: overwrite a row of shape [MEMORY]."""
    for i in range(MEMORY):
        memory[i] = 0.0


def add(memory: Any, regressors: tuple[float, ...], constant: float, change: float) -> None:
    """Take in a period in which the brake slid.

    Args:
        memory: row of the run, changed.
        regressors: of the motion balance [rad/s].
        constant: regressor of the origin: the constant torque of the spring at the largest angle [rad/s].
        change: of the velocity [rad/s].
    """
    memory[COUNT] = max(memory[COUNT], 1.0) + 1.0  # with the one at its begin, where all sums are 0
    for i in range(COEFFICIENTS - 1):
        memory[SUM + i] += regressors[i]
    memory[SUM + COEFFICIENTS - 1] += constant
    memory[SUM + COEFFICIENTS] += change
    place = SECOND
    for i in range(COEFFICIENTS):
        left = memory[SUM + i]
        memory[FIRST + i] += left
        for j in range(i, WIDTH):
            memory[place] += left * memory[SUM + j]
            place += 1
    memory[FIRST + COEFFICIENTS] += memory[SUM + COEFFICIENTS]


def end_stretch(memory: Any) -> None:
    """Take in that the brake did not slide in a period, or that nothing is known of it."""
    count = memory[COUNT]
    if count == 0.0:
        return
    place = 0
    for i in range(COEFFICIENTS):
        for j in range(i, WIDTH):
            memory[NORMAL + place] += memory[SECOND + place] - memory[FIRST + i] * memory[FIRST + j] / count
            place += 1
    for at in range(COUNT, NORMAL):
        memory[at] = 0.0


def origin(memory: Any, deviation: float, travel: float) -> tuple[float, float]:
    """Angle at which the nominal spring begins, and how far from 0 it may [rad].

    Args:
        memory: row of the run, changed.
        deviation: standard deviation of a velocity [rad/s].
        travel: unit of the origin's coefficient [rad].
    """
    end_stretch(memory)
    prior = deviation * deviation
    place = NORMAL
    for i in range(COEFFICIENTS):
        for j in range(i, WIDTH):
            memory[WORK + i * WIDTH + j] = memory[place]
            place += 1
        memory[WORK + i * WIDTH + i] += prior
        memory[WORK + i * WIDTH + COEFFICIENTS] += prior if i < PHYSICAL else 0.0
    eliminate(memory, WORK, SOLUTION, COEFFICIENTS, WIDTH)
    last = COEFFICIENTS - 1
    error = deviation / math.sqrt(memory[WORK + last * WIDTH + last])  # the last pivot is an inverse variance
    late = abs(memory[SOLUTION + PHYSICAL]) + abs(memory[SOLUTION + PHYSICAL + 1])
    return -travel * float(memory[SOLUTION + last]), float(ALLOWED + ERRORS * travel * error + LATE * late)


def eliminate(memory: Any, work: int, solution: int, count: int, width: int) -> None:
    """Solve symmetric equations by Gauss's elimination, in the row.

    Args:
        memory: row, changed.
        work: place of the equations: upper triangle of ``count`` rows of ``width``, with the right side at the end.
        solution: place of what solves them.
        count: of the equations.
        width: of a row.
    """
    for i in range(count):
        top = work + i * width
        for j in range(i + 1, count):
            factor = memory[top + j] / memory[top + i]
            for k in range(j, width):
                memory[work + j * width + k] -= factor * memory[top + k]
    for i in range(count - 1, -1, -1):
        top = work + i * width
        value = memory[top + width - 1]
        for j in range(i + 1, count):
            value -= memory[top + j] * memory[solution + j]
        memory[solution + i] = value / memory[top + i]
