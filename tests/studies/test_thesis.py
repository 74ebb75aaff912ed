"""The thesis's figures anew: closed forms and second computations beside the numbers, and a verdict on each fact."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import stiffness
from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.errors import EXIT_DONE
from studies.thesis import oscillator, two_parameters
from studies.thesis.cli import ANALYSIS, main
from studies.thesis.determinant import EPSILON, Unprotected, determinant, normalised, unprotected
from studies.thesis.facts import AGREES, DIFFERS, SUGGESTED, Fact
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH


@pytest.fixture(scope="module")
def before() -> Unprotected:
    return unprotected(BENCH, 0.7)


@pytest.fixture(scope="module")
def runs() -> list[two_parameters.Excited]:
    return [two_parameters.excited(BENCH, text) for text in two_parameters.EXCITATIONS]


@pytest.fixture(scope="module")
def facts() -> list[Fact]:
    return [Fact(name, *statement) for name, of in ANALYSIS.items() for statement in of(BENCH)]


def fact(facts: list[Fact], figure: str, words: str) -> Fact:
    """The one fact of a figure whose claim has these words."""
    (found,) = (f for f in facts if f.figure == figure and words in f.claim)
    return found


def hilbert(n: int) -> list[list[Fraction]]:
    return [[Fraction(1, i + j + 1) for j in range(n)] for i in range(n)]


# --- Figures 4.2 and 4.3 ----------------------------------------------------------------------------------------------


def test_the_elimination_is_that_of_its_arithmetic() -> None:
    assert determinant(hilbert(4), Fraction) == Fraction(1, 6048000)
    assert determinant([[0, 2], [3, 1]], Fraction) == -6
    assert determinant([[1, 2], [2, 4]], Fraction) == 0
    rng = np.random.default_rng(1)
    for n in (1, 2, 3, 4, 5):
        matrix = rng.standard_normal((n, n))
        assert determinant(matrix.tolist(), float) == pytest.approx(float(np.linalg.det(matrix)), rel=1e-10)
    assert type(determinant([[np.float32(v) for v in row] for row in hilbert(4)], np.float32)) is np.float32


def test_the_exact_logarithm_is_that_of_the_matrix_where_it_is_well_conditioned(before: Unprotected) -> None:
    good = before.conditions < 1e9
    signs, logs = np.linalg.slogdet(before.fims[good])
    assert good.sum() > 400
    assert (signs == 1.0).all()
    assert before.log_exact[good] == pytest.approx(logs, abs=1e-5)


def test_the_printed_normalisation_lets_the_determinant_grow(facts: list[Fact], before: Unprotected) -> None:
    # Eq. 4.38 and 4.39 letter by letter, with alpha_k from the determinant of the normalised matrix before.
    start = 4.0 * math.log(EPSILON)
    increments = np.diff(before.fims, axis=0, prepend=np.zeros((1, 4, 4)))
    normalised, alpha = EPSILON * np.eye(4), 1.0
    for increment in increments:
        new = math.exp((start - np.linalg.slogdet(normalised)[1]) / 4.0)
        normalised = new / alpha * normalised + new * increment
        alpha = new
    drift = abs(np.linalg.slogdet(normalised)[1] - start)
    assert f"ends {drift:.3g} away" in fact(facts, "fig-4.3", "as printed the normalised determinant").found
    assert drift > 20.0


# --- Figure 5.1 -------------------------------------------------------------------------------------------------------


def fine(bench: Bench, factor: int) -> Bench:
    timing = bench.timing
    return replace(bench, timing=replace(timing, sample_time=timing.sample_time / factor, horizon=500 * factor))


def scipy_response(times: Floats) -> Floats:
    """The exact a(t) at constant 500 rad/s, by scipy's solution of eq. 5.7."""
    p = BENCH.brake
    system = scipy.signal.TransferFunction([-p.f_v * 500.0], [p.J, p.f_v, p.gamma * p.k_1])
    return np.asarray(scipy.signal.step(system, T=times)[1])


def test_the_sensitivity_at_constant_speed_tends_to_the_damped_oscillator_s() -> None:
    errors = []
    for factor in (1, 10):
        first, _ = oscillator.inputs(fine(BENCH, factor))
        exact = scipy_response(np.arange(500 * factor + 1) * 1e-3 / factor)[1:]
        errors.append(np.abs(first.s[:, 0] - exact).max())
    assert errors[0] < 0.4
    assert errors[1] == pytest.approx(errors[0] / 10.0, rel=0.05)  # Euler is of first order


def test_peak_time_and_overshoot_are_those_of_the_exact_response() -> None:
    times, closed = np.linspace(0.0, 0.5, 20_001), oscillator.oscillator(BENCH.brake)
    response = -scipy_response(times)
    assert closed.peak_time == pytest.approx(times[np.argmax(response)], abs=1.3e-5)
    settled = BENCH.brake.f_v * 500.0 / stiffness(BENCH.brake, 0.0)
    assert float(response.max()) / settled - 1.0 == pytest.approx(closed.overshoot, rel=1e-6)


def test_the_response_matrix_gives_what_the_recursion_gives() -> None:
    velocity = np.random.default_rng(2).uniform(-500.0, 500.0, 500)
    driven = oscillator.driven(BENCH, velocity)
    response = oscillator.response_matrix(BENCH)
    assert np.einsum("kjc,j->kc", response, velocity) == pytest.approx(driven.s, abs=1e-9)


def test_an_input_that_reverses_beats_the_constant_one_at_the_end(facts: list[Fact]) -> None:
    half_swing = round(oscillator.oscillator(BENCH.brake).peak_time / 1e-3)
    reversed_ = np.where(np.arange(500) < 500 - half_swing, -500.0, 500.0)
    first, _ = oscillator.inputs(BENCH)
    gain = oscillator.driven(BENCH, reversed_).increments[-1] / first.increments[-1]
    assert f"an increment {gain:.3g} times as large" in fact(facts, "fig-5.1", "upper limit").found
    assert gain > 2.9


def test_no_random_velocity_gathers_more_than_the_constant_one() -> None:
    first, second = oscillator.inputs(BENCH)
    rng = np.random.default_rng(3)
    total = first.increments.sum()
    assert second.increments.sum() < total
    for _ in range(20):
        switched = 500.0 * np.sign(np.repeat(rng.standard_normal(10), 50))
        assert oscillator.driven(BENCH, switched).increments.sum() <= total


# --- Section 6.1 ------------------------------------------------------------------------------------------------------


def test_the_runs_of_the_sensitivity_study_keep_the_limits_and_return(runs: list[two_parameters.Excited]) -> None:
    assert all(run.response.kept and run.response.home for run in runs)


def test_the_spring_that_eq_6_1_keeps_out_of_contact_matters_as_found(
    facts: list[Fact], runs: list[two_parameters.Excited]
) -> None:
    p, t_s = BENCH.brake, BENCH.timing.sample_time
    jacobian = np.eye(2) + t_s * np.array([[0.0, 1.0], [-p.gamma * p.k_1 / p.J, -p.f_v / p.J]])
    weights = np.diag([100.0, 1.0 / 250000.0])
    found, differences = fact(facts, "sec-6.1", "out of contact").found, {}
    for run in runs:
        s, fim = np.zeros((2, 2)), np.zeros((2, 2))
        for x1, x2 in run.response.states[:-1]:
            drive = np.array([[0.0, 0.0], [-p.f_v * x2, -p.k_1 * p.gamma * max(x1, 0.0)]])
            s = jacobian @ s + t_s / p.J * drive
            fim += s.T @ weights @ s
        differences[run.name] = 100.0 * np.abs(np.diag(fim) / np.diag(run.fim) - 1.0).max()
    worst = max(differences, key=lambda name: differences[name])
    assert f"by {differences[worst]:.2g} % with {worst}" in found
    assert f"by {differences['constant-speed']:.2g} % with constant-speed" in found


def test_a_correlation_is_that_of_the_inverse(runs: list[two_parameters.Excited]) -> None:
    for run in runs:
        covariance = np.linalg.inv(run.fim)
        expected = covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
        assert run.correlation == pytest.approx(expected, abs=1e-9)


# --- Verdicts ---------------------------------------------------------------------------------------------------------


def test_so_many_printed_facts_of_a_figure_agree_differ_or_are_only_suggested(facts: list[Fact]) -> None:
    expected = {"fig-4.2": (3, 2, 1), "fig-4.3": (4, 5, 0), "fig-5.1": (10, 2, 0), "sec-6.1": (3, 1, 1)}
    for figure, counts in expected.items():
        verdicts = [f.verdict for f in facts if f.figure == figure]
        assert tuple(map(verdicts.count, (AGREES, DIFFERS, SUGGESTED))) == counts, figure
    assert len(facts) == 32


def test_the_numbers_that_the_thesis_prints(facts: list[Fact]) -> None:
    for words, found in (("0.2407", "0.2407"), ("0.34 s", "Euler at 0.333 s"), ("1.3e5", "closed form 1.31e+05")):
        assert found in fact(facts, "fig-5.1", words).found


def test_a_wrong_parameter_changes_the_verdicts() -> None:
    soft = replace(BENCH, brake=BENCH.brake._replace(k_1=12.0))
    found = [Fact("fig-5.1", *statement) for statement in oscillator.oscillator_facts(soft)]
    assert not fact(found, "fig-5.1", "0.2407").agrees
    assert not fact(found, "fig-5.1", "0.34 s").agrees
    assert not fact(found, "fig-5.1", "1.3e5").agrees


def test_the_command_says_what_the_facts_are(facts: list[Fact], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fig-5.1"]) == EXIT_DONE
    assert "10 of 12 statements agree" in capsys.readouterr().out
    assert main(["--json"]) == EXIT_DONE
    assert json.loads(capsys.readouterr().out) == [fact.document() for fact in facts]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_step_rewards_are_unchanged_by_the_normalisation_and_the_determinant_stays_near_its_start(
    seed: int, n: int
) -> None:
    rng = np.random.default_rng(seed)
    halves = [rng.normal(size=(n, 2)) * 10.0 ** (k / 15.0) for k in range(60)]
    increments = np.array([half @ half.T for half in halves])
    sums = 0.1 * np.eye(n) + np.cumsum(increments, axis=0)
    rewards, logs, alphas, matrices = normalised(increments, 0.1)
    begun = n * math.log(0.1)
    np.testing.assert_allclose(rewards, np.diff(np.linalg.slogdet(sums)[1], prepend=begun), atol=1e-6)
    # eq. 4.35, and what α_k is for: |α_k M_{k−1}| = |M_init|
    np.testing.assert_allclose(matrices, np.exp(alphas)[:, None, None] * sums, rtol=1e-9)
    np.testing.assert_allclose(logs, begun + rewards, atol=1e-7)
