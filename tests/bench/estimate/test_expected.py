"""The interval that is expected of an experiment beside estimates of noisy logs; averages over errors of sensors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
import pytest

from emb_bench.api import fisher_information
from emb_bench.brake.parameters import COMMAND, F_V, K_1, K_M, T_C
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.average import ABSENT, SHARES, Influence, average
from emb_bench.estimate.effects import EFFECTS, Linearised, Prediction, Simulation, regressors, with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.expected import Interval, of_experiment, of_information
from emb_bench.estimate.innovations import Filter, FilterPrediction
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.estimate.suspects import basis_and_inverse, lacking
from emb_bench.experiment.simulate import SystematicErrors
from emb_bench.information.evaluation import Question, expected
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from tests.bench.measurements import Floats, currents_of, fit, problem_of, record

CURRENTS = np.repeat(np.random.default_rng(3).uniform(-2.5, 3.0, 25), 12)


def interval(bench: Bench, plant: str = "exact", currents: Floats = CURRENTS) -> Interval:
    """Of planned currents with the four parameters."""
    model = bench.plant(plant)
    return of_information(expected(bench, model, Question(), bench.brake, SystematicErrors(), currents))


def without_systematic(bench: Bench, **but: float) -> Bench:
    """The bench whose instruments are certain, and whose brake has no effect besides."""
    none = {field.name: 0.0 for field in fields(bench.systematic) if field.name != "k_m"}
    return replace(bench, systematic=type(bench.systematic)(**none | but))


PLANTS = ("exact", "euler", "stribeck", "load", "hysteresis", "cubic", "play", "observer", "offset", "late")


def modelled(bench: Bench, plant: Plant, late: float = 0.0) -> tuple[Problem, Floats]:
    """A record without noise that the model explains at z."""
    shown = record(bench, plant, CURRENTS, seed=None)
    problem = make_problem(bench, plant, [shown], with_systematic(EstimationProblem(), bench, plant))
    z = problem.nominal()
    for i, unknown in enumerate(problem.unknowns):
        z[i] = late if unknown.name == "delay" else z[i]
    return problem, z


@pytest.mark.parametrize("late", [0.0, 0.3])
@pytest.mark.parametrize("name", PLANTS)
def test_an_effect_that_acts_as_a_current_sums_the_derivatives_to_single_currents(
    bench: Bench, name: str, late: float
) -> None:
    """An estimate has these derivatives for reports that were lost."""
    problem, z = modelled(bench, bench.plant(name), late)
    model = Simulation(problem, z, [np.ones((len(CURRENTS), 2))])
    turned = Linearised(problem, z, model, 0, np.zeros((0, len(z))), tuple(EFFECTS)).shares()
    torques = {each for each, row in EFFECTS.items() if row.torque}
    assert {*turned} == torques - ({"play"} if name in ("play", "euler") else set())
    acting = {each: (u, s) for each, (u, s) in turned.items() if u in (COMMAND, K_M)}
    rows = np.stack([s * (CURRENTS if u == K_M else 1.0) for u, s in acting.values()], axis=1)
    found = model.parts(0, np.array([u for u, _ in acting.values()]), np.stack([s for _, s in acting.values()], axis=1))
    wanted = np.zeros_like(found)
    for odd in range(2):
        lost = np.arange(len(CURRENTS)) % 2 == odd
        gaps = replace(
            problem, experiments=(replace(problem.experiments[0], assumed=np.where(lost, CURRENTS, np.nan)),)
        )
        single = gaps.predict(z, 0).sensitivities[:, len(z) :]
        wanted += np.einsum("kgo,gj->kjo", single, rows[lost])
    assert (np.abs(found - wanted).max(axis=0) <= 1e-8 * np.abs(wanted).max(axis=0)).all()


@pytest.mark.parametrize("method", ["oem", "pem"])
@pytest.mark.parametrize("late", [0.0, 0.3])
@pytest.mark.parametrize("name", PLANTS)
def test_the_parts_of_a_parameter_in_each_period_add_to_its_derivative(
    bench: Bench, name: str, late: float, method: str
) -> None:
    problem, z = modelled(bench, bench.plant(name), late)
    weights = problem.weights(z)
    followed = Filter(problem, 10.0)
    gains = followed.gains(z, weights)
    model: Prediction = Simulation(problem, z, weights)
    jacobian = problem.jacobian(z, weights)[1]
    if method == "pem":
        model, jacobian = FilterPrediction(followed, z, weights, gains), followed.jacobian(z, weights, gains)[1]
    whole = -jacobian[: 2 * len(CURRENTS), :4].reshape(-1, 2, 4).transpose(0, 2, 1)
    shares = np.random.default_rng(5).uniform(-1.0, 2.0, (len(CURRENTS), 4))
    shares[10:20] = 0.0
    unknowns = np.array([K_M, K_1, T_C, F_V])
    found = model.parts(0, unknowns, shares) + model.parts(0, unknowns, 1.0 - shares)
    assert (np.abs(found - whole).max(axis=(0, 2)) <= 1e-8 * np.abs(whole).max(axis=(0, 2))).all()


FRICTION = {"friction_100": 100.0, "friction_200": 200.0}  # Stribeck velocities [rad/s]
PERIODS = np.arange(500)
TURNING: dict[str, Callable[[Bench], Floats]] = {
    "chirp": lambda bench: currents_of(bench, "chirp"),
    "multisine": lambda bench: currents_of(bench, "multisine"),
    "square, 40 ms": lambda _: 3.0 * np.sign(np.sin(2.0 * math.pi * PERIODS / 40.0 + 0.1)),
    "square, 25 ms": lambda _: 3.0 * np.sign(np.sin(2.0 * math.pi * PERIODS / 25.0 + 0.1)),
    "sine, 30 ms": lambda _: 3.0 * np.sin(2.0 * math.pi * PERIODS / 30.0),
}


@pytest.mark.parametrize("currents", TURNING)
@pytest.mark.parametrize("name", FRICTION)
def test_what_a_friction_leaves_beside_the_model_is_that_of_a_brake_that_has_it(
    bench: Bench, name: str, currents: str
) -> None:
    """A current in place of it leaves up to ten times as much where the brake turns back often."""
    plant = bench.plant("exact")
    problem = problem_of(bench, PARAMETER_NAMES, record(bench, plant, TURNING[currents](bench), seed=None))
    z = problem.nominal()
    weights = problem.weights(z)
    model, jacobian = Simulation(problem, z, weights), problem.jacobian(z, weights)[1]
    basis, inverse = basis_and_inverse(jacobian)
    changed = plant.mechanics._replace(tolerance=1e-12, break_away=1.0 + 1e-5, stribeck_velocity=FRICTION[name])
    (more, less) = (model.whitened_samples(0, m) for m in (changed, changed._replace(break_away=1.0)))
    change = ((more - less) / 1e-5).ravel()
    wanted = change - basis @ (basis.T @ change)
    found = lacking(regressors(problem, z, model, jacobian, (name,)), basis, inverse).beside[0]
    assert np.linalg.norm(found - wanted) < 0.05 * np.linalg.norm(wanted)


@pytest.mark.parametrize("name", ["exact", "stribeck"])
def test_estimates_of_noisy_logs_state_the_interval_that_was_expected(bench: Bench, name: str) -> None:
    plant, wanted = bench.plant(name), interval(bench, name)
    found = []
    for seed in range(12):
        asked = with_systematic(EstimationProblem(), bench, plant)
        estimate = fit(bench, plant, [record(bench, plant, CURRENTS, seed=seed)], asked, starts=1)
        own = estimate.requested()
        found.append([estimate.cramer_rao()[own], estimate.between_runs()[own], estimate.deviations()[own]])
    ratios = np.median(found, axis=0) / [wanted.repeatability, wanted.between_runs, wanted.total]
    assert (np.abs(np.log(ratios)) < math.log(1.35)).all(), ratios


def test_with_certain_instruments_the_repeatability_is_that_of_ideal_sensors(bench: Bench) -> None:
    certain = without_systematic(bench)
    found = interval(certain)
    bounds = expected(certain, certain.plant("exact"), Question(), certain.brake, SystematicErrors(), CURRENTS)
    np.testing.assert_allclose(found.repeatability, [bounds[name] for name in PARAMETER_NAMES], rtol=1e-9)
    np.testing.assert_array_equal(found.total, found.repeatability)
    assert found.of_repeatability == pytest.approx(-float(np.log(np.diag(bounds.covariance)).sum()))
    assert found.of_comparison == found.of_repeatability
    assert found.largest(0) is None


def test_an_error_of_the_inertia_is_in_the_total_and_not_between_runs(bench: Bench) -> None:
    found = interval(without_systematic(bench, inertia=0.01))
    np.testing.assert_allclose(found.total, np.hypot(found.repeatability, 0.01), rtol=1e-9)
    np.testing.assert_array_equal(found.between_runs, found.repeatability)
    assert [one.name for one in found.budget] == ["J"]


def test_one_effect_moves_the_parameters_by_regression(bench: Bench) -> None:
    """A change of k_m over the run that is certain to be there, against the normal equations."""
    certain = without_systematic(bench, drift=0.01)
    found = interval(certain)
    problem = make_problem(
        certain, certain.plant("exact"), [record(bench, certain.plant("exact"), CURRENTS, seed=None)],
        with_systematic(EstimationProblem(), certain, certain.plant("exact")),
    )  # fmt: skip
    z = problem.nominal()
    weights = problem.weights(z)
    jacobian = problem.jacobian(z, weights)[1]
    ones = Simulation(problem, z, weights)
    column = regressors(problem, z, ones, jacobian, ("k_m_drift",))["k_m_drift"]
    moved, square, *_ = np.linalg.lstsq(jacobian, column, rcond=None)
    information, squares, weights_of = float(square[0]), 0.0, 0.5  # half the brakes have none
    for share in (1e-3, 1e-2, 0.1, 1.0):
        variance = 1.0 / ((share * 0.01) ** -2 + information)
        weight = math.exp(0.5 * variance * information) / math.sqrt(1.0 + (share * 0.01) ** 2 * information) / 8.0
        squares, weights_of = squares + weight * (variance + variance**2 * information), weights_of + weight
    wanted = np.abs(moved[:4])
    wanted[0] += 0.5  # it is meant from the begin of a run to its end
    (own,) = [one for one in found.budget if one.name == "k_m_drift"]
    np.testing.assert_allclose(np.abs(own.bias), wanted * math.sqrt(squares / weights_of), rtol=1e-9)


def test_lost_samples_widen_the_interval(bench: Bench) -> None:
    plant = bench.plant("exact")
    whole = record(bench, plant, CURRENTS, seed=None)
    lost = whole.lose(np.arange(len(CURRENTS)) > 200)
    wide, narrow = (of_experiment(bench, plant, bench.brake, one, Question()) for one in (lost, whole))
    assert wide.of_repeatability < narrow.of_repeatability - 0.1
    assert wide.of_comparison < narrow.of_comparison


def test_a_gap_in_the_reports_widens_it(bench: Bench) -> None:
    plant = bench.plant("exact")
    whole = record(bench, plant, CURRENTS, seed=None)
    assumed = np.where(np.isin(np.arange(len(CURRENTS)), [40, 90, 91, 92]), 0.0, np.nan)
    gap = replace(whole, assumed=assumed)
    wide, narrow = (of_experiment(bench, plant, bench.brake, one, Question()) for one in (gap, whole))
    assert wide.of_repeatability < narrow.of_repeatability
    assert [one.name for one in wide.budget] == [one.name for one in narrow.budget]


def test_several_runs_have_no_interval_together(bench: Bench) -> None:
    one = fisher_information(CURRENTS)
    with pytest.raises(UsageError, match="each run has an interval of its own"):
        of_information(one + one)


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
