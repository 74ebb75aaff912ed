from __future__ import annotations

import numpy as np
import pytest

from emb_bench.config.bench import Bench
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

from tests.bench.measurements import check_derivatives, currents_of, fit, record  # isort: skip

OF = {
    "stribeck": ("break_away", "stribeck_velocity"),
    "load": ("break_away", "stribeck_velocity", "f_l"),
    "cubic": ("quadratic", "cubic"),
    "hysteresis": ("hysteresis",),
    "play": ("play",),
    "lag": ("current_lag",),
}
"""Features of the shipped bench's plants."""


@pytest.mark.parametrize("plant", OF)
def test_features_are_estimated_with_a_plant_that_lacks_them(bench: Bench, plant: str) -> None:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp"), seed=3)
    e = fit(bench, "exact", [data], EstimationProblem(PARAMETER_NAMES, OF[plant]))
    assert e.validation.fits
    true = bench.brake._asdict() | bench.plant(plant).mechanics._asdict()
    for unknown, value, deviation in zip(e.unknowns, e.values.tolist(), e.cramer_rao().tolist(), strict=True):
        assert abs(value / true[unknown.name] - 1.0) < 4.0 * deviation
        assert deviation < 0.3
    for name, value in zip(OF[plant], e.values[len(PARAMETER_NAMES) :].tolist(), strict=True):
        assert getattr(e.plant.mechanics, name) == value


@pytest.mark.parametrize("plant", [*OF, "rough"])
def test_their_derivatives_are_finite_differences_of_the_residuals(bench: Bench, plant: str) -> None:
    names = OF.get(plant, ("break_away", "stribeck_velocity", "f_l", "quadratic", "hysteresis", "current_lag"))
    asked = EstimationProblem(PARAMETER_NAMES, names)
    problem = Problem(
        bench, bench.plant(plant), asked, (record(bench, bench.plant(plant), currents_of(bench, "multisine")[:150]),)
    )
    z = problem.nominal()
    weights = problem.weights(z)
    derivatives = problem.jacobian(z, weights)[1]
    for i in range(len(z)):
        step = np.zeros(len(z))
        step[i] = 3e-5 * z[i]
        above, below = (problem.jacobian(z + side * step, weights)[0] for side in (1.0, -1.0))
        slope = (above - below) / (2.0 * step[i])
        assert np.abs(slope - derivatives[:, i]).max() < 1e-3 * np.abs(slope).max(), problem.unknowns[i].name


@pytest.mark.parametrize("late", [-0.04, 0.3])
@pytest.mark.parametrize("plant", ["exact", "late", "offset"])
def test_derivatives_to_systematic_errors_are_finite_differences_of_the_residuals(
    bench: Bench, plant: str, late: float
) -> None:
    known = {"offset": 0.01, "current_offset": 0.05, "delay": 0.3, "velocity_gain": 0.02}
    data = record(bench, bench.plant(plant), currents_of(bench, "multisine")[:150])
    problem = Problem(bench, bench.plant(plant), EstimationProblem(("k_m", "f_v"), systematic=known), (data,))
    assert [u.name for u in problem.unknowns[2:]] == ["x1_0", *known]
    away = {"x1_0": 0.02, "offset": 0.01, "current_offset": 0.03, "delay": late, "velocity_gain": 0.01}
    z = problem.nominal() + np.array([away.get(u.name, 0.01) for u in problem.unknowns])
    weights = problem.weights(z)
    check_derivatives(lambda z: problem.jacobian(z, weights)[0], z, problem.jacobian(z, weights)[1])


def test_a_feature_that_is_not_there_ends_near_zero(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=4)
    e = fit(bench, "exact", [data], EstimationProblem(PARAMETER_NAMES, ("hysteresis",)))
    i = len(PARAMETER_NAMES)
    assert e.values[i] < 4.0 * e.values[i] * e.cramer_rao()[i]


def test_unknowns_that_a_plant_cannot_have_are_refused(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), np.ones(50))
    for plant, names, reason in (
        ("euler", ("cubic",), "expected a plant that is solved exactly"),
        ("euler", ("delay",), "delay"),
        ("lag", ("delay",), "delay"),
        ("exact", ("stribeck_velocity",), "estimate break_away too"),
        ("exact", ("hysteresis", "play"), "play does not go with hysteresis"),
        ("hysteresis", ("play",), "play does not go with hysteresis"),
        ("play", ("hysteresis",), "play does not go with hysteresis"),
    ):
        with pytest.raises(UsageError, match=f"plant '{plant}': .*{reason}"):
            fit(bench, plant, [data], EstimationProblem(("k_m",), names))
