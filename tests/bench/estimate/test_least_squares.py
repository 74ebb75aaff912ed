from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.least_squares import SURE
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.report.caveats import caveats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

from tests.bench.measurements import currents_of, fit, record  # isort: skip

estimate = partial(fit, method="rls")

Floats = NDArray[np.float64]


def chirped(bench: Bench, plant: str = "exact", seed: int | None = 0) -> Experiment:
    return record(bench, bench.plant(plant), currents_of(bench, "chirp"), seed=seed)


def equations(bench: Bench, data: Experiment) -> tuple[Floats, Floats]:
    """Of the periods that surely keep their direction, in SI units, from the equation of motion, one by one."""
    p, t_s, rows, wholes = bench.brake, bench.timing.sample_time, [], []
    for k in range(1, len(data.currents)):
        (x, w), (y, v) = data.samples[k - 1].tolist(), data.samples[k].tolist()
        sure = SURE * bench.noise.velocity
        if not (min(w, v) > sure or max(w, v) < -sure):
            continue
        sign = 1.0 if w > 0.0 else -1.0
        clamped = p.gamma * max(0.5 * (x + y), 0.0)
        rows.append([data.currents[k] * t_s, -clamped * t_s, -sign * t_s, -0.5 * (w + v) * t_s])
        wholes.append(p.J * (v - w))
    return np.array(rows), np.array(wholes)


@pytest.mark.parametrize("seeds", [(0,), (1, 2)])
def test_it_is_least_squares_over_the_periods_that_surely_keep_their_direction(
    bench: Bench, seeds: tuple[int, ...]
) -> None:
    records = [chirped(bench, seed=seed) for seed in seeds]
    rows, wholes = map(np.concatenate, zip(*(equations(bench, data) for data in records), strict=True))
    scale = np.linalg.norm(rows, axis=0)
    expected = np.linalg.lstsq(rows / scale, wholes, rcond=None)[0] / scale
    found = estimate(bench, "exact", records)
    assert found.values == pytest.approx(expected, rel=1e-7)
    deviation = 2.0**0.5 * bench.brake.J * bench.noise.velocity
    relative = rows * expected / deviation
    assert found.information == pytest.approx(relative.T @ relative, rel=1e-6)
    assert f"{len(rows)} of {499 * len(seeds)} periods count" in caveats(found)[1]


def test_some_of_the_parameters_are_estimated_with_the_others_as_they_are_nominally(bench: Bench) -> None:
    data, b = chirped(bench), bench.brake
    rows, wholes = equations(bench, data)
    rest = wholes - rows[:, [1, 2]] @ [b.k_1, b.T_c]
    scale = np.linalg.norm(rows[:, [3, 0]], axis=0)
    expected = np.linalg.lstsq(rows[:, [3, 0]] / scale, rest, rcond=None)[0] / scale
    found = estimate(bench, "exact", [data], EstimationProblem(("f_v", "k_m")))
    assert found.values == pytest.approx(expected, rel=1e-7)
    assert found.theta == b._replace(f_v=found.values[0], k_m=found.values[1])


def test_a_prior_is_a_ridge_around_its_mean(bench: Bench) -> None:
    data, ranges = chirped(bench), bench.range_set("pm50")
    rows, wholes = equations(bench, data)
    deviation = 2.0**0.5 * bench.brake.J * bench.noise.velocity
    mean = np.array([0.5 * (getattr(ranges.low, n) + getattr(ranges.high, n)) for n in PARAMETER_NAMES])
    spread = np.array([(getattr(ranges.high, n) - getattr(ranges.low, n)) / 12.0**0.5 for n in PARAMETER_NAMES])
    stacked = np.concatenate([rows / deviation * spread, np.eye(4)])
    expected = np.linalg.lstsq(stacked, np.concatenate([wholes / deviation, mean / spread]), rcond=None)[0] * spread
    found = estimate(bench, "exact", [data], EstimationProblem(prior=ranges))
    assert found.values == pytest.approx(expected, rel=1e-7)
    assert found.prior is not None
    assert np.diag(found.prior) == pytest.approx((expected / spread) ** 2, rel=1e-6)


def test_it_says_that_it_estimates_no_systematic_errors_where_the_bench_cannot_exclude_them(bench: Bench) -> None:
    asked = with_systematic(EstimationProblem(), bench, bench.plant("exact"))
    trusted, found = (estimate(bench, "exact", [chirped(bench)], a) for a in (EstimationProblem(), asked))
    assert (trusted.ideal_sensors, found.ideal_sensors) == (False, True)
    assert len(caveats(found)) == len(caveats(trusted)) + 1
    assert (found.values == trusted.values).all()
    assert (found.deviations() == trusted.deviations()).all()


def test_instruments_are_taken_into_account(bench: Bench) -> None:
    true = np.array([getattr(bench.brake, n) for n in PARAMETER_NAMES])
    for plant in ("offset", "late", "jitter"):
        found = estimate(bench, plant, [chirped(bench, plant)])
        assert (np.abs(found.values / true - 1.0) < 0.25).all(), plant
    late = replace(chirped(bench), late=np.full(500, 2e-5))
    for found, said in (
        (estimate(bench, "observer", [chirped(bench, "observer")]), "the velocity is an observer's"),
        (estimate(bench, "exact", [late]), "all samples count at the instants of the grid"),
    ):
        assert len(caveats(found)) == 3
        assert said in caveats(found)[2]


def test_what_the_brake_never_met_is_not_told(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), np.full(60, -1.5))
    found = estimate(bench, "exact", [data], EstimationProblem(("k_m", "k_1")))
    assert [finding.identified for finding in found.identifiability().findings] == [True, False]
    assert np.isinf(found.cramer_rao()[1])
    assert found.values[1] == pytest.approx(bench.brake.k_1)


def test_the_border_of_the_search_is_kept_with_the_others_at_their_best(bench: Bench) -> None:
    data, low = chirped(bench), 1.2 * bench.brake.k_m
    off = replace(bench, brake=bench.brake._replace(k_m=10.0 * low))
    found = estimate(off, "exact", [data], EstimationProblem(("k_m", "T_c")))
    assert found.values[0] == pytest.approx(low, rel=1e-6)
    assert found.at_bound == ("k_m",)
    b = bench.brake
    rows, wholes = equations(bench, data)
    rest = wholes - rows[:, [0, 1, 3]] @ [low, b.k_1, b.f_v]
    assert found.values[1] == pytest.approx(float(rows[:, 2] @ rest / (rows[:, 2] @ rows[:, 2])), rel=1e-4)


def test_what_it_cannot_estimate_is_refused(bench: Bench) -> None:
    for names, plant in ((("k_m", "J"), "exact"), (("k_m", "x1_0"), "exact"), (PARAMETER_NAMES, "stribeck")):
        with pytest.raises(UsageError):
            estimate(bench, plant, [chirped(bench)], EstimationProblem(names))
    hardly_moving = record(bench, bench.plant("exact"), np.full(50, 0.1))
    with pytest.raises(UsageError):
        estimate(bench, "exact", [hardly_moving])
