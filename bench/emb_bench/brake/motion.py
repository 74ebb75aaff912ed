"""One sample period of any plant: state and sensitivities, in place.

Plain Python on numpy arrays; the batch runs it compiled by :func:`emb_bench.compiled.compiled`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.euler import advance_euler
from emb_bench.brake.exact import advance_exact
from emb_bench.brake.extended import advance_extended
from emb_bench.brake.parameters import PARAMETERS, X1_0, X2_0
from emb_bench.config.plants import EULER, Mechanics
from emb_runtime.config.bench import BrakeParameters

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STATES = 4
"""Angle [rad], velocity [rad/s], position in the hysteresis −1..1 or with play the lag of the clamp behind the motor
[rad], current in the motor [A]."""
SENSITIVE = 4  # Sensitivities of the same, in this order; that of the current only with a lag of the current


def advance(
    mechanics: Mechanics, p: BrakeParameters, x: Floats, u: float, t_s: float, unknowns: Integers, s: Floats
) -> None:
    """One sample period with a constant current, in place.

    Without a current lag x[3] is the current of the period before. ``unknowns`` are indices in ``PARAMETERS`` of the n
    unknowns; ``s``, shape (n, SENSITIVE), are the sensitivities of the states to them.
    """
    if mechanics.solver == EULER:
        advance_euler(p, x, u, t_s, unknowns, s)
    elif is_plain(mechanics) or mechanics.viscous_asymmetry != 0.0:  # which goes with no other feature
        advance_exact(p, x, u, t_s, unknowns, s, mechanics.viscous_asymmetry)
    else:
        advance_extended(mechanics, p, x, u, t_s, unknowns, s)


PLAIN = Mechanics()


def is_plain(m: Mechanics) -> bool:
    """Returns True if a brake solved exactly has none of the features beyond the thesis's equations."""
    return m[1:-1] == PLAIN[1:-1]  # except the solver and the tolerance of the integration


def rest() -> Floats:
    """The state of a brake at rest at the origin, without current."""
    return np.zeros(STATES)


def no_sensitivity(params: Sequence[str]) -> tuple[Integers, Floats]:
    """Indices of the named unknowns, and the sensitivities at the start: to the initial state alone (eq. 4.26).

    Raises:
        ValueError: a name is not in ``PARAMETERS``.
    """
    unknowns = np.array([list(PARAMETERS).index(name) for name in params], np.int64)
    s = np.zeros((len(unknowns), SENSITIVE))
    s[unknowns == X1_0, 0] = 1.0
    s[unknowns == X2_0, 1] = 1.0
    return unknowns, s
