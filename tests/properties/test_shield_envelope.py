"""The envelope shield holds the limits for every brake of its set, whatever the policy says: a slice of the search.

``tests/searches/shield.py`` runs it at length; that one period keeps the safe set is proved (``proof/``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import step as euler_step
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Limits, Noise, Ranges
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield import shield, successor, window
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.benches import SENSOR_BENCH
from tests.properties.shield_climb import climb
from tests.properties.shield_search import (
    COASTING,
    CRUISE_HOME,
    CRUISE_OUT,
    DROPS,
    END_ANGLE,
    EXTENSIONS,
    FINE,
    LAST_SPEED,
    NOISES,
    PIECE,
    PLANT,
    PLANTS,
    POLICIES,
    ROUGH,
    Floats,
    Found,
    bench_with,
    fine_piece,
    search,
)

SHIPPED = SENSOR_BENCH


def assert_held_and_home(found: Found, home: bool = True) -> None:
    assert not found.violated.any(), found.describe(int(np.flatnonzero(found.violated)[0]))
    away = found.obeyed & ~found.home
    assert not (home and away.any()), found.describe(int(np.flatnonzero(away)[0]))


# --- Whole episodes -------------------------------------------------------------------------------------------------


def test_no_policy_noise_or_lost_command_breaks_a_limit_for_any_brake_of_the_envelope() -> None:
    found = search(SHIPPED, 3000, seed=1)
    assert_held_and_home(found)
    assert np.abs(found.rows[found.obeyed, END_ANGLE]).max() < 0.25
    # The search went where it hurts, with everything it has.
    assert found.rows[:, 0].min() < -9.7
    assert found.rows[:, 1].max() > 99.6
    assert found.rows[:, 2].max() > 499.0
    assert found.rows[:, 3].min() < -499.0
    for column, kinds in enumerate((len(POLICIES), len(NOISES), len(DROPS))):
        assert set(found.labels[:, column]) == set(range(kinds))


HELD: dict[str, dict[str, Any]] = {
    **{ranges: {"ranges": ranges} for ranges in ("pm50", "viscous", "viscous-stiffness")},
    **EXTENSIONS,
    "frame ages 1..1": {"frame_age": (1, 1)},
    "frame ages 2..4": {"frame_age": (2, 4)},
}
OLDEST = ("frame ages 0..5", "frame ages 5..5", "frame ages 2..4")
"""With frames so old, an episode in a thousand ends a little off home."""


@pytest.mark.parametrize("what", HELD)
def test_whatever_is_declared_holds_the_limits_and_comes_home(what: str) -> None:
    found = search(bench_with(**HELD[what]), 200, seed=2)
    assert set(found.labels[:, 2]) == set(range(len(DROPS)))
    assert_held_and_home(found, home=what not in OLDEST)


@pytest.mark.parametrize("plant", PLANTS)
def test_a_brake_whose_features_are_declared_is_held_and_comes_home(plant: str) -> None:
    found = search(bench_with(**PLANTS[plant]), 150, seed=21, plant=plant)
    assert set(found.labels[:, 3]) == {FINE, PLANT}
    assert_held_and_home(found)


def test_the_coasting_envelope_needs_no_brake_when_commands_are_lost() -> None:
    found = search(bench_with(**COASTING), 300, seed=25, freewheel=True)
    assert_held_and_home(found)
    assert found.rows[found.of("killed"), LAST_SPEED].max() < 60.0  # it rests, or creeps under Euler's sign()


def test_a_kill_at_any_moment_ends_at_rest_inside_the_limits() -> None:
    found = search(SHIPPED, 400, seed=4, drops=("killed",))
    assert found.of("killed").all()
    assert not found.violated.any(), found.describe(int(np.flatnonzero(found.violated)[0]))
    # At rest, or creeping back under a wound spring slower than the speed from which the damped stop brakes fully.
    assert found.rows[:, LAST_SPEED].max() < SHIPPED.node.damping_velocity


def test_one_lost_command_in_ten_still_comes_home() -> None:
    found = search(SHIPPED, 400, seed=5, drops=("some",))
    assert not found.violated.any()
    assert found.home.all()


def test_a_brake_near_the_nominal_one_is_let_nearly_to_full_speed() -> None:
    rows = search(SHIPPED, 400, seed=6, truth="viscous", drops=("none",)).rows
    assert np.quantile(rows[:, CRUISE_OUT], 0.9) > 470.0
    assert np.quantile(rows[:, CRUISE_HOME], 0.9) > 450.0


def other_bench(rng: np.random.Generator) -> Bench:
    """A bench with another brake, other limits, noise, margin and damping, which may or may not make sense."""
    scale = dict(
        zip(("J", *PARAMETER_NAMES), rng.uniform([0.6, 0.5, 0.3, 0.4, 0.4], [2.0, 2.0, 1.5, 1.6, 2.0]), strict=True)
    )
    brake = SHIPPED.brake._replace(**{n: getattr(SHIPPED.brake, n) * float(s) for n, s in scale.items()})
    width = float(rng.uniform(0.0, 0.5))
    low = brake._replace(**{n: getattr(brake, n) * (1.0 - width) for n in PARAMETER_NAMES})
    high = brake._replace(**{n: getattr(brake, n) * (1.0 + width) for n in PARAMETER_NAMES})
    reach = rng.uniform([0.6, 0.6], rng.choice([[10.0, 100.0], [2.0, 2.0]]))
    return replace(
        SHIPPED,
        ranges={"envelope": Ranges("envelope", low, high)},
        limits=Limits(
            float(rng.uniform(2.0, 6.0)), (-float(reach[0]), float(reach[1])), float(rng.uniform(60.0, 500.0))
        ),
        noise=Noise(float(rng.uniform(1e-4, 3e-3)), float(rng.uniform(0.2, 2.0))),
        shield=SHIPPED.shield._replace(angle_margin=float(rng.uniform(0.1, 0.5))),
        node=replace(SHIPPED.node, damping_velocity=float(rng.uniform(50.0, 200.0))),
    )


def test_every_bench_that_is_not_refused_is_held() -> None:
    rng = np.random.default_rng(13)
    held = refused = 0
    while held < 12:
        bench = other_bench(rng)
        try:
            make_law(bench)
        except BenchFileError:
            refused += 1
            continue
        found = search(bench, 100, seed=held)
        assert not found.violated.any(), f"{bench.limits} {found.describe(int(np.flatnonzero(found.violated)[0]))}"
        held += 1
    assert refused > held  # the checks are not idle


# --- The search can fail --------------------------------------------------------------------------------------------


CARELESS = make_law(SHIPPED)._replace(bottom=make_law(SHIPPED).bottom - 0.3, top=make_law(SHIPPED).top + 0.3)
BREAKS: dict[str, tuple[dict[str, Any], int, dict[str, Any], float]] = {
    "a brake outside the set": ({"ranges": "viscous"}, 200, {"truth": "envelope", "drops": ("none",)}, 0.1),
    "a law without its margin, commands lost": ({}, 1000, {"law": CARELESS, "drops": ("slow outward",)}, 0.0),
    "a law for fresh frames, late ones": ({}, 200, {"law": make_law(SHIPPED), "ages": (0, 1)}, 0.05),
    "a node that freewheels": ({}, 300, {"drops": ("killed",), "freewheel": True}, 0.05),
    "a lag that is not declared": ({}, 150, {"plant": "lag"}, 0.1),
    "a lag and rough friction that are not": ({}, 150, {"plant": "rough"}, 0.1),
    "half of the lag": ({"current_lag": 0.0007}, 600, {"plant": "lag"}, 0.0),
    "an observer that is not declared": ({}, 300, {"bandwidth": 1520.0}, 0.1),
    "one of half the declared 800 rad/s": ({"observer": 800.0}, 600, {"bandwidth": 400.0}, 0.01),
    "one of half the declared 1520 rad/s": ({"observer": 1520.0}, 600, {"bandwidth": 760.0}, 0.01),
}
"""What the bench declares, episodes, what is otherwise, and the share of episodes that pass a limit at least."""


@pytest.mark.parametrize("what", BREAKS)
def test_what_breaks_an_assumption_of_the_law_breaks_the_limits(what: str) -> None:
    declared, episodes, otherwise, share = BREAKS[what]
    found = search(bench_with(**declared), episodes, seed=23, **otherwise)
    assert found.violated.mean() > share
    assert what != "a brake outside the set" or not found.home.all()
    assert what != "a node that freewheels" or found.rows[found.violated, LAST_SPEED].max() > 300.0


def test_hill_climbing_finds_the_way_out_for_an_observer_a_fifth_below_the_declared_bandwidth() -> None:
    bench = bench_with(observer=1520.0)
    assert climb(bench, 40, 40, seed=29, bandwidth=0.8 * 1520.0).min() < 0.0 < climb(bench, 40, 40, seed=29).min()


def test_hill_climbing_finds_no_way_out() -> None:
    for declared in ({}, ROUGH, COASTING, {"frame_age": (0, 5)}, {"observer": 1520.0}):
        assert climb(bench_with(**declared), 20, 30, seed=26).min() > 0.0


def test_hill_climbing_finds_the_way_out_of_a_law_without_its_margin() -> None:
    assert climb(SHIPPED, 20, 30, seed=26, law=CARELESS).min() < 0.0


# --- One step ---------------------------------------------------------------------------------------------------------


def in_envelope() -> st.SearchStrategy[BrakeParameters]:
    box = SHIPPED.range_set("envelope")
    bounds = {n: st.floats(getattr(box.low, n), getattr(box.high, n)) for n in PARAMETER_NAMES}
    return st.builds(BrakeParameters, J=st.just(box.low.J), gamma=st.just(box.low.gamma), **bounds)


shares = st.floats(-1.0, 1.0)


@settings(max_examples=300, deadline=None)
@given(
    p=in_envelope(),
    x=st.floats(-10.0, 100.0),
    v=st.floats(-500.0, 500.0) | st.floats(-20.0, 20.0),
    u=st.floats(-6.0, 6.0),
    shares=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_the_successor_box_contains_what_any_brake_does(
    p: BrakeParameters, x: float, v: float, u: float, shares: tuple[float, float]
) -> None:
    law = make_law(SHIPPED)
    below, above = shares
    xl, xh, vl, vh = successor(law, x - below * 0.01, x + above * 0.01, v - below * 10.0, v + above * 10.0, u)
    x1, v1 = euler_step(p, x, v, u, law.sample_time)
    x2, v2 = x, v
    for _ in range(round(law.sample_time / PIECE)):
        x2, v2 = fine_piece(p, x2, v2, u, PIECE)
    for x_next, v_next in ((x1, v1), (x2, v2)):
        assert xl - 1e-4 <= x_next <= xh + 1e-4
        assert vl <= v_next <= vh


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from([{}, ROUGH, COASTING, {"frame_age": (0, 3)}]),
    st.floats(-12.0, 105.0),
    st.floats(-550.0, 550.0),
    st.tuples(*[st.floats(-6.0, 6.0)] * 5),
    st.floats(-6.0, 6.0),
    st.integers(0, 499),
)
def test_the_shield_answers_inside_the_window_in_which_no_current_is_always_if_it_coasts(
    declared: dict[str, Any],
    angle: float,
    velocity: float,
    past: tuple[float, float, float, float, float],
    wanted: float,
    step: int,
) -> None:
    law = make_law(bench_with(**declared))
    lowest, highest = window(law, angle, velocity, past)
    sent, _ = shield(law, angle, velocity, wanted, past, step)
    assert -law.current <= lowest <= sent <= highest <= law.current
    assert not law.coasting or lowest <= 0.0 <= highest


# --- One source, two speeds -----------------------------------------------------------------------------------------


def answers(law: ShieldLaw, inputs: Floats, out: Floats) -> None:
    for i in range(inputs.shape[0]):
        r = inputs[i]
        out[i, 0], out[i, 1] = shield(law, r[0], r[1], r[2], (r[3], r[4], r[5], r[6], r[7]), int(r[8]))


@pytest.mark.parametrize(
    "declared", [{}, {"frame_age": (0, 3)}, {"frame_age": (2, 2)}, {"frame_age": (1, 5)}, ROUGH, COASTING]
)
def test_compiled_and_plain_answers_are_the_same_bits(declared: dict[str, Any]) -> None:
    law = make_law(bench_with(**declared))
    rng = np.random.default_rng(12)
    n = 2000
    inputs = np.column_stack(
        [rng.uniform(-11, 101, n), rng.uniform(-520, 520, n), *rng.uniform(-7, 7, (6, n)), rng.integers(0, 500, n)]
    ).astype(np.float64)
    slow = rng.random(n) < 0.3
    inputs[slow, 1] = rng.uniform(-20, 20, int(slow.sum()))
    inputs[slow, 0] = rng.uniform(-1, 1, int(slow.sum()))
    odd = np.array([math.nan, math.inf, -math.inf, 0.0, -0.0, 1e300, 5e-324])
    for column in range(8):
        inputs[column * 60 : column * 60 + 60, column] = rng.choice(odd, 60)
    plain, fast = np.zeros((n, 2)), np.zeros((n, 2))
    answers(law, inputs, plain)
    compiled(answers)(law, inputs, fast)
    assert plain.tobytes() == fast.tobytes()
