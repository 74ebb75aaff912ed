"""The loop again from its log: what was recorded comes out again, whatever happened, and what was altered does not."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_bench.rerun import Rerun, carried_policy, rerun
from emb_bench.sim.transport import SimTransport
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import Bench
from emb_runtime.control.loop import STOP_FRAME_NOT_SENT
from emb_runtime.log.ring_buffer import EventRecord, FrameRecord, InputRecord, Record, pack, unpack
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.records import Call, CycleRecord, Frame, Reason, RunState
from emb_runtime.safety.state_machine import Fault
from tests.actors import constant_actor
from tests.bench.conftest import Replay
from tests.bench.hostile import Driven, HostileBus, Thoughtful, drive, write_trace
from tests.bench.simulated_logs import square
from tests.benches import SENSOR_BENCH
from tests.corrupt import rewritten
from tests.scenarios.table import IN_LOOP, loop_run

from tests.conftest import Journal, SimRun, Simulate  # isort: skip
from emb_bench.batch.campaign import find
from emb_runtime.control.actor import Still, homing_steps
from tests.conftest import FunctionActor

Law = Callable[[float, float, float], float]
NOT_PLAYED = {"unguarded"}  # Its guard is not carried by a log
OF_A_WAY_HOME = {"not_home", "turned_out"}
Again = Callable[..., Rerun]


@pytest.fixture
def again(tmp_path: Path, bench: Bench, layout: Layout) -> Again:
    """Writes a run's records, altered if asked for, as a log, reads it, and runs the loop again."""

    def write_and_rerun(
        run: Driven, law: Law = square, alter: Callable[[list[Record]], object] = lambda records: None, **changes: Any
    ) -> Rerun:
        records = list(run.journal.records)
        alter(records)
        outcome = changes.pop("outcome", run.outcome)
        on = changes.pop("on", bench)
        path = write_trace(tmp_path / "run.mcap", records, on, layout, outcome, steps=run.steps, **changes)
        return rerun(read_log(path), Thoughtful(law), 6.0)

    return write_and_rerun


@pytest.fixture
def hostile(bench: Bench, layout: Layout) -> Callable[..., Driven]:
    """A run on a hostile bus."""

    def run(seed: int, law: Law = square, steps: int = 150, **misbehaviour: Any) -> Driven:
        return drive(HostileBus(bench, layout, random.Random(seed), **misbehaviour), law, steps)

    return run


@pytest.fixture
def recorded(simulate: Simulate) -> Callable[..., Driven]:
    """A run on ``--iface sim``, with its journal in order."""

    def run(law: Law = square, steps: int = 150, **arguments: Any) -> Driven:
        journal = Journal()
        done: SimRun = simulate(law, steps=steps, journal=journal, **arguments)
        return Driven(done.outcome, journal, steps)

    return run


def assert_reproduced(result: Rerun, run: Driven) -> None:
    assert result.differences == ()
    assert result.decisions == len(run.journal.cycles)
    assert result.followed
    assert result.outcome is not None
    # repr, because NaN is not equal to NaN; whether the operator is told the same is part of it
    assert repr(asdict(result.outcome)) == repr(asdict(run.outcome))


# --- what happened is reproduced ------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", ["seed=1", "plant=stribeck", "plant=lag"])
def test_every_decision_of_the_shipped_actor_is_reproduced_on_every_brake(
    recorded: Callable[..., Driven], bench: Bench, layout: Layout, tmp_path: Path, options: str
) -> None:
    actor = load_policy(shipped_actor_path(), bench)
    run = recorded(actor=actor, steps=500, options=options)
    records = run.journal.records
    path = write_trace(tmp_path / "run.mcap", records, bench, layout, run.outcome, steps=500, policy=actor.data)
    log = read_log(path)
    carried = carried_policy(log)
    assert_reproduced(rerun(log, carried, carried.contract.limits.current), run)


MISBEHAVIOUR: dict[str, dict[str, Any]] = {
    "frames lost": {"lost": 0.03},
    "late answers and overtaken pairs": {"slow": 0.1},
    "silent periods": {"silent": 0.02},
    "damaged frames": {"damaged": 0.02},
    "somebody else commands": {"foreign": 0.003},
    "the bus takes no frame": {"refusing": 0.3},
    "the bus is lost": {"dying": 0.002},
    "a slow computer": {"reading_us": 300},
    "a backlog when it begins": {"backlog_ms": 250, "reading_us": 100},
    "all of it": {"lost": 0.01, "slow": 0.03, "silent": 0.003, "damaged": 0.005, "backlog_ms": 100},
}


@cache
def hostile_runs(name: str) -> tuple[Driven, ...]:
    """A few runs with one misbehaviour."""
    buses = (HostileBus(SENSOR_BENCH, load_layout(), random.Random(n), **MISBEHAVIOUR[name]) for n in range(5))
    return tuple(drive(bus, square, 150) for bus in buses)


@pytest.mark.parametrize("name", MISBEHAVIOUR)
def test_on_a_hostile_bus_whatever_happened_happens_again(again: Again, name: str) -> None:
    for run in hostile_runs(name):
        assert_reproduced(again(run), run)


def test_the_hostile_bus_is_hostile_enough() -> None:
    runs = [run for name in MISBEHAVIOUR for run in hostile_runs(name)]
    faults = {run.outcome.fault for run in runs}
    assert faults >= {None, Fault.SENSOR_LOST, Fault.FOREIGN_COMMAND, Fault.BUS_LOST, Fault.NODE_STOPPED}
    tallies = [run.outcome.counters for run in runs]
    assert sum(t.unanswered for t in tallies) > 100
    assert sum(t.missed for t in tallies) > 100
    assert sum(t.rejected for t in tallies) > 10
    assert sum(t.not_obeyed for t in tallies) > 10
    codes = {code for run in runs for code in run.journal.codes}
    assert codes >= {"SENSOR_LATE", "FRAME_REJECTED", "STOP_FRAME_NOT_SENT"}
    late = [c for run in runs for c in run.journal.cycles if c.reasons & Reason.MISSED and c.decide_time_ns]
    overtaken = [c for run in runs for c in run.journal.cycles if c.reasons & Reason.MISSED and not c.decide_time_ns]
    assert late
    assert overtaken


def test_ctrl_c_at_any_moment_happens_again_at_that_moment(hostile: Callable[..., Driven], again: Again) -> None:
    for asked in (0, 5, 40, 79, 80, 81, 82, 83, 84, 85, 200, 201, 202, 300, 400):
        run = hostile(3, stop_after=asked, reading_us=100)
        assert run.outcome.fault is Fault.INTERRUPTED, asked
        assert_reproduced(again(run), run)


@pytest.mark.parametrize("name", sorted(IN_LOOP.keys() - NOT_PLAYED))
def test_a_run_with_any_fault_is_reproduced(
    recorded: Callable[..., Driven], again: Again, name: str, bench: Bench
) -> None:
    laws: list[Law] = []
    benches: list[Bench] = []

    def record(law: Law = square, **arguments: Any) -> Any:
        laws.append(law)
        benches.append(arguments.get("on_bench", bench))
        return recorded(law, **{"steps": 500, **arguments})

    run: Any = loop_run(name, record)
    fault = IN_LOOP[name].fault
    assert fault is None or fault.name in run.journal.codes
    purpose = "homing" if name in OF_A_WAY_HOME else "experiment"
    assert_reproduced(again(run, *laws, on=benches[0], purpose=purpose), run)


def test_an_error_that_does_not_come_again_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    def broken(_angle: float, _velocity: float, step: float) -> float:
        return 1.0 / (step - 70.0)

    mended = again(recorded(broken), lambda a, v, k: broken(a, v, k) if k != 70 else 1.0)
    assert not mended.followed
    assert "INTERNAL" in mended.differences[-1].recorded
    assert mended.differences[-1].came == "the record of step 70"


def failing_to_send(number: int, leaves: bool) -> dict[str, Any]:
    """A bus that raises an error of its own at a frame, before it or after it has left."""
    buses: list[SimTransport] = []
    sent: list[Frame] = []

    def receive(frame: Frame | None, bus: SimTransport, _clock: object) -> Frame | None:
        buses[:] = [bus]
        return frame

    def send(frame: Frame) -> None:
        sent.append(frame)
        if len(sent) == number:
            if leaves:
                buses[0].send(frame)
            raise OSError("a driver's own error")

    return {"on_receive": receive, "on_send": send}


@pytest.mark.parametrize("leaves", [False, True])
@pytest.mark.parametrize("number", [1, 70, 149, 151, 152, 153])  # of 150 commands and three stop frames
def test_a_frame_whose_sending_failed_may_have_left_or_not(
    recorded: Callable[..., Driven], again: Again, number: int, leaves: bool
) -> None:
    run = recorded(**failing_to_send(number, leaves))
    assert run.outcome.fault is (Fault.INTERNAL if number < 150 else None)
    assert ("STOP_FRAME_NOT_SENT" in run.journal.codes) == (number > 150)
    assert_reproduced(again(run), run)


def test_after_a_command_that_was_not_sent_only_a_fault_of_the_driver_can_come(
    recorded: Callable[..., Driven], again: Again
) -> None:
    run = recorded(**failing_to_send(70, leaves=False))

    def rename(fault: Fault, records: list[Record]) -> None:
        renamed = [r._replace(code=fault.name) if isinstance(r, InputRecord) and r.code else r for r in records]
        records[:] = [r for r in renamed if not (isinstance(r, EventRecord) and r.code == "INTERNAL")]

    for fault in (Fault.POLICY_NOT_FINITE, Fault.OUT_OF_LIMITS, Fault.INTERRUPTED):
        difference = again(run, alter=partial(rename, fault)).differences[-1]
        assert (difference.step, difference.what, difference.recorded) == (69, "what came next", fault.name)
        assert difference.came == "the record of step 69"


def test_a_text_that_was_cut_to_fit_into_the_log_is_compared_as_far_as_it_goes(
    recorded: Callable[..., Driven], again: Again
) -> None:
    def broken(_angle: float, _velocity: float, _step: float) -> float:
        raise ValueError("ß" * 300)

    def cut(records: list[Record]) -> None:
        records[:] = [unpack(*pack(record)) for record in records]

    run = recorded(broken)
    assert max(len(event.text) for event in run.journal.events) > 300
    result = again(run, broken, cut)
    assert (result.differences, result.followed) == ((), True)


def test_a_log_that_was_cut_anywhere_is_followed_up_to_there(hostile: Callable[..., Driven], again: Again) -> None:
    run = hostile(1, slow=0.05, backlog_ms=50)
    total = len(run.journal.records)
    for length in (2, 30, 60, 61, 62, 63, 64, 65, 66, 67, 200, 201, 202, 203, 204, total - 300, total - 2, total - 1):
        cut = Driven(run.outcome, Journal(), run.steps)
        cut.journal.records = run.journal.records[:length]
        result = again(cut, outcome=None)
        assert result.differences == ()
        assert result.followed
        assert result.outcome is None
        assert result.decisions == len(cut.journal.cycles)


# --- what was altered is found --------------------------------------------------------------------------------------

NUMBERS = ("angle", "velocity", "applied_current", "policy_current", "clipped_current", "sent_current")
WHOLE = tuple(name for name in CycleRecord._fields if name not in NUMBERS and not name.endswith("_time_ns"))


def altered(step: int, name: str, change: Callable[[Any], Any]) -> Callable[[list[Record]], None]:
    """Alters one field of one cycle record."""

    def alter(records: list[Record]) -> None:
        (at,) = (n for n, r in enumerate(records) if isinstance(r, CycleRecord) and r.step == step)
        record = records[at]
        assert isinstance(record, CycleRecord)
        records[at] = record._replace(**{name: change(getattr(record, name))})

    return alter


def test_a_number_that_differs_in_its_last_bit_a_state_a_reason_or_a_counter_that_differs_is_reported(
    recorded: Callable[..., Driven], again: Again
) -> None:
    run = recorded()
    for name in NUMBERS:
        result = again(run, alter=altered(60, name, lambda value: float(np.nextafter(value, np.inf))))
        assert [(d.step, d.what) for d in result.differences] == [(60, name)]
        assert float(result.differences[0].recorded) != float(result.differences[0].came)
    for name in WHOLE:
        result = again(run, alter=altered(60, name, lambda value: value ^ 1))
        assert (result.differences[0].what, result.decisions) == (name, 151)


@pytest.mark.parametrize("begin", [0, 400])
def test_frames_without_the_time_of_their_read_are_not_passed_over(
    recorded: Callable[..., Driven], again: Again, begin: int
) -> None:
    def alter(records: list[Record]) -> None:
        for n, record in enumerate(records):
            if n >= begin and isinstance(record, FrameRecord):
                records[n] = record._replace(read_ns=0)

    result = again(recorded(), alter=alter, outcome=None)
    assert [difference.what for difference in result.differences] == ["what came next"]
    assert not result.reproduced


def test_a_minus_before_a_zero_is_a_difference(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded(lambda *_: 0.0)
    assert again(run, lambda *_: 0.0).reproduced
    result = again(run, lambda *_: 0.0, altered(0, "policy_current", lambda value: -value))
    assert [(d.step, d.recorded, d.came) for d in result.differences] == [(0, "-0.0", "0.0")]


def own(records: list[Record], number: int) -> int:
    sent = [n for n, r in enumerate(records) if isinstance(r, FrameRecord) and r.frame.own]
    return sent[number]


def test_a_sent_frame_that_is_missing_or_other_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded()

    def remove(number: int, records: list[Record]) -> None:
        del records[own(records, number)]

    def change(number: int, records: list[Record]) -> None:
        at = own(records, number)
        record = records[at]
        assert isinstance(record, FrameRecord)
        data = record.frame.data[:2] + bytes([record.frame.data[2] ^ 1]) + record.frame.data[3:]
        records[at] = FrameRecord(record.frame._replace(data=data), record.read_ns)

    def add(number: int, records: list[Record]) -> None:
        records.insert(own(records, number), records[own(records, number)])

    for number in (0, 70, -4, -3, -2, -1):
        for alter, recorded_as in ((remove, "no such frame"), (change, "080#"), (add, "080#")):
            result = again(run, alter=partial(alter, number))
            (found,) = (d for d in result.differences if d.what == "sent frame")
            assert found.recorded.startswith(recorded_as)
            assert found.came == "no such frame" if alter is add else found.came.startswith("080#")


def test_a_stop_frame_that_the_guard_refused_excuses_no_other_frame(
    recorded: Callable[..., Driven], again: Again
) -> None:
    def refused(records: list[Record]) -> None:
        del records[own(records, -1)]
        now = records[-1].time_ns  # of the end, after which nothing may leave
        note = InputRecord(now, Call.NOTE, 0, STOP_FRAME_NOT_SENT, "the guard refused it")
        records += [InputRecord(now, Call.STOP_FRAME), note, EventRecord(now, note.code, note.text)]

    (found,) = again(recorded(), alter=refused, outcome=None).differences
    assert (found.what, found.recorded) == ("sent frame", "no such frame")


def test_a_missing_event_or_another_one_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded()

    def is_active(record: Record) -> bool:
        return isinstance(record, EventRecord) and record.code == RunState.ACTIVE.name

    def remove(records: list[Record]) -> None:
        records[:] = [record for record in records if not is_active(record)]

    def change(records: list[Record]) -> None:
        records[:] = [EventRecord(r.time_ns, "NODE_STOPPED", "") if is_active(r) else r for r in records]

    for alter in (remove, change):
        result = again(run, alter=alter)
        assert not result.followed
        assert result.outcome is None
        assert "ACTIVE" in result.differences[-1].came


def test_an_event_with_another_text_or_time_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded()

    def change(code: str, records: list[Record]) -> None:
        for n, record in enumerate(records):
            if isinstance(record, EventRecord) and record.code == code:
                records[n] = EventRecord(record.time_ns + 1, code, record.text + ".")

    for event in run.journal.events:
        result = again(run, alter=partial(change, event.code))
        assert [d.what for d in result.differences] == [f"time_ns of {event.code}", f"text of {event.code}"]
        assert result.differences[1].recorded == result.differences[1].came + "." == event.text + "."
        assert result.followed


def test_an_answer_that_was_sent_at_another_time_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    def change(records: list[Record]) -> None:
        at = [n for n, r in enumerate(records) if isinstance(r, InputRecord) and r.call == Call.ANSWER][60]
        record = records[at]
        assert isinstance(record, InputRecord)
        records[at] = record._replace(time_ns=record.time_ns + 3_000_000)  # so late that nothing is sent

    result = again(recorded(), alter=change)
    assert (result.differences[0].step, result.differences[0].what) == (60, "send_time_ns of ANSWER")


def test_a_sensor_frame_that_is_missing_or_other_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded()
    cycle = next(n for n, r in enumerate(run.journal.records) if isinstance(r, CycleRecord) and r.step == 60)
    at = max(n for n, r in enumerate(run.journal.records[:cycle]) if isinstance(r, FrameRecord))
    result = again(run, alter=lambda records: records.pop(at))
    assert not result.reproduced


def test_a_tally_that_differs_is_reported(recorded: Callable[..., Driven], again: Again) -> None:
    run = recorded()
    counters = replace(run.outcome.counters, answered=149)
    result = again(run, outcome=replace(run.outcome, counters=counters, fault=Fault.INTERRUPTED))
    assert [(d.what, d.recorded, d.came) for d in result.differences] == [
        ("exit_reason", "INTERRUPTED", "DONE"),
        ("answered", "149", "150"),
    ]


# --- the command ----------------------------------------------------------------------------------------------------


@pytest.fixture
def with_policy(
    tmp_path: Path, recorded: Callable[..., Driven], bench: Bench, layout: Layout
) -> Callable[..., list[str]]:
    """Arguments of a rerun of a log with an actor that always asks for 2 A."""

    def write(alter: Callable[[list[Record]], object] = lambda records: None, **changes: Any) -> list[str]:
        run = recorded(lambda *_: 2.0)
        records = list(run.journal.records)
        alter(records)
        policy = changes.pop("policy", constant_actor(bench, 2.0))
        path = tmp_path / "made.mcap"
        given = {"steps": run.steps, "policy": policy} | changes
        write_trace(path, records, bench, layout, run.outcome, **given)
        return ["rerun", str(path)]

    return write


def test_the_first_differences_are_printed_and_the_exit_code_says_so(
    with_policy: Callable[..., list[str]], replay: Replay
) -> None:
    def shift(records: list[Record]) -> None:
        records[:] = [r._replace(policy_current=2.5) if isinstance(r, CycleRecord) else r for r in records]

    arguments = with_policy(shift)
    lines = replay.text(*arguments, code=1).splitlines()
    assert lines[0] == "NOT reproduced: 151 differences in 151 decisions, 153 sent frames, 5 events"
    assert lines[2] == "  step 0, policy_current: recorded 2.5, came 2.0"
    assert lines[-2] == "  and 141 more (-v shows all)"
    assert len(replay.document(*arguments, code=1)["differences"]) == 151


def test_with_differences_the_versions_of_the_log_are_named(
    with_policy: Callable[..., list[str]], replay: Replay
) -> None:
    others = {"tool": "emb-excite 0.0.1", "onnxruntime": "1.0.0", "libc": "glibc 2.0"}
    assert "0.0.1" not in replay.text(*with_policy(**others))
    out = replay.text(*with_policy(altered(3, "policy_current", lambda value: value + 1e-7), **others), code=1)
    assert "tool emb-excite 0.0.1" in out
    assert "onnxruntime 1.0.0, libc glibc 2.0: rounding may differ" in out


def test_a_policy_or_a_bench_that_is_not_the_run_s_is_reported(
    with_policy: Callable[..., list[str]], replay: Replay
) -> None:
    found = replay.document(*with_policy(policy_sha256="0" * 64, bench_hash="1" * 64), code=1)["differences"]
    assert [d["what"] for d in found] == ["policy_sha256", "bench_hash"]


def test_a_policy_in_a_log_is_refused_as_emb_run_refuses_it(
    with_policy: Callable[..., list[str]], bench: Bench, replay: Replay
) -> None:
    for policy in (b"no actor", constant_actor(bench, 2.0)[:-50], constant_actor(bench, sample_time=2e-3)):
        replay.refused(*with_policy(policy=policy), code=5)


def test_a_log_without_the_inputs_of_its_run_is_one_line(with_policy: Callable[..., list[str]], replay: Replay) -> None:
    def strip(records: list[Record]) -> None:
        records[:] = [record for record in records if not isinstance(record, InputRecord)]

    arguments = with_policy(strip)
    assert "beginning of the run" in replay.refused(*arguments, code=6)
    rewritten(Path(arguments[1]))  # a topic without messages is not written
    assert "/input" not in read_log(arguments[1]).topics
    assert "expected the topic /input" in replay.refused(*arguments, code=6)


def test_inputs_in_any_disorder_are_compared_or_left_and_break_nothing(
    hostile: Callable[..., Driven], again: Again
) -> None:
    run, dice = hostile(1, slow=0.05, refusing=0.1), random.Random(41)
    for _ in range(30):

        def disturb(records: list[Record]) -> None:
            for _ in range(dice.choice((1, 1, 3, 30))):
                at, other = dice.randrange(1, len(records)), dice.randrange(1, len(records))
                record = records[at]
                if dice.random() < 0.5 and isinstance(record, InputRecord):
                    records[at] = record._replace(call=dice.randrange(10), code=dice.choice(("", "BUS_LOST", "X")))
                elif dice.random() < 0.5:
                    records[at], records[other] = records[other], records[at]
                else:
                    records.insert(at, records.pop(other))

        result = again(run, alter=disturb)
        assert result.followed or result.differences[-1].what == "what came next"


def test_a_log_that_says_nonsense_of_its_run_is_refused(with_policy: Callable[..., list[str]], replay: Replay) -> None:
    for name, values in {
        "steps": ("", "0", "-3", "501", "many", "1" * 5000, "²"),
        "limit": ("seven", "nan", "-1", "7"),
        "purpose": ("pleasure",),
    }.items():
        for value in values:
            assert name in replay.refused(*with_policy(**{name: value}), code=6)


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


@pytest.mark.parametrize("stage", [["--zero"], ["--limit", "0.7"]])
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


def test_a_log_of_mere_listening_is_refused_as_a_wrong_use(run: Run, replay: Replay) -> None:
    listened = run("--read-only")
    for command in ("fim", "rerun", "estimate"):
        err = replay.refused(command, listened)
        assert "nothing was driven" in err
        assert "--read-only" in err


def test_a_folder_of_logs_is_searched_for_experiments_only(homed: Path, run: Run) -> None:
    listened = homed.with_name("run-1-read.mcap")
    listened.write_bytes(homed.read_bytes())
    experiment = run("--duration", "0.05")
    assert [source.log for source in find([homed.parent])] == [experiment.name]
    assert [source.log for source in find([homed])] == [homed.name]
