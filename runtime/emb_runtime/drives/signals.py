"""Signals of a DBC as bits of a payload, and checksums: read bit by bit, by no code that writes them.

cantools encodes what leaves and decodes what comes; the second guard reads what leaves by these functions alone.
Sources of the checksums: AUTOSAR "Specification of SW-C End-to-End Communication Protection Library" (profiles 1, 2, 5)
and "Specification of CRC Routines"; for XOR and sum the DBC files of cars, which differ in a start value only.
"""

from __future__ import annotations

import binascii
import struct
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from emb_runtime.can import e2e

if TYPE_CHECKING:
    from cantools.database.can import Signal as DbcSignal

_FLOATS = {16: ">e", 32: ">f", 64: ">d"}
_MANTISSA = {16: 10, 32: 23, 64: 52}  # Bits of the fraction
_SMALLEST = {16: 2.0**-24, 32: 2.0**-149, 64: 2.0**-1074}
_LARGEST = {16: 65504.0, 32: (2.0 - 2.0**-23) * 2.0**127, 64: sys.float_info.max}
EXACT = 1e-12  # Part of a value by which floating-point numbers may be off


@dataclass(frozen=True)
class Field:
    """Place and scale of one signal in its message."""

    name: str
    start: int
    """Bit number of the DBC: the least significant bit if little-endian, the most significant one if big-endian."""
    length: int  # [bits]
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float  # DBC units per step
    offset: float  # [DBC units]

    @property
    def positions(self) -> tuple[int, ...]:
        """Bit numbers (8 byte + bit), most significant first."""
        if not self.big_endian:
            return tuple(range(self.start + self.length - 1, self.start - 1, -1))
        found, position = [], self.start
        for _ in range(self.length):
            found.append(position)
            position = position - 1 if position % 8 else position + 15
        return tuple(found)

    def step(self, value: float) -> float:
        """Distance of neighbouring values about a value, and what is lost beside a large offset [DBC units]."""
        step, lost = abs(self.scale), EXACT * abs(self.offset)
        if not self.is_float:
            return step + lost
        bits = self.length
        return abs(value - self.offset) * 2.0 ** -_MANTISSA[bits] + step * _SMALLEST[bits] + lost

    @property
    def ends(self) -> tuple[float, float]:
        """Least and largest value [DBC units]."""
        if self.is_float:
            least, most = -_LARGEST[self.length], _LARGEST[self.length]
        else:
            least = float(-(1 << self.length - 1) if self.signed else 0)
            most = least + (1 << self.length) - 1
        one, other = least * self.scale + self.offset, most * self.scale + self.offset
        return min(one, other), max(one, other)

    def carries(self, value: float) -> bool:
        """Returns True if a value is one of the signal's, to half a step [DBC units]."""
        (low, high), half = self.ends, 0.0 if self.is_float else 0.5 * self.step(value)
        return low - half <= value <= high + half


def make_field(signal: DbcSignal) -> Field:
    """The place of a signal of a DBC."""
    kind = signal.byte_order == "big_endian", signal.is_signed, signal.is_float
    return Field(signal.name, signal.start, signal.length, *kind, float(signal.scale), float(signal.offset))


def raw_value(field: Field, data: bytes) -> int:
    """The signal's bits as an integer, sign included; of a float, its bit pattern. IndexError: too few bytes."""
    raw = 0
    for position in field.positions:
        raw = raw << 1 | data[position >> 3] >> (position & 7) & 1
    if field.signed and not field.is_float and raw >> (field.length - 1):
        raw -= 1 << field.length
    return raw


def physical_value(field: Field, data: bytes) -> float:
    """The signal's value [DBC units]; NaN and infinity where a float is that. IndexError: too few bytes."""
    raw = raw_value(field, data)
    value = struct.unpack(_FLOATS[field.length], raw.to_bytes(field.length // 8, "big"))[0] if field.is_float else raw
    return float(value * field.scale + field.offset)


MODULI = {"profile1": 15, "profile2": 16, "profile5": 256}  # Number of values of the counter, where the profile has one
DATA_IDS = {"profile1": 1, "profile2": 16, "profile5": 1}
"""Number of data ids of a message: profile 2 has one for each value of the counter."""


@dataclass(frozen=True)
class Protection:
    """Protection of one message."""

    kind: str  # That of the mapping file's can.protection
    checksum: Field | None = None  # One byte, or two with profile 5
    counter: Field | None = None
    modulus: int = 0  # Number of values of the counter, 0 where there is none
    data_ids: tuple[int, ...] = ()
    start: int = 0  # Start value of XOR and sum, 0..255

    def next_counter(self, counter: int) -> int:
        """The counter that follows."""
        return (counter + 1) % self.modulus

    def checksum_of(self, data: bytes) -> int:
        """Checksum that a payload should have, whatever it has in its place."""
        field = self.checksum
        assert field is not None
        first = min(field.positions) // 8
        rest = data[:first] + data[first + field.length // 8 :]
        if self.kind == "profile1":
            return e2e.crc(e2e.profile1_start(self.data_ids[0]), rest)
        if self.kind == "profile2":
            assert self.counter is not None
            data_id = self.data_ids[raw_value(self.counter, data) % len(self.data_ids)]
            return crc8_h2f(rest + bytes((data_id & 0xFF,)))
        if self.kind == "profile5":
            return binascii.crc_hqx(rest + self.data_ids[0].to_bytes(2, "little"), 0xFFFF)
        state = self.start
        for byte in rest:
            state = state ^ byte if self.kind == "xor" else (state + byte) & 0xFF
        return state

    def fault(self, data: bytes) -> str:
        """Fault of a received payload, in words; empty if its checksum and the counter's value are possible."""
        if self.checksum is not None and raw_value(self.checksum, data) != self.checksum_of(data):
            return "wrong checksum"
        if self.counter is not None and raw_value(self.counter, data) >= self.modulus:
            return "invalid counter"
        return ""


def crc8_h2f(data: bytes) -> int:
    """CRC-8 with the polynomial 0x2F, start value and final XOR 0xFF: 0xDF for ``b"123456789"``."""
    state = 0xFF
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = (state << 1 ^ 0x2F if state & 0x80 else state << 1) & 0xFF
    return state ^ 0xFF
