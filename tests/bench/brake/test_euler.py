"""The Euler brake beside torch's autograd; each brake is moved by its own solver."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from emb_bench.brake.euler import advance_euler, sensitivity_step, sign, step, stiffness
from emb_bench.brake.exact import advance_exact
from emb_bench.brake.extended import advance_extended
from emb_bench.brake.motion import SENSITIVE, STATES, Floats, advance, no_sensitivity, rest
from emb_bench.brake.parameters import FEATURES as NAMED
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.plants import DIRECTED, EULER, EXACT, Mechanics
from emb_runtime.config.bench import load_bench

NOMINAL = load_bench().brake
T_S = 1e-3

angles = st.floats(-10.0, 100.0)
velocities = st.floats(-500.0, 500.0)
currents = st.floats(-6.0, 6.0)


def test_zero_velocity_has_no_sign_and_zero_angle_is_in_contact() -> None:
    assert (sign(0.0), sign(-0.0), sign(5e-324), sign(-5e-324)) == (0.0, 0.0, 1.0, -1.0)
    assert stiffness(NOMINAL, 0.0) == NOMINAL.gamma * NOMINAL.k_1
    assert stiffness(NOMINAL, -5e-324) == 0.0


def test_a_state_that_is_not_a_number_stays_one() -> None:
    assert all(math.isnan(v) for v in step(NOMINAL, math.nan, math.nan, 0.0, T_S))
    assert math.isnan(step(NOMINAL, 1.0, 1.0, math.nan, T_S)[1])


def autograd_step(x: torch.Tensor, theta: torch.Tensor, u: float) -> torch.Tensor:
    """Eq. 3.12-3.14 and 4.1 once more, written for torch; theta is relative to the nominal brake."""
    k_m, k_1, t_c, f_v = theta * torch.tensor([NOMINAL.k_m, NOMINAL.k_1, NOMINAL.T_c, NOMINAL.f_v], dtype=torch.float64)
    clamping = torch.where(x[0] >= 0, k_1 * x[0], torch.zeros_like(x[0]))
    friction = t_c * torch.sign(x[1]) + f_v * x[1]
    change = torch.stack([x[1], (k_m * u - NOMINAL.gamma * clamping - friction) / NOMINAL.J])
    return x + T_S * change


@settings(deadline=None)  # the first call loads torch's autograd
@given(st.lists(currents, min_size=1, max_size=25), angles, velocities)
def test_sensitivities_are_those_of_torch_autograd_along_any_trajectory(
    inputs: list[float], x1: float, x2: float
) -> None:
    theta = torch.ones(4, dtype=torch.float64)
    state = torch.tensor([x1, x2], dtype=torch.float64)
    expected = torch.zeros(2, 4, dtype=torch.float64)
    found = [(0.0, 0.0)] * 4
    for u in inputs:
        by_state, by_theta = torch.autograd.functional.jacobian(  # type: ignore[no-untyped-call]
            lambda x, th, u=u: autograd_step(x, th, u), (state, theta)
        )
        expected = by_state @ expected + by_theta
        state = autograd_step(state, theta, u)
        found = [sensitivity_step(NOMINAL, x1, x2, u, T_S, *s, i) for i, s in enumerate(found)]
        x1, x2 = step(NOMINAL, x1, x2, u, T_S)
        assert (x1, x2) == pytest.approx(state.tolist(), rel=1e-11, abs=1e-11)
        # what autograd sees hangs on the side of contact and the sign, which rounding may decide otherwise at zero
        x1, x2 = state.tolist()
    torch.testing.assert_close(torch.tensor(found, dtype=torch.float64).T, expected, rtol=1e-10, atol=1e-12)


BENCH = load_bench()
P = BENCH.brake
NAMES = ("k_m", "k_1", "x1_0")
FEATURES = {
    "break_away": 1.2,
    "stribeck_velocity": 30.0,
    "f_l": 1e-6,
    "quadratic": 0.001,
    "cubic": 1e-5,
    "hysteresis": 0.1,
    "current_lag": 0.002,
    "play": 0.3,
    "viscous_asymmetry": -0.2,
}


def start() -> Floats:
    return np.array([5.0, 20.0, 0.0, 1.0])


def advance_directed(m: Mechanics, p: Any, x: Floats, u: float, t_s: float, chosen: Any, s: Floats) -> None:
    advance_exact(p, x, u, t_s, chosen, s, m.viscous_asymmetry)


def moved(m: Mechanics) -> tuple[Floats, Floats]:
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    advance(m, P, x, 2.0, T_S, chosen, s)
    return x, s


def with_feature(name: str) -> Mechanics:
    return Mechanics(**(Mechanics(EXACT)._asdict() | {name: FEATURES[name]}))


@pytest.mark.parametrize(
    ("m", "solver"),
    [
        (Mechanics(EULER), lambda _, *arguments: advance_euler(*arguments)),
        (Mechanics(EXACT), lambda _, *arguments: advance_exact(*arguments)),
        *((with_feature(name), advance_extended) for name in FEATURES if name != DIRECTED),
        (with_feature(DIRECTED), advance_directed),
        (Mechanics(EXACT, tolerance=1e-11), lambda _, *arguments: advance_exact(*arguments)),
    ],
)
def test_each_brake_is_moved_by_its_own_solver(m: Mechanics, solver: Callable[..., None]) -> None:
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    solver(m, P, x, 2.0, T_S, chosen, s)
    assert_array_equal(moved(m)[0], x)
    assert_array_equal(moved(m)[1], s)


def test_friction_by_direction_has_the_sensitivities_of_central_differences() -> None:
    """Over turns of the motion, each way of which has a viscous friction of its own."""

    def run(asymmetry: float, names: tuple[str, ...] = ()) -> tuple[Floats, Floats]:
        x, (chosen, s), seen = start(), no_sensitivity(names), []
        for k in range(60):
            current = 2.0 if k % 20 < 10 else -2.0
            advance(Mechanics(EXACT, viscous_asymmetry=asymmetry), P, x, current, T_S, chosen, s)
            seen.append(x[:2].copy())
        return np.array(seen), s

    (_, s), step = run(0.3, ("viscous_asymmetry", "f_v")), 1e-6
    difference = (run(0.3 + step)[0][-1] - run(0.3 - step)[0][-1]) / (2.0 * step)
    np.testing.assert_allclose(s[0, :2], difference, rtol=1e-5, atol=1e-6)
    slower, faster = run(0.5)[0], run(-0.5)[0]
    assert slower[9, 1] < run(0.0)[0][9, 1] < faster[9, 1]  # tightening has more friction, or less


def test_at_the_start_only_the_initial_state_is_sensitive_to_itself() -> None:
    _, s = no_sensitivity(("x2_0", "k_m", "x1_0"))
    assert rest().shape == (STATES,)
    assert s.shape == (3, SENSITIVE)
    assert_array_equal(s, [[0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0]])
    with pytest.raises(ValueError, match="no_such_thing"):
        no_sensitivity(("no_such_thing",))


def test_each_feature_of_the_mechanics_has_a_row_with_what_its_readers_take() -> None:
    shaping = {"solver", "stribeck_exponent", "hysteresis_travel", "tolerance"}  # say how, not how much
    assert set(Mechanics._fields) - shaping - set(PARAMETERS) == set()
    assert set(NAMED) < set(Mechanics._fields)
    for name, row in PARAMETERS.items():
        assert row.unit, name
        assert row.low <= row.start <= row.high or row.start == 0.0, name
        assert row.low < row.high or name not in NAMED, name
        assert bool(row.effect) == bool(row.remedy), name
        assert row.step == 0.0 or name in NAMED, name
        assert row.gross > 0.0, name
