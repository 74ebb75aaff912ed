"""What the watchdog process decides and sends, in injected time on a fake bus."""

from __future__ import annotations

import errno
import itertools
import os
import random
import struct
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.messages import Layout, StopReason, load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from emb_runtime.safety.heartbeat import Heartbeat
from emb_runtime.safety.watchdog_process import STOP_TRIES, LoopStatus, SilenceMonitor, Watchdog, stop_frames
from tests.independent import DATABASE, protected

MS = 1_000_000
HEARTBEAT = 5 * MS
INTERVAL = MS
START = 1_000 * MS
FRAMES = stop_frames(load_layout())


# --- the memory that loop and watchdog share -------------------------------------------------------------------------


@pytest.fixture
def heartbeat() -> Iterator[Heartbeat]:
    made = Heartbeat.create(0.005, START)
    yield made
    made.close()


def contents(heartbeat: Heartbeat) -> bytes:
    return os.pread(heartbeat.fd, 1 << 16, 0)


def test_what_one_side_says_the_other_reads(heartbeat: Heartbeat) -> None:
    other = Heartbeat(os.dup(heartbeat.fd))
    heartbeat.arm(START + 1)
    assert (other.armed, other.beat_ns) == (True, START + 1)
    heartbeat.beat(START + 2)
    assert other.beat_ns == START + 2
    heartbeat.disarm()
    assert not other.armed
    other.trip()
    assert heartbeat.tripped
    other.close()
    assert heartbeat.tripped


def test_every_pair_of_counters_arrives_as_it_was_published(heartbeat: Heartbeat) -> None:
    for pair in itertools.product(range(15), repeat=2):
        heartbeat.publish(*pair)
        assert heartbeat.last == pair


def test_nothing_that_the_loop_says_takes_a_trip_back(heartbeat: Heartbeat) -> None:
    heartbeat.trip()
    heartbeat.arm(START)
    heartbeat.beat(START + MS)
    heartbeat.publish(3, 4)
    heartbeat.disarm()
    heartbeat.arm(START)
    assert heartbeat.tripped


def test_each_word_has_one_writer_and_the_two_sides_share_no_cache_line(heartbeat: Heartbeat) -> None:
    def changed(before: bytes) -> set[int]:
        return {at // 64 for at, (a, b) in enumerate(zip(before, contents(heartbeat), strict=True)) if a != b}

    before = contents(heartbeat)
    heartbeat.arm(START + 1)
    heartbeat.beat(START + 2)
    heartbeat.publish(5, 6)
    loop_lines, before = changed(before), contents(heartbeat)
    heartbeat.trip()
    heartbeat.mark_alive(START + 3)
    assert loop_lines
    assert changed(before)
    assert loop_lines.isdisjoint(changed(before))


def test_the_watchdog_counts_as_lost_after_four_silent_heartbeats_and_not_before(heartbeat: Heartbeat) -> None:
    assert heartbeat.watched(START + 20 * MS - 1)
    assert not heartbeat.watched(START + 20 * MS)
    heartbeat.mark_alive(START + 1)
    assert heartbeat.watched(START + 20 * MS)
    assert not heartbeat.watched(START + 20 * MS + 1)


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1))
def test_whatever_the_memory_holds_the_counters_are_counters_and_only_a_clear_no_is_unarmed(
    armed: int, last: int
) -> None:
    heartbeat = Heartbeat.create(0.005, START)
    os.pwrite(heartbeat.fd, struct.pack("=QQQ", armed, 0, last), 64)
    assert all(0 <= counter <= 14 for counter in heartbeat.last)
    assert heartbeat.armed == (armed != 0)
    heartbeat.close()


@pytest.mark.parametrize("memory", [b"", bytes(4095), bytes(4096), bytes(8192)])
def test_memory_that_is_no_heartbeat_is_refused(memory: bytes) -> None:
    fd = os.memfd_create("test")
    os.write(fd, memory)
    with pytest.raises(ValueError, match="heartbeat"):
        Heartbeat(fd)


# --- the judgement of a silence -------------------------------------------------------------------------------------


def monitor() -> SilenceMonitor:
    return SilenceMonitor(HEARTBEAT, START)


def looks(watch: SilenceMonitor, *times_ns: int, beat_ns: int) -> LoopStatus:
    """The verdict at the last of these times; it was ALIVE at all others."""
    for time_ns in times_ns[:-1]:
        assert watch.look(time_ns, beat_ns, armed=True, gone=False) is LoopStatus.ALIVE
    return watch.look(times_ns[-1], beat_ns, armed=True, gone=False)


ON_SCHEDULE = [START + k * MS for k in range(1, 5)]


def test_a_silence_of_the_heartbeat_trips_and_one_nanosecond_less_does_not() -> None:
    assert looks(monitor(), *ON_SCHEDULE, START + HEARTBEAT - 1, beat_ns=START) is LoopStatus.ALIVE
    assert looks(monitor(), *ON_SCHEDULE, START + HEARTBEAT, beat_ns=START) is LoopStatus.STALLED


def test_whoever_is_not_armed_may_be_silent_and_is_judged_from_the_arming_on() -> None:
    watch = monitor()
    for k in range(1, 100):
        assert watch.look(START + k * MS, START, armed=False, gone=False) is LoopStatus.ALIVE
    last = START + 99 * MS
    # The beat that comes with the arming may be seen after it.
    silence = [last + k * MS for k in range(1, 5)]
    assert looks(watch, *silence, last + HEARTBEAT - 1, beat_ns=START) is LoopStatus.ALIVE
    assert looks(watch, last + HEARTBEAT, beat_ns=START) is LoopStatus.STALLED


def test_a_beat_from_the_future_is_none() -> None:
    assert monitor().look(START, START, armed=True, gone=False) is LoopStatus.ALIVE
    assert monitor().look(START, START + 1, armed=True, gone=False) is LoopStatus.STALLED


@pytest.mark.parametrize(("armed", "status"), [(True, LoopStatus.GONE), (False, LoopStatus.OVER)])
def test_a_loop_that_is_gone_was_to_be_watched_or_had_ended(armed: bool, status: LoopStatus) -> None:
    assert monitor().look(START, START, armed, gone=True) is status


def test_two_intervals_between_two_looks_are_on_schedule_and_more_is_stolen() -> None:
    two = START + 2 * MS
    assert looks(monitor(), two, two + 2 * MS, START + HEARTBEAT, beat_ns=START) is LoopStatus.STALLED
    assert looks(monitor(), two + 1, two + 2 * MS, START + HEARTBEAT, beat_ns=START) is LoopStatus.ALIVE


def test_what_was_stolen_is_not_held_against_the_loop_beyond_one_interval() -> None:
    beat = START + MS
    watch = monitor()
    # On schedule at 1 and 2 ms, then nothing until 6.5 ms: 3.5 of those 4.5 ms were stolen.
    assert looks(watch, beat, beat + MS, beat + 5 * MS + MS // 2, beat_ns=beat) is LoopStatus.ALIVE
    assert looks(watch, beat + 7 * MS, beat + 8 * MS + MS // 2 - 1, beat_ns=beat) is LoopStatus.ALIVE
    assert looks(watch, beat + 8 * MS + MS // 2, beat_ns=beat) is LoopStatus.STALLED


def test_a_theft_before_the_beat_excuses_nothing_after_it() -> None:
    watch = monitor()
    wake = START + 40 * MS
    beat = wake - MS // 2
    assert looks(watch, wake, beat_ns=beat) is LoopStatus.ALIVE  # half a millisecond of this silence was stolen
    rest = [wake + k * MS for k in range(1, 5)]
    assert looks(watch, *rest, beat + HEARTBEAT + MS // 2 - 1, beat_ns=beat) is LoopStatus.ALIVE
    assert looks(watch, beat + HEARTBEAT + MS // 2, beat_ns=beat) is LoopStatus.STALLED
    # The next beat starts with nothing excused.
    again = monitor()
    looks(again, wake, beat_ns=beat)
    later = wake + MS
    assert looks(again, later, *[later + k * MS for k in range(1, 5)], later + HEARTBEAT, beat_ns=later) is (
        LoopStatus.STALLED
    )


def test_no_theft_excuses_a_silence_of_two_heartbeats() -> None:
    assert looks(monitor(), START + 2 * HEARTBEAT - 1, beat_ns=START) is LoopStatus.ALIVE
    assert looks(monitor(), START + 2 * HEARTBEAT, beat_ns=START) is LoopStatus.STALLED
    # Not even where every single look is late.
    late = [START + k * 5 * MS // 2 for k in range(1, 4)]
    assert looks(monitor(), *late, START + 2 * HEARTBEAT, beat_ns=START) is LoopStatus.STALLED


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(1, 15 * MS), st.booleans()), min_size=1, max_size=60))
def test_it_trips_between_one_and_two_heartbeats_of_silence_and_on_schedule_after_one(
    steps: list[tuple[int, bool]],
) -> None:
    watch = monitor()
    now = beat = START
    on_schedule = True  # since the last beat
    for gap, beats in steps:
        now += gap
        on_schedule = (on_schedule or beats) and gap <= 2 * INTERVAL
        if beats:
            beat = now - min(gap, MS // 3)
        silence = now - beat
        status = watch.look(now, beat, armed=True, gone=False)
        if silence < HEARTBEAT:
            assert status is LoopStatus.ALIVE
        elif on_schedule or silence >= 2 * HEARTBEAT:
            assert status is LoopStatus.STALLED
        if status is LoopStatus.STALLED:
            return


# --- all that can leave ---------------------------------------------------------------------------------------------


def test_each_frame_is_disabled_without_current_and_names_its_counters() -> None:
    message = DATABASE.get_message_by_name("EMB_Command")
    assert [len(row) for row in FRAMES] == [15] * 15
    for counter, row in enumerate(FRAMES):
        for answers, frame in enumerate(row):
            assert (frame.identifier, frame.extended, frame.remote) == (message.frame_id, False, False)
            values = message.decode(frame.data, decode_choices=False)
            assert (values["Enable"], values["Current"]) == (0, 0.0)
            assert (values["Counter"], values["Answers"]) == (counter, answers)
            assert frame.data == protected(message.frame_id, frame.data[1:])


class Rig:
    """A vigil in simulated time. ``script`` has what happens at which time; the loop is gone at ``gone_ns``."""

    def __init__(self) -> None:
        self.clock = SteppedClock(START)
        self.heartbeat = Heartbeat.create(HEARTBEAT * 1e-9, START)
        self.gone_ns = START + 10_000 * MS
        self.script: dict[int, Callable[[], None]] = {}
        self.late_ns: dict[int, int] = {}
        self.sent: list[tuple[int, Frame]] = []
        self.happened: list[str] = []
        self.refuse: Callable[[], None] = lambda: None
        self.watchdog = Watchdog(
            heartbeat=self.heartbeat,
            frames=FRAMES,
            period_ns=MS,
            clock=self.clock,
            send=self.send,
            silence_loop=self.silence_loop,
            wait=self.wait,
        )

    def send(self, frame: Frame) -> None:
        self.happened.append(f"send, tripped {self.heartbeat.tripped}")
        self.refuse()
        self.sent.append((self.clock.now_ns(), frame))

    def silence_loop(self) -> None:
        self.happened.append("silence the loop")

    def wait(self, until_ns: int) -> bool:
        for time_ns in sorted(self.script):
            if time_ns <= until_ns:
                self.script.pop(time_ns)()
        self.clock.advance_to(min(until_ns + self.late_ns.pop(until_ns, 0), max(self.gone_ns, self.clock.now_ns())))
        return self.clock.now_ns() >= self.gone_ns


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.heartbeat.close()


def test_a_stall_sends_three_stop_frames_one_per_period_that_continue_the_count(rig: Rig, layout: Layout) -> None:
    rig.heartbeat.arm(START)
    rig.heartbeat.publish(13, 6)
    report = rig.watchdog.run()
    assert [time_ns - START for time_ns, _ in rig.sent] == [5 * MS, 6 * MS, 7 * MS]
    assert [layout.decode_command(frame) for _, frame in rig.sent] == [
        CurrentCommand(counter, 6, 0.0, False) for counter in (14, 0, 1)
    ]
    assert report == {
        "tripped": "stalled", "time_ns": START + 5 * MS, "silence_ns": 5 * MS, "frames": 3, "lateness_ns": 0,
        "error": "",
    }  # fmt: skip


def test_the_permission_is_gone_before_the_first_stop_frame_and_the_socket_right_after_it(rig: Rig) -> None:
    rig.heartbeat.arm(START)
    rig.watchdog.run()
    assert rig.happened == ["send, tripped True", "silence the loop", "send, tripped True", "send, tripped True"]


def test_it_stays_until_the_loop_is_gone_and_says_nothing_more(rig: Rig) -> None:
    rig.heartbeat.arm(START)
    rig.script[START + 500 * MS] = lambda: rig.heartbeat.beat(START + 500 * MS)
    rig.watchdog.run()
    assert rig.clock.now_ns() == rig.gone_ns
    assert len(rig.sent) == 3
    assert rig.heartbeat.tripped


@pytest.mark.parametrize("armed", [True, False])
def test_a_loop_that_is_gone_is_stopped_for_at_once_if_it_was_armed(rig: Rig, armed: bool) -> None:
    rig.gone_ns = START + 3 * MS + 400_000
    if armed:
        rig.script[START + MS] = lambda: rig.heartbeat.arm(START + MS)
    report = rig.watchdog.run()
    assert report["tripped"] == ("gone" if armed else "")
    assert [time_ns - rig.gone_ns for time_ns, _ in rig.sent] == ([0, MS, 2 * MS] if armed else [])
    assert rig.heartbeat.tripped == armed


def test_it_looks_on_an_absolute_grid_and_gives_signs_of_life(rig: Rig) -> None:
    rig.gone_ns = START + 60 * MS
    rig.late_ns = {START + 3 * MS: 300_000, START + 10 * MS: 7 * MS + 200_000}
    signs: list[int] = []
    mark_alive = rig.heartbeat.mark_alive

    def record(now_ns: int) -> None:
        signs.append(now_ns - START)
        mark_alive(now_ns)

    rig.heartbeat.mark_alive = record  # type: ignore[method-assign]
    report = rig.watchdog.run()
    expected = [k * MS for k in range(1, 61) if not 11 <= k <= 17]
    expected[2] += 300_000
    expected[9] += 7 * MS + 200_000
    assert signs == expected
    assert report["lateness_ns"] == 7 * MS + 200_000


def test_a_full_transmit_queue_is_tried_again_in_the_next_period_with_the_next_counter(
    rig: Rig, layout: Layout
) -> None:
    refusals = iter(range(4))

    def full() -> None:
        if next(refusals, None) is not None:
            raise TransmitQueueFullError("full")

    rig.refuse = full
    rig.heartbeat.arm(START)
    report = rig.watchdog.run()
    assert [layout.decode_command(frame).counter for _, frame in rig.sent] == [4, 5, 6]
    assert [time_ns - START for time_ns, _ in rig.sent] == [9 * MS, 10 * MS, 11 * MS]
    assert (report["frames"], report["error"]) == (3, "full")


@pytest.mark.parametrize("error", [BusError, RuntimeError])
def test_a_dead_bus_is_given_up_and_told(rig: Rig, error: type[Exception]) -> None:
    def dead() -> None:
        raise error("the interface is down")

    rig.refuse = dead
    rig.heartbeat.arm(START)
    report = rig.watchdog.run()
    assert rig.happened.count("send, tripped True") == STOP_TRIES
    assert (report["tripped"], report["frames"], report["error"]) == ("stalled", 0, "the interface is down")


def test_a_socket_that_cannot_be_taken_away_is_told_and_keeps_no_stop_frame_back(rig: Rig) -> None:
    def refuse() -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    rig.watchdog.silence_loop = refuse
    rig.heartbeat.arm(START)
    report = rig.watchdog.run()
    assert (report["frames"], report["error"]) == (3, "the loop's socket keeps its bus: Invalid argument")


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32))
def test_whatever_the_shared_memory_holds_only_stop_frames_leave(seed: int) -> None:
    random_ = random.Random(seed)
    message = DATABASE.get_message_by_name("EMB_Command")
    rig = Rig()

    def damage() -> None:  # all but the head, which is read once, at the start
        words = [random_.choice([0, 1, random_.getrandbits(64), random_.getrandbits(40)]) for _ in range(510)]
        words[6] |= 1  # armed
        os.pwrite(rig.heartbeat.fd, struct.pack("=510Q", *words), 16)

    rig.gone_ns = START + 30 * MS
    rig.script = dict.fromkeys(range(START, START + 40 * MS, MS // 2), damage)
    rig.watchdog.run()
    rig.heartbeat.close()
    assert len(rig.sent) == 3
    for _, frame in rig.sent:
        values = message.decode(frame.data, decode_choices=False)
        assert (frame.identifier, values["Enable"], values["Current"]) == (message.frame_id, 0, 0.0)


# --- what the node makes of it --------------------------------------------------------------------------------------


class Race:
    """A node that obeys, and a loop that was stopped between the guard's question and the socket."""

    def __init__(self, bench: Bench, layout: Layout) -> None:
        self.layout = layout
        self.node = BrakeNode(bench, layout, bench.brake, lambda: (0.0, 0.0, 0.0))
        self.newest = -1
        self.period()
        for counter in range(20):
            self.node.receive(self.enabled(counter % 15, self.newest))
            self.period()
        assert self.node.state is NodeState.ACTIVE
        self.obeyed = self.node.obeyed
        self.in_flight = self.enabled(5, self.newest)  # the next command

    def enabled(self, counter: int, answers: int) -> Frame:
        return self.layout.encode_command(counter, answers, 1.0, True)

    def period(self) -> None:
        self.newest = self.layout.decode_angle(self.node.tick()[0]).counter

    def stop_frames(self, published: int) -> list[Frame]:
        return [FRAMES[(published + k) % 15][3] for k in (1, 2, 3)]

    def latched(self) -> bool:
        return self.node.state is NodeState.STOPPING and self.node.stop_reason is StopReason.DISABLED


@pytest.mark.parametrize("published", [4, 5], ids=["the same counter", "the next counter"])
@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_a_command_that_leaves_after_the_trip_is_not_obeyed(
    bench: Bench, layout: Layout, published: int, after: int
) -> None:
    race = Race(bench, layout)
    for _ in range(5):  # the silence
        race.period()
    frames = race.stop_frames(published)
    for frame in [*frames[:after], race.in_flight, *frames[after:]]:
        race.node.receive(frame)
        race.period()
    assert race.latched()
    assert race.node.obeyed == race.obeyed


@pytest.mark.parametrize("published", [4, 5], ids=["the same counter", "the next counter"])
def test_where_the_node_stood_still_as_well_the_next_period_s_stop_frame_latches(
    bench: Bench, layout: Layout, published: int
) -> None:
    race = Race(bench, layout)  # its newest sample is still the one that the command answers
    first, second, _ = race.stop_frames(published)
    race.node.receive(first)
    race.node.receive(race.in_flight)
    race.period()
    assert race.node.obeyed <= race.obeyed + 1
    race.node.receive(second)
    race.period()
    assert race.latched()
    assert race.node.obeyed <= race.obeyed + 1
