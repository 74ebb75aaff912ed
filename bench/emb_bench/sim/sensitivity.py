"""How any brake moves under a sequence of currents, and how its samples depend on what is unknown about it.

**Which samples count.** A sequence of n currents u_0..u_{n−1} moves the brake from the state x_0 to x_n, and the
samples y_1..y_n after each period count. y_0 tells nothing of a brake that starts from a known state (eq. 4.26).

Plain Python on the base install: 500 samples with four unknowns take 4 ms on the Euler brake, 16 ms on the exact one. A
batch compiles :func:`march`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats, Integers, advance, no_sensitivity, rest
from emb_bench.brake.parameters import OFFSET, UNKNOWNS
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics
from emb_runtime.errors import UsageError


class Run(NamedTuple):
    """What a brake did, and what that depends on."""

    states: Floats
    """Angle [rad] and velocity [rad/s] at the n + 1 instants around the n periods, shape (n + 1, 2)."""
    sensitivities: Floats
    """Of the samples y_1..y_n to the unknowns, shape (n, unknowns, 2): of the angle [rad] and of the velocity [rad/s].

    Relative for the brake's parameters, θ_i ∂y/∂θ_i at its own θ (eq. 4.17); per unit for those in ``UNITS``.
    """


def simulate(
    mechanics: Mechanics,
    p: BrakeParameters,
    currents: Sequence[float] | Floats,
    t_s: float,
    params: Sequence[str] = (),
    x0: tuple[float, float] = (0.0, 0.0),
) -> Run:
    """Move a brake through a sequence of currents; limits are not applied.

    Args:
        mechanics: how the brake moves.
        p: its parameters.
        currents: what acts in each period [A], length n. Before the first one no current acted.
        t_s: period [s].
        params: names of the unknowns, any of ``UNKNOWNS`` in any order; none gives the states alone.
        x0: angle [rad] and velocity [rad/s] at the start. Unless ``x1_0`` and ``x2_0`` are among the unknowns, known.

    Raises:
        UsageError: ``currents`` is not one row of finite numbers, or a name is unknown or comes twice.
    """
    check_unknowns(params)
    applied = _finite(currents)
    chosen, s = no_sensitivity(params)
    x = rest()
    x[:2] = x0
    states, shown = np.empty((len(applied) + 1, 2)), np.empty((len(applied), len(chosen), 2))
    march(mechanics, p, x, applied, t_s, chosen, s, states, shown)
    shown[:, chosen == OFFSET, 0] += 1.0
    return Run(states, shown)


def march(
    mechanics: Mechanics,
    p: BrakeParameters,
    x: Floats,
    currents: Floats,
    t_s: float,
    chosen: Integers,
    s: Floats,
    states: Floats,
    shown: Floats,
) -> None:
    """One period after the other; runs as it is or compiled (:func:`emb_bench.compiled.compiled`).

    Args:
        mechanics: how the brake moves.
        p: its parameters.
        x: state as :func:`emb_bench.brake.motion.advance` takes it, in place.
        currents: shape (n,) [A].
        t_s: period [s].
        chosen: indices of the unknowns in ``UNKNOWNS``.
        s: sensitivities of the state, in place, as ``advance`` takes them.
        states: becomes angle and velocity at all instants, shape (n + 1, 2).
        shown: becomes their sensitivities after each period, shape (n, len(chosen), 2).
    """
    states[0, 0], states[0, 1] = x[0], x[1]
    for k in range(currents.shape[0]):
        advance(mechanics, p, x, float(currents[k]), t_s, chosen, s)
        states[k + 1, 0], states[k + 1, 1] = x[0], x[1]
        for j in range(chosen.shape[0]):
            shown[k, j, 0], shown[k, j, 1] = s[j, 0], s[j, 1]


def check_unknowns(params: Sequence[str]) -> None:
    """Refuse names that are no unknowns.

    Raises:
        UsageError: an unknown name, or one that comes twice.
    """
    for name in params:
        if name not in UNKNOWNS:
            raise UsageError(f"'{name}' is no parameter of the brake; expected some of {', '.join(UNKNOWNS)}")
    if len(set(params)) < len(params):
        raise UsageError(f"a parameter comes twice in {', '.join(params)}: expected each once")


def _finite(currents: Sequence[float] | Floats) -> Floats:
    row = np.asarray(currents, dtype=np.float64)
    if row.ndim != 1:
        raise UsageError(f"expected one row of currents, got an array of shape {row.shape}")
    if not np.isfinite(row).all():
        k = int(np.argmin(np.isfinite(row)))
        raise UsageError(f"expected finite currents, got {row[k]} at step {k}")
    return row
