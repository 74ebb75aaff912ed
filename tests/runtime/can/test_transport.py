from __future__ import annotations

import errno
import os
import socket
import struct
from collections import deque
from importlib import metadata
from typing import Any, NamedTuple, cast

import pytest

from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.transport import SocketCan, TransmitQueueFullError, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock, MonotonicClock

WALL_NS = 1_700_000_000_000_000_000
RCVBUFFORCE, ERR_FILTER = 33, 2  # from the kernel's headers
SECOND = 1_000_000_000


def raw(identifier: int, data: bytes) -> bytes:
    """A ``struct can_frame``, laid out by hand."""
    return identifier.to_bytes(4, "little") + bytes([len(data), 0, 0, 0]) + data.ljust(8, b"\0")


def failure(code: int) -> OSError:
    return OSError(code, os.strerror(code))


class Datagram(NamedTuple):
    """One frame as the kernel gives it."""

    data: bytes
    wall_ns: int
    dropped: int | None
    flags: int


class FakeSocket:
    """Behaves as a CAN_RAW socket does, as far as it is asked to."""

    def __init__(self) -> None:
        self.options: dict[tuple[int, int], int | bytes] = {}
        self.bound: tuple[str] | None = None
        self.bind_error: OSError | None = None
        self.pending_error = 0
        self.privileged = True
        self.descriptor = 7
        self.sent: list[bytes] = []
        self.send_error: OSError | None = None
        self.incoming: deque[Datagram | OSError] = deque()
        self.blocking = True
        self.script: deque[Any] = deque()
        self.closed = False
        self.reads = 0

    def setblocking(self, flag: bool) -> None:
        self.blocking = flag

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:
        if option == RCVBUFFORCE and level == socket.SOL_SOCKET and not self.privileged:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        self.options[level, option] = value

    def getsockopt(self, level: int, option: int) -> int:
        assert level == socket.SOL_SOCKET
        if option == socket.SO_ERROR:
            pending, self.pending_error = self.pending_error, 0
            return pending
        assert option == socket.SO_RCVBUF
        return 8 << 20 if self.privileged else 425_984

    def bind(self, address: tuple[str]) -> None:
        if self.bind_error is not None:
            raise self.bind_error
        self.bound = address

    def fileno(self) -> int:
        return self.descriptor

    def send(self, data: bytes, flags: int) -> int:
        assert flags == socket.MSG_DONTWAIT  # whether the socket blocks or not
        if self.send_error is not None:
            raise self.send_error
        self.sent.append(data)
        return len(data)

    def recvmsg(self, size: int, _control: int, flags: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        assert flags == socket.MSG_DONTWAIT
        self.reads += 1
        if not self.incoming:
            raise BlockingIOError
        item = self.incoming.popleft()
        if isinstance(item, OSError):
            raise item
        control = [(socket.SOL_SOCKET, 35, struct.pack("@ll", *divmod(item.wall_ns, SECOND)))]
        if item.dropped is not None:
            control.append((socket.SOL_SOCKET, 40, struct.pack("@I", item.dropped)))
        return item.data[:size], control, item.flags, None

    def close(self) -> None:
        self.closed = True

    def arrives(
        self, identifier: int, data: bytes = b"", *, at_ns: int = 0, flags: int = 0, dropped: int | None = None
    ) -> None:
        self.incoming.append(Datagram(raw(identifier, data), WALL_NS + at_ns, dropped, flags))


class SettableClock(SteppedClock):
    """Simulated time whose wall clock can be stepped."""

    def __init__(self) -> None:
        super().__init__()
        self.offset_ns = WALL_NS

    def wall_offset_ns(self) -> int:
        return self.offset_ns


class Rig:
    """A SocketCan on a fake socket, in simulated time; waiting runs a script and then times out."""

    def __init__(self, identifiers: tuple[int, ...] | None = None, **state: object) -> None:
        self.socket = FakeSocket()
        for name, value in state.items():
            setattr(self.socket, name, value)
        self.clock = SettableClock()
        self.waits: list[float] = []
        self.script: deque[Any] = deque()
        self.bus = SocketCan(
            "vcan0",
            self.clock,
            identifiers,
            open_socket=lambda: cast(socket.socket, self.socket),
            wait_readable=self.wait,
        )

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        assert descriptor == self.socket.descriptor
        self.waits.append(timeout_s)
        if self.script:
            self.script.popleft()()
            return True
        return False


def test_opening_sets_what_the_loop_relies_on() -> None:
    rig = Rig()
    options = rig.socket.options
    assert (rig.bus.name, rig.socket.bound, rig.socket.blocking) == ("vcan0", ("vcan0",), False)
    assert options[socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS] == 1
    assert options[socket.SOL_CAN_RAW, ERR_FILTER] == 0x1FFFFFFF
    assert (socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER) not in options


def test_the_receive_buffer_is_forced_where_allowed_or_what_the_kernel_grants_and_read_back() -> None:
    for privileged, used, other, granted in (
        (True, RCVBUFFORCE, socket.SO_RCVBUF, "8388608 bytes"),
        (False, socket.SO_RCVBUF, RCVBUFFORCE, "425984 bytes"),
    ):
        rig = Rig(privileged=privileged)
        assert rig.socket.options[socket.SOL_SOCKET, used] == 4 << 20
        assert (socket.SOL_SOCKET, other) not in rig.socket.options
        assert rig.bus.obtained["receive_buffer"] == granted


def test_identifiers_become_exact_kernel_filters_and_a_socket_that_only_sends_gets_nothing() -> None:
    filters = Rig(identifiers=(0x100, 0x101)).socket.options[socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER]
    # Mask: 11 identifier bits, and the flags for extended and remote frames.
    assert filters == bytes.fromhex("00010000 ff0700c0 01010000 ff0700c0")
    options = Rig(identifiers=()).socket.options
    assert options[socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER] == b""
    assert options[socket.SOL_CAN_RAW, ERR_FILTER] == 0


def test_a_kernel_without_can_says_how_to_get_one() -> None:
    def refuse() -> socket.socket:
        raise failure(errno.EAFNOSUPPORT)

    with pytest.raises(BusError, match=r"^vcan0: no CAN sockets here .*emb-hil -- COMMAND") as caught:
        SocketCan("vcan0", SteppedClock(), open_socket=refuse)
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ({"bind_error": failure(errno.ENODEV)}, r"^can7: no such CAN interface \(No such device\); "),
        ({"bind_error": OSError("AF_CAN interface name too long")}, "too long"),
        ({"pending_error": errno.ENETDOWN}, "^can7: the interface is down; `ip link set can7 up`$"),
        ({"descriptor": 1024}, "1024 is too high"),  # for select
    ],
)
def test_a_socket_that_cannot_be_used_is_refused_at_opening_with_what_to_do(state: dict[str, Any], told: str) -> None:
    fake = FakeSocket()
    vars(fake).update(state)
    with pytest.raises(BusError, match=told):
        SocketCan("can7", SteppedClock(), open_socket=lambda: cast(socket.socket, fake))
    assert fake.closed


def test_a_frame_is_sent_as_the_kernel_lays_it_out_and_each_kind_is_recognised() -> None:
    for frame, wire in (
        (Frame(0x080, b"\x01\x02\x03\x04\x05"), "80000000 05 000000 0102030405000000"),
        (Frame(0x7FF, b""), "ff070000 00 000000 0000000000000000"),
        (Frame(0x12345, bytes(range(8)), extended=True), "45230180 08 000000 0001020304050607"),
        (Frame(0x100, b"", remote=True), "00010040 00 000000 0000000000000000"),
    ):
        rig = Rig()
        rig.bus.send(frame)
        assert rig.socket.sent == [bytes.fromhex(wire)]
        rig.socket.incoming.append(Datagram(bytes.fromhex(wire), WALL_NS, None, 0))
        assert rig.bus.receive(0) == frame
    for identifier, expected in (
        (0x40000100, Frame(0x100, b"", remote=True)),  # whatever the kernel leaves behind it
        (0x20000044, Frame(0x44, b"\x01\x02", error=True)),
    ):
        rig.socket.arrives(identifier, b"\x01\x02")
        assert rig.bus.receive(0) == expected


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.EAGAIN])
def test_a_full_queue_is_counted_and_raised_and_never_retried(code: int) -> None:
    rig = Rig(send_error=failure(code))
    with pytest.raises(TransmitQueueFullError, match="0x080 dropped"):
        rig.bus.send(Frame(0x080, b"\x01"))
    rig.socket.send_error = None
    rig.bus.send(Frame(0x080, b"\x02"))
    assert rig.socket.sent == [raw(0x080, b"\x02")]
    assert rig.bus.receive(0) is None  # the bus is not lost


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (errno.ENETDOWN, "is down"),
        (errno.ENODEV, "has disappeared"),
        (errno.ENXIO, "has disappeared"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_a_lost_bus_is_no_full_queue(code: int, reason: str) -> None:
    rig = Rig(send_error=failure(code))
    with pytest.raises(BusError, match=reason) as caught:
        rig.bus.send(Frame(0x080, b"\x01"))
    assert not isinstance(caught.value, TransmitQueueFullError)


def test_what_came_before_a_loss_is_given_stop_frames_are_tried_and_an_interface_that_is_up_again_is_a_bus() -> None:
    rig = Rig()
    rig.clock.advance_to(5)
    rig.socket.incoming.append(failure(errno.ENETDOWN))
    rig.socket.arrives(0x100, at_ns=5)
    with pytest.raises(BusError, match=r"^vcan0: the interface is down"):
        rig.bus.receive(0)
    rig.bus.send(Frame(0x080, b"\x01"))
    assert len(rig.socket.sent) == 1
    assert rig.bus.receive(0) == Frame(0x100, b"", time_ns=5)
    assert rig.bus.receive(1_000_005) is None
    assert rig.waits == [pytest.approx(1e-3)]  # whoever listens on a lost bus listens as long as on another


def test_a_waiting_frame_is_one_system_call_and_no_wait() -> None:
    rig = Rig()
    rig.clock.advance_to(123_456_789_012_345_679)
    rig.socket.arrives(0x100, b"\x01\x02", at_ns=123_456_789_012_345_679)
    assert rig.bus.receive(10**9) == Frame(0x100, b"\x01\x02", time_ns=123_456_789_012_345_679)
    assert (rig.socket.reads, rig.waits) == (1, [])


def test_the_drop_count_lasts_until_the_kernel_tells_another() -> None:
    rig = Rig()
    for dropped in (None, 3, None, 9):  # the kernel attaches it only to frames before which something was dropped
        rig.socket.arrives(0x100, dropped=dropped)
    frames = [rig.bus.receive(0) for _ in range(4)]
    assert [f.dropped for f in frames if f] == [0, 3, 3, 9]


def test_own_echo_is_known_by_its_flag_and_not_by_coming_from_this_host() -> None:
    rig = Rig()
    rig.socket.arrives(0x080, at_ns=0, flags=socket.MSG_CONFIRM | socket.MSG_DONTROUTE)
    rig.socket.arrives(0x100, at_ns=0, flags=socket.MSG_DONTROUTE)
    assert [f.own for f in (rig.bus.receive(0), rig.bus.receive(0)) if f] == [True, False]


@pytest.mark.parametrize("size", [0, 8, 15, 72])
def test_a_read_of_another_size_is_a_bus_error(size: int) -> None:
    rig = Rig()
    rig.socket.incoming.append(Datagram(bytes(size), WALL_NS, None, 0))
    with pytest.raises(BusError, match=f"expected 16 bytes per frame, got {size}"):
        rig.bus.receive(0)


def test_a_deadline_in_the_past_only_looks_and_waking_without_a_frame_waits_for_the_rest_of_the_time() -> None:
    rig = Rig()
    rig.clock.advance_to(1_000)
    assert [rig.bus.receive(deadline_ns) for deadline_ns in (1_000, 999, 0)] == [None] * 3
    assert rig.waits == []
    rig.script.append(lambda: rig.clock.advance_to(700_000))
    assert rig.bus.receive(1_000_000) is None
    assert rig.waits == [pytest.approx(999e-6), pytest.approx(300e-6)]


STEPS_MS = (*range(1, 10), 0.05, 0.2, 0.5, 0.9, 1.1, 1.5, 1.9, 50, 3_600_000)
STEPS_NS = [sign * round(step * 1e6) for step in STEPS_MS for sign in (1, -1)]


def test_a_step_of_the_wall_clock_does_not_move_the_arrival_of_what_comes_after_it() -> None:
    for step_ns in STEPS_NS:
        rig = Rig()

        def arrive(rig: Rig = rig, step_ns: int = step_ns) -> None:
            rig.clock.offset_ns += step_ns
            rig.clock.advance_to(300_000)
            rig.socket.arrives(0x100, at_ns=20_000 + step_ns)

        rig.script.append(arrive)
        assert rig.bus.receive(1_000_000) == Frame(0x100, b"", time_ns=20_000), step_ns  # when the queue was empty
        assert rig.bus.receive(0) is None
        rig.clock.advance_to(600_000)
        rig.socket.arrives(0x101, at_ns=595_000 + step_ns)
        assert rig.bus.receive(0) == Frame(0x101, b"", time_ns=595_000), step_ns


@pytest.mark.parametrize("stepped_first", [True, False])
def test_a_frame_that_waits_while_the_wall_clock_steps_looks_no_newer_and_not_older_than_the_empty_queue(
    stepped_first: bool,
) -> None:
    for step_ns in STEPS_NS:
        rig = Rig()
        rig.clock.advance_to(1_000_000)
        assert rig.bus.receive(0) is None
        rig.clock.advance_to(5_000_000)
        rig.socket.arrives(0x100, at_ns=3_000_000 + step_ns * stepped_first)
        rig.socket.arrives(0x101, at_ns=4_999_999 + step_ns)
        rig.clock.offset_ns += step_ns
        for true_ns in (3_000_000, 4_999_999):
            frame = rig.bus.receive(0)
            assert frame is not None
            assert 1_000_000 <= frame.time_ns <= true_ns, step_ns


def test_a_frame_that_the_kernel_is_late_with_is_no_newer_than_its_stamp() -> None:
    for late_ns in (100_000, 3_000_000, 50_000_000):
        rig = Rig()
        rig.clock.advance_to(100_000_000)
        assert rig.bus.receive(0) is None  # stamped already, and not yet in the queue
        rig.clock.advance_to(100_200_000)
        rig.socket.arrives(0x100, at_ns=100_000_000 - late_ns)
        assert rig.bus.receive(0) == Frame(0x100, b"", time_ns=100_000_000 - late_ns)


def test_a_stamp_from_a_step_that_was_taken_back_is_as_old_as_it_can_be() -> None:
    rig = Rig()
    rig.clock.advance_to(1_000_000)
    assert rig.bus.receive(0) is None
    rig.clock.advance_to(5_000_000)
    for at_ns in (-3_600_000_000_000, 3_600_000_000_000, -WALL_NS):
        rig.socket.arrives(0x100, at_ns=at_ns)
        assert rig.bus.receive(0) == Frame(0x100, b"", time_ns=1_000_000)


@pytest.mark.parametrize(("steps", "time_ns"), [(15, 5_000_000), (16, 0)])
def test_the_offsets_of_a_clock_that_never_stands_still_are_bounded(steps: int, time_ns: int) -> None:
    rig = Rig()
    first_ns = rig.clock.offset_ns
    for _ in range(steps):  # as on a babbling bus: the queue is never empty
        rig.clock.offset_ns += 3_600 * SECOND
        rig.socket.arrives(0x100, at_ns=rig.clock.offset_ns - WALL_NS)
        assert rig.bus.receive(0) == Frame(0x100, b"", time_ns=0)
    rig.clock.advance_to(10_000_000)
    rig.socket.arrives(0x100, at_ns=first_ns - WALL_NS + 5_000_000)  # stamped before the first step
    assert rig.bus.receive(0) == Frame(0x100, b"", time_ns=time_ns)


def test_a_real_wait_sees_what_is_readable_and_what_is_not() -> None:
    # The kernel of a test machine may have no CAN: a socket pair stands in for the descriptor only.
    ours, theirs = socket.socketpair()
    with ours, theirs:
        fake = FakeSocket()
        fake.descriptor = ours.fileno()
        bus = SocketCan("vcan0", MonotonicClock(), open_socket=lambda: cast(socket.socket, fake))
        now_ns = MonotonicClock().now_ns()
        assert bus.receive(now_ns + 1_000_000) is None
        assert MonotonicClock().now_ns() >= now_ns + 1_000_000
        theirs.send(b"x")
        reads = fake.reads
        assert bus.receive(MonotonicClock().now_ns() + 5_000_000) is None  # readable, but there is no frame
        assert fake.reads > reads + 1


@pytest.mark.parametrize(("iface", "options"), [("probe", ""), ("probe:a=1,b=2", "a=1,b=2")])
def test_a_registered_transport_gets_its_options_and_the_bench(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, iface: str, options: str
) -> None:
    entry = metadata.EntryPoint("probe", "tests_probe:open", "emb_runtime.transports")
    opened = (cast(Transport, object()), SteppedClock())
    calls: list[tuple[str, Bench]] = []

    def factory(options: str, bench: Bench) -> tuple[Transport, Clock]:
        calls.append((options, bench))
        return opened

    monkeypatch.setattr(metadata, "entry_points", lambda *, group: [entry] if group == entry.group else [])
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda _: factory)
    assert open_transport(iface, bench) is opened
    assert calls == [(options, bench)]
