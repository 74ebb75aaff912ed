"""Models of a brake: chosen among the plants of the bench, or grown until the records ask for no more."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from emb_bench.analysis.model_choice import choose_model
from emb_bench.analysis.model_growth import ADDITIONS, addition_scores, grow_model
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.records import ModelChoice, mixture_interval
from emb_bench.analysis.stages import make_study
from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.config.plants import EVERY, Plant
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import EstimationProblem, Unknown
from emb_bench.experiment.experiment import Experiment
from emb_bench.logs.log import RunLog, read_log
from emb_bench.report.estimate import study_document, study_text
from emb_bench.report.sentences import models
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from tests.bench.flows import square
from tests.bench.measurements import currents_of, fit, record
from tests.bench.report_pages import make
from tests.bench.simulated_logs import square as square_wave
from tests.bench.simulated_logs import write_log
from tests.conftest import Simulate

FACTORS = {"k_m": 0.9, "k_1": 1.2, "T_c": 1.3, "f_v": 1.4}


def chosen(bench: Bench, true: str, currents: Floats, models: list[str], runs: int = 1) -> ModelChoice:
    brake = bench.brake._replace(**{name: factor * getattr(bench.brake, name) for name, factor in FACTORS.items()})

    def records(plant: Plant) -> list[Experiment]:
        own = bench.plant(true)
        made = [record(bench, own, currents, brake=brake, seed=seed) for seed in range(runs)]
        offset = plant.instruments.encoder_offset
        return [
            Experiment(f"{i}", r.currents, r.samples, r.angle, 0.0, r.slack, abs(r.angle - offset) <= 4.0 * r.slack)
            for i, r in enumerate(made)
        ]

    plants = [bench.plant(name) for name in models]
    return choose_model(bench, plants, records, EstimationProblem(), starts=4, seed=0)


OTHERS = ("exact", "hysteresis", "play", "lag", "offset", "jitter", "observer")


@pytest.mark.parametrize("true", ["stribeck", "late", *(pytest.param(n, marks=pytest.mark.slow) for n in OTHERS)])
def test_the_plant_that_was_there_comes_first_and_tells_its_parameters(bench: Bench, true: str) -> None:
    found = chosen(bench, true, currents_of(bench, "chirp"), list(bench.plants))
    assert found.best.name == true
    assert found.best.weight > 0.99
    assert max(found.candidates, key=lambda c: c.held_out).name == true
    for unknown in found.best.estimate.unknowns:
        low, high = found.interval(unknown, 0.9999)
        assert low < FACTORS[unknown.name] * getattr(bench.brake, unknown.name) < high


def test_models_that_the_records_do_not_tell_apart_share_the_weight_and_the_interval_covers_both(bench: Bench) -> None:
    """A brake that never touches the clamp has no stiffness, whatever its curve."""
    found = chosen(bench, "exact", -square(15, 1.0)[:100], ["exact", "cubic"])
    assert [c.weight for c in found.candidates] == pytest.approx([0.5, 0.5], abs=0.01)
    assert len(found.plausible) == 2
    k_m = Unknown("k_m")
    low, high = found.interval(k_m)
    for c in found.candidates:
        own = c.estimate.intervals()[c.estimate.unknowns.index(k_m)]
        assert low <= own[0] + 0.01 * (own[1] - own[0])
        assert high >= own[1] - 0.01 * (own[1] - own[0])


def test_what_another_model_would_change_is_its_value_less_that_of_the_first(bench: Bench) -> None:
    found = chosen(bench, "stribeck", currents_of(bench, "chirp"), ["exact", "stribeck"])
    first, other = (c.estimate for c in found.candidates)
    for i, change in enumerate(found.changes(found.candidates[1])):
        assert change.name == PARAMETER_NAMES[i]
        assert change.percent == pytest.approx(100.0 * (other.values[i] / first.values[i] - 1.0))
        assert change.deviations == pytest.approx(change.percent / 100.0 / first.between_runs()[i])
    assert all(change.percent == 0.0 for change in found.changes(found.best))


def test_of_several_records_each_is_held_out_in_turn(bench: Bench) -> None:
    found = chosen(bench, "lag", currents_of(bench, "square")[:200], ["exact", "lag"], runs=2)
    assert found.best.name == "lag"
    assert found.best.held_out > found.candidates[1].held_out + 10.0


def test_the_interval_of_one_model_is_gaussian_and_that_of_two_holds_95_percent_of_both() -> None:
    assert mixture_interval([(1.0, 3.0, 2.0)], 0.95) == pytest.approx((3.0 - 1.96 * 2.0, 3.0 + 1.96 * 2.0), rel=1e-4)
    parts = [(0.5, 0.0, 1.0), (0.5, 10.0, 1.0)]
    low, high = mixture_interval(parts, 0.95)
    assert low == pytest.approx(stats.norm.ppf(0.05), abs=1e-3)
    assert high == pytest.approx(10.0 - stats.norm.ppf(0.05), abs=1e-3)
    assert mixture_interval([(0.5, 0.0, 1.0), (0.5, 0.0, np.inf)], 0.95) == (-np.inf, np.inf)


def test_a_study_with_all_models_says_which_it_took_and_why(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    log = read_log(write_log(tmp_path / "a.mcap", simulate(square_wave, options="plant=stribeck")))
    found = make_study(bench, [log], EstimateOptions(model=EVERY, starts=1))
    assert found.estimate.plant.name == "stribeck"
    alone = make_study(bench, [log], EstimateOptions(model="stribeck", starts=1)).estimate
    assert found.estimate.unknowns == alone.unknowns, "with the errors that the bench cannot exclude"
    assert found.estimate.intervals() == pytest.approx(alone.intervals(), rel=1e-5)
    said = study_document(found)
    # With the encoder's offset estimated too, 'offset' is 'exact'.
    assert [*{model["model"] for model in said["models"]} ^ {*bench.plants}] == said["models_left_out"] == ["offset"]
    assert said["models"][0]["model"] == said["model"] == "stribeck"
    assert sum(model["weight"] for model in said["models"]) == pytest.approx(1.0)
    json.dumps(said)
    assert said["not_told_apart"] is None


def square_log(folder: Path, simulate: Simulate, plant: str, steps: int, current: float = 3.0) -> RunLog:
    run = simulate(lambda *now: current / 3.0 * square_wave(*now), options=f"plant={plant},seed=3", steps=steps)
    return read_log(write_log(folder / "a.mcap", run, steps=steps))


def test_two_models_that_a_record_cannot_tell_apart_are_named_in_one_sentence(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    """In 200 samples play of 0.3 rad explains no less than the brake that was there, and comes first by chance."""
    log = square_log(tmp_path, simulate, "exact", 200)
    found = make_study(bench, [log], EstimateOptions(model=EVERY, starts=1))
    assert study_document(found)["not_told_apart"] == ["play", "exact"]
    choice = found.checks.choice
    assert choice is not None
    assert all(c.fits for c in choice.plausible)
    sentence = models(found)
    assert sentence in " ".join(study_text(found).split())
    page = make(tmp_path / "a.html", log.path, "--model", EVERY, "--starts", "1")
    assert sentence[1:] in page.reader.text
    alone = choice.best.estimate.intervals()
    for i, (name, c) in enumerate(zip(PARAMETER_NAMES, found.conclusions, strict=True)):
        assert c.interval[0] < getattr(bench.brake, name) < c.interval[1]
        assert c.interval[0] <= alone[i][0] < alone[i][1] <= c.interval[1]


def test_of_models_that_are_all_alike_the_simplest_one_answers(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    """A brake that goes away from the clamp has no curve, no hysteresis and no play."""
    log = square_log(tmp_path, simulate, "exact", 100, -1.0)
    found = make_study(bench, [log], EstimateOptions(model=EVERY, starts=1))
    assert found.estimate.plant.name == "exact"
    assert {"exact", "cubic", "hysteresis", "play"} <= {*study_document(found)["not_told_apart"]}


def test_plants_are_compared_with_the_errors_that_the_bench_cannot_exclude(bench: Bench) -> None:
    """20 mA that nobody reported: without them estimated too no plant explains the record."""
    currents, plant = currents_of(bench, "chirp"), bench.plant("hysteresis")
    data = replace(record(bench, plant, currents + 0.02, seed=3), currents=currents)
    asked = EstimationProblem()
    models = [bench.plant(name) for name in ("exact", "stribeck", "hysteresis", "lag")]
    without = choose_model(bench, models, lambda _: [data], asked, starts=1, seed=0)
    assert not without.best.fits
    found = choose_model(bench, models, lambda _: [data], with_systematic(asked, bench, plant), starts=1, seed=0)
    assert found.best.name == "hysteresis"
    assert found.best.fits
    assert "delay" not in {c.name: c for c in found.candidates}["lag"].estimate.question.default_nuisances
    e = found.best.estimate
    assert e.values[e.labels.index("current_offset")] == pytest.approx(0.02, rel=0.2)


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


def test_a_plant_that_is_not_solved_exactly_cannot_grow(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"))
    with pytest.raises(UsageError):
        grow_model(bench, bench.plant("euler"), [data], EstimationProblem(), starts=1, seed=0)
