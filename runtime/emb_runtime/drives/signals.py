"""Signals of a DBC as bits of a payload: read bit by bit, by no code that writes them.

cantools encodes what leaves and decodes what comes; the second guard reads what leaves by these functions alone.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cantools.database.can import Signal as DbcSignal

_FLOATS = {16: ">e", 32: ">f", 64: ">d"}


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
        """Distance of neighbouring values about a value [DBC units]."""
        if not self.is_float:
            return abs(self.scale)
        mantissa = {16: 10, 32: 23, 64: 52}[self.length]
        return abs(value) * 2.0**-mantissa + 2.0**-100


def make_field(signal: DbcSignal) -> Field:
    """The place of a signal of a DBC."""
    return Field(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=float(signal.scale),
        offset=float(signal.offset),
    )


def raw_value(field: Field, data: bytes) -> int:
    """The signal's bits as a whole number, sign included; of a float, its bit pattern.

    Raises:
        IndexError: the payload is too short.
    """
    raw = 0
    for position in field.positions:
        raw = raw << 1 | data[position >> 3] >> (position & 7) & 1
    if field.signed and not field.is_float and raw >> (field.length - 1):
        raw -= 1 << field.length
    return raw


def physical_value(field: Field, data: bytes) -> float:
    """The signal's value [DBC units]; NaN and infinity where a float says so.

    Raises:
        IndexError: the payload is too short.
    """
    raw = raw_value(field, data)
    value = struct.unpack(_FLOATS[field.length], raw.to_bytes(field.length // 8, "big"))[0] if field.is_float else raw
    return float(value * field.scale + field.offset)
