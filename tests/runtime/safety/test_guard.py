"""The guard lets out what its contract allows and nothing else; it rejects, it never mends.

Any sequence of legal, illegal and damaged commands is judged against an account that is written anew, with its reasons;
a million are played by tests/searches/fuzz.py.
"""

from __future__ import annotations

import ast
import contextlib
import re
import struct
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

import emb_runtime
from emb_runtime.can.generated import generate_codec
from emb_runtime.can.messages import Layout, _fields, load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Bench, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import EXIT_SAFETY_STOP, BusError, FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState, RunState, SensorSample
from emb_runtime.safety.device_clock import DeviceClock
from emb_runtime.safety.guard import Guard, GuardRejectedError
from emb_runtime.safety.heartbeat import Unwatched
from emb_runtime.safety.state_machine import Fault, StopError
from tests.fuzz.stream import COMMAND, Played, anything, chance, damaged, demand
from tests.independent import protected, read

MS = 1_000_000
ACTIVE = RunState.ACTIVE


class Bus:
    """Keeps what was sent."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def send(self, frame: Frame) -> None:
        self.frames.append(frame)


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def guard(bench: Bench, layout: Layout, bus: Bus) -> Guard:
    return Guard(layout, bench, bus.send)


def command(current: float = 1.0, counter: int = 0, enable: bool = True) -> Frame:
    return load_layout().encode_command(counter, 0, current, enable)


def let_out(guard: Guard, frame: Frame, state: RunState, sample_ns: int, now_ns: int) -> None:
    assert guard.check(frame, state, sample_ns, now_ns) == load_layout().decode_command(frame)
    guard.send(frame)


def let_check(guard: Guard, frame: Frame) -> Frame:
    guard.check(frame, ACTIVE, 100 * MS, 100 * MS)
    return frame


def refused(guard: Guard, bus: Bus, frame: Frame, reason: str, state: RunState = ACTIVE, age_ns: int = 0) -> None:
    passed, rejected = guard.passed, guard.rejected
    with pytest.raises(GuardRejectedError, match=reason) as caught:
        let_out(guard, frame, state, 100 * MS - age_ns, 100 * MS)
    assert caught.value.exit_code == EXIT_SAFETY_STOP
    assert (guard.passed, guard.rejected) == (passed, rejected + 1)
    assert len(bus.frames) == passed


def test_only_the_frame_that_was_checked_last_leaves_and_only_once(guard: Guard, bus: Bus) -> None:
    def is_refused(frame: Frame) -> None:
        passed, rejected = guard.passed, guard.rejected
        with pytest.raises(GuardRejectedError, match="it is not the one that was checked last"):
            guard.send(frame)
        assert (guard.passed, guard.rejected, len(bus.frames)) == (passed, rejected + 1, passed)

    is_refused(command())
    first = let_check(guard, command())
    is_refused(command())  # the same bytes, and not checked
    is_refused(first)  # another one was tried
    second = let_check(guard, command(counter=1))
    guard.send(second)
    is_refused(second)
    older, newer = let_check(guard, command(counter=2)), let_check(guard, command(counter=3))
    guard.send(newer)
    is_refused(older)
    overtaken = let_check(guard, command(counter=4))
    refused(guard, bus, command(counter=4), "does not follow")
    is_refused(overtaken)
    assert bus.frames == [second, newer]


def test_no_bench_no_limit_and_no_dbc_reaches_beyond_the_ceiling_of_six_ampere(bench: Bench, bus: Bus) -> None:
    command = load_layout().command
    current = command.signal("Current")
    wider = replace(current, minimum=-6.5, maximum=6.5, raw_minimum=-32_500, raw_maximum=32_500)
    command = replace(command, signals=tuple(wider if s is current else s for s in command.signals))
    encode = generate_codec(command, *_fields(1)["EMB_Command"]).encode
    wide = replace(load_layout(), command=command, encode_command=encode)
    guard = Guard(wide, replace(bench, limits=replace(bench.limits, current=6.5)), bus.send, limit=6.5)
    refused(guard, bus, wide.encode_command(0, 0, 6.0002, True), "beyond 6 A")
    let_out(guard, wide.encode_command(0, 0, 6.0, True), ACTIVE, 100 * MS, 100 * MS)


def test_the_rate_counts_from_the_oldest_of_the_last_24_commands_and_no_stop_frame_is_too_fast(guard: Guard) -> None:
    def send(time_ns: int) -> None:
        let_out(guard, command(counter=guard.next_counter), ACTIVE, time_ns, time_ns)

    oldest, second = 100 * MS, 101 * MS
    for time_ns in [oldest, second, *[109 * MS] * 22]:
        assert not guard.too_fast(time_ns)
        send(time_ns)
    for limiting in (oldest, second):
        with pytest.raises(GuardRejectedError, match="more than 24 commands in 20 periods"):
            send(limiting + 20 * MS - 1)
        assert guard.too_fast(limiting + 20 * MS - 1)
        assert not guard.too_fast(limiting + 20 * MS)
        send(limiting + 20 * MS)
    for _ in range(3):
        let_out(guard, command(0.0, guard.next_counter, enable=False), RunState.STOPPING, 0, 121 * MS)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_may_be_the_slew_and_one_step_of_the_signal_and_no_more(layout: Layout, bus: Bus, sign: float) -> None:
    bench = parse_bench(shipped_bench_text().replace("slew          = 12000.0", "slew = 1000.0"), "t")
    guard = Guard(layout, replace(bench, timing=replace(bench.timing, sample_time=2e-3)), bus.send)
    for n, (passes, fails) in enumerate([(2.0002, 2.0004), (4.0, 4.0006), (2.0, 1.9996)]):
        wrong, right = (layout.encode_command(n, n, sign * current, True) for current in (fails, passes))
        refused(guard, bus, wrong, "a change by -?2 A in one period is beyond 2 A")
        let_out(guard, right, ACTIVE, 100 * MS, 100 * MS)


def test_a_limit_asked_for_narrows_the_guard_and_never_widens_it(bench: Bench, layout: Layout, bus: Bus) -> None:
    guard = Guard(layout, bench, bus.send, limit=1.0)
    refused(guard, bus, command(1.0002), "is beyond 1 A")
    let_out(guard, command(1.0), ACTIVE, 100 * MS, 100 * MS)
    narrow = parse_bench(shipped_bench_text().replace("current  = 6.0", "current  = 2.5"), "t")
    refused(Guard(layout, narrow, bus.send, limit=100.0), Bus(), command(2.6), "is beyond 2.5 A")


class Tripped(Unwatched):
    """A watchdog that has spoken."""

    tripped = True


def test_once_the_watchdog_has_spoken_not_even_a_stop_frame_leaves(bench: Bench, layout: Layout, bus: Bus) -> None:
    guard = Guard(layout, bench, bus.send, Tripped())
    for frame, state in [(command(), ACTIVE), (command(0.0, 1, enable=False), RunState.STOPPING)]:
        with pytest.raises(StopError) as caught:
            let_out(guard, frame, state, 100 * MS, 100 * MS)
        assert caught.value.fault is Fault.WATCHDOG_TRIPPED
    assert bus.frames == []


def test_the_watchdog_learns_of_a_command_before_it_is_asked(bench: Bench, layout: Layout) -> None:
    order: list[object] = []

    class Pulse(Unwatched):
        def publish(self, counter: int, answers: int) -> None:
            order.append((counter, answers))

        @property
        def tripped(self) -> bool:
            order.append("asked")
            return False

    guard = Guard(layout, bench, lambda _frame: order.append("sent"), Pulse())
    let_out(guard, layout.encode_command(3, 9, 1.0, True), ACTIVE, 100 * MS, 100 * MS)
    assert order == [(3, 9), "asked", "sent"]


def test_a_frame_of_which_the_watchdog_does_not_learn_is_refused(bench: Bench, layout: Layout, bus: Bus) -> None:
    class Broken(Unwatched):
        def publish(self, counter: int, answers: int) -> None:
            raise OSError("no memory")

    guard, frame = Guard(layout, bench, bus.send, Broken()), command()
    with pytest.raises(OSError, match="no memory"):
        guard.check(frame, ACTIVE, 100 * MS, 100 * MS)
    with pytest.raises(GuardRejectedError, match="it is not the one that was checked last"):
        guard.send(frame)
    assert bus.frames == []


def test_a_drive_that_does_not_apply_what_left_ends_the_run(guard: Guard, bus: Bus) -> None:
    let_out(guard, command(4.0), ACTIVE, 100 * MS, 100 * MS)
    sample = SensorSample(1, 0.0, 0.0, 0, 0, 4.0, 0, NodeState.ACTIVE)
    for _ in range(20):
        guard.check_drive(sample)
    for _ in range(4):
        guard.check_drive(sample._replace(applied_current=-3.0))
    with pytest.raises(StopError, match="CURRENT_MISMATCH"):
        guard.check_drive(sample._replace(applied_current=-3.0))


def test_nothing_in_the_runtime_but_the_guard_and_the_watchdog_reaches_a_bus() -> None:
    """Every mention of a ``send``, called or handed on: outside the transports it is the guard's, or leads to it."""
    folder = Path(emb_runtime.__file__).parent
    mentions = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr in ("send", "_send", "send_periodic", "sendto", "sendmsg"):
                mentions.add((path.relative_to(folder).as_posix(), ast.unparse(node)))
    assert mentions == {
        ("can/transport.py", "self._socket.send"),
        ("safety/guard.py", "self._send"),
        ("cli/session.py", "bus.transport.send"),  # handed to the guard, and kept by nobody else
        ("control/loop.py", "core.guard.send"),
        ("safety/watchdog_process.py", "transport.send"),  # the watchdog process, which has stop frames only
        ("safety/watchdog_process.py", "self.send"),
        ("drives/wire_guard.py", "self._send"),  # the second guard
        ("drives/phases.py", "self._outlet.send"),  # a step of a sequence, to the second guard
        ("drives/phases.py", "self._send"),  # its own method
        ("drives/node.py", "self.outlet.send"),
        ("drives/gateway.py", "drive_bus.send"),  # handed to the node, and by it to the second guard
        ("drives/lock_step.py", "bus.send"),
        ("drives/gateway.py", "self._node_bus.send"),  # samples and status of the node, to the loop
        ("drives/mapping_file.py", "of.send"),  # a key of the file
    }
    owner = (folder / "drives" / "wire.py").read_text(encoding="utf-8")
    assert "WireGuard(mapping, limit, send)" in owner
    drive_node = (folder / "drives" / "node.py").read_text(encoding="utf-8")
    assert "Outlet(mapping, bench.limits.current, send)" in drive_node
    opener = (folder / "drives" / "gateway.py").read_text(encoding="utf-8")
    assert "DriveNode(mapping, bench, load_layout(), drive_bus.send)" in opener
    stepper = (folder / "drives" / "lock_step.py").read_text(encoding="utf-8")
    assert "drive = Port(bus.send, " in stepper
    session = (folder / "cli" / "session.py").read_text(encoding="utf-8")
    assert "Guard(plan.layout, plan.bench, bus.transport.send" in session


# --- device time ----------------------------------------------------------------------------------------------------


def sample_at(device_ns: int, receive_ns: int) -> SensorSample:
    return SensorSample(0, 0.0, 0.0, device_ns, receive_ns, 0.0, 15, NodeState.IDLE)


def test_once_the_device_time_is_wrong_no_enabled_command_passes_and_stop_frames_do(guard: Guard, bus: Bus) -> None:
    for n in range(10):
        assert guard.learn_time(sample_at(n * MS, (50 + n) * MS), first=n == 0)
    guard.check_time(sample_at(10 * MS, 60 * MS), 60 * MS)
    let_out(guard, command(), ACTIVE, 100 * MS, 100 * MS)
    with pytest.raises(StopError, match="DEVICE_TIME") as caught:
        guard.check_time(sample_at(24 * MS, 61 * MS), 61 * MS)
    assert (caught.value.fault, caught.value.detail) == (
        Fault.DEVICE_TIME,
        "it has gained 13.000 ms on this computer's",
    )
    refused(guard, bus, command(counter=1), "the device time of what it answers is wrong: it has gained 13.000 ms")
    let_out(guard, command(0.0, counter=1, enable=False), ACTIVE, 100 * MS, 100 * MS)
    assert len(bus.frames) == 2


def test_samples_are_judged_by_the_node_s_clock_before_and_after_arming(guard: Guard, bench: Bench) -> None:
    draw, clock = Random(1), DeviceClock(bench.timing.sample_time_ns)
    for run in range(40):
        at_ns = run * 1000 * MS
        for n in range(3):
            sample = sample_at(n * MS, at_ns + n * MS + draw.choice((0, -3 * MS)))
            if n == 0:
                clock.restart()
            learned = clock.learn(sample.device_time_ns, sample.receive_time_ns)
            assert guard.learn_time(sample, first=n == 0) == learned
        for n in range(3, 30):
            sample = sample_at(n * MS, at_ns + n * MS + draw.choice((0, 2 * MS, -MS)))
            seen_ns = sample.receive_time_ns + draw.choice((0, 0, MS))
            problem = clock.time_problem(sample.device_time_ns, sample.receive_time_ns, seen_ns)
            if not problem:
                guard.check_time(sample, seen_ns)
                continue
            with pytest.raises(StopError, match="DEVICE_TIME") as caught:
                guard.check_time(sample, seen_ns)
            assert caught.value.detail == problem
        if problem:  # never taken back
            guard, clock = Guard(load_layout(), bench, lambda _frame: None), DeviceClock(bench.timing.sample_time_ns)


# --- any sequence -----------------------------------------------------------------------------------------------------

SLEW = 1500.05
"""A/s. The shipped bench's never binds: it lets the current turn round in one period. No whole number of steps."""
SLEW_STEPS = 7_501  # Of the current signal's 0.2 mA, the one that rounding may cost included
STEPS = [MS] * 6 + [0, MS // 5, 5 * MS, 7 * MS - 1, 7 * MS, 1000 * MS, -MS]  # Times between two commands [ns]
HURRIED = [0, MS // 5, MS]  # So that the rate limit binds


def test_any_sequence_of_commands_is_judged_as_by_the_account() -> None:
    for seed in range(60):
        try:
            play(Random(seed))
        except AssertionError as err:
            err.add_note(f"seed {seed}")
            raise


def play(draw: Random) -> Played:
    """What reaches the bus is in the contract, and what is in the contract reaches the bus."""
    bench, layout = load_bench(), load_layout()
    bench = replace(bench, guard=replace(bench.guard, slew=SLEW))
    limit = draw.choice([6.0, 6.0, 2.0])
    bus, failing = list[Frame](), list[bool]()

    def send(frame: Frame) -> None:
        if failing.pop():
            raise draw.choice([BusError, TransmitQueueFullError])("gone")
        bus.append(frame)

    watched, account = Guard(layout, bench, send, limit=limit), Account(min(6.0, bench.limits.current, limit))
    now_ns, steps = draw.randint(0, 10**12), draw.choice([STEPS, HURRIED])
    for _ in range(100):
        now_ns += draw.choice(steps)
        state = draw.choice([*RunState, *[ACTIVE] * 20])
        age_ns = draw.choice([0, MS // 3, MS // 3, MS, 2 * MS, 2 * MS + 1, -MS, -MS - 1, 10 * MS])
        right = steps is HURRIED and not chance(draw, 20)  # else no 24 would leave in 20 periods
        frame = legal(draw, account) if right else attempt(draw, account)
        age_ns, fails, said = 0 if right else age_ns, chance(draw, 3), ""
        demand(watched.next_counter == account.expected()[0], "next counter", watched.next_counter)
        demand(watched.too_fast(now_ns) == account.too_fast(now_ns), "too fast", now_ns, account)
        failing.append(fails)
        before = len(bus)
        try:
            command = watched.check(frame, state, now_ns - age_ns, now_ns)
            demand(command == read_of(layout, frame), "read", command, "of", frame)
            watched.send(frame)
        except GuardRejectedError as err:
            said = str(err)
        except BusError:
            pass
        failing.clear()
        reason = account.judge(frame, state, now_ns - age_ns, now_ns, fails)
        demand(without_numbers(said).startswith(reason) and bool(said) == bool(reason), frame, said, "not", reason)
        demand(bus[before:] == ([] if reason or fails else [frame]), "the guard changed", frame)
        account.passed += not reason and not fails
        demand((watched.passed, watched.rejected) == (account.passed, account.rejected), "counts", watched, account)
        if chance(draw, 20):
            with contextlib.suppress(StopError):
                watched.check_drive(report(draw))
    return Played(100, len(bus))


def without_numbers(text: str) -> str:
    return re.sub(r"-?\d+(\.\d+)?", "#", text)


def read_of(layout: Layout, frame: Frame) -> CurrentCommand | None:
    """The command of a frame by the generated decoder; None where it is none."""
    try:
        return layout.decode_command(frame)
    except FrameError:
        return None


def legal(draw: Random, account: Account) -> Frame:
    """A command that only the rate may forbid, or a stop frame, which nothing does."""
    counter, answers, last = account.expected()
    enable = not chance(draw, 15)
    towards = draw.choice([last, last + SLEW_STEPS, last - SLEW_STEPS])
    raw = min(max(towards, -account.limit), account.limit) if enable else 0
    return Frame(COMMAND, protected(COMMAND, struct.pack("<BhB", counter | answers << 4, raw, enable)))


def attempt(draw: Random, account: Account) -> Frame:
    """A command that is nearly always nearly right."""
    if chance(draw, 3):
        return anything(draw)
    counter, answers, last = account.expected()
    if chance(draw, 10):
        counter = draw.randint(0, 15)
    if chance(draw, 10):
        answers, last = draw.randint(0, 15), 0
    enable = not chance(draw, 15)
    near = last + draw.choice([-1, 1]) * draw.choice([0, 100, SLEW_STEPS - 1, SLEW_STEPS, SLEW_STEPS, SLEW_STEPS + 1])
    most = account.limit
    raw = draw.choice([*[near] * 4, draw.randint(-32_768, 32_767), most, -most, most + 1, -most - 1])
    if not enable and not chance(draw, 20):
        raw = 0
    body = struct.pack("<BhB", counter | answers << 4, min(max(raw, -32_768), 32_767), enable)
    frame = Frame(COMMAND, protected(COMMAND, body))
    return damaged(draw, frame) if chance(draw, 10) else frame


def report(draw: Random) -> SensorSample:
    """What a drive might say of the period before."""
    applied = draw.randint(-100_000, 100_000) * 2e-4
    return SensorSample(draw.randint(0, 14), 0.0, 0.0, 0, 0, applied, draw.randint(0, 15), NodeState.ACTIVE)


class Account:
    """Which commands are legal, in whole steps of the current signal and whole nanoseconds."""

    def __init__(self, limit: float) -> None:
        self.passed = self.rejected = 0
        self.limit = round(limit / 2e-4)
        self._last: tuple[int, int, int] | None = None
        self._sample_ns = 0
        self._sent_ns: list[int] = []

    def expected(self) -> tuple[int, int, int]:
        """Counter and answered sample of the command that would come next, and the current before it in steps."""
        if self._last is None:
            return 0, 0, 0
        counter, answers, raw = self._last
        return (counter + 1) % 15, (answers + 1) % 15, raw

    def too_fast(self, now_ns: int) -> bool:
        return len(self._sent_ns) >= 24 and now_ns - self._sent_ns[-24] < 20 * MS

    def judge(self, frame: Frame, state: RunState, sample_ns: int, now_ns: int, fails: bool) -> str:
        """Why a command is illegal; it is remembered as sent, or as one that the bus has lost."""
        reason = self._reason(frame, state, sample_ns, now_ns)
        if reason:
            self.rejected += 1
            return f"the guard refused a command: {reason}"
        values = read(frame)
        assert values is not None
        raw = 0 if fails else round(values["Current"] / 2e-4)
        self._last, self._sample_ns = (int(values["Counter"]), int(values["Answers"]), raw), sample_ns
        self._sent_ns.append(now_ns)
        return ""

    def _reason(self, frame: Frame, state: RunState, sample_ns: int, now_ns: int) -> str:
        if state.name not in ("ACTIVE", "HOMING", "STOPPING"):
            return f"nothing may leave in state {state.name}"
        values = read(frame) if frame.identifier == COMMAND else None
        if values is None:
            return "EMB_Command: frame rejected, "
        raw = round(values["Current"] / 2e-4)
        next_counter, next_answers, last = self.expected()
        if self._last is not None and values["Counter"] != next_counter:
            return "counter # does not follow #"
        if abs(raw) > self.limit:
            return "# A is beyond # A"
        if not values["Enable"]:
            return "disabled, but with # A" if raw else ""
        if state is RunState.STOPPING:
            return "enabled in state STOPPING"
        if self.too_fast(now_ns):
            return "more than # commands in # periods"
        if not -MS <= now_ns - sample_ns <= 2 * MS:
            return "computed from a sample # ms old"
        # Seven periods: half a round of the counter, which is the same again 15 periods later.
        follows = values["Answers"] == next_answers and sample_ns - self._sample_ns < 7 * MS
        begins = last if follows and self._last is not None else 0
        return "a change by # A in one period is beyond # A" if abs(raw - begins) > SLEW_STEPS else ""
