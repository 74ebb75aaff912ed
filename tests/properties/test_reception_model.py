"""Reception and guard in every order of events that hypothesis can think of, beside a plain account of both."""

from __future__ import annotations

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from emb_runtime.can.messages import StopReason, load_layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import load_bench
from emb_runtime.records import CurrentCommand, Frame, NodeState, RunState, SensorSample
from emb_runtime.safety.guard import Guard, GuardRejectedError
from tests.fuzz.model import ReceptionModel
from tests.fuzz.stream import ANGLE, COMMAND, MS, STATUS, VELOCITY
from tests.fuzz.targets import compare

BENCH, LAYOUT = load_bench(), load_layout()
LONGEST_NS = 2 * MS
"""Age of a sample from which on nothing may be commanded by it."""


class ReceptionAndGuard(RuleBasedStateMachine):
    """A brake at rest, its frames on their way through everything, and commands that answer them."""

    def __init__(self) -> None:
        super().__init__()
        self.model = ReceptionModel(BENCH)
        self.reception = Reception(LAYOUT, BENCH, lambda _frame, _why: None)
        self.bus: list[tuple[CurrentCommand, int]] = []
        self.guard = Guard(LAYOUT, BENCH, self.on_the_bus)
        self.now_ns = 5_000 * MS
        self.count = 0
        self.sample: SensorSample | None = None
        self.alone = True

    def on_the_bus(self, frame: Frame) -> None:
        self.bus.append((LAYOUT.decode_command(frame), self.now_ns))

    def take(self, *frames: Frame) -> list[SensorSample]:
        samples = []
        for frame in frames:
            sample, expected = self.reception.take(frame), self.model.take(frame)
            assert sample == expected
            if sample is not None:
                self.sample = sample
                samples.append(sample)
        return samples

    def next_pair(self) -> tuple[Frame, Frame]:
        self.count += 1
        self.now_ns += MS
        angle = LAYOUT.encode_angle(self.count % 15, 0.0, self.count * MS)
        velocity = LAYOUT.encode_velocity(self.count % 15, 0.0, 0.0, NodeState.ACTIVE, 15)
        return angle._replace(time_ns=self.now_ns), velocity._replace(time_ns=self.now_ns)

    def status(self, counter: int) -> Frame:
        frame = LAYOUT.encode_status(counter, NodeState.ACTIVE, StopReason.NONE, 0, 0)
        return frame._replace(time_ns=self.now_ns)

    # --- what the node and the bus do -------------------------------------------------------------------------------

    @initialize(start=st.integers(0, 14), alone=st.sampled_from([True, True, True, False]))
    def begin(self, start: int, alone: bool) -> None:
        self.count, self.alone = start, alone
        self.take(*self.next_pair(), self.status(start))

    @rule(count=st.integers(1, 40))
    def good_pairs_with_the_counter_wrapping(self, count: int) -> None:
        for _ in range(count):
            self.take(*self.next_pair())
            self.the_newest_sample_is_answered_if_that_is_permitted()
            self.nothing_enabled_was_sent_without_a_fresh_valid_pair_and_leave_of_every_message()

    @rule(missed=st.sampled_from([1, 2, 13, 14, 15, 16, 29, 30]))
    def frames_are_dropped(self, missed: int) -> None:
        for _ in range(missed):
            self.next_pair()

    @rule(which=st.integers(0, 1))
    def one_frame_of_a_pair_is_dropped(self, which: int) -> None:
        assert self.take(self.next_pair()[which]) == []

    @rule(times=st.integers(1, 3))
    def a_pair_is_repeated(self, times: int) -> None:
        pair = self.next_pair()
        self.take(*pair)
        for _ in range(times):
            assert self.take(*pair) == []

    @rule()
    def the_frames_of_a_pair_are_swapped(self) -> None:
        angle, velocity = self.next_pair()
        self.take(velocity, angle)

    @rule()
    def two_pairs_are_swapped(self) -> None:
        first, second = self.next_pair(), self.next_pair()
        later = self.take(*second)
        earlier = self.take(*first)
        assert not (later and earlier)  # it lies in the past

    @rule(count=st.integers(2, 4))
    def the_counter_is_stuck(self, count: int) -> None:
        for n in range(count):
            angle, velocity = self.next_pair()
            self.count -= 1
            samples = self.take(angle, velocity._replace(time_ns=self.now_ns))
            assert n == 0 or samples == []
        self.count += 1

    @rule(identifier=st.sampled_from([ANGLE, VELOCITY, STATUS]), bit=st.integers(0, 63))
    def a_frame_is_damaged(self, identifier: int, bit: int) -> None:
        frames = {f.identifier: f for f in (*self.next_pair(), self.status(0))}
        word = int.from_bytes(frames[identifier].data, "little") ^ 1 << bit
        before = [self.model.counters.get(i) for i in (ANGLE, VELOCITY, STATUS)]
        assert self.take(frames[identifier]._replace(data=word.to_bytes(8, "little"))) == []
        assert [self.model.counters.get(i) for i in (ANGLE, VELOCITY, STATUS)] == before

    @rule(identifier=st.sampled_from([COMMAND, ANGLE, VELOCITY, STATUS]), data=st.binary(max_size=8))
    def somebody_sends_noise(self, identifier: int, data: bytes) -> None:
        self.take(Frame(identifier, data, self.now_ns, extended=True), Frame(identifier, data, self.now_ns, error=True))
        if identifier != COMMAND:
            self.take(Frame(identifier, data, self.now_ns))

    @rule(counter=st.integers(0, 14))
    def the_status_comes(self, counter: int) -> None:
        self.take(self.status(counter))

    @precondition(lambda self: not self.alone)  # it is over with the first one
    @rule(counter=st.integers(0, 14))
    def somebody_else_commands(self, counter: int) -> None:
        self.take(LAYOUT.encode_command(CurrentCommand(counter, 0, 0.0, False)))
        assert self.reception.foreign_command

    @rule(duration_ns=st.sampled_from([1, MS // 2, MS, 3 * MS, 199 * MS]))
    def time_passes(self, duration_ns: int) -> None:
        self.now_ns += duration_ns

    @precondition(lambda self: not self.reception.too_many_rejected)
    @rule(bit=st.integers(0, 63), which=st.integers(0, 1))
    def one_good_frame_is_enough_after_a_bad_one(self, bit: int, which: int) -> None:
        self.take(*self.next_pair())
        self.take(*self.next_pair())
        errors = [w.errors.errors for w in self.reception.watched]
        pair = self.next_pair()
        word = int.from_bytes(pair[which].data, "little") ^ 1 << bit
        self.take(pair[which]._replace(data=word.to_bytes(8, "little")), pair[1 - which])
        assert len(self.take(*self.next_pair())) == 1
        after = [w.errors.errors for w in self.reception.watched]
        assert all(now <= then + 3 for now, then in zip(after, errors, strict=True))  # 4 for the bad one

    # --- what the loop does -----------------------------------------------------------------------------------------

    def send(self, answers: SensorSample, state: RunState = RunState.ACTIVE) -> bool:
        command = CurrentCommand(self.guard.next_counter, answers.counter, 0.5, enable=True)
        before = len(self.bus)
        try:
            self.guard.send(LAYOUT.encode_command(command), state, answers.receive_time_ns, self.now_ns)
        except GuardRejectedError:
            assert len(self.bus) == before
            return False
        assert len(self.bus) == before + 1
        return True

    @rule()
    def the_newest_sample_is_answered_if_that_is_permitted(self) -> None:
        if self.sample is not None and self.reception.permitted(self.now_ns) == "":
            self.send(self.sample)

    @precondition(lambda self: self.sample is not None)
    @rule()
    def the_guard_alone_refuses_an_answer_to_an_old_sample(self) -> None:
        assert self.sample is not None
        if self.now_ns - self.sample.receive_time_ns > LONGEST_NS:
            assert not self.send(self.sample)

    @precondition(lambda self: self.sample is not None)
    @rule(state=st.sampled_from([s for s in RunState if s not in (RunState.ACTIVE, RunState.HOMING)]))
    def the_guard_alone_refuses_a_current_where_none_may_be(self, state: RunState) -> None:
        assert self.sample is not None
        assert not self.send(self.sample, state)

    # --- what always holds ------------------------------------------------------------------------------------------

    @invariant()
    def nothing_enabled_was_sent_without_a_fresh_valid_pair_and_leave_of_every_message(self) -> None:
        for command, sent_ns in self.bus:
            pair = self.model.last
            assert pair is not None
            assert command.answers == pair.counter
            assert sent_ns - pair.receive_time_ns <= LONGEST_NS
            assert self.model.permitted(sent_ns)
        self.bus.clear()

    @invariant()
    def permission_and_counts_are_as_they_should_be(self) -> None:
        compare(self.reception, self.model)
        for later_ns in (0, MS, LONGEST_NS, LONGEST_NS + 1, 200 * MS):
            now_ns = self.now_ns + later_ns
            assert (self.reception.permitted(now_ns) == "") == self.model.permitted(now_ns)


ReceptionAndGuard.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestReceptionAndGuard = ReceptionAndGuard.TestCase
