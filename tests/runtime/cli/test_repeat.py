"""Experiments with their ways home, and many of them in a row."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_bench.sim.node import STATUS_PERIODS, BrakeNode
from emb_runtime.can.messages import StopReason
from emb_runtime.cli.repeat import with_next_seed
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import NodeState
from emb_runtime.system import compiled_core
from emb_runtime.system.compiled_core import Core
from tests.actors import constant_actor
from tests.runtime.operating import Edited, EmbRun, Sim

pytestmark = pytest.mark.usefixtures("handlers")


@pytest.fixture
def short(tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]) -> EmbRun:
    """emb-run with a short experiment, whose logs come into a folder."""
    return EmbRun(("--policy", str(actor), "--duration", "0.2"), capsys, tmp_path / "logs")


def test_a_brake_that_is_elsewhere_is_brought_home_first_with_a_log_of_its_own(
    short: EmbRun, tmp_path: Path, sim: Sim
) -> None:
    sim.angle = 40.0
    document = short.document("--home")
    assert (document["result"], document["home"], document["answered"]) == ("done", True, 200)
    assert list(document["homing"]) == ["before"]
    before = document["homing"]["before"]
    assert (before["purpose"], before["home"], before["result"]) == ("homing", True, "done")
    names = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert [name.endswith("-before-home.mcap") for name in names] == [True, False]
    log = read_log(Path(before["log"]))
    assert log.complete
    assert log.run["purpose"] == "homing"
    assert "policy.onnx" not in log.attachments
    assert log.metadata["emb.preflight"]["stage"].startswith("ok: full, on the way home")
    assert np.all(log.cycles["policy_current"][:-1] == 0.0)


def test_every_pre_flight_table_says_what_it_is_of(short: EmbRun, sim: Sim, edited: Edited) -> None:
    sim.angle = 40.0
    slow = edited("slew          = 12000.0", "slew          = 6000.0")
    _, first, second = short.streams("--home", "--bench", slow)[1].split("PRE-FLIGHT ")
    assert "full, on the way home: up to 6 A, for 3 s" in first.splitlines()[1]
    _, stage, *warnings = second.splitlines()
    assert stage.startswith("stage ")
    assert "full: up to 6 A, for 0.2 s" in stage
    assert any(line.startswith("slew ") for line in warnings)
    assert not any(line.startswith("node ") for line in warnings)


def test_a_brake_that_is_at_home_goes_no_way_home(short: EmbRun, tmp_path: Path, sim: Sim) -> None:
    document = short.document("--home")
    assert document["homing"] == {}
    assert len(list((tmp_path / "logs").iterdir())) == 1


def test_a_brake_that_ends_elsewhere_is_brought_home_afterwards(emb_run: EmbRun, tmp_path: Path, sim: Sim) -> None:
    document = emb_run.document("--limit", "1", "--home")
    assert not document["home"]
    assert document["homing"]["after"]["home"]
    assert document["homing"]["after"]["log"] == str(tmp_path / "run-after-home.mcap")
    assert abs(sim.node.angle) < 0.5
    assert max(map(abs, sim.currents)) <= 1.0


def test_without_home_a_brake_elsewhere_is_refused_and_nothing_moves(short: EmbRun, sim: Sim) -> None:
    sim.angle = 40.0
    document = short.document(code=3)
    assert document["result"] == "NODE_NOT_READY"
    assert "--home" in document["detail"]
    assert sim.sent == []


def test_a_way_home_that_fails_is_the_outcome_and_no_experiment_begins(short: EmbRun, sim: Sim) -> None:
    sim.angle = 5.0
    sim.when(lambda node: node.obeyed == 20, deafen)
    document = short.document("--home", code=3)
    assert (document["purpose"], document["home"]) == ("homing", False)
    assert document["result"] in ("NOT_OBEYED", "NODE_STOPPED")


def deafen(node: BrakeNode) -> None:
    node.receive = lambda frame: None  # type: ignore[method-assign]


def test_after_a_fault_of_the_policy_the_brake_comes_home_and_the_fault_is_still_the_outcome(
    emb_run: EmbRun, tmp_path: Path, bench: Bench, sim: Sim
) -> None:
    path = tmp_path / "mad.onnx"
    path.write_bytes(constant_actor(bench, 2.0, float("nan")))
    document = emb_run.document("--policy", str(path), "--home", code=3)
    assert document["result"] == "POLICY_NOT_FINITE"
    assert document["homing"]["after"]["home"]


def test_after_the_node_stopped_at_a_limit_nothing_moves_by_itself_though_it_tells_so_late(
    emb_run: EmbRun, tmp_path: Path, bench: Bench, sim: Sim
) -> None:
    path = tmp_path / "outward.onnx"
    path.write_bytes(constant_actor(bench, -2.0))

    def just_after_a_status(node: BrakeNode) -> bool:  # at rest again before the next one
        return node.obeyed > 100 and node.periods % STATUS_PERIODS == 10

    sim.when(just_after_a_status, lambda node: node._latch(StopReason.LIMIT))
    document = emb_run.document("--policy", str(path), "--home", code=3)
    assert (document["result"], document["node_at_rest"], document["node_stop_reason"]) == (
        "NODE_STOPPED",
        True,
        "LIMIT",
    )
    assert document["last_angle"] < -1.0
    assert document["homing"] == {}


def test_a_node_that_is_gone_after_the_experiment_leaves_the_brake_nobody_knows_where(
    short: EmbRun, sim: Sim, edited: Edited
) -> None:
    hasty = edited("start_timeout = 5.0", "start_timeout = 0.5")
    sim.change = lambda frame: None if sim.node.obeyed == 200 and sim.node.state is NodeState.IDLE else frame
    document = short.document("--bench", hasty, "--home", code=3)
    assert (document["result"], document["answered"]) == ("NOT_AT_REST", 200)
    assert document["homing"] == {}  # a person should look first


def test_a_campaign_is_one_log_and_one_line_per_run_with_other_noise_in_each(
    short: EmbRun, tmp_path: Path, sim: Sim
) -> None:
    found = short.documents("--iface", "sim:f_v=3e-5,seed=7", "--repeat", "3")
    assert [(d["run"], d["result"], d["home"]) for d in found] == [(n, "done", True) for n in (1, 2, 3)]
    assert sim.opened == ["f_v=3e-5,seed=7", "f_v=3e-5,seed=8", "f_v=3e-5,seed=9"]
    assert sorted(d["log"] for d in found) == sorted(map(str, (tmp_path / "logs").iterdir()))
    assert {read_log(Path(d["log"])).metadata["emb.truth"]["seed"] for d in found} == {"7", "8", "9"}


def test_a_campaign_in_words_is_a_line_per_run_and_a_summary(
    short: EmbRun, sim: Sim, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = Core(compiled=True, text="compiled")  # without a warning, whichever core runs the tests
    monkeypatch.setattr(compiled_core, "running", lambda: compared)
    out, err = short.streams("--repeat", "2")
    lines = out.splitlines()
    assert [line[:19] for line in lines[:2]] == ["run 1 of 2: done: 2", "run 2 of 2: done: 2"]
    assert lines[2].startswith("2 of 2 runs: 2 done; logs in ")
    assert err.count("pre-flight: ") == 1


def test_a_campaign_ends_after_a_fault_that_wants_to_be_looked_at(short: EmbRun, sim: Sim) -> None:
    strong = ("--iface", "sim:k_m=0.06,f_v=1e-6,T_c=2e-4")
    found = short.documents("--duration", "0.5", *strong, "--repeat", "3", code=3)
    assert [d["result"] for d in found] == ["MOTION_OUTSIDE_SET"]


def test_ctrl_c_ends_the_present_run_safely_and_the_campaign(short: EmbRun, sim: Sim) -> None:
    def second_run(node: BrakeNode) -> bool:
        return len(sim.opened) == 2 and node.obeyed == 50

    sim.when(second_run, lambda _node: signal.raise_signal(signal.SIGINT))
    found = short.documents("--repeat", "5", code=3)
    assert [d["result"] for d in found] == ["done", "INTERRUPTED"]
    assert read_log(Path(found[1]["log"])).complete
    assert sim.currents[-3:] == [0.0, 0.0, 0.0]


def test_a_campaign_whose_node_goes_away_says_so_in_its_last_document(short: EmbRun, sim: Sim) -> None:
    sim.change = lambda frame: None if len(sim.opened) == 2 else frame
    found = short.documents("--repeat", "5", code=4)
    assert [d["result"] for d in found] == ["done", "NO_NODE"]
    assert found[1]["log"] is None


def test_a_bus_that_is_lost_between_two_runs_is_told_as_one(short: EmbRun, sim: Sim) -> None:
    def unplug(_node: BrakeNode) -> None:
        raise BusError("can0: the interface has disappeared")

    sim.when(lambda node: len(sim.opened) == 2 and node.samples == 10, unplug)
    found = short.documents("--repeat", "3", code=4)
    assert [(d["result"], d["exit_code"]) for d in found] == [("done", 0), ("BUS_LOST", 4)]


def test_ctrl_c_between_two_runs_ends_the_campaign_and_is_no_success(
    short: EmbRun, sim: Sim, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(_document: object) -> str:
        signal.raise_signal(signal.SIGINT)
        return "done"

    monkeypatch.setattr("emb_runtime.cli.main.summary.brief", pressed)
    assert "1 of 3 runs: 1 done" in short.text("--repeat", "3", code=3)


@pytest.mark.parametrize(
    ("iface", "truth", "following"),
    [
        ("sim", {"seed": "1"}, "sim:seed=2"),
        ("sim:plant=exact", {"seed": "1"}, "sim:plant=exact,seed=2"),
        ("sim:seed=9,f_v=3e-5", {"seed": "9"}, "sim:f_v=3e-5,seed=10"),
        ("can0", {}, "can0"),
        ("virtual:t", {}, "virtual:t"),
    ],
)
def test_only_a_bus_that_has_a_seed_gets_the_next_one(iface: str, truth: dict[str, str], following: str) -> None:
    assert with_next_seed(iface, truth) == following
