"""The Kalman filter, against the brakes it models, and textbook formulas."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emb_bench.brake import euler
from emb_bench.brake.motion import advance, no_sensitivity, rest
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors
from emb_runtime.estimator.kalman import (
    Four,
    Model,
    State,
    believed,
    deviations,
    follow,
    initial_state,
    make_model,
    predict,
)
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
PM50 = BENCH.range_set("pm50")
EXACT = make_model(BENCH, PM50)
OBSERVED = make_model(replace(BENCH, sensors=Sensors("observer", 1520.0)), PM50)
NOMINAL = np.array([getattr(BENCH.brake, n) for n in PARAMETER_NAMES])
T_S = BENCH.timing.sample_time
UNIT = (1.0, 1.0, 1.0, 1.0)
UNEQUAL = EXACT._replace(low=(0.5, 0.65, 0.7, 0.8), high=(1.4, 1.6, 1.8, 2.0))  # Ranges that tell parameters apart


def state_of(mean: Any, covariance: Floats) -> State:
    packed: Any = tuple(covariance[np.triu_indices(6)].tolist())
    six: Any = tuple(map(float, mean))
    return State(0.0, six, packed, 1.0, 1.0)


def errors(model: Model, state: State) -> Four:
    return deviations(model, state, believed(model, state))


def known(x: float, v: float, variance: float = 0.0) -> State:
    return state_of((x, v, *UNIT), variance * np.eye(6))


def random_state(seed: int, velocity: float) -> State:
    """A state with a full covariance, so fast that the direction is sure."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * np.array([1e-2, 0.5, 0.05, 0.05, 0.05, 0.05])[:, None]
    return state_of((rng.uniform(1.0, 90.0), velocity, *rng.uniform(0.6, 1.4, 4)), root @ root.T)


def after(unknowns: Floats, current: float) -> Floats:
    """One period of the bench's own brake from angle, velocity and relative parameters."""
    brake = BENCH.brake._replace(**dict(zip(PARAMETER_NAMES, unknowns[2:] * NOMINAL, strict=True)))
    x, (chosen, s) = rest(), no_sensitivity(["k_m"])
    x[0], x[1] = unknowns[0], unknowns[1]
    advance(BENCH.plant("exact").mechanics, brake, x, current, T_S, chosen, s)
    return np.array([x[0], x[1], *unknowns[2:]])


def jacobian(unknowns: Floats, current: float, steps: Floats) -> Floats:
    """Derivatives of what comes after a period to what was before, by central differences."""
    columns = [
        (after(unknowns + h * e, current) - after(unknowns - h * e, current)) / (2.0 * h)
        for h, e in zip(steps, np.eye(6), strict=True)
    ]
    return np.array(columns).T


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([-300.0, 300.0]), st.floats(-6.0, 6.0))
def test_a_prediction_spreads_a_full_covariance_by_the_derivatives_of_the_brake(
    seed: int, v: float, current: float
) -> None:
    state = random_state(seed, v)
    unknowns, p = np.array(state.mean), unpack(np.array(state.covariance), 6)
    f = jacobian(unknowns, current, np.array([1e-6, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6]))
    _, packed = predict(EXACT, state_of(state.mean, 1e-10 * p), 1.0, current)
    found, expected = unpack(np.array(packed), 6) / 1e-10, f @ p @ f.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert found / scale == pytest.approx(expected / scale, abs=1e-3)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.5, 95.0), st.floats(-490.0, 490.0), st.floats(-6.0, 6.0))
def test_a_prediction_of_the_exact_brake_is_its_period_and_its_derivatives(x: float, v: float, current: float) -> None:
    unknowns = np.array([x, v, *UNIT])
    end = after(unknowns, current)
    mean, _ = predict(EXACT, known(x, v), 1.0, current)
    assert mean[0] == pytest.approx(end[0], abs=3e-5)
    assert mean[1] == pytest.approx(end[1], abs=3e-4)
    pull = EXACT.motor * current - EXACT.spring * x
    assume(min(abs(v), abs(end[1])) > 0.05 and abs(abs(pull) - EXACT.coulomb) > 50.0)  # no derivative at a kink
    f = jacobian(unknowns, current, np.array([1e-6, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6]))
    _, packed = predict(EXACT, known(x, v, 1e-12), 1.0, current)
    covariance = unpack(np.array(packed), 6) / 1e-12
    assert covariance[0, 2:] == pytest.approx(f[0, 2:], rel=2e-2, abs=1e-5)
    assert covariance[1, 2:] == pytest.approx(f[1, 2:], rel=1e-2, abs=2e-2)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_two_corrections_in_turn_are_the_textbooks_joint_one(seed: int) -> None:
    state = random_state(seed, 100.0)
    mean, p = np.array(state.mean), unpack(np.array(state.covariance), 6)
    y, noise = mean[:2] + np.array([0.003, -0.7]), np.diag([EXACT.angle_variance, EXACT.velocity_variance])
    gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + noise)
    found = follow(EXACT, state, y[0], y[1], state.step, 0.0)
    assert found.mean == pytest.approx(mean + gain @ (y - mean[:2]), rel=1e-9)
    assert unpack(np.array(found.covariance), 6) == pytest.approx(p - gain @ p[:2], rel=1e-6, abs=1e-12)


def with_angles(state: State, samples: list[tuple[float, float]]) -> tuple[Floats, Floats, list[float]]:
    """Mean, covariance and squared innovations of the book's filter, which corrects with the angle alone.

    A sample is an angle [rad] and the current of the period before [A].
    """
    h, squares = np.eye(6)[:1], []
    for k, (angle, current) in enumerate(samples, 1):
        mean, packed = predict(OBSERVED, state, 1.0, current)
        p = unpack(np.array(packed), 6)
        s = h @ p @ h.T + BENCH.noise.angle**2
        gain, innovation = p @ h.T @ np.linalg.inv(s), angle - mean[0]
        squares.append(innovation**2 / s[0, 0])
        joseph = np.eye(6) - gain @ h
        p = joseph @ p @ joseph.T + gain @ gain.T * BENCH.noise.angle**2
        state = state_of(mean + gain[:, 0] * innovation, p)._replace(step=float(k))
    return np.array(state.mean), unpack(np.array(state.covariance), 6), squares


def test_with_a_declared_observer_the_angle_alone_corrects_whatever_the_velocity_is() -> None:
    rng, x, v, samples = np.random.default_rng(5), 0.0, 0.0, []
    for k in range(60):
        current = 6.0 if k < 30 else -6.0
        x, v = after(np.array([x, v, *UNIT]), current)[:2]
        samples.append((x + 1e-3 * rng.standard_normal(), current))
    mean, p, squares = with_angles(initial_state(OBSERVED), samples)
    running, worst = 1.0, 1.0
    for square in squares:  # of one innovation a sample: the memory is as many innovations as with two
        running += (square - running) / 128.0
        worst = max(worst, running)
    for shown in (0.0, 300.0, -math.inf, math.nan):
        state = initial_state(OBSERVED)
        for k, (angle, current) in enumerate(samples, 1):
            state = follow(OBSERVED, state, angle, shown, float(k), current)
        assert state.mean == pytest.approx(mean, rel=1e-6, abs=1e-9)
        assert unpack(np.array(state.covariance), 6) == pytest.approx(p, rel=1e-5, abs=1e-12)
        assert (state.innovation, state.worst) == pytest.approx((running, worst), rel=1e-6)
        assert abs(state.mean[1] - v) < 5.0


def test_the_prior_is_uniform_in_the_ranges_and_at_home() -> None:
    ranges = BENCH.range_set("viscous")
    state = initial_state(make_model(BENCH, ranges))
    assert state.mean == pytest.approx((0.0, 0.0, 1.0, 1.0, 1.0, 3.0e-5 / 2.16e-5))
    deviation = np.array([0.5, 5.0, 0.0, 0.0, 0.0, 4.0e-5 / 2.16e-5 / math.sqrt(12.0)])
    assert unpack(np.array(state.covariance), 6) == pytest.approx(np.diag(deviation**2))
    assert (state.step, state.innovation, state.worst) == (0.0, 1.0, 1.0)
    deviation = np.sqrt(np.diag(unpack(np.array(initial_state(UNEQUAL).covariance), 6)))[2:]
    assert deviation == pytest.approx(np.subtract(UNEQUAL.high, UNEQUAL.low) / math.sqrt(12.0))


def test_the_model_has_the_numbers_of_the_bench() -> None:
    p, model = BENCH.brake, EXACT
    assert (model.sample_time, model.current, model.nominal) == (1e-3, 6.0, (p.k_m, p.k_1, p.T_c, p.f_v))
    acceleration = euler.step(p, 2.0, 3.0, 0.5, 1e-3)[1] - 3.0
    assert 1e-3 * (0.5 * model.motor - 2.0 * model.spring - model.coulomb - 3.0 * model.viscous) == pytest.approx(
        acceleration
    )
    noisy = replace(BENCH, noise=replace(BENCH.noise, angle=2e-3, velocity=1.3))
    noise = make_model(noisy, PM50)
    assert (noise.angle_variance, noise.velocity_variance) == pytest.approx((4e-6, 1.69))
    assert (noise.derived, OBSERVED) == (False, EXACT._replace(derived=True))
    assert (model.start_angle_variance, model.start_velocity_variance) == pytest.approx((0.25, 25.0))
    assert model.lost == pytest.approx(6.0 * 1.5 * model.motor * 1e-3)
    assert model.low == pytest.approx([0.5] * 4)
    assert model.high == pytest.approx([1.5] * 4)


def test_lost_samples_leave_it_less_sure_by_the_currents_that_may_have_acted() -> None:
    state = known(10.0, 100.0, 1e-8)
    variances = [unpack(np.array(predict(EXACT, state, n, 0.0)[1]), 6)[1, 1] for n in (1.0, 2.0, 4.0)]
    assert variances[1] - variances[0] == pytest.approx(EXACT.lost**2, rel=1e-2)
    assert variances[2] - variances[0] == pytest.approx((3.0 * EXACT.lost) ** 2, rel=1e-2)
    assert predict(EXACT, state, 0.5, 1.0) == predict(EXACT._replace(lost=0.0), state, 0.5, 1.0)
    for periods in (0.0, -3.0):
        assert predict(EXACT, state, periods, 6.0) == (state.mean, state.covariance)
    late = follow(EXACT, initial_state(EXACT), 0.5, 3.0, 40.0, 0.0)
    assert late.mean[0] == pytest.approx(0.5, abs=2e-3)


def test_a_velocity_without_variance_counts_as_known_to_a_millionth_of_a_radian_a_second() -> None:
    def reversing(variance: float) -> Any:
        """Mean after a period in which a velocity just below rest, known so well, is reversed."""
        return predict(EXACT, state_of((0.2, -9e-6, *UNIT), np.diag([0.0, variance, *[0.0] * 4])), 1.0, 6.0)[0]

    assert reversing(0.0) == reversing(1e-12) != reversing(1.02e-12)


def test_a_brake_that_surely_sticks_stands_still_and_tells_nothing_of_the_friction() -> None:
    state = before = state_of((0.2, 0.0, *UNIT), np.diag([0.0, 0.0, *[0.02**2] * 4]))
    for k in range(1, 20):
        state = follow(EXACT, state, 0.2, 0.0, float(k), 0.1)
    assert abs(state.mean[1]) < 1e-12
    assert state.mean[2:] == pytest.approx(before.mean[2:], abs=1e-12)
    assert errors(EXACT, state) == pytest.approx([0.02] * 4, rel=1e-9)


def test_where_it_is_not_sure_whether_the_brake_sticks_it_stays_unsure() -> None:
    state = before = follow(EXACT, initial_state(EXACT), 0.0, 0.0, 0.0, 0.0)
    for k in range(1, 40):
        state = follow(EXACT, state, 0.0, 0.0, float(k), EXACT.coulomb / EXACT.motor)  # breaks the nominal one away
    assert errors(EXACT, state)[2] > 0.8 * errors(EXACT, before)[2]


def test_a_running_mean_of_the_innovations_is_kept_and_its_greatest_value_decides() -> None:
    state = follow(EXACT, initial_state(EXACT), 30.0, 0.0, 0.0, 0.0)  # 60 standard deviations from home
    assert state.innovation > 20.0
    assert state.worst == state.innovation
    for _ in range(200):
        state = follow(EXACT, state, state.mean[0], state.mean[1], 0.0, 0.0)
    assert state.innovation < 2.0
    assert state.worst > 20.0
    sure = known(1.0, 0.0, 1e-8)._replace(worst=1.6)
    assert errors(UNEQUAL, sure) == pytest.approx([1e-4] * 4)
    widths = np.subtract(UNEQUAL.high, UNEQUAL.low)
    assert errors(UNEQUAL, sure._replace(worst=1.601)) == pytest.approx(widths / math.sqrt(12.0))


def test_values_are_cut_off_at_their_ranges_and_known_no_better_than_by_what_is_cut_off() -> None:
    for beyond, ends in ((-1.0, UNEQUAL.low), (5.0, UNEQUAL.high)):
        state = state_of((0.0, 0.0, *[beyond] * 4), 1e-8 * np.eye(6))
        assert believed(UNEQUAL, state) == ends
        assert errors(UNEQUAL, state) == pytest.approx(np.abs(np.subtract(beyond, ends)))
    state = state_of((0.0, 0.0, 0.9, 1.0, 1.1, 1.2), 1e-8 * np.eye(6))
    assert believed(UNEQUAL, state) == (0.9, 1.0, 1.1, 1.2)
    assert errors(UNEQUAL, state) == pytest.approx([1e-4] * 4)
    broken = state_of(state.mean, -1e-8 * np.eye(6))  # by rounding
    assert errors(EXACT, broken) == errors(EXACT, broken._replace(worst=2.0)) == (math.inf,) * 4
    sure = state_of((0.0, 0.0, *UNIT), np.zeros((6, 6)))
    assert errors(EXACT, sure) == (0.0,) * 4
