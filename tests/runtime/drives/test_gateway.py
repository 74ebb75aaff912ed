"""The gateway between two buses, step by step: what passes, what the node does alone, and when the drive is let go."""

from __future__ import annotations

import json
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.messages import StopReason, load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.cli import gateway as cli
from emb_runtime.config.bench import parse_bench
from emb_runtime.drives.gateway import LISTEN, MOST_FRAMES, Gateway
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.node import INTRUDED, READY_SAMPLES, DriveNode
from emb_runtime.drives.phases import ARMED_PERIODS, LONGEST_STOP_PERIODS, Active, Failed, Off, Ready, Stopping
from emb_runtime.errors import BusError, SafetyStopError
from emb_runtime.records import Frame, NodeState
from emb_runtime.system import terminal
from tests.drives import EXAMPLES, late_bench

MS = 1_000_000
LAYOUT = load_layout()
IDLE, CLOSED_LOOP = 1, 8  # States of an ODrive's axis


class Bus:
    """A bus on which a test is everybody else; time passes while the gateway finds nothing on it."""

    name, truth, obtained = "bus", None, dict[str, str]()

    def __init__(self) -> None:
        self.waiting: deque[Frame] = deque()
        self.sent: list[Frame] = []
        self.send_error: BusError | None = None
        self.receive_error: BusError | None = None
        self.passes: Callable[[], None] = lambda: None

    def lose(self, error: BusError) -> None:
        self.send_error = self.receive_error = error

    def send(self, frame: Frame) -> None:
        if self.send_error is not None:
            raise self.send_error
        self.sent.append(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        assert deadline_ns == 0  # it only looks
        if self.receive_error is not None:
            raise self.receive_error
        if not self.waiting:
            self.passes()
            return None
        return self.waiting.popleft()

    def close(self) -> None:
        pass


class Played:
    """A gateway of an ODrive that obeys its arming and disarming, and the host."""

    def __init__(self, largest: float = 6.0) -> None:
        self.clock = SteppedClock(1_000 * MS)
        self.drive, self.host = Bus(), Bus()
        mapping, bench = load_mapping(EXAMPLES / "odrive.toml"), parse_bench(late_bench(), "bench.toml")
        bound = largest * 0.0217 + 1e-4
        told = {name: replace(one, high=1000.0) for name, one in mapping.conditions.items()}  # what emb.dbc cannot say
        mapping = replace(mapping, command=replace(mapping.command, low=-bound, high=bound), conditions=told)
        self.waits: list[int] = []
        self.gateway = Gateway(mapping, bench, self.drive, self.host, self.clock, self.waits.append)
        self.node = self.gateway.node
        self.state, self.last_fed = IDLE, 0
        self.position, self.velocity = 0.0, 0.0
        self.taken = self.periods = self.counter = 0
        self.ignores = False

    def period(self, step: bool = True) -> list[Frame]:
        """One period with a sample; frames of ours that the host gets."""
        before = len(self.host.sent)
        self.clock.advance_to(self.clock.now_ns() + MS)
        now_ns, self.periods = self.clock.now_ns(), self.periods + 1
        for frame in self.drive.sent[self.taken :]:
            self.last_fed = self.periods
            if frame.identifier == 0x007 and not self.ignores:
                self.state = frame.data[0]
        self.taken = len(self.drive.sent)
        if self.periods - self.last_fed > 10 and not self.ignores:  # its own time-out
            self.state = IDLE
        self.drive.waiting += [
            Frame(0x001, struct.pack("<IB3x", 0, self.state), now_ns),
            Frame(0x009, struct.pack("<ff", self.position, self.velocity), now_ns),
            Frame(0x014, struct.pack("<ff", 0.0, 0.0), now_ns),
        ]
        if step:
            self.gateway.serve_once()
        return self.host.sent[before:]

    def command(self, current: float, answers: int = 0, enable: bool = True) -> None:
        self.host.waiting.append(answer(self, current, answers, enable))
        self.gateway.serve_once()

    def arm(self) -> None:
        for _ in range(READY_SAMPLES):
            self.period()
        assert self.node.may_arm
        self.node.arm(self.clock.now_ns())
        for _ in range(200):
            if isinstance(self.node.phase, Ready):
                return
            self.period()
        raise AssertionError(self.node.failure)

    def drive_on(self, current: float) -> None:
        self.period()
        self.command(current)
        assert isinstance(self.node.phase, Active)

    def serve(self, periods: int, then: Callable[[], None] = lambda: None) -> None:
        """Let time pass by itself from now on; something happens after so many periods."""
        steps = 0

        def quarter() -> None:
            nonlocal steps
            steps += 1
            assert steps < 40_000, self.node.phase
            if steps % 4 == 0:
                self.period(step=False)
            if self.periods == periods:
                then()

        self.drive.passes = quarter

    def until(self, phase: type, most: int = 2000) -> None:
        for _ in range(most):
            if isinstance(self.node.phase, phase):
                return
            self.period()
        raise AssertionError(self.node.phase)

    @property
    def torques(self) -> list[float]:
        return [struct.unpack("<f", frame.data)[0] for frame in self.drive.sent if frame.identifier == 0x00E]

    @property
    def asked_states(self) -> list[int]:
        return [frame.data[0] for frame in self.drive.sent if frame.identifier == 0x007]


@pytest.fixture
def played() -> Played:
    return Played()


def state_of(frames: list[Frame]) -> NodeState:
    return LAYOUT.decode_velocity(next(f for f in frames if f.identifier == LAYOUT.velocity.identifier)).node_state


def test_the_drive_proves_its_time_out_before_it_is_armed_and_then_gets_0_a(played: Played) -> None:
    assert state_of([f for _ in range(3) for f in played.period()]) is NodeState.FAULT
    assert played.drive.sent == []
    played.arm()
    assert played.node.arming.time_out.startswith("disarmed within 0.0")
    assert played.asked_states == [CLOSED_LOOP, CLOSED_LOOP]
    left = len(played.torques)
    for _ in range(20):
        assert state_of(played.period()) is NodeState.IDLE
    assert played.torques[left:] == [0.0] * 20


def ended_at(played: Played, period: int) -> bool:
    return played.periods >= period


def test_the_bus_is_observed_for_a_time_before_the_drive_is_armed_and_an_end_by_then_arms_nothing() -> None:
    for end, armed in ((51, False), (52, True)):
        played = Played()
        played.serve(10**9)
        assert played.gateway.arm(partial(ended_at, played, end)) is armed
        assert bool(played.drive.sent) is armed


def test_it_waits_until_the_next_thing_is_due_and_takes_some_frames_of_each_bus(played: Played) -> None:
    played.gateway.serve_once()
    assert played.waits == [MS + 1]
    played.period()
    played.gateway.serve_once()
    assert played.waits[-1] == 750_000  # the newest sample is to be answered by then
    played.host.waiting += [Frame(0x700, b"")] * 100
    played.drive.waiting += [Frame(0x700, b"")] * 100
    played.gateway.serve_once()
    assert (len(played.host.waiting), len(played.drive.waiting)) == (100 - MOST_FRAMES, 100 - MOST_FRAMES) == (36, 36)
    looks: list[int] = []
    played.host.waiting.clear()
    played.host.passes = lambda: looks.append(1)
    played.gateway.serve_once()
    assert looks == [1]


def answer(played: Played, current: float, answers: int = 0, enable: bool = True) -> Frame:
    """An answer to the newest sample, or to another."""
    newest = next(f for f in reversed(played.host.sent) if f.identifier == LAYOUT.angle.identifier)
    counter = (LAYOUT.decode_angle(newest).counter + answers) % 15
    frame = LAYOUT.encode_command(played.counter, counter, current, enable)
    played.counter = (played.counter + 1) % 15
    return frame


def test_echoes_and_error_frames_of_the_host_s_bus_are_no_commands(played: Played) -> None:
    played.arm()
    for kind in ("own", "error"):
        played.period()
        played.host.waiting.append(answer(played, 2.0)._replace(own=kind == "own", error=kind == "error"))
        played.gateway.serve_once()
    assert (played.node.answers.refused, type(played.node.phase)) == (0, Ready)


def test_a_frame_for_which_the_host_s_bus_has_no_room_is_lost_and_nothing_else(played: Played) -> None:
    def full() -> None:
        played.host.send_error = TransmitQueueFullError("vcan0: full")

    played.serve(300, full)
    played.gateway.run(lambda: played.periods > 400, lambda: None, arms=True)
    assert (played.periods, type(played.node.phase)) == (402, Off)


def test_a_command_in_time_becomes_a_torque_and_the_next_sample_names_it(played: Played) -> None:
    played.arm()
    played.drive_on(2.0)
    assert played.torques[-1] == pytest.approx(2.0 * 0.0217)
    frames = played.period()
    velocity = LAYOUT.decode_velocity(next(f for f in frames if f.identifier == LAYOUT.velocity.identifier))
    assert (velocity.node_state, velocity.command_counter) == (NodeState.ACTIVE, 0)


def test_what_does_not_answer_the_newest_sample_in_time_moves_nothing(played: Played) -> None:
    played.arm()
    for refused, (answers, wait_ns) in enumerate(((1, 0), (14, 0), (0, 800_000)), 1):  # not yet, older, too late
        played.period()
        played.clock.advance_to(played.clock.now_ns() + wait_ns)
        played.command(2.0, answers)
        assert played.node.answers.refused == refused
    assert set(played.torques) == {0.0}


def test_a_sample_without_an_answer_is_braked_and_a_host_that_stays_silent_ends_in_a_stop(played: Played) -> None:
    played.arm()
    played.drive_on(1.0)
    played.velocity = 1.0  # rev/s
    for number in range(1, 11):
        played.position += 1e-3
        played.period()
        played.clock.advance_to(played.clock.now_ns() + MS * 3 // 4)
        played.gateway.serve_once()
        assert played.torques[-1] == pytest.approx(-6.0 * 2.0 * 3.14159 / 60.0 * 0.0217, rel=1e-3)
        assert isinstance(played.node.phase, Active) == (number < 10)
    assert (type(played.node.phase), played.node.stop_reason) == (Stopping, StopReason.WATCHDOG)


def test_a_drive_that_is_given_up_in_the_last_period_that_the_host_may_miss_stays_given_up() -> None:
    played = Played(largest=1.5)  # so a greater current of the node's stop is refused
    played.arm()
    played.drive_on(1.0)
    for velocity in (*[1.0] * 9, 3.0):
        played.position, played.velocity = played.position + (played.velocity + velocity) * 0.5e-3, velocity
        played.period()
        assert isinstance(played.node.phase, Active)
    played.clock.advance_to(played.clock.now_ns() + MS * 3 // 4)
    played.gateway.serve_once()
    assert isinstance(played.node.phase, Failed)
    assert (played.torques[-1], played.asked_states[-1]) == (0.0, IDLE)
    left = len(played.drive.sent)
    for _ in range(20):
        played.period()
    assert (len(played.drive.sent), type(played.node.phase)) == (left, Failed)


def test_after_a_stop_of_the_host_the_drive_stays_armed_and_after_any_other_it_is_let_go(played: Played) -> None:
    played.arm()
    for _ in range(2):
        played.drive_on(1.0)
        played.command(0.0, enable=False)
        assert isinstance(played.node.phase, Stopping)
        played.until(Ready)
        assert state_of(played.period()) is NodeState.IDLE
    assert IDLE not in played.asked_states
    played.drive_on(1.0)
    played.until(Off)  # the host is silent
    assert (played.torques[-1], played.asked_states[-1]) == (0.0, IDLE)


def test_a_stop_that_does_not_come_to_rest_ends_in_letting_go(played: Played) -> None:
    played.arm()
    played.drive_on(1.0)
    played.command(0.0, enable=False)
    for _ in range(LONGEST_STOP_PERIODS + 5):
        played.position, played.velocity = played.position + 0.002, 2.0
        played.period()
    assert isinstance(played.node.phase, Off)


def idle_for_long(played: Played, but: int = 0) -> None:
    if isinstance(played.node.phase, Ready):
        played.node.phase = Ready(ARMED_PERIODS - but)


def test_a_drive_that_nobody_commands_is_let_go_after_a_time(played: Played) -> None:
    played.arm()
    idle_for_long(played, but=1)
    for _ in range(3):
        played.period()
    assert isinstance(played.node.phase, Off)


def run(played: Played, periods: int, then: Callable[[], None] = lambda: None, *, arms: bool = True) -> list[str]:
    """Serve on the gateway's own loop; ``then`` happens after 300 periods, the operator ends it after so many."""
    said: list[str] = []
    played.serve(300, then)
    played.gateway.run(lambda: played.periods > periods, lambda: said.append("ready"), arms=arms)
    return said


def test_the_operator_s_end_lets_the_drive_go_and_is_no_error(played: Played) -> None:
    assert run(played, 1500) == ["ready"]
    assert (played.periods, type(played.node.phase), played.state) == (1502, Off, IDLE)
    assert played.asked_states[-1] == IDLE


def test_an_end_in_the_middle_of_a_run_waits_for_the_node_s_stop_however_long_that_takes(played: Played) -> None:
    def driven() -> None:
        played.host.waiting.append(answer(played, 1.0))
        played.drive.passes, passes = moving, played.drive.passes
        moved.append(passes)

    def moving() -> None:
        played.position, played.velocity = played.position + 0.0005, 2.0
        moved[0]()

    moved: list[Callable[[], None]] = []
    assert run(played, 300, driven) == ["ready"]
    assert (type(played.node.phase), played.node.stop_reason) == (Off, StopReason.DISABLED)
    assert LONGEST_STOP_PERIODS <= played.periods - 300 <= LONGEST_STOP_PERIODS + 10


def test_the_counts_go_to_the_host_with_each_status(played: Played) -> None:
    node = played.node
    node.outlet.not_sent, node.answers.braked, node.outlet.guard.rejected = 3, 70_000, 2
    assert run(played, 400) == ["ready"]
    own = LAYOUT.optional["EMB_Gateway"]
    told = [own.decode(f) for f in played.host.sent if f.identifier == own.identifier]
    statuses = [f for f in played.host.sent if f.identifier == LAYOUT.status.identifier]
    assert len(told) == len(statuses) >= 3
    assert [values["Counter"] for values in told] == [(n + 1) % 15 for n in range(len(told))]
    counts = {"NotSent": 3, "Braked": 65535, "NotBelieved": 0, "Refused": 2}
    assert told[0].items() >= {"Version": 1, **counts}.items()


@pytest.mark.parametrize(
    ("temperatures", "voltages", "told"),
    [
        ([61.5, 62.5], [12.0, 12.5, 13.0], [(62.5, 13.0)]),  # the newest of each
        ([61.5], [], []),
        ([], [12.5], []),
        ([math.nan], [12.5], []),
        ([310.0], [12.5], []),  # no value of emb.dbc
        ([61.5, math.nan, 1e9], [12.5, -1.0], [(61.5, 12.5)]),  # what the mapping does not believe is passed over
    ],
)
def test_conditions_go_to_the_host_with_a_status_once_both_have_come(
    temperatures: list[float], voltages: list[float], told: list[tuple[float, float]], played: Played
) -> None:
    sent = [f for _ in range(250) for f in played.period()]
    played.drive.waiting += [Frame(0x015, struct.pack("<ff", 0.0, value)) for value in temperatures]
    played.drive.waiting += [Frame(0x017, struct.pack("<ff", value, 0.0)) for value in voltages]
    sent += [f for _ in range(200) for f in played.period()]
    message = LAYOUT.optional["EMB_Conditions"]
    shown = [message.decode(f) for f in sent if f.identifier == message.identifier]
    assert [(row["Temperature"], row["SupplyVoltage"]) for row in shown] == told  # in whole steps
    assert [row["Counter"] for row in shown] == [*range(len(told))]


def test_conditions_that_came_long_apart_are_no_reading_together(played: Played) -> None:
    for identifier, data in ((0x015, struct.pack("<ff", 0.0, 61.5)), (0x017, struct.pack("<ff", 12.5, 0.0))):
        played.drive.waiting.append(Frame(identifier, data))
        sent = [f for _ in range(2200) for f in played.period()]
        assert not [f for f in sent if f.identifier == LAYOUT.optional["EMB_Conditions"].identifier]


def test_listening_sends_nothing(played: Played) -> None:
    assert run(played, 1500, arms=False) == ["ready"]
    assert played.drive.sent == []
    assert len(played.host.sent) >= 2998


def test_every_other_end_is_an_error_with_the_drive_let_go() -> None:
    down = BusError("it is down")
    linger = 1000  # Periods in which the node still reports its samples
    for happens, reason, periods in (
        (lambda it: setattr(it.host, "receive_error", down), "it is down", 301),
        (lambda it: setattr(it.host, "send_error", down), "it is down", 301),
        (lambda it: it.drive.lose(down), "it is down", 300),
        (lambda it: setattr(it, "velocity", 50.0), "angle and velocity contradict each other", 303 + linger),
        (idle_for_long, "a stop, reason NEVER_COMMANDED", 300 + linger),
    ):
        played = Played()
        with pytest.raises((BusError, SafetyStopError), match=reason):
            run(played, 5000, partial(happens, played))
        assert played.drive.send_error or played.asked_states[-1] == IDLE
        assert played.periods == periods, reason
    played = Played()
    with pytest.raises(SafetyStopError, match="contradict"):  # the operator ends it after that
        run(played, 400, lambda: setattr(played, "velocity", 50.0))
    assert played.periods == 401


def test_a_release_that_is_not_confirmed_is_an_error_after_the_reason_of_the_end() -> None:
    armed, nothing = "still reports that it is armed: it ignores its disarming", "has reported nothing since"

    def stubborn(it: Played) -> None:
        it.ignores = True

    def contradicting(it: Played) -> None:
        it.ignores, it.velocity = True, 50.0

    def deaf_host(it: Played) -> None:
        it.ignores = True
        it.host.lose(BusError("vcan0 is down"))

    def dumb(it: Played) -> None:
        it.drive.passes = lambda: it.clock.advance_to(it.clock.now_ns() + MS)

    def unplugged(it: Played) -> None:
        """Reports nothing more after it has reported, disarmed, that it is armed."""
        it.ignores = True
        it.serve(401, partial(dumb, it))

    def lost(it: Played) -> None:
        it.ignores = True
        it.serve(420, partial(it.drive.lose, BusError("can0 is down")))

    for happens, reason in (
        (stubborn, f"^the drive {armed}; switch it off"),
        (contradicting, f"angle and velocity contradict each other.*; the drive {armed}"),
        (deaf_host, f"vcan0 is down; the drive {armed}"),
        (dumb, f"silent for 3 periods; the drive {nothing}"),
        (unplugged, armed),
        (lost, f"{armed}: can0 is down; switch it off"),
    ):
        played = Played()
        with pytest.raises(BusError, match=reason):
            run(played, 400, partial(happens, played))
        assert played.asked_states[-1] == IDLE
        assert happens is not stubborn or played.periods == 401 + 1000


def test_an_end_before_the_drive_is_heard_sends_nothing_and_is_not_ready() -> None:
    for periods, error in ((3, None), (10**9, BusError("vcan0 is down"))):
        played = Played()
        if error is None:
            assert run(played, periods) == []
        else:
            played.host.lose(error)
            with pytest.raises(BusError, match="vcan0 is down"):
                run(played, periods)
        assert played.drive.sent == []


def test_a_drive_that_another_node_commands_is_not_armed() -> None:
    def passes(it: Played) -> None:
        it.clock.advance_to(it.clock.now_ns() + MS)
        it.periods += 1

    def ended(it: Played) -> bool:
        return it.periods > LISTEN * 1000 - 5

    for name in ("odrive", "mit"):
        mapping, bench = load_mapping(EXAMPLES / f"{name}.toml"), parse_bench(late_bench(name == "mit"), "bench.toml")
        command = mapping.messages[mapping.command.message]
        for own, error in ((False, False), (True, False), (False, True)):
            it = Played()
            gateway = Gateway(mapping, bench, it.drive, it.host, it.clock, lambda _ns: None)
            it.drive.passes = partial(passes, it)
            it.drive.waiting.append(
                Frame(command.identifier, bytes(command.length), extended=command.extended, own=own, error=error)
            )
            if own or error:
                gateway.run(partial(ended, it), lambda: None, arms=True)
            else:
                with pytest.raises(BusError, match="another node commands it"):
                    gateway.run(lambda: False, lambda: None, arms=True)
            assert it.drive.sent == []


def foreign(played: Played, identifier: int = 0x00E, **changed: Any) -> list[Frame]:
    """A stranger's frame of one that the mapping sends; commands that the host hears of."""
    before = len(played.host.sent)
    length = 8 if identifier == 0x00B else 0 if identifier == 0x018 else 4
    played.drive.waiting.append(Frame(identifier, bytes(length), played.clock.now_ns())._replace(**changed))
    played.gateway.serve_once()
    return [f for f in played.host.sent[before:] if f.identifier == LAYOUT.command.identifier]


@pytest.mark.parametrize("identifier", [0x007, 0x00B, 0x00E, 0x018])
def test_a_frame_of_another_commander_stops_a_moving_brake_and_the_host_hears_a_foreign_command(
    identifier: int,
) -> None:
    played = Played()
    played.arm()
    played.drive_on(2.0)
    assert foreign(played, identifier, own=True) == foreign(played, identifier, error=True) == []
    assert foreign(played, identifier, extended=True) == []
    assert (type(played.node.phase), played.node.failure) == (Active, "")
    (told,) = foreign(played, identifier)
    assert LAYOUT.decode_command(told) == (0, 0, 0.0, False)
    assert (type(played.node.phase), played.node.failure) == (Stopping, INTRUDED)
    assert IDLE not in played.asked_states
    played.until(Off)
    assert (played.torques[-1], played.asked_states[-1]) == (0.0, IDLE)
    assert foreign(played, identifier) == []  # nothing of ours is at stake


@pytest.mark.parametrize(("shared", "counts"), [(None, True), (0x009, False), (0x014, False), (0x001, False)])
def test_a_drive_may_answer_under_the_identifier_of_its_command(shared: int | None, counts: bool) -> None:
    it = Played()
    mapping = replace(load_mapping(EXAMPLES / "odrive.toml"), arm=(), disarm=())
    command = mapping.messages[mapping.command.message]
    identifier = shared or command.identifier
    messages = {**mapping.messages, command.name: replace(command, identifier=identifier)}
    bench = parse_bench(late_bench(), "bench.toml")
    gateway = Gateway(replace(mapping, messages=messages), bench, it.drive, it.host, it.clock, lambda _ns: None)
    it.drive.waiting.append(Frame(identifier, bytes(8), it.clock.now_ns()))
    it.drive.passes = lambda: it.clock.advance_to(it.clock.now_ns() + MS)
    with pytest.raises(BusError, match="another node commands it" if counts else "no samples of the drive"):
        gateway.run(lambda: False, lambda: None, arms=True)


def test_commands_of_another_node_that_go_on_let_a_moving_drive_go_at_once(played: Played) -> None:
    played.arm()
    played.drive_on(2.0)
    for number in (1, 2, 3):
        assert len(foreign(played)) == 1
        assert isinstance(played.node.phase, Failed) == (number == 3)
    assert (played.torques[-1], played.asked_states[-1]) == (0.0, IDLE)


def test_a_drive_at_rest_or_about_to_be_armed_is_let_go_with_the_first_command_of_another_node() -> None:
    played = Played()
    with pytest.raises(SafetyStopError, match="disarmed: another node commands it"):
        run(played, 5000, lambda: played.drive.waiting.append(Frame(0x00E, bytes(4), played.clock.now_ns())))
    assert (played.periods, played.asked_states[-1]) == (1300, IDLE)
    arming = Played()
    arming.serve(60, lambda: arming.drive.waiting.append(Frame(0x00E, bytes(4), arming.clock.now_ns())))
    with pytest.raises(BusError, match="cannot arm the drive: another node commands it"):
        arming.gateway.run(lambda: False, lambda: None, arms=True)
    assert (arming.torques[-1], arming.asked_states[-1]) == (0.0, IDLE)


def test_an_end_while_the_drive_is_armed_lets_it_go_and_is_not_ready(played: Played) -> None:
    assert run(played, round(LISTEN * 1000) + 5) == []
    assert (type(played.node.phase), played.asked_states[-1]) == (Off, IDLE)


def test_a_defect_leaves_with_0_a_and_the_disarming(played: Played) -> None:
    def defect() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(played, 400, lambda: setattr(played.gateway, "_received", defect))
    assert (played.torques[-1], played.asked_states[-1]) == (0.0, IDLE)


def test_a_drive_that_is_silent_or_cannot_be_armed_is_an_error_and_nothing_is_commanded() -> None:
    silent = Played()
    silent.drive.passes = lambda: silent.clock.advance_to(silent.clock.now_ns() + MS)
    begin_ns = silent.clock.now_ns()
    with pytest.raises(BusError, match=r"no samples of the drive.*with this DBC$"):
        silent.gateway.run(lambda: False, lambda: None, arms=True)
    assert silent.drive.sent == []
    assert silent.clock.now_ns() - begin_ns == 5_001 * MS
    deaf = Played()
    deaf.ignores = True
    said = "did not become active within 0.5 s; Axis0_Heartbeat.Axis_State is 1; idle is 1, active 8$"
    with pytest.raises(BusError, match=f"cannot arm the drive: the drive {said}"):
        run(deaf, 5000)
    assert set(deaf.torques) == {0.0}


def test_who_cannot_arm_a_drive_says_which_frames_were_not_believed() -> None:
    """A signal that the DBC takes for a float, and a message with a byte more than it says."""
    for identifier, data, reason in (
        (
            0x009,
            b"\xff\xff\x7f\x4e" * 2,
            "no samples.*; {n} frames were .*, the last one .*Pos_Estimate out of range: 1",
        ),
        (
            0x001,
            bytes(7),
            "did not become active.*; {n} frames were .*, the last one Axis0_Heartbeat: wrong length: 7 ",
        ),
    ):
        it = Played()
        receive = it.drive.receive

        def changed(
            wait_ns: int, receive: Callable[[int], Frame | None] = receive, of: int = identifier, data: bytes = data
        ) -> Frame | None:
            frame = receive(wait_ns)
            return frame._replace(data=data) if frame is not None and frame.identifier == of else frame

        it.drive.receive = changed  # type: ignore[method-assign,assignment]
        with pytest.raises(BusError, match=reason.format(n=r"\d+")):
            run(it, 6000)


def test_after_a_frame_of_the_arming_sequence_that_the_second_guard_refused_only_the_disarming_leaves() -> None:
    mapping, sent = load_mapping(EXAMPLES / "odrive.toml"), list[Frame]()
    (mode,), (arm,) = mapping.arm[1].frames, mapping.arm[2].frames
    wrong = replace(mode, data=bytes(8))  # whoever encoded it was wrong
    altered = replace(mapping, arm=(replace(mapping.arm[2], frames=(wrong, arm)),))
    node = DriveNode(altered, parse_bench(late_bench(), "bench.toml"), LAYOUT, sent.append)
    node.arm(0)
    assert isinstance(node.phase, Failed)
    assert "Control_Mode is 0, expected 1" in node.failure
    assert [(frame.identifier, frame.data) for frame in sent] == [
        (0x00E, bytes(4)), (0x00E, bytes(4)), (0x007, b"\x01\0\0\0"),
    ]  # fmt: skip


def test_the_command_asks_serves_and_ends_with_its_counts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "late.toml").write_text(late_bench())
    arguments = [str(EXAMPLES / "odrive.toml"), "--drive", "can0", "--node", "vcan0", "--serial", "7", "--no-rt"]
    arguments += ["--json", "--bench", str(tmp_path / "late.toml")]
    absent = ["can0" if word == "vcan0" else "nosuch0" if word == "can0" else word for word in arguments]
    assert cli.main([*absent, "--yes"]) == 4
    assert "nosuch0" in capsys.readouterr().err.splitlines()[-1]
    typed = ["n", "y\n", "y\n"]
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(terminal, "forget_typed", lambda: None)
    monkeypatch.setattr(terminal, "typed_line", lambda: typed.pop(0))
    for late_ns, code in ((0, 3), (0, 0), (1_200_000, 1)):
        played = Played()
        buses = {"can0": played.drive, "vcan0": played.host}
        monkeypatch.setattr(cli, "open_transport", lambda name, *_, p=played, b=buses: (b[name], p.clock))
        monkeypatch.setattr(cli, "Gateway", lambda *_, p=played: p.gateway)
        monkeypatch.setattr(cli, "StopRequest", lambda p=played: lambda: p.periods > 400)
        played.serve(400)
        played.node.times.largest_age_ns = late_ns
        assert cli.main(arguments) == code
        out, err = capsys.readouterr()
        assert "number 7, mapping " in err
        assert "hold_on_loss: " in err
        assert bool(played.drive.sent) == (code != 3)  # who said no
        if code != 3:
            assert json.loads(out)["drive_time_out"].startswith("disarmed within 0.0")
            assert ("TOO LATE: an answer acted 1.20 periods" in err) == (code == 1)
