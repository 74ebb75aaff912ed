from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from emb_bench.analysis.profile import profile
from emb_bench.analysis.records import LEVEL
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.identifiability import Doubt
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.measurements import currents_of, fit, record  # isort: skip


def estimated(bench: Bench, records: Sequence[Experiment], *params: str, **asked: object) -> Estimate:
    question = EstimationProblem(params, **asked)  # type: ignore[arg-type]
    return fit(bench, "exact", records, question)


@pytest.fixture(scope="module")
def told(bench: Bench) -> Estimate:
    plant = bench.plant("exact")
    data = [record(bench, plant, currents_of(bench, text), seed=n) for n, text in enumerate(("step", "chirp"))]
    return estimated(bench, data, *PARAMETER_NAMES)


@pytest.mark.parametrize("label", PARAMETER_NAMES)
def test_where_the_records_tell_a_parameter_well_its_profile_is_the_parabola_of_the_fisher_information(
    told: Estimate, label: str
) -> None:
    found, i = profile(told, label), told.labels.index(label)
    deviation = told.cramer_rao()[i] * told.values[i]
    assert found.doubt is None
    assert np.array(found.interval) == pytest.approx(told.intervals()[i], abs=0.03 * NORMAL_95 * deviation)
    parabola = ((found.values - told.values[i]) / deviation) ** 2
    assert found.rise == pytest.approx(parabola, abs=0.05 * LEVEL)
    assert (np.diff(found.values) > 0.0).all()
    assert found.agrees
    assert found.fell == 0.0


def test_the_rise_is_that_of_a_search_over_the_other_parameter(bench: Bench) -> None:
    """Brent's method on χ² itself, the only other unknown being one number."""
    data = record(bench, bench.plant("exact"), currents_of(bench, "square:amplitude=3,period=0.05"))
    e = estimated(bench, [data], "T_c", "f_v")
    found = profile(e, "T_c")
    problem = Problem(e.bench, e.plant, e.question, e.experiments)
    z = e.z
    weights = problem.weights(z)

    def chi2(t_c: float, f_v: float) -> float:
        errors, _ = problem.jacobian(np.array([t_c, f_v]), weights)
        return float(errors @ errors)

    least = chi2(*z)
    for value, rise in zip(np.log(found.values[::3]), found.rise[::3], strict=True):
        width = 20.0 * e.cramer_rao()[1]
        best = minimize_scalar(
            lambda f_v, t=value: chi2(t, f_v), bounds=(z[1] - width, z[1] + width), options={"xatol": 1e-9}
        )
        assert rise == pytest.approx(best.fun - least, abs=1e-3)


def test_a_clamping_stiffness_of_a_brake_that_never_clamps_has_a_flat_profile(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), np.full(60, -0.8))
    found = profile(estimated(bench, [data], "k_m", "k_1"), "k_1")
    assert (found.doubt, found.interval) == (Doubt.FLAT, (-np.inf, np.inf))
    assert np.abs(found.rise).max() < 1e-3
    nominal = bench.brake.k_1
    assert [found.values[0], found.values[-1]] == pytest.approx([nominal / 10.0, nominal * 10.0])


def test_a_brake_that_does_not_break_away_tells_its_friction_from_below_only(bench: Bench) -> None:
    """It stands as long as the motor's torque is no larger than T_c."""
    plant, current = bench.plant("exact"), 0.9 * bench.brake.T_c / bench.brake.k_m
    data = record(bench, plant, np.full(200, current))
    found = profile(estimated(bench, [data], "T_c"), "T_c")
    assert found.doubt is Doubt.OPEN_ABOVE
    low, high = found.interval
    assert high == np.inf
    assert low == pytest.approx(bench.brake.k_m * current, rel=1e-3)
    assert low < bench.brake.k_m * current


def test_a_side_that_closes_only_because_another_unknown_meets_its_border_is_open(bench: Bench) -> None:
    """Torques and inertia scale together, as far as the first of them may go."""
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"))
    off = replace(bench, brake=bench.brake._replace(f_v=8.0 * bench.brake.f_v))
    e = estimated(off, [data], *PARAMETER_NAMES, nuisances=("J",))
    found = profile(e, "k_m")
    assert found.rise.max() > LEVEL
    assert (found.doubt, found.interval) == (Doubt.FLAT, (-np.inf, np.inf))


def test_what_only_the_prior_tells_has_the_prior_s_interval(bench: Bench) -> None:
    """A Gaussian of the ranges' mean and variance."""
    ranges = bench.range_set("pm50")
    data = record(bench, bench.plant("exact"), np.full(60, -0.8))
    found = profile(estimated(bench, [data], "k_m", "k_1", prior=ranges), "k_1")
    mean, width = 0.5 * (ranges.low.k_1 + ranges.high.k_1), ranges.high.k_1 - ranges.low.k_1
    half = NORMAL_95 * width / 12.0**0.5
    assert found.interval == pytest.approx((mean - half, mean + half), rel=1e-3)


def test_a_profile_that_comes_upon_a_lower_minimum_says_that_the_estimate_was_a_local_one(bench: Bench) -> None:
    """With twice the friction the brake does not break away, and no small change of it shows."""
    current = 1.5 * bench.brake.T_c / bench.brake.k_m
    data = record(bench, bench.plant("exact"), np.full(60, current))
    found = estimated(bench, [data], "T_c")
    stuck = replace(found, z=2.0 * found.z)
    good, bad = profile(found, "T_c"), profile(stuck, "T_c")
    assert good.fell == 0.0
    assert bad.fell > 0.0
    assert bad.minimum == pytest.approx(found.values[0], rel=1e-5)
    assert bad.interval == pytest.approx(good.interval, rel=1e-6)
    assert bad.rise.min() > -1e-3
