"""The pre-flight: what it makes of what was heard, line by line, and what may not be armed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from emb_bench.sim.transport import open_sim
from emb_runtime.can.messages import Layout, StatusFrame, StopReason, load_layout
from emb_runtime.cli.bus_monitor import ENOUGH_PAIRS, BusMonitor, BusStatistics, listen
from emb_runtime.cli.options import Stage
from emb_runtime.cli.preflight import CHECKS, CheckResult, Findings, RefusedError, Verdict, check, refuse, table
from emb_runtime.config.bench import Bench, parse_bench
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import EXIT_BUS, EXIT_CHECK_FAILED, EXIT_SAFETY_STOP, EXIT_USAGE
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system.compiled_core import Core
from tests.drives import EXAMPLES
from tests.independent import encoded

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
        rejections={},
        distrusted=False,
        bus_errors={},
        dropped=0,
        commanded=False,
        status=status,
        sample=SAMPLE,
        pairs=200,
        missing=0,
        period=1e-3,
        angle_scatter=bench.noise.angle,
        velocity_scatter=bench.noise.velocity,
        creep=0.0,
        load=0.27,
    )


@pytest.fixture
def findings(bench: Bench, layout: Layout, heard: BusStatistics) -> Findings:
    """Everything as it should be, on a real bus."""
    return Findings(
        bench=bench,
        layout=layout,
        end_stop_speed=0.0,
        stage=Stage.FULL,
        limit=6.0,
        duration=0.5,
        start_conditions=StartConditions(bench, layout, Bounds(bench), anywhere=False),
        bus="can0, receive buffer 8388608 bytes",
        in_process=False,
        heard=heard,
        policy={"sha256": "ab" * 32, "kind": "current", "beyond": "", "provenance": ""},
        needed=400_000,
        free=1 << 33,
        watchdog="process 4711, heartbeat 5 ms, FIFO 90",
        core=Core(compiled=True, text="compiled (mypyc, x86-64)"),
        drive=None,
        serial="",
        realtime={"scheduler": "FIFO 80", "memory_lock": "current and future pages"},
    )


def lines_of(findings: Findings) -> dict[str, CheckResult]:
    return {line.what: line for line in check(findings)}


def test_a_compiled_core_that_is_not_taken_is_a_warning_with_its_reason(findings: Findings) -> None:
    refused = Core(
        compiled=False, text="Python", warning="the compiled core is not taken: it was compiled from another"
    )
    line = lines_of(replace(findings, core=refused))["core"]
    assert line.verdict is Verdict.WARNING
    assert line.found == f"Python; {refused.warning}"


def test_a_bench_that_is_as_it_should_be_is_ok_in_every_line(findings: Findings) -> None:
    lines = check(findings)
    assert [line.verdict for line in lines] == [Verdict.OK] * len(CHECKS)
    assert len({line.what for line in lines}) == len(CHECKS)
    refuse(lines)


NOT_READY = Fault.NODE_NOT_READY
REFUSED: dict[str, tuple[dict[str, Any], str, Fault]] = {
    "nothing heard": ({"frames": {}, "status": None, "sample": None}, "node", Fault.NO_NODE),
    "no status": ({"status": None}, "node", NOT_READY),
    "another protocol": ({"status": STATUS._replace(protocol_version=2)}, "node", NOT_READY),
    "another bench": ({"status": STATUS._replace(bench_identity=0x1234)}, "node", NOT_READY),
    "no valid pair": ({"sample": None, "pairs": 0}, "node state", Fault.NO_NODE),
    "in its safe stop": ({"sample": SAMPLE._replace(node_state=NodeState.STOPPING)}, "node state", NOT_READY),
    "away from home": ({"sample": SAMPLE._replace(angle=2.0)}, "node state", NOT_READY),
    "moving": ({"sample": SAMPLE._replace(velocity=-40.0)}, "node state", NOT_READY),
    "another rate": ({"period": 1.02e-3}, "samples", NOT_READY),
    "no rate": ({"period": math.nan, "pairs": 1}, "samples", Fault.NO_NODE),
    "damaged frames": (
        {"rejections": {"EMB_Angle": {"CRC": 90}}, "distrusted": True},
        "samples",
        Fault.FRAMES_REJECTED,
    ),
    "another commander": ({"commanded": True}, "interface", Fault.FOREIGN_COMMAND),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_was_heard_that_refuses_does_so_with_its_error(
    findings: Findings, heard: BusStatistics, name: str
) -> None:
    changes, what, fault = REFUSED[name]
    lines = check(replace(findings, heard=replace(heard, **changes)))
    with pytest.raises(RefusedError) as refused:
        refuse(lines)
    assert (refused.value.fault, refused.value.exit_code) == (
        fault,
        EXIT_BUS if fault is Fault.NO_NODE else EXIT_SAFETY_STOP,
    )
    assert str(refused.value).startswith(f"pre-flight, {what}: ")
    assert refused.value.lines == lines


def test_with_read_only_a_tenth_of_the_samples_missing_is_a_failed_check(
    findings: Findings, heard: BusStatistics
) -> None:
    reading = replace(findings, stage=Stage.READ_ONLY, watchdog="", realtime=None, policy=None)
    for missing, verdict in ((20, Verdict.WARNING), (25, Verdict.REFUSED), (170, Verdict.REFUSED)):
        lines = check(replace(reading, heard=replace(heard, pairs=200, missing=missing)))
        assert {line.what: line.verdict for line in lines}["samples"] is verdict
        assert lines_of(replace(findings, heard=replace(heard, missing=missing)))["samples"].verdict is Verdict.WARNING
    with pytest.raises(RefusedError, match=r"170 missing \(0\.46 of all\).*at most 10%") as refused:
        refuse(lines)
    assert (refused.value.exit_code, refused.value.fault) == (EXIT_CHECK_FAILED, None)


@pytest.mark.parametrize(
    ("slew", "limit", "verdict", "found"),
    [
        (12000.0, 6.0, Verdict.OK, "6 A to -6 A in 1 ms"),
        (11999.0, 6.0, Verdict.WARNING, "6 A to -6 A in 1 ms"),
        (1500.0, 6.0, Verdict.WARNING, "in 8 ms (guard.slew); the way home may be 7 ms late"),
        (1500.0, 0.75, Verdict.OK, "0.75 A to -0.75 A in 1 ms"),
        (1500.0, 0.0, Verdict.OK, "no current leaves"),
    ],
)
def test_a_slew_that_cannot_turn_the_current_round_in_a_period_is_told(
    findings: Findings, slew: float, limit: float, verdict: Verdict, found: str
) -> None:
    bench = parse_bench(findings.bench.text.replace("slew          = 12000.0", f"slew = {slew}"), "t")
    line = lines_of(replace(findings, bench=bench, limit=limit))["slew"]
    assert line.verdict is verdict
    assert found in line.found


def test_a_brake_that_still_creeps_is_not_taken_for_a_noisy_sensor(findings: Findings, heard: BusStatistics) -> None:
    line = lines_of(replace(findings, heard=replace(heard, creep=-0.07)))["noise at rest"]
    assert line.verdict is Verdict.OK
    assert "the brake is not at rest, it creeps at -0.07 rad/s" in line.found


WARNED: dict[str, tuple[dict[str, Any], str]] = {
    "controller errors": ({"bus_errors": {"no acknowledgement": 3}}, "interface"),
    "frames dropped": ({"dropped": 7}, "interface"),
    "missing pairs": ({"missing": 2}, "samples"),
    "rejected frames": ({"rejections": {"EMB_Angle": {"CRC": 1}}}, "samples"),
    "a noisy angle": ({"angle_scatter": 2.1e-3}, "noise at rest"),
    "a noisy velocity": ({"velocity_scatter": 2.1}, "noise at rest"),
    "no noise known": ({"velocity_scatter": math.nan}, "noise at rest"),
    "a busy bus": ({"load": 0.72, "others": 500}, "bus load"),
}


@pytest.mark.parametrize("name", WARNED)
def test_what_was_heard_that_only_warns_stands_in_its_line_alone(
    findings: Findings, heard: BusStatistics, name: str
) -> None:
    changes, what = WARNED[name]
    lines = check(replace(findings, heard=replace(heard, **changes)))
    assert [line.what for line in lines if line.verdict is Verdict.WARNING] == [what]
    refuse(lines)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"free": 3_000_000}, "disk"),
        ({"watchdog": ""}, "watchdog"),
        ({"realtime": {"scheduler": "not obtained: Operation not permitted"}}, "real time"),
        ({"realtime": None}, "real time"),
        ({"end_stop_speed": 214.0}, "shield"),
    ],
)
def test_what_this_computer_lacks_is_a_warning(findings: Findings, changes: dict[str, Any], what: str) -> None:
    lines = check(replace(findings, **changes))
    assert [line.what for line in lines if line.verdict is not Verdict.OK] == [what]
    refuse(lines)


def test_a_disk_too_small_for_the_log_refuses_as_a_usage_error(findings: Findings) -> None:
    with pytest.raises(RefusedError, match="disk") as refused:
        refuse(check(replace(findings, free=399_999)))
    assert (refused.value.exit_code, refused.value.fault) == (EXIT_USAGE, None)


def test_the_serial_number_of_a_mapped_drive_is_shown(findings: Findings) -> None:
    line = lines_of(replace(findings, drive=load_mapping(EXAMPLES / "odrive.toml"), serial="SN 12"))["drive"]
    assert line.verdict is Verdict.WARNING
    assert line.found.startswith("ODrive CANSimple, axis 0, serial number SN 12 by the operator, mapping ")


def test_a_bit_rate_that_cannot_carry_the_messages_refuses(findings: Findings) -> None:
    slow = parse_bench(findings.bench.text.replace("bitrate = 1000000", "bitrate = 250000"), "slow")
    with pytest.raises(RefusedError, match="bus load") as refused:
        refuse(check(replace(findings, bench=slow)))
    assert refused.value.exit_code == EXIT_USAGE


def test_the_bus_load_is_the_worst_case_of_davis_and_others_worked_out_by_hand(findings: Findings) -> None:
    # 5 bytes: 34 + 40 stuffable bits, 18 stuff bits, 13 more: 105. 8 bytes: 98 + 24 + 13 = 135.
    percent = 100.0 * (1000 * 105 + 2000 * 135 + 10 * 135) / 1e6
    assert f"{percent:.0f}% at worst" in lines_of(findings)["bus load"].found


def test_the_load_of_the_node_s_bus_is_judged_beside_that_of_a_mapped_drive_s(
    findings: Findings, heard: BusStatistics
) -> None:
    mapped = replace(findings, drive=load_mapping(EXAMPLES / "odrive.toml"))
    assert lines_of(mapped)["bus load"].verdict is Verdict.OK
    busy = lines_of(replace(mapped, heard=replace(heard, load=0.72, others=500)))["bus load"]
    assert busy.verdict is Verdict.WARNING
    for part in ("38% at worst", "72% heard, 500 frames of others", "% of the drive's bus at worst"):
        assert part in busy.found
    slow = parse_bench(findings.bench.text.replace("bitrate = 1000000", "bitrate = 250000"), "slow")
    assert lines_of(replace(mapped, bench=slow))["bus load"].verdict is Verdict.REFUSED
    alone = lines_of(replace(mapped, bench=slow, in_process=True))["bus load"]
    assert (alone.verdict, "heard" in alone.found) == (Verdict.OK, False)


def test_nothing_is_missed_where_nobody_else_is_on_the_bus_or_nothing_leaves(findings: Findings) -> None:
    alone = replace(findings, in_process=True, watchdog="", realtime=None)
    reading = replace(findings, stage=Stage.READ_ONLY, watchdog="", realtime=None, policy=None)
    for these in (alone, reading):
        assert {line.verdict for line in check(these)} == {Verdict.OK}


def test_on_the_way_home_the_brake_may_be_anywhere_inside_its_limits(findings: Findings, heard: BusStatistics) -> None:
    homing = replace(
        findings,
        start_conditions=StartConditions(
            findings.bench, findings.layout, findings.start_conditions.bounds, anywhere=True
        ),
    )
    for angle, verdict in ((-10.0, Verdict.OK), (60.0, Verdict.OK), (101.0, Verdict.REFUSED)):
        turned = replace(homing, heard=replace(heard, sample=SAMPLE._replace(angle=angle)))
        assert lines_of(turned)["node state"].verdict is verdict


def test_the_first_refused_line_is_the_one_that_counts(findings: Findings, heard: BusStatistics) -> None:
    with pytest.raises(RefusedError, match="pre-flight, node:"):
        refuse(check(replace(findings, free=0, heard=replace(heard, frames={}, sample=None, status=None))))


def test_the_table_has_every_line_with_what_was_found_and_expected(findings: Findings, heard: BusStatistics) -> None:
    lines = check(replace(findings, heard=replace(heard, missing=2)))
    text = table(lines)
    rows = text.splitlines()
    assert rows[0].split() == ["PRE-FLIGHT", "FOUND", "EXPECTED", "VERDICT"]
    assert all(any(row.startswith(line.what) for row in rows) for line in lines)
    assert [row.split()[-1] for row in rows if row.startswith("samples")] == ["warning"]
    assert max(map(len, rows)) <= 120


def test_no_check_fails_on_numbers_that_are_not_finite(findings: Findings, heard: BusStatistics) -> None:
    odd = replace(heard, period=math.nan, angle_scatter=math.inf, velocity_scatter=math.nan, duration=0.0, load=0.0)
    assert len(check(replace(findings, heard=odd))) == len(CHECKS)


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
    assert heard.angle_scatter == pytest.approx(bench.noise.angle, rel=0.2)
    assert heard.velocity_scatter == pytest.approx(bench.noise.velocity, rel=0.2)
    assert (heard.missing, heard.others, heard.commanded, heard.distrusted) == (0, 0, False, False)
    assert heard.rejections == {}


def test_the_load_that_is_heard_is_that_of_the_frames(listened: Callable[..., BusMonitor]) -> None:
    heard = listened().statistics()
    assert heard.load == pytest.approx(135 * sum(heard.frames.values()) / heard.duration / 1e6)


def test_a_node_that_is_not_ready_is_waited_for_until_the_deadline(listened: Callable[..., BusMonitor]) -> None:
    heard = listened(angle=3.0).statistics()
    assert heard.duration == pytest.approx(0.999, abs=0.002)
    assert heard.sample is not None
    assert heard.sample.angle == pytest.approx(3.0, abs=0.5)  # the clamped spring creeps


def test_the_scatter_is_that_about_a_line_so_that_a_creep_is_no_noise(listened: Callable[..., BusMonitor]) -> None:
    angles: list[float] = []
    monitor = listened(change=lambda frame: frame)
    assert monitor.statistics().creep == 0.0

    def drift(frame: Frame) -> Frame:
        if frame.identifier != 0x100:
            return frame
        layout = load_layout()
        seen = layout.decode_angle(frame)
        angles.append(seen.angle + 2e-4 * len(angles))
        values = {"Counter": seen.counter, "Angle": angles[-1], "DeviceTime": seen.device_time_ns * 1e-9}
        return encoded(frame.identifier, values)._replace(time_ns=frame.time_ns)

    heard = listened(change=drift).statistics()
    recent = np.array(angles[:200])
    slope, level = np.polyfit(np.arange(200) * 1e-3, recent, 1)
    rest = recent - level - slope * np.arange(200) * 1e-3
    assert heard.pairs == 200
    assert heard.creep == pytest.approx(slope, rel=1e-3)
    assert heard.creep == pytest.approx(0.2, rel=0.05)
    assert heard.angle_scatter == pytest.approx(np.sqrt(rest @ rest / 198), rel=1e-3)
    assert np.std(recent) > 10 * heard.angle_scatter


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


def test_a_source_whose_frames_are_mostly_damaged_is_not_trusted(listened: Callable[..., BusMonitor]) -> None:
    def damage(frame: Frame) -> Frame:
        return frame._replace(data=b"\x00" + frame.data[1:])

    heard = listened(change=damage).statistics()
    assert heard.distrusted
    assert heard.pairs < 20  # a CRC of zero is right once in a while


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


def test_a_silent_bus_is_nothing_heard(bench: Bench, monitor: BusMonitor) -> None:
    transport, clock = open_sim("", bench)

    def nothing(deadline_ns: int) -> None:
        while transport.receive(deadline_ns) is not None:
            pass

    listen(monitor, nothing, clock, MS, clock.now_ns() + 300 * MS, lambda *_: True, lambda: False)
    heard = monitor.statistics()
    assert (heard.frames, heard.pairs, heard.status, heard.load, heard.duration) == ({}, 0, None, 0.0, 0.0)
    assert math.isnan(heard.period)
    assert math.isnan(heard.angle_scatter)
