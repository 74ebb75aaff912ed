from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import advance_karnopp
from emb_bench.brake.motion import no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_runtime.config.bench import BrakeParameters, load_bench
from emb_runtime.config.plants import EULER, KARNOPP, Mechanics
from tests.bench.flows import changed, marched, moved

P = load_bench().brake
M = Mechanics(KARNOPP, karnopp_velocity=3.0, break_away=1.2)
T_S = 1e-3
NAMES = ("k_m", "k_1", "T_c", "f_v", "J", "contact", "break_away", "delay")


def stepped(x1: float, x2: float, u: float, m: Mechanics = M, p: BrakeParameters = P) -> tuple[float, float]:
    x = rest()
    x[:2] = x1, x2
    nothing, s = no_sensitivity(())
    advance_karnopp(m, p, x, u, T_S, nothing, s)
    return float(x[0]), float(x[1])


def test_within_the_interval_a_brake_is_held_by_up_to_the_static_friction() -> None:
    limit = 1.2 * P.T_c / P.k_m  # A
    assert stepped(-1.0, 2.9, 0.99 * limit) == (-1.0, 0.0)
    x1, x2 = stepped(-1.0, 0.0, 1.01 * limit)
    assert x1 == -1.0
    assert x2 == pytest.approx(T_S * 0.01 * 1.2 * P.T_c / P.J, rel=1e-9)
    assert stepped(-1.0, 0.0, -1.01 * limit)[1] == pytest.approx(-x2, rel=1e-12)


def test_beyond_the_interval_friction_is_that_of_the_thesis() -> None:
    expected = T_S * (P.k_m * 2.0 - P.T_c - P.f_v * 3.1) / P.J
    assert stepped(-1.0, 3.1, 2.0) == pytest.approx((-1.0 + 3.1e-3, 3.1 + expected), rel=1e-12)


def test_a_brake_that_coasts_to_rest_does_not_chatter_as_it_does_under_sign() -> None:
    coast = np.zeros(300)
    held = moved(M, P, coast, (-5.0, 30.0))[-200:]
    chattering = moved(Mechanics(EULER), P, coast, (-5.0, 30.0))[-200:]
    assert (held[:, 1] == 0.0).all()
    assert (held[:, 0] == held[0, 0]).all()
    assert np.abs(chattering[:, 1]).max() > 1.0


def test_a_clamped_brake_holds_its_angle_without_current_where_friction_suffices() -> None:
    held = moved(M, P, np.zeros(100), (20.0, 0.0))  # 8.7e-3 N·m of load, 12.4e-3 of static friction
    assert (held == (20.0, 0.0)).all()


def test_at_rest_no_parameter_moves_the_velocity() -> None:
    _, shown = marched(M, P, np.zeros(100), (20.0, 0.0), NAMES)
    assert (shown[:, :, 1] == 0.0).all()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.integers(-3000, 3000), min_size=1, max_size=10), st.integers(-100, 600))
def test_sensitivities_are_the_differences_while_no_case_changes(levels: list[int], start: int) -> None:
    currents, x0 = np.repeat(np.array(levels) / 1000.0, 10), ((start + 0.5) / 16.0, 0.0)
    names = ("k_m", "k_1", "T_c", "f_v", "J", "break_away")
    states, shown = marched(M, P, currents, x0, names)
    for j, name in enumerate(names):
        ends = [changed(M, P, currents, x0, name, by) for by in (1e-7, -1e-7)]
        # The equations are continuous within a case; they jump between cases, and nothing is compared across.
        same = all(
            ((np.abs(e[:, 1]) < M.karnopp_velocity) == (np.abs(states[:, 1]) < M.karnopp_velocity)).all()
            and ((e[:, 1] == 0.0) == (states[:, 1] == 0.0)).all()
            and (np.sign(e) == np.sign(states)).all()
            for e in ends
        )
        if same:
            slope = ((ends[0] - ends[1]) / 2e-7)[1:]
            np.testing.assert_allclose(shown[:, j], slope, rtol=1e-4, atol=1e-5 * max(1.0, np.abs(slope).max()))


@settings(deadline=None, max_examples=50)
@given(st.floats(-10.0, 100.0), st.floats(-10.0, 10.0), st.floats(-6.0, 6.0), st.floats(-1e3, 1e3))
def test_the_compiled_step_is_the_plain_one_bit_for_bit(x1: float, x2: float, u: float, seed: float) -> None:
    chosen, s = no_sensitivity(NAMES)
    ends = []
    for advance in (advance_karnopp, compiled(advance_karnopp)):
        x, t = rest(), s + seed
        x[:2] = x1, x2
        advance(M, P, x, u, T_S, chosen, t)
        ends.append((x.tobytes(), t.tobytes()))
    assert ends[0] == ends[1]
