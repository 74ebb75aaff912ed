from __future__ import annotations

import itertools
import math
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.config.bench import load_bench, parse_bench, shipped_bench_text
from emb_runtime.safety.shield import LIMITED, RETURNING, Past, shield
from emb_runtime.safety.shield_design import VELOCITY_PAD, ShieldLaw, damped_excess, make_law

SHIPPED = load_bench()
AGES = [(0, 0), (0, 1), (0, 3), (1, 1), (2, 3), (3, 3)]
LAW = make_law(SHIPPED)
LAWS = [make_law(replace(SHIPPED, shield=SHIPPED.shield._replace(frame_age=ages))) for ages in AGES]

anything = st.floats(allow_nan=True, allow_infinity=True)
angles = st.floats(-15.0, 105.0)
velocities = st.floats(-550.0, 550.0)
currents = st.floats(-6.0, 6.0)


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(LAWS), anything, anything, anything, st.tuples(*[anything] * 5), st.integers(-10, 2000))
def test_whatever_comes_in_a_finite_current_within_the_limit_comes_out(
    law: ShieldLaw, angle: float, velocity: float, wanted: float, past: Past, step: int
) -> None:
    current, bits = shield(law, angle, velocity, wanted, past, step)
    assert abs(current) <= law.current
    assert bits in {0, LIMITED, RETURNING, LIMITED | RETURNING}


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


def test_every_shipped_set_can_be_shielded() -> None:
    for name, ages in itertools.product(sorted(SHIPPED.ranges), AGES):
        law = make_law(replace(SHIPPED, shield=SHIPPED.shield._replace(ranges=name, frame_age=ages)))
        assert 400.0 < law.cruise < law.homeward_speed
        assert all(math.isfinite(value) for value in law)


def test_what_a_bench_file_does_not_declare_its_brake_does_not_have() -> None:
    lines = [
        line
        for line in shipped_bench_text().splitlines()
        if line.split(" ")[0] not in {"envelope", "current_lag", "break_away", "f_l"}
    ]
    older = parse_bench("\n".join(lines), "test")
    assert older.shield == SHIPPED.shield
    assert older.identity_hash == SHIPPED.identity_hash
