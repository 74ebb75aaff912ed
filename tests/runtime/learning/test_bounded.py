"""What is surely possible, against a simulator of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import step as euler_step
from emb_runtime.config.bench import BrakeParameters, load_bench
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.bounded import CENTRE, SHAPE, _cut_ellipsoid, hear, lose, start
from emb_runtime.learning.known import FALSIFIED, Known, known
from tests.properties.shield_search import fine_piece

BENCH = load_bench()
SET = BENCH.range_set("envelope")
PIECE = 5e-6
"""Of the independent simulator [s]: within a piece the acceleration is constant, which is off by less than 1 rad/s²."""
SHARES = st.tuples(*[st.floats(0.0, 1.0)] * 4)


def assumed(model: str, model_error: float = 0.0) -> Assumptions:
    shield = BENCH.shield._replace(
        learn=True, model="euler" if model == "euler" else "flow", model_error=model_error, current_error=0.0
    )
    return make_assumptions(replace(BENCH, shield=shield))


def brake_at(shares: tuple[float, float, float, float]) -> BrakeParameters:
    low, high = SET.low, SET.high
    k_m, k_1, t_c, f_v = (a + s * (b - a) for a, b, s in zip(low[2:], high[2:], shares, strict=True))
    return BrakeParameters(low.J, low.gamma, k_m, k_1, t_c, f_v)


def next_state(model: str, p: BrakeParameters, x: float, v: float, u: float) -> tuple[float, float]:
    if model == "euler":
        return euler_step(p, x, v, u, 1e-3)
    for _ in range(round(1e-3 / PIECE)):
        x, v = fine_piece(p, x, v, u, PIECE)
    return x, v


def holds(now: Known, p: BrakeParameters, x: float, v: float) -> bool:
    n = BENCH.brake
    true = (p.k_m / n.k_m, p.k_1 / n.k_1, p.T_c / n.T_c, p.f_v / n.f_v)
    low = (now.k_m_low, now.k_1_low, now.t_c_low, now.f_v_low)
    high = (now.k_m_high, now.k_1_high, now.t_c_high, now.f_v_high)
    inside = all(a <= b <= c for a, b, c in zip(low, true, high, strict=True))
    return inside and now.angle_low <= x <= now.angle_high and now.velocity_low <= v <= now.velocity_high


@pytest.mark.parametrize("model", ["euler", "flow"])
@settings(max_examples=25)
@given(
    shares=SHARES,
    plan=st.lists(st.tuples(st.floats(-6.0, 6.0), st.integers(1, 40)), min_size=1, max_size=6),
    signs=st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=30),
    gap=st.integers(3, 200),
)
def test_whatever_moves_the_brake_and_errs_within_bounds_the_truth_stays_possible(
    model: str,
    shares: tuple[float, float, float, float],
    plan: list[tuple[float, int]],
    signs: list[tuple[float, float]],
    gap: int,
) -> None:
    a = assumed(model, model_error=1.0)
    p, state = brake_at(shares), start(a)
    x = v = u = 0.0
    k = 0
    for wanted, periods in plan:
        for _ in range(periods):
            y, w = signs[k % len(signs)]
            if k % gap == gap - 1:
                lose(a, state)
            else:
                hear(a, state, x + y * a.angle_noise, v + w * a.velocity_noise, u)
                now = known(state)
                assert not now.falsified
                assert holds(now, p, x, v)
            u = wanted if abs(v) < 450.0 else -math.copysign(6.0, v)
            x, v = next_state(model, p, x, v, u)
            k += 1


@settings(max_examples=200)
@given(
    seed=st.integers(0, 2**32 - 1),
    strip=st.tuples(*[st.floats(-3.0, 3.0)] * 4),
    middle=st.floats(-1.2, 1.2),
    half=st.floats(0.0, 1.0),
)
def test_what_is_in_the_ellipsoid_and_in_the_strip_is_in_the_ellipsoid_that_is_cut(
    seed: int, strip: tuple[float, float, float, float], middle: float, half: float
) -> None:
    a = assumed("flow")
    state, rng = start(a), np.random.default_rng(seed)
    factor = rng.normal(size=(4, 4)) * 0.05
    centre, shape = 1.0 + 0.05 * rng.normal(size=4), factor @ factor.T
    state[CENTRE : CENTRE + 4] = centre.tolist()
    state[SHAPE : SHAPE + 10] = shape[np.triu_indices(4)].tolist()
    phi = np.array(strip)
    reach = math.sqrt(phi @ shape @ phi)
    assume(reach > 1e-3)
    low, high = phi @ centre + reach * (middle - half), phi @ centre + reach * (middle + half)
    directions = rng.normal(size=(4, 2000))
    points = centre[:, None] + factor @ (directions / np.linalg.norm(directions, axis=0) * rng.random(2000) ** 0.25)
    kept = points[:, (phi @ points >= low) & (phi @ points <= high)]
    _cut_ellipsoid(state, *strip, float(low), float(high))
    if state[FALSIFIED]:
        assert kept.shape[1] == 0
        return
    cut = np.zeros((4, 4))
    cut[np.triu_indices(4)] = state[SHAPE : SHAPE + 10]
    cut = cut + np.triu(cut, 1).T
    off = kept - np.array(state[CENTRE : CENTRE + 4])[:, None]
    assert np.all(np.sum(off * np.linalg.solve(cut, off), axis=0) <= 1.0 + 1e-6)
    assert np.linalg.det(cut) <= np.linalg.det(shape) * (1.0 + 1e-6)
