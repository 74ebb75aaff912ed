"""Every later version decides the same again, bit for bit, on what these logs hold: bench, DBC, policy and frames.

``golden/done.mcap`` is ``emb-run --iface sim:plant=exact,seed=3 --duration 0.25`` with the shipped actor;
``golden/rejected.mcap`` is the play ``lie_jumps`` of :mod:`tests.hil.plays`: a run on a vcan0 in which every other
angle was 5 rad off, until there were too many. Both are of a version whose first move had a constant limit;
``golden/stoppable.mcap`` is the first command again, with a first move that friction can stop. A change that decides
otherwise on purpose says so in CHANGELOG.md and records them anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from emb_bench.cli.replay import main
from emb_bench.logs.log import read_log
from emb_runtime.policy.policy import load_policy

FOLDER = Path(__file__).parent / "golden"
LOGS = {
    "done": ("DONE", 251, 253, 5),
    "rejected": ("FRAMES_REJECTED", 158, 161, 214),
    "stoppable": ("DONE", 251, 253, 5),
}
"""Exit reason, and how many decisions, sent frames and safety events each holds."""


@pytest.mark.parametrize("name", LOGS)
def test_every_decision_frame_and_event_of_a_golden_log_comes_out_again(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    reason, decisions, frames, events = LOGS[name]
    assert main(["rerun", str(FOLDER / f"{name}.mcap"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["differences"] == []
    assert (found["decisions"], found["frames"], found["events"]) == (decisions, frames, events)
    assert read_log(FOLDER / f"{name}.mcap").end["exit_reason"] == reason


@pytest.mark.parametrize(("name", "most"), [("done", 2.1504608294930874), ("stoppable", 6.0)])
def test_a_log_says_by_its_entries_what_limited_its_first_move(name: str, most: float) -> None:
    log = read_log(FOLDER / f"{name}.mcap")
    assert log.run["first_current"] == "2.1504608294930874"
    assert log.run.get("first_move") == ("stoppable" if name == "stoppable" else None)
    cycles = log.cycles
    first = [float(u) for u in cycles["sent_current"][cycles["step"] >= 0][:2]]
    assert max(abs(u) for u in first) == pytest.approx(most, abs=0.004)


@pytest.mark.parametrize("name", LOGS)
def test_its_policy_is_accepted_for_its_bench(name: str) -> None:
    log = read_log(FOLDER / f"{name}.mcap")
    assert log.complete
    assert load_policy(log.attachments["policy.onnx"], log.bench).contract.horizon == log.bench.timing.horizon
