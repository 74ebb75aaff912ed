"""The guard lets out what its contract allows and nothing else; it rejects, it never mends."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import emb_runtime
from emb_runtime.bench import Bench, parse_bench, shipped_bench_text
from emb_runtime.errors import EXIT_SAFETY_STOP, BusError
from emb_runtime.frames import Layout, load_layout
from emb_runtime.guard import RATE_WINDOW_PERIODS, Guard, GuardRejectedError
from emb_runtime.records import CurrentCommand, Frame, RunState

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
    return load_layout().encode_command(CurrentCommand(counter, 0, current, enable))


def refused(guard: Guard, bus: Bus, frame: Frame, reason: str, state: RunState = ACTIVE, age_ns: int = 0) -> None:
    passed, rejected = guard.passed, guard.rejected
    with pytest.raises(GuardRejectedError, match=reason) as caught:
        guard.send(frame, state, 100 * MS - age_ns, 100 * MS)
    assert caught.value.exit_code == EXIT_SAFETY_STOP
    assert (guard.passed, guard.rejected) == (passed, rejected + 1)
    assert len(bus.frames) == passed


def test_a_command_within_the_contract_passes_unchanged(guard: Guard, bus: Bus) -> None:
    frame = command(-6.0)
    guard.send(frame, ACTIVE, 99 * MS, 100 * MS)
    assert bus.frames == [frame]


@pytest.mark.parametrize("state", [s for s in RunState if s not in (RunState.ACTIVE, RunState.STOPPING)])
def test_nothing_leaves_before_the_experiment(guard: Guard, bus: Bus, state: RunState) -> None:
    refused(guard, bus, command(), "nothing may leave", state)
    refused(guard, bus, command(0.0, enable=False), "nothing may leave", state)


def test_while_stopping_only_the_stop_frame_leaves(guard: Guard, bus: Bus) -> None:
    refused(guard, bus, command(), "enabled in state STOPPING", RunState.STOPPING)
    guard.send(command(0.0, enable=False), RunState.STOPPING, 0, 100 * MS)
    assert len(bus.frames) == 1


def test_a_disabled_command_with_a_current_is_refused(guard: Guard, bus: Bus) -> None:
    refused(guard, bus, command(0.5, enable=False), "disabled, but with 0.5 A")


def test_no_other_identifier_leaves(guard: Guard, bus: Bus) -> None:
    for identifier in set(range(0x800)) - {0x80}:
        refused(guard, bus, command()._replace(identifier=identifier), "not the command message")


@pytest.mark.parametrize("change", [{"extended": True}, {"remote": True}, {"error": True}])
def test_no_other_kind_of_frame_leaves(guard: Guard, bus: Bus, change: dict[str, Any]) -> None:
    refused(guard, bus, command()._replace(**change), "not the command message")


@pytest.mark.parametrize("length", [n for n in range(9) if n != 5])
def test_no_other_length_leaves(guard: Guard, bus: Bus, length: int) -> None:
    refused(guard, bus, Frame(0x80, (command().data + bytes(8))[:length]), "wrong length")


@pytest.mark.parametrize("bit", range(40))
def test_no_damaged_frame_leaves(guard: Guard, bus: Bus, bit: int) -> None:
    data = bytearray(command().data)
    data[bit // 8] ^= 1 << bit % 8
    refused(guard, bus, Frame(0x80, bytes(data)), "wrong CRC")


def test_the_counter_must_follow(guard: Guard, bus: Bus) -> None:
    for counter in [13, 14, 0, 1]:
        guard.send(command(counter=counter), ACTIVE, 100 * MS, 100 * MS)
    for counter in [1, 3, 14]:
        refused(guard, bus, command(counter=counter), "does not follow 1")
    guard.send(command(counter=2), ACTIVE, 100 * MS, 100 * MS)


def test_a_narrower_bench_narrows_the_guard(layout: Layout, bus: Bus) -> None:
    bench = parse_bench(shipped_bench_text().replace("current  = 6.0", "current  = 2.5"), "t")
    guard = Guard(layout, bench, bus.send)
    refused(guard, bus, command(2.5002), "is beyond 2.5 A")
    guard.send(command(2.5), ACTIVE, 100 * MS, 100 * MS)


def test_every_current_that_the_signal_can_hold_passes_exactly_if_it_is_within_the_limit(layout: Layout) -> None:
    bench = parse_bench(shipped_bench_text().replace("current  = 6.0", "current  = 3.0"), "t")
    for raw in range(-30_000, 30_001, 7):
        bus = Bus()
        guard = Guard(layout, bench, bus.send)
        if abs(raw) <= 15_000:
            guard.send(command(raw * 2e-4), ACTIVE, 100 * MS, 100 * MS)
        else:
            refused(guard, bus, command(raw * 2e-4), "beyond 3 A")


@pytest.mark.parametrize("age_ms", [-1.001, 2.001, 50.0])
def test_a_command_from_an_old_or_a_future_sample_is_refused(guard: Guard, bus: Bus, age_ms: float) -> None:
    refused(guard, bus, command(), "ms old", age_ns=round(age_ms * MS))


def test_commands_faster_than_the_bench_are_refused(guard: Guard, bus: Bus) -> None:
    surplus = round(RATE_WINDOW_PERIODS * 1.2)
    for n in range(surplus):
        guard.send(command(counter=n % 15), ACTIVE, 100 * MS, 100 * MS)
    refused(guard, bus, command(counter=surplus % 15), "more than 24 commands in 20 periods")
    guard.send(command(counter=surplus % 15), ACTIVE, 120 * MS, 120 * MS)


def test_a_stop_frame_is_never_too_fast(guard: Guard, bus: Bus) -> None:
    for n in range(24):
        guard.send(command(counter=n % 15), ACTIVE, 100 * MS, 100 * MS)
    for n in range(24, 27):
        guard.send(command(0.0, counter=n % 15, enable=False), RunState.STOPPING, 100 * MS, 100 * MS)
    assert len(bus.frames) == 27


def test_a_bus_that_fails_is_not_counted_as_passed_and_its_counter_is_spent(bench: Bench, layout: Layout) -> None:
    def lost(_frame: Frame) -> None:
        raise BusError("down")

    guard = Guard(layout, bench, lost)
    with pytest.raises(BusError):
        guard.send(command(counter=4), ACTIVE, 100 * MS, 100 * MS)
    assert guard.passed == 0
    with pytest.raises(GuardRejectedError, match="does not follow 4"):
        guard.send(command(counter=4), ACTIVE, 100 * MS, 100 * MS)


@given(st.binary(max_size=8), st.sampled_from(RunState), st.integers(0, 0x1FFFFFFF))
def test_random_bytes_never_leave_unless_they_are_a_legal_command(
    data: bytes, state: RunState, identifier: int
) -> None:
    layout = load_layout()
    bus = Bus()
    guard = Guard(layout, parse_bench(shipped_bench_text(), "t"), bus.send)
    try:
        guard.send(Frame(identifier, data), state, 100 * MS, 100 * MS)
    except GuardRejectedError:
        assert bus.frames == []
    else:
        legal = layout.decode_command(bus.frames[0])
        assert math.isfinite(legal.current)
        assert abs(legal.current) <= 6.0


def test_nothing_in_the_runtime_but_the_guard_sends() -> None:
    """The only calls of a ``send`` outside the transports are the guard's own and those to a guard."""
    folder = Path(emb_runtime.__file__).parent
    callers = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                called = ast.unparse(node.func)
                if node.func.attr in ("send", "_send", "send_periodic"):
                    callers.add((path.name, called))
    assert callers == {
        ("guard.py", "self._send"),
        ("loop.py", "self.guard.send"),
        ("loop.py", "self._send"),  # the loop's own method, which hands the frame to the guard
        ("transport.py", "self._socket.send"),
        ("transport.py", "self._bus.send"),
    }
    run = (folder / "run.py").read_text(encoding="utf-8")
    assert run.count("transport.send") == 1
    assert "Guard(layout, bench, transport.send)" in run
