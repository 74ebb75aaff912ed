"""``emb-train``: what a training writes, what is refused, and what is left when it is stopped."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import EXIT_INTERRUPTED, EXIT_USAGE, UsageError
from emb_runtime.policy.policy import load_policy
from emb_runtime.system.terminal import DOCUMENT_SCHEMA
from emb_train.cli import main
from emb_train.network import network_file
from emb_train.plan import Found
from emb_train.play import fresh_draws
from emb_train.presets import preset_record, preset_summaries
from emb_train.rewards import Transition, information_increment
from emb_train.training import (
    BENCH,
    CONFIGURATION,
    CURVE,
    METRICS,
    ONNX,
    PLAN,
    Training,
    Validation,
    begin_training,
    hyper_parameters,
    load_preset,
    run_training,
    training_from,
)
from tests.commands import refused
from tests.train.trainings import HORIZON, ITERATION, make_tiny, short_bench, tiny

FILES = [ONNX, BENCH, "bench.schema.json", CURVE, METRICS, CONFIGURATION]


def policy_of(folder: Path) -> dict[str, Any]:
    """What a training's policy says of its origin."""
    return dict(load_policy(folder / ONNX, load_bench(folder / BENCH)).contract.provenance)


def configuration_of(folder: Path) -> Training:
    record = json.loads((folder / CONFIGURATION).read_text())
    assert record.pop("schema") == DOCUMENT_SCHEMA
    return training_from(record, "it")


def metrics_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / METRICS).read_text().splitlines()]


def test_a_training_writes_all_that_its_result_depends_on_and_keeps_the_best_actor(
    finished: Path, tmp_path: Path
) -> None:
    assert sorted(p.name for p in finished.iterdir()) == sorted(FILES)
    metrics, bench = metrics_of(finished), load_bench(finished.parent / "short.toml")
    assert configuration_of(finished) == tiny()
    assert load_bench(finished / BENCH) == bench
    assert [m["steps"] for m in metrics] == [ITERATION, 2 * ITERATION, 3 * ITERATION]
    scores = [m["score"] for m in metrics]
    best = scores.index(max(scores))
    assert (policy_of(finished)["steps"], policy_of(finished)["score"]) == (metrics[best]["steps"], scores[best])
    assert len({(finished / name).stat().st_mode for name in (CONFIGURATION, ONNX)}) == 1
    begin_training(tmp_path / "again", tiny(), bench)
    better = list(run_training(tmp_path / "again", tiny(), bench))
    assert [one.score for one in better] == sorted({*np.maximum.accumulate(scores).tolist()})
    assert Validation(tiny(), bench).score(better[-1].actor) == scores[best]
    assert network_file(better[-1], tiny(), bench)[0] == (finished / ONNX).read_bytes()


def test_a_training_for_speeds_begins_with_a_plan_and_is_never_worse(finished_speeds: Path) -> None:
    assert sorted(p.name for p in finished_speeds.iterdir()) == sorted([*FILES, PLAN])
    plan = json.loads((finished_speeds / PLAN).read_text())["speeds"]
    assert len(plan) == HORIZON
    assert max(map(abs, plan)) <= 1.0
    metrics = metrics_of(finished_speeds)
    assert [m["steps"] for m in metrics] == [0, ITERATION, 2 * ITERATION]
    assert policy_of(finished_speeds)["score"] == max(m["score"] for m in metrics)
    policy = load_policy(finished_speeds / ONNX, load_bench(finished_speeds / BENCH))
    assert (policy.contract.kind, len(policy.contract.inputs)) == ("speed", 11)


@pytest.mark.parametrize(("preset", "of"), [("single-viscous", "finished"), ("interval", "finished_speeds")])
def test_the_same_seed_gives_the_same_files(
    preset: str, of: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_tiny(monkeypatch)
    done: Path = request.getfixturevalue(of)
    bench, other = done.parent / "short.toml", tmp_path / "run"
    assert main(["ppo", preset, "--bench", str(bench), "--output", str(other)]) == 0
    for path in done.iterdir():
        assert (other / path.name).read_bytes() == path.read_bytes(), path.name


def test_the_search_for_a_plan_has_a_price_of_its_own_for_a_lie_that_the_motion_does_not_show(
    finished_speeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_tiny(monkeypatch)
    bench = load_bench(finished_speeds / BENCH)

    def returns(searched: float | None, learned: float) -> tuple[float, float]:
        """Return of the best plan that was drawn, and score of the actor that follows the best of all."""
        training = load_preset("interval", **{"plan.hidden": searched, "demands.hidden": learned})
        folder, shown = tmp_path / f"{searched},{learned}", list[Any]()
        begin_training(folder, training, bench)
        *_, _ = run_training(folder, training, bench, shown.append)
        return shown[0].best, metrics_of(folder)[0]["score"]

    (plan, score), (same, paid), (free, _) = returns(10.0, 4.0), returns(10.0, 0.0), returns(0.0, 4.0)
    assert plan == same < free
    assert returns(None, 0.0)[0] == free
    assert score < paid


def test_hyper_parameters_are_set_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_tiny(monkeypatch)
    given = "hidden=[4,4] clip=0.1 clone_steps=2 scale=0.5 total_steps=1 gain=0.2"
    given += " plan.drawn=3 plan.levels=4 plan.spread=0.3"
    options = [word for text in given.split() for word in ("--set", text)]
    options += ["--command-delay", "0", "2", "--plant", "exact,observer,stribeck"]
    folder, bench = tmp_path / "run", short_bench(tmp_path)
    assert main(["ppo", "--bench", str(bench), "--output", str(folder), *options]) == 0
    training = configuration_of(folder)
    assert load_policy(folder / ONNX, load_bench(bench)).contract.gain == training.conditions.gain == 0.2
    assert (training.conditions.command_delay, training.ppo.envs) == ((0, 2), 12)  # pairs of each of three plants
    assert (training.ppo.hidden, training.ppo.clip, training.ppo.clone_steps) == ((4, 4), 0.1, 2)
    assert training.plan is not None
    assert (training.plan.drawn, training.plan.levels, training.plan.spread) == (3, 4, 0.3)
    assert (training.scale, len(metrics_of(folder))) == (0.5, 2)
    said = capsys.readouterr().out
    assert all(str(folder / name) in said for name in (ONNX, CURVE))


def test_the_time_counts_until_the_precision_that_is_set(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_tiny(monkeypatch)
    bench, waited = load_bench(short_bench(tmp_path)), {}
    for precision in (0.0065, 0.5):  # a brake within 50 % is known to 0.29 before it moves
        training = load_preset("quick", **{"precision.repeatability": precision, "precision.price": 0.0})
        assert hyper_parameters(training)["precision.repeatability"] == precision
        (env, _) = training.environments(bench, 2)
        env.reset(seed=1)
        waited[precision] = sum(env.step(np.full((2, 1), 0.1, np.float32))[1].sum() for _ in range(HORIZON))
    assert waited[0.0065] == pytest.approx(-2 * HORIZON * training.scale)
    assert waited[0.5] > -2 * training.scale
    command = ["ppo", "interval", "--output", str(tmp_path / "x"), "--set", "precision.price=0.1"]
    assert "no hyper-parameter" in refused(lambda: main(command), capsys)


def test_ctrl_c_before_there_is_an_actor_leaves_none_and_after_that_the_best_one_as_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_tiny(monkeypatch)
    bench = short_bench(tmp_path)

    def pressed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def pressed_once(what: str) -> Callable[..., object]:
        real, times = getattr(sys.modules["emb_train.training"], what), 0

        def once(*given: Any, **named: Any) -> object:
            nonlocal times
            times += 1
            if what == "clone" and times > 1:
                return real(*given, **named)
            if what == "search":
                named["show"](Found(4, 1.0, np.linspace(-1.0, 1.0, 18)))
            raise KeyboardInterrupt

        return once

    for what, name, left in (
        ("search", "plan", False),
        ("clone", "cloning, twice", False),
        ("search", "a plan", True),
        ("clone", "cloning", True),
        ("train", "PPO", True),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(f"emb_train.training.{what}", pressed_once(what) if left else pressed)
            folder = tmp_path / name
            assert main(["ppo", "--bench", str(bench), "--output", str(folder)]) == EXIT_INTERRUPTED
        said = capsys.readouterr()
        assert (folder / ONNX).exists() == left, name
        assert ("nothing was trained" in said.err) != left, name
        assert (str(folder / ONNX) in said.out) == left, name
        if not left:
            assert list(folder.iterdir()) == [], name
            continue
        assert (policy_of(folder)["steps"], len(metrics_of(folder))) == (0, 1)
        assert (folder / CURVE).exists()
        assert metrics_of(folder)[0]["score"] == policy_of(folder)["score"]


def test_the_table_of_a_preset_is_its_callers_own() -> None:
    before = load_preset("interval")
    load_preset("interval", **{"plan.population": 5, "epochs": 1, "gain": 0.5})
    preset_record("interval")["ppo"]["hidden"] = []
    assert load_preset("interval") == before


def test_ctrl_c_and_divergence_leave_the_best_actor_so_far(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_tiny(monkeypatch)
    calls, stop = 0, True

    def ending(t: Transition) -> Any:
        nonlocal calls
        calls += 1
        if calls <= 4 * HORIZON:  # two iterations, each with its validation
            return information_increment(t)
        if stop:
            raise KeyboardInterrupt
        return math.nan * t.after[:, 0]

    monkeypatch.setitem(sys.modules["emb_train.rewards"].REWARDS, "information_increment", ending)
    bench = finished.parent / "short.toml"
    for code in (EXIT_INTERRUPTED, 1):
        calls, stop, folder = 0, code == EXIT_INTERRUPTED, tmp_path / str(code)
        assert main(["ppo", "single-viscous", "--bench", str(bench), "--output", str(folder)]) == code
        scores = [m["score"] for m in metrics_of(folder)]
        assert scores == [m["score"] for m in metrics_of(finished)][:2]
        assert policy_of(folder)["score"] == max(scores)


def test_training_validation_and_evaluation_draw_other_brakes(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    environments = Training.environments

    def noted(*arguments: Any) -> Any:
        made.append(environments(*arguments))
        return made[-1]

    monkeypatch.setattr(Training, "environments", noted)
    bench, f_v = load_bench(finished / BENCH), BrakeParameters._fields.index("f_v")
    ranges, actor = bench.range_set("viscous"), tiny().untrained_actor(bench)
    drawn: list[float] = []
    for seed in range(20):
        validation = Validation(tiny(seed=seed), bench)
        validation.score(actor)
        drawn += made[-1][0].batch.experiments.brakes[:, f_v].tolist()
        drawn += [draw.brake.f_v for draw in fresh_draws(ranges, seed, 50)]
        for iteration in range(5):  # as emb_train.ppo draws its seeds
            seeds = np.random.SeedSequence([seed, iteration]).generate_state(10, np.uint64).tolist()
            drawn += [np.random.default_rng(s).uniform(ranges.low, ranges.high)[f_v] for s in seeds]
    assert len(set(drawn)) == len(drawn) == 20 * (64 + 50 + 50)


def test_the_help_takes_no_torch_and_says_the_summaries_of_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["ppo", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert all(f" {name} {summary} " in said for name, summary in preset_summaries().items())
    code = (
        "import contextlib, sys\n"
        "from emb_train.cli import main\n"
        "with contextlib.suppress(SystemExit):\n"
        "    main(['--help'])\n"
        "sys.exit(any(name in sys.modules for name in ('torch', 'gymnasium', 'scipy', 'numba')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_in_the_imports_and_a_missing_extra_are_no_traceback(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from emb_train import emb_train\n"
        "class Pressed:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'emb_train.cli': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Pressed())\n"
        "sys.exit(emb_train())"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from emb_train.cli import main\n"
        f"sys.exit(main(['ppo', 'single-viscous', '--output', {str(tmp_path / 'run')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (EXIT_USAGE, 1)
    assert ".[train]'" in done.stderr


def test_a_bench_that_does_not_fit_the_training_is_refused_and_nothing_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = short_bench(tmp_path).read_text()
    for old, new in (('"envelope"', '"pm50"'), (f"= {HORIZON}", "= 120")):
        (tmp_path / "other.toml").write_text(text.replace(old, new, 1))
        command = ["ppo", "single-viscous", "--output", str(tmp_path / "x"), "--bench", str(tmp_path / "other.toml")]
        assert refused(lambda: main(command), capsys), new  # noqa: B023  # called at once
        assert not (tmp_path / "x").exists()


def test_a_damaged_folder_is_refused(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = (finished / ONNX).read_bytes()
    damages: list[tuple[int, Callable[[Path], object]]] = [
        (2, lambda d: (d / ONNX).unlink()),
        (2, lambda d: (d / BENCH).unlink()),
        (2, lambda d: (d / BENCH).write_text("junk")),
        (5, lambda d: (d / ONNX).write_bytes(data[:1000])),
        (5, lambda d: (d / ONNX).write_bytes(b"junk" * 100)),
        (5, lambda d: (d / BENCH).write_text((d / BENCH).read_text().replace("time = 1.0e-3", "time = 2.0e-3"))),
        (
            2,
            lambda d: (d / BENCH).write_text((d / BENCH).read_text().replace("angle    = 1.0e-3", "angle    = 1.1e-3")),
        ),
    ]
    for i, (code, damage) in enumerate(damages):
        folder = shutil.copytree(finished, tmp_path / str(i))
        damage(folder)
        assert refused(lambda: main(["evaluate", str(folder)]), capsys, code=code)  # noqa: B023  # called at once


def test_every_configuration_survives_json_and_impossible_values_are_refused_by_their_key() -> None:
    trainings = [load_preset(name, **changes) for name in preset_summaries() for changes in ({}, {"seed": 3})]
    trainings += [
        load_preset("interval", plants=["exact"], **{"plan.drawn": 3}),
        tiny(conditions={"command_delay": [0, 2]}),
    ]
    for training in trainings:
        assert training_from(msgspec.json.decode(msgspec.json.encode(training)), "it") == training
    record = msgspec.json.decode(msgspec.json.encode(tiny()))
    cases: list[tuple[str, Any]] = [
        ("reward", "none"),
        ("reward", []),
        ("scale", math.nan),
        ("scale", 0.0),
        ("memory", 0),
        ("ppo.envs", 0),
        ("ppo.epochs", -1),
        ("ppo.learning_rate", 0.0),
        ("ppo.learning_rate", math.inf),
        ("ppo.gamma", 1.1),
        ("ppo.clip", math.nan),
        ("ppo.noise_memory", 1.0),
        ("ppo.noise_hold", HORIZON + 1),
        ("ppo.hidden", [8, 0]),
        ("ppo.initial_mean", math.nan),
        ("ppo.memory", 0),
        ("conditions.horizon", 300),
        ("conditions.observes", "nothing"),
        ("conditions.information", "total"),
        ("conditions.command_delay", ["x", 0]),
        ("conditions.unknown", 1),
    ]
    for key, value in cases:
        changed = json.loads(json.dumps(record))
        *path, last = key.split(".")
        table = changed
        for part in path:
            table = table[part]
        table[last] = value
        with pytest.raises(UsageError, match=last):
            training_from(changed, "it")
    documents: list[Any] = [[], {}, {"preset": "x"}]
    for document in documents:
        with pytest.raises(UsageError):
            training_from(document, "it")
