"""The process of the software node: what passes between loop, watchdog and drive, and what outlives whom."""

from __future__ import annotations

import socket
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import parse_bench
from emb_runtime.drives.link import Kind, link_pair, pack_document, pack_frame, read_packets, unpack
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.node import DriveNode, Phase
from emb_runtime.drives.node_process import NodeServer
from emb_runtime.drives.transport import ProcessDrive, open_mapped
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from emb_runtime.system.clock import MonotonicClock, SteppedClock
from tests.drives import EXAMPLES
from tests.runtime.drives.mapped import late_bench

MS = 1_000_000
LAYOUT = load_layout()


class Bus:
    """A bus on which a test is the drive."""

    name, truth, obtained = "bus", None, dict[str, str]()

    def __init__(self) -> None:
        self.waiting: deque[Frame] = deque()
        self.sent: list[Frame] = []

    def send(self, frame: Frame) -> None:
        self.sent.append(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        del deadline_ns
        return self.waiting.popleft() if self.waiting else None

    def close(self) -> None:
        pass


class Played:
    """A server of an ODrive, its loop, its watchdog and its drive, step by step."""

    def __init__(self) -> None:
        self.clock = SteppedClock(1_000 * MS)
        self.bus = Bus()
        self.loop, loop = link_pair()
        self.watchdog, watchdog = link_pair()
        self.ends = [self.loop, self.watchdog, loop, watchdog]
        mapping, bench = load_mapping(EXAMPLES / "odrive.toml"), parse_bench(late_bench(), "bench.toml")
        self.server = NodeServer(mapping, bench, self.bus, self.clock, loop, watchdog)
        self.state = 1
        self.counter = 0

    def sample(self, position: float = 0.0, velocity: float = 0.0) -> list[Frame]:
        """One period with a sample; our frames that the loop gets."""
        self.clock.advance_to(self.clock.now_ns() + MS)
        now_ns = self.clock.now_ns()
        self.bus.waiting += [
            Frame(0x001, struct.pack("<IB3x", 0, self.state), now_ns),
            Frame(0x009, struct.pack("<ff", position, velocity), now_ns),
            Frame(0x014, struct.pack("<ff", 0.0, 0.0), now_ns),
        ]
        self.server.step()
        return self.heard(Kind.OURS)

    def heard(self, wanted: Kind) -> list[Frame]:
        contents = [unpack(packet) for packet in read_packets(self.loop)[0]]
        return [content for kind, content in contents if kind is wanted and isinstance(content, Frame)]

    def command(self, end: socket.socket, answers: int, current: float, enable: bool = True) -> None:
        frame = LAYOUT.encode_command(CurrentCommand(self.counter, answers, current, enable))
        self.counter = (self.counter + 1) % 15
        end.send(pack_frame(frame, Kind.OURS))
        self.server.step()

    def arm(self) -> None:
        self.sample()
        self.loop.send(pack_document({"do": "arm", "zero": False}))
        self.server.step()
        self.must_be(Phase.ARMING)
        self.state = 8
        self.sample()
        self.must_be(Phase.READY)

    def must_be(self, phase: Phase) -> None:
        assert self.server.node.phase is phase

    @property
    def torques(self) -> list[float]:
        return [struct.unpack("<f", frame.data)[0] for frame in self.bus.sent if frame.identifier == 0x00E]

    @property
    def asked_states(self) -> list[int]:
        return [frame.data[0] for frame in self.bus.sent if frame.identifier == 0x007]


@pytest.fixture
def played() -> Iterator[Played]:
    it = Played()
    yield it
    for end in it.ends:
        end.close()


def test_while_it_is_armed_the_drive_s_time_out_is_fed_with_0_a(played: Played) -> None:
    played.sample()
    played.loop.send(pack_document({"do": "arm", "zero": False}))
    played.server.step()
    for number in range(1, 30):
        played.sample()
        assert played.torques == [0.0] * number
    played.must_be(Phase.ARMING)


def newest(frames: list[Frame]) -> int:
    return LAYOUT.decode_angle(next(f for f in frames if f.identifier == LAYOUT.angle.identifier)).counter


def test_a_command_in_time_becomes_a_torque_and_the_next_sample_names_it(played: Played) -> None:
    played.arm()
    counter = newest(played.sample())
    played.command(played.loop, counter, 2.0)
    assert played.torques[-1] == pytest.approx(2.0 * 0.0217)
    velocity = LAYOUT.decode_velocity(played.sample()[1])
    assert (velocity.node_state, velocity.command_counter) == (NodeState.ACTIVE, 0)


@pytest.mark.parametrize(
    ("answers", "wait_ns"), [(1, 0), (14, 0), (0, 800_000)], ids=["not yet", "an older sample", "too late"]
)
def test_what_does_not_answer_the_newest_sample_in_time_moves_nothing(
    played: Played, answers: int, wait_ns: int
) -> None:
    played.arm()
    counter = newest(played.sample())
    played.clock.advance_to(played.clock.now_ns() + wait_ns)
    played.command(played.loop, (counter + answers) % 15, 2.0)
    assert set(played.torques) == {0.0}
    assert played.server.node.counts.refused == 1


def test_a_sample_without_an_answer_is_braked_and_too_many_end_in_a_stop(played: Played) -> None:
    played.arm()
    played.command(played.loop, newest(played.sample()), 1.0)
    for position in range(1, 12):
        played.sample(position * 1e-3, 1.0)  # rev/s
        played.clock.advance_to(played.clock.now_ns() + MS * 3 // 4)
        played.server.step()
        assert played.torques[-1] == pytest.approx(-6.0 * 2.0 * 3.14159 / 60.0 * 0.0217, rel=1e-3)
        if position == 9:
            played.must_be(Phase.ACTIVE)
    played.must_be(Phase.STOPPING)


def test_without_its_loop_the_drive_is_stopped_and_let_go(played: Played) -> None:
    played.arm()
    played.command(played.loop, newest(played.sample()), 1.0)
    played.loop.close()
    played.watchdog.close()
    for _ in range(60):
        played.clock.advance_to(played.clock.now_ns() + MS)
        now_ns = played.clock.now_ns()
        played.bus.waiting += [
            Frame(0x001, struct.pack("<IB3x", 0, 8), now_ns),
            Frame(0x009, struct.pack("<ff", 0.0, 0.0), now_ns),
            Frame(0x014, struct.pack("<ff", 0.0, 0.0), now_ns),
        ]
        played.server.step()
    played.must_be(Phase.OFF)
    assert (played.torques[-1], played.asked_states) == (0.0, [8, 1])
    played.server.run()  # has nothing left to do


def test_once_the_watchdog_has_spoken_the_loop_is_not_heard(played: Played) -> None:
    played.arm()
    played.command(played.loop, newest(played.sample()), 1.0)
    played.command(played.watchdog, 0, 0.0, enable=False)
    played.must_be(Phase.STOPPING)
    left = len(played.torques)
    counter = newest(played.sample())
    played.command(played.loop, counter, 3.0)
    assert all(abs(torque) < 1e-9 for torque in played.torques[left:])
    played.loop.send(pack_document({"do": "arm", "zero": False}))
    played.server.step()
    played.must_be(Phase.STOPPING)


def test_with_zero_no_other_current_is_obeyed(played: Played) -> None:
    played.sample()
    played.loop.send(pack_document({"do": "arm", "zero": True}))
    played.server.step()
    played.state = 8
    played.sample()
    counter = newest(played.sample())
    played.command(played.loop, counter, 0.5)
    assert set(played.torques) == {0.0}
    assert played.server.node.counts.refused == 1


def test_the_loop_gets_the_frames_of_the_drive_s_bus_for_its_log(played: Played) -> None:
    played.bus.waiting.append(Frame(0x123, b"\x01", played.clock.now_ns()))
    played.server.step()
    assert played.heard(Kind.DRIVE) == [Frame(0x123, b"\x01", played.clock.now_ns())]


@pytest.mark.parametrize("packet", [b"\x09", b"\x01abc", b"\x03[1]", b"\x03{", bytes((1,)) * 500])
def test_a_packet_that_is_none_changes_nothing(played: Played, packet: bytes) -> None:
    played.loop.send(packet)
    played.server.step()
    assert played.bus.sent == []
    played.must_be(Phase.OFF)


def test_a_process_that_cannot_open_the_bus_says_why_in_one_line() -> None:
    bench = parse_bench(late_bench(), "bench.toml")
    mapping = load_mapping(EXAMPLES / "odrive.toml")
    with pytest.raises(BusError, match="nosuch0"):
        ProcessDrive(mapping, bench, "nosuch0", MonotonicClock(), "map:odrive.toml@nosuch0")


def test_after_a_frame_of_the_arming_sequence_that_the_second_guard_refused_only_the_disarming_leaves() -> None:
    mapping, sent = load_mapping(EXAMPLES / "odrive.toml"), list[Frame]()
    (mode,), (arm,) = mapping.arm[1].frames, mapping.arm[2].frames
    wrong = replace(mode, data=bytes(8))  # whoever encoded it was wrong
    altered = replace(mapping, arm=(replace(mapping.arm[2], frames=(wrong, arm)),))
    node = DriveNode(altered, parse_bench(late_bench(), "bench.toml"), LAYOUT, sent.append)
    node.arm(0)
    assert node.phase is Phase.FAILED
    assert "Control_Mode says 0, meant was 1" in node.failure
    assert [(frame.identifier, frame.data) for frame in sent] == [
        (0x00E, bytes(4)), (0x00E, bytes(4)), (0x007, b"\x01\0\0\0"),
    ]  # fmt: skip


@pytest.mark.parametrize("options", ["", "drive.toml", "@can0", "drive.toml@", "drive.toml@sim", "a@map:b@can0"])
def test_an_interface_that_names_no_file_and_bus_is_refused(options: str) -> None:
    with pytest.raises(UsageError):
        open_mapped(options, parse_bench(late_bench(), "bench.toml"))


def test_a_node_of_its_own_process_ends_with_its_loop() -> None:
    bench = parse_bench(late_bench(), "bench.toml")
    mapping = load_mapping(EXAMPLES / "odrive.toml")
    drive = ProcessDrive(mapping, bench, "udp_multicast:239.74.163.16", MonotonicClock(), "map:x")
    assert drive.receive(0) is None
    assert drive.report()["drive_samples"] == "0"
    drive.close()
    assert drive._child.exit_code == 0
