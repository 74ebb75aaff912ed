from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.forces import (
    acceleration_from_rest,
    decay,
    decay_slope,
    parting_acceleration,
    sliding_share,
    sliding_slope,
    sliding_torque,
    static_torque,
)
from emb_bench.brake.parameters import BREAK_AWAY, F_L, F_V, STRIBECK_VELOCITY, T_C
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import load_bench

P = load_bench().brake
FIGURE_3_3 = Mechanics(break_away=1.2, stribeck_velocity=30.0, stribeck_exponent=2.0)

speeds = st.floats(0.5, 500.0)
forces = st.floats(0.0, 2500.0)
exponents = st.floats(1.0, 4.0)


def friction(m: Mechanics, speed: float, force: float = 0.0) -> float:
    return sliding_torque(m, P, speed, force, decay(m, speed))


def test_the_stribeck_curve_is_that_of_figure_3_3() -> None:
    assert friction(FIGURE_3_3, 0.0) == pytest.approx(1.2444e-2, rel=1e-12)
    # At the Stribeck velocity 1/e of the static part is left.
    assert friction(FIGURE_3_3, 30.0) == pytest.approx(1.037e-2 + 2.074e-3 / math.e + 2.16e-5 * 30.0, rel=1e-12)
    assert friction(FIGURE_3_3, 500.0) == pytest.approx(1.037e-2 + 2.16e-5 * 500.0, rel=1e-12)


def test_static_friction_grows_with_the_load() -> None:
    m = FIGURE_3_3._replace(f_l=2e-6)
    assert static_torque(m, P, 1000.0) == pytest.approx(1.2444e-2 + 2e-3, rel=1e-12)
    assert friction(m, 0.0, 1000.0) == pytest.approx(1.4444e-2, rel=1e-12)
    assert friction(m, 300.0, 1000.0) == pytest.approx(friction(m, 300.0), rel=1e-12)


def test_without_a_stribeck_velocity_static_friction_acts_at_rest_only() -> None:
    m = Mechanics(break_away=1.2)
    assert friction(m, 0.0) == P.T_c
    assert static_torque(m, P, 0.0) == pytest.approx(1.2444e-2, rel=1e-12)
    assert parting_acceleration(m, P, 0.0) == pytest.approx(0.2 * P.T_c / P.J, rel=1e-12)


def test_with_a_stribeck_velocity_a_brake_parts_gently() -> None:
    assert parting_acceleration(FIGURE_3_3, P, 700.0) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-0.05, 0.05), forces)
def test_a_brake_at_rest_holds_up_to_the_static_torque_and_no_more(pull: float, force: float) -> None:
    m = Mechanics(break_away=1.3, f_l=2e-6)
    found = acceleration_from_rest(m, P, pull, force)
    if abs(pull) <= static_torque(m, P, force):
        assert found == 0.0
    else:
        assert found == pytest.approx(math.copysign(abs(pull) - P.T_c, pull) / P.J, rel=1e-12)


@given(speeds, forces, exponents)
def test_friction_always_takes_energy_and_never_exceeds_its_parts(speed: float, force: float, exponent: float) -> None:
    m = Mechanics(break_away=1.5, stribeck_velocity=20.0, stribeck_exponent=exponent, f_l=5e-6)
    found = friction(m, speed, force)
    assert P.T_c + P.f_v * speed <= found <= static_torque(m, P, force) + P.f_v * speed


@settings(deadline=None)
@given(speeds, forces, exponents)
def test_slopes_and_shares_are_the_differences_of_the_torque(speed: float, force: float, exponent: float) -> None:
    m = Mechanics(break_away=1.5, stribeck_velocity=20.0, stribeck_exponent=exponent, f_l=5e-6)
    left, h = decay(m, speed), 1e-6
    scale = friction(m, speed, force)

    def close(found: float, larger: float, smaller: float, step: float) -> None:
        assert found == pytest.approx((larger - smaller) / (2 * step), rel=1e-6, abs=1e-7 * scale / (step / h))

    step = h * speed
    faster, slower = speed + step, speed - step
    close(sliding_slope(m, P, speed, force, left), friction(m, faster, force), friction(m, slower, force), step)
    close(decay_slope(m, speed, left) * scale, scale * decay(m, faster), scale * decay(m, slower), step)
    changed = {
        T_C: [(m, P._replace(T_c=P.T_c * (1 + d))) for d in (h, -h)],
        F_V: [(m, P._replace(f_v=P.f_v * (1 + d))) for d in (h, -h)],
        BREAK_AWAY: [(m._replace(break_away=m.break_away * (1 + d)), P) for d in (h, -h)],
        STRIBECK_VELOCITY: [(m._replace(stribeck_velocity=m.stribeck_velocity * (1 + d)), P) for d in (h, -h)],
        F_L: [(m._replace(f_l=m.f_l * (1 + d)), P) for d in (h, -h)],
    }
    for unknown, pair in changed.items():
        more, less = (sliding_torque(n, q, speed, force, decay(n, speed)) for n, q in pair)
        close(sliding_share(m, P, speed, force, left, unknown), more, less, h)
