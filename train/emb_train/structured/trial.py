"""Whole experiments under a structured excitation, compiled: estimator, reference, loop, shield, brake, information.

The step is :func:`emb_train.envs.closed_loop.advance_one`, so that what is tuned here is what the environment plays.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.learning.known import known
from emb_runtime.learning.law import law_for, middle
from emb_train.envs.batch import Batch
from emb_train.envs.closed_loop import Experiments, Setup, advance_one, with_law
from emb_train.envs.conditions import BENCH_CONDITIONS, Bools, Conditions
from emb_train.envs.play import Draw, Outcome, begin_all, joined
from emb_train.structured.estimator import (
    MISFIT,
    WORST,
    Four,
    Model,
    believed,
    deviation,
    make_model,
    start,
)
from emb_train.structured.law import FEATURES, PRODUCTS, Loop, act, features, share_after
from emb_train.structured.learning import Learning, Shield, begin, holds, listen, make_learning, miss

CHUNK = 64  # Experiments that a thread plays at a time
ANY_PRECISION: Four = (math.inf, math.inf, math.inf, math.inf)
"""Relative deviations of k_m, k_1, T_c and f_v at which an experiment is over: none."""


@dataclass(frozen=True, eq=False)
class ReportedOutcome(Outcome):
    """Final results of N experiments and of their estimators."""

    estimates: Floats  # State of the estimator at the end, shape [N, STATE]
    mistaken: Bools
    """Mask of the experiments in which the truth was at some time outside what the shield had learnt, shape [N]."""
    known: Floats
    """Time until the estimates had the precision asked for [s], shape [N]. Where they had not at the end: more than the
    experiment's duration, by as much as the logarithm of what was missing says."""
    used: Floats
    """Features with which each level and each switch of the reference was used, on average, 0 where it was not; only of
    trials that are :meth:`Trials.perturbed`, shape [N, 2 n − 1, C]."""


class Trials(Batch):
    """N brakes with their noise, on which excitations are compared: every one meets the same."""

    def __init__(
        self,
        bench: Bench,
        ranges: Ranges,
        parameters: Sequence[str],
        draws: Sequence[Draw],
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
        shield: Shield = "worst case",
        precision: Four = ANY_PRECISION,
    ) -> None:
        """Begin the experiments.

        Args:
            bench: limits, noise, timing, shield.
            ranges: where the brakes lie, which the estimator knows.
            parameters: whose information counts.
            draws: brakes and noise.
            plant: which of the bench's plants.
            conditions: which information is collected, and for which brakes the shield holds the limits.
            shield: for all of them at any time, or for what has been learnt of each.
            precision: relative deviations of k_m, k_1, T_c and f_v; once the estimates have them, 0 A is asked for.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits.
            UsageError: see :class:`emb_train.envs.batch.Batch`, :func:`emb_train.structured.estimator.make_model` and
                :func:`emb_train.structured.learning.make_learning`.
        """
        super().__init__(bench, ranges, parameters, len(draws), compiled, plant, conditions)
        self.learning = make_learning(self.bench, shield, self._plant, conditions.randomised)
        self.model = make_model(bench, ranges, plant)
        self.precision = precision
        begin_all(self, draws)

    def play(self, loop: Loop, tables: Floats) -> list[ReportedOutcome]:
        """Play every reference on all the brakes.

        Args:
            loop: how they are followed.
            tables: of the references, see :func:`emb_train.structured.law.share_after`, shape [C, 2 n − 1, TERMS].
        """
        count = len(self.k)
        each = [np.tile(table, (count, 1, 1)) for table in np.asarray(tables, np.float64)]
        return self._all(loop, each, 0)

    def perturbed(self, loop: Loop, tables: Sequence[Floats]) -> list[ReportedOutcome]:
        """Play several times, with a reference for each brake; says with which features it was used.

        Args:
            loop: how they are followed.
            tables: of the references, each of shape [N, 2 n − 1, TERMS].
        """
        return self._all(loop, tables, tables[0].shape[1])

    def _all(self, loop: Loop, tables: Sequence[Floats], noted: int) -> list[ReportedOutcome]:
        parts = [slice(i, i + CHUNK) for i in range(0, len(self.k), CHUNK)]
        pieces = [(table[part], part, noted) for table in tables for part in parts]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            found = list(pool.map(lambda piece: self._play(loop, *piece), pieces))
        return [joined(found[i : i + len(parts)]) for i in range(0, len(found), len(parts))]

    def _play(self, loop: Loop, tables: Floats, part: slice, noted: int) -> ReportedOutcome:
        experiments = Experiments._make(array[part].copy() for array in self.experiments)
        x, count, shield = experiments.x, len(experiments.k), self.bench.shield
        m, left, mistaken = np.zeros_like(experiments.m), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        states, reached = np.tile(start(self.model), (count, 1)), np.zeros(count)
        learnt = np.tile(begin(self.learning), (count, 1))
        used = np.zeros((count, noted, tables.shape[2]))
        play = compiled(play_trials)
        play(
            self.setup,
            experiments,
            self.model,
            self.learning,
            loop,
            np.ascontiguousarray(tables),
            self.precision,
            states,
            learnt,
            m,
            left,
            mistaken,
            reached,
            used,
        )
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        matrices = unpack(m, len(self.parameters))
        return ReportedOutcome(matrices, left, home, x[:, 0], x[:, 1], states, mistaken, reached, used)


def play_trials(
    setup: Setup,
    experiments: Experiments,
    model: Model,
    learning: Learning,
    loop: Loop,
    tables: Floats,  # Of the references, shape [N, 2 n − 1, TERMS]
    precision: Four,  # At which 0 A is asked for from then on, and the estimate rests
    states: Floats,  # Of the estimators, shape [N, STATE]
    learnt: Floats,  # What the shields have learnt, one row each
    informed: Floats,  # Becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2]
    left: Bools,  # Becomes whether they were, shape [N]
    mistaken: Bools,  # Becomes whether the truth was ever not among what was learnt, shape [N]
    reached: Floats,  # Becomes the time until the precision was reached [s], shape [N]
    used: Floats,  # Becomes the mean features of each row of the table; nothing is noted if it has no rows
) -> None:
    """N experiments from their first sample to their end, or to where they leave the limits, in place."""
    k, duration = experiments.k, setup.rules.sample_time * setup.rules.horizon
    weights = np.zeros(used.shape[1])
    for i in range(k.shape[0]):
        weights[:] = 0.0
        now, wanted, missing, over = setup, 0.0, math.inf, False
        for _ in range(setup.rules.horizon):
            if not experiments.lost[i, k[i]]:  # else the law is not called
                if not over:
                    wanted = asked(experiments, i, model, loop, tables[i], states[i], used[i], weights)
                    before, missing = missing, lacking(model, states[i], precision)
                    over = missing <= 1.0
                    reached[i] = reached_at(setup.rules.sample_time, k[i], before, missing)
                if over:
                    wanted = 0.0
                    if used.shape[1] > 0:  # it is trained, and only the time counts
                        break
                now = with_learnt(setup, experiments, i, learning, learnt[i], mistaken)
            elif learning.learns:
                miss(learning, learnt[i])
            advance_one(now, experiments, i, wanted)
            if experiments.violated[i]:
                left[i] = True
                break
            if not over:
                informed[i] = experiments.m[i]
        if not over:
            reached[i] = duration * (1.0 + math.log(max(missing, 1.0)))
        average(used[i], weights)


def asked(
    experiments: Experiments, i: int, model: Model, loop: Loop, table: Any, state: Any, used: Any, weights: Any
) -> float:
    """Current that the reference requests for the newest sample of an experiment [A]; notes what it used."""
    y, step = experiments.y, float(experiments.k[i])
    wanted = act(model, loop, table, state, y[i, 0], y[i, 1], step, experiments.applied[i])
    if used.shape[0] > 0:
        note_use(model, loop, table, state, step, used, weights)
    return wanted


def with_learnt(
    setup: Setup, experiments: Experiments, i: int, learning: Learning, learnt: Any, mistaken: Bools
) -> Setup:
    """The setup with the shield for what has been learnt, after the newest sample of an experiment."""
    brakes, x, y = experiments.brakes, experiments.x, experiments.y
    if learning.learns:
        listen(learning, learnt, y[i, 0], y[i, 1], experiments.applied[i])
        possible = known(learnt)
        mistaken[i] = mistaken[i] or not holds(learning.nominal, possible, brakes[i], x[i, 0], x[i, 1])
        if not possible.falsified:
            y[i, 0], y[i, 1] = middle(possible)
            return with_law(setup, law_for(learning.setting, learning.nominal, possible))
    return setup


def reached_at(sample_time: float, step: int, before: float, missing: float) -> float:
    """Time at which what is missing came to 1, between the sample before and this one, so that it is continuous [s]."""
    if 0.0 < missing <= 1.0 < before < math.inf:
        return sample_time * (step - math.log(missing) / (math.log(missing) - math.log(before)))
    return sample_time * step


def lacking(model: Model, state: Any, precision: Four) -> float:
    """Greatest ratio of a relative deviation to the one asked for; infinite if none is, or the model does not fit."""
    if state[WORST] > MISFIT or min(precision) == math.inf:
        return math.inf
    missing = 0.0
    for i in range(FEATURES):
        missing = max(missing, deviation(model, state, i) / (precision[i] * believed(model, state, i)))
    return missing


def note_use(model: Model, loop: Loop, table: Any, state: Any, step: float, used: Any, weights: Any) -> None:
    """Add the features with which each level is used now, by its share of the period, and each switch that begins."""
    f = features(model, state)
    levels, before = (table.shape[0] + 1) // 2, 1.0
    for i in range(levels):
        after = min(before, share_after(table, i + 1, f, step, loop.horizon))
        if before > after:
            _add(used[i], f, before - after)
            weights[i] += before - after
        if after > 0.0 and weights[levels + i] == 0.0:
            _add(used[levels + i], f, 1.0)
            weights[levels + i] = 1.0
        before = after


def average(used: Any, weights: Any) -> None:
    """Divide the sums of :func:`note_use` by their weights, in place."""
    for j in range(used.shape[0]):
        if weights[j] > 0.0:
            used[j] /= weights[j]


def _add(total: Any, f: Four, weight: float) -> None:
    """Add the features of a row of a table."""
    total[0] += weight
    for i in range(FEATURES):
        total[1 + i] += weight * f[i]
    for at in range(len(PRODUCTS)):
        i, j = PRODUCTS[at]
        total[1 + FEATURES + at] += weight * f[i] * f[j]
