"""What is known of a brake, and the law of the part of the set that it leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from emb_bench.compiled import compiled
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, load_bench
from emb_runtime.learning.assumptions import make_assumptions
from emb_runtime.learning.known import FALSIFIED, HEAD, HEARD, Known, falsify, known, numbers, start_head
from emb_runtime.learning.law import covered_viscous, farthest, fits, law_between, law_for, middle, with_room
from emb_runtime.safety.shield_design import (
    VELOCITY_PAD,
    DesignInputs,
    Part,
    ShieldLaw,
    design_inputs,
    law_of,
    make_law,
)

BENCH = load_bench()
SET = BENCH.range_set("envelope")


def learning(bench: Bench = BENCH, model_error: float = 0.0) -> Bench:
    return replace(bench, shield=bench.shield._replace(learn=True, model_error=model_error))


def of(low: BrakeParameters, high: BrakeParameters, model_error: float = 0.0) -> ShieldLaw:
    law: ShieldLaw = compiled(law_between)(design_inputs(learning(model_error=model_error)), low, high, 0.006, 6.0)
    return law


def change_of_viscous_friction(law: ShieldLaw, viscous: float) -> float:
    """Part of it that the velocity pad has to cover, within a sample of full braking at the limits (L1) [rad/s]."""
    slowed = law.braking + law.spring_low * BENCH.limits.angle[1] + viscous * BENCH.limits.velocity
    return 0.5 * law.sample_time**2 * viscous * slowed


def test_a_part_counts_on_viscous_friction_as_far_as_the_pad_covers_its_change() -> None:
    setting, law = design_inputs(BENCH), of(SET.high, SET.high)
    assert change_of_viscous_friction(law, SET.high.f_v / SET.high.J) > VELOCITY_PAD
    assert 0.9 * VELOCITY_PAD < change_of_viscous_friction(law, law.viscous_low) <= VELOCITY_PAD
    assert law.viscous_low == pytest.approx(covered_viscous(setting, SET.high, SET.high) / SET.high.J)
    assert law.viscous_high == SET.high.f_v / SET.high.J
    assert covered_viscous(setting, SET.low, SET.high) == SET.low.f_v


def test_a_law_is_asked_with_the_middle_of_the_box_and_its_noise_holds_the_whole_box_rounding_or_not() -> None:
    """In floats the middle is not always as far from one end as from the other: the farther one counts."""
    setting, n = design_inputs(BENCH), BENCH.brake
    shares = (getattr(end, p) / getattr(n, p) for p in PARAMETER_NAMES for end in (SET.low, SET.high))
    everything = Known._make([*shares, 0.0, 0.0, 0.0, 0.0, False])
    dice, uneven = np.random.default_rng(0), 0
    for _ in range(300):
        x, v, half, wide = dice.uniform(-9.0, 99.0), dice.uniform(-499.0, 499.0), *(10.0 ** dice.uniform(-14, -2, 2))
        box = everything._replace(angle_low=x, angle_high=x + half, velocity_low=v, velocity_high=v + wide)
        (angle, velocity), law = middle(box), law_for(setting, n, box)
        ends = [
            box.angle_high - angle,
            angle - box.angle_low,
            box.velocity_high - velocity,
            velocity - box.velocity_low,
        ]
        uneven += ends[0] != ends[1] and ends[2] != ends[3]
        assert (law.angle_noise, law.velocity_noise) == (max(ends[:2]), max(ends[2:]))
        assert fits(law, box)
        assert fits(law._replace(angle_noise=min(ends[:2])), box) == (ends[0] == ends[1])
        assert fits(law._replace(velocity_noise=min(ends[2:])), box) == (ends[2] == ends[3])
        outside: tuple[dict[str, float], ...] = (
            {"angle_high": x + 2.0 * half + 1e-12},
            {"angle_low": x - half - 1e-12},
            {"velocity_high": v + 2.0 * wide + 1e-11},
            {"velocity_low": v - wide - 1e-11},
        )
        for changed in outside:
            assert not fits(law, Known(**{**box._asdict(), **changed}))
        roomy = with_room(setting, box)
        assert roomy.angle_low <= angle - setting.angle_noise
        assert roomy.angle_high >= angle + setting.angle_noise
    assert uneven > 50


def test_a_box_as_wide_as_the_measurement_stays_as_wide_and_a_wider_one_is_not_cut() -> None:
    setting, rounding = design_inputs(BENCH), 1e-6
    a, n = setting.angle_noise, setting.velocity_noise
    box = Known._make([*[1.0] * 8, -a, a, -n, n, False])
    assert with_room(setting, box)[8:12] == pytest.approx(
        (-a * (1 + rounding), a * (1 + rounding), -n * (1 + rounding), n * (1 + rounding)), rel=1e-12
    )
    wide = box._replace(angle_low=-2 * a, angle_high=2 * a, velocity_low=-2 * n, velocity_high=2 * n)
    assert with_room(setting, wide) == wide
    narrow = box._replace(velocity_low=-1.0, velocity_high=1.0)
    assert with_room(setting, narrow)[10:12] == pytest.approx((-1.1, 1.1), rel=1e-12)


def held_up_to(setting: DesignInputs, low: BrakeParameters, high: BrakeParameters) -> float:
    """L5 (d) by the definition: where the damped stop at V_down, or full braking, is 95 % of the stiffest spring."""
    m, d = setting.current * low.k_m / high.J, low.T_c / high.J - setting.model_error
    t, room = setting.sample_time, -setting.lowest_angle - setting.shield.angle_margin
    # The sample before still moves at that speed: v²/2A + 3 v t/2 = room.
    a = m + d
    stopped = float(max(np.roots([0.5 / a, 1.5 * t, -room]).real))
    v = min(setting.speed - VELOCITY_PAD, stopped)
    braking = m * min(1.0, v / setting.damping_velocity) + d + low.f_v / high.J * v
    return float(0.95 * braking * low.J / (high.gamma * high.k_1))


@pytest.mark.parametrize("error", [0.0, 300.0])
@pytest.mark.parametrize("change", [{}, {"speed": 900.0}, {"damping_velocity": 700.0}])
@pytest.mark.parametrize("margin", [0.3, 9.0])
def test_a_law_reaches_as_far_as_the_weakest_motor_holds_the_stiffest_spring(
    error: float, margin: float, change: dict[str, Any]
) -> None:
    setting = design_inputs(learning(model_error=error))
    setting = setting._replace(shield=setting.shield._replace(angle_margin=margin), **change)
    low, high = (
        SET.low._replace(J=0.9 * SET.low.J),
        SET.high._replace(k_1=3.0 * SET.high.k_1, gamma=1.1 * SET.high.gamma),
    )
    assert farthest(setting, low, high) == pytest.approx(held_up_to(setting, low, high), rel=1e-9)
    assert farthest(setting, SET.low, SET.low._replace(k_1=1e-3)) == setting.highest_angle


def test_the_plan_of_the_way_home_leaves_a_fifth_of_what_the_weakest_motor_reaches() -> None:
    bench = learning(model_error=100.0)
    setting = design_inputs(replace(bench, shield=bench.shield._replace(break_away=1.3)))
    low, high = SET.low, SET.high._replace(J=1.2 * SET.high.J, f_v=40.0 * SET.high.f_v)
    driving = setting.current * low.k_m / high.J - 1.3 * high.T_c / low.J - setting.model_error
    least = low._replace(f_v=covered_viscous(setting, low, high))
    part = Part(farthest(setting, low, high), 0.8 * driving * low.J / high.f_v, 0.006, 6.0)
    law = law_between(setting, low, high, 0.006, 6.0)
    assert law == pytest.approx(law_of(setting, least, high, part), rel=1e-12)
    assert law.cruise == pytest.approx(part.planned_speed)
    assert part.planned_speed < 0.5 * setting.speed
    thin = high._replace(f_v=1e-2 * high.f_v)  # of which no speed within the limit takes a fifth
    assert law_between(setting, low, thin, 0.006, 6.0).cruise < setting.speed


# --- what is known ----------------------------------------------------------------------------------------------------


def test_what_is_known_are_the_numbers_of_the_head_by_name_and_for_the_log_in_order() -> None:
    """Least four at 2, greatest four at 6, the box of states at 10; contradicted or not at 1."""
    head = [5.0, 0.0, 0.1, 0.2, 0.3, 0.4, 1.1, 1.2, 1.3, 1.4, -2.0, 2.0, -30.0, 30.0]
    now = known(head)
    assert now == (0.1, 1.1, 0.2, 1.2, 0.3, 1.3, 0.4, 1.4, -2.0, 2.0, -30.0, 30.0, False)
    assert Known._fields[:4] == ("k_m_low", "k_m_high", "k_1_low", "k_1_high")
    assert Known._fields[4:8] == ("t_c_low", "t_c_high", "f_v_low", "f_v_high")
    assert numbers(now, 7) == (0.1, 1.1, 0.2, 1.2, 0.3, 1.3, 0.4, 1.4, -2.0, 2.0, -30.0, 30.0, 7.0)
    assert known([*head[:1], 1.0, *head[2:]]) == now._replace(falsified=True)
    assert len(head) == HEAD  # where the numbers of the learner begin


def test_a_contradiction_is_the_set_known_beforehand_around_the_newest_sample() -> None:
    assumptions = make_assumptions(BENCH)
    state = [9.0] * HEAD
    falsify(assumptions, state, 3.0, 40.0)
    assert (state[HEARD], state[FALSIFIED]) == (0.0, 1.0)
    now = known(state)
    assert now[0:8:2] == assumptions.low
    assert now[1:8:2] == assumptions.high
    assert now[8:] == pytest.approx((2.994, 3.006, 34.0, 46.0, True), rel=1e-12)
    start_head(assumptions, state)
    assert state[:10] == [0.0, 0.0, *assumptions.low, *assumptions.high]


def test_before_anything_is_heard_of_the_brake_the_law_is_the_benchs_compiled_or_not() -> None:
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    start_head(assumptions, state)
    assert not known(state).falsified
    falsify(assumptions, state, 3.0, 40.0)
    found = known(state)
    assert found.falsified
    assert middle(found) == pytest.approx((3.0, 40.0))
    for function in (law_for, compiled(law_for)):
        law = function(design_inputs(BENCH), BENCH.brake, found)
        assert law == pytest.approx(make_law(BENCH), rel=1e-12)


def test_a_law_is_kept_while_the_possible_states_fit_into_its_noise_and_it_serves_a_part_of_its_set() -> None:
    setting = design_inputs(BENCH)
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    falsify(assumptions, state, 3.0, 40.0)
    whole = known(state)
    part = whole._replace(angle_low=2.999, angle_high=3.0, velocity_low=39.0, velocity_high=41.0)
    law = law_for(setting, BENCH.brake, with_room(setting, part))
    assert law.velocity_noise == pytest.approx(1.1)
    assert law.angle_noise == pytest.approx(setting.angle_noise)
    assert fits(law, part)
    assert fits(law, part._replace(velocity_low=50.0, velocity_high=52.19, angle_high=3.01))
    assert not fits(law, part._replace(velocity_high=41.3))
    assert not fits(law, part._replace(angle_high=3.0131))
    wide = law_for(setting, BENCH.brake, with_room(setting, whole))  # never beyond the measurement's noise
    assert (wide.angle_noise, wide.velocity_noise) == pytest.approx((setting.angle_noise, setting.velocity_noise))
    assert fits(wide, whole)
