"""Encoder and decoder of a message as Python functions that are generated from its description in the DBC.

Each is one expression per signal on the payload as one little-endian word. The errors are those of
:meth:`emb_runtime.can.codec.Message.refusal` and ``decode``, which work by the table of signals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from emb_runtime.can.codec import Message, Number, Signal
from emb_runtime.can.e2e import CRC_TABLE
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame


@dataclass(frozen=True)
class Field:
    """A signal as a field of a record: its physical value by default."""

    signal: str
    choices: tuple[object, ...] = ()  # Objects in place of the values 0, 1, ...
    scale: int = 1  # Steps of the record in a unit of the signal: 10**9 for nanoseconds; then both are integers
    wraps: bool = False  # A value beyond the signal's bits is encoded modulo them
    saturates: bool = False  # A value beyond the greatest is encoded as the greatest
    fixed: int | None = None  # Encoded in each frame: no argument of the encoder


class Codec(NamedTuple):
    """Functions of one message."""

    encode: Callable[..., Frame]  # Record's fields → protected frame; raises FrameError
    decode: Callable[[Frame], Any]  # Frame → record; raises FrameRejectedError


def generate_codec(message: Message, record: type[Any], fields: tuple[Field, ...]) -> Codec:
    """The codec of a message, from and to a named tuple whose fields stand for every signal but the CRC, in order.

    Those that are not fixed are the arguments of the encoder.
    """
    coded = [_Coded(message.signal(field.signal), field, f"v{at}") for at, field in enumerate(fields)]
    names: dict[str, Any] = {
        "T": CRC_TABLE,
        "Frame": Frame,
        "Record": record,
        "new": tuple.__new__,
        "word_of": int.from_bytes,
        "refusal": lambda values: message.refusal({c.signal.name: v for c, v in zip(coded, values, strict=True)}),
        "explain": lambda frame: message.decode(frame),
        "FrameError": FrameError,
        **{f"choices_{c.name}": c.field.choices for c in coded},
    }
    exec(_encoder(message, coded) + _decoder(message, coded), names)
    return Codec(names["encode"], names["decode"])


class _Coded(NamedTuple):
    signal: Signal
    field: Field
    name: str  # Variable of its value

    @property
    def resolution(self) -> Number:
        """Record's value of a step."""
        factor = self.signal.factor
        return factor if self.field.scale == 1 else round(factor * self.field.scale)

    def condition(self) -> str:
        """True for a value that can be encoded; NaN is refused by the order of the comparisons."""
        low, high = self.signal.minimum, self.signal.maximum
        if self.field.wraps or self.field.fixed is not None:
            return ""
        bounds = f"{low!r} <= {self.name}" + ("" if self.field.saturates else f" <= {high!r}")
        return f"{bounds} and int({self.name}) == {self.name}" if self.signal.factor == 1 else bounds

    def encoded(self) -> str:
        """The raw value of the value."""
        value, step = self.name, self.resolution
        if self.field.fixed is not None:
            return str(self.field.fixed)
        if self.field.wraps:
            steps = f"({value} + {step // 2}) // {step}" if isinstance(step, int) else f"round({value} / {step!r})"
            return f"{steps} & {self.signal.mask}"
        if self.field.saturates:
            value = f"min({value}, {self.signal.maximum!r})"
        return f"int({value})" if self.signal.factor == 1 else f"round({value} / {step!r})"

    def raw(self) -> str:
        """The raw value in the word."""
        signal = self.signal
        unsigned = f"w >> {signal.shift} & {signal.mask}"
        return f"(({unsigned}) ^ {signal.sign}) - {signal.sign}" if signal.sign else unsigned

    def decoded(self) -> str:
        """The value of the raw value."""
        if self.field.choices:
            return f"choices_{self.name}[{self.name}]"
        return self.name if self.resolution == 1 else f"{self.name} * {self.resolution!r}"


def _encoder(message: Message, coded: list[_Coded]) -> str:
    names = ", ".join(c.name for c in coded if c.field.fixed is None)
    values = ", ".join(c.name if c.field.fixed is None else str(c.field.fixed) for c in coded)
    checks = " and ".join(condition for c in coded if (condition := c.condition()))
    word = " | ".join(f"({c.encoded()} & {c.signal.mask}) << {c.signal.shift}" for c in coded)
    return f"""def encode({names}):
    if not ({checks}):
        raise refusal(({values},))
    w = {word}
    b = w.to_bytes({message.length}, "little")
    return new(Frame, ({message.identifier}, bytes(({_crc(message, "b")},)) + b[1:], 0, False, False, False, False, 0))
"""


def _decoder(message: Message, coded: list[_Coded]) -> str:
    kind = f"f.identifier == {message.identifier} and not (f.extended or f.remote or f.error)"
    raws = "".join(f"            {c.name} = {c.raw()}\n" for c in coded)
    ranges = " and ".join(f"{c.signal.raw_minimum} <= {c.name} <= {c.signal.raw_maximum}" for c in coded)
    values = ", ".join(c.decoded() for c in coded)
    return f"""
def decode(f):
    b = f.data
    if {kind} and len(b) == {message.length}:
        w = word_of(b, "little")
        if b[0] == {_crc(message, "b")} and w & 0xF00 != 0xF00 and not w & {message.reserved}:
{raws}            if {ranges}:
                return new(Record, ({values},))
    explain(f)
    raise FrameError(f"{message.name}: the two decoders disagree on {{f}}")
"""


def _crc(message: Message, payload: str) -> str:
    state = str(message.crc_start)
    for at in range(1, message.length):
        state = f"T[{state} ^ {payload}[{at}]]"
    return state
