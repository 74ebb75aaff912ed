"""The node obeys fresh, valid, enabled answers to its newest sample; left alone it brakes, and stops."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.brake.euler import step
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Instruments, Plant
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import gaussian_noise
from emb_runtime.can.messages import Layout, StopReason, load_layout
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.records import Frame, NodeState
from emb_runtime.safety.state_machine import Fault
from tests.conftest import Simulate
from tests.independent import DATABASE, read

QUIET = lambda: (0.0, 0.0, 0.0)  # noqa: E731  a constant


class Bus:
    """A node with an obedient commander."""

    def __init__(self, bench: Bench, layout: Layout, plant: Plant | None = None) -> None:
        self.layout = layout
        self.node = BrakeNode(bench, layout, bench.brake, QUIET, plant)
        self.counter = 0
        self.frames = self.node.tick()

    @property
    def answers(self) -> int:
        return self.layout.decode_angle(self.frames[0]).counter

    def command(self, current: float, enable: bool = True, answers: int | None = None) -> None:
        answers = self.answers if answers is None else answers
        self.node.receive(self.layout.encode_command(self.counter, answers, current, enable))
        self.counter = (self.counter + 1) % 15

    def tick(self, periods: int = 1) -> None:
        for _ in range(periods):
            self.frames = self.node.tick()

    def drive(self, current: float, periods: int = 1) -> None:
        """Answer each sample with a command."""
        for _ in range(periods):
            self.command(current)
            self.tick()


@pytest.fixture
def bus(bench: Bench, layout: Layout) -> Bus:
    return Bus(bench, layout)


def test_a_node_that_sends_the_charge_differs_in_nothing_else(bench: Bench, layout: Layout) -> None:
    plain, telling = (BrakeNode(bench, layout, bench.brake, QUIET, charge=charge) for charge in (False, True))
    total = 0.0
    for k in range(40):
        expected, (first, *others) = plain.tick(), telling.tick()
        assert others == expected
        values = DATABASE.decode_message("EMB_Charge", first.data)
        counter = layout.decode_angle(others[0]).counter
        applied = layout.decode_velocity(others[1]).applied_current
        assert values["Counter"] == counter
        total += applied * bench.timing.sample_time
        assert values["Charge"] == pytest.approx(total, abs=1e-7)
        for node in (plain, telling):
            node.receive(layout.encode_command(k % 15, counter, 0.5, True))
    assert total > 0.015


def test_an_answer_acts_in_the_period_of_the_sample_it_answers(bench: Bench, layout: Layout) -> None:
    bus = Bus(bench, layout, bench.plant("euler"))
    angle, velocity = 0.0, 0.0
    for current in (6.0, 3.0, -1.2):
        bus.drive(current)
        angle, velocity = step(bench.brake, angle, velocity, current, 1e-3)
        assert (bus.node.angle, bus.node.velocity) == (angle, velocity)
        said = bus.layout.decode_velocity(bus.frames[1])
        assert said.applied_current == pytest.approx(current, abs=1e-12)
        assert said.command_counter == (bus.counter - 1) % 15
        assert said.node_state is NodeState.ACTIVE


def test_a_late_answer_is_refused_and_its_period_is_braked(bus: Bus) -> None:
    bus.drive(6.0)
    stale = bus.answers
    bus.drive(6.0)
    before = bus.node.velocity
    bus.command(6.0, answers=stale)
    bus.tick()
    assert bus.node.velocity < before
    assert (bus.node.rejected, bus.node.braked) == (1, 1)
    assert bus.layout.decode_velocity(bus.frames[1]).command_counter == 15


def test_a_frozen_counter_is_obeyed_once_and_never_again_however_often_the_brake_comes_to_rest(bus: Bus) -> None:
    for _ in range(500):
        bus.node.receive(bus.layout.encode_command(5, bus.answers, 2.0, True))
        bus.tick()
    assert bus.node.state is NodeState.IDLE  # after the stop that followed the one command
    assert (bus.node.obeyed, bus.node.rejected) == (1, 499)
    bus.counter = 6
    bus.command(2.0)
    bus.tick()
    assert bus.node.obeyed == 2


def test_a_disabled_command_with_a_current_stops_the_brake_and_is_counted(bus: Bus) -> None:
    for _ in range(30):
        bus.command(2.0)
        bus.tick()
    bus.command(6.0, enable=False)
    bus.tick()
    assert (bus.node.state, bus.node.stop_reason) == (NodeState.STOPPING, StopReason.DISABLED)
    assert (bus.node.obeyed, bus.node.rejected) == (30, 1)


def test_a_damaged_command_is_not_obeyed(bus: Bus) -> None:
    for bit in range(40):
        data = bytearray(bus.layout.encode_command(0, bus.answers, 6.0, True).data)
        data[bit // 8] ^= 1 << bit % 8
        bus.node.receive(Frame(0x80, bytes(data)))
        bus.tick()
        assert (bus.node.obeyed, bus.node.rejected, bus.node.state) == (0, bit + 1, NodeState.IDLE)


def test_a_command_beyond_the_bench_is_not_obeyed(bench: Bench, layout: Layout) -> None:
    narrow = replace(bench, limits=replace(bench.limits, current=2.0))
    bus = Bus(narrow, layout)
    bus.drive(2.1)
    assert (bus.node.obeyed, bus.node.rejected) == (0, 1)


def test_the_safe_stop_latches_after_the_watchdog_time_and_ends_at_rest(bus: Bus) -> None:
    bus.drive(2.0, 60)
    speed, states = bus.node.velocity, []
    assert speed > 100.0
    for _ in range(10):
        bus.tick()
        states.append(bus.node.state)
    assert states == [NodeState.ACTIVE] * 9 + [NodeState.STOPPING]
    assert bus.node.stop_reason is StopReason.WATCHDOG
    assert abs(bus.node.velocity) < 0.2 * speed
    bus.command(6.0)  # too late: a stop that has latched is finished first
    bus.tick()
    states.append(bus.node.state)
    bus.tick(1000)
    states.append(bus.node.state)
    assert bus.node.angle_range[1] < 100.0
    bus.drive(1.0)
    states.append(bus.node.state)
    assert states[10:] == [NodeState.STOPPING, NodeState.IDLE, NodeState.ACTIVE]


def test_a_freewheeling_node_only_lets_go(bench: Bench, layout: Layout) -> None:
    bus = Bus(replace(bench, node=replace(bench.node, stop="freewheel")), layout)
    bus.drive(2.0, 30)
    bus.tick()
    assert bus.layout.decode_velocity(bus.frames[1]).applied_current == 0.0


def test_leaving_a_limit_begins_the_stop(bus: Bus) -> None:
    bus.drive(6.0, 40)
    assert bus.node.top_speed > 500.0
    assert (bus.node.state, bus.node.stop_reason) == (NodeState.STOPPING, StopReason.LIMIT)


def test_periods_that_a_late_node_skipped_have_passed_for_the_brake_and_for_its_watchdog(bus: Bus) -> None:
    bus.command(2.0)
    bus.frames = bus.node.tick(skipped=4)
    assert bus.node.periods == 6
    assert bus.node.samples == 2
    assert bus.node.braked == 4
    assert bus.layout.decode_angle(bus.frames[0]).device_time_ns == 6_000_000
    bus.node.tick(skipped=5)
    assert bus.node.state is NodeState.STOPPING


def test_the_status_comes_every_100_samples_and_counts(bus: Bus) -> None:
    statuses = []
    for n in range(300):
        bus.tick()
        statuses += [(n, bus.layout.decode_status(f)) for f in bus.frames if f.identifier == 0x102]
    assert [n for n, _ in statuses] == [99, 199, 299]
    assert [s.counter for _, s in statuses] == [1, 2, 3]
    assert statuses[0][1].stop_reason is StopReason.NEVER_COMMANDED


def delayed(bench: Bench, **instruments: int) -> Plant:
    return Plant("delayed", bench.plant("exact").mechanics, Instruments(**instruments))


def test_a_command_of_a_late_drive_is_obeyed_at_once_and_acts_later_and_the_report_is_what_acts(
    bench: Bench, layout: Layout
) -> None:
    late, prompt = Bus(bench, layout, delayed(bench, command_delay=2)), Bus(bench, layout, bench.plant("exact"))
    said = []
    for current in (1.0, 2.0, 3.0, 4.0, 5.0):
        late.drive(current)
        said.append(layout.decode_velocity(late.frames[1]))
    assert [s.applied_current for s in said] == pytest.approx([0.0, 0.0, 1.0, 2.0, 3.0], abs=1e-12)
    assert [s.command_counter for s in said] == [0, 1, 2, 3, 4]
    assert [s.node_state for s in said] == [NodeState.ACTIVE] * 5
    for current in (1.0, 2.0, 3.0):
        prompt.drive(current)
    assert (late.node.angle, late.node.velocity) == (prompt.node.angle, prompt.node.velocity)


def test_a_late_drive_brakes_in_the_period_in_which_the_missing_command_would_have_acted(
    bench: Bench, layout: Layout
) -> None:
    bus = Bus(bench, layout, delayed(bench, command_delay=1))
    said = []
    for k in range(8):
        if k != 5:
            bus.command(2.0)
        bus.tick()
        said.append(layout.decode_velocity(bus.frames[1]))
    assert [s.command_counter for s in said] == [0, 1, 2, 3, 4, 15, 5, 6]
    assert [s.applied_current > 0.0 for s in said] == [False, True, True, True, True, True, False, True]
    assert bus.node.braked == 1


def test_a_late_drive_stops_without_delay(bench: Bench, layout: Layout) -> None:
    bus = Bus(bench, layout, delayed(bench, command_delay=5))
    bus.drive(2.0, 30)
    bus.command(0.0, enable=False)
    bus.tick()
    assert bus.node.state is NodeState.STOPPING
    assert layout.decode_velocity(bus.frames[1]).applied_current < 0.0


def test_sensor_noise_has_the_bench_s_standard_deviations_and_follows_its_seed(bench: Bench) -> None:
    for jitter in (0.0, 2e-5):
        draws = [gaussian_noise(bench.noise, 5, jitter) for _ in range(2)]
        values = [draws[0]() for _ in range(20_000)]
        assert values[:100] == [draws[1]() for _ in range(100)]
        for column, std in enumerate((bench.noise.angle, bench.noise.velocity, jitter)):
            squares = math.fsum(v[column] ** 2 for v in values) / len(values)
            assert math.sqrt(squares) == pytest.approx(std, rel=0.02)


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=20))
def test_random_frames_are_never_obeyed_unless_they_are_valid_answers(content: list[tuple[int, bytes]]) -> None:
    layout = load_layout()
    bus = Bus(load_bench(), layout)
    legal = 0
    for identifier, data in content:
        legal += identifier == layout.command.identifier and read(Frame(identifier, data)) is not None
        bus.node.receive(Frame(identifier, data))
        bus.tick()
    assert bus.node.obeyed <= legal


ENDS: dict[str, Fault | None] = {
    # What the shield is proved for, and what differs from it in friction at rest only.
    "euler": None,
    "exact": None,
    # Outside its assumptions; the run ends as it should, or the node ends it at a limit.
    "stribeck": None,
    "load": None,
    "cubic": None,
    "hysteresis": None,
    "play": None,
    "lag": Fault.RESPONSE_LATE,
    "late": Fault.RESPONSE_LATE,
    "offset": None,
    "jitter": None,
    "observer": Fault.RESPONSE_LATE,
    "rough": Fault.RESPONSE_LATE,
}


def test_every_shipped_plant_has_a_documented_end(bench: Bench) -> None:
    assert list(ENDS) == list(bench.plants)


@pytest.mark.parametrize("plant", list(ENDS))
def test_full_current_on_any_plant_ends_by_itself_and_as_documented(
    simulate: Simulate, bench: Bench, plant: str
) -> None:
    run = simulate(lambda *_: 6.0, options=f"plant={plant}")
    assert run.outcome.fault is ENDS[plant]
    if run.outcome.fault is None:
        assert run.outcome.counters.answered == bench.timing.horizon


@pytest.mark.parametrize("plant", ["euler", "exact"])
@pytest.mark.parametrize("theta", ["f_v=1e-5", "f_v=5e-5", "f_v=1e-5,k_m=3.2e-2", "f_v=5e-5,k_m=1.1e-2"])
def test_the_shipped_actor_keeps_the_limits_at_the_ends_of_the_ranges_and_the_brake_comes_home(
    simulate: Simulate, bench: Bench, plant: str, theta: str
) -> None:
    run = simulate(actor=load_policy(shipped_actor_path(), bench), options=f"plant={plant},{theta}")
    node, limits = run.transport.node, bench.limits
    low, high = node.angle_range
    assert run.outcome.fault is None
    assert limits.angle[0] <= low <= high <= limits.angle[1]
    assert node.top_speed <= limits.velocity
    assert run.outcome.home
