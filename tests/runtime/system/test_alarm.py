from __future__ import annotations

import ctypes
import os
import signal
import socket
import threading
import time
from types import FrameType

import pytest

from emb_runtime.can.recvmmsg import DatagramReader, stamp_and_count
from emb_runtime.system.alarm import AGAIN_NS, RINGS, Alarm


def test_it_ends_a_read_that_blocks_and_not_before_its_time() -> None:
    alarm = Alarm.here()
    assert alarm is not None
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        stamp_and_count(ours)
        read = DatagramReader(ours.fileno(), 16, 4).read
        for _ in range(3):  # each time it is set anew
            deadline_ns = time.monotonic_ns() + 5_000_000
            alarm.set(deadline_ns)
            assert read(wait=True) == []
            assert time.monotonic_ns() >= deadline_ns
        alarm.set(time.monotonic_ns() + 60_000_000_000)
        theirs.send(b"x")
        assert [datagram.data for datagram in read(wait=True)] == [b"x"]
    alarm.close()


def test_a_signal_that_came_too_early_leaves_the_sockets_own_time_out() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        stamp_and_count(ours)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, bytes(8) + (1).to_bytes(8, "little"))
        assert DatagramReader(ours.fileno(), 16, 4).read(wait=True) == []


def test_it_rings_again_for_a_call_that_began_after_the_first_signal_and_then_is_silent() -> None:
    alarm, rang = Alarm.here(), 0
    assert alarm is not None
    handler = signal.getsignal(signal.SIGRTMIN)
    assert callable(handler)

    def count(number: int, frame: FrameType | None) -> None:
        nonlocal rang
        rang += 1
        handler(number, frame)

    signal.signal(signal.SIGRTMIN, count)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        stamp_and_count(ours)
        alarm.set(time.monotonic_ns() + 1)
        while not rang:
            pass
        assert DatagramReader(ours.fileno(), 16, 4).read(wait=True) == []
        while rang < RINGS:
            time.sleep(0.001)
        last = rang
        time.sleep(20e-9 * AGAIN_NS)
        assert rang - last <= 1  # one was perhaps on its way
    alarm.close()


def test_closed_it_does_not_ring() -> None:
    rang: list[int] = []
    alarm = Alarm.here()
    assert alarm is not None
    before = signal.signal(signal.SIGRTMIN, lambda number, _: rang.append(number))
    try:
        alarm.set(time.monotonic_ns() + 20_000_000)
        alarm.close()
        time.sleep(0.04)
        assert rang == []
    finally:
        signal.signal(signal.SIGRTMIN, before)


def test_there_is_none_beside_the_main_thread() -> None:
    found: list[Alarm | None] = []
    thread = threading.Thread(target=lambda: found.append(Alarm.here()))
    thread.start()
    thread.join()
    assert found == [None]


def test_there_is_none_on_another_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    assert Alarm.here() is None


class WithoutTimers:
    """A C library in which the calls fail, or are not there."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def timer_create(self, *_: object) -> int:
        ctypes.set_errno(11)
        return -1


def test_there_is_none_where_the_kernel_makes_no_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", WithoutTimers)
    assert Alarm.here() is None
    with pytest.raises(OSError, match=os.strerror(11)):
        Alarm(WithoutTimers())  # type: ignore[arg-type]  # stands in for the library
