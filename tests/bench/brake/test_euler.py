from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import sensitivity_step, sign, step, stiffness
from emb_bench.brake.parameters import F_V
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


def viscous_sensitivity(velocity_until: float) -> list[float]:
    """Sensitivity of the angle to f_v, in contact, at 500 rad/s until a time [s] and at rest after it (Fig. 5.1)."""
    s1 = s2 = 0.0
    history = []
    for k in range(500):
        x2 = 500.0 if k * T_S < velocity_until else 0.0
        s1, s2 = sensitivity_step(NOMINAL, 1.0, x2, 0.0, T_S, s1, s2, F_V)
        history.append(s1)
    return history


def test_at_constant_full_speed_the_angle_sensitivity_peaks_where_figure_5_1_has_it() -> None:
    history = [abs(s) for s in viscous_sensitivity(velocity_until=1.0)]
    peak = history.index(max(history))
    assert (peak + 1) * T_S == pytest.approx(0.34, abs=0.01)
    # Steady state f_v·500/(γ k_1), exceeded by the overshoot of ζ = 0.2407, which Euler's negative damping raises.
    steady = NOMINAL.f_v * 500.0 / (NOMINAL.gamma * NOMINAL.k_1)
    overshoot = math.exp(-math.pi * 0.2407 / math.sqrt(1.0 - 0.2407**2))
    assert history[peak] == pytest.approx(steady * (1.0 + overshoot), rel=0.02)


def test_after_the_motor_stops_information_still_rises_once_more_as_in_figure_5_1() -> None:
    history = [s * s for s in viscous_sensitivity(velocity_until=0.2)]
    valley = min(range(200, 500), key=history.__getitem__)
    assert history[valley] < 0.001 * max(history)
    assert max(history[valley:]) > 0.05 * max(history)
