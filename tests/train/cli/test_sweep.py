"""A sweep: the same trainings as one by one, in parallel, here and on Ray, and none that fails costs another."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.errors import UsageError
from emb_train import CHECKPOINT
from emb_train.cli.sweep import Outcome, Trial, document, main, outcomes, seeds_of, settings_of, table, trained
from emb_train.cli.train import main as train_main
from emb_train.training.checkpoint import BEST
from tests.train.trainings import HORIZON, ITERATION, make_tiny, short_bench


@pytest.fixture
def sweep(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    """A sweep of tiny trainings; the other processes read them from the directories."""
    make_tiny(monkeypatch)
    bench = short_bench(tmp_path)

    def run(*arguments: object) -> int:
        return main(["--preset", "single-viscous", "--bench", str(bench), *map(str, arguments)])

    return run


def said_in(directory: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((directory / "sweep.json").read_text())
    return result


@pytest.mark.slow
def test_each_training_of_a_sweep_is_the_training_alone_bit_for_bit(
    sweep: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    assert sweep("--out", out, "--seeds", "4", "--set", "learning_rate=1e-3,1e-2", "--jobs", 2) == 0
    alone = ["--preset", "single-viscous", "--bench", str(tmp_path / "short.toml"), "--out", str(tmp_path / "a")]
    assert train_main([*alone, "--seed", "4"]) == 0
    one = out / "learning_rate=0.001,seed=4"
    for name in (CHECKPOINT, BEST, "metrics.jsonl", "config.json"):
        assert (one / name).read_bytes() == (tmp_path / "a" / name).read_bytes(), name
    said = said_in(out)
    assert [(t["setting"], t["seed"]) for t in said["trainings"]] == [
        ("learning_rate=0.001", 4),
        ("learning_rate=0.01", 4),
    ]
    scores = [
        json.loads((Path(t["directory"]) / "metrics.jsonl").read_text().splitlines()[-1])["score"]
        for t in said["trainings"]
    ]
    assert [t["score"] for t in said["trainings"]] == scores
    assert [group["score"][0] for group in said["settings"]] == scores
    assert "learning_rate=0.01 " in capsys.readouterr().out

    before = {p: p.stat().st_mtime_ns for p in out.glob("*/*.safetensors")}
    assert sweep("--out", out, "--seeds", "4", "--set", "learning_rate=1e-3", "--jobs", 1, "--json") == 0
    assert json.loads(capsys.readouterr().out) == said_in(out)
    assert {p.name for p in before} == {CHECKPOINT, BEST}
    assert all(p.stat().st_mtime_ns == then for p, then in before.items())  # what is finished is not trained again


@pytest.mark.slow
def test_on_ray_a_training_is_the_training_alone(sweep: Callable[..., int], tmp_path: Path) -> None:
    assert sweep("--out", tmp_path / "ray", "--seeds", "5", "--jobs", 1, "--ray") == 0
    alone = ["--preset", "single-viscous", "--bench", str(tmp_path / "short.toml"), "--out", str(tmp_path / "a")]
    assert train_main([*alone, "--seed", "5"]) == 0
    assert (tmp_path / "ray" / "seed=5" / CHECKPOINT).read_bytes() == (tmp_path / "a" / CHECKPOINT).read_bytes()
    assert said_in(tmp_path / "ray")["settings"][0]["failed"] == 0


def test_what_goes_wrong_in_a_training_is_its_outcome(
    sweep: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("emb_train.cli.sweep.outcomes", at_once)
    assert sweep("--out", tmp_path / "s") == 1
    directory = tmp_path / "s" / "seed=0"
    (directory / CHECKPOINT).write_bytes(b"junk")
    outcome = trained(Trial("", 0, str(directory)))
    assert "no usable checkpoint" in outcome.error
    assert outcome.score is None


@pytest.mark.parametrize("damage", ["", "junk\n", "{}\n"])
def test_metrics_that_cannot_be_read_fail_their_own_training_only(
    damage: str, sweep: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("emb_train.cli.sweep.outcomes", at_once)
    assert sweep("--out", tmp_path / "s") == 1
    directory = tmp_path / "s" / "seed=0"
    (directory / "metrics.jsonl").write_text(damage, encoding="utf-8")
    monkeypatch.setattr("emb_train.training.loop.train", lambda *_, **__: False)  # finished before
    outcome = trained(Trial("", 0, str(directory)))
    assert f"{directory / 'metrics.jsonl'}: the last line is not that of an iteration" in outcome.error


def at_once(trials: Sequence[Trial], jobs: int | None, ray: str | None) -> Iterator[tuple[Trial, Outcome]]:
    """Outcomes without any training; the one with seed 0 fails."""
    for trial in trials:
        yield trial, Outcome(trial.seed / 0.75, 2.0, 3.0, 4) if trial.seed else Outcome(error="it broke")


def dies(trial: Trial) -> Outcome:
    """One process ends, the others do not."""
    if trial.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(1.0 * trial.seed, 2.0, 3.0, 4)


@pytest.mark.slow
def test_a_process_that_dies_costs_its_own_training_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emb_train.cli.sweep.trained", dies)
    trials = [Trial("", seed, f"d{seed}") for seed in range(3)]
    found = dict(outcomes(trials, 2, None))
    assert "SIGKILL" in found[trials[1]].error
    assert [found[trials[seed]].score for seed in (0, 2)] == [0.0, 2.0]


def test_a_failed_training_makes_exit_code_1_and_the_others_their_table(
    sweep: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("emb_train.cli.sweep.outcomes", at_once)
    assert sweep("--out", tmp_path / "s", "--seeds", "0-2") == 1
    said = said_in(tmp_path / "s")["settings"]
    assert (said[0]["failed"], said[0]["trainings"], said[0]["score"][0]) == (1, 3, 2.0)
    captured = capsys.readouterr()
    assert f"FAILED {tmp_path / 's' / 'seed=0'}: it broke" in captured.out
    assert captured.err.splitlines()[-1].endswith("seed=2: score 2.667")


def test_mean_and_interval_are_those_of_student_over_the_seeds() -> None:
    results = {Trial("", s, str(s)): Outcome(value, value, None, 1) for s, value in enumerate((1.0, 2.0, 3.0))}
    said = document(results)["settings"][0]
    half = 4.302652729911275 / math.sqrt(3.0)  # the 97.5 % point of t with two degrees of freedom, deviation 1
    assert said["score"] == pytest.approx([2.0, 2.0 - half, 2.0 + half])
    assert said["information"] is None
    assert said["violations"] == 3
    assert "2 ± 2.5" in table({"settings": [said], "trainings": []})


def test_seeds_are_ranges_and_lists() -> None:
    assert seeds_of("0-3,7") == [0, 1, 2, 3, 7]
    for wrong in ("", "a", "1-", "3-1", "1,1", "-1"):
        with pytest.raises(UsageError, match="--seeds"):
            seeds_of(wrong)


def test_settings_are_every_combination_with_the_types_of_the_hyper_parameters() -> None:
    assert settings_of([]) == [{}]
    assert settings_of(["clip=0.1,0.2", "hidden=8x8", "epochs=2"]) == [
        {"clip": 0.1, "hidden": (8, 8), "epochs": 2},
        {"clip": 0.2, "hidden": (8, 8), "epochs": 2},
    ]
    for wrong in ("speed=1", "clip", "clip=", "total_steps=5"):
        with pytest.raises(UsageError, match="--set"):
            settings_of([wrong])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("epochs=1.5", "--set: epochs: expected a whole number, got '1.5'"),
        ("clip=0.1,x", "--set: clip: expected a number, got 'x'"),
        ("hidden=8xa", "--set: hidden: expected widths such as 64x64, got '8xa'"),
    ],
)
def test_a_value_of_another_type_is_refused_with_the_type_that_was_expected(text: str, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        settings_of([text])
    assert str(refused.value) == said


def test_a_hyper_parameter_cannot_be_set_twice() -> None:
    with pytest.raises(UsageError, match="--set"):
        settings_of(["clip=0.1", "clip=0.2"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--jobs", "0"], "--jobs"),
        (["--set", "clip=0.1,0.1"], "twice"),
        (["--set", "clip=-1"], "clip: expected a positive number"),
        (["--plant", "rubber"], "no plant is called 'rubber'"),
        (["--steps", "0"], "--steps: expected a whole number from 1 to"),
        (["--set", f"rollout={HORIZON + 1}"], "whole experiments"),
    ],
)
def test_a_sweep_that_cannot_be_done_is_refused_in_one_line_and_makes_nothing(
    arguments: list[str], words: str, sweep: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep("--out", tmp_path / "s", *arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("emb-train sweep: ")
    assert words in message
    assert message.count("\n") == 1
    assert not (tmp_path / "s").exists()


def test_a_directory_with_another_training_is_not_taken_for_this_one(
    sweep: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("emb_train.cli.sweep.outcomes", at_once)
    assert sweep("--out", tmp_path / "s", "--steps", ITERATION, "--seeds", "1") == 0
    capsys.readouterr()
    assert sweep("--out", tmp_path / "s", "--steps", 2 * ITERATION, "--seeds", "1") == 2
    assert "holds another training" in capsys.readouterr().err
