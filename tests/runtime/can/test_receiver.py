"""Reception: pairs are made of valid, fresh, plausible frames, and nothing else moves it.

Samples, leaky counts and the permission of any sequence of frames are those of an account that is written anew
(tests/fuzz/model.py). Status frames are too rare there for their own count to reach its bound: here each message's
does. Besides: what is told of them, and the borders.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.codec import Fault
from emb_runtime.can.messages import Layout, StopReason
from emb_runtime.can.receiver import BUS_OFF, UNKNOWN, WITHOUT_DETAILS, Reception, Rejection, Trapezium, classify
from emb_runtime.config.bench import Bench, Sensors
from emb_runtime.records import Frame, NodeState, SensorSample

MS = 1_000_000
IDLE = NodeState.IDLE
START_MS = 5_000  # When the first pair arrives
ANGLE, VELOCITY, STATUS, COMMAND = 0x100, 0x101, 0x102, 0x080


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
        stamp_ns = START_MS * MS + time_ns
        return (
            self.layout.encode_angle(counter, angle, time_ns + time_error_ns)._replace(time_ns=stamp_ns),
            self.layout.encode_velocity(counter, self.velocity, 0.0, IDLE, 15)._replace(time_ns=stamp_ns),
        )

    def status(self, counter: int = 0) -> Frame:
        """As of the last pair."""
        frame = self.layout.encode_status(counter, IDLE, StopReason.NONE, 0, 0)
        return frame._replace(time_ns=(START_MS + self.count - 1) * MS)


class Harness:
    def __init__(self, bench: Bench, layout: Layout) -> None:
        self.why: list[str] = []
        self.reception = Reception(layout, bench, lambda _frame, why: self.why.append(why))

    def take(self, *frames: Frame) -> list[SensorSample]:
        return [sample for frame in frames if (sample := self.reception.add_frame(frame)) is not None]


@pytest.fixture
def node(layout: Layout) -> Node:
    return Node(layout)


@pytest.fixture
def harness(bench: Bench, layout: Layout) -> Harness:
    return Harness(bench, layout)


def test_a_node_that_sends_the_velocity_first_is_told_what_its_frames_lack(node: Node, harness: Harness) -> None:
    assert harness.reception.pairing_problem == ""
    first = node.pair()
    harness.take(first[1])
    assert harness.reception.pairing_problem == ""
    harness.take(first[0])
    assert "that goes first" in harness.reception.pairing_problem
    for _ in range(5):
        angle, velocity = node.pair()
        assert harness.take(velocity, angle) == []
    assert "that goes first" in harness.reception.pairing_problem
    harness.take(*node.pair())
    assert harness.reception.pairing_problem == ""


# --- who sent it ----------------------------------------------------------------------------------------------------


def test_whoever_else_uses_our_identifier_is_noticed_and_our_own_echo_is_not(bench: Bench, layout: Layout) -> None:
    own = layout.encode_command(0, 0, 1.0, True)._replace(time_ns=7 * MS, own=True)
    for frame, foreign in [
        (own, False),
        (own._replace(own=False), True),  # the very bits, at the very time
        (own._replace(own=False, data=bytes(8)), True),  # not even valid
        (own._replace(own=False, data=b"", remote=True), True),
        (own._replace(own=False, extended=True), False),  # another identifier: 29 bits
        (own._replace(own=False, error=True), False),  # the kernel's word for a bus error: 0x080 as well
    ]:
        harness = Harness(bench, layout)
        harness.take(own, frame)
        assert harness.reception.foreign_command == foreign, frame
        assert harness.reception.rejected == 0


def test_error_frames_are_counted_by_what_they_report(harness: Harness) -> None:
    harness.take(Frame(0x044, b"\0\x20\0\0\0\0\0\0", error=True), Frame(0x101, bytes(8), error=True))
    reported = harness.reception.bus_errors
    assert reported == dict.fromkeys(
        ["bus-off", "error passive by transmit errors", "transmission timed out", "controller restarted"], 1
    )


def test_the_kernel_s_count_of_dropped_frames_never_falls(harness: Harness) -> None:
    for dropped in (0, 3, 2, 7):
        harness.take(Frame(0x123, b"", dropped=dropped))
    assert harness.reception.dropped == 7


def test_the_charge_valid_or_damaged_repeated_or_silent_changes_nothing(bench: Bench, layout: Layout) -> None:
    harness, charge = Harness(bench, layout), layout.encode_charge(3, 1.25)
    before = harness.reception.inhibit_reason(0)
    for frame in (charge, charge, charge._replace(data=bytes(7)), charge._replace(data=b"")):
        assert harness.take(frame) == []
    assert harness.reception.rejected == 0
    assert not harness.reception.foreign_command
    assert harness.reception.inhibit_reason(0) == before


def test_the_latest_status_is_kept_and_a_repeated_counter_is_none(harness: Harness, layout: Layout) -> None:
    harness.take(layout.encode_status(3, NodeState.STOPPING, StopReason.WATCHDOG, 7, 0x1234))
    harness.take(layout.encode_status(3, NodeState.IDLE, StopReason.NONE, 8, 0x1234))
    assert harness.reception.status is not None
    assert harness.reception.status.stop_reason is StopReason.WATCHDOG
    assert harness.reception.rejections() == {"EMB_Status": {Rejection.REPEATED: 1}}


@pytest.mark.parametrize("declared", [Sensors("observer", 800.0), Sensors("observer", velocity_lag=9e-4 / 0.8)])
def test_a_velocity_may_lag_as_the_bench_declares_and_no_more(bench: Bench, declared: Sensors) -> None:
    """Of the strongest brake at full current, which a critically damped observer shows 2/ω late."""
    strongest = bench.range_set(bench.shield.ranges)
    acceleration = strongest.high.k_m * bench.limits.current / strongest.low.J

    def follows(sensors: Sensors, late: float) -> bool:
        def sample(at: float) -> SensorSample:
            angle, shown = 0.5 * acceleration * at**2, acceleration * (at - late)
            return SensorSample(0, angle, shown, round(at * 1e9), 0, 0.0, 0, IDLE)

        return Trapezium(replace(bench, sensors=sensors)).follows(sample(0.006), sample(0.007), 1e-3)

    assert follows(Sensors(), 0.0)
    assert not follows(Sensors(), 2.0 / 800.0)
    assert follows(declared, 0.0)
    assert follows(declared, 2.0 / 800.0)
    assert not follows(declared, 5.0 / 800.0)


def test_rejections_are_counted_by_message_and_reason(node: Node, harness: Harness) -> None:
    angle, velocity = node.pair()
    harness.take(
        angle._replace(data=angle.data[:5]),
        velocity._replace(remote=True, data=b""),
        angle._replace(data=bytes(8)),
        velocity._replace(data=bytes(8)),
        *(angle, velocity),
        *(angle, velocity),
        *node.pair(angle_error=0.2),
        *node.pair(time_error_ns=-3 * MS),
        *node.pair(time_error_ns=-3 * MS),  # it has stood still since the first
    )
    assert harness.reception.rejections() == {
        "EMB_Angle": {Fault.LENGTH: 1, Fault.CRC: 1, Rejection.REPEATED: 1},
        "EMB_Velocity": {Fault.KIND: 1, Fault.CRC: 1, Rejection.REPEATED: 1},
        "pair": {Rejection.IMPLAUSIBLE: 1, Rejection.TIME: 2},
    }
    assert harness.reception.rejected == 9 == len(harness.why)
    assert "does not follow" in harness.why[6]
    assert "device time" in harness.why[7]
    assert "device time" in harness.why[8]
    assert len(harness.take(*node.pair())) == 1  # the brake can have got there


@pytest.mark.parametrize(("apart_ns", "samples"), [(-2 * MS - 1, 0), (-2 * MS, 1), (2 * MS, 1), (2 * MS + 1, 0)])
def test_the_frames_of_a_pair_come_within_two_periods(
    node: Node, harness: Harness, apart_ns: int, samples: int
) -> None:
    angle, velocity = node.pair()
    velocity = velocity._replace(time_ns=angle.time_ns + apart_ns)
    arrivals = [s.receive_time_ns for s in harness.take(angle, velocity)]
    assert arrivals == [max(angle.time_ns, velocity.time_ns)] * samples


# --- permission -----------------------------------------------------------------------------------------------------


def permitted_until(harness: Harness, end_ns: int, why: str) -> None:
    assert harness.reception.inhibit_reason(end_ns) == ""
    assert why in harness.reception.inhibit_reason(end_ns + 1)


def test_no_current_is_permitted_before_every_message_has_come(node: Node, harness: Harness) -> None:
    now_ns = START_MS * MS
    assert "EMB_Angle has not come" in harness.reception.inhibit_reason(now_ns)
    angle, velocity = node.pair()
    harness.take(angle)
    assert "EMB_Velocity has not come" in harness.reception.inhibit_reason(now_ns)
    harness.take(velocity)
    assert "EMB_Status has not come" in harness.reception.inhibit_reason(now_ns)
    harness.take(node.status())
    assert harness.reception.inhibit_reason(now_ns) == ""


@pytest.mark.parametrize(("identifier", "name"), [(ANGLE, "EMB_Angle"), (VELOCITY, "EMB_Velocity"), (STATUS, "EMB_S")])
@pytest.mark.parametrize("damaged", [False, True])
def test_the_loss_of_any_message_removes_permission_after_two_of_its_periods_until_it_is_back(
    node: Node, harness: Harness, identifier: int, name: str, damaged: bool
) -> None:
    def arrive(lose: bool) -> None:
        frames = [*node.pair(), *([node.status(node.count // 100 % 15)] if node.count % 100 == 1 else [])]
        for frame in frames:
            if not lose or frame.identifier != identifier:
                harness.take(frame)
            elif damaged and harness.reception.rejected < 2:
                harness.take(frame._replace(data=frame.data[:7] + bytes([frame.data[7] ^ 0x40])))

    for _ in range(101):
        arrive(lose=False)
    last_ns = (START_MS + 100) * MS
    end_ns = last_ns + (200 if identifier == STATUS else 2) * MS
    assert harness.reception.inhibit_reason(last_ns) == ""
    while (now_ns := (START_MS + node.count) * MS) <= end_ns:
        arrive(lose=True)
        assert harness.reception.inhibit_reason(now_ns) == ""
    permitted_until(harness, end_ns, name)
    while node.count % 100 != 1:
        arrive(lose=True)
    arrive(lose=False)
    while node.count % 100 != 1:
        arrive(lose=False)
    arrive(lose=False)
    assert harness.reception.inhibit_reason((START_MS + node.count - 1) * MS) == ""


def test_pairs_that_are_not_believed_remove_permission_as_if_they_had_not_come(node: Node, harness: Harness) -> None:
    harness.take(*node.pair(), node.status())
    last_ns = START_MS * MS
    for _ in range(3):
        harness.take(*node.pair(angle_error=5.0))
    permitted_until(harness, last_ns + 2 * MS, "pair is overdue")


def test_a_repeated_status_does_not_renew_permission(node: Node, harness: Harness) -> None:
    harness.take(*node.pair(), node.status())
    for _ in range(201):
        harness.take(*node.pair())
    harness.take(node.status())  # the first one again, as a gateway that hangs would send it
    assert "EMB_Status is overdue: the last valid one is 201.000 ms old" in harness.reception.inhibit_reason(
        (START_MS + 201) * MS
    )


def test_a_stamp_ahead_of_now_by_more_than_a_period_permits_nothing(node: Node, harness: Harness) -> None:
    harness.take(*node.pair(), node.status())
    assert harness.reception.inhibit_reason((START_MS - 1) * MS) == ""
    assert "ahead of now" in harness.reception.inhibit_reason((START_MS - 1) * MS - 1)


@pytest.mark.parametrize("identifier", [COMMAND, ANGLE, VELOCITY, STATUS])
def test_a_second_commander_or_too_many_rejections_remove_permission(
    node: Node, harness: Harness, bench: Bench, identifier: int
) -> None:
    bad = Frame(identifier, bytes(5 if identifier == COMMAND else 8))
    count, why = (1, "somebody else") if identifier == COMMAND else (bench.watch.rejected, "too many")
    harness.take(*node.pair(), node.status(), *[bad] * (count - 1))
    assert harness.reception.inhibit_reason(START_MS * MS) == ""
    harness.take(bad)
    assert why in harness.reception.inhibit_reason(START_MS * MS)


# --- error frames, as <linux/can/error.h> says ----------------------------------------------------------------------


def reported(identifier: int, payload: str = "00 00 00 00 00 00 00 00") -> set[str]:
    return set(classify(Frame(identifier, bytes.fromhex(payload), error=True)))


def test_each_kind_is_read_from_its_bit() -> None:
    for identifier, payload, kinds in [
        (0x001, "00 00 00 00 00 00 00 00", {"transmission timed out"}),
        (0x002, "0c 00 00 00 00 00 00 00", {"arbitration lost"}),  # lost at bit 12
        (0x004, "00 00 00 00 00 00 00 00", {WITHOUT_DETAILS}),
        (0x004, "00 01 00 00 00 00 00 00", {"controller's receive buffer overflowed"}),
        (0x004, "00 02 00 00 00 00 00 00", {"controller's transmit buffer overflowed"}),
        (0x004, "00 04 00 00 00 00 00 00", {"many receive errors (warning level)"}),
        (0x004, "00 08 00 00 00 00 00 00", {"many transmit errors (warning level)"}),
        (0x004, "00 10 00 00 00 00 00 00", {"error passive by receive errors"}),
        (0x004, "00 20 00 00 00 00 00 00", {"error passive by transmit errors"}),
        (0x004, "00 40 00 00 00 00 00 00", {"error active again"}),
        (0x008, "00 00 04 03 00 00 00 00", {"protocol violation"}),  # bit stuffing, at the start of the frame
        (0x010, "00 00 00 00 04 00 00 00", {"transceiver problem"}),  # CAN_H has no wire
        (0x020, "00 00 00 00 00 00 00 00", {"no acknowledgement"}),
        (0x040, "00 00 00 00 00 00 00 00", {BUS_OFF}),
        (0x080, "00 00 00 00 00 00 00 00", {"bus error"}),
        (0x100, "00 00 00 00 00 00 00 00", {"controller restarted"}),
        (0x200, "00 00 00 00 00 00 07 09", set()),  # the error counters, and nothing wrong
        (0x400, "00 00 00 00 00 00 00 00", {UNKNOWN}),
        # What sja1000 says when nobody acknowledges: a bus error in the acknowledge slot, 128 and 0 errors so far.
        (0x28C, "00 20 80 19 00 00 80 00", {"error passive by transmit errors", "protocol violation", "bus error"}),
    ]:
        assert reported(identifier, payload) == kinds, hex(identifier)


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_any_error_frame_reports_each_of_its_bits_once(identifier: int, data: bytes) -> None:
    kinds = classify(Frame(identifier, data, error=True))
    assert len(set(kinds)) == len(kinds)
    assert kinds or identifier & 0x200
    assert (BUS_OFF in kinds) == bool(identifier & 0x40)
