"""The estimator of a run, and the forms in which its estimate is given."""

from __future__ import annotations

import dataclasses
import math

import pytest

from emb_runtime.config.bench import PARAMETER_NAMES, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import BenchFileError
from emb_runtime.estimator.estimate import by_name, words
from emb_runtime.estimator.estimator import Estimator, estimated
from emb_runtime.estimator.kalman import MISFIT, follow, start

BENCH = load_bench()
SAMPLES = [(0.0, 0.3, 0.0, 0.0), (0.02, 15.0, 1.0, 6.0), (0.4, 80.0, 6.0, 6.0), (0.45, 60.0, 7.0, -6.0)]


def test_it_begins_with_the_set_that_the_bench_names_and_reports_what_is_open_in_it() -> None:
    assert estimated(BENCH) == PARAMETER_NAMES
    brake, high = BENCH.brake, BENCH.range_set("pm50").high
    values, deviations = Estimator(BENCH).estimate[:4], Estimator(BENCH).estimate[4:]
    assert values == pytest.approx(brake[2:])
    assert deviations == pytest.approx([(b - a) / math.sqrt(3.0) for a, b in zip(brake[2:], high[2:], strict=True)])
    one = dataclasses.replace(BENCH, prior="viscous")
    assert estimated(one) == ("f_v",)
    assert Estimator(one).estimate == pytest.approx((*brake[2:5], 3e-5, 0.0, 0.0, 0.0, 4e-5 / math.sqrt(12.0)))
    assert list(by_name(Estimator(one).estimate)) == ["f_v"]
    assert estimated(dataclasses.replace(BENCH, prior="nominal")) == ()


def test_a_bench_file_may_name_the_set_or_leave_the_shields() -> None:
    text = shipped_bench_text()
    assert parse_bench(text, "it").prior == "pm50"
    without = text.replace("[estimator] ", "[plants.none] ").replace('ranges = "pm50"', "play = 0.1")
    assert parse_bench(without, "it").prior == "envelope"
    for wrong in ('ranges = "none"', "ranges = 1", 'ranges = "pm50"\nmodel = 1'):
        with pytest.raises(BenchFileError, match="estimator"):
            parse_bench(text.replace('ranges = "pm50"', wrong), "it")


def test_it_takes_samples_and_begins_anew() -> None:
    estimator = Estimator(BENCH)
    assert estimator.model.sticks
    fresh = estimator.state
    for sample in SAMPLES:
        before = estimator.state
        estimator.take(*sample)
        assert estimator.state == follow(estimator.model, before, *sample)
    assert estimator.parameters == estimator.estimate != Estimator(BENCH).estimate
    one = Estimator(one_bench := dataclasses.replace(BENCH, prior="viscous"))
    for sample in SAMPLES:
        one.take(*sample)
    assert one.estimate[:3] == Estimator(one_bench).estimate[:3]
    assert one.estimate[4:7] == (0.0, 0.0, 0.0)
    estimator.begin()
    assert estimator.state == fresh == start(estimator.model)
    assert estimator.fits
    estimator.state = fresh._replace(worst=1.01 * MISFIT)
    assert not estimator.fits


def test_an_estimate_that_is_not_finite_is_none() -> None:
    estimator = Estimator(BENCH)
    estimator.take(math.nan, 0.0, 0.0, 0.0)
    assert estimator.estimate == ()


def test_an_estimate_is_given_by_name_and_in_as_many_digits_as_its_interval_allows() -> None:
    assert by_name(()) == {}
    record = by_name((0.0217, 23.04, 1.0, 1.0, 1.5e-7, 0.05, 0.0, 0.0))
    assert record["k_1"]["interval_95"] == pytest.approx([22.942, 23.138], abs=1e-4)
    assert (record["k_m"]["value"], record["k_m"]["deviation"], record["k_m"]["unit"]) == (0.0217, 1.5e-7, "N·m/A")
    assert words(record) == ["k_m = 0.02170000 ± 2.9e-07 N·m/A   0.0014 %", "k_1 = 23.040 ± 0.098 N/rad   0.43 %"]
    zero = {"value": 0.0, "deviation": 0.0, "unit": "N·m/A"}
    assert words({"k_m": zero}) == ["k_m = 0.000 ± 0.0 N·m/A"]
