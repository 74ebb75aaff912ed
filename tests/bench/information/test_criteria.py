"""Criteria of an information matrix, dense and packed, beside dense linear algebra, singular ones and many at once."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emb_bench.brake.parameters import PARAMETERS
from emb_bench.information.criteria import criteria, criteria_series
from emb_bench.information.identifiability import Doubt, Spectrum, combination, identifiability, schur_complement
from emb_bench.information.symmetric import (
    Floats,
    add_increment,
    lambda_min,
    log_det,
    pack,
    trace_inverse,
)
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

FIVE = (*PARAMETER_NAMES, "J")


@pytest.mark.parametrize("matrix", [np.full((2, 2), np.nan), np.zeros((2, 3)), np.diag([1.0, -1.0])])
def test_what_is_no_information_matrix_is_refused(matrix: Floats) -> None:
    with pytest.raises(UsageError, match="square, finite Fisher information matrix"):
        criteria(matrix, ("k_m", "k_1"))


def matrices(seed: int, n: int) -> Floats:
    """A regular FIM whose parameters have very different scales."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n + 3))
    scale = 10.0 ** rng.uniform(-3.0, 3.0, n)
    return half @ half.T * np.outer(scale, scale)


@given(st.integers(0, 2**32 - 1), st.integers(2, 8), st.data())
def test_a_subset_is_judged_by_what_is_left_of_it_when_the_others_are_unknown_too(
    seed: int, n: int, data: st.DataObject
) -> None:
    names = tuple(PARAMETERS)[:n]
    interest = data.draw(st.lists(st.sampled_from(names), min_size=1, max_size=n, unique=True))
    m = matrices(seed, n)
    rows = [names.index(name) for name in interest]
    covariance = np.linalg.inv(m)[np.ix_(rows, rows)]
    found = criteria(m, names, interest)
    assert found.log_det == pytest.approx(-np.linalg.slogdet(covariance)[1], abs=1e-6)
    assert found.trace_inverse == pytest.approx(np.trace(covariance), rel=1e-6)
    assert found.lambda_min == pytest.approx(1.0 / np.linalg.eigvalsh(covariance)[-1], rel=1e-6)
    remaining = schur_complement(m, rows)
    np.testing.assert_allclose(remaining @ covariance, np.eye(len(rows)), atol=1e-5)
    assert found.condition == pytest.approx(np.linalg.eigvalsh(remaining)[-1] / found.lambda_min, rel=1e-6)
    assert tuple(found.weakest) == tuple(interest)


def test_nuisances_that_the_data_do_not_tell_leave_the_subset_its_information() -> None:
    # The two last ones enter as their sum only: it costs what one of them would, and the other nothing more.
    half = np.random.default_rng(4).normal(size=(3, 6))
    twice = np.vstack([half, half[2:]])
    names = ("k_m", "f_v", "offset", "contact")
    one = criteria(half @ half.T, names[:3], ("k_m", "f_v"))
    both = criteria(twice @ twice.T, names, ("k_m", "f_v"))
    assert both.log_det == pytest.approx(one.log_det, rel=1e-9)
    assert both.condition == pytest.approx(one.condition, rel=1e-9)
    assert not both.singular
    lost = criteria(twice @ twice.T, names, ("k_m", "offset"))
    assert (lost.log_det, lost.trace_inverse, lost.lambda_min, lost.condition) == (-math.inf, math.inf, 0.0, math.inf)
    assert lost.flat == ({"k_m": 0.0, "offset": 1.0},)


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_correlations_are_those_of_the_inverse(seed: int, n: int) -> None:
    m = matrices(seed, n)
    covariance = np.linalg.inv(m)
    deviations = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        Spectrum(m).correlation(), covariance / np.outer(deviations, deviations), rtol=0.0, atol=1e-6
    )


@given(st.integers(0, 2**32 - 1), st.integers(0, 8), st.integers(0, 4), st.booleans())
def test_a_singular_matrix_of_any_rank_has_the_worst_values_and_a_verdict_and_no_nan(
    seed: int, rank: int, dead: int, with_prior: bool
) -> None:
    rng = np.random.default_rng(seed)
    s = np.zeros((9, 40))
    s[dead:] = rng.normal(size=(9 - dead, rank)) @ rng.normal(size=(rank, 40))
    s *= 10.0 ** rng.uniform(-3.0, 3.0, 9)[:, None]
    names = tuple(PARAMETERS)[:9]
    found = criteria(s @ s.T, names)
    assert (found.log_det, found.trace_inverse, found.lambda_min, found.condition) == (
        -math.inf,
        math.inf,
        0.0,
        math.inf,
    )
    assert found.singular == (rank < 9 or dead > 0)
    assert len(found.flat) == 9 - min(rank, 9 - dead)
    for direction in found.flat:
        v = np.array(list(direction.values()))
        assert v @ v == pytest.approx(1.0)
        assert np.linalg.norm(v @ s) <= 1e-6 * np.linalg.norm(np.abs(v)[:, None] * s)
    correlation = Spectrum(s @ s.T).correlation()
    assert np.isfinite(correlation).all()
    assert (np.abs(correlation) <= 1.0).all()
    verdict = identifiability(s @ s.T, names, np.zeros((9, 9)) if with_prior else None)
    assert not verdict.identified
    assert [f.doubts for f in verdict.findings[:dead]] == [(Doubt.NO_INFORMATION,)] * dead
    assert all(math.isinf(f.deviation) for f in verdict.findings[:dead])


def test_flat_directions_without_a_parameter_in_common_are_not_mixed() -> None:
    rng = np.random.default_rng(8)
    s = rng.normal(size=(5, 30))
    s[1], s[4] = 2.0 * s[0], -s[3]
    flat = criteria(s @ s.T, tuple(PARAMETERS)[:5]).flat
    assert sorted(combination(direction) for direction in flat) == [
        "+0.707 f_v +0.707 J",
        "+0.894 k_m -0.447 k_1",
    ]


def test_parameters_on_one_flat_direction_are_correlated_by_it_and_not_with_the_others() -> None:
    s = np.random.default_rng(8).normal(size=(4, 30))
    s[1] = 2.0 * s[0]
    correlation = Spectrum(s @ s.T).correlation()
    assert correlation[0, 1] == pytest.approx(-1.0, abs=1e-9)
    np.testing.assert_array_equal(correlation[:2, 2:], np.zeros((2, 2)))
    assert 0.0 < abs(correlation[2, 3]) < 1.0


def test_what_counts_as_told_depends_on_the_unit() -> None:
    # Deviations of 2: two hundred percent of k_m, two samples of delay, two rad/s at the start.
    verdict = identifiability(0.25 * np.eye(3), ("k_m", "delay", "x2_0"))
    assert [f.identified for f in verdict.findings] == [False, False, True]
    assert verdict.findings[0].doubts == (Doubt.TOO_WIDE,)
    assert verdict.findings[1].doubts == (Doubt.TOO_WIDE,)
    assert [(f.deviation, f.unit) for f in verdict.findings] == [(2.0, ""), (2.0, "samples"), (2.0, "rad/s")]
    assert {tuple(d.shares.values()) for d in verdict.directions} == {(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)}
    assert [d.deviation for d in verdict.directions] == [2.0, 2.0]


def test_what_was_known_before_is_no_merit_of_the_data() -> None:
    prior = 12.0 * np.eye(2)
    verdict = identifiability(prior + np.diag([100.0, 0.1]), ("k_m", "f_v"), prior)
    assert [f.identified for f in verdict.findings] == [True, False]
    assert verdict.findings[1].doubts == (Doubt.NOTHING_NEW,)


@pytest.mark.parametrize("interest", [(), ("J",)])
def test_a_subset_that_is_none_is_refused(interest: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="expected some of k_m, f_v"):
        criteria(np.eye(2), ("k_m", "f_v"), interest)


def test_a_parameter_with_little_information_of_its_own_keeps_its_share_of_a_flat_direction() -> None:
    rng = np.random.default_rng(5)
    s = rng.standard_normal((40, 5)) * [1e6, 1e-1, 1e6, 1e6, 0.0]
    s[:, 4] = -s[:, :4].sum(axis=1)  # only the common scale of all five leaves no trace
    verdict = identifiability(s.T @ s, FIVE)
    (direction,) = verdict.directions
    np.testing.assert_allclose(list(direction.shares.values()), np.full(5, 5**-0.5), rtol=1e-6)
    assert not any(finding.identified for finding in verdict.findings)


def test_what_only_the_prior_tells_is_said_to_come_from_it() -> None:
    rng = np.random.default_rng(6)
    s = 1e4 * rng.standard_normal((40, 5))
    s[:, 4] = -s[:, :4].sum(axis=1)
    prior = np.diag([12.0, 12.0, 12.0, 12.0, 0.0])
    (shares,) = identifiability(s.T @ s + prior, FIVE, prior).left_to_prior
    np.testing.assert_allclose(list(shares.values()), np.full(5, 5**-0.5), rtol=1e-6)
    assert identifiability(s.T @ s + prior, FIVE).left_to_prior == ()


# --- Many matrices at once -----------------------------------------------------------------------------------------


def growing(seed: int, samples: int, dead: int, twins: bool) -> Floats:
    """Information after each sample: singular at first, and for ever with a dead parameter or two that are alike."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((samples, len(PARAMETER_NAMES))) * 10.0 ** rng.uniform(-3.0, 3.0, len(PARAMETER_NAMES))
    if dead < len(PARAMETER_NAMES):
        rows[:, dead] = 0.0
    if twins:
        rows[:, 1] = -2.0 * rows[:, 0]
    result: Floats = np.cumsum(rows[:, :, None] * rows[:, None, :], axis=0)
    return result


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    samples=st.integers(0, 12),
    dead=st.integers(0, 9),
    twins=st.booleans(),
    interest=st.lists(st.sampled_from(PARAMETER_NAMES), min_size=1, unique=True),
)
@example(seed=916, samples=5, dead=2, twins=False, interest=["k_m"])  # only just lost
def test_each_matrix_has_the_numbers_that_it_has_alone(
    seed: int, samples: int, dead: int, twins: bool, interest: list[str]
) -> None:
    matrices = growing(seed, samples, dead, twins)
    series = criteria_series(matrices, PARAMETER_NAMES, interest)
    alone = [criteria(matrix, PARAMETER_NAMES, interest) for matrix in matrices]
    np.testing.assert_allclose(series.log_det, [c.log_det for c in alone], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(series.lambda_min, [c.lambda_min for c in alone], rtol=1e-6)
    np.testing.assert_allclose(series.trace_inverse, [c.trace_inverse for c in alone], rtol=1e-6)


def badly_scaled(seed: int, n: int) -> tuple[Floats, Floats]:
    """A random positive definite matrix with scales over eight decades, and its inverse by way of the scaled one."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n + 2))
    scale = 10.0 ** rng.uniform(-4.0, 4.0, n)
    core = half @ half.T
    return core * np.outer(scale, scale), np.linalg.inv(core) / np.outer(scale, scale)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_the_criteria_are_those_of_dense_linear_algebra_whatever_the_scales(seed: int, n: int) -> None:
    matrix, inverse = badly_scaled(seed, n)
    m, work = pack(matrix), np.full((n, n), np.nan)
    assert log_det(m, work) == pytest.approx(-np.linalg.slogdet(inverse)[1], abs=1e-6)
    assert trace_inverse(m, work) == pytest.approx(np.trace(inverse), rel=1e-6)
    assert lambda_min(m, work) == pytest.approx(1.0 / np.linalg.eigvalsh(inverse)[-1], rel=1e-6)
    np.testing.assert_array_equal(m, pack(matrix))


def test_a_small_eigenvalue_beside_a_large_one_loses_no_digit_to_cancellation() -> None:
    # Half the trace less the root of the discriminant would give 2.0 or 0.0 here, whatever the small entry.
    assert lambda_min(np.array([1e16, 0.0, 1.2345]), np.empty((2, 2))) == pytest.approx(1.2345, rel=1e-14)
    large, off, small = Fraction(10**12), Fraction(10**5), Fraction(3, 100)
    exact = (large * small - off * off) / large  # |M| / λ_max, λ_max being `large` to 1e-14
    found = lambda_min(np.array([1e12, 1e5, 0.03]), np.empty((2, 2)))
    assert found == pytest.approx(float(exact), rel=1e-13)
    assert lambda_min(pack(np.diag([1e14, 1e7, 1.2345])), np.empty((3, 3))) == pytest.approx(1.2345, rel=1e-14)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.ones((3, 3)),
        np.diag([1.0, 0.0, 1.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.full((3, 3), np.nan),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([1.0, np.inf, 1.0]),
    ],
    ids=["zero", "rank one", "zero pivot", "indefinite", "nan", "nan on the diagonal", "infinite"],
)
def test_a_matrix_that_tells_nothing_certain_has_the_worst_values_and_never_nan(matrix: Floats) -> None:
    m, work = pack(matrix), np.empty((3, 3))
    assert (log_det(m, work), trace_inverse(m, work), lambda_min(m, work)) == (-math.inf, math.inf, 0.0)


def test_what_rounding_leaves_of_a_singular_sum_counts_as_singular() -> None:
    rng = np.random.default_rng(3)
    m = np.zeros(3)
    for s in rng.normal(size=(500, 2)):
        add_increment(m, np.array([s, 0.3 * s]), 1e6, 1.0)  # the second parameter always does 0.3 of the first
    assert log_det(m, np.empty((2, 2))) == -math.inf
    assert m[0] * m[2] - m[1] * m[1] != 0.0  # a determinant in floating point would have had a logarithm, or NaN
