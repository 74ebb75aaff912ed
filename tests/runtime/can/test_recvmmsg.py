from __future__ import annotations

import contextlib
import errno
import socket
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.recvmmsg import DatagramReader, stamp_and_count

# The kernel of a test machine may have no CAN. Local datagrams are stamped, UDP's are counted as well.


@contextlib.contextmanager
def pair(most: int = 4) -> Iterator[tuple[DatagramReader, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        stamp_and_count(ours)
        yield DatagramReader(ours.fileno(), 16, most), theirs


def test_nothing_waits_and_nothing_is_waited_for() -> None:
    with pair() as (reader, _):
        assert reader.read() == []
        assert reader.read() == []


@given(st.lists(st.binary(min_size=1, max_size=16), max_size=12), st.integers(1, 5))
def test_what_was_sent_is_read_in_order_however_many_fit_into_a_call(sent: list[bytes], most: int) -> None:
    with pair(most) as (reader, theirs):
        for k in range(0, len(sent), 3):  # some local sockets hold no more than ten datagrams
            for data in sent[k : k + 3]:
                theirs.send(data)
            read: list[bytes] = []
            while found := reader.read():
                assert len(found) <= most
                read += [datagram.data for datagram in found]
            assert read == sent[k : k + 3]


def test_each_datagram_has_the_wall_clocks_time_of_its_arrival() -> None:
    with pair() as (reader, theirs):
        moments = [time.time_ns()]
        for _ in range(3):
            theirs.send(b"x")
            moments.append(time.time_ns())
        stamps = [datagram.wall_ns for datagram in reader.read()]
        # The kernel's clock may be read in a coarser step than this process's.
        assert len(stamps) == 3
        for (before, after), stamp in zip(pairwise(moments), stamps, strict=True):
            assert before - 10**6 <= stamp <= after + 10**6
        assert stamps == sorted(stamps)


def test_a_longer_datagram_is_cut_and_flagged_and_the_next_one_is_not() -> None:
    with pair() as (reader, theirs):
        theirs.send(bytes(17))
        theirs.send(bytes(16))
        cut, whole = reader.read()
        assert (len(cut.data), cut.flags & socket.MSG_TRUNC) == (16, socket.MSG_TRUNC)
        assert (len(whole.data), whole.flags & socket.MSG_TRUNC) == (16, 0)


def test_what_the_kernel_dropped_is_told_with_the_datagram_after_it() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs,
    ):
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the least that the kernel grants: a few datagrams
        ours.bind(("127.0.0.1", 0))
        stamp_and_count(ours)
        reader = DatagramReader(ours.fileno(), 16, 64)
        for k in range(50):
            theirs.sendto(k.to_bytes(2, "little"), ours.getsockname())
        kept = reader.read()
        assert 0 < len(kept) < 50
        assert all(datagram.dropped is None for datagram in kept)
        theirs.sendto(b"after", ours.getsockname())
        (after,) = reader.read()
        assert after.dropped == 50 - len(kept)
        assert after.wall_ns > kept[-1].wall_ns


def test_an_error_of_the_socket_is_raised_with_its_number() -> None:
    with pytest.raises(OSError, match="Socket operation on non-socket") as caught, Path("/dev/null").open() as file:
        DatagramReader(file.fileno(), 16, 4).read()
    assert caught.value.errno == errno.ENOTSOCK
