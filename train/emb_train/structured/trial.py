"""Whole experiments under a structured excitation, compiled: estimator, reference, loop, shield, brake, information.

The step is :func:`emb_train.envs.closed_loop.advance_one`, so that what is tuned here is what the environment plays.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.learning.known import known
from emb_runtime.learning.law import law_for, middle
from emb_runtime.safety.shield_design import ShieldLaw
from emb_train.envs.batch import Batch
from emb_train.envs.closed_loop import Experiments, Setup, advance_one, make_setup, with_law
from emb_train.envs.conditions import BENCH_CONDITIONS, Bools, Conditions
from emb_train.envs.play import Draw, Outcome, begin_all, joined
from emb_train.structured.adaptive_shield import Belief, Shield, believed_law, contains, make_belief, narrowest
from emb_train.structured.estimator import ANGLE, MISFIT, VELOCITY, WORST, Model, make_model, start
from emb_train.structured.law import Loop, act
from emb_train.structured.learning import Learning, begin, holds, listen, make_learning, miss

CHUNK = 64
"""Experiments that a thread plays at a time."""


@dataclass(frozen=True, eq=False)
class ReportedOutcome(Outcome):
    """Final results of N experiments and of their estimators."""

    estimates: Floats
    """State of the estimator at the end, shape [N, STATE]."""
    mistaken: Bools
    """Mask of the experiments in which the truth was at some time outside what the shield believed, shape [N]."""


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
    ) -> None:
        """Begin the experiments.

        Args:
            bench: limits, noise, timing, shield.
            ranges: where the brakes lie, which the estimator knows.
            parameters: whose information counts.
            draws: brakes and noise.
            plant: which of the bench's plants.
            conditions: which information is collected, and for which brakes the shield holds the limits.
            shield: for all of them at any time, or for what the running estimate or a currency leaves of them. Where
                there is none up to the limit of the angle, it is made for a smaller one.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits.
            UsageError: see :class:`emb_train.envs.batch.Batch`, :func:`emb_train.structured.estimator.make_model` and
                :func:`emb_train.structured.adaptive_shield.make_belief`.
        """
        nearer, law = narrowest(conditions.applied(bench))
        super().__init__(nearer, ranges, parameters, len(draws), compiled, plant, conditions)
        self.bench = conditions.applied(bench)
        self.setup = make_setup(self.bench, law, self._plant, parameters, conditions.kind, conditions.shielded)
        self.belief = make_belief(self.bench, shield, self._plant, conditions.randomised)
        self.learning = make_learning(nearer, shield, self._plant, conditions.randomised)
        self.model = make_model(bench, ranges, plant)
        begin_all(self, draws)

    def play(self, loop: Loop, tables: Floats, laws: Sequence[ShieldLaw] | None = None) -> list[ReportedOutcome]:
        """Play every reference on all the brakes.

        Args:
            loop: how they are followed.
            tables: of the references, see :func:`emb_train.structured.law.reference`, shape [C, 2 n − 1, TERMS].
            laws: a shield for each of the brakes in place of the one for all of them.
        """
        count = len(self.k)
        rows = [(slice(i, i + CHUNK), self.setup) for i in range(0, count, CHUNK)]
        if laws is not None:
            rows = [(slice(i, i + 1), with_law(self.setup, law)) for i, law in enumerate(laws)]
        pieces = [(table, *row) for table in np.ascontiguousarray(tables, np.float64) for row in rows]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = list(pool.map(lambda piece: self._play(loop, *piece), pieces))
        return [joined(parts[i : i + len(rows)]) for i in range(0, len(parts), len(rows))]

    def _play(self, loop: Loop, table: Floats, part: slice, setup: Setup) -> ReportedOutcome:
        experiments = Experiments._make(array[part].copy() for array in self.experiments)
        x, count, shield = experiments.x, len(experiments.k), self.bench.shield
        m, left, mistaken = np.zeros_like(experiments.m), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        states = np.tile(start(self.model), (count, 1))
        learnt = np.tile(begin(self.learning), (count, 1))
        play = compiled(play_trials)
        play(setup, experiments, self.model, self.belief, self.learning, loop, table, states, learnt, m, left, mistaken)
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        return ReportedOutcome(unpack(m, len(self.parameters)), left, home, x[:, 0], x[:, 1], states, mistaken)


def play_trials(
    setup: Setup,
    experiments: Experiments,
    model: Model,
    belief: Belief,
    learning: Learning,
    loop: Loop,
    table: Floats,
    states: Floats,
    learnt: Floats,
    informed: Floats,
    left: Bools,
    mistaken: Bools,
) -> None:
    """N experiments from their first sample to their end, or to where they leave the limits, in place.

    Args:
        setup: what they have in common; where the shield follows the estimate, its law is for a model that does not
            fit.
        experiments: at their start.
        model: of the estimator.
        belief: prior knowledge of the shield beside the law, where it follows the estimate.
        learning: the same where it learns.
        loop: how the reference is followed.
        table: of the reference.
        states: of the estimators, shape [N, STATE].
        learnt: states of what the shields have learnt, one per row.
        informed: becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2].
        left: becomes whether they were, shape [N].
        mistaken: becomes whether the truth was ever not among what was believed, shape [N].
    """
    brakes, x, y, k = experiments.brakes, experiments.x, experiments.y, experiments.k
    for i in range(k.shape[0]):
        state, now, wanted = states[i], setup, 0.0
        for _ in range(setup.rules.horizon):
            if not experiments.lost[i, k[i]]:  # else the law is not called
                wanted = act(model, loop, table, state, y[i, 0], y[i, 1], float(k[i]), experiments.applied[i])
                now = setup
                if belief.running and state[WORST] <= MISFIT:
                    now = with_law(setup, believed_law(belief, state))
                    mistaken[i] = mistaken[i] or not contains(belief, state, brakes[i], x[i, 0], x[i, 1])
                    y[i, 0], y[i, 1] = state[ANGLE], state[VELOCITY]  # what the shield has for the measurement
                if learning.currency:
                    listen(learning, learnt[i], y[i, 0], y[i, 1], experiments.applied[i])
                    possible = known(learning.assumptions, learnt[i])
                    mistaken[i] = mistaken[i] or not holds(learning.nominal, possible, brakes[i], x[i, 0], x[i, 1])
                    if not possible.falsified:
                        now = with_law(setup, law_for(learning.setting, learning.nominal, possible))
                        y[i, 0], y[i, 1] = middle(possible)
            elif learning.currency:
                miss(learning, learnt[i])
            advance_one(now, experiments, i, wanted)
            if experiments.violated[i]:
                left[i] = True
                break
            informed[i] = experiments.m[i]
