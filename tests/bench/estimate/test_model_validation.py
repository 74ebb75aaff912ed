"""A model that is not the brake raises the alarm and names what it lacks, a drift within the run among it."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy import stats

from emb_bench.brake.motion import Floats, advance, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_bench.estimate.effects import DRIFTS, Linearised, Simulation, with_systematic
from emb_bench.estimate.estimate import OF_THE_BENCH, Estimate
from emb_bench.estimate.model_validation import LAGS, lagged
from emb_bench.estimate.records import NORMAL_95, OUTPUTS, SYSTEMATIC, EstimationProblem
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.report.sentences import alarms, explained, residual_notes
from emb_runtime.config.bench import PARAMETER_NAMES, Systematic
from tests.bench.measurements import coloured, currents_of, errors_in_sigmas, fit, problem_of, record

WRONG = tuple(name for name in load_bench().plants if name != "exact")
EXCITATIONS = ("chirp", "constant-speed:turn=0.15")


def fitted(
    bench: Bench, plant: str, model: str = "exact", text: str = "chirp", seed: int = 0, noise: float = 1.0
) -> Estimate:
    data = record(bench, bench.plant(plant), currents_of(bench, text), seed=seed, noise=noise)
    return fit(bench, model, [data], starts=2)


@pytest.mark.parametrize("text", EXCITATIONS)
def test_a_brake_that_is_not_the_model_raises_the_alarm(bench: Bench, text: str) -> None:
    for plant in WRONG:
        validation = fitted(bench, plant, text=text).validation
        assert not validation.fits, plant
        assert validation.ratio > validation.expected[1], plant


def test_every_brake_fits_itself(bench: Bench) -> None:
    """The seed is fixed; each of these brakes may fail once in a hundred seeds."""
    for plant in ("exact", *WRONG):
        validation = fitted(bench, plant, plant).validation
        assert validation.fits, (plant, validation.alarming)
        assert validation.expected[0] < validation.ratio < validation.expected[1], plant


@pytest.mark.slow
def test_the_right_model_raises_the_alarm_no_more_often_than_it_is_allowed_to(bench: Bench) -> None:
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    draws = 60
    found = [fit(bench, plant, [record(bench, plant, currents, seed=seed)]).validation for seed in range(draws)]
    assert sum(not validation.fits for validation in found) <= stats.binom.ppf(0.999, draws, 0.01)
    for p_values in (
        [m.chi2_p for m in found],
        *([m.whiteness[name].p_value for m in found] for name in OUTPUTS),
        *([m.independence[name].p_value for m in found] for name in OUTPUTS),
    ):
        assert stats.kstest(p_values, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("plant", "name", "amount"), [("late", "delay", 1.0), ("offset", "contact", 0.2)])
def test_what_the_model_lacks_is_named_with_its_size(bench: Bench, plant: str, name: str, amount: float) -> None:
    suspect = fitted(bench, plant).validation.suspects[0]
    assert suspect.name == name
    assert suspect.value == pytest.approx(amount, rel=0.1)
    assert abs(suspect.sigmas) > 10.0


def test_nothing_is_suspected_of_the_right_model(bench: Bench) -> None:
    suspects = fitted(bench, "exact", text="step:amplitude=1.5").validation.suspects
    assert {suspect.name for suspect in suspects} >= {
        *("delay", "x1_0", "x2_0", "offset", "contact", "hysteresis"),
        *DRIFTS,
    }
    assert all(abs(suspect.sigmas) < 4.0 for suspect in suspects)


def test_what_was_estimated_is_no_suspect(bench: Bench) -> None:
    data = record(bench, bench.plant("late"), currents_of(bench, "chirp"))
    found = fit(bench, "exact", [data], EstimationProblem(nuisances=("delay", "x1_0")))
    assert not {suspect.name for suspect in found.validation.suspects} & {*PARAMETER_NAMES, "delay", "x1_0"}


def test_more_noise_than_the_bench_says_is_told_from_a_wrong_model(bench: Bench) -> None:
    found = fitted(bench, "exact", noise=1.5)
    validation = found.validation
    assert validation.alarming == {"size"}
    assert "the noise may be larger than in the bench file" in alarms(found)[0]
    assert validation.ratio == pytest.approx(2.25, rel=0.15)
    wrong = fitted(bench, "stribeck")
    assert not any("noise may be larger" in alarm for alarm in alarms(wrong))
    assert any(name.startswith("current of") for name in wrong.validation.alarming)


def test_less_noise_than_the_bench_says_is_noted(bench: Bench) -> None:
    found = fitted(bench, "exact", noise=0.5)
    assert found.validation.fits
    assert "too large" in residual_notes(found)[0]
    assert found.validation.ratio == pytest.approx(0.25, rel=0.15)


def test_coloured_noise_is_a_note_and_widens_the_deviations_from_the_residuals(bench: Bench) -> None:
    """Output error does not need white noise, its bound does."""
    found = fit(bench, "exact", [coloured(bench)])
    assert found.validation.fits
    assert found.validation.coloured == ("angle", "velocity")
    assert (found.robust() > 1.3 * found.cramer_rao()).all()


def test_the_whiteness_is_that_of_ljung_and_box(bench: Bench) -> None:
    found = fitted(bench, "stribeck")
    for column, name in enumerate(OUTPUTS):
        e = found.residuals[0][:, column]
        n, full = len(e), np.correlate(e, e, "full")
        r = full[n : n + 20] / full[n - 1]
        expected = n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, 21))))
        assert found.validation.whiteness[name].statistic == pytest.approx(expected, rel=1e-9)
        assert found.validation.whiteness[name].p_value == pytest.approx(float(stats.chi2.sf(expected, 20)))


def test_the_dependence_on_the_current_is_an_f_test_of_two_regressions(bench: Bench) -> None:
    """The residuals regressed on the model's sensitivities, without and with the currents."""
    found = fitted(bench, "stribeck", text="constant-speed:turn=0.15")
    e, past = found.residuals[0], lagged(found.experiments[0].currents, LAGS)
    currents = planned(found.experiments[0].currents)
    s = simulate(found.plant, Theta(found.theta), currents, 0.001, ("k_m", "k_1", "T_c", "f_v"))
    model = (s.sensitivities / [bench.noise.angle, bench.noise.velocity]).transpose(0, 2, 1).reshape(-1, 4)
    model /= np.linalg.norm(model, axis=0)
    both = np.zeros((500, 2, LAGS))
    both[:, 0] = past
    more = np.concatenate([model, both.reshape(-1, LAGS)], axis=1)
    without, with_currents = (
        float(np.sum((e.ravel() - a @ np.linalg.lstsq(a, e.ravel(), rcond=None)[0]) ** 2)) for a in (model, more)
    )
    expected = (without - with_currents) / LAGS / (with_currents / (1000 - 4 - LAGS))
    test = found.validation.independence["angle"]
    assert test.statistic == pytest.approx(expected, rel=1e-3)
    assert test.p_value == pytest.approx(float(stats.f.sf(expected, LAGS, 1000 - 4 - LAGS)), rel=0.01, abs=1e-30)


def test_lost_samples_leave_the_tests_as_they_are(bench: Bench) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=3)
    samples = data.samples.copy()
    samples[np.random.default_rng(0).random(500) < 0.2] = np.nan
    found = fit(bench, plant, [replace(data, samples=samples)]).validation
    assert found.freedom == 2 * int(np.isfinite(samples[:, 0]).sum()) - 4
    assert found.fits
    assert min(test.p_value for test in found.whiteness.values()) > 0.001


@pytest.mark.parametrize("method", ["oem", "pem"])
def test_an_interval_says_what_it_allows_for_most_and_holds_the_truth_where_fishers_does_not(
    bench: Bench, method: str
) -> None:
    """Play of 0.05 rad, which no test notices, moves T_c by 0.1 %: by seven deviations of the Fisher information."""
    plant = bench.plant("exact")
    loose = replace(plant, mechanics=plant.mechanics._replace(play=0.05))
    data = record(bench, loose, currents_of(bench, "chirp"), seed=1)
    known = scaled(bench, 0.0, 0.0)
    known = replace(known, systematic=replace(known.systematic, slow_friction=0.0))
    e = fit(bench, plant, [data], with_systematic(EstimationProblem(), known, plant), method=method)
    i = e.labels.index("T_c")
    assert e.validation.fits
    effect = e.largest_bias(i)
    assert effect is not None
    assert effect.name == "play"
    assert e.unmodelled_bias()[i] >= abs(effect.bias[i]) > 3.0 * e.cramer_rao()[i]
    error = abs(e.theta.T_c / bench.brake.T_c - 1.0)
    assert NORMAL_95 * e.cramer_rao()[i] < error < NORMAL_95 * e.deviations()[i]
    trusted = fit(bench, plant, [data], method=method)
    assert trusted.largest_bias(i) is None


def scaled(bench: Bench, inertia: float, angle: float) -> Bench:
    return replace(bench, systematic=replace(bench.systematic, inertia=inertia, angle_scale=angle))


@pytest.mark.parametrize(("method", "plant"), [("oem", "exact"), ("pem", "exact"), ("oem", "observer")])
def test_what_no_record_can_know_enters_the_total_as_the_equation_of_motion_says(
    bench: Bench, method: str, plant: str
) -> None:
    """J ω' = k_m i - γ k_1 x - T_c - f_v ω: only ratios to J show; with angles a times as large, k_m/a and T_c/a.

    If a period lasts s times as long as it is said to, k_m, k_1 and T_c show s² times as large, f_v s times.
    """
    model, bench = bench.plant(plant), scaled(bench, 0.02, 0.005)
    bench = replace(bench, systematic=replace(bench.systematic, current_scale=0.01, time_scale=1e-3))
    data = record(bench, model, currents_of(bench, "chirp"), seed=1)
    e = fit(bench, model, [data], with_systematic(EstimationProblem(), bench, model), method=method)
    found = {one.name: dict(zip(e.labels, one.bias, strict=True)) for one in e.validation.budget}
    for name, expected in {
        "J": {"k_m": 0.02, "k_1": 0.02, "T_c": 0.02, "f_v": 0.02},
        "current_scale": {"k_m": 0.01, "k_1": 0.0, "T_c": 0.0, "f_v": 0.0},
        "time_scale": {"k_m": 2e-3, "k_1": 2e-3, "T_c": 2e-3, "f_v": 1e-3},
        "angle_scale": {"k_m": 0.005, "k_1": 0.0, "T_c": 0.005, "f_v": 0.0}
        | ({"velocity_gain": 0.005} if plant == "exact" else {}),
    }.items():
        for label, bias in expected.items():
            assert abs(found[name][label]) == pytest.approx(bias, rel=0.05, abs=2e-5), (name, label)
    known = [i for i, label in enumerate(e.labels) if label in PARAMETER_NAMES]
    both = [math.hypot(*(found[one][name] for one in OF_THE_BENCH)) for name in PARAMETER_NAMES]
    assert e.deviations()[known] == pytest.approx(np.hypot(e.between_runs()[known], both), rel=1e-6)
    assert [finding.name for finding in e.identifiability().findings] == list(PARAMETER_NAMES)
    held = fit(bench, model, [data], with_systematic(EstimationProblem(("f_v",)), bench, model), method=method)
    assert held.deviations()[0] > 0.02, "held torques scale with J as well"
    trusted = fit(bench, model, [data], method=method)
    assert trusted.validation.budget == ()
    assert trusted.values[known] == pytest.approx(e.values[known], rel=2e-3)


def test_an_angle_that_is_shown_too_large_is_inside_every_interval_and_not_blamed_on_the_velocity(bench: Bench) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=1)
    e = fit(
        bench,
        plant,
        [replace(data, samples=data.samples * [1.003, 1.0])],
        with_systematic(EstimationProblem(), bench, plant),
    )
    assert e.validation.fits
    off, i = e.theta.k_m / bench.brake.k_m - 1.0, e.labels.index("velocity_gain")
    assert off == pytest.approx(0.003, rel=0.1)
    assert (np.abs(errors_in_sigmas(e, bench.brake)) < 1.0).all()
    assert e.values[i] == pytest.approx(-0.003, rel=0.1)
    assert e.deviations()[i] > 0.0029


SIZES = {"k_m": 0.03, "k_1": 0.01, "T_c": 0.1, "f_v": 0.1}
DRIVEN = ("chirp", "multisine", "constant-speed:turn=0.15")


def motion(bench: Bench, currents: Floats, name: str, drift: float) -> Floats:
    """Angle and velocity at the samples of a brake that changes from period to period, none in the middle."""
    mechanics, t_s, n = bench.plant("exact").mechanics, bench.timing.sample_time, len(currents)
    (chosen, s), x, states = no_sensitivity(()), rest(), np.empty((n, 2))
    for k, u in enumerate(currents.tolist()):
        factor = 1.0 + drift * ((k + 0.5) / n - 0.5)
        brake = bench.brake._replace(**{name: getattr(bench.brake, name) * factor})
        compiled(advance)(mechanics, brake, x, u, t_s, chosen, s)
        states[k] = x[:2]
    return states


def drifting(bench: Bench, text: str, name: str, drift: float, seed: int) -> Experiment:
    currents = currents_of(bench, text)
    still = record(bench, bench.plant("exact"), currents, seed=seed)
    moved = motion(bench, currents, name, drift) - motion(bench, currents, name, 0.0)
    return replace(still, samples=still.samples + moved)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("text", DRIVEN)
def test_its_column_is_the_finite_difference_of_a_brake_that_drifts(bench: Bench, name: str, text: str) -> None:
    currents = currents_of(bench, text)
    problem = problem_of(bench, PARAMETER_NAMES, record(bench, bench.plant("exact"), currents))
    z = problem.nominal()
    weights = problem.weights(z)
    model = Linearised(problem, z, Simulation(problem, z, weights), 0, np.zeros((0, len(z))), (f"{name}_drift",))
    column = model.turned(f"{name}_drift")
    assert column is not None
    h = 1e-5
    expected = (motion(bench, currents, name, h) - motion(bench, currents, name, -h)) / (2.0 * h) * weights[0]
    assert np.linalg.norm(column - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("name", "method"),
    [(name, method) for name in PARAMETER_NAMES for method in ("oem", "pem") if (name, method) != ("k_1", "pem")],
)
def test_a_parameter_that_drifts_is_found_with_its_size_and_named_with_a_remedy(
    bench: Bench, name: str, method: str
) -> None:
    data = drifting(bench, "square:period=0.2", name, SIZES[name], seed=3)
    m = fit(bench, "exact", [data], method=method).validation
    assert not m.fits
    assert m.cause is not None
    assert m.cause.suspect.name == f"{name}_drift"
    assert m.cause.suspect.value == pytest.approx(SIZES[name], rel=0.3)
    said = explained(m.cause)
    assert f"a change of {name} over the run " in said
    assert "shorter" in said


def test_a_drift_of_the_stiffness_is_to_prediction_error_a_load_that_walks_whose_first_suspect_it_is(
    bench: Bench,
) -> None:
    data = drifting(bench, "square:period=0.2", "k_1", SIZES["k_1"], seed=3)
    e = fit(bench, "exact", [data], method="pem")
    assert e.validation.disturbance is not None
    assert e.validation.disturbance.load > 0.0
    assert e.validation.suspects[0].name == "k_1_drift"
    assert e.validation.suspects[0].value == pytest.approx(SIZES["k_1"], rel=0.3)
    low, high = e.intervals()[[u.name for u in e.unknowns].index("k_1")]
    assert low < bench.brake.k_1 < high


@pytest.mark.parametrize(("name", "drift"), [("k_1", 0.03), ("T_c", 0.03)])
def test_the_interval_holds_what_a_drift_that_a_walk_followed_began_and_ended_with(
    bench: Bench, name: str, drift: float
) -> None:
    asked = with_systematic(EstimationProblem(), bench, bench.plant("exact"))
    e = fit(bench, "exact", [drifting(bench, "square:period=0.2", name, drift, seed=3)], asked, method="pem")
    assert e.process_noise + e.load_noise > 0.0
    low, high = e.intervals()[[u.name for u in e.unknowns].index(name)] / getattr(bench.brake, name)
    assert low < 1.0 - 0.5 * drift
    assert 1.0 + 0.5 * drift < high


@pytest.mark.parametrize("seed", [3, 4])
def test_the_interval_allows_for_a_drift_that_is_too_small_to_be_noticed(bench: Bench, seed: int) -> None:
    data = drifting(bench, "square:period=0.2", "T_c", 3e-4, seed=seed)
    errors_of_sensors = {name: getattr(bench.systematic, name) for name in SYSTEMATIC}
    others = dict.fromkeys(asdict(bench.systematic), 0.0) | {"k_m": None} | errors_of_sensors
    asked = [
        with_systematic(EstimationProblem(), replace(bench, systematic=Systematic(**known)), bench.plant("exact"))
        for known in (others, others | {"drift": bench.systematic.drift})
    ]
    found = [fit(bench, "exact", [data], one) for one in asked]
    errors = [errors_in_sigmas(e, bench.brake)[0] for e in found]
    assert [e.validation.fits for e in found] == [True, True]
    assert abs(errors[0]) > 2.5
    assert abs(errors[1]) < 2.0
    assert found[0].values == pytest.approx(found[1].values)
