"""Inputs in the journal of a run: fed to a core of the same setup, they make every record of the run again."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import pytest

from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.control.core import Core
from emb_runtime.log.ring_buffer import FrameRecord, InputRecord, Record
from emb_runtime.records import Call, Frame
from emb_runtime.safety.state_machine import Fault

from tests.conftest import FunctionActor, Journal, Simulate, make_loop  # isort: skip
from tests.benches import SENSOR_BENCH
from tests.scenarios.injections import Pulse
from tests.scenarios.table import IN_LOOP, loop_run

STEPS = 200


def records_of(core: Core, inputs: Iterable[Record], lost: list[str]) -> list[Record]:
    """Records of a core that gets these inputs; ``lost`` holds why the bus has no room for the next frame."""
    frames, found = list[Frame](), list[Record]()
    for record in inputs:
        if isinstance(record, FrameRecord):
            frames.append(record.frame)
            if record.read_ns:
                take(core, frames, record.read_ns)
                frames = []
        elif isinstance(record, InputRecord):
            call(core, record, lost)
        found += core.records
        core.records.clear()
    return found


def take(core: Core, frames: list[Frame], read_ns: int) -> None:
    with contextlib.suppress(ZeroDivisionError):  # of the actor
        core.process_frames(frames, read_ns)


def call(core: Core, record: InputRecord, lost: list[str]) -> None:
    """Make a call of the driver again."""
    time_ns, number, send_ns, code, text = record
    match number:
        case Call.BEGIN:
            core.begin(time_ns)
        case Call.TIMEOUT:
            core.timeout(time_ns)
        case Call.ANSWER:
            frame = core.answer(time_ns)
            if frame is not None and (send_ns or text):
                lost[:] = [text] if text else []
                try:
                    core.guard.send(frame)
                except TransmitQueueFullError:
                    core.sent(time_ns, text)
                else:
                    core.sent(send_ns)
        case Call.LATCH:
            core.latch(Fault[code], time_ns)
        case Call.EXPLAIN:
            core.explain(Fault[code], time_ns, text)
        case Call.STOP_FRAME:
            core.stop_frame(time_ns)
        case Call.NOTE:
            core.note(time_ns, code, text)
        case Call.END:
            core.end(time_ns)
        case _:
            raise AssertionError(record)


def assert_inputs_suffice(journal: Journal, law: Any, steps: int, on_bench: Any = SENSOR_BENCH, **core: Any) -> None:
    lost: list[str] = []

    def send(_frame: Frame) -> None:
        if lost:
            raise TransmitQueueFullError(lost.pop())

    driven: dict[str, Any] = {"send": send, "receive": None, "now_ns": None, "push": None}
    loop = make_loop(on_bench, FunctionActor(law), steps, **driven, **core)
    inputs = [record for record in journal.records if isinstance(record, FrameRecord | InputRecord)]
    again = records_of(loop.core, inputs, lost)
    assert list(map(repr, again)) == list(map(repr, journal.records))  # repr, because NaN is not equal to NaN


@pytest.mark.parametrize("name", sorted(IN_LOOP.keys() - {"unguarded"}))
def test_the_inputs_of_a_run_make_each_of_its_records_again(name: str, simulate: Simulate) -> None:
    given: dict[str, Any] = {}
    journal = Journal()

    def record(law: Any = lambda *_: 6.0, **arguments: Any) -> Any:
        given.update(law=law, **arguments)
        return simulate(law, journal=journal, **arguments)

    run = loop_run(name, record)
    fault = IN_LOOP[name].fault
    assert fault is None or fault.name in run.journal.codes
    core = {"homing": True} if given.get("homing") else {}
    assert_inputs_suffice(journal, given["law"], given.get("steps", run.bench.timing.horizon), run.bench, **core)


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
    core = make_loop(run.bench, FunctionActor(lambda *_: 3.0), STEPS, **driven).core
    assert core.answer(0) is None
    records_of(core, inputs[:at], [])
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
