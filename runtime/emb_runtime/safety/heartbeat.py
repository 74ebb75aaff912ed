"""The heartbeat: a few machine words in shared memory between the loop and its watchdog process.

The loop reports that it lives, that it is armed, and the counter of the last command; the watchdog that it lives, and
whether it has tripped. Each word has one writer, and is stored and loaded at once (see
:mod:`emb_runtime.log.ring_buffer`). Nothing here waits, and nothing is a system call: it costs the loop a store.
"""

from __future__ import annotations

import mmap
import os
import struct

from emb_runtime.can.e2e import COUNTER_MODULUS

LOST_AFTER = 4
"""Heartbeats without a sign of life from the watchdog after which it counts as lost. More than one, for the loop
cannot tell a watchdog that is gone from a computer that was busy elsewhere; the node's watchdog still stands
behind both."""
STOP_FRAMES = 3
"""Stop frames that end a run, from the loop or from the watchdog, one per period; one would do, and the bus may lose
one."""

_SIZE = 4096
_MAGIC = 0x3154414548424D45
_MAGIC_AT, _HEARTBEAT_AT = 0, 1
_ARMED_AT, _BEAT_AT, _LAST_AT = 8, 9, 10  # the loop's, on another cache line
_TRIPPED_AT, _SIGN_AT = 16, 17  # the watchdog's


class Heartbeat:
    """One end of the shared memory, by its file descriptor: the loop's or the watchdog's.

    Raises:
        ValueError: the memory is not a heartbeat of this version.
    """

    def __init__(self, fd: int) -> None:
        size = os.fstat(fd).st_size
        if size != _SIZE:
            raise ValueError(f"expected a heartbeat in shared memory, got {size} bytes")
        self.fd = fd
        self._memory = mmap.mmap(fd, size)
        self._words = memoryview(self._memory).cast("Q")
        if self._words[_MAGIC_AT] != _MAGIC:
            self.close()
            raise ValueError("the shared memory is not a heartbeat of this version")
        self.heartbeat_ns = self._words[_HEARTBEAT_AT]  # Silence of the loop that trips the watchdog [ns]

    @classmethod
    def create(cls, heartbeat: float, now_ns: int) -> Heartbeat:
        """New shared memory: not armed, no command sent; OSError if the system has none.

        Args:
            heartbeat: silence of the loop that trips the watchdog [s].
            now_ns: monotonic; counts as the watchdog's first sign of life [ns].
        """
        fd = os.memfd_create("emb-heartbeat", os.MFD_CLOEXEC)
        os.ftruncate(fd, _SIZE)
        with mmap.mmap(fd, _SIZE) as memory:
            struct.pack_into("=QQ", memory, 0, _MAGIC, round(heartbeat * 1e9))
            struct.pack_into("=Q", memory, _LAST_AT * 8, COUNTER_MODULUS - 1 << 4)  # the first command has counter 0
            struct.pack_into("=Q", memory, _SIGN_AT * 8, now_ns)
        return cls(fd)

    # --- the loop's side --------------------------------------------------------------------------------------------

    @property
    def tripped(self) -> bool:
        """Returns True if the watchdog has tripped: from then on nothing may leave. Never taken back."""
        return self._words[_TRIPPED_AT] != 0

    def arm(self, now_ns: int) -> None:
        """Have the loop watched from now on, monotonic [ns]: before the first command."""
        self._words[_BEAT_AT] = now_ns
        self._words[_ARMED_AT] = 1

    def disarm(self) -> None:
        """Have the loop watched no longer: after the last stop frame."""
        self._words[_ARMED_AT] = 0

    def beat(self, now_ns: int) -> None:
        """Report that the loop lives, monotonic [ns], read just now."""
        self._words[_BEAT_AT] = now_ns

    def publish(self, counter: int, answers: int) -> None:
        """Report the alive counter of the next command, and that of the sample which it answers.

        Call before the last check of :attr:`tripped`. Then one side sees the other, or both use the same counter and
        the node drops the second frame.
        """
        self._words[_LAST_AT] = counter << 4 | answers

    def watched(self, now_ns: int) -> bool:
        """Returns True if the watchdog has reported within the last :data:`LOST_AFTER` heartbeats; monotonic [ns]."""
        return now_ns - self._words[_SIGN_AT] < LOST_AFTER * self.heartbeat_ns

    # --- the watchdog's side ----------------------------------------------------------------------------------------

    @property
    def armed(self) -> bool:
        """Returns True if the loop is to be watched: anything but 0."""
        return self._words[_ARMED_AT] != 0

    @property
    def beat_ns(self) -> int:
        """Time of the loop's last sign of life, monotonic [ns]."""
        return self._words[_BEAT_AT]

    @property
    def last(self) -> tuple[int, int]:
        """Counter of the last command that was sent or about to be, and of the sample that it answers; both 0..14.

        They are in this range whatever the memory holds.
        """
        word = self._words[_LAST_AT]
        return (word >> 4) % COUNTER_MODULUS, (word & 0xF) % COUNTER_MODULUS

    def trip(self) -> None:
        """Take the permission to send anything from the loop, for good."""
        self._words[_TRIPPED_AT] = 1

    def mark_alive(self, now_ns: int) -> None:
        """Report that the watchdog lives, monotonic [ns]."""
        self._words[_SIGN_AT] = now_ns

    def close(self) -> None:
        """Unmap and close; the other side has its mapping still."""
        self._words.release()
        self._memory.close()
        os.close(self.fd)


class Unwatched(Heartbeat):
    """A heartbeat that no watchdog reads: of a run on a simulated bus, whose time stands still."""

    def __init__(self) -> None:
        """Take memory of this process alone: the watchdog of another run must not trip this one."""
        self._words = memoryview(bytearray(_SIZE)).cast("Q")

    def close(self) -> None:
        """Leave the memory: it goes with the object."""

    def watched(self, now_ns: int) -> bool:
        """Returns True."""
        return True
