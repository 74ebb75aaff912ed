"""``emb-train reproduce``: every table and figure, from a training to its sentence; trainings take a moment here."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_runtime.bench import load_bench
from emb_train import presets
from emb_train.checkpoint import METRICS
from emb_train.configuration import Configuration
from emb_train.evaluation.play import Draw
from emb_train.ppo import PpoConfig
from emb_train.presets import load_preset
from emb_train.reproduce import plots, several, single, trainings
from emb_train.reproduce.cli import TARGETS, main
from emb_train.reproduce.courses import run
from emb_train.reproduce.result import number, spread
from emb_train.reproduce.several import square_wave
from emb_train.reproduce.single import on_grid, phases, rises_early
from emb_train.rewards import PenalisedIncrement
from emb_train.train import main as emb_train
from emb_train.train import train

BENCH = load_bench()
STEPS = "500"


def small(name: str) -> Configuration:
    """A preset that trains in a moment."""
    preset = load_preset(name)
    horizon = preset.conditions.applied(BENCH).timing.horizon
    ppo = PpoConfig(total_steps=3000, envs=1, rollout=horizon, minibatch=500, epochs=1, hidden=(8, 8), threads=1)
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
        assert main(["all", "--steps", STEPS, "--seeds", "2", "--out", str(folder)]) == 0
    return folder


def must_not_train(*_: Any) -> None:
    raise AssertionError("trained again")


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
    assert "Trainings were cut at 500 steps" in text


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
    assert main(["fig-5.9", "--steps", STEPS, "--seeds", "2", "--out", str(everything)]) == 0
    assert (everything / "fig-5.9.png").read_bytes() == before
    assert "statements agree" in capsys.readouterr().out


def test_a_training_that_was_interrupted_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["fig-5.2", "--steps", STEPS, "--out", str(tmp_path)]
    whole = train

    def stopped(directory: Path, config: Configuration, bench: Any) -> None:
        whole(directory, dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, total_steps=300)), bench)
        raise KeyboardInterrupt

    monkeypatch.setattr(trainings, "train", stopped)
    assert main(arguments) == 130
    begun = tmp_path / "trainings" / "thesis-fixed-0" / METRICS
    assert len(begun.read_text(encoding="utf-8").splitlines()) == 1
    # As an interruption leaves it: the configuration is that of the whole training.
    config = begun.with_name("config.json")
    config.write_text(config.read_text(encoding="utf-8").replace('"total_steps": 300', '"total_steps": 500'), "utf-8")
    monkeypatch.setattr(trainings, "train", whole)
    assert main(arguments) == 0
    assert len(begun.read_text(encoding="utf-8").splitlines()) == 2  # iterations of 300 steps


def test_a_folder_with_other_trainings_is_refused(everything: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fig-5.2", "--steps", "1000", "--out", str(everything)]) == 2
    assert "holds another training" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fig-1.1"], "no table or figure is called 'fig-1.1'; there are: all, fig-5.2"),
        (["--seeds", "0"], "--seeds: expected at least 1, got 0"),
        (["--steps", "-5"], "--steps: expected at least 1, got -5"),
    ],
)
def test_what_cannot_be_reproduced_is_refused_in_a_line(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "new")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_agents_that_leave_the_limits_at_once_get_a_report_like_any_other(
    everything: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(everything / "trainings", tmp_path / "trainings")
    for module in (single, several):
        monkeypatch.setattr(module, "asked", lambda _: lambda batch: np.full(len(batch.k), 6.0))
    names = ["fig-5.3", "fig-5.4", "fig-5.6", "fig-5.7", "fig-5.8", "table-6.2"]
    assert main([*names, "--steps", STEPS, "--seeds", "2", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "reproduction.json").read_text(encoding="utf-8"))["results"]
    assert results[-1]["rows"][0][-1] == results[-1]["rows"][1][-1] == "100 (2 seeds: 100 to 100)"  # violations
    (home, *_) = results[names.index("fig-5.8")]["statements"]
    assert not home["agrees"]
    assert home["found"].startswith("0 of 5")


def test_a_training_without_a_shield_says_who_evaluates_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(presets, "load_preset", small)
    assert emb_train(["--preset", "thesis-random", "--steps", "300", "--out", str(tmp_path / "a")]) == 0
    assert "emb-train reproduce shows what it does" in capsys.readouterr().out


def test_a_printed_number_agrees_within_a_fifth_or_between_the_seeds() -> None:
    assert number(100.0, [119.0], "x").agrees
    assert not number(100.0, [121.0], "x").agrees
    assert number(100.0, [90.0, 500.0], "x").agrees
    assert not number(-100.0, [100.0], "x").agrees
    assert spread([1234.0]) == "1.23e+03"
    assert spread([1.0, 3.0, 5.0]) == "3 (3 seeds: 1 to 5)"


def test_a_return_rises_early_if_more_than_half_of_the_gain_comes_in_three_tenths_of_the_training() -> None:
    steady = np.linspace(0.0, 100.0, 101)
    assert not rises_early([steady]).agrees
    assert rises_early([np.minimum(4.0 * steady, 100.0)]).agrees
    assert not rises_early([-np.minimum(4.0 * steady, 100.0)]).agrees  # it falls
    assert rises_early([steady]).numbers["share_early"] == pytest.approx(0.3, abs=0.02)


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


def test_the_square_wave_has_a_period_of_20_ms() -> None:
    config = load_preset("thesis-d-optimal-1")
    current = run(config, BENCH, square_wave, [Draw(0, BENCH.brake)]).current[:, 0]
    np.testing.assert_array_equal(current, np.tile(np.repeat([6.0, -6.0], 10), 15))


def test_the_phases_of_table_5_1_are_the_whole_return(tmp_path: Path) -> None:
    made = trainings.Trainings(tmp_path, BENCH, (0,), 1, lambda _: None).first("thesis-trajectory-b")
    assert phases(made).shape == (3,)
    assert phases(made).sum() == pytest.approx(on_grid(made).returns.mean())
