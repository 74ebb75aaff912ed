"""Averaging over whether systematic errors are there, against one least-squares problem for each combination."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from emb_bench.config.bench import Bench
from emb_bench.estimate.average import ABSENT, SHARES, Influence, average
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import EstimationProblem

from tests.bench.measurements import Floats, currents_of, fit, record  # isort: skip

PRIORS = {"offset": 0.05, "current_offset": 0.05, "delay": 0.3, "velocity_gain": 0.02}
SIZES = [(0.0, ABSENT), *((share, (1.0 - ABSENT) / len(SHARES)) for share in SHARES)]
HALF = 0.5  # Probability that the effect is there
EFFECT = [(0.0, 1.0 - HALF), *((share, HALF / len(SHARES)) for share in SHARES)]


class Answer(NamedTuple):
    """Gaussian answer of one combination."""

    logarithm: float  # Of its probability, but for a constant
    mean: Floats
    covariance: Floats


def answers(names: list[str], z: Floats, y: Floats, a: Floats) -> Iterator[tuple[dict[str, float], Answer]]:
    """Answers of samples ``a x = y`` and a prior for each error, by their deviations; what is absent is zero.

    The unknowns are x + z; an unknown ``effect`` has the prior deviation 1.
    """
    priors = PRIORS | ({"effect": 1.0} if "effect" in names else {})
    triangle: Floats = np.linalg.qr(np.column_stack([a, y]))[1]
    a, y, constant = triangle[:-1, :-1], triangle[:-1, -1], triangle[-1, -1] ** 2
    unit = np.linalg.norm(a, axis=0)
    sizes = [EFFECT if name == "effect" else SIZES for name in priors]
    for chosen in itertools.product(*sizes):
        deviations = {name: share * priors[name] for name, (share, _) in zip(priors, chosen, strict=True)}
        kept = [i for i, name in enumerate(names) if deviations.get(name, 1.0) > 0.0]
        absent = [i for i in range(len(names)) if i not in kept]
        known = [i for i in kept if names[i] in deviations]
        inverse = np.array([1.0 / deviations[names[i]] for i in known])
        rows = (np.concatenate([a, np.eye(len(names))[known] * inverse[:, None]]) / unit)[:, kept]
        wanted = np.concatenate([y + a[:, absent] @ z[absent], -z[known] * inverse])
        found = np.linalg.lstsq(rows, wanted, rcond=None)[0]
        mean, covariance = -z.copy(), np.zeros((len(z), len(z)))
        mean[kept] = found / unit[kept]
        own = rows.T @ rows
        covariance[np.ix_(kept, kept)] = np.linalg.inv(own) / np.outer(unit[kept], unit[kept])
        left = wanted - rows @ found
        volume = np.linalg.slogdet(own)[1] + 2.0 * np.log(unit[kept]).sum() - 2.0 * np.log(inverse).sum()
        chance = sum(math.log(before) for _, before in chosen)
        yield deviations, Answer(chance - 0.5 * (float(left @ left) + constant + volume), mean, covariance)


class Case(NamedTuple):
    """A record, and the problem linearised at its fit."""

    problem: Problem
    estimate: Estimate
    found: tuple[Floats, Floats]

    @property
    def names(self) -> list[str]:
        return [unknown.name for unknown in self.problem.unknowns]

    def samples(self) -> tuple[Floats, Floats]:
        """Samples as equations for a change of the unknowns; the last rows found are the priors in full."""
        rows = len(self.found[0]) - len(PRIORS)
        return -self.found[0][:rows], self.found[1][:rows]


def case(bench: Bench, plant: str, current: float) -> Case:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp"))
    data = replace(data, currents=data.currents + current)
    exact = bench.plant("exact")
    problem = make_problem(bench, exact, [data], with_systematic(EstimationProblem(), bench, exact))
    assert problem.question.systematic == PRIORS
    e = fit(bench, exact, [data], problem.question)
    return Case(problem, e, problem.jacobian(e.fit, problem.weights(e.fit)))


@pytest.mark.parametrize(("plant", "current"), [("exact", 0.0), ("offset", 0.0), ("exact", 0.003)])
def test_mean_and_covariance_are_those_of_all_combinations_weighted_by_their_evidence(
    bench: Bench, plant: str, current: float
) -> None:
    its = case(bench, plant, current)
    found = [one for _, one in answers(its.names, its.estimate.fit, *its.samples())]
    weights = np.exp(np.array([one.logarithm for one in found]) - max(one.logarithm for one in found))
    weights /= weights.sum()
    mean = sum(w * one.mean for w, one in zip(weights, found, strict=True))
    covariance = sum(
        w * (one.covariance + np.outer(one.mean - mean, one.mean - mean)) for w, one in zip(weights, found, strict=True)
    )
    unit = np.sqrt(np.diag(covariance))
    averaged = average(its.problem, its.estimate.fit, its.found)
    assert averaged.step / unit == pytest.approx(mean / unit, abs=1e-3)
    ours = np.linalg.inv(its.found[1].T @ its.found[1] + averaged.added())
    assert ours / np.outer(unit, unit) == pytest.approx(covariance / np.outer(unit, unit), abs=1e-3)
    assert np.abs(its.estimate.values - its.problem.values(its.estimate.fit + averaged.step)) == pytest.approx(
        np.zeros(len(unit)), abs=0.02 * float(np.max(unit * its.estimate.scale))
    )


@pytest.mark.parametrize("size", [0.0, 2.0, 6.0])
def test_a_bias_is_that_of_all_combinations_of_errors_and_effect(bench: Bench, size: float) -> None:
    """The effect, a current that grows with the time, is there in the samples with ``size`` deviations."""
    its = case(bench, "exact", 0.0)
    y, a = its.samples()
    column = a[:, its.names.index("k_m")] * np.linspace(-1.0, 1.0, len(y)) * 3e-3
    whole = np.append(column, np.zeros(len(PRIORS)))
    errors, jacobian = its.found
    pseudo = np.linalg.pinv(jacobian / (unit := np.linalg.norm(jacobian, axis=0))) / unit[:, None]
    beside = whole - jacobian @ (pseudo @ whole)
    length = float(np.linalg.norm(beside))
    shifted = errors + size / length * beside  # the fit stays where it is
    averaged = average(its.problem, its.estimate.fit, (shifted, jacobian))
    none = np.zeros(len(its.names))
    effect = Influence(pseudo @ whole, length**2, float(beside @ shifted), np.array(SHARES), HALF, none)
    names, z = [*its.names, "effect"], np.append(its.estimate.fit, 0.0)
    logs, squares, sizes = [], [], []
    for deviations, one in answers(names, z, -shifted[: len(y)], np.column_stack([a, -column])):
        known = [i for i in range(len(none)) if deviations.get(names[i], 1.0) > 0.0]
        priors = np.array([1.0 / deviations[names[i]] if names[i] in deviations else 0.0 for i in known])
        rows = np.concatenate([a[:, known], np.diag(priors)]) / unit[known]
        moved = none.copy()
        moved[known] = np.linalg.lstsq(rows, np.append(column, np.zeros(len(known))), rcond=None)[0] / unit[known]
        logs.append(one.logarithm)
        sizes.append(one.covariance[-1, -1] + one.mean[-1] ** 2)
        squares.append(moved**2 * sizes[-1])
    weights = np.exp(np.array(logs) - max(logs))
    expected = np.sqrt(weights @ np.array(squares) / weights.sum())
    (found,), (size,) = averaged.biases([effect])
    assert size == pytest.approx(float(np.sqrt(weights @ np.array(sizes) / weights.sum())), rel=0.01)
    assert np.abs(found[:4]) == pytest.approx(expected[:4], rel=0.01)
