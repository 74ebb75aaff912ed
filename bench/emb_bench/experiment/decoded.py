"""The frames of a log, taken exactly as the run took them, many at a time.

:class:`emb_runtime.can.receiver.Reception` decides frame by frame which pairs are samples. A log has millions of
frames, and nearly all of them are plain. So the same decisions are taken here on columns, with the state that is
carried from batch to batch: which counters came last, which angle waits for its velocity, where the device's time
stands, and the last sample that was believed. Only samples around an implausible one are looked at one by one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.logs.chunk import Integers, windows
from emb_bench.logs.contents import Batch
from emb_bench.logs.log import RunLog
from emb_bench.logs.protobuf_columns import Spans
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, protect
from emb_runtime.can.messages import Layout, Message
from emb_runtime.can.receiver import Reception, contracts
from emb_runtime.config.bench import Bench
from emb_runtime.errors import LogError
from emb_runtime.records import Frame

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

RECENT = COUNTER_MODULUS
"""A command names the sample that it answers by its counter: of older ones than this many none is meant."""
RX, TX = "/can/rx", "/can/tx"
FIELDS = ("id", "data", "is_extended", "is_rtr", "is_error")

_CRC = np.frombuffer(b"".join(protect(0, bytes([value]))[:1] for value in range(256)), np.uint8)
"""The CRC of each single byte."""
_LATEST = 1 << 61  # ns; 73 years on a monotonic clock, and half of what int64 holds


class Frames(NamedTuple):
    """Frames as columns, in the order in which they were recorded."""

    time_ns: Integers
    """Monotonic clock [ns]."""
    identifier: Integers
    word: NDArray[np.uint64]
    """The payload as one little-endian number."""
    length: Integers
    """Of the payload [bytes]."""
    plain: Booleans
    """Neither extended nor remote nor an error."""
    own: Booleans

    @classmethod
    def of(cls, frames: list[Frame]) -> Frames:
        """Frames that are no columns yet."""
        return cls(
            np.array([f.time_ns for f in frames], np.int64),
            np.array([f.identifier for f in frames], np.int64),
            np.array([int.from_bytes(f.data[:8], "little") for f in frames], np.uint64),
            np.array([len(f.data) for f in frames], np.int64),
            np.array([not (f.extended or f.remote or f.error) for f in frames], np.bool_),
            np.array([f.own for f in frames], np.bool_),
        )


class Samples(NamedTuple):
    """Sensor samples as columns: the fields of SensorSample but for the last."""

    counter: Integers
    angle: Floats
    velocity: Floats
    device_time_ns: Integers
    receive_time_ns: Integers
    applied_current: Floats
    command_counter: Integers
    node_state: Integers

    def part(self, index: Any) -> Samples:
        """Some of them."""
        return Samples(*(column[index] for column in self))

    @classmethod
    def joined(cls, *parts: Samples) -> Samples:
        """One after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @classmethod
    def none(cls) -> Samples:
        """No sample."""
        whole, real = np.empty(0, np.int64), np.empty(0)
        return cls(whole, real, real, whole, whole, real, whole, whole)


class Commands(NamedTuple):
    """Enabled commands that answer a sample, as columns, in their order."""

    answered: Integers
    """Number of the sample among all of the log."""
    counter: Integers
    current: Floats
    """[A]."""


class Taken(NamedTuple):
    """What one batch of frames gave."""

    samples: Samples
    commands: Commands


def frames_of(log: RunLog, batch: Batch) -> Frames:
    """The frames in a batch of a log, on the run's monotonic clock; ``own`` if the run sent them.

    Raises:
        LogError: frames cannot be decoded, have other fields, or times that no run has.
    """
    parts: list[tuple[Integers, Frames]] = []
    for topic, own in ((RX, False), (TX, True)):
        if topic not in log.topics:
            continue
        log.require(topic, FIELDS)
        found: Any = log.plain(batch, topic, FIELDS)
        word, length = _payload(batch.data, found["data"])
        kind = found["is_extended"] | found["is_rtr"] | found["is_error"]
        time_ns = _on_the_run_s_clock(log, found["publish_time"])
        frames = Frames(time_ns, found["id"], word, length, ~kind, np.full(len(word), own))
        parts.append((found["order"], frames))
    if not parts:
        return Frames.of([])
    order = np.argsort(np.concatenate([order for order, _ in parts]), kind="stable")
    return Frames(*(np.concatenate(c)[order] for c in zip(*(frames for _, frames in parts), strict=True)))


def _payload(data: NDArray[np.uint8], payload: Spans | NDArray[Any]) -> tuple[NDArray[np.uint64], Integers]:
    if not isinstance(payload, Spans):
        words = [int.from_bytes(part[:8], "little") for part in payload]
        return np.array(words, np.uint64), np.array([len(part) for part in payload], np.int64)
    word = windows(data, "<u8")[payload.begin].astype(np.uint64)
    unused = 8 * np.clip(8 - payload.length, 0, 7).astype(np.uint64)
    word = np.where(payload.length > 0, word << unused >> unused, np.uint64(0))
    return word, payload.length


def _on_the_run_s_clock(log: RunLog, unix_ns: Integers) -> Integers:
    if not len(unix_ns):
        return unix_ns
    first, offset = int(unix_ns.min()), log.wall_offset_ns
    if not -_LATEST < first - offset <= int(unix_ns.max()) - offset < _LATEST:
        raise LogError(f"{log.path}: the times of the frames and those of the run's clock have nothing in common")
    return (unix_ns - first) + (first - offset)


def replayed(log: RunLog, bench: Bench) -> Iterator[Taken]:
    """What the run made of its frames, one batch of the log at a time."""
    take = Replay(log.layout, bench)
    for batch in log.contents.batches():
        yield take(frames_of(log, batch))


class Replay:
    """Takes batches of frames in their order, and gives the samples that the run took from them.

    Args:
        layout: the bus layout.
        bench: says what is plausible.
    """

    def __init__(self, layout: Layout, bench: Bench) -> None:
        self._layout = layout
        self._plausible = Reception(layout, bench, lambda _frame, _why: None).follows
        self._apart_ns = contracts(layout, bench).pair.fresh_ns
        self._least_ns = bench.timing.sample_time_ns // 2
        self._counters = {"angle": -1, "velocity": -1}
        self._angle: tuple[int, float, int, int] | None = None
        """Counter, angle, device time and arrival of the angle that waits for its velocity."""
        self._stamp: tuple[int, int, int] | None = None
        """Wrapped device time, unwrapped device time and arrival of the last pair."""
        self._last: Samples | None = None
        """The last sample that was believed."""
        self._recent = np.empty(0, np.int64)
        """Counters of the last samples."""
        self._count = 0

    def __call__(self, frames: Frames) -> Taken:
        """What a batch gives."""
        layout = self._layout
        angles, velocities = (
            self._accepted(frames, layout.angle, "angle"),
            self._accepted(frames, layout.velocity, "velocity"),
        )
        places, samples = self._believed(*self._paired(frames, angles, velocities))
        return Taken(samples, self._answers(frames, places, samples))

    def _accepted(self, frames: Frames, message: Message, name: str) -> Integers:
        """Places of valid frames of a message whose counter does not repeat that of the valid one before."""
        valid = np.flatnonzero(valid_frames(message, frames) & ~frames.own)
        counters = _raw(message, "Counter", frames.word[valid])
        before = np.concatenate([[self._counters[name]], counters[:-1]]) if len(counters) else counters
        if len(counters):
            self._counters[name] = int(counters[-1])
        accepted: Integers = valid[counters != before]
        return accepted

    def _paired(self, frames: Frames, angles: Integers, velocities: Integers) -> tuple[Integers, Samples]:
        """Pairs of one counter: each velocity with the latest angle before it, which counts once."""
        layout = self._layout
        words, own = frames.word[angles], self._angle
        counter = _raw(layout.angle, "Counter", words)
        angle = _physical(layout.angle, "Angle", words)
        stamp = np.rint(_physical(layout.angle, "DeviceTime", words) * 1e9).astype(np.int64)
        arrival, place = frames.time_ns[angles], angles
        if own is not None:
            rows = zip(own, (counter, angle, stamp, arrival), strict=True)
            counter, angle, stamp, arrival = (np.concatenate([[first], column]) for first, column in rows)
            place = np.concatenate([[-1], place])
        latest = np.searchsorted(place, velocities) - 1
        seen = _raw(layout.velocity, "Counter", frames.word[velocities])
        fits = latest >= 0
        apart_ns = frames.time_ns[velocities[fits]] - arrival[latest[fits]]
        fits[fits] = (counter[latest[fits]] == seen[fits]) & (np.abs(apart_ns) <= self._apart_ns)
        velocities, latest = velocities[fits], latest[fits]
        first = np.diff(latest, prepend=-1) > 0
        velocities, latest = velocities[first], latest[first]
        if len(place):
            used = len(latest) > 0 and int(latest[-1]) == len(place) - 1
            last = (int(counter[-1]), float(angle[-1]), int(stamp[-1]), int(arrival[-1]))
            self._angle = None if used else last
        words, received = frames.word[velocities], frames.time_ns[velocities]
        return velocities, Samples(
            counter=counter[latest],
            angle=angle[latest],
            velocity=_physical(layout.velocity, "Velocity", words),
            device_time_ns=self._unwrapped(stamp[latest], arrival[latest]),
            receive_time_ns=np.maximum(arrival[latest], received),
            applied_current=_physical(layout.velocity, "AppliedCurrent", words),
            command_counter=_raw(layout.velocity, "CommandCounter", words),
            node_state=_raw(layout.velocity, "NodeState", words),
        )

    def _unwrapped(self, stamp: Integers, arrival: Integers) -> Integers:
        """Unwraps as :class:`emb_runtime.system.clock.TimeUnwrapper`: increments nearest to those of the arrivals."""
        if not len(stamp):
            return stamp
        period, half = self._layout.device_time_period_ns, self._layout.device_time_period_ns // 2
        first = self._stamp or (int(stamp[0]), int(stamp[0]), int(arrival[0]))
        passed = np.diff(arrival, prepend=first[2])
        increments = passed + (np.diff(stamp, prepend=first[0]) - passed + half) % period - half
        device = first[1] + np.cumsum(increments)
        self._stamp = (int(stamp[-1]), int(device[-1]), int(arrival[-1]))
        return device

    def _believed(self, places: Integers, samples: Samples) -> tuple[Integers, Samples]:
        """Those that follow from the one that was believed before."""
        if not len(places):
            return places, samples
        kept = self._follow(samples)
        places, samples = places[kept], samples.part(kept)
        if len(places):
            self._last = samples.part(slice(-1, None))
        return places, samples

    def _follow(self, samples: Samples) -> Integers:
        """Numbers of the samples that are believed."""
        every = samples if self._last is None else Samples.joined(self._last, samples)
        carried = len(every.counter) - len(samples.counter)
        ok = self._from_to(every.part(slice(None, -1)), every.part(slice(1, None)))
        if ok.all():
            return np.arange(len(samples.counter))
        believed = [0]
        for k in range(1, len(every.counter)):
            last = believed[-1]
            if ok[k - 1] if last == k - 1 else self._from_to(every.part([last]), every.part([k]))[0]:
                believed.append(k)
        return np.array(believed[carried:], np.int64) - carried

    def _from_to(self, last: Samples, sample: Samples) -> Booleans:
        elapsed_ns = sample.device_time_ns - last.device_time_ns
        as_one: Any = self._plausible
        result: Booleans = (elapsed_ns >= self._least_ns) & as_one(last, sample, elapsed_ns * 1e-9)
        return result

    def _answers(self, frames: Frames, places: Integers, samples: Samples) -> Commands:
        """Which sample each enabled command answers: the latest before it that has the counter."""
        message = self._layout.command
        sent = np.flatnonzero(valid_frames(message, frames) & frames.own)
        words = frames.word[sent]
        sent, words = (column[_raw(message, "Enable", words) != 0] for column in (sent, words))
        answers = _raw(message, "Answers", words)
        known = np.concatenate([self._recent, samples.counter])
        first = self._count - len(self._recent)
        place = np.concatenate([np.full(len(self._recent), -1), places])
        before = np.searchsorted(place, sent)  # how many of the known samples came before
        span = len(known) + 1
        keys = known * span + np.arange(len(known))
        order = np.argsort(keys)
        at = np.searchsorted(keys[order], answers * span + before) - 1
        found = np.where(at >= 0, order[at], 0) if len(known) else np.zeros(len(at), np.int64)
        fits = (at >= 0) & (before - found <= RECENT)
        if len(known):
            fits &= known[found] == answers
        self._recent = known[-RECENT:]
        self._count += len(places)
        chosen = words[fits]
        return Commands(found[fits] + first, _raw(message, "Counter", chosen), _physical(message, "Current", chosen))


def valid_frames(message: Message, frames: Frames) -> Booleans:
    """Whether each frame is one that :meth:`emb_runtime.can.codec.Message.decode` takes."""
    valid: Booleans = (frames.identifier == message.identifier) & frames.plain & (frames.length == message.length)
    words = frames.word[valid]
    octets = words.astype("<u8").view(np.uint8).reshape(-1, 8)
    crc = np.full(len(words), message.crc_start, np.uint8)
    for k in range(1, message.length):
        crc = _CRC[crc ^ octets[:, k]]
    good = (crc == octets[:, 0]) & (octets[:, 1] & 0x0F != NO_COUNTER) & (words & np.uint64(message.reserved) == 0)
    for signal in message.signals:
        if signal.raw_maximum - signal.raw_minimum < signal.mask:  # else all that its bits can say is allowed
            raw = _raw(message, signal.name, words)
            good &= (signal.raw_minimum <= raw) & (raw <= signal.raw_maximum)
    valid[valid] = good
    return valid


def _raw(message: Message, name: str, words: NDArray[np.uint64]) -> Integers:
    signal = message.signal(name)
    bits = (words >> np.uint64(signal.shift) & np.uint64(signal.mask)).astype(np.int64)
    result: Integers = (bits ^ signal.sign) - signal.sign
    return result


def _physical(message: Message, name: str, words: NDArray[np.uint64]) -> Floats:
    signal = message.signal(name)
    return np.asarray(_raw(message, name, words) * signal.factor + signal.offset, np.float64)
