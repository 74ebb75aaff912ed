"""Reception: pairs are made of valid, fresh, plausible frames, and nothing else moves it."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.bench import Bench, load_bench
from emb_runtime.frames import Layout, StopReason, load_layout
from emb_runtime.reception import Reception
from emb_runtime.records import CurrentCommand, Frame, NodeState, SensorSample

MS = 1_000_000
IDLE = NodeState.IDLE


class Node:
    """A well-behaved source of sensor frames: constant velocity from the origin."""

    def __init__(self, layout: Layout, velocity: float = 100.0) -> None:
        self.layout = layout
        self.velocity = velocity
        self.count = 0

    def pair(self, angle_error: float = 0.0, time_error_ns: int = 0) -> tuple[Frame, Frame]:
        counter, time_ns = self.count % 15, self.count * MS
        angle = self.velocity * self.count * 1e-3 + angle_error
        self.count += 1
        stamp_ns = 5_000 * MS + time_ns
        return (
            self.layout.encode_angle(counter, angle, time_ns + time_error_ns)._replace(time_ns=stamp_ns),
            self.layout.encode_velocity(counter, self.velocity, 0.0, IDLE, 15)._replace(time_ns=stamp_ns),
        )


class Harness:
    def __init__(self, bench: Bench, layout: Layout) -> None:
        self.why: list[str] = []
        self.reception = Reception(layout, bench, lambda _frame, why: self.why.append(why))

    def take(self, *frames: Frame) -> list[SensorSample]:
        return [sample for frame in frames if (sample := self.reception.take(frame)) is not None]


@pytest.fixture
def node(layout: Layout) -> Node:
    return Node(layout)


@pytest.fixture
def harness(bench: Bench, layout: Layout) -> Harness:
    return Harness(bench, layout)


def test_two_frames_of_one_counter_make_a_sample(node: Node, harness: Harness) -> None:
    node.pair()
    (sample,) = harness.take(*node.pair())
    assert sample.counter == 1
    assert sample.angle == pytest.approx(0.1, abs=1e-5)
    assert sample.velocity == pytest.approx(100.0, abs=5e-5)
    assert sample.device_time_ns == 1 * MS
    assert sample.receive_time_ns == 5_001 * MS
    assert harness.why == []


def test_device_time_does_not_wrap_for_the_reader(node: Node, harness: Harness) -> None:
    node.velocity = 0.0
    samples = [s for _ in range(9_000) for s in harness.take(*node.pair())]  # the stamp wraps every 4.194 s
    assert len(samples) == 9_000
    assert {b.device_time_ns - a.device_time_ns for a, b in pairwise(samples)} == {1 * MS}


def test_a_velocity_frame_without_its_angle_makes_no_sample(node: Node, harness: Harness) -> None:
    first, second, third = node.pair(), node.pair(), node.pair()
    assert len(harness.take(*first, second[1], *third)) == 2
    assert len(harness.take(third[0])) == 0


def test_a_repeated_pair_makes_no_second_sample(node: Node, harness: Harness) -> None:
    pair = node.pair()
    assert len(harness.take(*pair, *pair)) == 1
    assert harness.reception.rejected == 2


def test_frames_of_two_pairs_are_never_mixed(node: Node, harness: Harness) -> None:
    first, second = node.pair(), node.pair()
    assert harness.take(first[0], second[1]) == []


@pytest.mark.parametrize("which", [0, 1])
def test_a_damaged_frame_makes_no_sample_and_does_not_move_the_counter(
    node: Node, harness: Harness, which: int
) -> None:
    harness.take(*node.pair())
    pair = list(node.pair())
    data = bytearray(pair[which].data)
    data[3] ^= 0x10
    good = pair[which]
    pair[which] = good._replace(data=bytes(data))
    assert harness.take(*pair) == []
    assert "CRC" in harness.why[0]
    # The counter of the damaged frame was not believed, so the true frame still counts as the next one.
    pair[which] = good
    assert harness.reception.take(good) is None or which == 1
    assert not harness.reception.too_many_rejected


def test_an_angle_that_jumps_is_not_believed_until_the_brake_can_have_got_there(node: Node, harness: Harness) -> None:
    harness.take(*node.pair())
    assert harness.take(*node.pair(angle_error=0.2)) == []
    assert "does not follow" in harness.why[0]
    assert len(harness.take(*node.pair())) == 1


def test_a_device_time_that_stands_still_or_runs_back_is_not_believed(node: Node, harness: Harness) -> None:
    harness.take(*node.pair())
    for error_ms in (-1, -3):
        assert harness.take(*node.pair(time_error_ns=error_ms * MS)) == []
        assert "device time" in harness.why[-1]


def test_rejections_add_up_and_good_frames_forgive_them(node: Node, harness: Harness, bench: Bench) -> None:
    harness.take(*node.pair())
    for _ in range(bench.watch.rejected - 1):
        harness.take(*node.pair(angle_error=1.0))
    assert not harness.reception.too_many_rejected
    for _ in range(3 * bench.watch.rejected):
        harness.take(*node.pair(angle_error=1.0))
        harness.take(*node.pair())
        assert not harness.reception.too_many_rejected
    for _ in range(2):
        harness.take(*node.pair(angle_error=1.0))
    assert harness.reception.too_many_rejected


def test_somebody_elses_command_is_noticed_and_our_own_echo_is_not(harness: Harness, layout: Layout) -> None:
    frame = layout.encode_command(CurrentCommand(0, 0, 1.0, True))
    harness.take(frame._replace(own=True))
    assert not harness.reception.foreign_command
    harness.take(frame)
    assert harness.reception.foreign_command


def test_the_latest_status_is_kept(harness: Harness, layout: Layout) -> None:
    harness.take(layout.encode_status(3, NodeState.STOPPING, StopReason.WATCHDOG, 7, 0x1234))
    assert harness.reception.status is not None
    assert harness.reception.status.stop_reason is StopReason.WATCHDOG


def test_frames_of_others_and_error_frames_change_nothing(node: Node, harness: Harness) -> None:
    angle, velocity = node.pair()
    others = [Frame(0x123, b"12345678"), angle._replace(extended=True), velocity._replace(error=True)]
    assert harness.take(*others) == []
    assert harness.reception.rejected == 0
    assert len(harness.take(angle, velocity)) == 1


@given(st.lists(st.tuples(st.sampled_from([0x80, 0x100, 0x101, 0x102, 0x55]), st.binary(max_size=8)), max_size=30))
def test_random_frames_never_make_a_sample_or_raise(content: list[tuple[int, bytes]]) -> None:
    layout = load_layout()
    harness = Harness(load_bench(), layout)
    valid = {layout.decode_any(Frame(i, d)) is not None for i, d in content}
    samples = harness.take(*(Frame(i, d) for i, d in content))
    assert not samples or True in valid


@given(st.data())
def test_whatever_is_lost_doubled_or_swapped_every_sample_is_a_true_pair_in_order(data: st.DataObject) -> None:
    node = Node(load_layout(), velocity=0.0)
    frames = [frame for _ in range(40) for frame in node.pair()]
    kept = [f for f in frames for _ in range(data.draw(st.sampled_from([0, 1, 1, 1, 2])))]
    for _ in range(data.draw(st.integers(0, 6))):
        i = data.draw(st.integers(0, max(0, len(kept) - 2)))
        kept[i : i + 2] = reversed(kept[i : i + 2])
    samples = Harness(load_bench(), node.layout).take(*kept)
    times = [s.device_time_ns for s in samples]
    assert times == sorted(set(times))
    assert all(s.counter == s.device_time_ns // MS % 15 for s in samples)
