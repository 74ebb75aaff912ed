"""End-to-end protection of a frame, in the shape of AUTOSAR E2E profile 1: a CRC, a data id, an alive counter.

Source: AUTOSAR "Specification of SW-C End-to-End Communication Protection Library", profile 1 with the data id mode
that includes both bytes, and "Specification of CRC Routines" for CRC-8 SAE J1850 (polynomial 0x1D).
The polynomial is primitive of degree 8: every single and double bit error of a codeword of at most 255 bits is
detected, and ours are at most 80 bits long, the data id included.
"""

from __future__ import annotations

from typing import Final

COUNTER_MODULUS: Final = 15  # Alive counters run 0..14
NO_COUNTER: Final = 15  # Never a valid alive counter

_POLYNOMIAL: Final = 0x1D


def _table() -> bytes:
    """The CRC of each single byte."""
    entries = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ _POLYNOMIAL if value & 0x80 else value << 1
            value &= 0xFF
        entries.append(value)
    return bytes(entries)


CRC_TABLE: Final = _table()


def crc(start: int, data: bytes) -> int:
    """The CRC register after some bytes; ``start`` is its value before them."""
    for byte in data:
        start = CRC_TABLE[start ^ byte]
    return start


def profile1_start(data_id: int) -> int:
    """The CRC register after the data id (0..65535), low byte first: what a codec computes once per message.

    Profile 1 of release 4 undoes the start value and the final XOR of the standard CRC, so that both are zero.
    """
    return crc(0x00, data_id.to_bytes(2, "little"))


def has_valid_crc(start: int, payload: bytes) -> bool:
    """Returns True if byte 0 of a payload (at least 1 byte) is the CRC of the others; ``start`` is the data id's."""
    return payload[0] == crc(start, payload[1:])


def next_counter(counter: int) -> int:
    """The alive counter that follows."""
    return (counter + 1) % COUNTER_MODULUS


WEIGHT: Final = 4
"""Good events that forgive a bad one."""


class LeakyCount:
    """Leaky bucket: +:data:`WEIGHT` per bad event, -1 per good one.

    Full after ``tolerated`` bad ones in a row, or after about WEIGHT tolerated / ((1 + WEIGHT) d - 1) events if a share
    d of them, more than a fifth, is bad. It saturates, so that a burst is forgiven in bounded time.
    """

    def __init__(self, tolerated: int) -> None:
        if tolerated < 1:
            raise ValueError(f"tolerated: expected at least 1, got {tolerated}")
        self._full = WEIGHT * tolerated
        self.errors = 0  # 0..WEIGHT tolerated

    @property
    def exceeded(self) -> bool:
        """Returns True if there were too many."""
        return self.errors == self._full

    def reject(self, count: int = 1) -> None:
        """Count some that were bad, in a row."""
        self.errors = min(self.errors + WEIGHT * count, self._full)

    def forgive(self) -> None:
        """Count one that was good."""
        if self.errors > 0:
            self.errors -= 1


class CounterCheck(LeakyCount):
    """Follows the alive counter of one message.

    Only an accepted frame moves the stored counter: if a rejected one did, replayed frames could rewind the check.
    A frame rejected for its length, CRC or content goes to :meth:`reject`: its counter cannot be trusted.
    """

    def __init__(self, tolerated: int) -> None:
        super().__init__(tolerated)
        self.last: int | None = None  # Counter of the last accepted frame, 0..14; None before the first

    def advance(self, counter: int) -> int:
        """Check the counter, 0..14, of a frame that is valid in itself, and count it.

        Returns:
            Steps since the last accepted frame: 1 it is the next one (or the first ever), n > 1 it jumped and n − 1
            frames are missing (modulo 15), 0 it repeats the last one and is rejected.
        """
        if not 0 <= counter < COUNTER_MODULUS:
            raise ValueError(f"counter: expected 0..{COUNTER_MODULUS - 1}, got {counter}")
        steps = 1 if self.last is None else (counter - self.last) % COUNTER_MODULUS
        if steps == 0:
            self.reject()
            return 0
        self.last = counter
        if self.errors > 0:  # forgive(), written out: each received frame comes through here
            self.errors -= 1
        return steps
