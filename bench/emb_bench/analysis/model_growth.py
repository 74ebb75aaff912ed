"""Stepwise growth of a model: significant features are added one by one to a simple plant.

Each round fits every missing feature with a significant score test (Rao). The fit with the least BIC is added if BIC
falls and the held-out prediction is no worse; then features that BIC no longer supports are removed. It ends when no
feature is significant, or none is accepted.

Multiple testing: BIC is that of Chen and Chen (Biometrika 95, 2008), with 2 log of the number of models with as many
additions. Score tests are linear: with large residuals they select features, but do not size them. Friction that
differs by the direction of motion is no addition, for it is the same torque as an offset of the current. The clamping
force's curve is added with both of its terms: with one of them alone the slope at contact would be overconfident.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from emb_bench.analysis.model_choice import candidate, fit_from, ranked
from emb_bench.analysis.records import Candidate
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import Bench
from emb_bench.config.plants import EXACT, Plant
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem, check_model
from emb_bench.experiment.experiment import Experiment
from emb_runtime.errors import UsageError

ADDITIONS: Mapping[str, tuple[str, ...]] = {
    row.addition: tuple(name for name, other in PARAMETERS.items() if other.addition == row.addition)
    for row in PARAMETERS.values()
    if row.addition
}
"""Possible additions, and the unknowns of each."""
SIGNIFICANT = 3.0  # Score above which an addition is tried [standard deviations]
FOLLOWED = 10.0  # χ²/n above which a search is repeated by continuation
POLISHED = 6  # Searches around the minimum of an accepted model,
AROUND = 0.03  # from values that differ by this share


def grow_model(
    bench: Bench,
    plant: Plant,
    experiments: Sequence[Experiment],
    question: EstimationProblem,
    *,
    starts: int,
    seed: int,
) -> Estimate:
    """Adds features to a plant until none is significant; the estimate's plant is named after them."""
    if plant.mechanics.solver != EXACT:
        raise UsageError(f"plant '{plant.name}': expected one that is solved exactly: others have no features to add")
    first = method_of("oem")(bench, plant, question, starts=starts, seed=seed).fit(experiments)
    now = _grown(plant, first, ())
    added: tuple[str, ...] = ()
    seen: dict[tuple[str, ...], Candidate] = {(): now}
    path = [added]
    while True:
        scores = addition_scores(now.estimate, added)
        tried = [
            name for name in scores if abs(scores[name]) >= SIGNIFICANT and _possible(plant, question, (*added, name))
        ]
        for name in tried:
            key = _key((*added, name))
            if key not in seen:
                seen[key] = _fitted(plant, question, now.estimate, key)
        found = [(name, seen[_key((*added, name))]) for name in tried]
        better = [(name, c) for name, c in found if c.bic < now.bic and c.held_out >= now.held_out]
        if not better:
            break
        newest, best = min(better, key=lambda pair: pair[1].bic)
        added = _key((*added, newest))
        now = seen[added] = _polished(plant, question, best, added, seed)
        now, added = _pruned(plant, question, now, added, seen, newest)
        if added in path:
            break
        path.append(added)
    # Models with less BIC predict the held-out part worse.
    return ranked([c for c in seen.values() if c.bic >= now.bic or c is now]).best.estimate


def addition_scores(e: Estimate, added: Sequence[str] = ()) -> dict[str, float]:
    """Scores of all additions that the model lacks [standard deviations], most significant first."""
    scores = {suspect.name: suspect.sigmas for suspect in e.validation.suspects}
    found = {
        name: scores[unknowns[0]]
        for name, unknowns in ADDITIONS.items()
        if name not in added and unknowns[0] in scores and _possible(e.plant, e.question, (name,))
    }
    return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))


def _key(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in ADDITIONS if name in names)


def _with(question: EstimationProblem, names: Sequence[str]) -> EstimationProblem:
    unknowns = [unknown for name in names for unknown in ADDITIONS[name] if unknown not in question.names]
    return replace(question, nuisances=(*question.nuisances, *unknowns))


def _possible(plant: Plant, question: EstimationProblem, names: Sequence[str]) -> bool:
    try:
        check_model(plant, _with(question, names).names)
    except UsageError:
        return False
    return True


def _problem(plant: Plant, question: EstimationProblem, near: Estimate, names: Sequence[str]) -> Problem:
    """Problem with additions, without systematic errors that they exclude: a delay beside a lag."""
    found = _with(question, names)
    if found.systematic:
        found = with_systematic(found, near.bench, plant)
    return Problem(near.bench, plant, found, near.experiments)


def _grown(plant: Plant, e: Estimate, added: Sequence[str]) -> Candidate:
    name = " + ".join((plant.name, *added))
    found = candidate(name, replace(e, problem=replace(e.problem, plant=replace(e.plant, name=name))))
    return replace(found, bic=found.bic + 2.0 * math.log(math.comb(len(ADDITIONS), len(added))))


def _fitted(plant: Plant, question: EstimationProblem, near: Estimate, names: Sequence[str]) -> Candidate:
    problem = _problem(plant, question, near, names)
    fit = fit_from(problem, near)
    if fit.ratio > FOLLOWED:
        fit = min(fit, fit_from(problem, near, follow=True), key=lambda one: one.best.cost)
    return _grown(plant, fit.finished(), names)


def _polished(
    plant: Plant, question: EstimationProblem, found: Candidate, names: Sequence[str], seed: int
) -> Candidate:
    """The model searched again from points around its minimum, which may be a local one."""
    e, rng = found.estimate, np.random.default_rng(seed)
    problem = _problem(plant, question, e, names)
    around = [e.values * (1.0 + AROUND * rng.standard_normal(len(e.z))) for _ in range(POLISHED)]
    near = [replace(e, z=e.problem.coordinates(values)) for values in around]
    fits = [fit_from(problem, e, follow=True), *(fit_from(problem, start) for start in near)]
    best = min(fits, key=lambda fit: fit.best.cost)
    return _grown(plant, best.finished(), names) if best.best.cost < e.ends[0].cost - 1e-3 else found


def _pruned(
    plant: Plant,
    question: EstimationProblem,
    now: Candidate,
    added: tuple[str, ...],
    seen: dict[tuple[str, ...], Candidate],
    newest: str,
) -> tuple[Candidate, tuple[str, ...]]:
    """The model without earlier additions that BIC does not support."""
    for name in added:
        less = tuple(other for other in added if other != name)
        if name == newest or not less:
            continue
        if less not in seen:
            seen[less] = _fitted(plant, question, now.estimate, less)
        if seen[less].bic <= now.bic:
            now, added = seen[less], less
    return now, added
