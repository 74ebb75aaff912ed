"""Whole experiments under a structured excitation, compiled: estimator, reference, loop, shield, brake, information.

The step is :func:`emb_train.episodes.advance`, so that what is tuned here is what the environment plays.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.packed import Floats, unpack
from emb_bench.plant import DEFAULT_PLANT
from emb_runtime.bench import Bench, Ranges
from emb_runtime.envelope import ShieldLaw
from emb_runtime.plants import Instruments, Mechanics
from emb_runtime.shield import PAST
from emb_train.conditions import BENCH_CONDITIONS, Conditions
from emb_train.episodes import Batch, Bools, Integers, Rules, advance
from emb_train.evaluation.play import Draw, Outcome
from emb_train.structured.estimator import Model, make_model, start
from emb_train.structured.law import Loop, act

CHUNK = 64
"""Experiments that a thread plays at a time."""


@dataclass(frozen=True, eq=False)
class Told(Outcome):
    """What N experiments ended with, and what their estimators say."""

    estimates: Floats
    """State of the estimator at the end, shape [N, STATE]."""


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
    ) -> None:
        """Begin the experiments.

        Args:
            bench: limits, noise, timing, shield.
            ranges: where the brakes lie, and what the estimator knows.
            parameters: whose information counts.
            draws: brakes and noise.
            plant: which of the bench's plants.
            conditions: which information is collected, and for which brakes the shield holds the limits.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits.
            UsageError: see :class:`emb_train.episodes.Batch` and :func:`emb_train.structured.estimator.make_model`.
        """
        super().__init__(bench, ranges, parameters, len(draws), compiled, plant, conditions)
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
        x = self.x[part].copy()
        count = len(x)
        m, left = np.zeros((count, self.m.shape[1])), np.zeros(count, np.bool_)
        states = np.tile(start(self.model), (count, 1))
        compiled(play)(
            law,
            self.rules,
            self._plant.mechanics,
            self._plant.instruments,
            self._chosen,
            self.brakes[part],
            x,
            self._s[part].copy(),
            self._memory[part].copy(),
            self.y[part].copy(),
            self._noise[part],
            self._late[part],
            self.model,
            loop,
            table,
            states,
            m,
            left,
        )
        shield = self.bench.shield
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        return Told(unpack(m, len(self.parameters)), left, home, x[:, 0], x[:, 1], states)


def _joined(parts: Sequence[Told]) -> Told:
    return Told(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Told)))


def play(
    law: ShieldLaw,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    brakes: Floats,
    x: Floats,
    s: Floats,
    memory: Floats,
    y: Floats,
    noise: Floats,
    late: Floats,
    model: Model,
    loop: Loop,
    table: Floats,
    states: Floats,
    told: Floats,
    left: Bools,
) -> None:
    """N experiments from their first sample to their end, in place.

    Args:
        law: this and what follows, up to ``late``, as in :func:`emb_train.episodes.advance` at the start of an episode.
        rules: the experiment's.
        mechanics: how the brakes move.
        instruments: what lies between them and the bus.
        chosen: indices of the n parameters.
        brakes: shape [N, 6].
        x: true states.
        s: sensitivities.
        memory: of the instruments.
        y: measured angle and velocity.
        noise: of all samples.
        late: how much too late they are taken.
        model: of the estimator.
        loop: how the reference is followed.
        table: of the reference.
        states: of the estimators, shape [N, STATE].
        told: becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2].
        left: becomes whether they were, shape [N].
    """
    count = x.shape[0]
    past, k, m = np.zeros((count, PAST)), np.zeros(count, np.int64), np.zeros(told.shape)
    wanted, reasons, outside = np.zeros(count), np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for _ in range(rules.horizon):
        for i in range(count):
            # x[i, 3] is the current of the period before: what the node reports.
            wanted[i] = act(model, loop, table, states[i], y[i, 0], y[i, 1], float(k[i]), x[i, 3])
        advance(
            law,
            rules,
            mechanics,
            instruments,
            chosen,
            brakes,
            x,
            s,
            m,
            memory,
            y,
            past,
            k,
            noise,
            late,
            wanted,
            reasons,
            outside,
        )
        for i in range(count):
            left[i] = left[i] or outside[i]
            if not left[i]:
                for j in range(told.shape[1]):
                    told[i, j] = m[i, j]
