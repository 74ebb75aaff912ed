"""Experiments with their ways home."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_bench.sim.node import STATUS_PERIODS, BrakeNode
from emb_runtime.can.messages import StopReason
from emb_runtime.config.bench import Bench
from emb_runtime.records import NodeState
from tests.actors import constant_actor
from tests.runtime.operating import Edited, EmbRun, Sim

pytestmark = pytest.mark.usefixtures("handlers")


@pytest.fixture
def short(tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str], one_process: None) -> EmbRun:
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

    def stop_at_the_limit(node: BrakeNode) -> None:
        node.state, node.stop_reason = NodeState.STOPPING, StopReason.LIMIT

    sim.when(just_after_a_status, stop_at_the_limit)
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
