"""The pre-flight: what it makes of what was heard, line by line, and what may not be armed.

And what is dropped while nobody listens, and what of it the next run must still see.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from emb_bench.sim.transport import SteppedClock, open_sim
from emb_runtime.can.messages import Layout, StatusFrame, StopReason, load_layout
from emb_runtime.cli.bus_monitor import ENOUGH_PAIRS, BusMonitor, BusStatistics, Scatter, listen
from emb_runtime.cli.main import Operator
from emb_runtime.cli.options import parser, prepare
from emb_runtime.cli.plan import MappedDrive, Stage
from emb_runtime.cli.preflight import (
    CHECKS,
    SLOW_MARK,
    Check,
    Findings,
    RefusedError,
    advice_on,
    first_refusal,
    run_checks,
)
from emb_runtime.cli.session import Bus, drop_backlog
from emb_runtime.config.bench import Bench, Sensors, parse_bench
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import EXIT_BUS, EXIT_CHECK_FAILED, EXIT_SAFETY_STOP, EXIT_USAGE
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.system.compiled_core import Core
from emb_runtime.system.terminal import StopRequest
from tests.benches import SENSOR_BENCH
from tests.drives import EXAMPLES
from tests.runtime.operating import Keyboard

MS = 1_000_000

STATUS = StatusFrame(3, NodeState.IDLE, 1, StopReason.NEVER_COMMANDED, 0, 0)
SAMPLE = SensorSample(3, 0.001, 0.5, 0, 0, 0.0, 15, NodeState.IDLE)


@pytest.fixture
def heard(bench: Bench, layout: Layout) -> BusStatistics:
    """A healthy node."""
    status = STATUS._replace(protocol_version=layout.protocol_version, bench_identity=int(bench.identity_hash[:4], 16))
    return BusStatistics(
        duration=0.2,
        frames={"EMB_Angle": 200, "EMB_Velocity": 200, "EMB_Status": 2},
        rates={"EMB_Angle": 1000.0, "EMB_Velocity": 1000.0, "EMB_Status": 10.0},
        others=0,
        load=0.27,
        rejections={},
        distrusted=False,
        bus_errors={},
        dropped=0,
        commanded=False,
        pairing_problem="",
        pairs=200,
        missing=0,
        period=1e-3,
        scatter=Scatter(ENOUGH_PAIRS, bench.noise.angle, bench.noise.velocity),
        status=status,
        sample=SAMPLE,
    )


@pytest.fixture(scope="module")
def healthy() -> Findings:
    """Everything as it should be, on a real bus, but for what was heard."""
    plan = prepare(parser().parse_args(["--iface", "can0"]))
    return Findings(
        plan=plan,
        start_conditions=StartConditions(plan.bench, plan.layout, Bounds(plan.bench), anywhere=False),
        duration=0.5,
        statistics=None,  # type: ignore[arg-type]  # see the next fixture
        bus="can0, receive buffer 8388608 bytes",
        in_process=False,
        end_stop_speed=0.0,
        needed=400_000,
        free=1 << 33,
        watchdog="process 4711, heartbeat 5 ms, FIFO 90",
        core=Core(compiled=True, text="compiled (mypyc, x86-64)"),
        realtime={"scheduler": "FIFO 80", "memory_lock": "current and future pages"},
    )


@pytest.fixture
def findings(healthy: Findings, heard: BusStatistics) -> Findings:
    return replace(healthy, statistics=heard)


def planned(findings: Findings, **changes: Any) -> Findings:
    return replace(findings, plan=replace(findings.plan, **changes))


def edited(findings: Findings, old: str, new: str) -> Bench:
    assert old in findings.plan.bench.text
    return parse_bench(findings.plan.bench.text.replace(old, new), "edited")


def hears(findings: Findings, **changes: Any) -> Findings:
    return replace(findings, statistics=replace(findings.statistics, **changes))


def reads_only(findings: Findings) -> Findings:
    return planned(replace(findings, watchdog="", realtime=None), stage=Stage.READ_ONLY, experiment=None)


def checks_of(findings: Findings) -> dict[str, Check]:
    return {check.name: check for check in run_checks(findings)}


def refused_by(findings: Findings) -> RefusedError:
    refused = first_refusal(run_checks(findings))
    assert refused is not None
    return refused


SLOW_BUS = "bitrate = 1000000", "bitrate = 250000"
NOTHING: dict[str, Any] = {"frames": {}, "status": None, "sample": None}


def test_a_bench_that_is_as_it_should_be_is_ok_in_every_check(findings: Findings) -> None:
    checks = run_checks(findings)
    assert [check.ok for check in checks] == [True] * len(CHECKS)
    assert len({check.name for check in checks}) == len(CHECKS)
    assert first_refusal(checks) is None


def test_what_was_heard_that_refuses_does_so_with_its_error_and_the_first_line_counts(findings: Findings) -> None:
    not_ready = Fault.NODE_NOT_READY
    rows: list[tuple[dict[str, Any], str, Fault]] = [
        (NOTHING, "node", Fault.NO_NODE),
        ({"status": None}, "node", not_ready),
        ({"status": STATUS._replace(protocol_version=2)}, "node", not_ready),
        ({"status": STATUS._replace(bench_identity=0x1234)}, "node", not_ready),
        ({"sample": None, "pairs": 0}, "node state", Fault.NO_NODE),
        ({"sample": SAMPLE._replace(node_state=NodeState.STOPPING)}, "node state", not_ready),
        ({"sample": SAMPLE._replace(angle=2.0)}, "node state", not_ready),
        ({"sample": SAMPLE._replace(velocity=-40.0)}, "node state", not_ready),
        ({"period": 1.02e-3}, "samples", not_ready),
        ({"period": math.nan, "pairs": 1}, "samples", Fault.NO_NODE),
        ({"rejections": {"EMB_Angle": {"CRC": 90}}, "distrusted": True}, "samples", Fault.FRAMES_REJECTED),
        ({"commanded": True}, "interface", Fault.FOREIGN_COMMAND),
    ]
    for changes, what, fault in rows:
        refused = refused_by(replace(hears(findings, **changes), free=0))  # nor is there room for the log
        exit_code = EXIT_BUS if fault is Fault.NO_NODE else EXIT_SAFETY_STOP
        assert (refused.fault, refused.exit_code) == (fault, exit_code), changes
        assert str(refused).startswith(f"pre-flight, {what}: ")
        assert refused.checks == run_checks(replace(hears(findings, **changes), free=0))


def test_in_a_kernel_of_emb_hil_that_runs_in_real_time_no_node_may_be_a_busy_computer(
    findings: Findings, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = hears(findings, **NOTHING)
    for times, told in (("1", True), ("100", False), (None, False)):
        monkeypatch.delenv(SLOW_MARK, raising=False)
        if times is not None:
            monkeypatch.setenv(SLOW_MARK, times)
        assert str(refused_by(silent)).endswith("on a busy computer: emb-hil --slow 100") == told
        assert advice_on(Fault.NOT_HOME) == FAULTS[Fault.NOT_HOME].advice


def test_what_this_computer_or_the_bench_file_lacks_for_any_run_is_a_usage_error(findings: Findings) -> None:
    slow = planned(findings, bench=edited(findings, *SLOW_BUS))
    for found, what in ((replace(findings, free=399_999), "disk"), (slow, "bus load")):
        refused = refused_by(found)
        assert (refused.exit_code, refused.fault) == (EXIT_USAGE, None)
        assert what in str(refused)


def test_what_only_warns_stands_in_its_line_alone(findings: Findings) -> None:
    core = Core(compiled=False, text="Python", warning="the compiled core is not taken: it was compiled from another")
    rows: list[tuple[Findings, str, str]] = [
        (hears(findings, bus_errors={"no acknowledgement": 3}), "interface", "no acknowledgement (3)"),
        (hears(findings, dropped=7), "interface", "7 frames dropped by the kernel"),
        (hears(findings, missing=2), "samples", "2 missing"),
        (hears(findings, missing=170), "samples", "170 missing"),
        (hears(findings, rejections={"EMB_Angle": {"CRC": 1}}), "samples", "EMB_Angle: CRC (1)"),
        (hears(findings, scatter=Scatter(200, 2.1e-3, 1.0)), "noise at rest", "0.0021 rad"),
        (hears(findings, scatter=Scatter(200, 1e-3, 2.1)), "noise at rest", "2.1 rad/s"),
        (hears(findings, scatter=Scatter(1, math.nan, math.nan)), "noise at rest", "unknown"),
        (hears(findings, load=0.72, others=500), "bus load", "72% measured, 500 frames of others"),
        (replace(findings, free=3_000_000), "disk", "3 MiB free"),
        (replace(findings, watchdog=""), "watchdog", "NONE"),
        (replace(findings, realtime={"scheduler": "not obtained: no"}), "real time", "scheduler: not obtained: no"),
        (replace(findings, realtime=None), "real time", "not requested"),
        (replace(findings, end_stop_speed=214.0), "shield", "214 rad/s"),
        (replace(findings, core=core), "core", f"Python; {core.warning}"),
    ]
    for found, what, said in rows:
        checks = run_checks(found)
        assert [check.name for check in checks if not check.ok] == [what]
        assert said in checks_of(found)[what].found
        assert first_refusal(checks) is None


def test_a_declared_observer_of_the_velocity_is_named(findings: Findings) -> None:
    assert "observer" not in checks_of(planned(findings, bench=SENSOR_BENCH))["shield"].found
    for sensors, said in (
        (Sensors("observer", 1520.0), "with a bandwidth of at least 1520 rad/s"),
        (Sensors("observer", velocity_lag=1e-3), "1 ms late at most"),
    ):
        line = checks_of(planned(findings, bench=replace(findings.plan.bench, sensors=sensors)))["shield"]
        assert line.found.endswith(f"; the velocity is an observer's, {said}")
        assert line.verdict == "ok"


def test_with_read_only_a_tenth_of_the_samples_missing_is_a_failed_check(findings: Findings) -> None:
    reading = reads_only(findings)
    for missing, verdict in ((20, "warning"), (25, "refused"), (170, "refused")):
        assert checks_of(hears(reading, missing=missing))["samples"].verdict == verdict
    refused = refused_by(hears(reading, missing=170))
    assert "170 missing (46 %)" in str(refused)
    assert (refused.exit_code, refused.fault) == (EXIT_CHECK_FAILED, None)


def test_a_slew_that_cannot_turn_the_current_round_in_a_period_is_told(findings: Findings) -> None:
    for slew, limit, verdict, found in (
        (12000.0, 6.0, "ok", "6 A to -6 A in 1 ms"),
        (11999.0, 6.0, "warning", "6 A to -6 A in 1 ms"),
        (1500.0, 6.0, "warning", "in 8 ms (guard.slew); the way home may be 7 ms late"),
        (1500.0, 0.75, "ok", "0.75 A to -0.75 A in 1 ms"),
        (1500.0, 0.0, "ok", "no current is sent"),
    ):
        bench = edited(findings, "slew          = 12000.0", f"slew = {slew}")
        line = checks_of(planned(findings, bench=bench, limit=limit))["slew"]
        assert line.verdict == verdict
        assert found in line.found


def test_a_mapped_drive_is_named_with_its_serial_number_and_has_the_load_of_its_bus_judged(findings: Findings) -> None:
    drive = MappedDrive(load_mapping(EXAMPLES / "odrive.toml"), "")
    mapped = planned(findings, drive=drive, label=replace(findings.plan.label, serial="SN 12"))
    line = checks_of(mapped)["drive"]
    assert line.verdict == "warning"
    assert line.found.startswith("ODrive CANSimple, axis 0, serial number SN 12 by the operator, mapping ")
    # 5 bytes: 34 + 40 stuffable bits, 18 stuff bits, 13 more: 105. 8 bytes: 98 + 24 + 13 = 135 (Davis and others).
    percent = 100.0 * (1000 * 105 + 2000 * 135 + 10 * 135) / 1e6
    for found in (findings, mapped):
        assert f"{percent:.0f}% at worst" in checks_of(found)["bus load"].found
    busy = checks_of(hears(mapped, load=0.72, others=500))["bus load"]
    assert busy.verdict == "warning"
    for part in ("72% measured, 500 frames of others", "% of the drive's bus at worst"):
        assert part in busy.found
    slow = planned(mapped, bench=edited(findings, *SLOW_BUS))
    assert checks_of(slow)["bus load"].verdict == "refused"
    alone = checks_of(replace(slow, in_process=True))["bus load"]
    assert (alone.verdict, "measured" in alone.found) == ("ok", False)


def test_nothing_is_missed_where_nobody_else_is_on_the_bus_or_nothing_leaves(findings: Findings) -> None:
    alone = replace(findings, in_process=True, watchdog="", realtime=None)
    for these in (alone, reads_only(findings)):
        assert {check.verdict for check in run_checks(these)} == {"ok"}


def test_on_the_way_home_the_brake_may_be_anywhere_inside_its_limits(findings: Findings) -> None:
    bench, layout = findings.plan.bench, findings.plan.layout
    homing = replace(findings, start_conditions=StartConditions(bench, layout, Bounds(bench), anywhere=True))
    for angle, verdict in ((-10.0, "ok"), (60.0, "ok"), (101.0, "refused")):
        turned = hears(homing, sample=SAMPLE._replace(angle=angle))
        assert checks_of(turned)["node state"].verdict == verdict


# --- listening ------------------------------------------------------------------------------------------------------


@pytest.fixture
def monitor(bench: Bench, layout: Layout) -> BusMonitor:
    return BusMonitor(layout, bench, lambda _frame, _why: None)


@pytest.fixture
def listened(bench: Bench, layout: Layout) -> Callable[..., BusMonitor]:
    """What a survey hears on the simulated bus within a second."""

    def run(options: str = "", angle: float = 0.0, change: Callable[[Frame], Frame | None] = lambda f: f) -> BusMonitor:
        transport, clock = open_sim(options, bench)
        transport.node.angle = angle
        monitor = BusMonitor(layout, bench, lambda _frame, _why: None)
        start_conditions = StartConditions(bench, layout, Bounds(bench), anywhere=False)

        def receive(deadline_ns: int) -> Frame | None:
            frame = transport.receive(deadline_ns)
            return None if frame is None else change(frame)

        def ready(sample: SensorSample, now_ns: int) -> bool:
            return not start_conditions.not_ready(monitor.status, sample, now_ns)

        listen(monitor, receive, clock, MS, clock.now_ns() + 1000 * MS, ready, lambda: False)
        return monitor

    return run


def test_a_node_that_is_ready_is_heard_just_long_enough(listened: Callable[..., BusMonitor], bench: Bench) -> None:
    heard = listened().statistics()
    assert heard.pairs == ENOUGH_PAIRS
    assert heard.period == pytest.approx(1e-3, abs=1e-12)
    assert heard.rates["EMB_Angle"] == pytest.approx(1000.0)
    assert heard.rates["EMB_Status"] == pytest.approx(10.0)
    assert heard.scatter.angle == pytest.approx(bench.noise.angle, rel=0.2)
    assert heard.scatter.velocity == pytest.approx(bench.noise.velocity, rel=0.2)
    assert (heard.missing, heard.others, heard.commanded, heard.distrusted) == (0, 0, False, False)
    assert heard.rejections == {}
    assert heard.load == pytest.approx(135 * sum(heard.frames.values()) / heard.duration / 1e6)


def test_a_node_that_is_not_ready_is_waited_for_until_the_deadline(listened: Callable[..., BusMonitor]) -> None:
    heard = listened(angle=3.0).statistics()
    assert heard.duration == pytest.approx(0.999, abs=0.002)
    assert heard.sample is not None
    assert heard.sample.angle == pytest.approx(3.0, abs=0.5)  # the clamped spring creeps


def test_the_scatter_is_that_of_the_samples_since_the_node_is_idle(listened: Callable[..., BusMonitor]) -> None:
    layout, angles = load_layout(), list[float]()

    def active_at_first(frame: Frame) -> Frame:
        if frame.identifier == layout.angle.identifier:
            angles.append(layout.decode_angle(frame).angle)
        if frame.identifier != layout.velocity.identifier or len(angles) > 120:
            return frame
        seen = layout.decode_velocity(frame)
        active = layout.encode_velocity(*seen._replace(node_state=NodeState.ACTIVE))
        return active._replace(time_ns=frame.time_ns)

    heard = listened(change=active_at_first).statistics()
    assert (heard.pairs, heard.scatter.pairs) == (ENOUGH_PAIRS, ENOUGH_PAIRS - 120)
    assert heard.scatter.angle == pytest.approx(statistics.stdev(angles[120:ENOUGH_PAIRS]))


def test_lost_frames_are_missing_pairs_and_damaged_ones_are_rejections(listened: Callable[..., BusMonitor]) -> None:
    count = 0

    def disturb(frame: Frame) -> Frame | None:
        nonlocal count
        count += 1
        if count == 100:
            return None
        return frame._replace(data=b"\x00" + frame.data[1:]) if count == 150 else frame

    heard = listened(change=disturb).statistics()
    assert heard.missing == 2
    assert sum(sum(reasons.values()) for reasons in heard.rejections.values()) == 1


def test_frames_from_before_the_listening_and_error_frames_are_no_traffic(bench: Bench, monitor: BusMonitor) -> None:
    transport, clock = open_sim("", bench)
    old = [Frame(0x700, b"", clock.now_ns() - 1) for _ in range(5)]
    other = [Frame(0x701, b"", clock.now_ns() + 1), Frame(0x020, bytes(8), clock.now_ns() + 1, error=True)]
    waiting = [*old, *other]

    def receive(deadline_ns: int) -> Frame | None:
        return waiting.pop(0) if waiting else transport.receive(deadline_ns)

    listen(monitor, receive, clock, MS, clock.now_ns() + 20 * MS, lambda *_: False, lambda: False)
    heard = monitor.statistics()
    assert heard.others == 1
    assert heard.bus_errors == {"no acknowledgement": 1}


def test_the_listening_ends_when_the_operator_says_so(bench: Bench, monitor: BusMonitor) -> None:
    transport, clock = open_sim("", bench)
    begin_ns = clock.now_ns()
    listen(monitor, transport.receive, clock, MS, begin_ns + 10**12, lambda *_: False, lambda: monitor.pairs >= 7)
    assert monitor.pairs == 7


# --- what came while nobody listened --------------------------------------------------------------------------------

NOW = 1_000 * MS
COMMAND = 0x80
FOREIGN = Frame(COMMAND, bytes(5), NOW - 3 * MS)
BUS_OFF = Frame(0x40, bytes(8), NOW - 2 * MS, error=True)
ORDINARY = (
    Frame(0x100, bytes(8), NOW - 4 * MS),
    Frame(COMMAND, bytes(5), NOW - 4 * MS, own=True),
    Frame(COMMAND, bytes(5), NOW - 4 * MS, extended=True),
    Frame(0x40, bytes(8), NOW - 4 * MS),
)


class Waiting:
    """A bus on which these frames wait."""

    name = "can0"
    truth = None
    obtained: Mapping[str, str] = {}

    def __init__(self, frames: Iterable[Frame]) -> None:
        self.frames = list(frames)
        self.typed: Callable[[str], object] = lambda _text: None

    def send(self, frame: Frame) -> None:
        raise AssertionError("nothing is sent here")

    def receive(self, deadline_ns: int) -> Frame | None:
        if len(self.frames) == 1:
            self.typed("y\n")
        return self.frames.pop(0) if self.frames else None

    def close(self) -> None:
        pass


def bus_of(*frames: Frame) -> tuple[Waiting, Bus]:
    waiting = Waiting(frames)
    return waiting, Bus("can0", waiting, SteppedClock(NOW, 0))


def test_of_what_piled_up_the_alarming_frames_are_kept_once_and_the_rest_is_dropped(layout: Layout) -> None:
    last = Frame(COMMAND + 1, b"", NOW + MS)
    _, bus = bus_of(*ORDINARY, FOREIGN, BUS_OFF, FOREIGN, BUS_OFF, last, last)
    assert drop_backlog(bus, layout) == (FOREIGN, BUS_OFF)
    assert drop_backlog(bus, layout) == ()


def test_the_frame_that_ends_the_dropping_is_looked_at_too(layout: Layout) -> None:
    fresh = FOREIGN._replace(time_ns=NOW)
    waiting, bus = bus_of(*ORDINARY, fresh, BUS_OFF)
    assert drop_backlog(bus, layout) == (fresh,)
    assert waiting.frames == [BUS_OFF]


def test_what_comes_while_the_operator_is_asked_is_kept_for_the_run(
    layout: Layout, keyboard: Keyboard, handlers: None
) -> None:
    plan = prepare(parser().parse_args(["--confirm"]))
    waiting, bus = bus_of(*ORDINARY, FOREIGN, BUS_OFF, *ORDINARY)
    waiting.typed = keyboard
    assert Operator(plan, StopRequest()).may_arm(bus)
    assert drop_backlog(bus, layout) == (FOREIGN, BUS_OFF)


@pytest.mark.parametrize(("frame", "commanded", "errors"), [(FOREIGN, True, 0), (BUS_OFF, False, 1)])
def test_the_pre_flight_sees_an_alarming_frame_that_came_before_it_listened(
    bench: Bench, layout: Layout, frame: Frame, commanded: bool, errors: int
) -> None:
    waiting, bus = bus_of(*ORDINARY, frame)
    monitor = BusMonitor(layout, bench, lambda _frame, _why: None)
    listen(monitor, waiting.receive, bus.clock, MS, NOW + 9 * MS, lambda *_: False, lambda: not waiting.frames)
    heard = monitor.statistics()
    assert (heard.commanded, len(heard.bus_errors)) == (commanded, errors)
    assert (heard.frames, heard.others) == ({}, 0)
