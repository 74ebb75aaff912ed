from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.experiment.decoded import RECENT, Frames, Replay, Samples
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState, SensorSample

BENCH, LAYOUT = load_bench(), load_layout()
PERIOD = BENCH.timing.sample_time_ns


class Answer(NamedTuple):
    """A command, and the number of the sample that it answers."""

    answered: int
    counter: int
    current: float


def one_by_one(frames: list[Frame], layout: Layout, bench: Bench) -> tuple[list[SensorSample], list[Answer]]:
    """What the run's own reception makes of the frames."""
    reception = Reception(layout, bench, lambda _frame, _why: None)
    samples: list[SensorSample] = []
    answers: list[Answer] = []
    for frame in frames:
        if (sample := reception.take(frame)) is not None:
            samples.append(sample)
        elif frame.own and frame.identifier == layout.command.identifier:
            try:
                command = layout.decode_command(frame)
            except FrameError:
                continue
            recent = [n for n in range(len(samples))[-RECENT:] if samples[n].counter == command.answers]
            if command.enable and recent:
                answers.append(Answer(recent[-1], command.counter, command.current))
    return samples, answers


def in_batches(frames: list[Frame], cuts: list[int]) -> tuple[list[SensorSample], list[Answer]]:
    """What :class:`Replay` makes of them."""
    replay, samples, answers = Replay(LAYOUT, BENCH), list[SensorSample](), list[Answer]()
    places = sorted({0, len(frames), *(cut % (len(frames) + 1) for cut in cuts)})
    for begin, end in pairwise(places):
        taken = replay(Frames.of(frames[begin:end]))
        rows = zip(*(column.tolist() for column in taken.samples), strict=True)
        samples += [SensorSample(*row)._replace(node_state=NodeState(row[-1])) for row in rows]
        answers += [Answer(*row) for row in zip(*(c.tolist() for c in taken.commands), strict=True)]
    return samples, answers


def bus(count: int, start: int) -> list[Frame]:
    """A brake that swings, and commands that answer every sample."""
    frames = []
    for k in range(count):
        counter, when = (start + k) % 15, 10**9 + (start + k) * PERIOD
        angle, velocity = 5.0 * np.sin(0.05 * k), 250.0 * np.cos(0.05 * k)
        frames += [
            LAYOUT.encode_angle(counter, angle, (start + k) * PERIOD)._replace(time_ns=when),
            LAYOUT.encode_velocity(counter, velocity, 0.5, NodeState.ACTIVE, (counter - 1) % 15)._replace(
                time_ns=when + 30_000
            ),
            LAYOUT.encode_command(CurrentCommand(counter, counter, 0.25, k % 7 != 0))._replace(
                time_ns=when + 90_000, own=True
            ),
        ]
    return frames


class Blow(NamedTuple):
    """Something that happens to a frame."""

    what: str
    at: int
    value: int


BLOWS = st.builds(
    Blow,
    st.sampled_from(
        [
            "lose",
            "repeat",
            "flip",
            "swap",
            "late",
            "early",
            "leap",
            "foreign",
            "extended",
            "remote",
            "own",
            "short",
            "hole",
        ]
    ),
    st.integers(0, 10_000),
    st.integers(0, 2**16),
)


def bent(frame: Frame, blow: Blow) -> Frame:
    match blow.what:
        case "flip" if frame.data:
            data = bytearray(frame.data)
            data[blow.value // 8 % len(data)] ^= 1 << blow.value % 8
            return frame._replace(data=bytes(data))
        case "leap" if frame.identifier == LAYOUT.angle.identifier:
            told = LAYOUT.angle.unpack(frame.data)
            there = LAYOUT.encode_angle(int(told["Counter"]), blow.value % 50, round(told["DeviceTime"] * 1e9))
            return frame._replace(data=there.data)
        case "extended":
            return frame._replace(extended=True)
        case "remote":
            return frame._replace(remote=True)
        case "own":
            return frame._replace(own=True)
        case "short":
            return frame._replace(data=frame.data[: blow.value % 8])
    return frame


def strike(frames: list[Frame], blow: Blow) -> None:
    if not frames:
        return
    at = blow.at % len(frames)
    frame = frames[at]
    match blow.what:
        case "lose":
            del frames[at]
        case "hole":
            del frames[at : at + blow.value % 90]
        case "repeat":
            frames.insert(min(len(frames), at + blow.value % 40), frame)
        case "swap":
            other = (at + blow.value % 5) % len(frames)
            frames[at], frames[other] = frames[other], frame
        case "late" | "early":
            by = blow.value * 10**5 * (1 if blow.what == "late" else -1)
            frames[at:] = [f._replace(time_ns=f.time_ns + by) for f in frames[at:]]
        case "foreign":
            frames.insert(at, Frame(blow.value % 0x800, blow.value.to_bytes(8, "little"), frame.time_ns))
        case _:
            frames[at] = bent(frame, blow)


@settings(deadline=None, max_examples=150)
@given(
    st.integers(0, 60), st.integers(0, 10**6), st.lists(BLOWS, max_size=12), st.lists(st.integers(0, 500), max_size=6)
)
def test_frames_are_taken_and_rejected_exactly_as_the_run_does_it(
    count: int, start: int, blows: list[Blow], cuts: list[int]
) -> None:
    frames = bus(count, start)
    for blow in blows:
        strike(frames, blow)
    assert in_batches(frames, cuts) == one_by_one(frames, LAYOUT, BENCH)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.sampled_from([0x80, 0x100, 0x101, 0x102]), st.binary(max_size=9)), max_size=20))
def test_noise_on_the_bus_is_no_sample(noise: list[tuple[int, bytes]]) -> None:
    frames = [Frame(identifier, data, k * PERIOD) for k, (identifier, data) in enumerate(noise)]
    assert in_batches(frames, [3]) == one_by_one(frames, LAYOUT, BENCH)


def test_the_device_s_time_is_unwrapped_over_many_wraps() -> None:
    wraps = 3 * LAYOUT.device_time_period_ns // PERIOD
    frames = [frame for k in range(0, wraps, 997) for frame in bus(1, k)]
    samples, _ = in_batches(frames, list(range(0, 1000, 7)))
    assert samples == one_by_one(frames, LAYOUT, BENCH)[0]
    first = samples[0].device_time_ns
    assert len(samples) > 10
    assert all(s.device_time_ns - first == s.receive_time_ns - samples[0].receive_time_ns for s in samples)


def test_no_sample_has_the_columns_of_a_sample() -> None:
    assert Samples._fields == SensorSample._fields
    assert [len(column) for column in Samples.none()] == [0] * len(SensorSample._fields)
