"""The loop again from the logs of every stage and purpose: what may be run again is, and the rest is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.batch.campaign import find
from emb_bench.logs.log import read_log
from emb_bench.rerun import rerun
from emb_runtime.can.messages import Layout
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import Bench
from emb_runtime.control.actor import Still, homing_steps
from emb_runtime.records import RunState
from tests.actors import constant_actor
from tests.bench.conftest import Replay
from tests.bench.hostile import write_trace
from tests.conftest import FunctionActor, Journal, SimRun, Simulate

Run = Callable[..., Path]


@pytest.fixture
def run(tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs emb-run on the simulated bus; gives its log."""
    actor = tmp_path / "actor.onnx"
    actor.write_bytes(constant_actor(bench))

    def execute(*arguments: str) -> Path:
        log = tmp_path / "run.mcap"
        assert emb_run(["--policy", str(actor), "--log", str(log), *arguments]) == 0
        capsys.readouterr()
        return log

    return execute


@pytest.mark.parametrize("stage", [["--zero"], ["--limit", "0.7"], ["--limit", "3"]])
def test_a_run_of_any_stage_is_reproduced_with_its_limit(run: Run, stage: list[str], replay: Replay) -> None:
    result = replay.document("rerun", run(*stage))
    assert (result["decisions"], result["frames"], result["ended"]) == (501, 503, True)


def test_a_limit_that_was_altered_in_the_log_is_found(
    simulate: Simulate, bench: Bench, layout: Layout, tmp_path: Path
) -> None:
    journal = Journal()
    done: SimRun = simulate(lambda *_: 6.0, steps=100, journal=journal, limit=2.0)
    for limit, reproduced in (("2.0", True), ("2.5", False), ("6.0", False)):
        path = write_trace(
            tmp_path / f"{limit}.mcap", journal.records, bench, layout, done.outcome, steps=100, limit=limit
        )
        assert rerun(read_log(path), WANTS, 6.0).reproduced is reproduced


WANTS = FunctionActor(lambda *_: 6.0)  # An actor that wants all


@pytest.fixture
def homed(simulate: Simulate, bench: Bench, layout: Layout, tmp_path: Path) -> Path:
    """The log of a way home from 60 rad."""
    journal = Journal()

    def turned(frame: object, transport: object, _clock: object) -> object:
        node = transport.node  # type: ignore[attr-defined]
        if node.periods < 5:
            node.angle = 60.0
            return None
        return frame

    steps = homing_steps(bench)
    done = simulate(actor=Still(), steps=steps, journal=journal, homing=True, on_receive=turned)
    assert done.outcome.home
    return write_trace(
        tmp_path / "x-before-home.mcap",
        *(journal.records, bench, layout, done.outcome),
        steps=steps,
        purpose="homing",
        limit="6.0",
    )


def test_a_way_home_is_reproduced_and_needs_no_policy(homed: Path, replay: Replay) -> None:
    out = replay.text("rerun", homed)
    assert out.startswith("reproduced   each of")
    assert "DONE, home" in out


def test_a_way_home_is_counted_and_timed_like_an_experiment(homed: Path, replay: Replay) -> None:
    homing = read_log(homed).cycles["state"] == RunState.HOMING
    found = replay.document("info", homed)
    assert found["cycles"]["active"] == np.count_nonzero(homing) > 50
    assert found["largest"]["angle_max"] > 40.0
    (timing,) = replay.document("timing", homed)["logs"]
    assert timing["samples"] == np.count_nonzero(homing)


@pytest.mark.parametrize("command", ["fim", "rerun", "estimate"])
def test_a_log_of_mere_listening_is_refused_as_a_wrong_use(run: Run, command: str, replay: Replay) -> None:
    err = replay.refused(command, run("--read-only"))
    assert "nothing was driven" in err
    assert "--read-only" in err


@pytest.mark.parametrize("prior", [[], ["--prior", "pm50"]])
def test_of_a_run_with_no_current_it_is_said_in_one_line_that_nothing_was_excited(
    run: Run, prior: list[str], replay: Replay
) -> None:
    out = replay.text("fim", run("--zero"), *prior)
    assert "no information" in out
    assert "-inf" not in out
    assert "inf %" not in out


@pytest.mark.parametrize(
    ("name", "said"), [*(("limit", text) for text in ("seven", "nan", "-1", "7")), ("purpose", "pleasure")]
)
def test_a_log_that_says_nonsense_of_its_run_is_refused(
    simulate: Simulate, bench: Bench, layout: Layout, tmp_path: Path, name: str, said: str, replay: Replay
) -> None:
    journal = Journal()
    done = simulate(lambda *_: 1.0, steps=20, journal=journal)
    path = tmp_path / "odd.mcap"
    stated: dict[str, Any] = {"purpose": "experiment", "limit": "6.0"} | {name: said}
    policy = constant_actor(bench, 1.0)
    write_trace(path, journal.records, bench, layout, done.outcome, steps=20, policy=policy, **stated)
    err = replay.refused("rerun", path, code=6)
    assert name in err


def test_a_folder_of_logs_is_searched_for_experiments_only(homed: Path, run: Run) -> None:
    listened = homed.with_name("run-1-read.mcap")
    listened.write_bytes(homed.read_bytes())
    experiment = run("--duration", "0.05")
    assert [source.log for source in find([homed.parent])] == [experiment.name]
    assert [source.log for source in find([homed])] == [homed.name]
