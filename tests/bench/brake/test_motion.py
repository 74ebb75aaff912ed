from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from emb_bench.brake.euler import advance_karnopp, step
from emb_bench.brake.exact import advance_exact
from emb_bench.brake.extended import advance_extended
from emb_bench.brake.motion import SENSITIVE, STATES, Floats, advance, is_plain, no_sensitivity, rest
from emb_runtime.config.bench import load_bench
from emb_runtime.config.plants import EXACT, KARNOPP, Mechanics

BENCH = load_bench()
P = BENCH.brake
T_S = 1e-3
NAMES = ("k_m", "k_1", "x1_0")
FEATURES = {
    "break_away": 1.2,
    "stribeck_velocity": 30.0,
    "f_l": 1e-6,
    "quadratic": 0.001,
    "cubic": 1e-5,
    "hysteresis": 0.1,
    "current_lag": 0.002,
}


def start() -> Floats:
    return np.array([5.0, 20.0, 0.0, 1.0])


def moved(m: Mechanics) -> tuple[Floats, Floats]:
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    advance(m, P, x, 2.0, T_S, chosen, s)
    return x, s


def test_the_euler_brake_is_stepped_as_the_thesis_does() -> None:
    x, _ = moved(BENCH.plant("euler").mechanics)
    assert (x[0], x[1]) == step(P, 5.0, 20.0, 2.0, T_S)
    assert x[3] == 2.0


def test_the_karnopp_brake_has_its_interval_of_rest() -> None:
    m = Mechanics(KARNOPP, karnopp_velocity=3.0)
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    advance_karnopp(m, P, x, 2.0, T_S, chosen, s)
    assert_array_equal(moved(m)[0], x)
    assert_array_equal(moved(m)[1], s)


def test_an_exact_brake_without_features_is_solved_as_the_thesis_s() -> None:
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    advance_exact(P, x, 2.0, T_S, chosen, s)
    assert_array_equal(moved(BENCH.plant("exact").mechanics)[0], x)
    assert_array_equal(moved(BENCH.plant("exact").mechanics)[1], s)


@pytest.mark.parametrize("feature", FEATURES)
def test_a_brake_with_any_one_feature_is_a_rich_one(feature: str) -> None:
    m = Mechanics(**(Mechanics(EXACT)._asdict() | {feature: FEATURES[feature]}))
    assert not is_plain(m)
    x, (chosen, s) = start(), no_sensitivity(NAMES)
    advance_extended(m, P, x, 2.0, T_S, chosen, s)
    assert_array_equal(moved(m)[0], x)
    assert_array_equal(moved(m)[1], s)


def test_every_field_of_the_mechanics_is_looked_at() -> None:
    # A solver, its own speed, and what shapes another feature do not make a brake rich by themselves.
    shaping = {"solver", "karnopp_velocity", "stribeck_exponent", "hysteresis_travel"}
    assert set(Mechanics._fields) == shaping | set(FEATURES)


@pytest.mark.parametrize("name", ["euler", "karnopp", "exact", "rough"])
def test_without_unknowns_the_brake_moves_the_same(name: str) -> None:
    m, x, (chosen, s) = BENCH.plant(name).mechanics, start(), no_sensitivity(())
    advance(m, P, x, 2.0, T_S, chosen, s)
    assert_array_equal(x, moved(m)[0])


def test_at_the_start_only_the_initial_state_is_sensitive_to_itself() -> None:
    _, s = no_sensitivity(("x2_0", "k_m", "x1_0"))
    assert rest().shape == (STATES,)
    assert s.shape == (3, SENSITIVE)
    assert_array_equal(s, [[0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0]])
    with pytest.raises(ValueError, match="not in tuple"):
        no_sensitivity(("no_such_thing",))
