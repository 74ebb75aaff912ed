"""Every later version decides the same again, bit for bit, on what these logs hold: bench, DBC, policy and frames.

``golden/done.mcap`` is ``emb-run --iface sim:plant=exact,seed=3 --duration 0.25`` with the shipped actor;
``golden/rejected.mcap`` the same with every other angle 5 rad off from the 420th on, until there were too many. A
change that decides otherwise on purpose says so in CHANGELOG.md and records them anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from emb_bench.cli.replay import main
from emb_bench.logs.log import read_log

FOLDER = Path(__file__).parent / "golden"
LOGS = {"done": ("DONE", 251, 253, 5), "rejected": ("FRAMES_REJECTED", 214, 217, 47)}
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
    log = read_log(FOLDER / f"{name}.mcap")
    assert log.complete
    assert log.end["exit_reason"] == reason
