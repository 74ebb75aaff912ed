"""The command: what it writes, what it refuses, and that nothing is lost when it is stopped."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from emb_runtime.config.bench import BrakeParameters, load_bench
from emb_runtime.errors import EXIT_INTERRUPTED, EXIT_USAGE, UsageError
from emb_train import CHECKPOINT
from emb_train.cli.train import main
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Critic
from emb_train.ppo.ppo import Learner, Metrics
from emb_train.presets import load_preset, preset_names, preset_summaries
from emb_train.rewards import InformationIncrement
from emb_train.training.checkpoint import BEST, METADATA, METRICS, Progress, append_metrics, load_actor
from emb_train.training.configuration import Configuration
from emb_train.training.loop import Validation
from tests.commands import refused
from tests.train.trainings import HORIZON, ITERATION, TINY, make_tiny, short_bench

Train = Callable[..., int]
FILES = ["bench.toml", BEST, CHECKPOINT, "config.json", METRICS, "result.json"]


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Train:
    make_tiny(monkeypatch)
    bench = short_bench(tmp_path)
    return lambda *arguments: main(["--preset", "single-viscous", "--bench", str(bench), *map(str, arguments)])


def metrics_of(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / METRICS).read_text().splitlines()]


def test_a_training_writes_all_that_its_result_depends_on(finished: Path) -> None:
    assert sorted(p.name for p in finished.iterdir()) == sorted(FILES)
    config, bench, actor, progress = load_actor(finished)
    assert config == TINY
    assert bench == load_bench(finished.parent / "short.toml")
    assert progress == Progress(3)
    assert actor(torch.zeros(1, 3)).shape == (1, 1)
    assert [m["steps"] for m in metrics_of(finished)] == [ITERATION, 2 * ITERATION, 3 * ITERATION]
    rows = json.loads((finished / "result.json").read_text())
    assert [r["name"] for r in rows[:3]] == ["trained actor", "constant +6 A", "constant -6 A"]
    assert rows[3]["name"].startswith("best blind switch")
    assert all(r["violations"] == 0 and r["home"] == 40 for r in rows)


def test_a_training_of_the_same_seed_is_the_same_files_and_shows_a_line_for_each_iteration(
    train: Train, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train("--out", tmp_path / "run") == 0
    for name in FILES:
        assert (tmp_path / "run" / name).read_bytes() == (finished / name).read_bytes(), name
    captured = capsys.readouterr()
    assert "trained actor" in captured.out
    assert [line.split(":")[0] for line in captured.err.splitlines()] == [f"iteration {i}/3" for i in (1, 2, 3)]


def test_ctrl_c_leaves_the_last_whole_iteration(
    train: Train, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    iterate = Learner.iterate
    for last in (0, 2):

        def interrupted(self: Learner, last: int = last) -> Metrics:
            if self.iteration == last:
                raise KeyboardInterrupt
            return iterate(self)

        with monkeypatch.context() as patch:
            patch.setattr(Learner, "iterate", interrupted)
            assert train("--out", tmp_path / f"run {last}") == EXIT_INTERRUPTED
        assert load_actor(tmp_path / f"run {last}")[3].iteration == last
    assert metrics_of(tmp_path / "run 2") == metrics_of(finished)[:2]


def test_the_best_iteration_by_the_validation_is_kept_and_can_be_loaded(finished: Path) -> None:
    scores = [m["score"] for m in metrics_of(finished)]
    best = max(range(3), key=lambda i: (scores[i], -i))
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


def test_every_command_has_a_help_that_takes_no_torch_and_lists_what_there_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for arguments in (["--help"], ["evaluate", "--help"], ["tune", "--help"], ["--version"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert set(preset_summaries()) == set(preset_names())
    for name, summary in preset_summaries().items():
        assert summary == load_preset(name).summary
        assert f" {name} {summary} " in said
    code = (
        "import contextlib, sys\n"
        "from emb_train.cli.train import main\n"
        "with contextlib.suppress(SystemExit):\n"
        "    main(['--help'])\n"
        "sys.exit('torch' in sys.modules or 'gymnasium' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_while_the_imports_take_their_time_is_no_traceback() -> None:
    code = (
        "import os, signal, sys\n"
        "from emb_train.entry import emb_train\n"
        "class Pressed:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'emb_train.cli.train': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Pressed())\n"
        "sys.exit(emb_train())"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_what_is_not_finite_is_null_in_the_metrics(tmp_path: Path) -> None:
    append_metrics(tmp_path, {"iteration": 1, "mean_fim": float("nan"), "kl": 0.5})
    assert metrics_of(tmp_path) == [{"iteration": 1, "mean_fim": None, "kl": 0.5}]


def test_a_training_that_diverges_ends_with_a_good_checkpoint_and_a_full_disk_is_no_traceback(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = 0
    good = InformationIncrement.__call__

    def diverging(self: InformationIncrement, transition: Any) -> Any:
        nonlocal calls
        calls += 1
        return good(self, transition) * (1.0 if calls <= 4 else math.nan)  # two iterations, each with its validation

    with monkeypatch.context() as patch:
        patch.setattr(InformationIncrement, "__call__", diverging)
        assert train("--out", tmp_path / "run") == 1
    assert load_actor(tmp_path / "run")[3].iteration == 2

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    capsys.readouterr()
    refused(lambda: train("--out", tmp_path / "other"), capsys)


def test_a_command_that_cannot_be_done_is_refused_in_one_line_and_makes_nothing(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short_bench(tmp_path)
    narrow = tmp_path / "narrow.toml"
    narrow.write_text((tmp_path / "short.toml").read_text().replace('"envelope"', '"pm50"', 1))
    (tmp_path / "long.toml").write_text((tmp_path / "short.toml").read_text().replace(f"= {HORIZON}", "= 120"))
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir()), {p.name: p.read_bytes() for p in finished.iterdir()}
    viscous = ["--preset", "single-viscous", "--out", "x"]
    for arguments in (
        viscous[:2],
        viscous[2:],
        ["train"],
        ["--preset", "none", "--out", "x"],
        [*viscous, "--plant", "rubber"],
        [*viscous, "--steps", "0"],
        [*viscous, "--steps", str(2**63)],
        [*viscous, "--seed", "-1"],
        [*viscous, "--seed", str(2**63)],
        [*viscous, "--bench", "none.toml"],
        [*viscous, "--bench", "narrow.toml"],
        [*viscous, "--bench", "long.toml"],
        [*viscous, "--randomise", "wind=0,1"],
        [*viscous[:3], "short.toml"],
        [*viscous[:3], str(finished)],
        [*viscous[:3], "."],
    ):
        assert refused(lambda: main(arguments), capsys), arguments  # noqa: B023  # called at once
    assert before == (sorted(tmp_path.iterdir()), {p.name: p.read_bytes() for p in finished.iterdir()})


def test_a_damaged_directory_is_refused(finished: Path, tmp_path: Path) -> None:
    def retold(directory: Path, metadata: str | None, **tensors: torch.Tensor) -> None:
        path = directory / CHECKPOINT
        save_file(load_file(path) | tensors, path, None if metadata is None else {METADATA: metadata})

    def edited(directory: Path, name: str, old: str, new: str) -> None:
        text = (directory / name).read_text()
        assert old in text
        (directory / name).write_text(text.replace(old, new))

    with safe_open(finished / CHECKPOINT, framework="pt") as file:
        good = file.metadata()[METADATA]
    damages: list[Callable[[Path], object]] = [
        lambda d: (d / CHECKPOINT).unlink(),
        lambda d: (d / CHECKPOINT).write_bytes((d / CHECKPOINT).read_bytes()[:1000]),
        lambda d: (d / CHECKPOINT).write_bytes(b"junk" * 100),
        lambda d: retold(d, None),
        lambda d: retold(d, "[]"),
        lambda d: retold(d, good.replace("iteration", "iterations")),
        lambda d: retold(d, good, more=torch.zeros(1)),
        lambda d: retold(d, good, log_deviation=torch.full((1,), math.nan)),
        lambda d: (d / "config.json").write_text("{"),
        lambda d: (d / "bench.toml").unlink(),
        lambda d: edited(d, "config.json", '"epochs"', '"epoch"'),
        lambda d: edited(d, "config.json", '"seed": 0', '"seed": "0"'),
        lambda d: edited(d, "config.json", "Increment", "Excrement"),
        lambda d: edited(d, "config.json", '"clip": 0.2', '"clip": 0.3'),  # of another training
        lambda d: edited(d, "bench.toml", "angle    = 1.0e-3", "angle    = 1.1e-3"),
        lambda d: edited(d, "bench.toml", "encoder_offset = 0.2", "encoder_offset = 0.3"),
    ]
    for i, damage in enumerate(damages):
        directory = tmp_path / str(i)
        directory.mkdir()
        for name in FILES:
            (directory / name).write_bytes((finished / name).read_bytes())
        load_actor(directory)
        damage(directory)
        with pytest.raises(UsageError):
            load_actor(directory)


def test_a_missing_extra_is_one_line_that_says_what_to_install(tmp_path: Path) -> None:
    for missing in ("torch", "gymnasium"):
        code = (
            f"import sys; sys.modules['{missing}'] = None\n"
            "from emb_train.cli.train import main\n"
            f"sys.exit(main(['--preset', 'single-viscous', '--out', {str(tmp_path / 'run')!r}]))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr.count("\n")) == (EXIT_USAGE, 1)
        assert "emb-excite[" in done.stderr


def test_every_configuration_survives_json() -> None:
    for name in preset_names():
        preset = load_preset(name)
        assert preset.preset == name
        for config in (preset, dataclasses.replace(preset, plant="exact", seed=3)):
            assert Configuration.from_json(config.to_json()) == config


def test_a_configuration_with_an_impossible_value_is_refused_by_its_key() -> None:
    text = load_preset("single-viscous").to_json()
    for old, new, key in (
        ('"name": "InformationIncrement"', '"name": []', "reward"),
        ('"scale": 3e-07', f'"scale": {10**400}', "reward.scale"),
        ('"scale": 3e-07', '"scale": NaN', "reward.scale"),
        ('"learning_rate": 0.002', f'"learning_rate": {10**400}', "ppo.learning_rate"),
        ('"seed": 0', f'"seed": {2**63}', "seed"),
        ('"seed": 0', '"seed": -1', "seed"),
        ('"envs": 256', '"memory": 0, "envs": 256', "ppo.memory"),
    ):
        assert old in text
        with pytest.raises(UsageError, match=key):
            Configuration.from_json(text.replace(old, new))
    for text in ("[]", "{}", '{"schema": 1}', '{"schema": 1, "reward": {"name": "none"}}'):
        with pytest.raises(UsageError):
            Configuration.from_json(text)
