from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from emb_bench.analysis.model_growth import ADDITIONS, ModelGrowth, grow_model, grow_with_errors, wanted
from emb_bench.analysis.study import StudyOptions, make_study
from emb_bench.config.bench import Bench
from emb_bench.config.plants import EVERY
from emb_bench.estimate.records import EstimationProblem, with_systematic
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

from tests.bench.measurements import currents_of, fit, record  # isort: skip
from tests.bench.simulated_logs import square as square_wave, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip

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


def grown(bench: Bench, true: str) -> ModelGrowth:
    data = record(bench, bench.plant(true), currents_of(bench, "chirp"), seed=3)
    return grow_model(bench, bench.plant("exact"), [data], EstimationProblem(), starts=2, seed=0)


@pytest.mark.parametrize(
    "true", [n if n in ("exact", "stribeck") else pytest.param(n, marks=pytest.mark.slow) for n in PATHS]
)
def test_the_model_grows_to_the_brake_that_was_there_and_no_further(bench: Bench, true: str) -> None:
    found = grown(bench, true)
    assert set(found.added) == PATHS[true]
    best = found.choice.best
    assert best.name == " + ".join(("exact", *found.added)) == best.estimate.plant.name
    assert best.fits
    ratios = [one.ratio for one in found.rounds]
    assert ratios == sorted(ratios, reverse=True)
    assert not any(trial.accepted for trial in found.rounds[-1].trials)
    for trial in (trial for one in found.rounds for trial in one.trials):
        assert abs(trial.sigmas) >= 3.0
        assert not trial.accepted or (trial.bic < 0.0 and trial.held_out >= 0.0)
    for unknown in best.estimate.unknowns[: len(PARAMETER_NAMES)]:
        low, high = found.choice.interval(unknown, 0.9999)
        assert low < getattr(bench.brake, unknown.name) < high


def test_under_the_right_model_the_scores_are_small(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=5)
    scores = wanted(fit(bench, "exact", [data], EstimationProblem()))
    assert set(scores) == set(ADDITIONS)
    assert max(scores.values()) < 3.5


@pytest.mark.slow
def test_with_systematic_errors_estimated_along_a_model_grows_beside_an_offset_of_the_current(bench: Bench) -> None:
    currents, plant = currents_of(bench, "chirp"), bench.plant("exact")
    true = record(bench, bench.plant("hysteresis"), currents + 0.02, seed=3)
    data = replace(true, currents=currents)  # 20 mA act beyond what was reported
    asked = with_systematic(EstimationProblem(), bench, plant)
    found = grow_model(bench, plant, [data], asked, starts=1, seed=0)
    assert found.added == ("hysteresis",)
    e = found.choice.best.estimate
    assert e.validation.fits
    assert e.values[e.labels.index("current_offset")] == pytest.approx(0.02, rel=0.2)
    for unknown in e.unknowns[: len(PARAMETER_NAMES)]:
        low, high = found.choice.interval(unknown, 0.9999)
        assert low < getattr(bench.brake, unknown.name) < high


@pytest.mark.slow
def test_a_lag_leaves_no_delay_to_be_estimated_along(bench: Bench) -> None:
    plant, data = bench.plant("exact"), record(bench, bench.plant("lag"), currents_of(bench, "chirp"), seed=3)
    asked = with_systematic(EstimationProblem(), bench, plant)
    found = grow_model(bench, plant, [data], asked, starts=1, seed=0)
    assert "lag of the current" in found.added
    assert "delay" not in found.choice.best.estimate.asked.along


def test_where_no_model_fits_it_grows_with_systematic_errors(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=3)
    data = replace(data, samples=data.samples * [1.0, 1.003])
    plant, asked = bench.plant("exact"), EstimationProblem()
    assert not grow_model(bench, plant, [data], asked, starts=1, seed=0).choice.best.fits
    e = grow_with_errors(bench, plant, [data], asked, starts=1, seed=0).choice.best.estimate
    assert e.validation.fits
    assert e.values[e.labels.index("velocity_gain")] == pytest.approx(0.003, rel=0.2)


def test_what_cannot_grow_is_refused(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    log = read_log(write_log(tmp_path / "a.mcap", simulate(square_wave)))
    for method, model in (("pem", None), ("oem", EVERY), ("oem", "euler")):
        with pytest.raises(UsageError):
            make_study(bench, [log], StudyOptions(EstimationProblem(), method, model, grow=True))
