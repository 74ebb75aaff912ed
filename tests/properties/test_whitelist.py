"""Every identifier, length and kind of frame: what passes reception and guard, each judged on its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from emb_runtime.can.messages import Layout, StopReason
from emb_runtime.can.receiver import BUS_OFF, Reception
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame, NodeState, RunState
from emb_runtime.safety.guard import Guard, GuardRejectedError

KINDS = {
    "standard": Frame(0, b""),
    "extended": Frame(0, b"", extended=True),
    "remote": Frame(0, b"", remote=True),
    "error": Frame(0, b"", error=True),
}
COMMAND, ANGLE, VELOCITY, STATUS = 0x080, 0x100, 0x101, 0x102
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)  # Payload bytes that only a frame of CAN FD has
HIGH_BITS = 1 << 18  # 29-bit identifiers with the same lower 11 bits


def every(kind: str, valid: dict[int, bytes]) -> Iterator[Frame]:
    """Each identifier with each length: the first bytes of a valid payload, and zeros where it has no more."""
    for identifier in range(0x800):
        payload = valid.get(identifier, b"\x01\x02\x03\x04\x05\x06\x07\x08").ljust(8, b"\0")
        for length in range(9):
            yield KINDS[kind]._replace(identifier=identifier, data=payload[:length])


def let_out(guard: Guard, frame: Frame) -> None:
    guard.check(frame, RunState.ACTIVE, 0, 0)
    guard.send(frame)


@pytest.fixture(scope="module")
def valid(layout: Layout) -> dict[int, bytes]:
    frames = [
        layout.encode_command(0, 0, 1.0, True),
        layout.encode_angle(3, 0.0, 0),
        layout.encode_velocity(3, 0.0, 0.0, NodeState.IDLE, 15),
        layout.encode_status(3, NodeState.IDLE, StopReason.NONE, 0, 0),
    ]
    return {frame.identifier: frame.data for frame in frames}


@pytest.mark.parametrize("kind", KINDS)
def test_the_reception_believes_exactly_its_messages_and_is_touched_by_nothing_else(
    bench: Bench, layout: Layout, valid: dict[int, bytes], kind: str
) -> None:
    believed, rejected, foreign = set(), set(), set()
    reception = Reception(layout, bench, lambda _frame, _why: None)
    fresh = [w.valid_ns for w in reception.states]
    for frame in every(kind, valid):
        reception.add_frame(frame)
        touched = (frame.identifier, len(frame.data))
        if [w.valid_ns for w in reception.states] != fresh:
            believed.add(touched)
        if reception.rejected:
            rejected.add(touched)
        if reception.foreign_command:
            foreign.add(touched)
        if {touched} & (believed | rejected | foreign):
            reception = Reception(layout, bench, lambda _frame, _why: None)
    ours = {(identifier, length) for identifier in (ANGLE, VELOCITY, STATUS) for length in range(9)}
    command = {(COMMAND, length) for length in range(9)}
    whole = {(ANGLE, 8), (VELOCITY, 8), (STATUS, 8)}
    expected = {
        "standard": (whole, ours - whole, command),
        "extended": (set(), set(), set()),
        "remote": (set(), ours, command),
        "error": (set(), set(), set()),
    }
    assert (believed, rejected, foreign) == expected[kind]
    reported = reception.bus_errors
    assert reported.get(BUS_OFF, 0) == (1024 * 9 if kind == "error" else 0)  # half of all have that bit


@pytest.mark.parametrize("length", FD_LENGTHS)
def test_no_frame_of_can_fd_is_believed_or_let_out(
    bench: Bench, layout: Layout, valid: dict[int, bytes], length: int
) -> None:
    reception, bus = Reception(layout, bench, lambda _frame, _why: None), list[Frame]()
    guard = Guard(layout, bench, bus.append)
    fresh = [w.valid_ns for w in reception.states]
    for identifier in range(0x800):
        frame = Frame(identifier, valid.get(identifier, b"").ljust(length, b"\0"))
        assert reception.add_frame(frame) is None
        with pytest.raises(GuardRejectedError):
            let_out(guard, frame)
    assert [w.valid_ns for w in reception.states] == fresh
    assert (reception.rejected, reception.foreign_command, bus) == (3, True, [])


@pytest.mark.parametrize("step", [31, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("identifier", [COMMAND, ANGLE, VELOCITY, STATUS])
@pytest.mark.parametrize("extended", [True, False])
def test_no_29_bit_identifier_that_ends_like_one_of_ours_is_taken_for_it(
    bench: Bench, layout: Layout, valid: dict[int, bytes], identifier: int, extended: bool, step: int
) -> None:
    """Whether the frame says that it has 29 bits, or its number alone does; all of them at night."""
    reception, bus = Reception(layout, bench, lambda _frame, _why: None), list[Frame]()
    guard = Guard(layout, bench, bus.append)
    fresh = [w.valid_ns for w in reception.states]
    refused = 0
    highs = range(0 if extended else 1, HIGH_BITS, step)
    for high in highs:
        frame = Frame(high << 11 | identifier, valid[identifier], extended=extended)
        reception.add_frame(frame)
        if identifier == COMMAND:
            try:
                let_out(guard, frame)
            except GuardRejectedError:
                refused += 1
    assert [w.valid_ns for w in reception.states] == fresh
    assert (reception.rejected, reception.foreign_command, bus) == (0, False, [])
    assert refused == (len(highs) if identifier == COMMAND else 0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_guard_lets_out_exactly_one_identifier_of_one_length_and_kind(
    bench: Bench, layout: Layout, valid: dict[int, bytes], kind: str
) -> None:
    bus: list[Frame] = []
    guard = Guard(layout, bench, bus.append)
    refused = 0
    for frame in every(kind, valid):
        try:
            let_out(guard, frame)
        except GuardRejectedError:
            refused += 1
    assert [(frame.identifier, len(frame.data)) for frame in bus] == ([(COMMAND, 5)] if kind == "standard" else [])
    assert refused == guard.rejected == 0x800 * 9 - len(bus)
