"""Frames as a node sends them, and everything that can be wrong with frames."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import NamedTuple

from emb_runtime.can.messages import StopReason, load_layout
from emb_runtime.records import Frame, NodeState
from tests.independent import MESSAGES, protected

LAYOUT = load_layout()
MS = 1_000_000
COMMAND, ANGLE, VELOCITY, STATUS = 0x080, 0x100, 0x101, 0x102


class Played(NamedTuple):
    """What a sequence was."""

    items: int  # Frames or events
    commands: int = 0  # Commands that reached the bus, each of them judged


class ViolationError(AssertionError):
    """Something that must not be."""


def demand(holds: bool, *what: object) -> None:
    """Raise a :class:`ViolationError` unless it holds."""
    if not holds:
        raise ViolationError(" ".join(map(str, what)))


def chance(draw: Random, percent: int) -> bool:
    """True so often; false is what hypothesis shrinks to."""
    return draw.randrange(100) >= 100 - percent


def anything(draw: Random, time_ns: int = 0) -> Frame:
    """Any frame at all: mostly with an identifier of ours and often with a CRC that is right."""
    identifier = draw.choice([COMMAND, ANGLE, VELOCITY, STATUS, draw.randint(0, 0x7FF)])
    frame = Frame(identifier, draw.randbytes(draw.randint(0, 8)), time_ns)
    if identifier in MESSAGES and chance(draw, 70):
        frame = frame._replace(data=protected(identifier, draw.randbytes(MESSAGES[identifier].length - 1)))
    return of_a_kind(draw, frame) if chance(draw, 15) else frame


def of_a_kind(draw: Random, frame: Frame) -> Frame:
    """The same frame, but not a standard data frame on the bus."""
    kind = draw.randint(0, 4)
    if kind == 0:
        return frame._replace(extended=True, identifier=draw.choice([frame.identifier, draw.randint(0, 0x1FFFFFFF)]))
    if kind == 1:
        return frame._replace(remote=True, data=draw.choice([b"", frame.data]))
    if kind == 2:
        return frame._replace(error=True, identifier=draw.randint(0, 0xFFF))
    if kind == 3:
        return frame._replace(own=True)
    return frame._replace(dropped=draw.randint(0, 1000))


def damaged(draw: Random, frame: Frame) -> Frame:
    """A frame that the bus, a gateway or another sender has changed."""
    data = bytearray(frame.data)
    how = draw.randint(0, 5)
    if how == 0 and data:  # bit errors that the CAN controller has overlooked
        for _ in range(draw.randint(1, 4)):
            bit = draw.randint(0, 8 * len(data) - 1)
            data[bit // 8] ^= 1 << bit % 8
    elif how == 1:
        data = data[: draw.randint(0, len(data))]
    elif how == 2 and len(data) > 1 and frame.identifier in MESSAGES:  # something else, properly protected
        data[1 + draw.randint(0, len(data) - 2)] = draw.randint(0, 255)
        data = bytearray(protected(frame.identifier, bytes(data[1:])))
    elif how == 3 and len(data) > 1 and frame.identifier in MESSAGES:  # of another sender
        data = bytearray(protected(frame.identifier, bytes(data[1:]), by=draw.randint(0, 0xFFFF)))
    elif how == 4:
        return of_a_kind(draw, frame)
    else:
        data += draw.randbytes(8 - min(8, len(data)))
    return frame._replace(data=bytes(data))


@dataclass
class Stream:
    """A node at constant speed, and everything that can happen between it and its reader."""

    draw: Random
    now_ns: int = 1_000 * MS
    count: int = 0  # Sampling periods so far

    def __post_init__(self) -> None:
        """Begin anywhere."""
        self._speed = self.draw.randint(-300, 300)
        self._percent = self.draw.choice([3, 10, 30])
        self._status_counter = 0
        self._past: list[Frame] = []
        self.count = self.draw.randint(0, 20)

    def period(self) -> list[Frame]:
        """The frames that come in the next sampling period, with their arrival times."""
        self.count += 1
        self.now_ns += MS
        frames = self._sent()
        if not chance(self.draw, self._percent):
            return frames
        return self._spoiled(frames)

    def _sent(self) -> list[Frame]:
        counter, angle = self.count % 15, 1e-3 * self._speed * (self.count % 500)
        frames = [
            LAYOUT.encode_angle(counter, angle, self.count * MS),
            LAYOUT.encode_velocity(counter, self._speed, 0.0, NodeState.ACTIVE, 15),
        ]
        if self.count % 100 == 1 or chance(self.draw, 2):
            self._status_counter = (self._status_counter + 1) % 15
            frames.append(LAYOUT.encode_status(self._status_counter, NodeState.ACTIVE, StopReason.NONE, 0, 0))
        return [frame._replace(time_ns=self.now_ns + n * 150_000) for n, frame in enumerate(frames)]

    def _spoiled(self, frames: list[Frame]) -> list[Frame]:
        draw = self.draw
        self._past = [*self._past, *frames][-40:]
        at = draw.randint(0, len(frames) - 1)
        how = draw.randint(0, 8)
        if how == 0:
            del frames[at]
        elif how == 1:
            frames.insert(at, frames[at])
        elif how == 2:
            frames.reverse()
        elif how == 3:
            frames[at] = damaged(draw, frames[at])
        elif how == 4:  # an old one once more
            frames.append(draw.choice(self._past)._replace(time_ns=self.now_ns))
        elif how == 5:
            frames.insert(at, anything(draw, self.now_ns))
        elif how == 6:  # silence, long enough for the counter to come round now and then
            missed = draw.choice([1, 2, 14, 15, 19, 20, 250])
            self.count += missed
            self.now_ns += missed * MS
            return frames[:1]
        elif how == 7:  # the computer's clock steps
            self.now_ns += draw.choice([-5 * MS, 5 * MS, 3600 * 1000 * MS, -3600 * 1000 * MS])
        else:  # the node has begun anew
            self.count = 0
        return frames
