"""Fisher information of currents and records, beside finite differences and the spread of estimates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import NO_ERRORS, SystematicErrors, Theta, simulate
from emb_bench.information.evaluation import Fit, Question, information_and_fit
from emb_bench.information.evaluation import expected as expected_of
from emb_bench.information.fisher import (
    Fisher,
    Kind,
    information_over_time,
    physical_weights,
    thesis_weights,
    uniform_prior,
    weights_along,
)
from emb_bench.information.identifiability import Border
from emb_bench.information.symmetric import Floats, log_det, pack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import UsageError
from tests.bench.flows import euler_states, fisher, of_euler, square
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
BRAKE = BENCH.brake
T_S = BENCH.timing.sample_time
EULER = BENCH.plant("euler")
EXACT = BENCH.plant("exact")


def of(
    currents: Sequence[float] | Floats,
    params: Sequence[str] = PARAMETER_NAMES,
    plant: str = "exact",
    *,
    p: BrakeParameters = BRAKE,
    kind: Kind = "physical",
    **more: Any,
) -> Fisher:
    """Physical information on the nominal brake unless another is asked for."""
    return fisher(BENCH, p, currents, kind=kind, params=params, plant=BENCH.plant(plant), **more)


@pytest.mark.parametrize(("kind", "scale"), [("physical", (1.0, 1.0)), ("weighted", (100.0, 500.0))])
def test_the_fisher_information_is_the_sum_of_the_outer_products(kind: Kind, scale: tuple[float, float]) -> None:
    s = of_euler(square(20, 4.0)) / np.array(scale)
    inverse_noise = np.diag([BENCH.noise.angle**-2, BENCH.noise.velocity**-2])
    found = of(square(20, 4.0), kind=kind, plant="euler")
    np.testing.assert_allclose(found.matrix, np.einsum("kia,ab,kjb->ij", s, inverse_noise, s), rtol=1e-11)
    assert (found.kind, found.params, found.theta, found.prior) == (kind, PARAMETER_NAMES, BRAKE, None)


def test_a_lost_sample_tells_nothing_but_the_brake_moves_on() -> None:
    s = of_euler(square(20, 4.0))
    measured = np.random.default_rng(2).random(500) > 0.2
    history = information_over_time(s, physical_weights(BENCH.noise), measured=measured)
    np.testing.assert_allclose(history[-1], information_over_time(s[measured], physical_weights(BENCH.noise))[-1])
    nothing = of(square(20, 4.0), plant="euler", measured=np.zeros(500, dtype=bool))
    assert nothing.criteria().log_det == -math.inf


def test_what_is_not_told_has_an_infinite_bound_and_the_others_keep_theirs() -> None:
    currents, start = np.full(150, 2.7), (0.0, 10.0)
    bounds = of(currents, plant="euler", x0=start).cramer_rao()
    told = of(currents, plant="euler", x0=start, params=("k_m", "k_1", "f_v")).cramer_rao()
    assert (bounds["k_m"], bounds["T_c"]) == (math.inf, math.inf)
    # The two that look alike are one parameter's worth of doubt, whichever of the two is kept.
    assert (bounds["k_1"], bounds["f_v"]) == pytest.approx((told["k_1"], told["f_v"]), rel=1e-5)


def test_knowing_a_range_of_fifty_percent_is_worth_twelve_and_bounds_what_a_resting_brake_does_not() -> None:
    prior = uniform_prior(BENCH.range_set("pm50"), PARAMETER_NAMES, BRAKE)
    np.testing.assert_allclose(prior, 12.0 * np.eye(4), rtol=1e-12, atol=0.0)
    found = of(np.zeros(500), plant="euler", prior=prior)
    assert list(found.cramer_rao().values()) == pytest.approx([1.0 / math.sqrt(12.0)] * 4, rel=1e-12)
    np.testing.assert_array_equal(found.prior, prior)


def test_the_weighted_information_gives_no_bound() -> None:
    found = of(square(20, 4.0), kind="weighted", plant="euler")
    for answer in (found.cramer_rao, found.correlation, found.identifiability):
        with pytest.raises(UsageError):
            answer()


def test_the_spread_of_estimates_is_the_bound_of_the_physical_information_and_not_the_inverse_of_the_weighted() -> None:
    # Least squares on the trajectory linearised by finite differences: knows no Fisher information.
    currents = 1.0 + 0.8 * np.sign(np.sin(0.15 * np.arange(200)))
    rng = np.random.default_rng(11)
    h = 1e-5
    columns = []
    for name in PARAMETER_NAMES:
        above, below = (
            euler_states(BRAKE._replace(**{name: getattr(BRAKE, name) * f}), currents, (0.0, 5.0))
            for f in (1.0 + h, 1.0 - h)
        )
        columns.append(((above - below)[1:] / (2.0 * h) / [BENCH.noise.angle, BENCH.noise.velocity]).ravel())
    noise = rng.standard_normal((400, 2000))
    errors = np.linalg.lstsq(np.stack(columns, axis=1), noise, rcond=None)[0].T
    # e^T M e has the mean 4 and the variance 8: over 2000 estimates the mean has the deviation 0.063.
    means = {}
    kinds: tuple[Kind, Kind] = ("physical", "weighted")
    for kind in kinds:
        m = of(currents, kind=kind, plant="euler", x0=(0.0, 5.0)).matrix
        means[kind] = float(np.einsum("ni,ij,nj->n", errors, m, errors).mean())
    assert means["physical"] == pytest.approx(4.0, abs=0.25)
    assert means["weighted"] < 1e-3


def test_without_a_start_the_determinant_turns_negative_and_with_one_its_logarithm_is_continuous() -> None:
    # Thesis Fig. 4.2 and 4.3: constant input, the determinant by elimination, before and after ε I.
    s = of_euler(np.full(500, 2.0), x0=(0.0, 10.0))
    weights = thesis_weights(BENCH.noise, BENCH.limits)
    bare = information_over_time(s, weights)
    assert (np.linalg.det(bare) < 0.0).any()
    logs = [log_det(pack(m), np.empty((4, 4))) for m in bare]
    assert not np.isnan(logs).any()
    started = information_over_time(s, weights, 1e-2 * np.eye(4))
    logs = [log_det(pack(m), np.empty((4, 4))) for m in started]
    assert np.isfinite(logs).all()
    assert logs[0] == pytest.approx(4.0 * math.log(1e-2), abs=0.1)
    assert (np.diff(logs) >= -1e-6).all()
    assert np.diff(logs).max() < 2.0


def chirp() -> Floats:
    """1 to 50 Hz, 3 A."""
    t = np.arange(500) * T_S
    return 3.0 * np.sin(2.0 * np.pi * (t + 0.5 * 49.0 / 0.5 * t**2))


@pytest.mark.parametrize(
    ("currents", "by_euler", "by_exact"),
    [(square(10, 6.0), 80.8, 70.3), (square(50, 1.5), 83.1, 78.9), (chirp(), 92.8, 87.4)],
    ids=["square 20 ms", "square 100 ms", "chirp"],
)
def test_euler_finds_information_that_the_exact_brake_does_not_give(
    currents: Floats, by_euler: float, by_exact: float
) -> None:
    assert of(currents, plant="euler").criteria().log_det == pytest.approx(by_euler, abs=0.06)
    assert of(currents).criteria().log_det == pytest.approx(by_exact, abs=0.06)


def test_a_brake_that_moves_once_and_stays_is_singular_and_euler_pays_for_its_chatter() -> None:
    # While it moves forward, motor and friction torque are one number; Euler never comes to rest and tells them apart.
    currents = np.full(500, 0.9)
    chatter = simulate(EULER, Theta(BRAKE), planned(currents), T_S).states[-100:, 1]
    assert 0.0 < np.abs(chatter).max() < 2.0 * BRAKE.T_c * T_S / BRAKE.J
    invented = of(currents, plant="euler")
    assert invented.criteria().log_det == pytest.approx(91.4, abs=0.06)
    assert max(invented.cramer_rao().values()) < 1e-4
    found = of(currents)
    assert (simulate(EXACT, Theta(BRAKE), planned(currents), T_S).states[-100:, 1] == 0.0).all()
    assert found.criteria().singular
    assert found.criteria().log_det == -math.inf
    (flat,) = found.criteria().flat
    length = math.hypot(BRAKE.T_c, BRAKE.k_m * 0.9)
    assert flat == pytest.approx({"k_m": BRAKE.T_c / length, "k_1": 0.0, "T_c": BRAKE.k_m * 0.9 / length, "f_v": 0.0})
    assert np.isfinite([found.cramer_rao()[name] for name in ("k_1", "f_v")]).all()


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32 - 1))
def test_with_the_inertia_free_no_sequence_tells_the_common_scale_of_all_torques(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = BENCH.range_set("pm50")
    p = BrakeParameters(*(rng.uniform(low, high) for low, high in zip(box.low, box.high, strict=True)))
    currents = np.repeat(rng.uniform(-6.0, 6.0, 12), 25)
    params = (*PARAMETER_NAMES, "J")
    found = of(currents, params=params, p=p)
    assert found.criteria().singular
    together = np.full(5, 1.0 / math.sqrt(5.0))
    flat = np.array([list(direction.values()) for direction in found.criteria().flat]).T
    np.testing.assert_allclose(flat @ np.linalg.pinv(flat) @ together, together, atol=1e-6)


def test_the_verdict_names_the_common_scale_and_the_shift_of_all_angles() -> None:
    found = of(chirp(), (*PARAMETER_NAMES, "J"), nuisances=("contact", "offset", "x1_0"))
    scale, shift = (direction.shares for direction in found.identifiability().directions)
    assert all(scale[name] == pytest.approx(5**-0.5, rel=1e-3) for name in (*PARAMETER_NAMES, "J"))
    assert (shift["contact"], -shift["offset"], shift["x1_0"]) == pytest.approx([3**-0.5] * 3, rel=1e-3)
    assert not found.identifiability().identified
    assert of(chirp()).identifiability().identified


def test_a_bound_above_the_value_itself_is_not_taken_for_an_answer() -> None:
    # A tenth of a milliampere in the middle of a constant current makes the matrix regular, and tells nothing.
    found = of(np.where(np.arange(500) < 100, 0.9, 0.9001))
    assert not found.criteria().singular
    assert found.criteria().log_det > 60.0
    verdict = found.identifiability(BENCH.range_set("pm50"))
    told = {finding.name: finding.identified for finding in verdict.findings}
    assert told == {"k_m": False, "k_1": True, "T_c": False, "f_v": True}
    (direction,) = verdict.directions
    assert direction.deviation > 1.0
    assert verdict.findings[0].border is Border.AT_LOWER
    assert direction.shares["k_m"] == pytest.approx(0.469, abs=1e-3)


def test_an_error_of_the_sampling_instant_is_worth_what_the_output_changes_in_it() -> None:
    states = np.array([[0.0, 0.0], [0.1, 200.0], [0.4, 300.0]])
    found = weights_along(BENCH, "physical", Instruments(clock_jitter=1e-5), states)
    # 200 rad/s and 2e5 rad/s², then 300 rad/s and 1e5 rad/s², for 10 µs
    expected = [[1.0 / (1e-6 + 4e-6), 1.0 / (1.0 + 4.0)], [1.0 / (1e-6 + 9e-6), 1.0 / (1.0 + 1.0)]]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    thesis = weights_along(BENCH, "weighted", Instruments(clock_jitter=1e-5), states)
    np.testing.assert_array_equal(thesis, [thesis_weights(BENCH.noise, BENCH.limits)] * 2)
    assert of(chirp(), plant="jitter").criteria().log_det < of(chirp()).criteria().log_det - 3.0


def test_two_estimates_that_replace_each_other_are_called_traded_off() -> None:
    found = of(square(10, 6.0))
    correlation = found.correlation()
    np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)
    assert correlation[2, 3] == pytest.approx(-0.9998, abs=1e-4)
    (friction,) = (finding for finding in found.identifiability().findings if finding.name == "T_c")
    assert list(friction.traded_with) == ["f_v"]
    assert friction.traded_with["f_v"] == pytest.approx(-0.9998, abs=1e-4)


def test_a_value_that_cannot_be_told_from_the_end_of_its_range_is_at_a_border() -> None:
    for k_1, expected in (
        (24.0, Border.BELOW),
        (25.0, Border.AT_LOWER),
        (30.0, None),
        (50.0, Border.AT_UPPER),
    ):
        verdict = of(chirp(), p=BRAKE._replace(k_1=k_1)).identifiability(BENCH.range_set("viscous-stiffness"))
        assert {f.name: f.border for f in verdict.findings} == {"k_m": None, "k_1": expected, "T_c": None, "f_v": None}


FINE = 20  # Steps of the simulation in a period
CURRENTS = np.repeat([2.0, -1.5, 1.0, 0.3], 20)


def shown(
    bench: Bench, late: int = 0, offset: float = 0.0, current_offset: float = 0.0, gain: float = 0.0
) -> Experiment:
    """What the sensors of a brake show without noise, simulated in short steps.

    Args:
        bench: the brake.
        late: by which each command acts late, or its sample is taken late if negative [steps].
        offset: of the encoder [rad].
        current_offset: acts besides [A].
        gain: relative error of the velocity's scale.
    """
    acted = np.concatenate([np.zeros(max(late, 0)), np.repeat(CURRENTS, FINE)]) + current_offset
    plant, t_s = bench.plant("exact"), bench.timing.sample_time
    fine = simulate(plant, Theta(bench.brake), planned(acted), t_s / FINE).states
    at = np.arange(FINE, len(CURRENTS) * FINE, FINE)
    x = fine[at - min(late, 0)]
    return Experiment("", CURRENTS[: len(x)], x * [1.0, 1.0 + gain] + [offset, 0.0], 0.0, 0.0, 0.0, True)


def evaluated(bench: Bench, run: Experiment, errors: SystematicErrors, *names: str) -> tuple[Floats, Fit]:
    """The physical information of an experiment that is evaluated in parts, and the fit."""
    theta, last = Theta(bench.brake, errors=errors), [run.periods - 1]
    histories, fit = information_and_fit(bench, bench.plant("exact"), theta, run, names, instants=last, piece=30)
    return histories["physical"][-1], fit


@pytest.mark.parametrize(
    ("simulated", "errors", "most"),
    [
        ({"late": 6}, SystematicErrors(delay=0.3), 1e-6),
        ({"offset": 0.04}, SystematicErrors(offset=0.04), 1e-6),
        ({"current_offset": 0.05}, SystematicErrors(current_offset=0.05), 1e-6),
        ({"gain": 0.02}, SystematicErrors(velocity_gain=0.02), 1e-6),
        (
            {"late": 6, "offset": -0.04, "current_offset": 0.05, "gain": -0.02},
            SystematicErrors(-0.04, 0.05, 0.3, -0.02),
            1e-6,
        ),
        ({"late": -1}, SystematicErrors(delay=-0.05), 0.2),  # to first order
    ],
)
def test_a_record_is_explained_with_its_systematic_errors_only(
    bench: Bench, simulated: dict[str, Any], errors: SystematicErrors, most: float
) -> None:
    piece = shown(bench, **simulated)
    (_, explained), (_, alone) = (evaluated(bench, piece, each, "k_m") for each in (errors, NO_ERRORS))
    assert max(explained.compared) < most
    assert max(alone.compared) > 1.0


def test_the_information_about_systematic_errors_is_that_of_finite_differences(bench: Bench) -> None:
    at: dict[str, Any] = {"late": 6, "offset": 0.01, "current_offset": 0.05, "gain": 0.02}
    steps = {"delay": ("late", 1, 1 / FINE), "current_offset": ("current_offset", 1e-4, 1e-4)}
    steps |= {"offset": ("offset", 1e-4, 1e-4), "velocity_gain": ("gain", 1e-4, 1e-4)}
    rows = []
    for option, step, size in steps.values():
        more, less = (shown(bench, **at | {option: at[option] + sign * step}) for sign in (1, -1))
        derivative = (more.samples - less.samples) / (2.0 * size)
        rows.append((derivative / [bench.noise.angle, bench.noise.velocity]).ravel())
    found, _ = evaluated(bench, shown(bench, **at), SystematicErrors(0.01, 0.05, 0.3, 0.02), *steps)
    expected = np.array(rows) @ np.array(rows).T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-3)


@pytest.mark.parametrize("errors", [NO_ERRORS, SystematicErrors(offset=-0.7)])
def test_a_planned_experiment_begins_at_the_origin_whatever_the_encoder_reads_there(
    bench: Bench, errors: SystematicErrors
) -> None:
    exact = bench.plant("exact")
    shifted = replace(exact, instruments=exact.instruments._replace(encoder_offset=0.4))
    found, right = (expected_of(bench, one, Question(), bench.brake, errors, CURRENTS) for one in (shifted, exact))
    assert found.trajectory.states.tolist() == right.trajectory.states.tolist()
    assert found.matrix.tolist() == right.matrix.tolist()
