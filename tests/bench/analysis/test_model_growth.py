from __future__ import annotations

from dataclasses import replace

import pytest

from emb_bench.analysis.model_growth import ADDITIONS, addition_scores, grow_model
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import EstimationProblem
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

from tests.bench.measurements import currents_of, fit, record  # isort: skip

PATHS = {
    "exact": set(),
    "stribeck": {"static friction"},
    "load": {"static friction", "static friction by load"},
    "cubic": {"curved stiffness"},
    "hysteresis": {"hysteresis"},
    "play": {"play"},
    "lag": {"lag of the current"},
}
"""Additions that make the shipped bench's plants of ``exact``."""


def grown(bench: Bench, true: str) -> Estimate:
    data = record(bench, bench.plant(true), currents_of(bench, "chirp"), seed=3)
    return grow_model(bench, bench.plant("exact"), [data], EstimationProblem(), starts=2, seed=0)


@pytest.mark.parametrize(
    "true", [n if n in ("exact", "stribeck") else pytest.param(n, marks=pytest.mark.slow) for n in PATHS]
)
def test_the_model_grows_to_the_brake_that_was_there_and_no_further(bench: Bench, true: str) -> None:
    e = grown(bench, true)
    plain, *added = e.plant.name.split(" + ")
    assert plain == "exact"
    assert set(added) == PATHS[true]
    assert e.validation.fits
    for unknown, value, deviation in zip(e.unknowns, e.values, e.between_runs(), strict=True):
        if unknown.name in PARAMETER_NAMES:
            truth = getattr(bench.brake, unknown.name)
            assert value == pytest.approx(truth, abs=4.0 * deviation * truth)


def test_under_the_right_model_the_scores_are_small(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=5)
    scores = addition_scores(fit(bench, "exact", [data], EstimationProblem()))
    assert set(scores) == set(ADDITIONS)
    assert max(scores.values()) < 3.5


@pytest.mark.slow
def test_with_systematic_errors_estimated_along_a_model_grows_beside_an_offset_of_the_current(bench: Bench) -> None:
    currents, plant = currents_of(bench, "chirp"), bench.plant("exact")
    true = record(bench, bench.plant("hysteresis"), currents + 0.02, seed=3)
    data = replace(true, currents=currents)  # 20 mA act beyond what was reported
    asked = with_systematic(EstimationProblem(), bench, plant)
    e = grow_model(bench, plant, [data], asked, starts=1, seed=0)
    assert e.plant.name == "exact + hysteresis"
    assert e.validation.fits
    assert e.values[e.labels.index("current_offset")] == pytest.approx(0.02, rel=0.2)


@pytest.mark.slow
def test_a_lag_leaves_no_delay_to_be_estimated_along(bench: Bench) -> None:
    plant, data = bench.plant("exact"), record(bench, bench.plant("lag"), currents_of(bench, "chirp"), seed=3)
    asked = with_systematic(EstimationProblem(), bench, plant)
    e = grow_model(bench, plant, [data], asked, starts=1, seed=0)
    assert "lag of the current" in e.plant.name
    assert "delay" not in e.question.default_nuisances


def test_a_plant_that_is_not_solved_exactly_cannot_grow(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"))
    with pytest.raises(UsageError):
        grow_model(bench, bench.plant("euler"), [data], EstimationProblem(), starts=1, seed=0)
