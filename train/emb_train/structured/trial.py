"""Whole experiments under a structured excitation, compiled: estimator, reference, loop, shield, brake, information.

The step is :func:`emb_train.envs.steps.advance`, so that what is tuned here is what the environment plays.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.packed import Floats, unpack
from emb_bench.sim.plant_spec import DEFAULT_PLANT
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.config.plants import Instruments, Mechanics
from emb_runtime.safety.shield_design import ShieldLaw
from emb_train.envs.conditions import BENCH_CONDITIONS, Conditions
from emb_train.envs.episodes import Batch
from emb_train.envs.play import Draw, Outcome
from emb_train.envs.randomisation import Bools
from emb_train.envs.steps import Integers, Rows, Rules, advance, only, rules_of
from emb_train.structured.adaptive_shield import Belief, Shield, believed_law, contains, make_belief, narrowest
from emb_train.structured.estimator import ANGLE, MISFIT, VELOCITY, WORST, Model, make_model, start
from emb_train.structured.law import Loop, act

CHUNK = 64
"""Experiments that a thread plays at a time."""


@dataclass(frozen=True, eq=False)
class Told(Outcome):
    """What N experiments ended with, and what their estimators say."""

    estimates: Floats
    """State of the estimator at the end, shape [N, STATE]."""
    mistaken: Bools
    """In which the truth was not among what the shield believed, at some time, shape [N]."""


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
            ranges: where the brakes lie, and what the estimator knows.
            parameters: whose information counts.
            draws: brakes and noise.
            plant: which of the bench's plants.
            conditions: which information is collected, and for which brakes the shield holds the limits.
            shield: for all of them at any time, or for what the running estimate leaves of them. Where there is none
                up to the limit of the angle, it is made for a smaller one.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits.
            UsageError: see :class:`emb_train.envs.episodes.Batch`, :func:`emb_train.structured.estimator.make_model`
            and
                :func:`emb_train.structured.adaptive_shield.make_belief`.
        """
        nearer, law = narrowest(conditions.applied(bench))
        super().__init__(nearer, ranges, parameters, len(draws), compiled, plant, conditions)
        self.bench = conditions.applied(bench)
        self.rules = rules_of(self.bench, conditions.kind, conditions.shielded)
        self._law = law
        self.belief = make_belief(self.bench, shield, self._plant, conditions.randomised)
        self.model = make_model(bench, ranges, plant)
        for i, draw in enumerate(draws):
            self.begin(i, np.random.default_rng(draw.seed), draw.brake)

    def play(self, loop: Loop, tables: Floats, laws: Sequence[ShieldLaw] | None = None) -> list[Told]:
        """Play every reference on all the brakes.

        Args:
            loop: how they are followed.
            tables: of the references, see :func:`emb_train.structured.law.reference`, shape [C, 2 n − 1, TERMS].
            laws: a shield for each of the brakes in place of the one for all of them.
        """
        if laws is None:
            rows = [(slice(i, i + CHUNK), self._law) for i in range(0, len(self.k), CHUNK)]
        else:
            rows = [(slice(i, i + 1), law) for i, law in enumerate(laws)]
        pieces = [(table, *row) for table in np.ascontiguousarray(tables, np.float64) for row in rows]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = list(pool.map(lambda piece: self._play(loop, *piece), pieces))
        return [_joined(parts[i : i + len(rows)]) for i in range(0, len(parts), len(rows))]

    def _play(self, loop: Loop, table: Floats, part: slice, law: ShieldLaw) -> Told:
        rows = Rows._make(array[part].copy() for array in self.rows)
        count = len(rows.k)
        m, left, mistaken = np.zeros_like(rows.m), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        states = np.tile(start(self.model), (count, 1))
        compiled(play)(
            law,
            self.rules,
            self._plant.mechanics,
            self._plant.instruments,
            self._chosen,
            rows,
            self.model,
            self.belief,
            loop,
            table,
            states,
            m,
            left,
            mistaken,
        )
        x, shield = rows.x, self.bench.shield
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        return Told(unpack(m, len(self.parameters)), left, home, x[:, 0], x[:, 1], states, mistaken)


def _joined(parts: Sequence[Told]) -> Told:
    return Told(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Told)))


def play(
    law: ShieldLaw,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    rows: Rows,
    model: Model,
    belief: Belief,
    loop: Loop,
    table: Floats,
    states: Floats,
    told: Floats,
    left: Bools,
    mistaken: Bools,
) -> None:
    """N experiments from their first sample to their end, or to where they leave the limits, in place.

    Args:
        law: this and what follows, up to ``rows``, as in :func:`emb_train.envs.steps.advance`.
        rules: the experiment's.
        mechanics: how the brakes move.
        instruments: what lies between them and the bus.
        chosen: indices of the n parameters.
        rows: the experiments, at their start.
        model: of the estimator.
        belief: what the shield knows beside the law; where it listens to the estimate, ``law`` is for a model that does
            not fit.
        loop: how the reference is followed.
        table: of the reference.
        states: of the estimators, shape [N, STATE].
        told: becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2].
        left: becomes whether they were, shape [N].
        mistaken: becomes whether the truth was ever not among what was believed, shape [N].
    """
    wanted = np.zeros(1)
    for i in range(rows.k.shape[0]):
        row, state, now = only(rows, i), states[i], law
        for _ in range(rules.horizon):
            if not row.lost[0, row.k[0]]:  # else nobody is asked
                y1, y2, step = row.y[0, 0], row.y[0, 1], float(row.k[0])
                wanted[0] = act(model, loop, table, state, y1, y2, step, row.applied[0])
                now = law
                if belief.running and state[WORST] <= MISFIT:
                    now = believed_law(belief, state)
                    mistaken[i] = mistaken[i] or not contains(belief, state, row.brakes[0], row.x[0, 0], row.x[0, 1])
                    row.y[0, 0], row.y[0, 1] = state[ANGLE], state[VELOCITY]  # what the shield has for the measurement
            advance(now, rules, mechanics, instruments, chosen, row, wanted)
            if row.violated[0]:
                left[i] = True
                break
            told[i] = row.m[0]
