"""Tasks of a reference, and whole compiled experiments in which it is tried: estimator, speed loop, shield, brake.

The step is :func:`emb_train.closed_loop.advance_one`, so that what is learned here is what the environment plays. The
shield covers the whole set of brakes, or is the runtime's learning shield.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EULER, Plant
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, LearntModel, Ranges
from emb_runtime.errors import UsageError
from emb_runtime.estimator.kalman import MISFIT, Four, Model, State, believed, deviations, follow, make_model, start
from emb_runtime.estimator.speed_loop import Scale, share_after
from emb_runtime.learning.assumptions import Assumptions, assumptions_of, make_assumptions
from emb_runtime.learning.bounded import hear, lose
from emb_runtime.learning.bounded import start as start_learning
from emb_runtime.learning.known import Known, known
from emb_runtime.learning.law import law_for, middle
from emb_runtime.safety.shield_design import DesignInputs, design_inputs
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Bools, Conditions, Experiments, Setup, advance_one, with_law
from emb_train.play import MEASURES, Draw, Measure, Outcome, begin_all, fresh_draws, joined
from emb_train.reference import FEATURES, PRODUCTS, Box, Shield, Stored, box_of, features, wanted_current


class Learning(NamedTuple):
    """Prior knowledge of a learning shield; numbers only."""

    learns: bool
    inputs: DesignInputs  # Of the bench
    nominal: BrakeParameters  # Brake that the parameters are relative to
    assumptions: Assumptions


def make_learning(bench: Bench, shield: Shield, plant: Plant, delay: int) -> Learning:
    """Prior knowledge of the shield, which takes the brakes for what they are: Euler's, or ones that stick.

    Raises:
        BenchFileError: an assumption does not hold on this bench.
        UsageError: one does not hold for the brakes.
    """
    learns = shield == "bounded"
    if learns and not can_learn(bench, plant, delay):
        raise UsageError(
            "a shield that learns needs fresh frames, no lag, an encoder without an offset, a velocity that is "
            "measured and the braking envelope"
        )
    model: LearntModel = "euler" if plant.mechanics.solver == EULER else "flow"
    declared = bench.shield._replace(learn=learns, model=model)
    bench = replace(bench, shield=declared)
    assumptions = make_assumptions(bench) if learns else assumptions_of(bench)
    return Learning(learns, design_inputs(bench), bench.brake, assumptions)


def can_learn(bench: Bench, plant: Plant, delay: int) -> bool:
    """Returns True if a shield can learn: its model has no delay, lag, offset or observer, and the drive has to brake.

    It matters whether the shield covers one, the plant has it or it is drawn.
    """
    shield, between = bench.shield, plant.instruments
    late = max(shield.frame_age[1], between.command_delay, between.measurement_delay, delay) > 0
    lagging = max(shield.current_lag, plant.mechanics.current_lag) > 0.0
    off = between.encoder_offset != 0.0
    return not (late or lagging or off or between.observer_bandwidth > 0.0 or shield.envelope == "coasting")


def begin(learning: Learning) -> Floats:
    """The state before the first sample."""
    return np.array(start_learning(learning.assumptions))


def listen(learning: Learning, state: Any, angle: float, velocity: float, applied: float) -> None:
    """Take in a sample, in place; arguments as of :func:`emb_runtime.learning.bounded.hear`."""
    hear(learning.assumptions, state, angle, velocity, applied)


def miss(learning: Learning, state: Any) -> None:
    """Go on by a period of which nothing is known, in place."""
    lose(learning.assumptions, state)


def holds(nominal: BrakeParameters, possible: Known, brake: Any, angle: float, velocity: float) -> bool:
    """Returns True if the true parameters, angle and velocity are among what is known to be possible.

    Args:
        nominal: brake that the parameters are relative to.
        possible: what is known.
        brake: true parameters, a row of :class:`emb_runtime.config.bench.BrakeParameters`, shape [6].
        angle: true [rad].
        velocity: true [rad/s].
    """
    k_m, k_1, t_c, f_v = brake[2] / nominal.k_m, brake[3] / nominal.k_1, brake[4] / nominal.T_c, brake[5] / nominal.f_v
    return bool(
        possible.k_m_low <= k_m <= possible.k_m_high
        and possible.k_1_low <= k_1 <= possible.k_1_high
        and possible.t_c_low <= t_c <= possible.t_c_high
        and possible.f_v_low <= f_v <= possible.f_v_high
        and possible.angle_low <= angle <= possible.angle_high
        and possible.velocity_low <= velocity <= possible.velocity_high
    )


CHUNK = 64  # Experiments that a thread plays at a time
ANY_PRECISION: Four = (math.inf, math.inf, math.inf, math.inf)
"""Relative deviations of k_m, k_1, T_c and f_v at which an experiment is over: none."""


@dataclass(frozen=True, eq=False)
class ReportedOutcome(Outcome):
    """Final results of N experiments and of their estimators."""

    estimates: Floats
    """Relative parameters at the end, their standard deviations, and the worst innovation, shape [N, 9]."""
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
            UsageError: J or γ vary in these ranges; see :class:`emb_train.closed_loop.Batch` and
                :func:`emb_train.trial.make_learning`.
        """
        super().__init__(bench, ranges, parameters, len(draws), plant, conditions)
        self.learning = make_learning(self.bench, shield, self._plant, conditions.command_delay[1])
        for name in ("J", "gamma"):
            if getattr(ranges.low, name) < getattr(ranges.high, name):
                raise UsageError(f"the estimator takes {name} as known, the set of ranges '{ranges.name}' varies it")
        self.model = make_model(bench, ranges, sticks=self._plant.mechanics.solver != EULER)
        self.box = box_of(bench, ranges)
        self.precision = precision
        begin_all(self, draws)

    def play(self, scale: Scale, tables: Floats) -> list[ReportedOutcome]:
        """Play every reference on all the brakes.

        Args:
            scale: of the references.
            tables: of the references, see :func:`emb_train.reference.set_reference`, shape [C, 2 n − 1, TERMS].
        """
        count = len(self.k)
        each = [np.tile(table, (count, 1, 1)) for table in np.asarray(tables, np.float64)]
        return self._all(scale, each, 0)

    def perturbed(self, scale: Scale, tables: Sequence[Floats]) -> list[ReportedOutcome]:
        """Play several times, with a reference for each brake; says with which features it was used.

        Args:
            scale: of the references.
            tables: of the references, each of shape [N, 2 n − 1, TERMS].
        """
        return self._all(scale, tables, tables[0].shape[1])

    def _all(self, scale: Scale, tables: Sequence[Floats], noted: int) -> list[ReportedOutcome]:
        parts = [slice(i, i + CHUNK) for i in range(0, len(self.k), CHUNK)]
        pieces = [(table[part], part, noted) for table in tables for part in parts]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            found = list(pool.map(lambda piece: self._play(scale, *piece), pieces))
        return [joined(found[i : i + len(parts)]) for i in range(0, len(found), len(parts))]

    def _play(self, scale: Scale, tables: Floats, part: slice, noted: int) -> ReportedOutcome:
        experiments = Experiments._make(array[part].copy() for array in self.experiments)
        x, count, shield = experiments.x, len(experiments.k), self.bench.shield
        m, left, mistaken = np.zeros_like(experiments.m), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        estimates, reached = np.zeros((count, 9)), np.zeros(count)
        learnt = np.tile(begin(self.learning), (count, 1))
        used = np.zeros((count, noted, tables.shape[2]))
        play = compiled(play_trials)
        play(
            self.setup,
            experiments,
            self.model,
            self.learning,
            scale,
            self.box,
            np.ascontiguousarray(tables),
            self.precision,
            estimates,
            learnt,
            m,
            left,
            mistaken,
            reached,
            used,
        )
        home = (np.abs(x[:, 0]) <= shield.home_angle) & (np.abs(x[:, 1]) <= shield.home_velocity) & ~left
        matrices = unpack(m, len(self.parameters))
        return ReportedOutcome(matrices, left, home, x[:, 0], x[:, 1], estimates, mistaken, reached, used)


def play_trials(
    setup: Setup,
    experiments: Experiments,
    model: Model,
    learning: Learning,
    scale: Scale,
    box: Box,
    tables: Floats,  # Of the references, shape [N, 2 n − 1, TERMS]
    precision: Four,  # At which 0 A is asked for from then on, and the estimate rests
    estimates: Floats,  # Become the estimates at the end, shape [N, 9]
    learnt: Floats,  # What the shields have learnt, one row each
    informed: Floats,  # Becomes the packed FIM, up to where the limits were left, shape [N, n (n + 1) / 2]
    left: Bools,  # Becomes whether they were, shape [N]
    mistaken: Bools,  # Becomes whether the truth was ever not among what was learnt, shape [N]
    reached: Floats,  # Becomes the time until the precision was reached [s], shape [N]
    used: Floats,  # Becomes the mean features of each row of the table; nothing is noted if it has no rows
) -> None:
    """N experiments from their first sample to their end, or to where they leave the limits, in place."""
    k, duration = experiments.k, setup.rules.sample_time * setup.rules.horizon
    weights, reference = np.zeros(used.shape[1]), np.zeros(tables.shape[1])
    for i in range(k.shape[0]):
        weights[:] = 0.0
        state = start(model)
        now, wanted, missing, over = setup, 0.0, math.inf, False
        for _ in range(setup.rules.horizon):
            if not experiments.lost[i, k[i]]:  # else the law is not called
                if not over:
                    y, u = experiments.y, experiments.applied[i]
                    state = follow(model, state, y[i, 0], y[i, 1], float(k[i]), u)
                    wanted = wanted_current(model, state, scale, box, tables[i], reference)
                    if used.shape[1] > 0:
                        note_use(scale, features(box, believed(model, state)), reference, state.step, used[i], weights)
                    before, missing = missing, lacking(model, state, precision)
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
        estimates[i, :4], estimates[i, 4:8] = believed(model, state), deviations(model, state)
        estimates[i, 8] = state.worst


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
            return with_law(setup, law_for(learning.inputs, learning.nominal, possible))
    return setup


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
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    shield: Shield = "worst case"  # For all of that set at any time, or for what has been learnt of the brake
    command_delay: tuple[int, int] = (0, 0)  # Least and most samples that a command waits, drawn for each experiment
    precision: Four = ANY_PRECISION
    """Relative deviations of k_m, k_1, T_c and f_v: where these are asked for, the time until they are reached counts,
    and nothing else."""
    begin: tuple[float, ...] = (1.0, -1.0, -0.007, 0.3, 0.61)
    """Blind reference that learning begins with: levels, then switches, found by CMA-ES from many places."""

    @classmethod
    def of(cls, kept: Stored) -> Task:
        """The task that a reference was tuned for."""
        return replace(TASKS[kept.task], plant=kept.plant, shield=kept.shield, command_delay=kept.command_delay)

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
        """Experiments with these brakes behind this task's shield.

        Raises:
            BenchFileError: the shield cannot guarantee the limits for its set, or the bench lacks a set or the plant.
            UsageError: the shield does not cover the brakes.
        """
        ranges = bench.range_set(self.ranges)
        return Trials(bench, ranges, self.parameters, draws, self.plant, self.conditions, self.shield, self.precision)

    def score(self, outcome: Outcome) -> Floats:
        """The criterion of each experiment, or minus its time until the precision, shape [N]; higher is better."""
        if isinstance(outcome, ReportedOutcome) and self.precision != ANY_PRECISION:
            return -outcome.known
        return self.measure.values(outcome.matrices)


_FOUR = Task(
    name="four-d",
    parameters=PARAMETER_NAMES,
    ranges="pm50",
    shield_ranges="envelope",
    criterion="D",
)
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
