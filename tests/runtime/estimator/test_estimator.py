"""The estimator of a run, and the forms in which its estimate is given."""

from __future__ import annotations

import dataclasses
import math

import pytest

from emb_runtime.config.bench import PARAMETER_NAMES, Systematic, parse_bench, shipped_bench_text
from emb_runtime.errors import BenchFileError
from emb_runtime.estimator.estimate import NO_FIT, by_name, total, words
from emb_runtime.estimator.estimator import Estimator, estimated
from emb_runtime.estimator.kalman import MISFIT, follow, initial_state
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
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
    assert list(by_name(Estimator(one).estimate, one.systematic)) == ["f_v"]
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
    fresh = estimator.state
    for sample in SAMPLES:
        before = estimator.state
        estimator.add_sample(*sample)
        assert estimator.state == follow(estimator.model, before, *sample)
    assert estimator.parameters is estimator.parameters is estimator.estimate  # computed once a sample
    assert estimator.parameters != Estimator(BENCH).estimate
    one = Estimator(one_bench := dataclasses.replace(BENCH, prior="viscous"))
    for sample in SAMPLES:
        one.add_sample(*sample)
    assert one.estimate[:3] == Estimator(one_bench).estimate[:3]
    assert one.estimate[4:7] == (0.0, 0.0, 0.0)
    estimator.begin_run()
    assert estimator.state == fresh == initial_state(estimator.model)
    assert estimator.fits
    estimator.state = fresh._replace(worst=1.01 * MISFIT)
    assert not estimator.fits


def test_an_estimate_that_is_not_finite_is_none() -> None:
    estimator = Estimator(BENCH)
    estimator.add_sample(math.nan, 0.0, 0.0, 0.0)
    assert estimator.estimate == ()


KNOWN = Systematic(inertia=0.01, angle_scale=0.003)
HEAD = "running estimate ± repeatability (95 %, k=2), valid if the model is right"


def test_an_estimate_is_given_by_name_with_both_uncertainties() -> None:
    assert by_name((), KNOWN) == {}
    record = by_name((0.0217, 23.04, 1.0, 1.0, 1.5e-7, 0.05, 0.0, 0.0), KNOWN)
    assert list(record) == ["k_m", "k_1"], "what is not estimated is left out"
    k_m, k_1 = record.values()
    assert (k_m["value"], k_m["deviation"], k_m["unit"]) == (0.0217, 1.5e-7, "N·m/A")
    assert k_1["repeatability"] == pytest.approx(1.96 * 0.05, rel=1e-4)
    assert k_1["total"] == pytest.approx(1.96 * math.sqrt(0.05**2 + (0.01 * 23.04) ** 2), rel=1e-4)
    assert k_m["total"] == pytest.approx(1.96 * 0.0217 * math.sqrt(0.01**2 + 0.003**2), rel=1e-4)


def test_an_estimate_is_told_in_as_many_digits_as_its_repeatability_allows() -> None:
    record = by_name((0.0217, 23.04, 0.0, 1.0, 1.5e-7, 0.05, 0.4, 0.0), KNOWN)
    rows = [
        "  k_m = (2.170000 ± 0.000029) × 10⁻² N·m/A   repeatability ± 0.0014 %",
        "  k_1 = 23.040 ± 0.098 N/rad                 repeatability ± 0.43 %",
        "  T_c = 0.00 ± 0.78 N·m",
    ]
    assert words(record, "total about 2 %", fits=True) == [HEAD, *rows, "  total about 2 %"]
    assert words(record, "", fits=True) == [HEAD, *rows]
    assert words(record, "total about 2 %", fits=False) == [HEAD, f"  {NO_FIT}", *rows], "no total of a wrong model"
    assert words({}, "", fits=True) == [HEAD]


@pytest.mark.parametrize(
    ("repeatability", "known", "said"),
    [
        (
            {"k_m": 0.0, "f_v": 0.0},
            (0.0, 0.0, 0.0, 1e-4),
            "total at least 0.02 to 0.039 %, as the clock is known to 0.01 %",
        ),
        ({"k_m": 1e-5, "f_v": 1e-5}, (0.01, 0.003, 0.0), "total about 2 %, as J is known to 1 %"),
        ({"k_1": 0.012, "f_v": math.inf}, (0.01, 0.003, 0.0), "total about 2.3 %, as J is known to 1 %"),
        ({"k_1": 1e-5, "T_c": 0.012}, (0.01, 0.003, 0.0), "total about 2 to 2.4 %, as J is known to 1 %"),
        ({"k_1": 1e-5}, (0.5, 0.0, 0.0), "total about 98 %, as J is known to 50 %"),
        ({"k_1": 1e-5}, (0.001, 0.0, 0.0), "total at least 0.2 %, as J is known to 0.1 %"),
        ({"k_m": 1e-5}, (0.0, 0.003, 0.0), "total at least 0.59 %, as the angle's scale is known to 0.3 %"),
        ({"k_m": 1e-5}, (0.0, 0.0, 0.0), ""),
        ({"k_m": math.inf}, (0.01, 0.003, 0.0), ""),
        ({}, (0.01, 0.003, 0.0), ""),
        (
            {"k_m": 1e-5, "T_c": 1e-5},
            (0.0, 0.0, 0.01),
            "total at least 0.001 to 2 %, as the current's scale is known to 1 %",
        ),
    ],
)
def test_the_total_is_told_by_what_is_known_before_a_run(
    repeatability: dict[str, float], known: tuple[float, ...], said: str
) -> None:
    """By the deviations of J, angle, current and time."""
    inertia, angle, current, time = (*known, 0.0)[:4]
    errors = Systematic(inertia=inertia, angle_scale=angle, current_scale=current, time_scale=time)
    assert total(repeatability, errors) == said
