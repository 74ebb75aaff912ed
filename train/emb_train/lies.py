"""Detectability of a faulty node by the motion of an experiment.

The runtime ends a run whose motion no single brake explains (:mod:`emb_runtime.safety.motion_balance`). Whether this
test detects a fault depends on the excitation: a scale that drifts is detected in long strokes, not in slow motion.
Here the record of a fault-free experiment is changed as the fault would change it, and the balance tests it. The loop
follows the reported values: with a wrong sensor the reported motion stays the same, and the true motion and its
currents change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.safety.motion_balance import BalanceModel, balance_model, begin_balance, origin, take, unexplained

SWING = 10.0 * np.pi  # Angular frequency of a swinging scale [rad/s]


class Record(NamedTuple):
    """Record of n periods of the length ``ts`` [s], as measured, or as a faulty node would cause it."""

    ts: float
    brake: BrakeParameters  # The true one
    x: Floats  # Angles [rad], shape [n + 1]
    v: Floats  # Velocities [rad/s], shape [n + 1]
    u: Floats  # Currents of the periods [A], shape [n]

    @property
    def at(self) -> Floats:
        """Times of the samples [s], shape [n + 1]."""
        times: Floats = self.ts * np.arange(len(self.x), dtype=np.float64)
        return times

    @property
    def within(self) -> Floats:
        """Times of the middle of each period [s], shape [n]."""
        return self.at[:-1] + 0.5 * self.ts

    def moved(self, x: Floats, v: Floats) -> Record:
        """The record with another true motion, shape [n + 1] each: the loop follows the reported one."""
        brake, more = self.brake, v - self.v
        spring = brake.gamma * brake.k_1 * (np.maximum(x, 0.0) - np.maximum(self.x, 0.0))[1:]
        return self.pulled(brake.J * np.diff(more) / self.ts + spring + brake.f_v * more[1:])

    def scaled(self, scale: Floats) -> Record:
        """The record with scaled angle and velocity, shape [n + 1]; the angle stays the integral of the velocity."""
        v = self.v / scale
        moves = 0.5 * self.ts * (v[1:] + v[:-1])
        return self.moved(self.x[0] + np.concatenate([[0.0], np.cumsum(moves)]), v)

    def pulled(self, torque: Floats) -> Record:
        """The record with an additional torque, which the current overcomes [N·m], shape [n]."""
        return self._replace(u=self.u + torque / self.brake.k_m)


LIES: Mapping[str, Callable[[Record], Record]] = {
    "scale slides by 0.5/s": lambda r: r.scaled(1.0 - 0.5 * r.at),
    "scale slides by -0.5/s": lambda r: r.scaled(1.0 + 0.5 * r.at),
    "scale swings": lambda r: r.scaled(1.0 + 0.1 * np.sin(SWING * r.at)),
    "angle curved": lambda r: r.moved(r.x + 0.001 * r.x**2, r.v * (1.0 + 0.002 * r.x)),
    "zero at 5 rad": lambda r: r.moved(r.x + 5.0, r.v),
    "zero at -5 rad": lambda r: r.moved(r.x - 5.0, r.v),
    "current grows by -0.5/s": lambda r: r._replace(u=r.u / (1.0 - 0.5 * r.within)),
    "current swings": lambda r: r._replace(u=r.u / (1.0 + 0.1 * np.sin(SWING * r.within))),
    "current times 1.05": lambda r: r._replace(u=np.where(r.within > 0.06, r.u / 1.05, r.u)),
    "reported current +0.1 A": lambda r: r._replace(u=r.u + 0.1),
    "friction doubles": lambda r: r.pulled(r.brake.T_c * np.sign(r.v[1:]) * r.within),
    "stiffness halves": lambda r: r.pulled(
        -0.5 * r.brake.gamma * r.brake.k_1 * np.maximum(r.x[1:], 0.0) * (r.within > 0.25)
    ),
}
"""The changes of a record by faults of a node, by name."""


def clearness(bench: Bench, brakes: list[BrakeParameters], motion: Floats, currents: Floats) -> Floats:
    """Unexplained velocity by each fault in each of N experiments, as a share of the limit for a fault-free run.

    Args:
        bench: of the experiments.
        brakes: their brakes, N.
        motion: true angles and velocities at the samples [rad, rad/s], shape [N, n + 1, 2].
        currents: those that acted [A], shape [N, n].

    Returns:
        Shape [N, faults]: above 1 the fault ends the run; 0 where the motion is too small for a verdict; infinite on a
        bench whose runs have no verdict.
    """
    model, ts, found = balance_model(bench), bench.timing.sample_time, np.full((len(brakes), len(LIES)), np.inf)
    if model.allowed == math.inf:
        return found
    for row, brake, states, acted in zip(found, brakes, motion, currents, strict=True):
        honest = Record(ts, brake, states[:, 0], states[:, 1], acted)
        records = [lie(honest) for lie in LIES.values()]
        arguments: tuple[Any, ...] = (
            model,
            np.stack([record.x for record in records]),
            np.stack([record.v for record in records]),
            np.stack([record.u for record in records]),
            row,
        )
        compiled(judge_records)(*arguments)
    return found


def judge_records(model: BalanceModel, x: Floats, v: Floats, u: Floats, found: Floats) -> None:
    """Let the balance judge some records, at their ends; shapes as in :class:`Record` with one axis before."""
    for i in range(len(found)):
        state = begin_balance(x[i, 0], v[i, 0])
        for k in range(u.shape[1]):
            state = take(model, state, True, x[i, k + 1], v[i, k + 1], u[i, k])
        residual, allowed = unexplained(model, state)
        place, most = origin(model, state)
        found[i] = max(residual / allowed, abs(place) / most) if allowed < math.inf else 0.0
