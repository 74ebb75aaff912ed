"""A period of a brake that may stop: its moments, against samples of such brakes and integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate
from scipy.stats import norm

from emb_runtime.estimator.stick_slip import KINK, KINK_DECAY, Accelerations, contact, excess, move, normal, slide

SURE = 1e-9
T_S = 1e-3


def test_a_kink_has_the_moments_of_a_gaussian_number_cut_off_at_zero() -> None:
    for z in (-4.0, -2.0, -0.7, 0.0, 0.3, 1.0, 2.5):

        def moment(of: int, z: float = z) -> float:
            return float(integrate.quad(lambda e: (z + e) ** of * norm.pdf(e), -z, 9.0)[0])

        mean, slope = moment(1), float(norm.cdf(z))
        assert normal(z) == pytest.approx(slope, abs=4e-4)
        assert excess(z, normal(z)) == pytest.approx(mean - max(z, 0.0), abs=1e-3)
        assert KINK * math.exp(-KINK_DECAY * z * z) == pytest.approx(moment(2) - mean**2 - slope**2, abs=4e-3)


def test_a_stop_that_may_be_a_reversal_has_the_mean_and_spread_of_a_sample_of_brakes() -> None:
    now, v, spread = Accelerations(-20000.0, 2200.0, 4.7, 0.0), 21.5, 0.8
    rng = np.random.default_rng(0)
    ends = np.array([move(now, 5.0, v + spread * e, T_S, SURE, SURE, SURE).velocity for e in rng.normal(size=4000)])
    found = move(now, 5.0, v, T_S, spread, spread, spread)
    assert found.velocity == pytest.approx(ends.mean(), abs=0.03)
    assert math.sqrt((found.velocity_by_velocity * spread) ** 2 + found.kinked) == pytest.approx(ends.std(), rel=0.1)


def test_a_brake_at_rest_answers_a_drive_for_the_whole_period_however_little_it_may_have_moved_before() -> None:
    pull, by, v, spread = 28000.0, 100.0, 0.003, 0.14
    noise = spread * np.random.default_rng(1).normal(size=4000)

    def mean_end(pull: float) -> float:
        now = Accelerations(pull, 2200.0, 4.7, 0.0)
        return float(np.mean([move(now, 5.0, v + e, T_S, SURE, SURE, SURE).velocity for e in noise]))

    found = move(Accelerations(pull, 2200.0, 4.7, 0.0), 5.0, v, T_S, spread, 8.0, 8.0)
    assert found.velocity_by_pull == pytest.approx((mean_end(pull + by) - mean_end(pull - by)) / (2.0 * by), rel=5e-3)
    assert found.velocity_by_friction == pytest.approx(-found.velocity_by_pull, rel=1e-2)


def test_a_brake_that_stops_and_may_break_away_is_known_no_better_than_a_sample_of_such_brakes() -> None:
    v, spread, doubt = -1.4, 0.3, 600.0  # against the pull, known to 0.3 rad/s; whether it breaks away is not
    for driven in (-1000.0, -300.0, 0.0, 300.0, 1000.0):
        ends = []
        for e, d in np.random.default_rng(2).normal(size=(4000, 2)):
            now = Accelerations(2200.0 + driven + doubt * d, 2200.0, 4.7, 0.0)
            ends.append(move(now, 5.0, v + spread * e, T_S, SURE, SURE, SURE).velocity)
        around = math.hypot(spread, T_S * doubt)
        found = move(Accelerations(2200.0 + driven, 2200.0, 4.7, 0.0), 5.0, v, T_S, spread, around, around)
        explained = math.hypot(found.velocity_by_velocity * spread, found.velocity_by_pull * doubt)
        scatter = float(np.std(ends))
        assert math.hypot(explained, math.sqrt(found.kinked)) > scatter
        assert found.velocity == pytest.approx(float(np.mean(ends)), abs=1.5 * scatter)
        assert abs(found.velocity_by_pull) <= T_S


def test_a_brake_that_surely_slides_has_no_stop_and_no_kink() -> None:
    for v in (12.5, -40.0):  # with the pull, and against it: 12.5 and 18 deviations from standstill
        for pull in (2e4, -2e4):
            found = move(Accelerations(pull, 2200.0, 4.7, 0.0), 5.0, math.copysign(v, v * pull), T_S, 1.0, 1.0, 1.0)
            assert (found.stopped, found.kinked) == (0.0, 0.0)
    driven = Accelerations(2e4, 2200.0, 4.7, 0.0)
    assert move(driven, 5.0, 11.5, T_S, 1.0, 1.0, 1.0).kinked > 0.0
    assert move(driven, 5.0, -300.0, T_S, 100.0, 1.0, 100.0).kinked > 0.0


def test_a_brake_that_turns_around_at_the_very_end_of_a_period_is_driven_against_friction_from_there_on() -> None:
    now = Accelerations(2e4, 2000.0, 5.0, 5e4)
    found = move(now, 50.0, -22.1765, T_S, SURE, SURE, SURE)
    assert found.velocity == pytest.approx(18.0 / 22.0 * slide(now, 50.0, -22.1765, T_S, -1.0)[1])


def test_contact_in_a_period_is_its_integral_over_the_path() -> None:
    for x, v in ((-0.2, 400.0), (0.2, -400.0), (3.0, 100.0), (-3.0, 100.0)):
        times = np.linspace(0.0, T_S, 20001)
        squeezed = np.maximum(x + v * times, 0.0)
        share, to_velocity, to_angle = contact(x, x + T_S * v, T_S, v, v)
        assert share == pytest.approx((squeezed > 0.0).mean(), abs=1e-3)
        assert to_velocity == pytest.approx(integrate.trapezoid(squeezed, times) / T_S, abs=1e-6)
        weighted = integrate.trapezoid(squeezed * (T_S - times), times) / (T_S * T_S / 2.0)
        assert to_angle == pytest.approx(weighted, abs=1e-6)
