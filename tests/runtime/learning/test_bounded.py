"""The bounded currency: what is surely possible, against a simulator of its own."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.bounded import hear, lose, start
from emb_runtime.learning.known import known

BENCH = load_bench()


def assumed(model: str) -> Assumptions:
    return make_assumptions(replace(BENCH, shield=replace(BENCH.shield, learn="bounded", model=model)))


def test_before_the_first_sample_the_set_is_the_one_known_beforehand() -> None:
    a = assumed("flow")
    now = known(a, start(a))
    assert (now.k_m_low, now.k_1_low, now.t_c_low, now.f_v_low) == a.low
    assert (now.k_m_high, now.k_1_high, now.t_c_high, now.f_v_high) == a.high
    assert not now.falsified


@pytest.mark.parametrize("model", ["euler", "flow"])
def test_a_motion_that_no_brake_of_the_set_can_have_is_an_assumption_that_is_false(model: str) -> None:
    a = assumed(model)
    state = start(a)
    hear(a, state, 0.0, 0.0, 0.0)
    hear(a, state, 0.0, 100.0, 0.0)
    now = known(a, state)
    assert now.falsified
    assert (now.k_m_low, now.k_m_high) == (a.low[0], a.high[0])
    assert (now.velocity_low, now.velocity_high) == (100.0 - a.velocity_noise, 100.0 + a.velocity_noise)


@pytest.mark.parametrize("model", ["euler", "flow"])
def test_after_a_lost_period_any_current_may_have_acted(model: str) -> None:
    a = assumed(model)
    state = start(a)
    hear(a, state, 0.0, 0.0, 0.0)
    lose(a, state)
    now = known(a, state)
    assert now.velocity_high > 0.9 * a.sample_time * a.motor * a.current * a.high[0]
    assert now.velocity_low < -0.9 * a.sample_time * a.motor * a.current * a.high[0]
