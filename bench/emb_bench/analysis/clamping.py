"""Clamping force at an angle, the current that holds it, and the friction band, from an estimate.

With the clamping force F of :func:`emb_bench.brake.forces.clamping_force` while the brake is applied, and the static
friction T_s under it,

    current = γ F / k_m − current_offset,   friction = T_s / γ

A current between (γ F − T_s)/k_m and (γ F + T_s)/k_m holds the force F: a current determines the force to ± friction.
The totals follow from D C Dᵀ, with the estimate's total covariance C and the Jacobian D of the three. So errors common
to the parameters count with their signs: an error of J changes k_1 and k_m alike, and the current not at all. The angle
is the encoder's, from contact: an error of its scale changes k_m and T_c in C, and the angle besides.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emb_bench.brake.forces import (
    clamping_force,
    clamping_share,
    clamping_slopes,
    sliding_share,
    static_torque,
    stop_limit,
)
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import CONTACT, CURRENT_OFFSET, K_M, PARAMETERS, PLAY
from emb_bench.config.plants import Mechanics
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import NORMAL_95
from emb_runtime.config.bench import BrakeParameters

NEEDED = ("k_m", "k_1", "T_c")  # Parameters that the three depend on
SCALE = "angle_scale"  # Entry of the budget that changes the angle


class Amount(NamedTuple):
    """A number with its total."""

    value: float
    total: float  # Half of the 95 % interval, in ``unit``
    unit: str

    @property
    def with_interval(self) -> tuple[float, tuple[float, float], str]:
        """Value, 95 % interval and unit."""
        return self.value, (self.value - self.total, self.value + self.total), self.unit


class Clamping(NamedTuple):
    """Clamping force of a brake that is applied."""

    angle: float  # As the encoder counts it from contact [rad]
    force: Amount  # At this angle
    current: Amount  # Middle of the currents that hold the force, as reported by the node
    friction: Amount  # Half of the friction band


def clamping(e: Estimate, angle: float | None = None) -> Clamping | None:
    """Clamping force at an angle [rad], by default the largest measured one, to two digits.

    Returns:
        None for a machine that is no brake, if a parameter of ``NEEDED`` is missing, or if the brake never clamped.
    """
    names = [unknown.name for unknown in e.unknowns]
    if e.bench.machine is not None or not {*NEEDED} <= {*names}:
        return None
    x, m, p = _largest(e) if angle is None else angle, e.problem.mechanics(e.z), e.theta
    if x <= 0.5 * m.play:
        return None
    offset = dict(zip(names, e.values.tolist(), strict=True)).get("current_offset", 0.0)
    force = clamping_force(m, p, x, _w(m))
    values = force, p.gamma * force / p.k_m - offset, static_torque(m, p, force) / p.gamma
    jacobian, along = _jacobian(m, p, x, names)
    used = jacobian.any(axis=0)
    covariance = jacobian[:, used] @ e.covariance()[np.ix_(used, used)] @ jacobian[:, used].T
    for one in e.validation.budget:
        if one.name == SCALE:  # the angle of a true one is smaller by it
            biased, direct = jacobian @ np.array(one.bias), -one.size * along
            covariance += np.outer(biased, direct) + np.outer(direct, biased) + np.outer(direct, direct)
    totals = NORMAL_95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Clamping(x, *map(Amount, values, totals.tolist(), ("N", "A", "N")))


def _largest(e: Estimate) -> float:
    """Largest angle from contact in the experiments, rounded down to two digits [rad]; 0 where none is above."""
    seen = [
        float(np.nanmax(x.samples[:, 0], initial=-math.inf)) - e.problem.at(e.z, i).offset(e.plant)
        for i, x in enumerate(e.experiments)
    ]
    largest = max(seen) - e.problem.at(e.z, 0).contact
    if not 0.0 < largest < math.inf:
        return 0.0
    digit = 10.0 ** (math.floor(math.log10(largest)) - 1)
    return float(f"{math.floor(largest / digit) * digit:.2g}")


def _w(m: Mechanics) -> float:
    """State of the play or hysteresis of a brake that is applied."""
    return stop_limit(m) if m.play > 0.0 or m.hysteresis > 0.0 else 0.0


def _jacobian(m: Mechanics, p: BrakeParameters, x: float, names: list[str]) -> tuple[Floats, Floats]:
    """Derivatives of force, current and friction along the unknowns, shape (3, unknowns), and along x, times x."""
    w, index = _w(m), list(PARAMETERS)
    slope, by_w = clamping_slopes(m, p, x, w)
    force, columns = clamping_force(m, p, x, w), []

    def column(change: float, torque: float = 0.0, current: float = 0.0) -> tuple[float, float, float]:
        """Of a change of the force [N], of the friction under a constant one [N·m], of the current beside it [A]."""
        return change, p.gamma * change / p.k_m + current, (torque + m.f_l * change) / p.gamma

    for i in map(index.index, names):
        change = by_w * w if i == PLAY else 0.0 if i == CONTACT else clamping_share(m, p, x, w, i)
        current = -p.gamma * force / p.k_m if i == K_M else -1.0 if i == CURRENT_OFFSET else 0.0
        columns.append(column(change, sliding_share(m, p, 0.0, force, 1.0, i), current))
    return np.array(columns).T, np.array(column(slope * x))
