"""Periods of which it is not known what acted are unknowns; outliers are counted, and move no parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emb_bench.analysis.held_out import held_out, refit
from emb_bench.analysis.model_choice import choose_model, fit_from
from emb_bench.config.bench import Bench
from emb_bench.estimate.innovations import Filter
from emb_bench.estimate.least_squares import regression
from emb_bench.estimate.output_error import few, outliers
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.simulate import gap_ends
from emb_bench.report.caveats import caveats
from emb_runtime.config.bench import PARAMETER_NAMES
from tests.bench.measurements import currents_of, errors_in_sigmas, fit, problem_of, record

SINGLE = (40, 90, 300)
SEVERAL = (range(150, 170), range(230, 232))
EVERY = sorted({*SINGLE, *SEVERAL[0], *SEVERAL[1]})


def lossy(data: Experiment, lost: list[int], assumed: float | None = None) -> Experiment:
    """The record without the reports of some periods, of which a current is assumed, or rightly that which acted."""
    currents, samples, guess = data.currents.copy(), data.samples.copy(), np.full(len(data.currents), np.nan)
    samples[lost] = np.nan
    if assumed is not None:
        currents[lost] = assumed
    guess[lost] = currents[lost]
    return replace(data, currents=currents, samples=samples, assumed=guess)


@pytest.mark.parametrize(
    ("plant", "late"),
    [
        ("exact", 0.0),
        ("exact", 0.3),
        ("stribeck", 0.3),
        ("hysteresis", 0.3),
        ("lag", None),
        ("euler", None),
        ("late", None),
    ],
)
def test_sensitivities_to_what_is_unknown_in_gaps_are_finite_differences(
    bench: Bench, plant: str, late: float | None
) -> None:
    model, names = bench.plant(plant), ("k_m",) if late is None else ("k_m", "delay")
    data = lossy(record(bench, model, currents_of(bench, "chirp")), EVERY)
    problem = problem_of(bench, names, data, plant=plant)
    z = problem.coordinates(np.array([bench.brake.k_m] if late is None else [bench.brake.k_m, late]))
    weights = problem.weights(z)
    held = problem.in_gaps()
    shown, counts = problem.predict(z, 0), weights[0][:, 0] > 0.0
    assert len(held) == problem.gap_basis(z, weights).shape[1] == 3 + 2 * 2
    for j in range(len(held)):
        step = np.zeros(len(held))
        step[j] = 1e-4
        up, down = (problem.filled(held + side * step).predict(z, 0).samples for side in (1.0, -1.0))
        expected = ((up - down) / 2e-4)[counts]
        assert shown.sensitivities[counts, len(names) + j] == pytest.approx(
            expected, rel=1e-5, abs=1e-6 * np.abs(expected).max()
        )


def test_information_is_what_is_left_when_the_gaps_are_unknowns_beside_the_parameters(bench: Bench) -> None:
    data = lossy(record(bench, bench.plant("exact"), currents_of(bench, "chirp")), EVERY)
    problem = problem_of(bench, PARAMETER_NAMES, data)
    z = problem.nominal()
    weights = problem.weights(z)
    said, low_high = problem.predict(z, 0), bench.limits.angle
    columns = said.sensitivities * weights[0][:, None]
    joint = np.einsum("njo,nko->jk", columns, columns)
    widths = [bench.limits.current] * 3 + [low_high[1] - low_high[0], bench.limits.velocity] * 2
    joint += np.diag([0.0] * 4 + [1.0 / width**2 for width in widths])
    jacobian = problem.jacobian(z, weights)[1]
    assert np.linalg.inv(jacobian.T @ jacobian) == pytest.approx(np.linalg.inv(joint)[:4, :4], rel=1e-6)


@pytest.mark.parametrize("assumed", [None, 0.0, -6.0])
def test_a_right_model_fits_whatever_is_assumed_of_its_gaps(bench: Bench, assumed: float | None) -> None:
    plant, brake = bench.plant("exact"), bench.brake._replace(f_v=3e-5, T_c=8e-3)
    whole = record(bench, plant, currents_of(bench, "chirp"), brake=brake, seed=3)
    found = fit(bench, plant, [lossy(whole, EVERY, assumed)])
    assert found.validation.fits
    assert np.abs(errors_in_sigmas(found, brake)).max() < 3.5
    assert found.validation.freedom == 2 * (500 - len(EVERY)) - 4 - 3 - 4
    ideal = fit(bench, plant, [whole])
    assert (found.deviations() > ideal.deviations()).all()


def test_what_is_fitted_again_or_by_another_model_settles_its_own_gaps(bench: Bench) -> None:
    plant, brake = bench.plant("exact"), bench.brake._replace(f_v=3e-5)
    whole = record(bench, plant, currents_of(bench, "chirp"), brake=brake, seed=7)
    raw = lossy(whole, EVERY, -6.0)
    e = fit(bench, plant, [raw])
    others = (
        fit_from(Problem(bench, plant, EstimationProblem(), (raw,)), e),
        refit(replace(e, problem=replace(e.problem, experiments=(raw,))), [0]),
    )
    assert [e.ends[0].cost] * 2 == pytest.approx([others[0].best.cost, others[1].ends[0].cost], abs=1e-2)
    choice = choose_model(
        bench, [plant, bench.plant("hysteresis")], lambda _: [raw], EstimationProblem(), starts=1, seed=0
    )
    assert choice.best.name == "exact"
    assert choice.best.fits
    assert caveats(choice.best.estimate) == caveats(e) != []


def test_innovations_of_the_right_brake_are_as_large_as_stated_whatever_is_assumed_of_its_gaps(bench: Bench) -> None:
    whole = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=8)
    for assumed in (0.0, -6.0):
        problem = problem_of(bench, PARAMETER_NAMES, lossy(whole, EVERY, assumed))
        z = problem.nominal()
        weights, found = problem.weights(z), Filter(problem, 0.0)
        errors, _ = found.jacobian(z, weights, found.gains(z, weights))
        counts = int((weights[0] > 0.0).sum())
        assert float(errors @ errors) == pytest.approx(counts, abs=4.0 * (2.0 * counts) ** 0.5)


@pytest.mark.parametrize("plant", ["exact", "late"])
def test_recursive_least_squares_takes_no_period_whose_report_was_lost(bench: Bench, plant: str) -> None:
    whole = record(bench, bench.plant(plant), currents_of(bench, "chirp"))
    rows = [
        regression(problem_of(bench, PARAMETER_NAMES, data, plant=plant), data)
        for data in (lossy(whole, EVERY, 5.0), lossy(whole, EVERY, -5.0))
    ]
    assert rows[0][0].tolist() == rows[1][0].tolist()
    assert rows[0][1].tolist() == rows[1][1].tolist()


def test_a_held_out_record_with_gaps_is_predicted_as_the_others_are(bench: Bench) -> None:
    plant = bench.plant("exact")
    first, second = (record(bench, plant, currents_of(bench, "chirp"), seed=seed) for seed in (9, 10))
    found = held_out(fit(bench, plant, [first]), lossy(second, EVERY, 0.0))
    assert found.freedom == 2 * (500 - len(EVERY)) - 3 - 4
    assert found.fits


def test_a_gap_at_the_end_and_one_from_the_first_period_on_are_bridged(bench: Bench) -> None:
    plant = bench.plant("exact")
    whole = record(bench, plant, currents_of(bench, "chirp"), seed=5)
    found = fit(bench, plant, [lossy(whole, [0, 1, 2, 499], 0.0), lossy(whole, [0, 498, 499], 0.0)])
    assert found.validation.fits
    assert np.abs(errors_in_sigmas(found, bench.brake)).max() < 3.5


@pytest.mark.parametrize("seed", range(2))
def test_a_brake_that_turns_around_at_the_end_of_a_gap_fits(bench: Bench, seed: int) -> None:
    plant = bench.plant("exact")
    whole = record(bench, plant, currents_of(bench, "chirp"), seed=seed)
    velocity = whole.samples[:, 1]
    turns = [k for k in range(30, 480) if velocity[k - 3] * velocity[k + 3] < 0.0 and abs(velocity[k]) < 3.0]
    lost = sorted({k for turn in turns[:: max(len(turns) // 6, 1)] for k in range(turn - 10, turn)})
    found = fit(bench, plant, [lossy(whole, lost, 0.0)])
    assert found.validation.fits
    assert np.abs(errors_in_sigmas(found, bench.brake)).max() < 3.5


def test_a_late_sample_after_a_gap_shows_the_brake_going_on_as_it_went_through_its_own_period(bench: Bench) -> None:
    plant = bench.plant("exact")
    whole = replace(record(bench, plant, currents_of(bench, "chirp")), late=np.full(500, 1e-4))
    every = problem_of(bench, PARAMETER_NAMES, whole)
    z = every.nominal()
    said = every.predict(z, 0)
    data = lossy(whole, EVERY, -6.0)
    problem = problem_of(bench, PARAMETER_NAMES, data)
    breaks, _ = gap_ends(data, plant.instruments)
    placed = problem.filled(np.concatenate([whole.currents[list(SINGLE)], said.states[breaks + 1].ravel()]))
    counts = problem.weights(z)[0][:, 0] > 0.0
    difference = np.abs(placed.predict(z, 0).samples - said.samples)[counts] / [bench.noise.angle, bench.noise.velocity]
    assert difference.max() < 0.1


def test_of_late_samples_those_that_show_the_inside_of_a_gap_do_not_count(bench: Bench) -> None:
    plant = bench.plant("late")
    delay = plant.instruments.measurement_delay
    data = lossy(record(bench, plant, currents_of(bench, "chirp")), list(range(100, 110)))
    problem = Problem(bench, plant, EstimationProblem(), (data,))
    counts = problem.weights(problem.nominal())[0][:, 0] > 0.0
    assert delay == 1
    assert np.flatnonzero(~counts).tolist() == list(range(100, 110))
    shorter = lossy(data, [])
    assert shorter.gap_unknowns == 0


def with_jumps(data: Experiment, *jumps: tuple[int, int, float]) -> Experiment:
    """The record whose samples show some more at some places: sample, output, and by how much."""
    samples = data.samples.copy()
    for k, output, by in jumps:
        samples[k, output] += by
    return replace(data, samples=samples)


@pytest.mark.parametrize("jump", [(250, 0, 5.0), (3, 0, -5.0), (400, 1, 100.0), (499, 0, 0.05)])
def test_a_jump_of_one_sample_moves_no_parameter_by_more_than_its_interval(
    bench: Bench, jump: tuple[int, int, float]
) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=2)
    clean, found = fit(bench, plant, [data]), fit(bench, plant, [with_jumps(data, jump)])
    assert found.validation.fits
    assert found.experiments[0].outliers == 1
    assert len(caveats(found)) == 1
    low, high = clean.intervals().T
    assert ((low < found.values) & (found.values < high)).all()
    assert caveats(clean) == []


def test_many_samples_apart_are_no_outliers_but_a_record_that_does_not_fit(bench: Bench) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=2)
    found = fit(bench, plant, [with_jumps(data, *((k, 0, 0.1) for k in range(50, 450, 40)))])
    assert found.experiments[0].outliers == 0
    assert not found.validation.fits


def test_noise_that_is_larger_than_the_bench_says_is_not_outlying() -> None:
    errors = 3.0 * np.random.default_rng(0).standard_normal((500, 2))
    assert not outliers(errors, np.ones((500, 2), np.bool_)).any()


def test_what_does_not_count_is_no_outlier_and_a_short_record_has_none() -> None:
    errors, counts = np.zeros((100, 2)), np.ones((100, 2), np.bool_)
    errors[50], counts[50] = 1e6, False
    errors[70, 1] = -9.0
    assert np.flatnonzero(outliers(errors, counts)).tolist() == [70]
    assert not outliers(1e6 * np.eye(8, 2), np.ones((8, 2), np.bool_)).any()
    assert not few([np.zeros(500, np.bool_)])
    assert few([np.arange(500) < 5])
    assert not few([np.arange(500) < 6])
