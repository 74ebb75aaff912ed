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
    deviations = e.cramer_rao() * e.scale
    for unknown, value, deviation in zip(e.unknowns, e.values.tolist(), deviations.tolist(), strict=True):
        assert abs(value - true[unknown.name]) < 4.0 * deviation
        assert deviation < 0.3 * true[unknown.name]
    for name, value in zip(OF[plant], e.values[len(PARAMETER_NAMES) :].tolist(), strict=True):
        assert getattr(e.plant.mechanics, name) == value


SYSTEMATIC = ("offset", "current_offset", "delay", "velocity_gain")
AWAY = {"x1_0": 0.02, "offset": 0.01, "contact": 0.2, "current_offset": 0.03, "delay": 0.3, "velocity_gain": 0.01}
"""Values of those unknowns at which derivatives are compared."""


@pytest.mark.parametrize(
    ("plant", "names", "delay"),
    [
        ("exact", (*PARAMETER_NAMES, "x1_0", "x2_0", "offset"), 0.3),
        ("exact", ("k_1", "contact", "x1_0", "delay"), 0.3),
        ("stribeck", ("delay", "f_v", "J"), 0.3),
        ("late", ("k_m", "T_c", "offset"), 0.3),
        ("euler", ("k_m", "contact"), 0.3),
        *((plant, (*PARAMETER_NAMES, *features), 0.3) for plant, features in OF.items()),
        ("rough", ("break_away", "stribeck_velocity", "f_l", "quadratic", "hysteresis", "current_lag"), 0.3),
        *(
            (plant, ("k_m", "f_v", "x1_0", *SYSTEMATIC), d)
            for plant in ("exact", "late", "offset")
            for d in (-0.04, 0.3)
        ),
    ],
)
def test_derivatives_are_finite_differences_of_the_residuals(
    bench: Bench, plant: str, names: tuple[str, ...], delay: float
) -> None:
    model = bench.plant(plant)
    data = record(bench, model, currents_of(bench, "multisine")[:150], x0=(0.3, 20.0))
    asked = EstimationProblem(names, systematic=dict.fromkeys({*SYSTEMATIC} & {*names}, 0.1))
    problem = Problem(bench, model, asked, (data,))
    away = np.array([(AWAY | {"delay": delay}).get(u.name, 0.0) for u in problem.unknowns])
    z = problem.coordinates(1.03 * problem.values(problem.nominal())) + away
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
