"""The command: what it writes, what it refuses, and that nothing is lost when it is stopped."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tensorboard.backend.event_processing.event_accumulator import (  # type: ignore[import-untyped]  # it has no types
    EventAccumulator,
)

from emb_runtime.config.bench import BrakeParameters, load_bench
from emb_runtime.errors import UsageError
from emb_train import CHECKPOINT
from emb_train.cli.train import main
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Critic
from emb_train.ppo.ppo import Learner, Metrics
from emb_train.presets import load_preset, preset_names, preset_summaries
from emb_train.rewards import InformationIncrement
from emb_train.training.checkpoint import BEST, METADATA, METRICS, Progress, append_metrics, best_score, load_actor
from emb_train.training.configuration import Configuration
from emb_train.training.loop import Validation, chosen_device
from emb_train.training.progress import Bar, Lines, open_display
from tests.commands import refused
from tests.train.trainings import HORIZON, ITERATION, TINY, make_tiny, short_bench

Train = Callable[..., int]


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Train:
    make_tiny(monkeypatch)
    bench = short_bench(tmp_path)

    def run(*arguments: object) -> int:
        fixed = [] if "--resume" in arguments else ["--preset", "single-viscous", "--bench", str(bench)]
        return main([*fixed, *map(str, arguments)])

    return run


def metrics_of(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / METRICS).read_text().splitlines()]


def test_a_training_writes_all_that_its_result_depends_on(
    train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train("--out", out, "--seed", 7) == 0
    assert sorted(p.name for p in out.iterdir()) == [
        "bench.toml",
        "best.safetensors",
        "checkpoint.safetensors",
        "config.json",
        "metrics.jsonl",
        "result.json",
    ]
    config, bench, actor, progress = load_actor(out)
    assert config == dataclasses.replace(TINY, seed=7)
    assert bench == load_bench(tmp_path / "short.toml")
    assert progress == Progress(3, ((0, 3 * ITERATION),))
    assert actor(torch.zeros(1, 3)).shape == (1, 1)
    assert [m["steps"] for m in metrics_of(out)] == [ITERATION, 2 * ITERATION, 3 * ITERATION]
    rows = json.loads((out / "result.json").read_text())
    assert [r["name"] for r in rows[:3]] == ["trained actor", "constant +6 A", "constant -6 A"]
    assert rows[3]["name"].startswith("best blind switch")
    assert all(r["violations"] == 0 and r["home"] == 40 for r in rows)
    captured = capsys.readouterr()
    assert "trained actor" in captured.out
    assert f"{3 * ITERATION:,}/{3 * ITERATION:,} steps" in captured.err


def test_a_training_that_is_stopped_and_resumed_is_the_training_that_was_not(
    train: Train, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = tmp_path / "parts"
    iterate = Learner.iterate

    def interrupted(self: Learner) -> Metrics:
        if self.iteration == 2:
            raise KeyboardInterrupt
        return iterate(self)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "iterate", interrupted)
        assert train("--out", parts) == 130
    assert f"--resume {parts}" in capsys.readouterr().err
    assert load_actor(parts)[3].iteration == 2
    with (parts / METRICS).open("a") as file:
        file.write('{"iteration": 3, "steps": 99}\n{"iterat')  # a kill between the two files
    assert train("--resume", parts) == 0
    for name in (CHECKPOINT, BEST, METRICS, "config.json", "bench.toml", "result.json"):
        assert (parts / name).read_bytes() == (finished / name).read_bytes(), name


def test_a_training_stopped_before_its_first_iteration_leaves_a_usable_checkpoint(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: Learner) -> Metrics:
        raise KeyboardInterrupt

    monkeypatch.setattr(Learner, "iterate", interrupted)
    assert train("--out", tmp_path / "run") == 130
    assert load_actor(tmp_path / "run")[3].iteration == 0


def test_ctrl_c_in_the_evaluation_leaves_the_finished_training(
    train: Train, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(directory: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("emb_train.cli.train.evaluate", interrupted)
    assert train("--out", tmp_path / "run") == 130
    assert (tmp_path / "run" / CHECKPOINT).read_bytes() == (finished / CHECKPOINT).read_bytes()


def test_the_best_iteration_by_the_validation_is_kept_and_can_be_loaded(finished: Path) -> None:
    scores = [m["score"] for m in metrics_of(finished)]
    best = max(range(3), key=lambda i: (scores[i], -i))
    assert best_score(finished) == scores[best]
    config, bench, actor, progress = load_actor(finished, BEST)
    assert (progress.iteration, progress.score) == (best + 1, scores[best])
    assert Validation(config, bench).score(actor) == scores[best]


def test_the_validation_draws_other_brakes_than_any_iteration_of_the_training(finished: Path) -> None:
    config, bench, actor, _ = load_actor(finished)
    validation = Validation(config, bench)
    validation.score(actor)
    f_v = BrakeParameters._fields.index("f_v")
    drawn = set(validation._env.batch.brakes[:, f_v])
    assert len(drawn) == 64
    env = EmbExcitationVectorEnv(8, bench, config.ranges, config.parameters, config.reward)
    learner = Learner(env, actor, Critic(env.critic_size, (8, 8)), config.ppo, config.seed)
    for _ in range(3):
        learner.iterate()
        assert drawn.isdisjoint(env.batch.brakes[:, f_v])


def test_a_kill_between_the_best_checkpoint_and_the_last_one_changes_nothing(
    train: Train, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"

    def killed(directory: Path, record: Any) -> None:
        if record["iteration"] == 2:
            raise KeyboardInterrupt
        append_metrics(directory, record)

    with monkeypatch.context() as patch:
        patch.setattr("emb_train.training.loop.append_metrics", killed)
        assert train("--out", out) == 130
    assert load_actor(out)[3].iteration == 1
    assert train("--resume", out) == 0
    for name in (CHECKPOINT, BEST, METRICS):
        assert (out / name).read_bytes() == (finished / name).read_bytes(), name


def test_a_best_checkpoint_that_cannot_be_read_is_none(tmp_path: Path) -> None:
    assert best_score(tmp_path) is None
    (tmp_path / BEST).write_bytes(b"junk")
    assert best_score(tmp_path) is None


def test_tensorboard_gets_the_metrics_of_every_iteration(train: Train, tmp_path: Path) -> None:
    assert train("--out", tmp_path / "run", "--tensorboard") == 0
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    read = [(e.step, e.value) for e in events.Scalars("mean_return")]
    assert read == [(m["steps"], pytest.approx(m["mean_return"])) for m in metrics_of(tmp_path / "run")]


def test_without_tensorboard_its_option_is_refused_with_what_to_install(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    message = refused(lambda: train("--out", tmp_path / "run", "--tensorboard"), capsys)
    assert "pip install 'emb-excite[tensorboard]'" in message
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("asked", "there", "hidden", "chosen"),
    [
        ("auto", False, (64, 64), "cpu"),
        ("auto", True, (64, 64), "cpu"),
        ("auto", True, (64, 1024), "cuda"),
        ("auto", True, (), "cpu"),
        ("cpu", True, (1024,), "cpu"),
        ("cuda", True, (8,), "cuda"),
    ],
)
def test_a_gpu_is_chosen_for_wide_networks_or_when_asked_for(
    asked: str, there: bool, hidden: tuple[int, ...], chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    ppo = dataclasses.replace(TINY.ppo, hidden=hidden)
    assert chosen_device(asked, ppo).type == chosen


@pytest.mark.parametrize("command", ["evaluate", "sweep", "tune"])
def test_further_commands_are_named_in_the_help_and_have_one_of_their_own(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["--help"], [command, "--help"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0
        assert f"emb-train {command}" in capsys.readouterr().out


def test_the_help_lists_every_preset_with_its_summary(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert set(preset_summaries()) == set(preset_names())
    for name, summary in preset_summaries().items():
        assert summary == load_preset(name).summary
        assert f" {name} {summary} " in said


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"emb-train {version('emb-excite')}\n"


def test_the_help_takes_no_torch() -> None:
    code = (
        "import contextlib, sys\n"
        "from emb_train.cli.train import main\n"
        "with contextlib.suppress(SystemExit):\n"
        "    main(['--help'])\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_while_the_imports_take_their_time_is_no_traceback() -> None:
    code = (
        "import os, signal, sys\n"
        "from emb_bench.cli.entry import emb_train\n"
        "assert 'gymnasium' not in sys.modules\n"
        "class Pressed:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'gymnasium': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Pressed())\n"
        "sys.exit(emb_train())"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "emb-train: interrupted\n")


def test_a_directory_that_cannot_be_written_any_more_is_one_line(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("emb_train.training.checkpoint.save", full)
    assert "No space left" in refused(lambda: train("--out", tmp_path / "run"), capsys)


def test_what_is_not_finite_is_null_in_the_metrics(tmp_path: Path) -> None:
    append_metrics(tmp_path, {"iteration": 1, "mean_fim": float("nan"), "kl": 0.5})
    assert metrics_of(tmp_path) == [{"iteration": 1, "mean_fim": None, "kl": 0.5}]


def test_a_finished_training_can_be_taken_further(train: Train, copied: Path) -> None:
    assert train("--resume", copied, "--steps", 5 * ITERATION) == 0
    assert [m["iteration"] for m in metrics_of(copied)] == [1, 2, 3, 4, 5]
    assert load_actor(copied)[0].ppo.total_steps == 5 * ITERATION


def test_a_resume_of_what_is_finished_says_so_and_changes_nothing(
    train: Train, finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {p.name: p.read_bytes() for p in copied.iterdir()}
    assert train("--resume", copied) == 0
    said = f"{copied}: finished before, nothing was trained; --steps with more than {3 * ITERATION} takes it further\n"
    assert capsys.readouterr().out == said
    assert before == {p.name: p.read_bytes() for p in copied.iterdir()}


def test_a_resume_of_what_is_finished_makes_the_table_that_an_interruption_prevented(
    train: Train, finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copied / "result.json").unlink()
    assert train("--resume", copied) == 0
    captured = capsys.readouterr().out
    assert "finished before" in captured
    assert "trained actor" in captured
    assert (copied / "result.json").read_bytes() == (finished / "result.json").read_bytes()


def test_fewer_steps_than_are_done_are_refused_and_change_nothing(
    train: Train, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {p.name: p.read_bytes() for p in copied.iterdir()}
    assert f"{3 * ITERATION}, got {2 * ITERATION}" in refused(
        lambda: train("--resume", copied, "--steps", 2 * ITERATION), capsys
    )
    assert before == {p.name: p.read_bytes() for p in copied.iterdir()}


def test_a_resume_whose_checkpoint_is_refused_leaves_the_configuration(
    train: Train, finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copied / CHECKPOINT).write_bytes(b"junk")
    refused(lambda: train("--resume", copied, "--steps", 5 * ITERATION), capsys)
    assert (copied / "config.json").read_bytes() == (finished / "config.json").read_bytes()


def test_a_schedule_keeps_only_the_changes_that_were_acted_on() -> None:
    begun = Progress(2, ((0, 300),))
    assert begun.towards(300) == begun
    longer = begun.towards(500)
    assert longer == Progress(2, ((0, 300), (2, 500)))
    assert longer.towards(300) == begun
    assert longer.towards(400) == Progress(2, ((0, 300), (2, 400)))
    assert Progress(0, ((0, 300),)).towards(500) == Progress(0, ((0, 500),))


@pytest.mark.parametrize("horizon", [40, 120])
def test_a_bench_whose_horizon_does_not_divide_the_rollout_is_refused_before_anything_is_made(
    horizon: int, train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = short_bench(tmp_path, f"horizon     = {HORIZON}", f"horizon     = {horizon}")
    message = refused(lambda: train("--out", tmp_path / "run", "--bench", bench), capsys)
    assert f"{HORIZON} steps for the bench's horizon of {horizon}" in message
    assert not (tmp_path / "run").exists()


def test_ctrl_c_before_anything_was_saved_says_so(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("emb_train.training.loop.train", interrupted)
    assert train("--out", tmp_path / "run") == 130
    assert capsys.readouterr().err == "emb-train: interrupted; nothing was saved\n"


def test_a_training_that_diverges_says_so_and_keeps_the_last_good_checkpoint(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def diverging(self: InformationIncrement, transition: Any) -> Any:
        calls.append(1)
        good = 1e-6 * (transition.after[:, 0] - transition.before[:, 0])
        return good if len(calls) <= 4 else good * float("nan")  # two iterations, each with its validation

    monkeypatch.setattr(InformationIncrement, "__call__", diverging)
    assert train("--out", tmp_path / "run") == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("emb-train: training diverged in iteration 2: a reward")
    assert load_actor(tmp_path / "run")[3].iteration == 2


def test_a_directory_that_holds_something_is_not_overwritten(
    train: Train, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {p.name: p.read_bytes() for p in copied.iterdir()}
    assert "--resume" in refused(lambda: train("--out", copied, "--seed", 1), capsys)
    assert before == {p.name: p.read_bytes() for p in copied.iterdir()}
    assert "other files" in refused(lambda: train("--out", tmp_path), capsys)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--preset", "single-viscous"], "--out"),
        (["--out", "x"], "single-viscous"),
        (["--preset", "none", "--out", "x"], "no preset is called 'none'"),
        (["--resume", "x", "--seed", "1"], "--resume takes"),
        (["--resume", "x", "--plant", "exact"], "--resume takes"),
        (["--preset", "single-viscous", "--out", "x", "--plant", "rubber"], "no plant is called 'rubber'"),
        (["--resume", "nowhere"], "not the directory of a training"),
        (["--preset", "single-viscous", "--out", "x", "--steps", "0"], "--steps: expected a whole number from 1"),
        (
            ["--preset", "single-viscous", "--out", "x", "--steps", str(2**63)],
            "--steps: expected a whole number from 1",
        ),
        (["--preset", "single-viscous", "--out", "x", "--plant", ""], "no plant is called ''"),
        (["train"], "no command is called 'train'; there are: evaluate, sweep, tune"),
        (["--preset", "single-viscous", "--out", "x", "--seed", "-1"], "seed: expected"),
        (["--preset", "single-viscous", "--out", "x", "--seed", str(2**63)], "seed: expected"),
        (["--preset", "single-viscous", "--out", "x", "--bench", "none.toml"], "none.toml"),
        (["--preset", "single-viscous", "--out", "short.toml"], "short.toml"),
        (["--preset", "single-viscous", "--out", "x", "--device", "cuda"], "--device cuda: torch finds no CUDA device"),
    ],
)
def test_a_command_that_cannot_be_done_is_refused_in_one_line_and_makes_nothing(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    short_bench(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert said in refused(lambda: main(arguments), capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["short.toml"]


def test_a_preset_whose_ranges_the_shield_does_not_cover_is_refused(
    train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = short_bench(tmp_path, 'ranges        = "envelope"', 'ranges        = "pm50"')
    message = refused(lambda: train("--out", tmp_path / "run", "--bench", bench), capsys)
    assert "'viscous' has f_v from 1e-05 to 5e-05, the shield's set 'pm50' covers 1.08e-05 to 3.24e-05" in message


def rewrite(
    directory: Path, change: Callable[[dict[str, torch.Tensor]], object] = lambda tensors: None, **metadata: object
) -> None:
    """Change tensors and metadata of a checkpoint as someone with the library could."""
    path = directory / CHECKPOINT
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        record = json.loads(file.metadata()[METADATA])
    change(tensors)
    save_file(tensors, path, {METADATA: json.dumps(record | metadata)})


def without_adam(tensors: dict[str, torch.Tensor]) -> None:
    for key in [k for k in tensors if k.startswith("adam.")]:
        del tensors[key]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda d: rewrite(d, without_adam), "adam.0.exp_avg"),
        (lambda d: rewrite(d, lambda t: t.pop("adam.1.exp_avg_sq")), "adam.1.exp_avg_sq"),
        (lambda d: rewrite(d, lambda t: t.update({"adam.1.exp_avg": torch.zeros(3)})), "adam.1.exp_avg"),
        (lambda d: rewrite(d, lambda t: t.update({"adam.99.step": torch.zeros(())})), "adam.99.step"),
        (lambda d: rewrite(d, lambda t: t["actor.layers.0.bias"].fill_(math.nan)), "actor.layers.0.bias is not finite"),
        (lambda d: rewrite(d, lambda t: t["adam.0.step"].fill_(math.inf)), "adam.0.step is not finite"),
        (lambda d: rewrite(d, iteration=-2), "got -2"),
        (lambda d: rewrite(d, iteration=1.5), "got 1.5"),
        (lambda d: rewrite(d, iteration=True), "got True"),
        (lambda d: rewrite(d, iteration=0), "adam.0.exp_avg"),
        (lambda d: rewrite(d, iteration=10**30), "beyond"),
        (lambda d: rewrite(d, schedule=[]), "schedule"),
        (lambda d: rewrite(d, schedule=[[0]]), "no usable checkpoint"),
        (lambda d: rewrite(d, schema=1), "train again"),
    ],
)
def test_a_checkpoint_that_someone_changed_is_refused_with_what_is_wrong(
    damage: Callable[[Path], None], said: str, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copied)
    assert said in refused(lambda: main(["--resume", str(copied)]), capsys)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [("bench.toml", "angle    = 1.0e-3", "angle    = 1.1e-3"), ("config.json", '"clip": 0.2', '"clip": 0.3')],
)
def test_a_checkpoint_does_not_go_on_with_another_bench_or_configuration(
    name: str, old: str, new: str, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (copied / name).read_text()
    assert old in text
    (copied / name).write_text(text.replace(old, new))
    assert f"{name} is not the one" in refused(lambda: main(["--resume", str(copied)]), capsys)


def test_a_training_on_another_plant_goes_on_with_that_plant_only(
    train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train("--out", out, "--plant", "exact") == 0
    assert load_actor(out)[0].plant == "exact"
    assert train("--resume", out, "--steps", 4 * ITERATION) == 0
    assert load_actor(out)[0].plant == "exact"
    capsys.readouterr()
    text = (out / "config.json").read_text()
    for other in ("stribeck", "euler"):
        (out / "config.json").write_text(text.replace('"plant": "exact"', f'"plant": "{other}"'))
        assert "config.json is not the one" in refused(lambda: train("--resume", out), capsys)


def test_what_a_plant_s_name_means_may_not_change_under_a_training(
    train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train("--out", out, "--plant", "offset") == 0
    capsys.readouterr()
    text = (out / "bench.toml").read_text()
    assert "encoder_offset = 0.2" in text
    (out / "bench.toml").write_text(text.replace("encoder_offset = 0.2", "encoder_offset = 0.3"))
    assert "bench.toml is not the one" in refused(lambda: train("--resume", out), capsys)


def test_a_configuration_from_before_there_were_plants_keeps_its_identity() -> None:
    assert '"plant"' not in TINY.to_json()
    assert Configuration.from_json(TINY.to_json()).plant == "euler"
    other = dataclasses.replace(TINY, plant="exact")
    assert other.identity != TINY.identity
    assert Configuration.from_json(other.to_json()) == other


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: (d / CHECKPOINT).write_bytes((d / CHECKPOINT).read_bytes()[:1000]),
        lambda d: (d / CHECKPOINT).write_bytes(b"junk" * 100),
        lambda d: save_file({"actor.x": torch.zeros(1)}, d / CHECKPOINT, {METADATA: '{"schema": 1, "iteration": 1}'}),
        lambda d: save_file(load_file(d / CHECKPOINT), d / CHECKPOINT),
        lambda d: save_file(load_file(d / CHECKPOINT), d / CHECKPOINT, {METADATA: "[]"}),
        lambda d: save_file(load_file(d / CHECKPOINT), d / CHECKPOINT, {METADATA: '{"schema": 1}'}),
        lambda d: save_file(load_file(d / CHECKPOINT), d / CHECKPOINT, {METADATA: '{"schema": 2, "iteration": 1}'}),
        lambda d: (d / "config.json").write_text("{"),
        lambda d: (d / "config.json").write_text((d / "config.json").read_text().replace('"epochs"', '"epoch"')),
        lambda d: (d / "config.json").write_text((d / "config.json").read_text().replace('"seed": 0', '"seed": "0"')),
        lambda d: (d / "config.json").write_text((d / "config.json").read_text().replace("Increment", "Excrement")),
        lambda d: (d / "bench.toml").unlink(),
    ],
)
def test_a_damaged_directory_is_refused_in_one_line(
    damage: Callable[[Path], object], copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copied)
    assert str(copied) in refused(lambda: main(["--resume", str(copied)]), capsys)


@pytest.mark.parametrize("missing", ["torch", "gymnasium"])
def test_a_missing_extra_is_one_line_that_says_what_to_install(missing: str, tmp_path: Path) -> None:
    code = (
        f"import sys; sys.modules['{missing}'] = None\n"
        "from emb_train.cli.train import main\n"
        f"sys.exit(main(['--preset', 'single-viscous', '--out', {str(tmp_path / 'run')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "emb-excite[" in done.stderr
    assert done.stderr.count("\n") == 1


def test_every_preset_has_the_name_that_it_is_called_by_and_survives_json() -> None:
    assert "single-viscous" in preset_names()
    for name in preset_names():
        preset = load_preset(name)
        assert preset.preset == name
        assert Configuration.from_json(preset.to_json()) == preset


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"name": "InformationIncrement"', '"name": []', "reward"),
        ('"scale": 3e-07', f'"scale": {10**400}', "reward.scale"),
        ('"scale": 3e-07', '"scale": NaN', "reward.scale"),
        ('"learning_rate": 0.002', f'"learning_rate": {10**400}', "ppo.learning_rate"),
        ('"seed": 0', f'"seed": {2**63}', "seed"),
        ('"seed": 0', '"seed": -1', "seed"),
        ('"envs": 256', '"memory": 32, "envs": 256', "ppo.memory: version 0.2 has 0 only"),
        ('"envs": 256', '"actions": "squashed", "envs": 256', "ppo.actions: version 0.2 has 'clipped' only"),
    ],
)
def test_a_configuration_with_an_impossible_value_is_refused_by_its_key(old: str, new: str, said: str) -> None:
    text = load_preset("single-viscous").to_json()
    assert old in text
    with pytest.raises(UsageError, match=said):
        Configuration.from_json(text.replace(old, new))


def test_hyper_parameters_that_version_0_1_had_are_read_where_they_changed_nothing() -> None:
    preset = load_preset("single-viscous")
    text = preset.to_json().replace('"envs": 256', '"memory": 0, "actions": "clipped", "envs": 256')
    assert Configuration.from_json(text) == preset


@pytest.mark.parametrize("text", ["[]", "{}", '{"schema": 1}', '{"schema": 1, "reward": {"name": "none"}}'])
def test_what_is_no_configuration_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        Configuration.from_json(text)


# Progress -------------------------------------------------------------------------------------------------------------

SOME = Metrics(1, 500, 4.5, 1.25e7, 1, 3, 4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1e-3)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_plain_lines_come_at_most_every_few_seconds_and_always_at_the_end() -> None:
    out, times = io.StringIO(), iter([0.0, 10.0, 10.0, 11.0, 12.0, 12.0])
    with Lines(out, 0, 1500, lambda: next(times)) as lines:
        for iteration in (1, 2, 3):
            lines.show(dataclasses.replace(SOME, steps=500 * iteration))
    first, last = out.getvalue().splitlines()
    assert first == (
        "500/1,500 steps · 50 steps/s · return 4.500 · information 1.250e+07 · violations 1 · home 3/4 · ETA 20 s"
    )
    assert last.startswith("1,500/1,500 steps · 125 steps/s")


def test_a_bar_shows_speed_return_violations_and_the_time_left() -> None:
    out, times = io.StringIO(), iter([0.0, 10.0])
    with Bar(Console(file=out, force_terminal=True, width=160), 0, 1000, lambda: next(times)) as bar:
        bar.show(SOME)
    for part in ("50%", "50 steps/s", "return 4.500", "violations 1", "ETA"):
        assert part in out.getvalue()


def test_a_terminal_gets_the_bar_and_everything_else_plain_lines() -> None:
    assert isinstance(open_display(Terminal(), 0, 1), Bar)
    assert isinstance(open_display(io.StringIO(), 0, 1), Lines)
