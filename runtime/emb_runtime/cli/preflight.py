"""Pre-flight: a table of checks on what was found, before anything is armed.

Pure: :class:`Findings` go in, one :class:`Check` of each of :data:`CHECKS` comes out. One that refuses has the
error with which the run ends, before any frame is sent.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from textwrap import shorten, wrap

from emb_runtime.cli.bus_monitor import BusStatistics, planned_load
from emb_runtime.cli.plan import Plan, Stage
from emb_runtime.config.bench import HIGHEST_BUS_LOAD
from emb_runtime.control.start_conditions import StartConditions
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_SAFETY_STOP, EXIT_USAGE, EmbError
from emb_runtime.safety.end_stop import released_speed
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.system.compiled_core import Core

RATE_TOLERANCE = 0.01
"""Largest relative deviation of the node's sample time from the bench's. The shield reckons with the bench's."""
MOST_MISSING = 0.1  # Share of the pairs that may be missing before --read-only calls the bus unfit
SCATTER_TOLERANCE = 2.0  # Times the bench's noise that a sensor may scatter at rest before a warning
DISK_RESERVE = 10.0  # Logs of this length for which there should be room

SLOW_MARK = "EMB_SLOW"
"""In the environment of a command in a kernel of ``emb-hil``: how many times time is slower there."""
SLOWLY = "emb-hil --slow 100"
OF_TIME = (Fault.NO_NODE, Fault.SENSOR_LOST, Fault.NODE_STOPPED, Fault.NOT_OBEYED, Fault.WATCHDOG_TRIPPED)
"""Faults that a computer causes which is busy with something else."""

WIDTHS = (13, 52, 40)  # Widths of the table's columns [characters]


class RefusedError(EmbError):
    """The run ends before anything was sent; with the pre-flight as far as it came, and the fault if it is one."""

    def __init__(self, message: str, exit_code: int, checks: Sequence[Check] = (), fault: Fault | None = None) -> None:
        super().__init__(message)
        self.exit_code = exit_code
        self.checks = tuple(checks)
        self.fault = fault


def interrupted(when: str, checks: Sequence[Check] = ()) -> RefusedError:
    """The operator's end of a command while no run goes on, with the words for when it came."""
    return RefusedError(f"stopped by the operator {when}", EXIT_SAFETY_STOP, checks, Fault.INTERRUPTED)


@dataclass(frozen=True)
class Check:
    """A check of the pre-flight, with what was found."""

    name: str
    found: str
    expected: str
    ok: bool = True
    fault: Fault | None = None  # Fault that it would be in a run where it is not ok
    refusal: int = EXIT_DONE  # Exit code of the command where it is not ok, and no fault; EXIT_DONE: a warning

    @property
    def exit_code(self) -> int:
        """Exit code with which it ends the command; EXIT_DONE if it does not."""
        return EXIT_DONE if self.ok else FAULTS[self.fault].exit_code if self.fault else self.refusal

    @property
    def verdict(self) -> str:
        """``ok``, ``warning`` or ``refused``."""
        return "ok" if self.ok else "refused" if self.exit_code else "warning"

    def document(self) -> dict[str, str]:
        """The check as plain data."""
        return {"what": self.name, "found": self.found, "expected": self.expected, "verdict": self.verdict}


@dataclass(frozen=True)
class Findings:
    """Findings that the checks look at."""

    plan: Plan
    start_conditions: StartConditions
    duration: float  # Duration of the run [s]
    statistics: BusStatistics
    bus: str  # Interface, in words
    in_process: bool  # Only this process can be on it
    end_stop_speed: float  # End-stop speed after a loss of all commands at the worst moment [rad/s]
    needed: int  # Expected size of the log [bytes]
    free: int  # Free space on its disk [bytes]
    watchdog: str  # Watchdog, in words; empty for none
    core: Core  # Compiled or not
    realtime: Mapping[str, str] | None
    """Real-time settings, see :func:`emb_runtime.system.realtime.obtain`; None where none were requested."""


def run_checks(findings: Findings) -> tuple[Check, ...]:
    """Run every check, in the order of the table."""
    return tuple(check(findings) for check in (*CHECKS, *((_drive,) if findings.plan.drive else ())))


def first_refusal(checks: Sequence[Check]) -> RefusedError | None:
    """The error of the first check that refuses; None if none does."""
    for check in checks:
        if check.exit_code:
            advice = f"; {advice_on(check.fault)}" if check.fault else ""
            message = f"pre-flight, {check.name}: {check.found}; expected {check.expected}{advice}"
            return RefusedError(message, check.exit_code, checks, check.fault)
    return None


def advice_on(fault: Fault) -> str:
    """Advice on a fault; for one that a busy computer causes, with what ``emb-hil`` can do about that."""
    slow = f"; on a busy computer: {SLOWLY}" if fault in OF_TIME and os.environ.get(SLOW_MARK) == "1" else ""
    return FAULTS[fault].advice + slow


def table(checks: Sequence[Check]) -> str:
    """The checks as text."""
    rows = [("PRE-FLIGHT", "FOUND", "EXPECTED", "VERDICT")]
    for check in checks:
        cells = wrap(check.name, WIDTHS[0]), wrap(check.found, WIDTHS[1]), wrap(check.expected, WIDTHS[2])
        rows += zip_longest(*cells, [check.verdict], fillvalue="")
    what, found, expected = WIDTHS
    return "\n".join(f"{a:<{what}}  {b:<{found}}  {c:<{expected}}  {d}".rstrip() for a, b, c, d in rows)


def counted(counts: Mapping[str, int]) -> str:
    """Counts by name as text: ``CRC (2), counter (1)``."""
    return ", ".join(f"{name} ({count})" for name, count in counts.items())


# --- the checks -----------------------------------------------------------------------------------------------------


def _stage(f: Findings) -> Check:
    stage, limit = f.plan.stage, f.plan.limit
    sent = {
        Stage.READ_ONLY: "nothing is sent",
        Stage.ZERO: "only 0 A is sent",
        Stage.LIMITED: f"at most {limit:g} A",
        Stage.FULL: f"up to {limit:g} A",
    }
    where = ", on the way home" if f.start_conditions.anywhere else ""
    return Check("stage", f"{stage}{where}: {sent[stage]}, for {f.duration:g} s", "as requested")


def _interface(f: Findings) -> Check:
    seen = f.statistics
    if seen.commanded:
        found = f"{f.bus}; commands of another sender"
        return Check("interface", found, "no other sender", ok=False, fault=Fault.FOREIGN_COMMAND)
    trouble = [f"{name} ({count})" for name, count in seen.bus_errors.items()]
    trouble += [f"{seen.dropped} frames dropped by the kernel"] if seen.dropped else []
    return Check("interface", "; ".join((f.bus, *trouble)), "open, without errors", ok=not trouble)


def _node(f: Findings) -> Check:
    status, silent = f.statistics.status, not f.statistics.frames
    identity = f"protocol {f.plan.layout.protocol_version}, bench {f.start_conditions.identity:#06x}"
    if problem := "no frame came" if silent else f.start_conditions.mismatch(status):
        return Check("node", problem, identity, ok=False, fault=Fault.NO_NODE if silent else Fault.NODE_NOT_READY)
    assert status is not None  # else it is a stranger
    found = f"protocol {status.protocol_version}, bench {status.bench_identity:#06x}"
    return Check("node", f"{found}, {status.rejected} commands rejected so far", identity)


def _state(f: Findings) -> Check:
    sample, status, home = f.statistics.sample, f.statistics.status, f.plan.bench.shield
    expected = f"IDLE, within {home.home_angle:g} rad and {home.home_velocity:g} rad/s of the origin"
    if f.start_conditions.anywhere:
        expected = "IDLE, inside the limits"
    if sample is None:
        problem = f.statistics.pairing_problem
        fault = Fault.NODE_NOT_READY if problem else Fault.NO_NODE
        return Check("node state", problem or "no valid sensor pair came", expected, ok=False, fault=fault)
    if problem := f.start_conditions.not_at_rest(sample):
        return Check("node state", problem, expected, ok=False, fault=Fault.NODE_NOT_READY)
    reason = f" (latest stop reason: {status.stop_reason.name})" if status else ""
    found = f"{sample.node_state.name}{reason}, at {sample.angle:.3f} rad and {sample.velocity:.1f} rad/s"
    return Check("node state", found, expected)


def _samples(f: Findings) -> Check:
    seen, period = f.statistics, f.plan.bench.timing.sample_time
    expected = f"a sample each {period * 1e3:g} ms, none missing or rejected"
    if not math.isfinite(seen.period):
        return Check("samples", f"{seen.pairs} sensor pairs", expected, ok=False, fault=Fault.NO_NODE)
    lost = seen.missing / max(1, seen.pairs + seen.missing)
    rejected = ", ".join(
        f"{name}: {why} ({n})" for name, reasons in seen.rejections.items() for why, n in reasons.items()
    )
    found = f"{seen.pairs}, each {seen.period * 1e3:g} ms, {seen.missing} missing ({100 * lost:.2g} %), "
    found += f"rejected {rejected}" if rejected else "none rejected"
    fault = Fault.FRAMES_REJECTED if seen.distrusted else None
    if fault is None and abs(seen.period / period - 1.0) > RATE_TOLERANCE:
        fault = Fault.NODE_NOT_READY
    if fault is None and f.plan.stage is Stage.READ_ONLY and lost > MOST_MISSING:
        return Check("samples", found, f"{expected}; at most {MOST_MISSING:.0%}", ok=False, refusal=EXIT_CHECK_FAILED)
    return Check("samples", found, expected, ok=not (fault or seen.missing or rejected), fault=fault)


def _noise(f: Findings) -> Check:
    (_, angle, velocity), noise = f.statistics.scatter, f.plan.bench.noise
    expected = (
        f"at most {SCATTER_TOLERANCE:g} times {noise.angle:g} rad and {noise.velocity:g} rad/s; the shield allows "
        f"for {f.plan.bench.shield.noise_sigmas:g} times that"
    )
    if not math.isfinite(angle + velocity):
        return Check("noise at rest", "unknown: no samples at rest", expected, ok=False)
    ok = angle <= SCATTER_TOLERANCE * noise.angle and velocity <= SCATTER_TOLERANCE * noise.velocity
    found = f"{angle:.2g} rad and {velocity:.2g} rad/s{'' if ok else ': noise, or a brake that still creeps'}"
    return Check("noise at rest", found, expected, ok)


def _bus_load(f: Findings) -> Check:
    plan, layout, seen, drive = f.plan, f.plan.layout, f.statistics, f.plan.drive
    bitrate, expected = plan.bench.can.bitrate, f"at most {HIGHEST_BUS_LOAD:.0%}"
    of_drive = ""
    if drive is not None:  # that it fits was checked with the mapping file
        load, rate = planned_load(plan.bench, layout, drive.mapping), drive.mapping.bitrate
        of_drive = f"{load:.0%} of the drive's bus at worst by its DBC at {rate} bit/s (its can.bitrate)"
        if f.in_process:  # in lock-step there is no other bus
            return Check("bus load", of_drive, expected)
    planned = layout.bus_load(bitrate)
    others = f", {seen.others} frames of others" if seen.others else ""
    found = f"{planned:.0%} at worst by the DBC at {bitrate} bit/s (can.bitrate), {seen.load:.0%} measured{others}"
    to_come = seen.load + layout.command.worst_bits / layout.command.cycle_time / bitrate
    return Check(
        "bus load",
        "; ".join(filter(None, (found, of_drive))),
        expected,
        ok=max(planned, to_come) <= HIGHEST_BUS_LOAD,
        refusal=EXIT_USAGE if planned > HIGHEST_BUS_LOAD else EXIT_DONE,
    )


def _disk(f: Findings) -> Check:
    found, expected = f"{f.free / 2**20:.0f} MiB free", f"{f.needed / 2**20:.1f} MiB for the log, and a reserve"
    refusal = EXIT_USAGE if f.free < f.needed else EXIT_DONE
    return Check("disk", found, expected, ok=f.free >= DISK_RESERVE * f.needed, refusal=refusal)


def _shield(f: Findings) -> Check:
    shield, node, sensors = f.plan.bench.shield, f.plan.bench.node, f.plan.bench.sensors
    # That the argument holds for this set was checked when the law was made.
    speed = f.end_stop_speed
    end = f"at worst into an end stop with {speed:.3g} rad/s" if speed else "which reaches no end stop"
    found = (
        f"{shield.envelope} envelope for '{shield.ranges}', margin {shield.angle_margin:g} rad; without commands a "
        f"{node.stop} stop, {end}{f'; the velocity is {sensors}' if sensors.velocity == 'observer' else ''}"
    )
    return Check("shield", found, "no brake of the set leaves its limits", ok=speed == 0.0)


def _slew(f: Findings) -> Check:
    limit, period, slew = f.plan.limit, f.plan.bench.timing.sample_time, f.plan.bench.guard.slew
    if not limit:
        return Check("slew", "no current is sent", "none needed")
    reversal = 2.0 * limit / slew
    ok = reversal <= period * (1.0 + 1e-9)
    found = f"{limit:g} A to {-limit:g} A in {reversal * 1e3:.3g} ms (guard.slew)"
    if not ok:
        found += f"; the way home may be {(reversal - period) * 1e3:.3g} ms late, and the node brake in its place"
    return Check("slew", found, f"at most {period * 1e3:g} ms: the shield assumes any current at once", ok)


def _policy(f: Findings) -> Check:
    if f.plan.experiment is None or f.start_conditions.anywhere:
        return Check("policy", "none", "none")
    policy = f.plan.experiment.policy
    provenance = ", ".join(f"{name} {value}" for name, value in policy.contract.provenance.items())
    parts = (f"{policy.contract.kind}, sha256 {policy.sha256[:12]}", shorten(provenance, 80, placeholder=" …"))
    found = "; ".join((", ".join(filter(None, parts)), *policy.warnings))
    return Check("policy", found, "fits this bench, reproduces its test vectors", ok=not policy.warnings)


def _watchdog(f: Findings) -> Check:
    if f.in_process or f.plan.stage is Stage.READ_ONLY:
        why = "no other process has this bus" if f.in_process else "nothing is sent"
        return Check("watchdog", "none needed", f"none: {why}")
    expected = "a process above the loop's priority"
    return Check("watchdog", f.watchdog or "NONE", expected, ok=bool(f.watchdog))


def _realtime(f: Findings) -> Check:
    if f.realtime is None:
        needed = not f.in_process and f.plan.stage is not Stage.READ_ONLY
        return Check("real time", "not requested", "all settings" if needed else "not needed", ok=not needed)
    settings = {name.replace("_", " "): value for name, value in f.realtime.items()}
    lacking = {name: value for name, value in settings.items() if value.startswith("not obtained")}
    found = "; ".join(f"{name}: {value}" for name, value in (lacking or settings).items())
    return Check("real time", found, "all settings", ok=not lacking)


def _core(f: Findings) -> Check:
    found = "; ".join(filter(None, (f.core.text, f.core.warning)))
    return Check("core", found, "compiled if installed, else Python", ok=not f.core.warning)


def _drive(f: Findings) -> Check:
    from emb_runtime.drives.mapping import PROPERTIES  # here, for most runs have no mapped drive

    assert f.plan.drive is not None
    drive, bench, serial = f.plan.drive.mapping, f.plan.bench, f.plan.label.serial
    lacks = "; ".join(f"{name} ({PROPERTIES[name]})" for name in drive.lost)
    speed, by = released_speed(bench, drive.watchdog), f", serial number {serial} by the operator" if serial else ""
    named = f"{drive.sha256[:12]}, as the bench file names it"
    if not bench.can.mapping:
        named = f'not named by the bench file (can.mapping = "{drive.sha256}")'
    found = (
        f"{drive.name}{by}, mapping {named}, time-out {drive.watchdog:g} s; after the worst loss of host or cable "
        f"below {speed:.4g} rad/s, the brake withstands {drive.end_stop_speed:g}; lacks {lacks}"
    )
    expected = "all of it accepted by name in the mapping file; the shield assumes shield.frame_age, and a host and a "
    return Check("drive", found, f"{expected}cable that are not lost", ok=False)


CHECKS: tuple[Callable[[Findings], Check], ...] = (
    *(_stage, _interface, _node, _state, _samples, _noise, _bus_load),
    *(_disk, _shield, _slew, _policy, _watchdog, _realtime, _core),
)
"""In the order of the table; the first that refuses ends the run."""
