"""The guard lets out what its contract allows and nothing else; it rejects, it never mends.

Rule by rule, at each border. Any sequence of legal, illegal and damaged commands is judged against an account that is
written anew (tests/fuzz/targets.py).
"""

from __future__ import annotations

import ast
import contextlib
from dataclasses import replace
from pathlib import Path

import pytest

import emb_runtime
from emb_runtime.can.generated import generate_codec
from emb_runtime.can.messages import Layout, _fields, load_layout
from emb_runtime.config.bench import Bench, parse_bench, shipped_bench_text
from emb_runtime.errors import EXIT_SAFETY_STOP, BusError
from emb_runtime.records import Frame, NodeState, RunState, SensorSample
from emb_runtime.safety.guard import Guard, GuardRejectedError
from emb_runtime.safety.heartbeat import Unwatched
from emb_runtime.safety.state_machine import Fault, StopError

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


def test_a_guard_begins_with_counter_0_and_counts_what_passed_and_what_it_refused(guard: Guard, bus: Bus) -> None:
    assert (guard.next_counter, guard.passed, guard.rejected) == (0, 0, 0)
    refused(guard, bus, command(6.0)._replace(extended=True), "not a classical data frame of this message")
    assert guard.next_counter == 0
    let_out(guard, command(), ACTIVE, 100 * MS, 100 * MS)
    assert (guard.next_counter, guard.passed, guard.rejected) == (1, 1, 1)


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


@pytest.mark.parametrize("state", [RunState.INIT, RunState.SILENT, RunState.ARMED, RunState.OVER])
def test_nothing_leaves_before_the_experiment(guard: Guard, bus: Bus, state: RunState) -> None:
    refused(guard, bus, command(), "nothing may leave", state)
    refused(guard, bus, command(0.0, enable=False), "nothing may leave", state)


def test_while_stopping_only_the_stop_frame_leaves(guard: Guard, bus: Bus) -> None:
    refused(guard, bus, command(), "enabled in state STOPPING", RunState.STOPPING)
    let_out(guard, command(0.0, enable=False), RunState.STOPPING, 0, 100 * MS)
    assert len(bus.frames) == 1


def test_a_disabled_command_with_a_current_is_refused(guard: Guard, bus: Bus) -> None:
    refused(guard, bus, command(0.5, enable=False), "disabled, but with 0.5 A")


def test_the_counter_must_follow(guard: Guard, bus: Bus) -> None:
    for counter in [13, 14, 0, 1]:
        let_out(guard, command(counter=counter), ACTIVE, 100 * MS, 100 * MS)
    for counter in [1, 3, 14]:
        refused(guard, bus, command(counter=counter), "does not follow 1")
    let_out(guard, command(counter=2), ACTIVE, 100 * MS, 100 * MS)


def test_every_current_that_the_signal_can_hold_passes_exactly_if_it_is_within_the_limit(layout: Layout) -> None:
    bench = parse_bench(shipped_bench_text().replace("current  = 6.0", "current  = 3.0"), "t")
    for raw in range(-30_000, 30_001, 7):
        bus = Bus()
        guard = Guard(layout, bench, bus.send)
        if abs(raw) <= 15_000:
            let_out(guard, command(raw * 2e-4), ACTIVE, 100 * MS, 100 * MS)
        else:
            refused(guard, bus, command(raw * 2e-4), "beyond 3 A")


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


@pytest.mark.parametrize("age_ns", [-MS - 1, 2 * MS + 1, 50 * MS])
def test_a_command_from_an_old_or_a_future_sample_is_refused(guard: Guard, bus: Bus, age_ns: int) -> None:
    refused(guard, bus, command(), "ms old", age_ns=age_ns)


@pytest.mark.parametrize("age_ns", [-MS, 0, 2 * MS])
def test_a_sample_may_be_two_periods_old_and_its_stamp_one_period_ahead(guard: Guard, age_ns: int) -> None:
    let_out(guard, command(), ACTIVE, 100 * MS - age_ns, 100 * MS)


def test_the_rate_counts_from_the_oldest_of_the_last_24_commands(guard: Guard) -> None:
    def send(time_ns: int) -> None:
        let_out(guard, command(counter=guard.next_counter), ACTIVE, time_ns, time_ns)

    oldest, second = 100 * MS, 101 * MS
    for time_ns in [oldest, second, *[109 * MS] * 22]:
        send(time_ns)
    for limiting in (oldest, second):
        with pytest.raises(GuardRejectedError, match="more than 24 commands in 20 periods"):
            send(limiting + 20 * MS - 1)
        send(limiting + 20 * MS)


def test_a_stop_frame_is_never_too_fast(guard: Guard, bus: Bus) -> None:
    for n in range(24):
        let_out(guard, command(counter=n % 15), ACTIVE, 100 * MS, 100 * MS)
    for n in range(24, 27):
        let_out(guard, command(0.0, counter=n % 15, enable=False), RunState.STOPPING, 100 * MS, 100 * MS)
    assert len(bus.frames) == 27


def test_a_bus_that_fails_is_not_counted_as_passed_and_its_counter_is_spent(bench: Bench, layout: Layout) -> None:
    def lost(_frame: Frame) -> None:
        raise BusError("down")

    guard = Guard(layout, bench, lost)
    with pytest.raises(BusError):
        let_out(guard, command(counter=4), ACTIVE, 100 * MS, 100 * MS)
    assert guard.passed == 0
    with pytest.raises(GuardRejectedError, match="does not follow 4"):
        let_out(guard, command(counter=4), ACTIVE, 100 * MS, 100 * MS)


def answer(current: float, counter: int, answers: int) -> Frame:
    return load_layout().encode_command(counter, answers, current, True)


def slow(slew: float) -> Bench:
    return parse_bench(shipped_bench_text().replace("slew          = 12000.0", f"slew          = {slew}"), "t")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_may_be_the_slew_and_one_step_of_the_signal_and_no_more(layout: Layout, bus: Bus, sign: float) -> None:
    bench = slow(1000.0)
    guard = Guard(layout, replace(bench, timing=replace(bench.timing, sample_time=2e-3)), bus.send)
    for counter, (passes, fails) in enumerate([(2.0002, 2.0004), (4.0, 4.0006), (2.0, 1.9996)]):
        refused(guard, bus, answer(sign * fails, counter, counter), "a change by -?2 A in one period is beyond 2 A")
        let_out(guard, answer(sign * passes, counter, counter), ACTIVE, 100 * MS, 100 * MS)


@pytest.mark.parametrize("missing", [2, 3, 14])
def test_after_a_period_without_a_command_the_slew_counts_from_zero(layout: Layout, bus: Bus, missing: int) -> None:
    guard = Guard(layout, slow(2000.0), bus.send)
    for n, current in enumerate([2.0, 4.0, 6.0]):
        let_out(guard, answer(current, n, n), ACTIVE, 100 * MS, 100 * MS)
    after = (2 + missing) % 15
    refused(guard, bus, answer(5.0, 3, after), "a change by 5 A")
    let_out(guard, answer(-2.0, 3, after), ACTIVE, 100 * MS, 100 * MS)


@pytest.mark.parametrize(
    ("elapsed_ns", "follows"), [(MS // 2, True), (MS, True), (7 * MS - 1, True), (7 * MS, False), (16 * MS, False)]
)
@pytest.mark.parametrize(("current", "from_the_last"), [(4.0, True), (-2.0, False)])
def test_a_counter_that_has_come_round_is_not_that_of_the_next_sample(
    layout: Layout, bus: Bus, elapsed_ns: int, follows: bool, current: float, from_the_last: bool
) -> None:
    guard, now_ns = Guard(layout, slow(2000.0), bus.send), 100 * MS + elapsed_ns
    let_out(guard, answer(2.0, 0, 3), ACTIVE, 100 * MS, 100 * MS)
    with contextlib.nullcontext() if follows == from_the_last else pytest.raises(GuardRejectedError):
        let_out(guard, answer(current, 1, 4), ACTIVE, now_ns, now_ns)


@pytest.mark.parametrize(
    ("current", "passes"), [(2.0, True), (2.4, False), (5.0, False), (-2.0, True), (-1.4, True), (-2.4, False)]
)
def test_after_a_command_that_the_bus_did_not_take_the_slew_counts_from_zero(
    layout: Layout, current: float, passes: bool
) -> None:
    full = iter([False, True, False])

    def send(_frame: Frame) -> None:
        if next(full):
            raise BusError("no room")

    guard = Guard(layout, slow(2000.0), send)
    let_out(guard, answer(2.0, 0, 0), ACTIVE, 100 * MS, 100 * MS)
    with pytest.raises(BusError):
        let_out(guard, answer(4.0, 1, 1), ACTIVE, 100 * MS, 100 * MS)
    assert guard.next_counter == 2
    with contextlib.nullcontext() if passes else pytest.raises(GuardRejectedError):
        let_out(guard, answer(current, 2, 2), ACTIVE, 100 * MS, 100 * MS)


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
    let_out(guard, answer(1.0, 3, 9), ACTIVE, 100 * MS, 100 * MS)
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


def test_too_early_is_judged_by_when_the_sample_was_in_hand(guard: Guard) -> None:
    guard.learn_time(sample_at(0, 50 * MS), first=True)
    guard.check_time(sample_at(MS, 41 * MS), 51 * MS)
    with pytest.raises(StopError):
        guard.check_time(sample_at(2 * MS, 42 * MS), 49 * MS)


def test_too_late_is_judged_by_the_sample_s_own_stamp(guard: Guard) -> None:
    guard.learn_time(sample_at(0, 50 * MS), first=True)
    for n in range(1, 20):
        guard.check_time(sample_at(n * MS, (53 + n) * MS), (54 + n) * MS)
    with pytest.raises(StopError, match="DEVICE_TIME"):
        guard.check_time(sample_at(20 * MS, 73 * MS), 74 * MS)


def test_samples_before_arming_that_had_piled_up_begin_the_reference_anew(guard: Guard) -> None:
    assert guard.learn_time(sample_at(0, 50 * MS), first=True)
    assert not guard.learn_time(sample_at(MS, 48 * MS), first=False)  # 3 ms earlier than the first by its own clock
    guard.check_time(sample_at(2 * MS, 47 * MS), 47 * MS)
    assert guard.learn_time(sample_at(3 * MS, 70 * MS), first=True)
    with pytest.raises(StopError):
        guard.check_time(sample_at(4 * MS, 68 * MS), 68 * MS)


def test_the_rate_can_be_asked_for_before_a_command_is_refused(guard: Guard, bus: Bus) -> None:
    surplus = 24
    for n in range(surplus):
        assert not guard.too_fast(100 * MS)
        let_out(guard, command(counter=n % 15), ACTIVE, 100 * MS, 100 * MS)
    assert guard.too_fast(100 * MS)
    assert guard.too_fast(120 * MS - 1)
    assert not guard.too_fast(120 * MS)
    let_out(guard, command(counter=surplus % 15), ACTIVE, 120 * MS, 120 * MS)
