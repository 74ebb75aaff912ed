"""Choice of a model: plants are fitted and ranked, and intervals cover all plausible ones.

Every plant is fitted by output error with the same unknowns, and with the systematic errors that it can have. Each
search begins at the fit of the simplest plant; a search with systematic errors begins at the fit without them. A plant
that does not explain the experiments is fitted again from the best of the others.

*Likelihood.* −2 log L = Σ e²/σ² + Σ log σ² over all samples. The variance counts, because it is part of the model: a
jittering clock makes samples of a fast brake uncertain. An observer's velocity has no noise besides that of the angles.
So the likelihood of such a model is that of the angles, times that of the difference between the velocity sent and the
observer's recursion over three samples in a row, with a variance estimated from the experiment.

*Criteria* (Burnham and Anderson, Model Selection and Multimodel Inference, 2nd ed., 2002, chapter 6): BIC adds log n
for each unknown, but none for the default systematic errors, which have priors. The *held-out score* needs no count of
unknowns: it is the log predictive density of the rest by a model fitted to a part of the experiments (Laplace's
approximation, with a prior deviation of 100 %). The part is all but one of several experiments, each in turn, or the
first half of a single one.

*Weights.* A model's weight is exp(−BIC/2) over the sum of all. The interval of a parameter is that of the mixture of
the models' Gaussians with these weights, and so covers all models that explain the experiments. Models that do not fit
have no weight if another one fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from emb_bench.analysis.records import Candidate, ModelChoice
from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, Instruments, Mechanics, Plant
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.output_error import Fit, reweighted, search, with_gaps
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import EstimationProblem, has_time_for_a_delay
from emb_bench.estimate.search import continuation
from emb_bench.experiment.experiment import Experiment
from emb_runtime.estimator.observer import observer_gains

WRONG = 25  # Limit of simulations for a model that does not explain the experiments
ExperimentsOf = Callable[[Plant], Sequence[Experiment]]
"""The experiments for a plant; its encoder offset determines whether an experiment starts at the origin."""


def choose_model(
    bench: Bench,
    plants: Sequence[Plant],
    experiments_of: ExperimentsOf,
    question: EstimationProblem,
    *,
    starts: int,
    seed: int,
) -> ModelChoice:
    """Fits every plant and ranks them."""
    ordered = sorted(plants, key=lambda plant: (plant.name != DEFAULT_PLANT, plant.mechanics, plant.instruments))

    def problems(question: EstimationProblem) -> list[Problem]:
        return [
            make_problem(bench, plant, experiments_of(plant), _for_plant(bench, plant, question)) for plant in ordered
        ]

    trusting = problems(replace(question, systematic={}))
    simplest = trusting[0]
    first = method_of("oem")(bench, ordered[0], simplest.question, starts=starts, seed=seed).fit(simplest.experiments)
    fits = _from_the_best([fit_from(problem, first) for problem in trusting])
    if question.systematic:
        fits = _from_the_best([fit_from(full, fit) for full, fit in zip(problems(question), fits, strict=True)])
    if not any(fit.explains for fit in fits):
        fits = _from_the_best([fits[0], *(fit_from(fit.problem, fits[0], follow=True) for fit in fits[1:])])
    found = [candidate(fit.problem.plant.name, fit.finished()) for fit in fits]
    distinct = {model_of(c.estimate.plant, question): c for c in reversed(ranked(found).candidates)}
    names = {c.name for c in distinct.values()}
    choice = ranked([c for c in found if c.name in names])
    return replace(choice, same=tuple(c.name for c in found if c.name not in names))


def _from_the_best(fits: Sequence[Fit]) -> list[Fit]:
    """Fits each model that does not explain the experiments once more, from the best of the others."""
    near = min(fits, key=lambda fit: fit.ratio)
    again = []
    for fit in fits:
        worse = not fit.explains and fit is not near
        again.append(min(fit, fit_from(fit.problem, near), key=lambda fit: fit.best.cost) if worse else fit)
    return again


def model_of(plant: Plant, question: EstimationProblem) -> tuple[Mechanics, Instruments]:
    """A plant's equations, without an encoder offset that is estimated."""
    estimated = "offset" in (*question.names, *question.default_nuisances)
    return plant.mechanics, plant.instruments._replace(encoder_offset=0.0) if estimated else plant.instruments


def _for_plant(bench: Bench, plant: Plant, question: EstimationProblem) -> EstimationProblem:
    """The problem for a plant: with a delay only if the plant has time for one."""
    if not has_time_for_a_delay(plant) and "delay" not in question.params:
        question = replace(question, nuisances=tuple(name for name in question.nuisances if name != "delay"))
    return with_systematic(question, bench, plant) if question.systematic else question


def fit_from(problem: Problem, near: Estimate | Fit, *, follow: bool = False) -> Fit:
    """Output error from the end of another model's search, with ``follow`` by continuation from there."""
    z = near.z if isinstance(near, Estimate) else near.best.z
    start = problem.initial(dict(zip(near.problem.unknowns, near.problem.values(z).tolist(), strict=True)))
    if follow:
        start = continuation(problem, start).z
    weights = problem.weights(start)
    fit = Fit(problem, weights, (search(problem, start, weights, WRONG),))
    if not fit.best.converged and fit.best.cost <= 2.0 * fit.limit:
        fit = replace(fit, ends=(search(problem, fit.best.z, weights),))
    return reweighted(with_gaps(fit), WRONG)


def candidate(name: str, e: Estimate) -> Candidate:
    """A fitted model with its criteria."""
    samples = sum(int(experiment.measured.sum()) for experiment in e.experiments) * 2
    deviance, count = _deviance(e.problem, e.fit), len(e.requested())
    return Candidate(name, e, deviance, deviance + count * math.log(samples), held_out_score(e, deviance))


def ranked(candidates: Sequence[Candidate]) -> ModelChoice:
    """Models with their weights: those that fit first, then by BIC."""
    usable = [c for c in candidates if c.fits] or list(candidates)
    least = min(c.bic for c in usable)
    weights = [math.exp(-0.5 * (c.bic - least)) if c in usable else 0.0 for c in candidates]
    weighted = [replace(c, weight=w / sum(weights)) for c, w in zip(candidates, weights, strict=True)]
    return ModelChoice(
        tuple(sorted(weighted, key=lambda c: (not c.fits and len(usable) < len(weighted), round(c.bic, 1))))
    )


def _deviance(problem: Problem, z: Floats) -> float:
    """−2 log L of the samples, without a constant that all models share."""
    weights = problem.weights(z)
    errors, _ = problem.jacobian(z, weights)
    total = float(errors @ errors)
    for experiment, root in zip(problem.experiments, weights, strict=True):
        total -= 2.0 * float(np.sum(np.log(root[root > 0.0])))
        if problem.plant.instruments.observer_bandwidth > 0.0:
            bandwidth = problem.plant.instruments.observer_bandwidth
            total += _observed(experiment, bandwidth, problem.bench.timing.sample_time)
    return total


def _observed(experiment: Experiment, bandwidth: float, t_s: float) -> float:
    """−2 log L of a velocity that an observer derives from the angles."""
    alpha, beta = observer_gains(bandwidth, t_s)
    angle, velocity = experiment.samples.T
    surprise = np.diff(velocity)[:-1] * t_s / beta  # of the middle one of three samples
    ahead = angle[1:-1] - (1.0 - alpha) * surprise + t_s * velocity[1:-1]
    errors = velocity[2:] - velocity[1:-1] - beta / t_s * (angle[2:] - ahead)
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return 0.0
    variance = max(float(np.mean(errors**2)), 1e-300)
    return int(experiment.measured.sum()) * (math.log(variance) + 1.0)


def held_out_score(e: Estimate, deviance: float) -> float:
    """Logarithm of the predictive density of the held-out part, with the model fitted to the rest."""
    volume, score, count = _volume(e.problem, e.z), 0.0, len(e.experiments)
    for out in range(count):
        if count > 1:
            problem, places = e.problem.subset([i for i in range(count) if i != out])
        else:
            half = e.experiments[0].until(max(len(e.experiments[0].currents) // 2, 1))
            problem, places = replace(e.problem, experiments=(half,)), list(range(len(e.z)))
        start = e.z[places]
        there = search(problem, start, problem.weights(start), WRONG).z
        score -= 0.5 * (deviance - _deviance(problem, there) + volume - _volume(problem, there))
    return score


def _volume(problem: Problem, z: Floats) -> float:
    """Log determinant of the information, plus 1 on the diagonal as a prior."""
    rows = problem.jacobian(z, problem.weights(z))[1]
    return float(np.linalg.slogdet(rows.T @ rows + np.eye(len(z)))[1])
