from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.config.bench import Bench, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield import LIMITED, NO_PAST, RETURNING, Past, shield
from emb_runtime.safety.shield_design import VELOCITY_PAD, ShieldLaw, chatter_excess, damped_excess, make_law

SHIPPED = load_bench()
AGES = [(0, 0), (0, 1), (0, 3), (1, 1), (2, 3), (3, 3)]
LAW = make_law(SHIPPED)
LAWS = [make_law(replace(SHIPPED, shield=SHIPPED.shield._replace(frame_age=ages))) for ages in AGES]

anything = st.floats(allow_nan=True, allow_infinity=True)
angles = st.floats(-15.0, 105.0)
velocities = st.floats(-550.0, 550.0)
currents = st.floats(-6.0, 6.0)


def bench_with(*changes: tuple[str, str]) -> Bench:
    text = shipped_bench_text()
    for old, new in changes:
        assert text.count(old) >= 1
        text = text.replace(old, new)
    return parse_bench(text, "test")


def answer(law: ShieldLaw, angle: float, velocity: float, wanted: float, step: int = 0) -> tuple[float, int]:
    return shield(law, angle, velocity, wanted, NO_PAST, step)


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(LAWS), anything, anything, anything, st.tuples(*[anything] * 5), st.integers(-10, 2000))
def test_whatever_comes_in_a_finite_current_within_the_limit_comes_out(
    law: ShieldLaw, angle: float, velocity: float, wanted: float, past: Past, step: int
) -> None:
    current, bits = shield(law, angle, velocity, wanted, past, step)
    assert abs(current) <= law.current
    assert bits in {0, LIMITED, RETURNING, LIMITED | RETURNING}


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(LAWS), angles, velocities, anything, st.tuples(*[currents] * 5), st.integers(0, 499))
def test_no_bit_means_exactly_what_was_wanted_and_a_difference_has_a_bit(
    law: ShieldLaw, angle: float, velocity: float, wanted: float, past: Past, step: int
) -> None:
    current, bits = shield(law, angle, velocity, wanted, past, step)
    if bits == 0 or current != wanted:
        assert (bits == 0) == (current == wanted)


def test_far_from_every_limit_the_policy_has_its_way() -> None:
    for wanted in (-6.0, -0.1, 0.0, 2.5, 6.0):
        assert answer(LAW, 30.0, 100.0, wanted, step=50) == (wanted, 0)


def test_above_the_stopping_distance_the_answer_is_full_braking() -> None:
    assert answer(LAW, 99.0, 300.0, 6.0, step=50)[0] == -6.0
    assert answer(LAW, -9.0, -300.0, -6.0, step=50)[0] == 6.0


def test_at_the_speed_limit_the_clip_is_continuous_in_the_measurement() -> None:
    currents_there = [answer(LAW, 40.0, 480.0 + 0.01 * i, 6.0, step=20)[0] for i in range(2000)]
    assert max(abs(b - a) for a, b in itertools.pairwise(currents_there)) < 0.03
    assert min(currents_there) < 0.0 < max(currents_there)


def test_the_shipped_law_has_the_numbers_worked_by_hand() -> None:
    # (6 A · 1.085e-2 N·m/A + 5.185e-3 N·m) / 4.624e-6 kg·m²; 1.889e-5 m · 34.56 N/rad / 4.624e-6 kg·m²
    assert math.isclose(LAW.braking, 15200.04, rel_tol=1e-6)
    assert math.isclose(LAW.spring_high, 141.1848, rel_tol=1e-6)
    assert (LAW.bottom, LAW.top, LAW.outward_speed) == (-9.7, 99.7, 500.0 - VELOCITY_PAD)
    assert LAW.homeward_speed == LAW.outward_speed
    assert math.isclose(LAW.angle_noise, 6e-3)
    assert math.isclose(LAW.velocity_noise, 6.0)
    # From 60 rad/s with 234.6453/s times the speed and 1121.3235 rad/s² of friction, against 15200.04 rad/s².
    by_hand = 60 / 234.645329 - 1121.32353 / 234.645329**2 * math.log(15200.04325 / 1121.32353)
    by_hand += -(60**2) / (2 * 15200.04325) + 60e-3 / 2
    excess = damped_excess(LAW.motor_low, LAW.friction_low, 6.0, 60.0, 1e-3)
    assert math.isclose(excess, by_hand, rel_tol=1e-6)
    assert math.isclose(excess, 0.1142, abs_tol=5e-5)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 400.0), st.floats(1000.0, 20000.0))
def test_the_damped_stop_needs_no_more_beyond_full_braking_than_the_excess(speed: float, friction: float) -> None:
    # An independent count: sampled steps of both stops of the weakest brake.
    def distance(v: float, damped: bool) -> float:
        x = 0.0
        while v > 0.0:
            share = min(1.0, v / LAW.damping_velocity) if damped else 1.0
            x += 1e-3 * v
            v -= 1e-3 * (share * LAW.motor_low * 6.0 + friction)
        return x

    full = LAW.motor_low * 6.0 + friction
    allowed = speed * speed / (2.0 * full) + speed * 0.5e-3
    excess = damped_excess(LAW.motor_low, LAW.friction_low, 6.0, LAW.damping_velocity, 1e-3)
    assert distance(speed, damped=True) <= allowed + excess
    assert distance(speed, damped=False) <= allowed + full * 1e-6 / 8.0 + 1e-12


def test_every_shipped_set_can_be_shielded() -> None:
    for name, ages in itertools.product(sorted(SHIPPED.ranges), AGES):
        law = make_law(replace(SHIPPED, shield=SHIPPED.shield._replace(ranges=name, frame_age=ages)))
        assert 400.0 < law.cruise < law.homeward_speed
        assert all(math.isfinite(value) for value in law)


UNREADABLE = [
    ("current_lag   = 0.0", "current_lag   = -1e-3", "shield.current_lag: expected a number from 0 to 0.1"),
    ("current_lag   = 0.0", "current_lag   = 0.2", "shield.current_lag: expected a number from 0 to 0.1"),
    ("break_away    = 1.0", "break_away    = 0.9", "shield.break_away: expected a number from 1 to 5"),
    ("f_l           = 0.0", "f_l           = 2.0e-4", "shield.f_l: expected a number from 0 to 0.0001"),
    ('envelope      = "braking"', 'envelope      = "gliding"', "shield.envelope: expected one of braking, coasting"),
    ("f_l           = 0.0", "f_k           = 0.0", r"shield.f_k: unknown key; expected some of .*break_away.* f_l,"),
]


@pytest.mark.parametrize(("old", "new", "reason"), UNREADABLE)
def test_a_bound_that_makes_no_sense_is_refused_with_its_key(old: str, new: str, reason: str) -> None:
    with pytest.raises(BenchFileError, match=reason):
        bench_with((old, new))


def test_what_a_bench_file_does_not_declare_its_brake_does_not_have() -> None:
    lines = [
        line
        for line in shipped_bench_text().splitlines()
        if line.split(" ")[0] not in {"envelope", "current_lag", "break_away", "f_l"}
    ]
    older = parse_bench("\n".join(lines), "test")
    assert older.shield == SHIPPED.shield
    assert older.identity_hash == SHIPPED.identity_hash


def test_friction_beyond_coulombs_widens_only_the_upper_bound_of_friction() -> None:
    law = make_law(bench_with(("break_away    = 1.0", "break_away    = 1.2"), ("f_l           = 0.0", "f_l = 2.0e-6")))
    # (1.2 · 1.5555e-2 N·m + 2e-6 m · 34.56 N/rad · 100 rad) / 4.624e-6 kg·m²
    assert math.isclose(law.friction_high, (1.2 * 1.5555e-2 + 2e-6 * 34.56 * 100.0) / 4.624e-6)
    assert law.friction_low == LAW.friction_low
    assert law.braking == LAW.braking


def test_the_apex_of_the_coasting_envelope_is_the_one_worked_by_hand() -> None:
    law = make_law(
        bench_with(
            ('envelope      = "braking"', 'envelope = "coasting"'), ("angle_margin  = 0.3", "angle_margin = 1.1")
        )
    )
    # 6 rad/s of noise, 0.3 of pad, and what the strongest motor's surplus leaves between 3364 and 1121 rad/s² in 1 ms
    slow = 3.0 * (6.0 + 0.3 + 1e-3 * (3.0 * 3363.970588 - 1121.323529))
    left = 1121.323529 * (law.apex + 8.9) - 141.184775 * law.apex**2 / 2.0
    assert math.isclose(left, slow**2 / 2.0, rel_tol=1e-6)
    assert math.isclose(law.homeward_speed, math.sqrt(2.0 * 1121.323529 * 8.9), rel_tol=1e-6)


def test_the_margin_that_is_asked_for_is_enough() -> None:
    needed = damped_excess(LAW.motor_low, LAW.friction_low, 6.0, 60.0, 1e-3)
    needed += chatter_excess(LAW.friction_low, LAW.friction_high, 1e-3) + 0.005
    assert math.isclose(needed, 0.1343, abs_tol=1e-4)
    make_law(bench_with(("angle_margin  = 0.3", f"angle_margin  = {needed + 1e-6}")))
    with pytest.raises(BenchFileError, match="angle_margin"):
        make_law(bench_with(("angle_margin  = 0.3", f"angle_margin  = {needed - 1e-6}")))


def test_a_short_free_stroke_lowers_the_homeward_speed_so_that_it_can_still_be_stopped() -> None:
    law = make_law(bench_with(("angle    = [-10.0, 100.0]", "angle    = [-4.0, 100.0]")))
    assert law.homeward_speed < 330.0
    x, v = 0.0, -law.homeward_speed
    while v < 0.0:
        x, v = x + 1e-3 * v, v + 1e-3 * law.braking
    assert x >= law.bottom
    assert x < law.bottom + 0.4


def test_at_the_end_the_brake_is_brought_home_whatever_the_policy_wants() -> None:
    assert answer(LAW, 0.0, 0.0, 6.0, step=499) == (0.0, RETURNING)
    current, bits = answer(LAW, 60.0, 100.0, 6.0, step=300)
    assert (current, bits) == (-6.0, RETURNING)
    assert answer(LAW, 60.0, 100.0, 6.0, step=100) == (6.0, 0)
