"""Tasks of a reference, and whole compiled experiments in which it is tried: estimator, speed loop, shield, brake.

The step is :func:`emb_train.closed_loop.advance_one`, so that what is learned here is what the environment plays.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EULER
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, Ranges
from emb_runtime.errors import UsageError
from emb_runtime.estimator.kalman import MISFIT, Four, Model, State, believed, deviations, follow, make_model, start
from emb_runtime.estimator.speed_loop import Scale, share_after
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Bools, Conditions, Experiments, Setup, advance_one
from emb_train.play import MEASURES, Draw, Measure, Outcome, begin_all, fresh_draws, joined
from emb_train.reference import FEATURES, PRODUCTS, Box, Form, Stored, box_of, features, wanted_current

CHUNK = 64  # Experiments that a thread plays at a time
ANY_PRECISION: Four = (math.inf, math.inf, math.inf, math.inf)
"""Relative deviations of k_m, k_1, T_c and f_v at which an experiment is over: none."""


@dataclass(frozen=True, eq=False)
class ReportedOutcome(Outcome):
    """Final results of N experiments and of their estimators."""

    known: Floats
    """Time until the estimates had the precision asked for [s], shape [N]. Where they had not at the end: more than the
    experiment's duration, by as much as the logarithm of what was missing says."""
    used: Floats
    """Features with which each level and each switch of the reference was used, on average, 0 where it was not, shape
    [N, 2 n − 1, TERMS]."""


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
            precision: relative deviations of k_m, k_1, T_c and f_v; an experiment ends once its estimates have them.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits.
            UsageError: J or γ vary in these ranges; see :class:`emb_train.closed_loop.Batch`.
        """
        super().__init__(bench, ranges, parameters, len(draws), plant, conditions)
        for name in ("J", "gamma"):
            if getattr(ranges.low, name) < getattr(ranges.high, name):
                raise UsageError(f"the estimator takes {name} as known, the set of ranges '{ranges.name}' varies it")
        self.model = make_model(bench, ranges, sticks=self._plant.mechanics.solver != EULER)
        self.box = box_of(bench, ranges)
        self.precision = precision
        begin_all(self, draws)

    def play(self, scale: Scale, tables: Sequence[Floats]) -> list[ReportedOutcome]:
        """Play every reference on all the brakes.

        Args:
            scale: of the references.
            tables: of the references, see :func:`emb_train.reference.set_reference`, each of shape [2 n − 1, TERMS] or,
                with one for each brake, [N, 2 n − 1, TERMS].
        """
        parts = [slice(i, i + CHUNK) for i in range(0, len(self.k), CHUNK)]
        each = [np.broadcast_to(table, (len(self.k), *table.shape[-2:])) for table in tables]
        pieces = [(table[part], part) for table in each for part in parts]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            found = list(pool.map(lambda piece: self._play(scale, *piece), pieces))
        return [joined(found[i : i + len(parts)]) for i in range(0, len(found), len(parts))]

    def _play(self, scale: Scale, tables: Floats, part: slice) -> ReportedOutcome:
        experiments = Experiments._make(array[part].copy() for array in self.experiments)
        x, count, shield = experiments.x, len(experiments.k), self.bench.shield
        m, left, reached = np.zeros_like(experiments.m), np.zeros(count, np.bool_), np.zeros(count)
        tables = np.ascontiguousarray(tables)
        used, fixed = np.zeros_like(tables), (self.setup, self.model, scale, self.box, self.precision)
        acted = np.zeros((count, self.setup.rules.horizon))
        compiled(play_trials)(*fixed, experiments, tables, m, left, reached, acted, used)
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        matrices = unpack(m, len(self.parameters))
        return ReportedOutcome(matrices, left, home, acted, reached, used)


def play_trials(
    setup: Setup,
    model: Model,
    scale: Scale,
    box: Box,
    precision: Four,  # At which an experiment ends
    experiments: Experiments,
    tables: Floats,  # Of the references, shape [N, 2 n − 1, TERMS]
    informed: Floats,  # Becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2]
    left: Bools,  # Becomes whether they were, shape [N]
    reached: Floats,  # Becomes the time until the precision was reached [s], shape [N]
    acted: Floats,  # Becomes the currents that acted, 0 after the end [A], shape [N, horizon]
    used: Floats,  # Becomes the mean features of each row of the table
) -> None:
    """N experiments from their first sample to their end, to the precision or out of the limits, in place."""
    k, duration = experiments.k, setup.rules.sample_time * setup.rules.horizon
    weights, reference = np.zeros(used.shape[1]), np.zeros(tables.shape[1])
    for i in range(k.shape[0]):
        weights[:] = 0.0
        state = start(model)
        missing = math.inf
        for _ in range(setup.rules.horizon):
            y, u = experiments.y, experiments.applied[i]
            state = follow(model, state, y[i, 0], y[i, 1], float(k[i]), u)
            wanted = wanted_current(model, state, scale, box, tables[i], reference)
            note_use(scale, features(box, believed(model, state)), reference, state.step, used[i], weights)
            before, missing = missing, lacking(model, state, precision)
            if missing <= 1.0:
                reached[i] = reached_at(setup.rules.sample_time, k[i], before, missing)
                break
            advance_one(setup, experiments, i, wanted)
            if experiments.violated[i]:
                left[i] = True
                break
            informed[i] = experiments.m[i]
            acted[i, k[i] - 1] = experiments.applied[i]
        if not missing <= 1.0:
            reached[i] = duration * (1.0 + math.log(missing))
        average(used[i], weights)


def reached_at(sample_time: float, step: int, before: float, missing: float) -> float:
    """Time at which what is missing came to 1, between the sample before and this one, so that it is continuous [s]."""
    if 0.0 < missing <= 1.0 < before < math.inf:
        return sample_time * (step - math.log(missing) / (math.log(missing) - math.log(before)))
    return sample_time * step


def lacking(model: Model, state: State, precision: Four) -> float:
    """Greatest ratio of a relative deviation to the one asked for; infinite if none is, or the model does not fit."""
    if state.worst > MISFIT or min(precision) == math.inf:
        return math.inf
    missing, values, known = 0.0, believed(model, state), deviations(model, state)
    for i in range(FEATURES):
        missing = max(missing, known[i] / (precision[i] * values[i]))
    return missing


def note_use(scale: Scale, f: Four, reference: Any, step: float, used: Any, weights: Any) -> None:
    """Add the features with which each level is used now, by its share of the period, and each switch that begins."""
    levels, before = (len(reference) + 1) // 2, 1.0
    for i in range(levels):
        after = min(before, share_after(reference[levels + i], step, scale.horizon)) if i < levels - 1 else 0.0
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


@dataclass(frozen=True)
class Task:
    """One task, as it is tuned for and as it is evaluated."""

    name: str  # One of :data:`emb_train.presets.TASKS`, which says what it is
    parameters: tuple[str, ...]  # Parameters whose information counts
    ranges: str  # Set of the bench that the brakes are drawn from
    shield_ranges: str  # Set of the bench that the shield covers; it contains ``ranges``
    criterion: str  # Name of a measure, see :data:`emb_train.play.MEASURES`
    form: Form = "quadratic"  # Of a reference that is learned for it, if nobody asks for another
    steps: int = 400  # Of that search
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    command_delay: tuple[int, int] = (0, 0)  # Least and most samples that a command waits, drawn for each experiment
    precision: Four = ANY_PRECISION
    """Relative deviations of k_m, k_1, T_c and f_v: where these are asked for, the time until they are reached counts,
    and nothing else."""
    begin: tuple[float, ...] = (1.0, -1.0, -0.007, 0.3, 0.61)
    """Blind reference that learning begins with: levels, then switches, found by CMA-ES from many places."""

    @classmethod
    def of(cls, kept: Stored) -> Task:
        """The task that a reference was tuned for."""
        return replace(TASKS[kept.task], plant=kept.plant, command_delay=kept.command_delay)

    @property
    def measure(self) -> Measure:
        """Measure of an experiment."""
        return MEASURES[self.criterion]

    @property
    def conditions(self) -> Conditions:
        """Conditions in which it is trained and played."""
        return Conditions(
            shield_ranges=self.shield_ranges, information=self.measure.kind, command_delay=self.command_delay
        )

    def draws(self, bench: Bench, seed: int, count: int) -> list[Draw]:
        """Brakes and noise."""
        return fresh_draws(bench.range_set(self.ranges), seed, count)

    def trials(self, bench: Bench, draws: list[Draw]) -> Trials:
        """Experiments with these brakes behind the shield.

        Raises:
            BenchFileError: the shield cannot guarantee the limits for its set, or the bench lacks a set or the plant.
            UsageError: the shield does not cover the brakes.
        """
        ranges = bench.range_set(self.ranges)
        return Trials(bench, ranges, self.parameters, draws, self.plant, self.conditions, self.precision)

    def score(self, outcome: Outcome) -> Floats:
        """The criterion of each experiment, or minus its time until the precision, shape [N]; higher is better."""
        if isinstance(outcome, ReportedOutcome) and self.precision != ANY_PRECISION:
            return -outcome.known
        return self.measure.values(outcome.matrices)


_FOUR = Task(name="four-d", parameters=PARAMETER_NAMES, ranges="pm50", shield_ranges="envelope", criterion="D")
_CREEP_FIRST = (-0.2, -0.007, 1.0, -1.0, 0.005, 0.94, -0.23, 0.02, 0.21, 0.42, 0.71, 0.96, 0.965)
"""A probe, then k_1 and f_v by a creep, two full strokes, and what is left of the time."""
TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        Task(
            name="viscous",
            parameters=("f_v",),
            ranges="viscous",
            shield_ranges="viscous",
            criterion="weighted",
            begin=(1.0, -1.0, -0.006, 0.375, 0.9),
        ),
        Task(
            name="viscous-stiffness",
            parameters=("k_1", "f_v"),
            ranges="viscous-stiffness",
            shield_ranges="viscous-stiffness",
            criterion="weighted",
            begin=(1.0, -1.0, -0.007, 0.336, 0.92),
        ),
        _FOUR,
        replace(_FOUR, name="four-t", criterion="T", form="blind", steps=80),
        replace(_FOUR, name="four-e", criterion="E", begin=_CREEP_FIRST),
        replace(_FOUR, name="four-a", criterion="A", begin=_CREEP_FIRST),
        replace(
            _FOUR,
            name="four-time",
            precision=(0.0065, 0.0065, 0.0065, 0.0065),
            begin=(-0.2, 1.0, -1.0, 0.032, 0.3),
        ),
    )
}
"""By name."""
