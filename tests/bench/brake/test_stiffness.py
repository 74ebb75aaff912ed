from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.brake.forces import clamping_force, clamping_share, clamping_slopes, edge_ahead, stop_rate
from emb_bench.brake.parameters import CONTACT, CUBIC, HYSTERESIS, K_1, K_M, PLAY, QUADRATIC
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import load_bench

P = load_bench().brake
CURVED = Mechanics(quadratic=0.002, cubic=2e-5, hysteresis=0.05, hysteresis_travel=1.0)

angles = st.floats(0.1, 100.0)
positions = st.floats(-1.0, 1.0)


def test_the_force_is_the_cubic_of_equation_3_9() -> None:
    m = Mechanics(quadratic=0.002, cubic=2e-5)
    # k_1 x + k_2 x² + k_3 x³ in the thesis's order, at 50 rad: 1152 + 115.2 + 57.6
    assert clamping_force(m, P, 50.0, 0.0) == pytest.approx(1152.0 + 115.2 + 57.6, rel=1e-12)


def test_without_features_the_force_is_linear_and_zero_at_contact() -> None:
    assert clamping_force(Mechanics(), P, 50.0, 0.0) == P.k_1 * 50.0
    assert clamping_force(CURVED, P, 0.0, 1.0) == 0.0


@given(angles)
def test_the_hysteresis_moves_the_force_up_and_down_by_its_share(x1: float) -> None:
    middle = clamping_force(CURVED, P, x1, 0.0)
    assert clamping_force(CURVED, P, x1, 1.0) == pytest.approx(1.05 * middle, rel=1e-12)
    assert clamping_force(CURVED, P, x1, -1.0) == pytest.approx(0.95 * middle, rel=1e-12)


@given(angles, positions)
def test_slopes_and_shares_are_the_differences_of_the_force(x1: float, w: float) -> None:
    h = 1e-6
    scale = clamping_force(CURVED, P, x1, w)

    def close(found: float, larger: float, smaller: float, step: float = h) -> None:
        assert found == pytest.approx((larger - smaller) / (2 * step), rel=1e-6, abs=1e-8 * scale * h / step)

    along, across = clamping_slopes(CURVED, P, x1, w)
    step = h * x1
    close(along, clamping_force(CURVED, P, x1 + step, w), clamping_force(CURVED, P, x1 - step, w), step)
    close(across, clamping_force(CURVED, P, x1, w + h), clamping_force(CURVED, P, x1, w - h))
    assert clamping_share(CURVED, P, x1, w, CONTACT) == -along
    assert clamping_share(CURVED, P, x1, w, K_1) == scale
    assert clamping_share(CURVED, P, x1, w, K_M) == 0.0
    for unknown, name in ((QUADRATIC, "quadratic"), (CUBIC, "cubic"), (HYSTERESIS, "hysteresis")):
        ends = [CURVED._replace(**{name: getattr(CURVED, name) * (1 + d)}) for d in (h, -h)]
        close(clamping_share(CURVED, P, x1, w, unknown), *(clamping_force(m, P, x1, w) for m in ends))


@given(angles, positions)
def test_with_play_the_force_is_that_of_the_clamp_which_lags(x1: float, w: float) -> None:
    without, m = CURVED._replace(hysteresis=0.0), CURVED._replace(hysteresis=0.0, play=2.0)
    lag, clamp = 0.05 * w, x1 - 0.05 * w
    assert clamping_force(m, P, x1, lag) == clamping_force(without, P, clamp, 0.0)
    along = clamping_slopes(without, P, clamp, 0.0)[0]
    assert clamping_slopes(m, P, x1, lag) == (along, -along)
    for unknown in (K_1, QUADRATIC, CUBIC, CONTACT, HYSTERESIS, PLAY):
        assert clamping_share(m, P, x1, lag, unknown) == clamping_share(without, P, clamp, 0.0, unknown)


def test_the_stop_follows_the_angle_until_it_saturates_and_leaves_saturation_when_the_motion_turns() -> None:
    m = Mechanics(hysteresis=0.1, hysteresis_travel=2.0)
    assert stop_rate(m, 0.3, 1.0) == stop_rate(m, 0.3, -1.0) == 0.5
    assert (stop_rate(m, 1.0, 1.0), stop_rate(m, 1.0, -1.0)) == (0.0, 0.5)
    assert (stop_rate(m, -1.0, -1.0), stop_rate(m, -1.0, 1.0)) == (0.0, 0.5)
    assert stop_rate(Mechanics(), 0.0, 1.0) == 0.0


def test_the_clamp_stays_within_the_play_and_follows_beyond_it() -> None:
    m = Mechanics(play=3.0)
    assert stop_rate(m, 0.3, 1.0) == stop_rate(m, 1.5, -1.0) == stop_rate(m, -1.5, 1.0) == 1.0
    assert stop_rate(m, 1.5, 1.0) == stop_rate(m, -1.5, -1.0) == 0.0


@pytest.mark.parametrize(
    ("x1", "w", "direction", "edge"),
    [
        (5.0, 0.5, 1.0, 6.0),  # the clearance ends
        (5.0, 0.5, -1.0, 3.0),
        (5.0, 1.5, 1.0, math.inf),
        (5.0, -1.5, -1.0, -1.5),  # contact is left, the clamp ahead of the motor
        (-5.0, 1.5, 1.0, 1.5),  # contact is made, the clamp behind
        (-5.0, -1.5, -1.0, -math.inf),
        (1.5, 1.5, 1.0, math.inf),
        (-1.5, -1.5, -1.0, -math.inf),
    ],
)
def test_with_play_the_law_ends_where_the_clamp_is_taken_along_or_comes_to_contact(
    x1: float, w: float, direction: float, edge: float
) -> None:
    assert edge_ahead(Mechanics(play=3.0), x1, w, direction) == edge


@pytest.mark.parametrize(
    ("x1", "w", "direction", "edge"),
    [
        (-2.0, 0.0, 1.0, 0.0),
        (-2.0, 0.0, -1.0, -math.inf),
        (0.0, 0.0, -1.0, -math.inf),
        (5.0, 0.5, 1.0, 6.0),
        (5.0, 1.0, 1.0, math.inf),
        (5.0, 0.5, -1.0, 2.0),
        (1.0, 0.5, -1.0, 0.0),
        (5.0, -1.0, -1.0, 0.0),
    ],
)
def test_the_law_ends_at_contact_or_where_the_stop_saturates(
    x1: float, w: float, direction: float, edge: float
) -> None:
    assert edge_ahead(Mechanics(hysteresis=0.1, hysteresis_travel=2.0), x1, w, direction) == edge


def test_a_closed_loop_in_saturation_encloses_the_area_of_its_share() -> None:
    # 2·hysteresis·∫F dx between the branches, without the two turns; the linear brake has ∫F dx = k_1 (b² − a²)/2.
    m = Mechanics(hysteresis=0.1)
    x = np.linspace(10.0, 40.0, 2001)
    branches = [np.array([clamping_force(m, P, v, w) for v in x]) for w in (1.0, -1.0)]
    assert np.trapezoid(branches[0] - branches[1], x) == pytest.approx(0.1 * P.k_1 * (40.0**2 - 10.0**2), rel=1e-9)
