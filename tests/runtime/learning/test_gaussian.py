"""The Gaussian currency holds the true brake and state: each step against an independent one, and whole experiments."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emb_bench.brake.motion import advance, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, load_bench
from emb_runtime.config.shield_config import shield_config
from emb_runtime.learning import gaussian
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.gaussian import CENTRE, MATRIX, PAID, hear, lose, start
from emb_runtime.learning.known import (
    ANGLE_HIGH,
    ANGLE_LOW,
    BUDGET,
    FALSIFIED,
    HIGH,
    LOW,
    VELOCITY_HIGH,
    VELOCITY_LOW,
    known,
)
from emb_runtime.learning.law import law_for, middle
from emb_runtime.safety.shield import NO_PAST, damped_current, shield

BENCH = load_bench()
MODELS = ("flow", "euler")
UPPER = np.triu_indices(6)
Floats = NDArray[np.float64]


def assumptions_of(model: str, **change: Any) -> Assumptions:
    return make_assumptions(replace(BENCH, shield=replace(BENCH.shield, model=model, **change)))


def brake_of(theta: Any) -> BrakeParameters:
    return BENCH.brake._replace(
        **{name: float(share) * getattr(BENCH.brake, name) for name, share in zip(PARAMETER_NAMES, theta, strict=True)}
    )


def moved(model: str, theta: Any, x: float, v: float, u: float) -> tuple[float, float]:
    """One period of the bench's own plants."""
    state, (chosen, none) = rest(), no_sensitivity([])
    state[0], state[1] = x, v
    mechanics = BENCH.plant("exact" if model == "flow" else "euler").mechanics
    advance(mechanics, brake_of(theta), state, u, BENCH.timing.sample_time, chosen, none)
    return float(state[0]), float(state[1])


def matrix_of(state: Any) -> Floats:
    full = np.zeros((6, 6))
    full[UPPER] = state[MATRIX : MATRIX + 21]
    return full + np.triu(full, 1).T


def with_matrix(state: Any, full: Floats) -> None:
    state[MATRIX : MATRIX + 21] = [float(value) for value in full[UPPER]]


def drawn_state(seed: int, a: Assumptions) -> list[float]:
    """A state in the middle of a run: a box around some centre, and a matrix with correlations."""
    dice = np.random.default_rng(seed)
    state = start(a)
    state[BUDGET] = float(dice.uniform(50, 500))
    x, v = dice.choice([0.0, 1.0]) * dice.uniform(-9, 99), dice.choice([0.0, 0.1, 1.0]) * dice.uniform(-490, 490)
    hx, hv = dice.uniform(0, 0.006), dice.uniform(0, 6)
    state[ANGLE_LOW], state[ANGLE_HIGH] = x - hx, x + hx
    state[VELOCITY_LOW], state[VELOCITY_HIGH] = v - hv, v + hv
    state[CENTRE], state[CENTRE + 1] = x + dice.uniform(-2, 2) * hx, v + dice.uniform(-2, 2) * hv
    shrunk = 10.0 ** dice.uniform(-4, 0)
    for i in range(4):
        low, high = a.low[i], a.high[i]
        middle_, half = dice.uniform(low, high), shrunk * (high - low)
        state[LOW + i], state[HIGH + i] = max(low, middle_ - half), min(high, middle_ + half)
        state[CENTRE + 2 + i] = middle_ + dice.uniform(-1.5, 1.5) * half
    root = dice.normal(size=(6, 6)) * dice.uniform(0.01, 1.0, 6)
    with_matrix(state, root @ root.T)
    return state


def drawn_truth(dice: np.random.Generator, state: list[float]) -> Floats:
    """A true angle, velocity and brake in the boxes, often in a corner."""
    low = np.array([state[ANGLE_LOW], state[VELOCITY_LOW], *state[LOW : LOW + 4]])
    high = np.array([state[ANGLE_HIGH], state[VELOCITY_HIGH], *state[HIGH : HIGH + 4]])
    share = dice.uniform(size=6)
    return np.asarray(low + (high - low) * np.where(dice.random(6) < 0.5, np.round(share), share))


def predicted(a: Assumptions, state: list[float], u: float, error: float) -> Any:
    return (gaussian._flow if a.flow else gaussian._euler)(a, state, u, error)


@pytest.mark.parametrize("model", MODELS)
@given(seed=st.integers(0, 10**9))
@settings(max_examples=300, deadline=None)
def test_what_a_prediction_leaves_out_is_within_its_rest(model: str, seed: int) -> None:
    a = assumptions_of(model, current_error=0.05)
    dice = np.random.default_rng(seed)
    state = drawn_state(seed, a)
    u, off = dice.uniform(-6, 6), dice.uniform(-0.05, 0.05)
    step = predicted(a, state, u, a.current_error)
    centre = np.array(state[CENTRE : CENTRE + 6])
    for _ in range(5):
        truth = drawn_truth(dice, state)
        x, v = moved(model, truth[2:], truth[0], truth[1], u + off)
        apart = truth - centre
        assert abs(x - step.angle - np.dot(step.by_angle, apart)) <= step.angle_rest + 1e-11
        assert abs(v - step.velocity - np.dot(step.by_velocity, apart)) <= step.velocity_rest + 1e-9


@pytest.mark.parametrize("model", MODELS)
def test_rests_are_no_larger_than_what_can_happen_by_an_order(model: str) -> None:
    """A rest of 1 would pass the test above: in certain motion with the brake known nothing is left."""
    a = assumptions_of(model, current_error=0.0)
    state = start(a)
    state[LOW : LOW + 4] = state[HIGH : HIGH + 4] = state[CENTRE + 2 : CENTRE + 6] = [1.0] * 4
    for x, v in ((30.0, 300.0), (30.0, -300.0), (-5.0, 100.0)):
        state[ANGLE_LOW] = state[ANGLE_HIGH] = state[CENTRE] = x
        state[VELOCITY_LOW] = state[VELOCITY_HIGH] = state[CENTRE + 1] = v
        step = predicted(a, state, 2.0, 0.0)
        exact = moved(model, [1.0] * 4, x, v, 2.0)
        assert step.velocity_rest < 1e-3
        assert step.angle_rest < 1e-6
        assert (step.angle, step.velocity) == pytest.approx(exact, abs=1e-3)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", range(8))
def test_slopes_are_the_derivatives_of_the_prediction(model: str, seed: int) -> None:
    a = assumptions_of(model)
    state = drawn_state(seed, a)
    step = predicted(a, state, 3.0, a.current_error)
    for i in range(6):
        width = 1e-5 * max(1.0, abs(state[CENTRE + i]))
        sides = []
        for sign in (1.0, -1.0):
            other = list(state)
            other[CENTRE + i] += sign * width
            sides.append(predicted(a, other, 3.0, a.current_error))
        up, down = sides
        assert step.by_angle[i] == pytest.approx((up.angle - down.angle) / (2 * width), abs=1e-7, rel=1e-6)
        assert step.by_velocity[i] == pytest.approx((up.velocity - down.velocity) / (2 * width), abs=1e-5, rel=1e-6)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", range(10))
def test_the_recursion_is_that_of_matrices_and_its_identity_holds_for_the_truth(model: str, seed: int) -> None:
    """G1 with numpy, sample by sample: the weighted square of what is missed equals what was counted."""
    a = assumptions_of(model)
    dice = np.random.default_rng(seed)
    state = drawn_state(seed, a)
    z = drawn_truth(dice, state)
    c, p = np.array(state[CENTRE : CENTRE + 6]), matrix_of(state)
    u = 3.0
    step = predicted(a, state, u, a.current_error)
    f = np.eye(6)
    f[0], f[1] = step.by_angle, step.by_velocity
    paid = state[PAID]
    before = float((z - c) @ np.linalg.solve(p, z - c))
    gaussian._predict(a, state, u, a.current_error)
    cost = state[PAID] - paid
    widened = matrix_of(state)
    plain = f @ p @ f.T
    added = np.diag(widened - plain)
    assert widened - np.diag(added) == pytest.approx(plain, rel=1e-9, abs=1e-9)
    assert (added >= -1e-9).all()
    rests = np.array([step.angle_rest, step.velocity_rest])
    assert cost == pytest.approx(sum(q * q / y for q, y in zip(rests, added[:2], strict=True) if q > 0.0), rel=1e-3)
    x, v = moved(model, z[2:], z[0], z[1], u)
    z = np.array([x, v, *z[2:]])
    c = np.array([step.angle, step.velocity, *c[2:]])
    after = float((z - c) @ np.linalg.solve(widened, z - c))
    assert after <= before + cost + 1e-6 * before
    for i, sigma, take in (
        (0, a.angle_sigma, gaussian._correct_angle),
        (1, a.velocity_sigma, gaussian._correct_velocity),
    ):
        error = 3.0 * sigma * dice.normal()
        p = matrix_of(state)
        total, innovation = p[i, i] + sigma**2, z[i] + error - c[i]
        logs, surprise = state[gaussian.LOGS], state[gaussian.SURPRISE]
        take(state, z[i] + error, sigma**2)
        gain = p[:, i] / total
        c = c + gain * innovation
        assert state[CENTRE : CENTRE + 6] == pytest.approx(list(c), rel=1e-9)
        assert matrix_of(state) == pytest.approx(p - np.outer(gain, p[i]), rel=1e-6, abs=1e-9)
        assert state[gaussian.LOGS] - logs == pytest.approx(math.log(total / sigma**2))
        assert state[gaussian.SURPRISE] - surprise == pytest.approx(innovation**2 / total)
        now = float((z - c) @ np.linalg.solve(matrix_of(state), z - c))
        assert now == pytest.approx(after + error**2 / sigma**2 - innovation**2 / total, rel=1e-4, abs=1e-3)
        after = now


def test_the_budget_is_the_lesser_of_ratio_and_energy_and_the_boxes_are_those_of_the_ellipsoid() -> None:
    a = assumptions_of("flow", delta=1e-6)
    state = drawn_state(3, a)
    state[PAID], state[gaussian.LOGS], state[gaussian.SURPRISE], state[gaussian.MEASURED] = 6.0, 20.0, 30.0, 40.0
    rare = math.log(2 * 2 * a.samples / a.delta)
    ratio = 6.0 + 2 * math.log(2 / a.delta) + 20.0
    energy = 6.0 + 40.0 + 2 * math.sqrt(40.0 * rare) + 2 * rare - 30.0
    assert gaussian.budget(a, state) == pytest.approx(min(ratio, energy))
    state[gaussian.LOGS] = 500.0
    assert gaussian.budget(a, state) == pytest.approx(energy)
    state[gaussian.MEASURED] = 2.0 * a.samples + 1.0  # more than the energy was summed over
    assert gaussian.budget(a, state) == pytest.approx(ratio + 480.0)
    state[gaussian.LOGS], state[gaussian.MEASURED] = 20.0, 40.0
    centre, p = np.array(state[CENTRE : CENTRE + 6]), matrix_of(state)
    gaussian._enclose(a, state)
    on_it = np.random.default_rng(0).normal(size=(20000, 6))
    on_it *= math.sqrt(state[BUDGET]) / np.linalg.norm(on_it, axis=1)[:, None]
    points = centre + on_it @ np.linalg.cholesky(p).T
    reach = np.sqrt(state[BUDGET] * np.diag(p))
    assert np.abs(points - centre).max(axis=0) == pytest.approx(reach, rel=0.2)
    assert (state[ANGLE_LOW], state[ANGLE_HIGH]) == pytest.approx((centre[0] - reach[0], centre[0] + reach[0]))
    assert (state[VELOCITY_LOW], state[VELOCITY_HIGH]) == pytest.approx((centre[1] - reach[1], centre[1] + reach[1]))
    assert (np.abs(points - centre).max(axis=0) <= reach).all()


def played(
    model: str, theta: Any, seed: int, *, steps: int = 500, truth: str = "", lost: float = 0.0, shrunk: float = 1.0
) -> tuple[list[list[float]], list[float], bool]:
    """States after each sample, the last of them, and True if the truth was outside at any time.

    Args:
        model: what is declared.
        theta: the true relative parameters.
        seed: of noise, currents and losses.
        steps: of the run.
        truth: what the brake is, if not what is declared.
        lost: share of the samples that are lost.
        shrunk: factor on the noise.
    """
    a, setting = assumptions_of(model), shield_config(BENCH)
    dice = np.random.default_rng(seed)
    state, (x, v), u, outside = start(a), (0.0, 0.0), 0.0, False
    wanted = 6.0 * np.sign(np.sin(np.arange(steps) * dice.uniform(0.01, 0.2)) + 0.1)
    seen = []
    for k in range(steps):
        if k and dice.random() < lost:
            lose(a, state)
            u = damped_current(v, setting.current, setting.damping_velocity)
        else:
            noise = shrunk * np.clip(dice.normal(size=2), -6.0, 6.0) * [BENCH.noise.angle, BENCH.noise.velocity]
            hear(a, state, x + noise[0], v + noise[1], u)
            now = known(a, state)
            boxed = now.angle_low <= x <= now.angle_high and now.velocity_low <= v <= now.velocity_high
            outside |= not boxed or any(not state[LOW + i] <= theta[i] <= state[HIGH + i] for i in range(4))
            u, _ = shield(law_for(setting, BENCH.brake, now), *middle(now), float(wanted[k]), NO_PAST, k)
        x, v = moved(truth or model, theta, x, v, u)
        assert -10.0 <= x <= 100.0
        assert abs(v) <= 500.0
        seen.append(list(state))
    return seen, state, outside


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_the_true_brake_and_state_stay_inside_and_the_set_shrinks(model: str, seed: int, lost: float) -> None:
    theta = np.random.default_rng(seed + 100).uniform([0.5, 0.5, 0.5, 0.47], [1.5, 1.5, 1.5, 2.3])
    seen, state, outside = played(model, theta, seed, lost=lost)
    assert not outside
    assert state[FALSIFIED] == 0.0
    widths = [[row[HIGH + i] - row[LOW + i] for i in range(4)] for row in seen]
    assert (np.diff(widths, axis=0) <= 0.0).all()
    assert max(widths[-1][:2]) < (0.1 if lost == 0.0 else 0.4)


def test_a_brake_outside_the_set_is_found_out_and_then_nothing_is_believed() -> None:
    seen, state, _ = played("flow", [1.0, 1.0, 4.0, 1.0], 0, steps=150)
    a = assumptions_of("flow")
    falsified = [row[FALSIFIED] for row in seen]
    assert falsified[-1] == 1.0
    assert falsified == sorted(falsified)
    assert state[LOW : LOW + 4] == list(a.low)
    assert state[HIGH : HIGH + 4] == list(a.high)
    now = known(a, state)
    assert now.angle_high - now.angle_low == pytest.approx(2 * a.angle_noise)
    assert now.velocity_high - now.velocity_low == pytest.approx(2 * a.velocity_noise)


@pytest.mark.parametrize("model", MODELS)
def test_compiled_it_is_the_same_bit_for_bit(model: str) -> None:
    a = assumptions_of(model)
    dice = np.random.default_rng(5)
    plain = start(a)
    batch: Any = np.array(plain)
    x, v, u = 0.0, 0.0, 0.0
    for k in range(120):
        sample = (x + 1e-3 * dice.normal(), v + dice.normal(), u)
        if k % 17 == 16:
            lose(a, plain)
            compiled(lose)(a, batch)
        else:
            hear(a, plain, *sample)
            compiled(hear)(a, batch, *sample)
        assert list(batch) == plain
        u = 3.0 if k % 40 < 20 else -3.0
        x, v = moved(model, [1.1, 0.9, 1.2, 0.8], x, v, u)
