"""Pre-flight: a table of checks on what was found, before anything is armed.

Pure: :class:`Findings` go in, one :class:`CheckResult` for each of :data:`CHECKS` comes out. A line that is refused
says with which error the run ends, before any frame has left.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import zip_longest
from textwrap import shorten, wrap
from typing import Any

from emb_runtime.can.messages import bench_identity
from emb_runtime.cli.bus_monitor import BusStatistics, planned_load
from emb_runtime.cli.options import Plan, Stage
from emb_runtime.config.bench import HIGHEST_BUS_LOAD
from emb_runtime.control.start_conditions import StartConditions
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_SAFETY_STOP, BenchFileError, EmbError, UsageError
from emb_runtime.safety.end_stop import released_speed
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.system.compiled_core import Core

RATE_TOLERANCE = 0.01
"""Largest relative deviation of the node's sample time from the bench's. The shield reckons with the bench's."""
MOST_MISSING = 0.1  # Share of the pairs that may be missing before --read-only calls the bus unfit
SCATTER_TOLERANCE = 2.0  # Times the bench's noise that a sensor may scatter at rest before a warning
DISK_RESERVE = 10.0  # Logs of this length for which there should be room

SLOW_MARK = (
    "EMB_SLOW"  # In the environment of a command in a kernel of ``emb-hil``: how many times time is slower there
)
SLOWLY = "emb-hil --slow 100"
OF_TIME = (Fault.NO_NODE, Fault.SENSOR_LOST, Fault.NODE_STOPPED, Fault.NOT_OBEYED, Fault.WATCHDOG_TRIPPED)
"""Faults that a computer causes which is busy with something else."""

WIDTHS = (13, 52, 40)  # Widths of the table's columns [characters]


class Verdict(StrEnum):
    """Verdict of a check."""

    OK = "ok"
    WARNING = "warning"
    REFUSED = "refused"


class RefusedError(EmbError):
    """The run ends before anything was sent; with the pre-flight as far as it came, and the fault if it is one."""

    def __init__(
        self, message: str, exit_code: int, lines: Sequence[CheckResult] = (), fault: Fault | None = None
    ) -> None:
        super().__init__(message)
        self.exit_code = exit_code
        self.lines = tuple(lines)
        self.fault = fault


def interrupted(when: str, lines: Sequence[CheckResult] = ()) -> RefusedError:
    """The operator's end of a command while no run goes on, with the words for when it came."""
    return RefusedError(f"stopped by the operator {when}", EXIT_SAFETY_STOP, lines, Fault.INTERRUPTED)


@dataclass(frozen=True)
class CheckResult:
    """Result of one check: a line of the table."""

    what: str
    found: str
    expected: str
    verdict: Verdict = Verdict.OK
    exit_code: int = 0  # Exit code of the command where the line is refused
    fault: Fault | None = None  # Fault that it would be in a run

    def document(self) -> dict[str, Any]:
        """The line as plain data."""
        return {"what": self.what, "found": self.found, "expected": self.expected, "verdict": str(self.verdict)}


@dataclass(frozen=True)
class Findings:
    """Findings that the checks look at."""

    plan: Plan
    start_conditions: StartConditions
    duration: float  # Duration of the run [s]
    heard: BusStatistics
    bus: str  # Interface, in words
    in_process: bool  # Only this process can be on it
    end_stop_speed: float  # End-stop speed after a loss of all commands at the worst moment [rad/s]
    needed: int  # Expected size of the log [bytes]
    free: int  # Free space on its disk [bytes]
    watchdog: str  # Watchdog, in words; empty for none
    core: Core  # Compiled or not
    realtime: Mapping[str, str] | None
    """Real-time settings, see :func:`emb_runtime.system.realtime.obtain`; None where none were asked for."""


def check(findings: Findings) -> tuple[CheckResult, ...]:
    """Run every check, in the order of the table."""
    return tuple(look(findings) for look in (*CHECKS, *((_drive,) if findings.plan.drive else ())))


def refuse(lines: Sequence[CheckResult]) -> None:
    """Raise RefusedError if a line is refused; the first one says why."""
    for line in lines:
        if line.verdict is Verdict.REFUSED:
            advice = "" if line.fault is None else f"; {advice_on(line.fault)}"
            raise RefusedError(
                f"pre-flight, {line.what}: {line.found}; expected {line.expected}{advice}",
                line.exit_code,
                lines,
                line.fault,
            )


def advice_on(fault: Fault) -> str:
    """Advice on a fault; for one that a busy computer causes, with what ``emb-hil`` can do about that."""
    slow = f"; on a busy computer: {SLOWLY}" if fault in OF_TIME and os.environ.get(SLOW_MARK) == "1" else ""
    return FAULTS[fault].advice + slow


def table(lines: Sequence[CheckResult]) -> str:
    """The lines for a person."""
    rows = [("PRE-FLIGHT", "FOUND", "EXPECTED", "VERDICT")]
    for line in lines:
        cells = (wrap(line.what, WIDTHS[0]), wrap(line.found, WIDTHS[1]), wrap(line.expected, WIDTHS[2]))
        rows += zip_longest(*cells, [str(line.verdict)], fillvalue="")
    what, found, expected = WIDTHS
    return "\n".join(f"{a:<{what}}  {b:<{found}}  {c:<{expected}}  {d}".rstrip() for a, b, c, d in rows)


# --- the checks -----------------------------------------------------------------------------------------------------


def _stage(f: Findings) -> CheckResult:
    says = {
        Stage.READ_ONLY: "nothing is sent",
        Stage.ZERO: "only 0 A is sent",
        Stage.LIMITED: f"at most {f.plan.limit:g} A",
        Stage.FULL: f"up to {f.plan.limit:g} A",
    }
    where = "" if not f.start_conditions.anywhere else ", on the way home"
    return CheckResult("stage", f"{f.plan.stage}{where}: {says[f.plan.stage]}, for {f.duration:g} s", "as asked for")


def _interface(f: Findings) -> CheckResult:
    heard = f.heard
    if heard.commanded:
        return _faulty("interface", Fault.FOREIGN_COMMAND, f"{f.bus}; commands of another sender", "no other sender")
    trouble = [f"{name} ({count})" for name, count in heard.bus_errors.items()]
    trouble += [f"{heard.dropped} frames dropped by the kernel"] if heard.dropped else []
    return _line("interface", f"{f.bus}{''.join(f'; {t}' for t in trouble)}", "open, without errors", not trouble)


def _node(f: Findings) -> CheckResult:
    status = f.heard.status
    identity = f"protocol {f.plan.layout.protocol_version}, bench {bench_identity(f.plan.bench.identity_hash):#06x}"
    if not f.heard.frames:
        return _faulty("node", Fault.NO_NODE, "no frame came", identity)
    if why := f.start_conditions.mismatch(status):
        return _faulty("node", Fault.NODE_NOT_READY, why, identity)
    assert status is not None  # else it is a stranger
    found = f"protocol {status.protocol_version}, bench {status.bench_identity:#06x}"
    return CheckResult("node", f"{found}, {status.rejected} commands rejected so far", identity)


def _state(f: Findings) -> CheckResult:
    sample, home = f.heard.sample, f.plan.bench.shield
    expected = f"IDLE, within {home.home_angle:g} rad and {home.home_velocity:g} rad/s of the origin"
    if f.start_conditions.anywhere:
        expected = "IDLE, inside the limits"
    if sample is None and f.heard.pairing_problem:
        return _faulty("node state", Fault.NODE_NOT_READY, f.heard.pairing_problem, expected)
    if sample is None:
        return _faulty("node state", Fault.NO_NODE, "no valid sensor pair came", expected)
    if why := f.start_conditions.not_at_rest(sample):
        return _faulty("node state", Fault.NODE_NOT_READY, why, expected)
    reason = "" if f.heard.status is None else f" (latest stop reason: {f.heard.status.stop_reason.name})"
    found = f"{sample.node_state.name}{reason}, at {sample.angle:.3f} rad and {sample.velocity:.1f} rad/s"
    return CheckResult("node state", found, expected)


def _rate(f: Findings) -> CheckResult:
    heard, period = f.heard, f.plan.bench.timing.sample_time
    expected = f"a sample each {period * 1e3:g} ms, none missing or rejected"
    if not math.isfinite(heard.period):
        return _faulty("samples", Fault.NO_NODE, f"{heard.pairs} sensor pairs", expected)
    rejected = [f"{name}: {why} ({n})" for name, reasons in heard.rejections.items() for why, n in reasons.items()]
    lost = heard.missing / max(1, heard.pairs + heard.missing)
    found = f"{heard.pairs}, each {heard.period * 1e3:g} ms, {heard.missing} missing ({100 * lost:.2g} %), "
    found += f"rejected {', '.join(rejected)}" if rejected else "none rejected"
    if heard.distrusted:
        return _faulty("samples", Fault.FRAMES_REJECTED, found, expected)
    if abs(heard.period / period - 1.0) > RATE_TOLERANCE:
        return _faulty("samples", Fault.NODE_NOT_READY, found, expected)
    if f.plan.stage is Stage.READ_ONLY and lost > MOST_MISSING:
        return CheckResult(
            "samples", found, f"{expected}; at most {MOST_MISSING:.0%}", Verdict.REFUSED, EXIT_CHECK_FAILED
        )
    return _line("samples", found, expected, not (heard.missing or rejected))


def _noise(f: Findings) -> CheckResult:
    heard, noise = f.heard, f.plan.bench.noise
    expected = (
        f"at most {SCATTER_TOLERANCE:g} times {noise.angle:g} rad and {noise.velocity:g} rad/s; the shield allows "
        f"for {f.plan.bench.shield.noise_sigmas:g} times that"
    )
    if not (math.isfinite(heard.angle_scatter) and math.isfinite(heard.velocity_scatter)):
        return _line("noise at rest", "not known: no samples at rest", expected, good=False)
    good = heard.angle_scatter <= SCATTER_TOLERANCE * noise.angle
    good = good and heard.velocity_scatter <= SCATTER_TOLERANCE * noise.velocity
    found = f"{heard.angle_scatter:.2g} rad and {heard.velocity_scatter:.2g} rad/s"
    return _line("noise at rest", found if good else f"{found}: noise, or a brake that still creeps", expected, good)


def _bus_load(f: Findings) -> CheckResult:
    bitrate, command = f.plan.bench.can.bitrate, f.plan.layout.command
    expected = f"at most {HIGHEST_BUS_LOAD:.0%}"
    of_drive = ""
    if f.plan.drive is not None:  # that it fits was checked with the mapping file
        drive = f.plan.drive.mapping
        load = planned_load(f.plan.bench, f.plan.layout, drive)
        of_drive = f"{load:.0%} of the drive's bus at worst by its DBC at {drive.bitrate} bit/s (its can.bitrate)"
    if of_drive and f.in_process:  # in lock-step there is no other bus
        return CheckResult("bus load", of_drive, expected)
    planned = f.plan.layout.bus_load(bitrate)
    found = f"{planned:.0%} at worst by the DBC at {bitrate} bit/s (can.bitrate), {f.heard.load:.0%} measured"
    found += f", {f.heard.others} frames of others" if f.heard.others else ""
    found += f"; {of_drive}" if of_drive else ""
    if planned > HIGHEST_BUS_LOAD:
        return CheckResult("bus load", found, expected, Verdict.REFUSED, BenchFileError.exit_code)
    to_come = f.heard.load + command.worst_bits / command.cycle_time / bitrate
    return _line("bus load", found, expected, to_come <= HIGHEST_BUS_LOAD)


def _disk(f: Findings) -> CheckResult:
    found, expected = f"{f.free / 2**20:.0f} MiB free", f"{f.needed / 2**20:.1f} MiB for the log, and a reserve"
    if f.free < f.needed:
        return CheckResult("disk", found, expected, Verdict.REFUSED, UsageError.exit_code)
    return _line("disk", found, expected, f.free >= DISK_RESERVE * f.needed)


def _shield(f: Findings) -> CheckResult:
    shield, node = f.plan.bench.shield, f.plan.bench.node
    # That the argument holds for this set was checked when the law was made.
    speed = f.end_stop_speed
    end = f"at worst into an end stop with {speed:.3g} rad/s" if speed else "which reaches no end stop"
    found = (
        f"{shield.envelope} envelope for '{shield.ranges}', margin {shield.angle_margin:g} rad; without commands a "
        f"{node.stop} stop, {end}"
    )
    if (sensors := f.plan.bench.sensors).velocity == "observer":
        found += f"; the velocity is {sensors}"
    return _line("shield", found, "no brake of the set leaves its limits", speed == 0.0)


def _slew(f: Findings) -> CheckResult:
    if not f.plan.limit:
        return CheckResult("slew", "no current is sent", "none needed")
    period, slew = f.plan.bench.timing.sample_time, f.plan.bench.guard.slew
    reversal = 2.0 * f.plan.limit / slew
    expected = f"at most {period * 1e3:g} ms: the shield assumes any current at once"
    found = f"{f.plan.limit:g} A to {-f.plan.limit:g} A in {reversal * 1e3:.3g} ms (guard.slew)"
    if good := reversal <= period * (1.0 + 1e-9):
        return _line("slew", found, expected, good)
    late = f"; the way home may be {(reversal - period) * 1e3:.3g} ms late, and the node brake in its place"
    return _line("slew", found + late, expected, good)


def _policy(f: Findings) -> CheckResult:
    policy = f.plan.policy
    if policy is None or f.plan.stage is Stage.READ_ONLY or f.start_conditions.anywhere:
        return CheckResult("policy", "none", "none")
    provenance = ", ".join(f"{name} {value}" for name, value in policy.contract.provenance.items())
    made = shorten(provenance, 80, placeholder=" …")
    parts = (f"{policy.contract.kind}, sha256 {policy.sha256[:12]}", made)
    found = "; ".join((", ".join(filter(None, parts)), *policy.warnings))
    return _line("policy", found, "fits this bench, reproduces its test vectors", not policy.warnings)


def _watchdog(f: Findings) -> CheckResult:
    if f.in_process or f.plan.stage is Stage.READ_ONLY:
        return CheckResult(
            "watchdog",
            "none needed",
            "none: no other process has this bus" if f.in_process else "none: nothing is sent",
        )
    return _line("watchdog", f.watchdog or "NONE", "a process of its own, above the loop's priority", bool(f.watchdog))


def _realtime(f: Findings) -> CheckResult:
    if f.realtime is None:
        none_needed = f.in_process or f.plan.stage is Stage.READ_ONLY
        return _line("real time", "not asked for", "not needed" if none_needed else "all settings", none_needed)
    settings = {name.replace("_", " "): value for name, value in f.realtime.items()}
    lacking = {name: value for name, value in settings.items() if value.startswith("not obtained")}
    found = "; ".join(f"{name}: {value}" for name, value in (lacking or settings).items())
    return _line("real time", found, "all settings", not lacking)


def _core(f: Findings) -> CheckResult:
    found = f.core.text + (f"; {f.core.warning}" if f.core.warning else "")
    return _line("core", found, "compiled if installed, else Python", not f.core.warning)


def _drive(f: Findings) -> CheckResult:
    from emb_runtime.drives.mapping import PROPERTIES  # here, for most runs have no mapped drive

    assert f.plan.drive is not None
    drive = f.plan.drive.mapping
    lacks = "; ".join(f"{name} ({PROPERTIES[name]})" for name in drive.lost)
    speed = released_speed(f.plan.bench, drive.watchdog)
    named = f"{drive.sha256[:12]}, as the bench file names it"
    if not f.plan.bench.can.mapping:
        named = f'not named by the bench file (can.mapping = "{drive.sha256}")'
    serial = f", serial number {f.plan.serial} by the operator" if f.plan.serial else ""
    found = f"{drive.name}{serial}, mapping {named}, time-out {drive.watchdog:g} s; after the worst loss of host or "
    found += f"cable below {speed:.4g} rad/s, the brake withstands {drive.end_stop_speed:g}; lacks {lacks}"
    expected = "all of it accepted by name in the mapping file; the shield assumes shield.frame_age, and a host and a "
    return CheckResult("drive", found, f"{expected}cable that are not lost", Verdict.WARNING)


CHECKS: tuple[Callable[[Findings], CheckResult], ...] = (
    *(_stage, _interface, _node, _state, _rate, _noise, _bus_load),
    *(_disk, _shield, _slew, _policy, _watchdog, _realtime, _core),
)
"""In the order of the table; the first that refuses says why."""


def _line(what: str, found: str, expected: str, good: bool) -> CheckResult:
    return CheckResult(what, found, expected, Verdict.OK if good else Verdict.WARNING)


def _faulty(what: str, fault: Fault, found: str, expected: str) -> CheckResult:
    return CheckResult(what, found, expected, Verdict.REFUSED, FAULTS[fault].exit_code, fault)
