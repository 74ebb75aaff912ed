"""References and policy files as excitations of many experiments, each with the runtime's estimator."""

from __future__ import annotations

from typing import Any

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import Ranges
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.kalman import Model, State, follow, make_model, start
from emb_runtime.estimator.speed_loop import Scale
from emb_runtime.policy.policy import Policy
from emb_train.envs.excitations import ANGLE, Currents, Seen
from emb_train.structured.law import Box, box_of, wanted_current
from emb_train.structured.stored import Stored

STATE = 30  # Numbers of a row: step, mean, covariance, innovation, worst


class Following:
    """A stored reference in N experiments.

    Attributes:
        states: of the estimators, shape [N, STATE].
    """

    def __init__(self, kept: Stored, bench: Bench, ranges: Ranges, *, sticks: bool = True) -> None:
        """Follow a reference with an estimator for these ranges."""
        self._model, self._scale = make_model(bench, ranges, sticks=sticks), kept.scale(bench)
        self._box, self._table = box_of(bench, ranges), kept.array()
        self.states: Floats = np.zeros((0, STATE))

    def begin(self, count: int) -> None:
        """Begin N experiments anew."""
        self.states = np.zeros((count, STATE))
        for row in self.states:
            to_row(start(self._model), row)

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`emb_train.envs.excitations.Excitation`."""
        wanted: Currents = np.zeros(len(seen))
        compiled(answer)(
            self._model, self._scale, self._box, self._table, self.states, np.asarray(seen, np.float64), wanted
        )
        return wanted


class PolicyFile:
    """A policy file, one experiment after the other as the runtime calls it, each with an estimator of its own."""

    def __init__(self, policy: Policy, bench: Bench) -> None:
        """Use this policy, with estimators as the bench has them."""
        self._policy, self._bench = policy, bench
        self._estimators: list[Estimator] = []

    def begin(self, count: int) -> None:
        """Begin N experiments anew."""
        self._estimators = [Estimator(self._bench) for _ in range(count)]

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`emb_train.envs.excitations.Excitation`."""
        wanted: Currents = np.zeros(len(seen))
        for i in np.flatnonzero(~np.isnan(seen[:, ANGLE])):
            angle, velocity, step, applied = seen[i].tolist()
            self._estimators[i].take(angle, velocity, step, applied)
            wanted[i] = self._policy.act(angle, velocity, step, self._estimators[i])
        return wanted


def answer(model: Model, scale: Scale, box: Box, table: Floats, states: Floats, seen: Floats, wanted: Floats) -> None:
    """Take in one sample of each experiment and answer it, in place; a sample that was lost is left out.

    Args:
        model: of the estimators.
        scale: of the reference.
        box: of its features.
        table: of the reference, see :func:`emb_train.structured.law.set_reference`.
        states: of the estimators, shape [N, STATE].
        seen: angle [rad], velocity [rad/s], step and applied current [A], shape [N, 4].
        wanted: becomes the currents [A], shape [N].
    """
    reference = np.zeros(table.shape[0])
    for i in range(len(states)):
        if not np.isnan(seen[i, ANGLE]):
            state = follow(model, of_row(states[i]), seen[i, 0], seen[i, 1], seen[i, 2], seen[i, 3])
            wanted[i] = wanted_current(model, state, scale, box, table, reference)
            to_row(state, states[i])


def to_row(state: State, row: Any) -> None:
    """Write a state into a row, shape [STATE]."""
    row[0], row[28], row[29] = state.step, state.innovation, state.worst
    for i in range(6):
        row[1 + i] = state.mean[i]
    for i in range(21):
        row[7 + i] = state.covariance[i]


def of_row(r: Any) -> State:
    """The state in a row."""
    mean = (r[1], r[2], r[3], r[4], r[5], r[6])
    covariance = (
        r[7], r[8], r[9], r[10], r[11], r[12],
        r[13], r[14], r[15], r[16], r[17],
        r[18], r[19], r[20], r[21],
        r[22], r[23], r[24],
        r[25], r[26],
        r[27],
    )  # fmt: skip
    return State(r[0], mean, covariance, r[28], r[29])
