"""Friction and clamping force at numbers of the thesis; shares and slopes are in the flow of test_extended.py."""

from __future__ import annotations

import math

import pytest

from emb_bench.brake.forces import clamping_force, decay, sliding_torque
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import load_bench

P = load_bench().brake


@pytest.mark.parametrize(
    ("speed", "expected"),
    [
        (0.0, 1.2444e-2),
        (30.0, 1.037e-2 + 2.074e-3 / math.e + 2.16e-5 * 30.0),  # the Stribeck velocity: 1/e of the static part is left
        (500.0, 1.037e-2 + 2.16e-5 * 500.0),
    ],
)
def test_the_stribeck_curve_is_that_of_figure_3_3(speed: float, expected: float) -> None:
    m = Mechanics(break_away=1.2, stribeck_velocity=30.0, stribeck_exponent=2.0)
    assert sliding_torque(m, P, speed, 0.0, decay(m, speed)) == pytest.approx(expected, rel=1e-12)


def test_the_force_is_the_cubic_of_equation_3_9() -> None:
    m = Mechanics(quadratic=0.002, cubic=2e-5)
    # k_1 x + k_2 x² + k_3 x³ in the thesis's order, at 50 rad: 1152 + 115.2 + 57.6
    assert clamping_force(m, P, 50.0, 0.0) == pytest.approx(1152.0 + 115.2 + 57.6, rel=1e-12)
