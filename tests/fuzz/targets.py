"""What is fuzzed, each against an account of it that is written anew: reception and guard.

A target plays one sequence of choices and says how much that was. It raises :class:`ViolationError` for what must not
be; every other exception that leaves it is a finding as well.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from random import Random
from typing import NamedTuple

from emb_runtime.can.messages import load_layout
from emb_runtime.can.receiver import Reception
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame, NodeState, RunState, SensorSample
from emb_runtime.safety.guard import Guard, GuardRejectedError
from emb_runtime.safety.state_machine import StopError
from tests.fuzz.model import ReceptionModel
from tests.fuzz.stream import COMMAND, MS, Stream, anything, chance, damaged
from tests.independent import protected, read

LENGTH = 100  # Frames or events in a sequence
BENCH, LAYOUT = load_bench(), load_layout()


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


def reception(draw: Random) -> Played:
    """Whatever is lost, damaged, repeated, swapped, forged or mistimed, no frame counts for more than it is."""
    stream, model = Stream(draw), ReceptionModel(BENCH)
    taken = Reception(LAYOUT, BENCH, lambda _frame, _why: None)
    count = 0
    while count < LENGTH:
        for frame in stream.period():
            count += 1
            ours, expected = taken.take(frame), model.take(frame)
            demand(ours == expected, frame, "made", ours, "expected", expected)
            now_ns = frame.time_ns + draw.randint(-2 * MS, 3 * MS)
            demand((taken.inhibit_reason(now_ns) == "") == model.permitted(now_ns), "permission at", now_ns, taken)
            compare(taken, model)
    return Played(count)


def compare(taken: Reception, model: ReceptionModel) -> None:
    """The reception has counted what the model has."""
    seen = (taken.rejected, taken.too_many_rejected, taken.foreign_command)
    demand(seen == (model.rejected, model.too_many, model.foreign), "counted", seen, "expected", model)
    for state in taken.states:
        key = 0 if state.name == "pair" else state.identifier
        demand(state.errors.errors == model.errors[key], state.name, "leaky count", state.errors.errors)
        demand(state.errors.last == model.counters.get(key), state.name, "stored counter", state.errors.last)


SLEW = 1500.05
"""A/s. The shipped bench's never binds: it lets the current turn round in one period. No whole number of steps."""
SLEW_STEPS = 7_501  # Of the current signal's 0.2 mA, the one that rounding may cost included


def guard(draw: Random) -> Played:
    """What reaches the bus is in the contract, and what is in the contract reaches the bus."""
    bench = replace(BENCH, guard=replace(BENCH.guard, slew=SLEW))
    limit = draw.choice([6.0, 6.0, 2.0])
    bus, failing = list[Frame](), list[bool]()

    def send(frame: Frame) -> None:
        if failing.pop():
            raise draw.choice([BusError, TransmitQueueFullError])("gone")
        bus.append(frame)

    watched, model = Guard(LAYOUT, bench, send, limit=limit), GuardModel(bench, limit)
    now_ns = draw.randint(0, 10**12)
    for _ in range(LENGTH):
        now_ns += draw.choice([MS, MS, MS, MS, MS, MS, 0, MS // 5, 5 * MS, 1000 * MS, -MS])
        state = draw.choice([*RunState, *[RunState.ACTIVE] * 20])
        age_ns = draw.choice([0, MS // 3, MS // 3, MS, 2 * MS, 2 * MS + 1, -MS, -MS - 1, 10 * MS])
        frame = attempt(draw, model)
        fails = chance(draw, 3)
        failing.append(fails)
        before = len(bus)
        with suppress(GuardRejectedError, BusError):
            watched.check(frame, state, now_ns - age_ns, now_ns)
            watched.send(frame)
        failing.clear()
        legal = model.judge(frame, state, now_ns - age_ns, now_ns, fails)
        demand((len(bus) > before) == (legal and not fails), frame, state.name, age_ns, "legal:", legal, model)
        demand(bus[before:] in ([], [frame]), "the guard changed", frame)
        if chance(draw, 20):
            with suppress(StopError):
                watched.check_drive(report(draw))
    return Played(LENGTH, len(bus))


def attempt(draw: Random, model: GuardModel) -> Frame:
    """A command that is nearly always nearly right."""
    if chance(draw, 3):
        return anything(draw)
    counter, answers, last = model.expected()
    if chance(draw, 10):
        counter = draw.randint(0, 15)
    if chance(draw, 10):
        answers, last = draw.randint(0, 15), 0
    enable = not chance(draw, 15)
    near = last + draw.choice([-1, 1]) * draw.choice([0, 100, SLEW_STEPS - 1, SLEW_STEPS, SLEW_STEPS, SLEW_STEPS + 1])
    raw = draw.choice([near, near, near, near, draw.randint(-32_768, 32_767), 30_000, -30_001, 10_001])
    if not enable and not chance(draw, 20):
        raw = 0
    body = struct.pack("<BhB", counter | answers << 4, min(max(raw, -32_768), 32_767), enable)
    frame = Frame(COMMAND, protected(COMMAND, body))
    return damaged(draw, frame) if chance(draw, 10) else frame


def report(draw: Random) -> SensorSample:
    """What a drive might say of the period before."""
    applied = draw.randint(-100_000, 100_000) * 2e-4
    return SensorSample(draw.randint(0, 14), 0.0, 0.0, 0, 0, applied, draw.randint(0, 15), NodeState.ACTIVE)


class GuardModel:
    """Which commands are legal, in whole steps of the current signal and whole nanoseconds."""

    def __init__(self, bench: Bench, limit: float) -> None:
        self._limit = round(min(6.0, bench.limits.current, limit) / 2e-4)
        self._last: tuple[int, int, int] | None = None
        self._sample_ns = 0
        self._sent_ns: list[int] = []

    def expected(self) -> tuple[int, int, int]:
        """Counter and answered sample of the command that would come next, and the current before it in steps."""
        if self._last is None:
            return 0, 0, 0
        counter, answers, raw = self._last
        return (counter + 1) % 15, (answers + 1) % 15, raw

    def judge(self, frame: Frame, state: RunState, sample_ns: int, now_ns: int, fails: bool) -> bool:
        """Whether a command is legal; it is remembered as sent, or as one that the bus has lost."""
        values = read(frame) if frame.identifier == COMMAND else None
        if values is None or state.name not in ("ACTIVE", "HOMING", "STOPPING"):
            return False
        counter, answers, raw = int(values["Counter"]), int(values["Answers"]), round(values["Current"] / 2e-4)
        next_counter, next_answers, last = self.expected()
        if (self._last is not None and counter != next_counter) or abs(raw) > self._limit:
            return False
        if values["Enable"]:
            # Seven periods: half a round of the counter, which is the same again 15 periods later.
            follows = answers == next_answers and sample_ns - self._sample_ns < 7 * MS
            begins = last if follows and self._last is not None else 0
            too_fast = len(self._sent_ns) >= 24 and now_ns - self._sent_ns[-24] < 20 * MS
            if state is RunState.STOPPING or too_fast or abs(raw - begins) > SLEW_STEPS:
                return False
            if not -MS <= now_ns - sample_ns <= 2 * MS:
                return False
        elif raw != 0:
            return False
        self._last, self._sample_ns = (counter, answers, 0 if fails else raw), sample_ns
        self._sent_ns.append(now_ns)
        return True


TARGETS: dict[str, Callable[[Random], Played]] = {
    "reception": reception,
    "guard": guard,
}
