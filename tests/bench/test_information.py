from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import step
from emb_bench.information import (
    Kind,
    NormaliseBy,
    NormalisedFisher,
    criteria,
    epsilon_identity,
    fisher,
    information_over_time,
    physical_weights,
    relative_to,
    sensitivities,
    thesis_weights,
    trajectory,
    uniform_prior,
)
from emb_bench.packed import Floats, log_det, pack
from emb_runtime.bench import PARAMETER_NAMES, load_bench
from emb_runtime.errors import UsageError

BENCH = load_bench()
BRAKE = BENCH.brake
T_S = BENCH.timing.sample_time


def square(half_period: int, current: float) -> Floats:
    """500 samples of a square wave, positive first."""
    return np.where(np.arange(500) // half_period % 2 == 0, current, -current)


def physical(
    currents: Floats, params: tuple[str, ...] = PARAMETER_NAMES, x0: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    return fisher(BENCH, BRAKE, currents, kind="physical", normalise_by="true", params=params, x0=x0).matrix


def test_the_weights_are_those_of_the_thesis_and_of_the_sensors() -> None:
    assert thesis_weights(BENCH.noise, BENCH.limits) == pytest.approx((100.0, 1.0 / 250000.0), rel=1e-12)
    assert physical_weights(BENCH.noise) == pytest.approx((1e6, 1.0), rel=1e-12)


def test_a_trajectory_is_one_step_after_the_other_and_begins_at_its_start() -> None:
    currents = [3.0, -1.0, 2.0]
    states = trajectory(BRAKE, currents, T_S, (1.0, -20.0))
    assert states.shape == (4, 2)
    assert tuple(states[0]) == (1.0, -20.0)
    for (x1, x2), u, after in zip(states.tolist(), currents, states[1:], strict=False):
        assert tuple(after) == step(BRAKE, x1, x2, u, T_S)


def test_the_first_sample_counts_after_the_first_step() -> None:
    s = sensitivities(BRAKE, [2.0], T_S, ("k_m", "f_v"))
    assert s.shape == (1, 2, 2)
    assert s[0, 0].tolist() == pytest.approx([0.0, T_S * BRAKE.k_m * 2.0 / BRAKE.J], rel=1e-15)
    assert s[0, 1].tolist() == [0.0, 0.0]


def test_sensitivities_come_in_the_order_of_the_names_asked_for() -> None:
    currents = square(25, 2.0)
    everything = sensitivities(BRAKE, currents, T_S)
    some = sensitivities(BRAKE, currents, T_S, ("f_v", "k_1"))
    np.testing.assert_array_equal(some, everything[:, [3, 1]])


def test_sensitivities_are_the_finite_differences_of_the_trajectory_to_each_parameter() -> None:
    currents = 1.2 + 0.3 * np.sin(0.1 * np.arange(150))
    start = (1.0, 60.0)
    s = sensitivities(BRAKE, currents, T_S, x0=start)
    h = 1e-6
    for i, name in enumerate(PARAMETER_NAMES):
        above, below = (
            trajectory(BRAKE._replace(**{name: getattr(BRAKE, name) * factor}), currents, T_S, start)
            for factor in (1.0 + h, 1.0 - h)
        )
        assert (above[:, 1] > 0.0).all()
        np.testing.assert_allclose(s[:, i], ((above - below) / (2.0 * h))[1:], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("half_period", "current", "expected"), [(10, 6.0, 80.8), (50, 1.5, 83.1), (500, 0.9, 91.4)])
def test_log_det_of_known_designs_is_what_an_independent_implementation_found(
    half_period: int, current: float, expected: float
) -> None:
    assert criteria(physical(square(half_period, current)), PARAMETER_NAMES).log_det == pytest.approx(
        expected, abs=0.06
    )


@pytest.mark.parametrize(("kind", "scale"), [("physical", (1.0, 1.0)), ("weighted", (100.0, 500.0))])
def test_the_fisher_information_is_the_sum_of_the_outer_products(kind: Kind, scale: tuple[float, float]) -> None:
    s = sensitivities(BRAKE, square(20, 4.0), T_S) / np.array(scale)
    inverse_noise = np.diag([BENCH.noise.angle**-2, BENCH.noise.velocity**-2])
    found = fisher(BENCH, BRAKE, square(20, 4.0), kind=kind, normalise_by="true")
    np.testing.assert_allclose(found.matrix, np.einsum("kia,ab,kjb->ij", s, inverse_noise, s), rtol=1e-11)
    assert (found.kind, found.params, found.theta, found.prior) == (kind, PARAMETER_NAMES, BRAKE, None)


def test_information_over_time_ends_at_the_whole_and_never_shrinks() -> None:
    s = sensitivities(BRAKE, square(20, 4.0), T_S)
    history = information_over_time(s, physical_weights(BENCH.noise))
    assert history.shape == (500, 4, 4)
    np.testing.assert_array_equal(history[-1], physical(square(20, 4.0)))
    assert (np.diff(history.diagonal(axis1=1, axis2=2), axis=0) >= 0.0).all()


@pytest.mark.parametrize("normalise_by", ["true", "nominal"])
def test_information_is_relative_to_the_values_it_says(normalise_by: NormaliseBy) -> None:
    p = BRAKE._replace(k_1=2.0 * BRAKE.k_1, f_v=0.5 * BRAKE.f_v)
    found = fisher(BENCH, p, square(20, 4.0), kind="physical", normalise_by=normalise_by)
    ratio = np.array([1.0, 0.5, 1.0, 2.0]) if normalise_by == "nominal" else np.ones(4)
    expected = fisher(BENCH, p, square(20, 4.0), kind="physical", normalise_by="true").matrix * np.outer(ratio, ratio)
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-12)
    assert found.normalise_by == normalise_by
    assert relative_to(p, BRAKE, PARAMETER_NAMES).tolist() == [1.0, 0.5, 1.0, 2.0]


def test_a_lost_sample_tells_nothing_but_the_brake_moves_on() -> None:
    s = sensitivities(BRAKE, square(20, 4.0), T_S)
    measured = np.random.default_rng(2).random(500) > 0.2
    history = information_over_time(s, physical_weights(BENCH.noise), measured=measured)
    np.testing.assert_allclose(history[-1], information_over_time(s[measured], physical_weights(BENCH.noise))[-1])
    nothing = fisher(
        BENCH, BRAKE, square(20, 4.0), kind="physical", normalise_by="true", measured=np.zeros(500, dtype=bool)
    )
    assert nothing.criteria().log_det == -math.inf


def test_criteria_worked_by_hand() -> None:
    found = criteria(np.diag([4.0, 1.0]), ("k_m", "f_v"))
    assert found.log_det == pytest.approx(math.log(4.0), rel=1e-15)
    assert (found.trace_inverse, found.lambda_min, found.condition) == pytest.approx((1.25, 1.0, 4.0), rel=1e-15)
    assert not found.singular
    assert found.weakest == {"k_m": 0.0, "f_v": 1.0}
    assert found.verdict() == "every parameter is told; worst: +1 f_v"


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_criteria_are_those_of_dense_linear_algebra_whatever_the_scales(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n + 2))
    scale = 10.0 ** rng.uniform(-4.0, 4.0, n)
    inverse = np.linalg.inv(half @ half.T) / np.outer(scale, scale)
    found = criteria(half @ half.T * np.outer(scale, scale), PARAMETER_NAMES[:n])
    assert found.log_det == pytest.approx(-np.linalg.slogdet(inverse)[1], abs=1e-6)
    assert found.trace_inverse == pytest.approx(np.trace(inverse), rel=1e-6)
    assert found.lambda_min == pytest.approx(1.0 / np.linalg.eigvalsh(inverse)[-1], rel=1e-6)
    assert found.condition >= 1.0 - 1e-9
    assert not found.singular


def test_a_motion_in_one_direction_under_constant_current_names_the_direction_that_it_does_not_tell() -> None:
    # While it moves forward, 1 % more motor torque and the friction that eats it up look the same.
    current = 2.7
    found = fisher(BENCH, BRAKE, np.full(150, current), kind="physical", normalise_by="true", x0=(0.0, 10.0))
    assert (trajectory(BRAKE, np.full(150, current), T_S, (0.0, 10.0))[:, 1] > 0.0).all()
    verdict = found.criteria()
    assert (verdict.log_det, verdict.trace_inverse, verdict.lambda_min) == (-math.inf, math.inf, 0.0)
    assert verdict.condition == math.inf
    assert verdict.singular
    (flat,) = verdict.flat
    assert flat == verdict.weakest
    assert flat["k_m"] / flat["T_c"] == pytest.approx(BRAKE.T_c / (BRAKE.k_m * current), rel=1e-6)
    assert (abs(flat["k_1"]), abs(flat["f_v"])) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert verdict.verdict() == "singular: the data do not tell +0.174 k_m +0.985 T_c"


def test_what_is_not_told_has_an_infinite_bound_and_the_others_keep_theirs() -> None:
    currents, start = np.full(150, 2.7), (0.0, 10.0)
    bounds = fisher(BENCH, BRAKE, currents, kind="physical", normalise_by="true", x0=start).cramer_rao()
    told = fisher(
        BENCH, BRAKE, currents, kind="physical", normalise_by="true", x0=start, params=("k_m", "k_1", "f_v")
    ).cramer_rao()
    assert (bounds["k_m"], bounds["T_c"]) == (math.inf, math.inf)
    # The two that look alike are one parameter's worth of doubt, whichever of the two is kept.
    assert (bounds["k_1"], bounds["f_v"]) == pytest.approx((told["k_1"], told["f_v"]), rel=1e-5)


def test_a_brake_at_rest_tells_nothing() -> None:
    found = fisher(BENCH, BRAKE, np.zeros(500), kind="physical", normalise_by="true")
    assert found.cramer_rao() == dict.fromkeys(PARAMETER_NAMES, math.inf)
    assert found.criteria().log_det == -math.inf
    assert len(found.criteria().flat) == 4


def test_no_samples_leave_what_was_known_before() -> None:
    assert not fisher(BENCH, BRAKE, [], kind="physical", normalise_by="true").matrix.any()


def test_knowing_a_range_of_fifty_percent_is_worth_twelve_and_bounds_what_a_resting_brake_does_not() -> None:
    prior = uniform_prior(BENCH.range_set("pm50"), PARAMETER_NAMES, BRAKE)
    np.testing.assert_allclose(prior, 12.0 * np.eye(4), rtol=1e-12, atol=0.0)
    found = fisher(BENCH, BRAKE, np.zeros(500), kind="physical", normalise_by="nominal", prior=prior)
    assert list(found.cramer_rao().values()) == pytest.approx([1.0 / math.sqrt(12.0)] * 4, rel=1e-12)
    np.testing.assert_array_equal(found.prior, prior)


def test_a_parameter_that_does_not_vary_has_no_prior() -> None:
    with pytest.raises(UsageError, match="k_m does not vary in the ranges 'viscous'"):
        uniform_prior(BENCH.range_set("viscous"), ("k_m",), BRAKE)


def test_the_weighted_information_gives_no_bound() -> None:
    found = fisher(BENCH, BRAKE, square(20, 4.0), kind="weighted", normalise_by="true")
    with pytest.raises(UsageError, match="needs the physical Fisher information"):
        found.cramer_rao()


def test_the_spread_of_estimates_is_the_bound_of_the_physical_information_and_not_the_inverse_of_the_weighted() -> None:
    # Least squares on the trajectory linearised by finite differences: knows no Fisher information.
    currents = 1.0 + 0.8 * np.sign(np.sin(0.15 * np.arange(200)))
    rng = np.random.default_rng(11)
    h = 1e-5
    columns = []
    for name in PARAMETER_NAMES:
        above, below = (
            trajectory(BRAKE._replace(**{name: getattr(BRAKE, name) * f}), currents, T_S, (0.0, 5.0))
            for f in (1.0 + h, 1.0 - h)
        )
        columns.append(((above - below)[1:] / (2.0 * h) / [BENCH.noise.angle, BENCH.noise.velocity]).ravel())
    noise = rng.standard_normal((400, 2000))
    errors = np.linalg.lstsq(np.stack(columns, axis=1), noise, rcond=None)[0].T
    # e^T M e has the mean 4 and the variance 8: over 2000 estimates the mean has the deviation 0.063.
    means = {}
    kinds: tuple[Kind, Kind] = ("physical", "weighted")
    for kind in kinds:
        m = fisher(BENCH, BRAKE, currents, kind=kind, normalise_by="true", x0=(0.0, 5.0)).matrix
        means[kind] = float(np.einsum("ni,ij,nj->n", errors, m, errors).mean())
    assert means["physical"] == pytest.approx(4.0, abs=0.25)
    assert means["weighted"] < 1e-3


def test_without_a_start_the_determinant_turns_negative_and_with_one_its_logarithm_is_continuous() -> None:
    # Thesis Fig. 4.2 and 4.3: constant input, the determinant by elimination, before and after ε I.
    s = sensitivities(BRAKE, np.full(500, 2.0), T_S, x0=(0.0, 10.0))
    weights = thesis_weights(BENCH.noise, BENCH.limits)
    bare = information_over_time(s, weights)
    assert (np.linalg.det(bare) < 0.0).any()
    logs = [log_det(pack(m), np.empty((4, 4))) for m in bare]
    assert not np.isnan(logs).any()
    started = information_over_time(s, weights, epsilon_identity(4, 1e-2))
    logs = [log_det(pack(m), np.empty((4, 4))) for m in started]
    assert np.isfinite(logs).all()
    assert logs[0] == pytest.approx(4.0 * math.log(1e-2), abs=0.1)
    assert (np.diff(logs) >= -1e-6).all()
    assert np.diff(logs).max() < 2.0


def test_epsilon_raises_every_eigenvalue_by_itself() -> None:
    m = physical(square(20, 4.0))
    shifted = np.linalg.eigvalsh(m + epsilon_identity(4, 1e3))
    np.testing.assert_allclose(shifted, np.linalg.eigvalsh(m) + 1e3, rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_step_rewards_are_unchanged_by_the_normalisation_and_the_determinant_stays_near_its_start(
    seed: int, n: int
) -> None:
    rng = np.random.default_rng(seed)
    plain = epsilon_identity(n, 0.1)
    normalised = NormalisedFisher.start(plain)
    total = 0.0
    for k in range(60):
        half = rng.normal(size=(n, 2)) * 10.0 ** (k / 15.0)
        before, plain = np.linalg.slogdet(plain)[1], plain + half @ half.T
        normalised, reward = normalised.add(half @ half.T)
        total += reward
        assert reward == pytest.approx(np.linalg.slogdet(plain)[1] - before, abs=1e-7)
        # eq. 4.35, and what α_k is for: |α_k M_{k−1}| = |M_init|
        np.testing.assert_allclose(normalised.matrix, math.exp(normalised.log_alpha) * plain, rtol=1e-9)
        assert normalised.log_det == pytest.approx(n * math.log(0.1) + reward, abs=1e-7)
    assert total == pytest.approx(np.linalg.slogdet(plain)[1] - n * math.log(0.1), abs=1e-6)


def test_a_singular_start_of_the_normalisation_is_refused() -> None:
    with pytest.raises(UsageError, match="begin at epsilon_identity or uniform_prior"):
        NormalisedFisher.start(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ((), "at least one parameter"),
        (("k_m", "mass"), "'mass' is no parameter"),
        (("f_v", "f_v"), "comes twice"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(params: tuple[str, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        sensitivities(BRAKE, [1.0], T_S, params)


def test_currents_that_are_no_numbers_are_refused_with_their_place() -> None:
    with pytest.raises(UsageError, match="got nan at step 2"):
        trajectory(BRAKE, [1.0, 2.0, math.nan], T_S)
    with pytest.raises(UsageError, match="one row of currents"):
        sensitivities(BRAKE, np.zeros((3, 2)), T_S)


@pytest.mark.parametrize("matrix", [np.full((2, 2), np.nan), np.zeros((2, 3)), np.diag([1.0, -1.0])])
def test_what_is_no_information_matrix_is_refused(matrix: Floats) -> None:
    with pytest.raises(UsageError, match="square, finite Fisher information matrix"):
        criteria(matrix, ("k_m", "k_1"))


def test_the_base_install_is_enough() -> None:
    code = (
        "import sys, emb_bench.information, emb_bench.compiled; print(*sorted({'numba', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == ""
