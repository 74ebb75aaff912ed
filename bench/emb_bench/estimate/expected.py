"""Expected interval of an estimate, before there is a record: by the rules of the estimator.

The unknowns are those of ``estimate``: the parameters and the systematic errors of the bench with their priors, and the
start of the brake, whose angle at rest is a measurement. The estimate is averaged over the presence of each error
(:mod:`emb_bench.estimate.average`); the other effects of ``[systematic]`` bias it by their entries in the uncertainty
budget (:mod:`emb_bench.estimate.suspects`). The simulated brake has none of these effects: the score of an effect is
Gaussian with variance equal to its information, so the budget takes the expected square of the score.

Two criteria rate an experiment [nat], more is better. Each is a sum of −2 ln of the parameters' relative deviations: I
of the repeatability, T of the interval between runs, which is wider by all effects but those common to all runs on one
bench.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.average import average
from emb_bench.estimate.effects import Simulation, lacked_sensitivities, regressors, with_systematic
from emb_bench.estimate.estimate import OF_THE_BENCH
from emb_bench.estimate.intervals import largest, unnoticed
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import Contribution, EstimationProblem
from emb_bench.estimate.suspects import basis_and_inverse, budget_of, lacking
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.from_log import REST_SAMPLES
from emb_bench.experiment.simulate import NO_ERRORS, SystematicErrors
from emb_bench.information.evaluation import Evaluation, Information, Question
from emb_bench.information.identifiability import Spectrum
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError

NUMBERS = ("T", "I")


@dataclass(frozen=True, eq=False)
class Interval:
    """Standard deviations of estimates, relative or in the unknowns' units."""

    names: tuple[str, ...]
    count: int  # Number of parameters of interest, which come first
    covariance: Floats  # Of the noise alone, averaged over systematic errors, shape (p, p)
    budget: tuple[Contribution, ...]  # Root mean square biases by unmodelled effects

    @cached_property
    def repeatability(self) -> Floats:
        """Deviations by the noise alone, inf if not identified."""
        deviations: Floats = np.sqrt(np.diag(self.covariance))
        return deviations

    @cached_property
    def between_runs(self) -> Floats:
        """Deviations of values that are compared, without errors that all runs on one bench share."""
        return self._with(OF_THE_BENCH)

    @cached_property
    def total(self) -> Floats:
        """Deviations with all effects."""
        return self._with(())

    @property
    def of_repeatability(self) -> float:
        """I [nat]; −inf if a parameter is not identified."""
        return -2.0 * float(np.log(self.repeatability[: self.count]).sum())

    @property
    def of_comparison(self) -> float:
        """T [nat]; −inf if a parameter is not identified."""
        return -2.0 * float(np.log(self.between_runs[: self.count]).sum())

    def largest(self, i: int, shared: Sequence[str] = OF_THE_BENCH) -> Contribution | None:
        """The largest entry of the budget of an unknown, without those ``shared``; None without any."""
        return largest(self.budget, i, shared)

    def _with(self, without: Sequence[str]) -> Floats:
        together: Floats = np.hypot(self.repeatability, unnoticed(self.budget, len(self.names), without))
        return together


@dataclass(frozen=True)
class IntervalCriterion:
    """Criterion of an experiment [nat]: T, I, or the share of one parameter in T, by its name."""

    name: str

    def of(self, interval: Interval) -> float:
        """The criterion of an interval; more is better."""
        if self.name in NUMBERS:
            return interval.of_comparison if self.name == "T" else interval.of_repeatability
        return -2.0 * math.log(interval.between_runs[interval.names.index(self.name)])

    def value(self, phi: float) -> float:
        """The criterion in the unit that is printed, here [nat]."""
        return phi

    @property
    def label(self) -> str:
        """Name of the value."""
        return self.name if self.name in NUMBERS else f"T of {self.name}"


def of_information(e: Information) -> Interval:
    """The interval of the experiment of an information, at its parameters and with its unknowns.

    With planned currents every sample counts; of a recorded experiment, the samples received.

    Raises:
        UsageError: the information is of several runs, or the model cannot estimate these unknowns.
        LogError: the experiment is too short for them.
    """
    if e.experiment is None:
        raise UsageError("each run has an interval of its own: expected the information of one of them")
    experiment = replace(e.experiment, late=None, places=None)
    if not isinstance(e, Evaluation):
        experiment = sampled(e.bench, e.plant, experiment.currents)
    return of_experiment(e.bench, e.plant, e.theta, experiment, e.question, e.errors)


def sampled(bench: Bench, plant: Plant, currents: Sequence[float] | Floats) -> Experiment:
    """An experiment with planned currents [A], after rest at the origin, without lost samples."""
    experiment = planned(currents, plant.instruments.encoder_offset)
    rested = bench.noise.angle / math.sqrt(REST_SAMPLES)
    return replace(experiment, samples=np.zeros_like(experiment.samples), slack=rested)


def of_experiment(
    bench: Bench,
    plant: Plant,
    brake: BrakeParameters,
    experiment: Experiment,
    question: Question,
    errors: SystematicErrors = NO_ERRORS,
) -> Interval:
    """The interval of an experiment with a brake; its samples say which were received, and where a gap ended."""
    bench = replace(bench, brake=brake)
    parameters = EstimationProblem(question.params, question.nuisances, question.prior)
    full = with_systematic(parameters, bench, plant)
    problem = make_problem(bench, plant, [experiment.seen_by(plant)], full)
    z, given = problem.nominal(), {name: value for name, value in errors._asdict().items() if value is not None}
    for i, unknown in enumerate(problem.unknowns):
        z[i] = given.get(unknown.name, z[i])
    return of_problem(problem, z)


def of_problem(problem: Problem, z: Floats) -> Interval:
    """The interval of a problem of one noise-free experiment at ``z``."""
    effects = tuple(problem.question.unmodelled)
    fixed = lacked_sensitivities(problem, effects)
    trajectories = [problem.predict(z, i, fixed) for i in range(len(problem.experiments))]
    weights = problem.weights(z, trajectories)
    jacobian = problem.jacobian(z, weights, trajectories)[1]
    averaged = average(problem, z, (np.zeros(len(jacobian)), jacobian))  # without noise the residuals are zero
    basis, inverse = basis_and_inverse(jacobian)
    if any(experiment.gap_unknowns for experiment in problem.experiments):
        basis = np.concatenate([basis, problem.gap_basis(z, weights)], axis=1)
    prediction = Simulation(problem, z, weights, trajectories, fixed)
    found = lacking(regressors(problem, z, prediction, jacobian, effects), basis, inverse)
    information = np.sum(found.beside**2, axis=1)
    budget = budget_of(problem, averaged, found, information, np.sqrt(information))
    covariance = Spectrum(jacobian.T @ jacobian + averaged.added()).inverse()
    unknowns = [one.name for one in problem.unknowns]
    index = [i for i, name in enumerate(unknowns) if name not in problem.question.default_nuisances]
    biases = tuple(replace(one, bias=tuple(one.bias[i] for i in index)) for one in budget)
    names = tuple(unknowns[i] for i in index)
    return Interval(names, len(problem.question.params), covariance[np.ix_(index, index)], biases)
