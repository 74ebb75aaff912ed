"""Inputs in the journal of a run: what the driver did, call by call.

That they make every record of the run again is shown from the log of each fault by ``tests/bench/test_rerun.py``.
"""

from __future__ import annotations

from typing import Any

from emb_runtime.log.ring_buffer import FrameRecord, InputRecord
from emb_runtime.records import Call, Frame

from tests.conftest import FunctionActor, Journal, Simulate, make_loop  # isort: skip
from tests.scenarios.injections import Pulse
from tests.scenarios.table import loop_run

STEPS = 200


def test_what_the_driver_did_is_in_the_journal_call_by_call(simulate: Simulate) -> None:
    class Broken(Pulse):
        """A watchdog that cannot be let go."""

        def disarm(self) -> None:
            raise OSError("broken pipe")

    journal = Journal()
    run = simulate(lambda *_: 3.0, steps=STEPS, journal=journal, pulse=Broken())
    inputs = [record for record in journal.records if isinstance(record, InputRecord)]
    assert [Call(record.call) for record in inputs] == [
        *(Call.BEGIN, *[Call.ANSWER] * STEPS),
        *(Call.STOP_FRAME, Call.STOP_FRAME, Call.STOP_FRAME, Call.NOTE, Call.END),
    ]
    answers = [(record.time_ns, record.send_time_ns) for record in inputs if record.call == Call.ANSWER]
    assert answers == [(cycle.decide_time_ns, cycle.send_time_ns) for cycle in journal.cycles[:STEPS]]
    assert (inputs[-2].code, inputs[-2].text) == ("DISARM_FAILED", "OSError: broken pipe")
    assert run.outcome.fault is None


def test_an_answer_that_was_lost_says_why_and_one_that_was_left_was_not_sent(simulate: Simulate) -> None:
    for name, texts in (("queue", 3), ("no_status", 0)):
        run = loop_run(name, simulate)
        inputs = [record for record in run.journal.records if isinstance(record, InputRecord)]
        unsent = [record for record in inputs if record.call == Call.ANSWER and not record.send_time_ns]
        assert len(unsent) == run.outcome.counters.unanswered > 0
        assert sum(bool(record.text) for record in unsent) == texts


def test_a_sample_is_answered_once_and_without_one_nothing_is(simulate: Simulate) -> None:
    journal = Journal()
    run = simulate(lambda *_: 3.0, steps=STEPS, journal=journal)
    inputs = [record for record in journal.records if isinstance(record, FrameRecord | InputRecord)]
    at = next(n for n, r in enumerate(inputs) if isinstance(r, InputRecord) and r.call == Call.ANSWER)
    driven: dict[str, Any] = dict.fromkeys(("send", "receive", "now_ns", "push"))
    core, frames = make_loop(run.bench, FunctionActor(lambda *_: 3.0), STEPS, **driven).core, list[Frame]()
    assert core.answer(0) is None
    for record in inputs[:at]:
        if isinstance(record, InputRecord):
            core.begin(record.time_ns)
            continue
        frames.append(record.frame)
        if record.read_ns:
            core.process_frames(frames, record.read_ns)
            frames = []
    time_ns = inputs[at].time_ns
    assert core.answer(time_ns) is not None
    core.records.clear()
    assert core.answer(time_ns) is None
    assert core.records == []


def test_a_fault_is_latched_before_the_first_stop_frame_and_explained_after_it(simulate: Simulate) -> None:
    journal = loop_run("program", simulate).journal
    inputs = [record for record in journal.records if isinstance(record, InputRecord)]
    at = next(n for n, record in enumerate(inputs) if record.call == Call.LATCH)
    assert [Call(record.call).name for record in inputs[at : at + 3]] == ["LATCH", "STOP_FRAME", "EXPLAIN"]
    assert inputs[at].code == inputs[at + 2].code == "INTERNAL"
    assert inputs[at + 2].text.startswith("ZeroDivisionError: ")
