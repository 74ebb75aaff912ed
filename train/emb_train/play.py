"""Excitations played on given brakes with given noise, and measures of the information that they collect.

The shield has the last word over every excitation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench import excitation as reference
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.criteria import Criterion
from emb_bench.information.fisher import Kind
from emb_bench.information.symmetric import Floats, unpack
from emb_bench.numbers import LEVEL, Score
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.control.actor import Actor
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.speed_loop import current_for
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Bools, Conditions
from emb_train.intervals import finite, intervals
from emb_train.rewards import PRIOR

ANGLE, VELOCITY, STEP, APPLIED = range(4)
"""Columns of the observation: angle [rad], velocity [rad/s], step, current that acted in the period before [A]."""

Seen = NDArray[np.float32]
Currents = NDArray[np.float64]


Excitation = Callable[[Seen], Currents]
"""Requested currents [A], shape [N], for observations of N experiments side by side, shape [N, 4]."""


def of_law(law: reference.Law) -> Excitation:
    """A reference excitation, which answers one measurement at a time."""
    return lambda seen: np.array([law(angle, velocity, int(step)) for angle, velocity, step, _ in seen.tolist()])


def of_actor(actor: Actor, bench: Bench) -> Excitation:
    """Currents of an actor as the runtime asks it: one sample of one experiment at a time, with an estimator for each.

    The estimators are those of the bench, and begin anew in step 0.
    """
    estimators: list[Estimator] = []

    def excitation(seen: Seen) -> Currents:
        if seen[0, STEP] == 0.0:
            estimators[:] = [Estimator(bench) for _ in seen]
        requested: Currents = np.zeros(len(seen))
        for i, (estimator, row) in enumerate(zip(estimators, seen.tolist(), strict=True)):
            angle, velocity, step, applied = row
            estimator.add_sample(angle, velocity, step, applied)
            requested[i] = actor.act(angle, velocity, step, estimator)
        return requested

    return excitation


class Planned:
    """A plan of speeds as an actor, followed as the runtime follows the speeds of a policy."""

    def __init__(self, speeds: Sequence[float], bench: Bench, gain: float = BENCH_CONDITIONS.gain) -> None:
        """Follow a plan, parts of the limit of the speed, one for each step, with this gain of the speed loop."""
        self._speeds, self._gain = [bench.limits.velocity * part for part in speeds], gain

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """See :class:`emb_runtime.control.actor.Actor`."""
        speed = self._speeds[min(int(step), len(self._speeds) - 1)]
        return current_for(estimator.model, estimator.state, estimator.relative, speed, self._gain)


STREAM = 0x65766C
"""Spawn key of the evaluation's random numbers: training has none, and its validations have another one."""


class Draw(NamedTuple):
    """One brake and the noise that is measured on it."""

    seed: int | np.random.SeedSequence  # Of the noise
    brake: BrakeParameters


def fresh_draws(ranges: Ranges, seed: int, count: int) -> list[Draw]:
    """Brakes drawn from ranges, and their noise; draw i depends on ``seed`` and i alone."""
    seeds = [np.random.SeedSequence(seed, spawn_key=(STREAM, i)) for i in range(count)]
    return [
        Draw(s, BrakeParameters(*np.random.default_rng(s).uniform(ranges.low, ranges.high).tolist())) for s in seeds
    ]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Final results of N experiments. One that leaves the limits is stopped there, as on the bench."""

    matrices: Floats
    """Fisher information without a prior, relative to the true parameters, shape [N, n, n]. Of an experiment that
    violated the limits: that before."""
    violated: Bools  # Mask of the experiments that violated the limits, shape [N]
    home: Bools  # Mask of the experiments that ended at home without a violation, shape [N]
    currents: Floats  # Currents that acted in each period, 0 after an early end [A], shape [N, horizon]


def play(
    bench: Bench,
    ranges: Ranges,
    parameters: Sequence[str],
    excitation: Excitation,
    draws: Sequence[Draw],
    plant: str = DEFAULT_PLANT,
    conditions: Conditions = BENCH_CONDITIONS,
) -> Outcome:
    """Play one excitation, through the shield unless the conditions have none.

    Raises:
        PolicyRefusedError: the excitation requests no finite current, where the runtime stops.
        UsageError, BenchFileError: see :class:`emb_train.closed_loop.Batch`.
    """
    batch = Batch(bench, ranges, parameters, len(draws), plant, conditions)
    begin_all(batch, draws)
    e, violated, steps_inside = batch.experiments, np.zeros(len(draws), np.bool_), np.zeros(len(draws), np.int64)
    steps = np.arange(batch.bench.timing.horizon)
    for k in steps:
        requested = excitation(batch.seen())
        if not np.isfinite(requested[~violated]).all():
            raise PolicyRefusedError(f"its current is not finite at step {k}: it cannot be played")
        batch.advance(requested)
        violated |= batch.experiments.violated
        steps_inside += ~violated
    matrices = unpack(e.m[np.arange(len(draws)), steps_inside], len(parameters))
    currents = np.where(steps < steps_inside[:, None], e.applied[:, 1:], 0.0)
    return Outcome(matrices, violated, batch.home & ~violated, currents)


def begin_all(batch: Batch, draws: Sequence[Draw]) -> None:
    """Begin the experiments of a batch, one for each draw."""
    for i, draw in enumerate(draws):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)


def bounds(ranges: Ranges) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of each parameter."""
    return {name: (getattr(ranges.low, name), getattr(ranges.high, name)) for name in PARAMETER_NAMES}


def middle_of(ranges: Ranges) -> BrakeParameters:
    """The brake in the middle of the ranges."""
    return BrakeParameters(*(0.5 * (a + b) for a, b in zip(ranges.low, ranges.high, strict=True)))


@dataclass(frozen=True)
class Measure:
    """A number for a Fisher information matrix; more is better."""

    name: str  # Name on the command line
    label: str  # Formula or description of the number, for people
    goal: Criterion | IntervalCriterion  # Criterion that a design optimises; its φ is a logarithm
    kind: Kind  # Of Fisher information
    prior: float  # Added to the diagonal
    against: Literal["difference", "log-ratio", "ratio"]
    """Comparison of a value with the optimum: by a difference in nat, by the ratio of which both are logarithms, or
    by their ratio."""

    def values(self, matrices: Floats) -> Floats:
        """Of matrices without a prior, shape [N, n, n] to [N]; not of an interval."""
        size, goal = matrices.shape[-1], self.goal
        assert isinstance(goal, Criterion)
        phi = goal.phi(matrices + self.prior * np.eye(size))
        return phi if self.against != "ratio" else np.exp(phi)

    def of_outcomes(
        self,
        bench: Bench,
        plant: str,
        parameters: Sequence[str],
        brakes: Sequence[BrakeParameters],
        outcomes: Sequence[Outcome],
        pool: Executor | None = None,
    ) -> list[Floats]:
        """Of several outcomes of experiments with the same N brakes, each of shape [N]; a ``pool`` has processes."""
        goal = self.goal
        if isinstance(goal, Criterion):
            return [self.values(outcome.matrices) for outcome in outcomes]
        currents = np.concatenate([outcome.currents for outcome in outcomes])
        found = intervals(bench, plant, parameters, [*brakes] * len(outcomes), currents, pool)
        return np.split(finite([goal.of(one) for one in found]), len(outcomes))

    def shares(self, values: Floats, optima: Floats) -> Floats:
        """Of the optimum, for each draw: the difference in nat (0 at the optimum) for D, else the share (1 there)."""
        if self.against == "difference":
            return values - optima
        if self.against == "log-ratio":
            return np.asarray(np.exp(values - optima))
        return values / optima


_T, _I = IntervalCriterion("T"), IntervalCriterion("I")
MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        m.name: m
        for m in (
            Measure("T", "T (sum of -2 ln of the between-run interval)", _T, "physical", 0.0, "difference"),
            Measure("I", "I (sum of -2 ln of the repeatability)", _I, "physical", 0.0, "difference"),
            Measure("D", "ln det(M + 12 I)", Criterion("D"), "physical", PRIOR, "difference"),
            Measure("A", "-ln tr (M + 12 I)^-1", Criterion("A"), "physical", PRIOR, "log-ratio"),
            Measure("E", "ln lambda_min(M + 12 I)", Criterion("E"), "physical", PRIOR, "log-ratio"),
            Measure("weighted", "lambda_min of the thesis's weighted M", Criterion("E"), "weighted", 0.0, "ratio"),
        )
    }
)
"""By name. ``weighted`` is, for one parameter, the thesis's weighted information itself."""


def mean_score(values: Floats) -> Score:
    """Mean of independent values with Student's 95 % interval for it; one value has no interval (NaN)."""
    from scipy.stats import t as student  # takes a second to import

    centre, count = float(np.mean(values)), len(values)
    if count < 2:
        return Score(centre, math.nan, math.nan)
    half = float(student.ppf(0.5 + 0.5 * LEVEL, count - 1) * np.std(values, ddof=1) / math.sqrt(count))
    return Score(centre, centre - half, centre + half)
