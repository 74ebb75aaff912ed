"""Open loop: a brake driven through a record of currents, with the sensitivities of its state.

:func:`march` is the loop over a record, compiled or in plain Python; :mod:`emb_bench.experiment.simulate` adds the
instruments. Other loops need the state between two periods: the filter of :mod:`emb_bench.estimate.innovations` on
:func:`advance_shares`, and :func:`feedback` in plain Python.

**Which samples count.** A sequence of n currents u_0..u_{n−1} moves the brake from the state x_0 to x_n, and the
samples y_1..y_n after each period count. y_0 has no information on a brake with a given initial state (eq. 4.26).

**Late switching.** The command before acts for the first ``late`` part of a period.

Plain Python on the base install: 500 samples with four parameters take 3 ms on the Euler brake, 16 ms on the exact one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import SENSITIVE, STATES, Floats, Integers, advance, no_sensitivity, rest
from emb_bench.brake.parameters import COMMAND, DELAY, K_M, PARAMETERS, PAST_COMMAND
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError, near

WORTH_COMPILING = 20_000  # Periods above which the compiled functions save more time than their loading takes


class Input(NamedTuple):
    """Currents of n periods, and states that are set after gaps in the reports."""

    currents: Floats  # [A], shape (n,)
    t_s: float  # Period [s]
    late: float  # Part of a period in which the previous command still acts, 0 to below 1
    pulses: Integers  # Single periods whose current is an unknown, in ascending order, shape (g,)
    breaks: Integers  # Periods at whose ends the state is set after longer gaps, ascending, shape (h,)
    places: Floats  # Angle [rad] and velocity [rad/s] at these ends, shape (h, 2)


def zero_order_hold(currents: Floats, t_s: float, late: float = 0.0) -> Input:
    """Input of currents [A], each constant over a period of ``t_s`` [s], ``late`` periods late, without gaps."""
    none = np.zeros(0, np.int64)
    return Input(currents, t_s, late, none, none, np.zeros((0, 2)))


def trajectory(
    loop: Callable[..., None],
    mechanics: Mechanics,
    p: BrakeParameters,
    acting: Input,
    unknowns: Integers,
    x: Floats,
    s: Floats,
) -> tuple[Floats, Floats]:
    """States and sensitivities at all instants, from those at the first one.

    Shapes (n + 1, STATES) and (n + 1, m + g + 2 h, SENSITIVE): to the m ``unknowns``, then to those of the gaps, the
    currents of ``pulses`` [per A], angle and velocity at the end of each of ``breaks``. ``loop`` is :func:`march`, as
    it is or compiled.
    """
    n, rows = len(acting.currents), len(unknowns) + len(acting.pulses) + 2 * len(acting.breaks)
    states, sensitivities = np.empty((n + 1, STATES)), np.zeros((n + 1, rows, SENSITIVE))
    states[0], sensitivities[0, : len(unknowns)] = x, s
    loop(mechanics, p, acting, unknowns, states, sensitivities)
    return states, sensitivities


def march(mechanics: Mechanics, p: BrakeParameters, acting: Input, unknowns: Integers, x: Floats, s: Floats) -> None:
    """Fills states ``x`` and sensitivities ``s`` from their first rows on; see :func:`trajectory`.

    The current of a single period without report is an unknown. After a longer gap the state is set to the assumed one,
    and its angle and velocity are unknowns: the sensitivities to the motion before the gap are zero. Runs as it is or
    compiled (:func:`emb_bench.compiled.compiled`).
    """
    t_s, late, pulses, breaks, places = acting.t_s, acting.late, acting.pulses, acting.breaks, acting.places
    m, count = unknowns.shape[0], unknowns.shape[0] + pulses.shape[0]
    every = np.full(s.shape[1], PAST_COMMAND)
    for j in range(m):
        every[j] = unknowns[j]
    before, begun, broken, unknown = float(x[0, 3]), 0, 0, -1
    for k in range(acting.currents.shape[0]):
        _carry(x, s, k)
        after_gap = broken < breaks.shape[0] and breaks[broken] == k
        if after_gap:
            x[k + 1, 0], x[k + 1, 1] = places[broken, 0], places[broken, 1]
        u = float(acting.currents[k])
        if late > 0.0:
            if unknown >= 0:
                every[unknown] = COMMAND
            advance(mechanics, p, x[k + 1], before, late * t_s, every, s[k + 1])
        if unknown >= 0:
            every[unknown] = PAST_COMMAND
            unknown = -1
        if begun < pulses.shape[0] and pulses[begun] == k:
            unknown = m + begun
            every[unknown] = COMMAND
            begun += 1
        advance(mechanics, p, x[k + 1], u, (1.0 - late) * t_s, every, s[k + 1])
        before = u
        if after_gap:
            _put(x, s, k, places[broken])
            for i in range(2):
                s[k + 1, count + 2 * broken + i, i] = 1.0
            broken += 1


def march_shares(
    mechanics: Mechanics, p: BrakeParameters, acting: Input, unknowns: Integers, shares: Floats, x: Floats, s: Floats
) -> None:
    """Fills states ``x``, and sensitivities ``s`` to ``unknowns`` with weights in each period, the ``shares``.

    The ``shares``, shape (n, m), may be any numbers. The gaps have no unknowns here. Runs as it is or compiled.
    """
    every, before, broken = unknowns.copy(), float(x[0, 3]), 0
    for k in range(acting.currents.shape[0]):
        _carry(x, s, k)
        after_gap = broken < acting.breaks.shape[0] and acting.breaks[broken] == k
        if after_gap:
            x[k + 1, 0], x[k + 1, 1] = acting.places[broken, 0], acting.places[broken, 1]
        u = float(acting.currents[k])
        advance_shares(mechanics, p, x[k + 1], before, u, acting.t_s, acting.late, unknowns, shares, k, every, s[k + 1])
        before = u
        if after_gap:
            _put(x, s, k, acting.places[broken])
            broken += 1


def advance_shares(
    mechanics: Mechanics,
    p: BrakeParameters,
    x: Floats,
    before: float,
    u: float,
    t_s: float,
    late: float,
    unknowns: Integers,
    shares: Floats,
    k: int,
    every: Integers,
    s: Floats,
) -> None:
    """Period ``k``, in which the command ``u`` [A] acts late, and the one ``before`` [A] until then; in place.

    A delay's sensitivity is per duration of the step after the switch, here the shorter one: it has to be divided by
    :func:`delay_share`. The last of the ``unknowns`` have weights, the ``shares`` of shape (n, m): a period's map of a
    sensitivity is affine, s → A s + b with b of the unknown, and with a weight w it is s → w (A s/w + b); a weight of
    zero makes it the current of another period. ``every`` is a copy of ``unknowns``, which changes.
    """
    if late > 0.0:
        _share_out(unknowns, shares, k, True, True, every, s)
        advance(mechanics, p, x, before, late * t_s, every, s)
        _share_out(unknowns, shares, k, True, False, every, s)
    _share_out(unknowns, shares, k, False, True, every, s)
    advance(mechanics, p, x, u, (1.0 - late) * t_s, every, s)
    _share_out(unknowns, shares, k, False, False, every, s)


def _share_out(
    unknowns: Integers, shares: Floats, k: int, late: bool, begins: bool, every: Integers, s: Floats
) -> None:
    """Divides sensitivities by the weights at the beginning of a part of a period, multiplies them at its end.

    In the ``late`` part the previous command still acts: it and its motor constant have the weight of the period
    before.
    """
    first = unknowns.shape[0] - shares.shape[1]
    for j in range(shares.shape[1]):
        unknown, share = int(unknowns[first + j]), shares[k, j]
        if late and unknown in (K_M, COMMAND):
            share = shares[k - 1, j] if k > 0 else 0.0
        if begins:
            every[first + j] = PAST_COMMAND if share == 0.0 else unknown
        for i in range(SENSITIVE):
            if share != 0.0 and begins:
                s[first + j, i] /= share
            elif share != 0.0:
                s[first + j, i] *= share


def _carry(x: Floats, s: Floats, k: int) -> None:
    """Row k into the next one; an assignment of rows would take numba seconds to compile."""
    for i in range(STATES):
        x[k + 1, i] = x[k, i]
        for j in range(s.shape[1]):
            s[k + 1, j, i] = s[k, j, i]


def _put(x: Floats, s: Floats, k: int, place: Floats) -> None:
    """Set angle and velocity at the end of period k, without sensitivities to the motion before."""
    x[k, 1] = 2.0 * place[1] - x[k + 1, 1]  # keeps the acceleration near the place
    for i in range(2):
        x[k + 1, i] = place[i]
        for j in range(s.shape[1]):
            s[k + 1, j, i] = 0.0


def delay_share(unknown: int, late: float) -> float:
    """Divisor of a sensitivity from :func:`advance_shares` to make it one per sample: 1, except for the delay."""
    return 1.0 - late if unknown == DELAY else 1.0


def feedback(
    mechanics: Mechanics,
    p: BrakeParameters,
    law: Callable[[float, float, int], float],
    t_s: float,
    x0: tuple[float, float] = (0.0, 0.0),
) -> Iterator[tuple[float, float, float]]:
    """The current of each period [A], angle [rad] and velocity [rad/s] at its end, without end, under a feedback law.

    The law takes the true angle [rad] and velocity [rad/s] at the start of a period and its number.
    """
    x = rest()
    x[:2] = x0
    unknowns, s = no_sensitivity(())
    for k in count():
        u = law(float(x[0]), float(x[1]), k)
        advance(mechanics, p, x, u, t_s, unknowns, s)
        yield u, float(x[0]), float(x[1])


def fast_loop(periods: int) -> Callable[..., None]:
    """Returns :func:`march`, compiled if that saves time for so many periods; the results are equal."""
    if periods < WORTH_COMPILING and "numba" not in sys.modules:
        return march
    from emb_bench.compiled import compiled

    try:
        return compiled(march)
    except UsageError:  # the base install
        return march


def check_unknowns(params: Sequence[str]) -> None:
    """Refuses names that are no parameters of a brake or its instruments."""
    for name in params:
        if name not in PARAMETERS:
            names = f"{', '.join(PARAMETERS)}{near(name, PARAMETERS)}"
            raise UsageError(f"'{name}' is no parameter of the brake; expected some of {names}")
    if len(set(params)) < len(params):
        raise UsageError(f"a parameter comes twice in {', '.join(params)}: expected each once")
