"""``python -m studies.thesis.training``: every table and figure, from a training to its sentence; short trainings."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_runtime.config.bench import load_bench
from emb_train import presets
from emb_train.cli.train import main as emb_train
from emb_train.envs.play import Draw
from emb_train.ppo.ppo import PpoConfig
from emb_train.presets import load_preset
from emb_train.rewards import PenalisedIncrement
from emb_train.training.checkpoint import METRICS
from emb_train.training.configuration import Configuration
from studies.thesis.training import plots, several, single, trainings
from studies.thesis.training.cli import TARGETS, main, makers
from studies.thesis.training.report import Made, markdown, summary
from studies.thesis.training.result import Result, Statement, number, spread
from studies.thesis.training.several import square_wave
from studies.thesis.training.single import correlation, drops_at_limits, five, on_grid, phases, planned, rises_early
from studies.thesis.training.trajectories import run
from tests.commands import refused

BENCH = load_bench()


def small(name: str) -> Configuration:
    """A preset that trains in a moment."""
    preset = load_preset(name)
    horizon = preset.conditions.applied(BENCH).timing.horizon
    ppo = PpoConfig(total_steps=500, envs=1, rollout=horizon, minibatch=500, epochs=1, hidden=(8, 8), threads=1)
    return dataclasses.replace(preset, ppo=ppo)


@pytest.fixture(autouse=True)
def _small_presets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainings, "load_preset", small)


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All targets, once."""
    folder = tmp_path_factory.mktemp("all")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainings, "load_preset", small)
        assert main(["all", "--seeds", "2", "--out", str(folder)]) == 0
    return folder


def must_not_train(*_: Any) -> None:
    raise AssertionError("trained again")


@pytest.mark.slow
def test_every_target_has_a_picture_a_place_in_the_text_and_sentences(everything: Path) -> None:
    record = json.loads((everything / "reproduction.json").read_text(encoding="utf-8"))
    text = (everything / "reproduction.md").read_text(encoding="utf-8")
    assert [result["target"] for result in record["results"]] == list(TARGETS)
    for result in record["results"]:
        picture = everything / f"{result['target']}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < 300_000
        assert f"({picture.name})" in text
        assert result["statements"]
        for statement in result["statements"]:
            word = "Agrees" if statement["agrees"] else "Does not agree"
            assert f"- {word}: {statement['printed']}. Here: {statement['found']}." in text
    assert "ehears" not in text
    for preset, seed, steps, _ in record["trainings"]:
        assert f"| {preset} | {seed} | {steps:,} |" in text
    assert record["steps"] == sum(steps for _, _, steps, _ in record["trainings"])


def test_a_cut_training_makes_a_rehearsal_without_any_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fig-5.2", "--steps", "300", "--out", str(tmp_path)]) == 0
    assert "a rehearsal, no verdict counts: " in capsys.readouterr().out
    (result,) = json.loads((tmp_path / "reproduction.json").read_text(encoding="utf-8"))["results"]
    assert result["note"] == "rehearsal: trainings cut at 300 steps, no verdict counts"
    assert [statement["agrees"] for statement in result["statements"]] == [None, None]
    text = (tmp_path / "reproduction.md").read_text(encoding="utf-8")
    assert "Rehearsal: trainings cut at 300 steps, no verdict counts." in text
    assert "gree: " not in text


def test_only_what_was_cut_is_a_rehearsal() -> None:
    whole = Result("fig-1", "one", [Statement("a", "b", True, {}), Statement("c", "d", False, {})])
    cut = Result("fig-2", "two", [Statement("e", "f", True, {})], note="rehearsal: cut")
    assert summary([whole]) == "1 of 2 statements agree"
    assert summary([whole, cut]) == "1 of 2 statements agree, 1 results are a rehearsal"
    text = markdown(Made("command", (0,), [("p", 0, 1000, 2.0), ("q", 0, 500, 1.0)]), [whole, cut])
    assert "- Agrees: a. Here: b." in text
    assert "- Does not agree: c. Here: d." in text
    assert "- Thesis: e. Here: f." in text
    assert "Seed 0; 1,500 environment steps in 3 s of training." in text


def test_each_target_takes_the_trainings_that_it_is_said_to_take(
    everything: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("trajectories", "curves", "returns", "plan", "bars"):
        monkeypatch.setattr(plots, f"plot_{name}", lambda *_: None)
    for target, make in makers().items():
        taken = trainings.Trainings(everything / "trainings", BENCH, (0, 1), None, must_not_train)
        make(taken, plots.Picture(tmp_path / "none.png"))
        assert {preset for preset, *_ in taken.made} == set(TARGETS[target]), target


def test_what_is_repeated_has_all_seeds_and_what_is_not_only_the_first(everything: Path) -> None:
    made = sorted(path.name for path in (everything / "trainings").iterdir())
    both = ("e-optimal-hybrid", "e-optimal-trajectory", "trajectory-a", "trajectory-b")
    once = ("adaptive", "d-optimal-1", "d-optimal-2", "fixed", "random")
    assert made == sorted([f"thesis-{n}-{s}" for n in both for s in (0, 1)] + [f"thesis-{n}-0" for n in once])


def test_a_training_that_is_there_is_not_repeated(
    everything: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trainings, "train", must_not_train)
    before = (everything / "fig-5.9.png").read_bytes()
    assert main(["fig-5.9", "--seeds", "2", "--out", str(everything)]) == 0
    assert (everything / "fig-5.9.png").read_bytes() == before
    assert "statements agree" in capsys.readouterr().out


def test_what_cannot_be_reproduced_is_refused_in_a_line(
    everything: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["fig-1.1"], ["--seeds", "0"], ["--steps", "-5"], ["--seed", "-1"]):
        refused(lambda: main([*arguments, "--out", str(tmp_path / "new")]), capsys)  # noqa: B023  # called at once
    assert not (tmp_path / "new").exists()
    refused(lambda: main(["fig-5.2", "--steps", "300", "--out", str(everything)]), capsys)  # of other trainings
    directory = tmp_path / "trainings" / "thesis-fixed-0"
    for name, content in ((METRICS, "junk\n"), (METRICS, '{"steps": 1}\n'), ("seconds.json", "[]"), (METRICS, "\xff")):
        shutil.rmtree(directory, ignore_errors=True)
        shutil.copytree(everything / "trainings" / "thesis-fixed-0", directory)
        (directory / name).write_bytes(content.encode("latin-1"))
        refused(lambda: main(["fig-5.3", "--out", str(tmp_path)]), capsys)
    (directory / "seconds.json").unlink()  # as an interruption leaves it
    refused(lambda: main(["fig-5.3", "--out", str(tmp_path)]), capsys)


def test_agents_that_leave_the_limits_at_once_get_a_report_like_any_other(
    everything: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(everything / "trainings", tmp_path / "trainings")
    for module in (single, several):
        monkeypatch.setattr(module, "asked", lambda _: lambda batch: np.full(len(batch.k), 6.0))
    names = ["fig-5.3", "fig-5.4", "fig-5.6", "fig-5.7", "fig-5.8", "table-6.2"]
    assert main([*names, "--seeds", "2", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "reproduction.json").read_text(encoding="utf-8"))["results"]
    assert results[-1]["rows"][0][-1] == results[-1]["rows"][1][-1] == "100 (2 seeds: 100 to 100)"  # violations
    (home, *_) = results[names.index("fig-5.8")]["statements"]
    assert home["agrees"] is False
    assert home["found"].startswith("0 of 5")
    (way,) = results[names.index("fig-5.7")]["statements"]
    assert way["agrees"] is False
    assert way["found"] == "none of 5 got to 300 ms"


def test_a_planned_way_home_is_the_polynomial_of_six_conditions(everything: Path) -> None:
    made = trainings.Trainings(everything / "trainings", BENCH, (0,), None, must_not_train).first("thesis-trajectory-b")
    plan, runs = planned(made), five(made)
    assert plan.planned.shape == plan.taken.shape == (201, 5, 2)
    np.testing.assert_allclose(plan.times[[0, -1]], [0.3, 0.5])
    np.testing.assert_array_equal(plan.taken, runs.x[300:])

    def derivative(order: int, t: float) -> Any:
        return np.array([math.perm(power, order) * t ** max(0, power - order) for power in range(6)])

    conditions = [derivative(order, t) for t in (0.0, 0.2) for order in range(3)]
    for i in range(5):
        acceleration = (runs.x[300, i, 1] - runs.x[299, i, 1]) / 1e-3
        ways = np.linalg.solve(conditions, [*runs.x[300, i], acceleration, 0.0, 0.0, 0.0])
        for k in (0, 50, 137, 200):
            np.testing.assert_allclose(plan.planned[k, i, 0], derivative(0, 1e-3 * k) @ ways, atol=1e-6)
            np.testing.assert_allclose(plan.planned[k, i, 1], derivative(1, 1e-3 * k) @ ways, atol=1e-4)


@pytest.mark.parametrize(
    ("fastest", "apart", "until", "verdicts"),
    [
        (400.0, 4.0, 201, [True, True]),
        (501.0, 4.0, 201, [False, True]),
        (400.0, 6.0, 201, [True, False]),
        (400.0, 4.0, 5, [True, False]),  # one leaves the limits soon after 300 ms
    ],
)
def test_a_way_home_agrees_if_it_keeps_the_limits_and_the_agent_takes_it(
    fastest: float,
    apart: float,
    until: int,
    verdicts: list[bool],
    everything: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times = np.linspace(0.3, 0.5, 201)
    way = np.zeros((201, 5, 2))
    way[:, :, 0], way[100, 2, 1] = np.linspace(70.0, 0.0, 201)[:, None], -fastest
    taken = way + np.array([apart, 0.0])
    taken[until:, 0] = math.nan
    monkeypatch.setattr(single, "planned", lambda _: plots.Plan(times, way, taken))
    made = trainings.Trainings(everything / "trainings", BENCH, (0,), None, must_not_train)
    result = single.fig_5_7(made, plots.Picture(tmp_path / "fig-5.7.png"))
    assert [statement.agrees for statement in result.statements] == verdicts
    assert f"{fastest:.0f} of 500 rad/s" in result.statements[0].found
    assert f"{apart:.1f}, {apart:.1f}" in result.statements[1].found
    assert f"; {int(until < 201)} of 5 left the limits" in result.statements[1].found


def test_what_never_changes_is_correlated_with_nothing() -> None:
    rising = np.arange(5.0)
    assert correlation(rising, np.zeros(5)) == 0.0
    assert correlation(rising, -2.0 * rising) == pytest.approx(-1.0)


def test_a_training_without_a_shield_says_who_evaluates_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(presets, "load_preset", small)
    assert emb_train(["--preset", "thesis-random", "--steps", "300", "--out", str(tmp_path / "a")]) == 0
    assert "the study of the thesis shows what it does" in capsys.readouterr().out


def test_a_printed_number_agrees_within_a_fifth_of_the_mean_however_far_the_seeds_scatter() -> None:
    assert number(100.0, [119.0], "x").agrees
    assert not number(100.0, [121.0], "x").agrees
    assert number(100.0, [60.0, 150.0], "x").agrees
    assert not number(100.0, [90.0, 500.0], "x").agrees
    assert not number(-100.0, [100.0], "x").agrees
    assert number(0.0, [0.0, 0.0], "x").agrees
    assert not number(0.0, [0.0, 40.0, 60.0], "x").agrees
    assert spread([1234.0]) == "1.23e+03"
    assert spread([1.0, 3.0, 5.0]) == "3 (3 seeds: 1 to 5)"


def test_a_return_rises_early_if_more_than_half_of_the_gain_comes_in_three_tenths_of_the_training() -> None:
    steady = np.linspace(0.0, 100.0, 101)
    assert not rises_early([steady]).agrees
    assert rises_early([np.minimum(4.0 * steady, 100.0)]).agrees
    assert not rises_early([-np.minimum(4.0 * steady, 100.0)]).agrees  # it falls
    assert rises_early([steady]).numbers["share_early"] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(
    ("depth", "left", "verdict", "drops", "at_limits"),
    [
        (0.1, [50, 70, 90], True, 3, 3),
        (0.1, [50, 70], True, 3, 2),
        (0.1, [50], False, 3, 1),
        (0.1, [40, 60, 80], False, 3, 0),  # where it does not drop
        (0.1, [10], False, 3, 0),  # in the first part of the training
        (0.01, [50, 70, 90], False, 0, 0),  # not a drop
    ],
)
def test_a_return_drops_at_the_limits_if_an_experiment_left_them_in_most_of_the_later_drops(
    depth: float, left: list[int], verdict: bool, drops: int, at_limits: int
) -> None:
    curve, violations = np.full(100, 100.0), np.zeros(100)
    curve[[10, 50, 70, 90]] *= 1.0 - depth
    violations[left] = 2.0
    said = drops_at_limits(curve, violations)
    assert said.agrees is verdict
    assert said.numbers == {"drops": drops, "with_violations": at_limits, "iterations": 70}


def test_a_curve_is_smoothed_by_the_mean_around_each_point() -> None:
    curve = np.arange(100.0)
    np.testing.assert_allclose(plots.smoothed(curve)[10:90], curve[10:90])
    assert plots.smoothed(curve)[0] == pytest.approx(1.0)  # of 0, 1, 2
    np.testing.assert_array_equal(plots.smoothed(curve[:5]), curve[:5])


def test_an_experiment_is_recorded_until_it_leaves_the_limits() -> None:
    config = load_preset("thesis-fixed")
    draws = [Draw(0, BENCH.brake), Draw(1, BENCH.brake)]
    courses = run(config, BENCH, lambda batch: np.array([6.0, 0.0]), draws)
    assert courses.violated.tolist() == [True, False]
    steps = int((~np.isnan(courses.current[:, 0])).sum())
    assert abs(courses.x[steps, 0, 1]) > 500.0
    assert np.isnan(courses.x[steps + 1 :, 0]).all()
    assert not np.isnan(courses.x[:, 1]).any()
    assert courses.last[0, 0] == courses.information[steps - 1, 0, 0]
    assert isinstance(config.reward, PenalisedIncrement)
    assert courses.returns[0] == pytest.approx(courses.information[steps - 2, 0, 0] - 4e4)  # in its own unit
    assert courses.x.shape == (301, 2, 2)
    assert courses.brakes == ("f_v = 2.16e-05", "f_v = 2.16e-05")


def test_the_square_wave_has_a_period_of_20_ms() -> None:
    config = load_preset("thesis-d-optimal-1")
    current = run(config, BENCH, square_wave, [Draw(0, BENCH.brake)]).current[:, 0]
    np.testing.assert_array_equal(current, np.tile(np.repeat([6.0, -6.0], 10), 15))


def test_the_phases_of_table_5_1_are_the_whole_return(tmp_path: Path) -> None:
    made = trainings.Trainings(tmp_path, BENCH, (0,), 1, lambda _: None).first("thesis-trajectory-b")
    assert phases(made).shape == (3,)
    assert phases(made).sum() == pytest.approx(on_grid(made).returns.mean())
