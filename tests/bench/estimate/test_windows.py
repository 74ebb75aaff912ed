from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emb_bench.config.bench import Bench, parse_bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import make_problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.estimate.windows import Cut, by_windows, predict_windows
from emb_bench.experiment.experiment import Experiment
from emb_bench.recordings.map_file import Place, parse_map
from emb_bench.recordings.readers import Column
from emb_bench.recordings.recording import bench_of
from emb_bench.recordings.signals import experiment_of
from emb_runtime.errors import UsageError
from tests.bench.linear_machine import MAP, Machine, Recording, record

BY_DIRECTION = Machine(forward=160.0, backward=240.0)
ASKED = EstimationProblem(("T_c", "f_v", "J"), ("current_offset",))


def made(found: Recording, text: str = MAP) -> tuple[Bench, Experiment]:
    """Bench and record of a recording, without a file between."""
    wanted = parse_map(text, "map")
    columns = {Place(name): Column(c, None) for name, c in zip(("t", "x", "F"), found, strict=True)}
    ours = experiment_of(columns, wanted, "csv", "r.csv")
    return parse_bench(bench_of(ours, wanted), "made", analysis=True), ours.experiment


def fitted(found: Recording, asked: EstimationProblem = ASKED, text: str = MAP) -> Estimate:
    bench, data = made(found, text)
    return method_of("windows")(bench, bench.plant("recorded"), asked, starts=1).fit([data])


def of_machine(e: Estimate) -> dict[str, tuple[float, float]]:
    """Values and half-widths of the 95 % intervals in SI units of the linear machine."""
    found = zip(e.unknowns, e.values.tolist(), e.intervals().tolist(), strict=True)
    return {u.name: (value, 0.5 * (high - low)) for u, value, (low, high) in found}


@pytest.fixture(scope="module")
def plain() -> Estimate:
    return fitted(record(Machine()))


def test_a_machine_that_is_known_only_by_position_and_force_is_found(plain: Estimate) -> None:
    found = of_machine(plain)
    for name, true in (("J", 95.0), ("f_v", 200.0), ("T_c", 20.0), ("current_offset", -3.0)):
        assert found[name][0] == pytest.approx(true, rel=0.01)


def test_friction_by_direction_is_named_and_found() -> None:
    data = record(BY_DIRECTION, 4.0)
    symmetric = fitted(data, replace(ASKED, window=0.1))
    assert not symmetric.validation.fits
    assert symmetric.validation.suspects[0].name == "viscous_asymmetry"
    asked = EstimationProblem(("T_c", "f_v", "J"), ("current_offset", "viscous_asymmetry"), window=0.1)
    found = of_machine(fitted(data, asked))
    f_v, share = found["f_v"][0], found["viscous_asymmetry"][0]
    assert f_v * (1.0 + share) == pytest.approx(160.0, rel=0.02)
    assert f_v * (1.0 - share) == pytest.approx(240.0, rel=0.02)


@pytest.mark.slow
def test_intervals_cover_the_truth_of_a_machine_under_a_disturbance_that_is_not_white() -> None:
    covered = []
    for seed in range(3):
        e = fitted(record(Machine(disturbance=1.0), phase=0.7 * seed, seed=seed))
        assert not e.validation.fits
        assert (e.cramer_rao() < 0.1 * e.robust()).all()
        found = of_machine(e)
        for name, true in (("J", 95.0), ("f_v", 200.0), ("T_c", 20.0), ("current_offset", -3.0)):
            value, half = found[name]
            covered.append(abs(value - true) <= half)
    assert sum(covered) >= 10  # of 12; 11 are expected


def test_what_is_estimated_from_one_recording_predicts_another(plain: Estimate) -> None:
    bench, data = made(record(Machine(), 3.0, phase=1.0))
    problem = make_problem(bench, plain.plant, [data], ASKED)
    error, _, _ = predict_windows(problem, plain.values)
    wrong, _, _ = predict_windows(problem, plain.values * 1.2)
    assert error < 2e-6
    assert wrong > 5.0 * error


def test_a_window_that_begins_at_rest_is_predicted_from_a_start_that_does_not_diverge() -> None:
    bench, data = made(record(Machine(disturbance=1.0), 1.0))
    begin, end = 42, 542  # friction holds at 42: a whole Gauss-Newton step starts the machine at -56 rad/s
    angle, velocity = data.samples[begin - 1].tolist()
    before = float(data.currents[begin - 1])
    part = Experiment(
        "r", data.currents[begin:end], data.samples[begin:end], angle, velocity, 0.0, False, before=before
    )
    problem = make_problem(bench, bench.plant("recorded"), [part], ASKED)
    true = {"T_c": 20.0, "f_v": 200.0, "J": 95.0, "current_offset": -3.0}
    values = np.array([true[u.name] for u in problem.unknowns])
    error, chi2, _ = predict_windows(problem, values)
    cut = Cut(problem, problem.coordinates(values))
    seen = cut.linearised(cut.begun)
    assert chi2 <= seen[0].costs[0]
    assert error < 150e-6


def test_eliminating_the_starts_gives_the_information_of_all_unknowns_together() -> None:
    e = fitted(record(Machine(), 6.0))
    problem = make_problem(e.bench, e.plant, e.experiments, ASKED)
    cut = Cut(problem, e.z).windows
    whole = make_problem(e.bench, e.plant, [w.experiments[0] for w in cut], cut[0].question)
    z = whole.nominal()
    z[:4] = e.z
    for i, window in enumerate(cut):  # where the estimate has its windows matters little to their derivatives
        z[[4 + i, 4 + len(cut) + i]] = window.nominal()[-2:]
    _, jacobian = whole.jacobian(z, whole.weights(z))
    deviations = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)[:4, :4]))
    np.testing.assert_allclose(e.cramer_rao(), deviations, rtol=0.05)


def test_windows_that_disagree_widen_the_covariance_and_neighbours_count_together() -> None:
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(400, 2)) @ np.array([[2.0, 0.0], [0.5, 1.0]])
    information = np.array([[30.0, 4.0], [4.0, 20.0]])
    alone = by_windows(information, scores, [False] * 400)
    inverse = np.linalg.inv(information)
    np.testing.assert_allclose(alone, inverse @ (scores.T @ scores) @ inverse * 400 / 398)
    twice = np.repeat(scores[::2], 2, axis=0)
    together = by_windows(information, twice, [False, *[True] * 399])
    apart = by_windows(information, twice, [False] * 400)
    assert np.diag(together).sum() > 1.4 * np.diag(apart).sum()


def test_a_length_that_is_asked_for_goes_before_the_map_s() -> None:
    data = record(Machine(), 2.0)
    for e in (fitted(data, replace(ASKED, window=0.15)), fitted(data, text=MAP.replace("= 0.5", "= 0.15"))):
        assert (e.windows, e.problem.window) == (13, 0.15)


@pytest.mark.parametrize("straight", [False, True])
def test_a_command_takes_the_course_that_the_map_states(straight: bool) -> None:
    text = MAP.replace('unit = "N"', f'unit = "N"\nbetween = "{"linear" if straight else "held"}"')
    found = of_machine(fitted(record(Machine(), 6.0, straight=straight), text=text))
    for name, true in (("J", 95.0), ("f_v", 200.0), ("T_c", 20.0), ("current_offset", -3.0)):
        assert found[name][0] == pytest.approx(true, rel=0.01)


def test_too_few_windows_and_starts_that_are_asked_for_are_refused() -> None:
    data = record(Machine(), 3.0)
    with pytest.raises(UsageError, match=r"6 windows of 0\.5 s are too few for 4 unknowns"):
        fitted(data)
    with pytest.raises(UsageError, match="no other feature"):
        fitted(data, EstimationProblem(("T_c",), ("viscous_asymmetry", "break_away"), window=0.1))
    with pytest.raises(UsageError, match="a start of its own"):
        fitted(data, EstimationProblem(("T_c", "f_v", "J"), ("x1_0",), window=0.1))
