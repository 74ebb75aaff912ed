"""Choice of a model: plants fitted to the experiments and ranked, and the interval that covers those left over.

Every plant is fitted by output error with the same unknowns, and with the systematic errors that it can have. The fit
of the simplest plant is a start for all others, and the fit without systematic errors one for that with them; whichever
does not explain the experiments from there is started anew from the best of the others.

*Likelihood.* −2 log L = Σ e²/σ² + Σ log σ² over all samples. The variance counts, because it is part of the model: a
jittering clock makes samples of a fast brake uncertain. A model in which the velocity is an observer's has no noise of
its own in it: given the angles its velocity follows, to the last digits that are sent. So its likelihood is that of
the angles, and that of the difference between the velocity sent and the one that the observer's recursion gives from
three samples in a row, whose variance is taken from the experiment.

*Criteria* (Burnham and Anderson, Model Selection and Multimodel Inference, 2nd ed., 2002, chapter 6): BIC adds log n
for each unknown, but none for the systematic errors that are estimated too, which have priors. The *held-out score*
needs no count of unknowns: the logarithm of the density that a model fitted to a part of the experiments gives to the
rest (Laplace's approximation, an uncertainty of 100 % before the experiments). The part is all but one of several
experiments, each in its turn, or the first half of a single one.

*Weights.* A model's weight is exp(−BIC/2) over the sum of all; where the experiments tell models apart, one has all of
it. The interval of a parameter is that of the mixture of the models' Gaussians with these weights, so that it covers
both where two explain the experiments. Models that do not fit beside one that does have no weight.
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
from emb_bench.estimate.search import released
from emb_bench.experiment.experiment import Experiment
from emb_runtime.estimator.observer import observer_gains

WRONG = 25  # Simulations after which the search of a model that does not explain the experiments ends
ExperimentsOf = Callable[[Plant], Sequence[Experiment]]
"""The experiments as a model takes them: its encoder's offset says whether one starts at the origin."""


def choose_model(
    bench: Bench,
    plants: Sequence[Plant],
    experiments_of: ExperimentsOf,
    asked: EstimationProblem,
    *,
    starts: int,
    seed: int,
) -> ModelChoice:
    """Fits every plant and ranks them."""
    ordered = sorted(plants, key=lambda plant: (plant.name != DEFAULT_PLANT, plant.mechanics, plant.instruments))

    def problems(asked: EstimationProblem) -> list[Problem]:
        return [make_problem(bench, plant, experiments_of(plant), _asked_of(bench, plant, asked)) for plant in ordered]

    trusting = problems(replace(asked, systematic={}))
    simplest = trusting[0]
    first = method_of("oem")(bench, ordered[0], simplest.asked, starts=starts, seed=seed).fit(simplest.experiments)
    fits = _from_the_best([fit_from(problem, first) for problem in trusting])
    if asked.systematic:
        fits = _from_the_best([fit_from(own, fit) for own, fit in zip(problems(asked), fits, strict=True)])
    if not any(fit.explains for fit in fits):
        fits = _from_the_best([fits[0], *(fit_from(fit.problem, fits[0], follow=True) for fit in fits[1:])])
    found = [candidate(fit.problem.plant.name, fit.finished()) for fit in fits]
    kept = {model_of(c.estimate.plant, asked): c for c in reversed(ranked(found).candidates)}
    names = {c.name for c in kept.values()}
    choice = ranked([c for c in found if c.name in names])
    return replace(choice, same=tuple(c.name for c in found if c.name not in names))


def _from_the_best(fits: Sequence[Fit]) -> list[Fit]:
    """Fits what does not explain the experiments once more, from the best of the others."""
    near = min(fits, key=lambda fit: fit.ratio)
    again = []
    for fit in fits:
        worse = not fit.explains and fit is not near
        again.append(min(fit, fit_from(fit.problem, near), key=lambda fit: fit.best.cost) if worse else fit)
    return again


def model_of(plant: Plant, asked: EstimationProblem) -> tuple[Mechanics, Instruments]:
    """A plant's equations without its name, and without the encoder's offset where that is estimated."""
    estimated = "offset" in (*asked.names, *asked.along)
    return plant.mechanics, plant.instruments._replace(encoder_offset=0.0) if estimated else plant.instruments


def _asked_of(bench: Bench, plant: Plant, asked: EstimationProblem) -> EstimationProblem:
    """The problem as a plant can answer it: a late command only if the plant has time for one."""
    if not has_time_for_a_delay(plant) and "delay" not in asked.params:
        asked = replace(asked, nuisances=tuple(name for name in asked.nuisances if name != "delay"))
    return with_systematic(asked, bench, plant) if asked.systematic else asked


def fit_from(problem: Problem, near: Estimate | Fit, *, follow: bool = False) -> Fit:
    """Output error, started from where another model ended.

    With ``follow`` a filter leads there, which follows the measured brake and has few local minima.
    """
    z = near.z if isinstance(near, Estimate) else near.best.z
    start = problem.started(dict(zip(near.problem.unknowns, near.problem.values(z).tolist(), strict=True)))
    if follow:
        start = released(problem, start).z
    weights = problem.weights(start)
    fit = Fit(problem, weights, (search(problem, start, weights, WRONG),))
    if not fit.best.converged and fit.best.cost <= 2.0 * fit.limit:
        fit = replace(fit, ends=(search(problem, fit.best.z, weights),))
    return reweighted(with_gaps(fit), WRONG)


def candidate(name: str, e: Estimate) -> Candidate:
    """A fitted model with its criteria."""
    samples = sum(int(experiment.measured.sum()) for experiment in e.experiments) * 2
    deviance, count = _deviance(e.problem, e.fit), len(e.wanted())
    return Candidate(name, e, deviance, deviance + count * math.log(samples), held_out_score(e, deviance))


def ranked(candidates: Sequence[Candidate]) -> ModelChoice:
    """Models with their weights: those that fit first, then by BIC; of equals the one that came first."""
    usable = [c for c in candidates if c.fits] or list(candidates)
    least = min(c.bic for c in usable)
    weights = [math.exp(-0.5 * (c.bic - least)) if c in usable else 0.0 for c in candidates]
    weighted = [replace(c, weight=w / sum(weights)) for c, w in zip(candidates, weights, strict=True)]
    return ModelChoice(
        tuple(sorted(weighted, key=lambda c: (not c.fits and len(usable) < len(weighted), round(c.bic, 1))))
    )


def _deviance(problem: Problem, z: Floats) -> float:
    """−2 log L of the samples, but for what all models share."""
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
    """Logarithm of the density that the model gives to what was held out when it was fitted to the rest."""
    volume, score, count = _volume(e.problem, e.z), 0.0, len(e.experiments)
    for out in range(count):
        if count > 1:
            problem, own = e.problem.part([i for i in range(count) if i != out])
        else:
            half = e.experiments[0].until(max(len(e.experiments[0].currents) // 2, 1))
            problem, own = replace(e.problem, experiments=(half,)), list(range(len(e.z)))
        start = e.z[own]
        there = search(problem, start, problem.weights(start), WRONG).z
        score -= 0.5 * (deviance - _deviance(problem, there) + volume - _volume(problem, there))
    return score


def _volume(problem: Problem, z: Floats) -> float:
    """Logarithm of the determinant of the information, 1 for what nothing is known of."""
    rows = problem.jacobian(z, problem.weights(z))[1]
    return float(np.linalg.slogdet(rows.T @ rows + np.eye(len(z)))[1])
