"""One run on an open bus: watchdog, real time, pre-flight, leave of the operator, recorder, loop, and what came of it.

The recorder and the watchdog are other processes; they inherit nothing of the loop's scheduling.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emb_runtime.can.messages import Layout
from emb_runtime.can.transport import Transport
from emb_runtime.cli.bus_monitor import BusMonitor, BusStatistics, is_alarming, listen
from emb_runtime.cli.documents import (
    DONE,
    REFUSED,
    RunResult,
    header,
    log_bytes,
    log_document,
    log_entries,
    reading,
    trailer,
)
from emb_runtime.cli.plan import Plan
from emb_runtime.cli.preflight import Check, Findings, first_refusal, interrupted, run_checks
from emb_runtime.control.actor import Actor, Still, homing_steps
from emb_runtime.control.core import Core
from emb_runtime.control.loop import Loop
from emb_runtime.control.setup import Setup
from emb_runtime.control.start_conditions import StartConditions
from emb_runtime.errors import EXIT_DONE, EXIT_LOG, BusError, EmbError, LogError, UsageError
from emb_runtime.log.recorder import Recorder
from emb_runtime.log.ring_buffer import ClockRecord, EventRecord, FrameRecord
from emb_runtime.records import Frame, RunState, RunType, SensorSample
from emb_runtime.safety.end_stop import end_stop_speed
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import Unwatched
from emb_runtime.safety.state_machine import Fault
from emb_runtime.safety.watchdog import WatchdogHandle
from emb_runtime.system import compiled_core, realtime
from emb_runtime.system.clock import Clock


@dataclass(frozen=True)
class Bus:
    """An open bus, and the time on it."""

    iface: str  # Interface as it was opened
    transport: Transport
    clock: Clock
    overheard: dict[tuple[bool, int], Frame] = field(default_factory=dict)
    """Alarming frames that came between two runs, the first of each kind: the next run's loop takes them."""

    @property
    def simulated(self) -> bool:
        """Returns True if its time stands still while nobody waits for a frame."""
        return self.transport.truth is not None

    @property
    def in_process(self) -> bool:
        """Returns True if nobody but this process can be on it."""
        return self.simulated

    def pass_over(self, frame: Frame, layout: Layout) -> None:
        """Drop a frame, unless it is alarming."""
        if is_alarming(frame, layout):
            self.overheard.setdefault((frame.error, frame.identifier), frame)


class Console:
    """User interface; this one shows nothing, agrees, and never stops."""

    stop_requested: Callable[[], bool] = staticmethod(lambda: False)  # Returns True once the operator ends it

    def show(self, checks: tuple[Check, ...], bus: Bus) -> None:
        """Show the pre-flight."""

    def may_arm(self, bus: Bus) -> bool:
        """Returns True if anything may be armed."""
        return True


def conduct(plan: Plan, bus: Bus, run_type: RunType, path: Path, console: Console) -> RunResult:
    """Run the experiment, or a way home, on an open bus with a new log.

    Raises:
        RefusedError: the pre-flight or the operator refused; nothing was sent.
        UsageError: the log cannot be written; nothing was sent.
        BusError: the bus was lost before anything was sent, or cannot be watched.
    """
    experiment, homing = plan.experiment, run_type is RunType.HOMING
    assert experiment is not None
    steps = homing_steps(plan.bench) if homing else experiment.law.steps
    actor: Actor = Still() if homing else experiment.policy
    with ExitStack() as stack:
        watchdog = _watch(plan, bus, stack)
        obtained = realtime.obtain() if plan.precautions.real_time and not bus.simulated else None
        start_conditions = plan.start_conditions(anywhere=homing)
        statistics = observe(plan, bus, start_conditions, console.stop_requested)
        duration = steps * plan.bench.timing.sample_time
        checks = run_checks(findings(plan, bus, start_conditions, statistics, duration, path, watchdog, obtained))
        console.show(checks, bus)
        if (refused := first_refusal(checks)) is not None:
            raise refused
        if not console.may_arm(bus):
            raise interrupted("before anything was sent", checks)
        recorder = start_recorder(plan, bus, run_type, path, checks, steps)
        outcome = result = None
        try:
            push_clock(recorder, bus.clock)
            pulse = watchdog.pulse if watchdog is not None else Unwatched()
            setup = Setup(
                bench=plan.bench,
                layout=plan.layout,
                law=experiment.law._replace(steps=steps),
                actor=actor,
                current_limit=experiment.policy.contract.limits.current,
                guard=Guard(plan.layout, plan.bench, bus.transport.send, pulse, plan.limit),
                limit=plan.limit,
                homing=homing,
                stop_condition=None if homing else experiment.stop_condition,
            )
            loop = Loop(
                core=Core(setup),
                receive=paced_receive(bus, recorder),
                now_ns=bus.clock.now_ns,
                push=recorder.push,
                stop_requested=console.stop_requested,
                pulse=pulse,
                overheard=drop_backlog(bus, plan.layout),
            )
            outcome = loop.run()
            push_clock(recorder, bus.clock)
        finally:
            stack.pop_all()
            watched = watchdog.finish() if watchdog is not None else None
            result = recorder.finish(trailer(outcome, obtained or {}, watched))
    return RunResult(plan, run_type, steps, checks, outcome, result, watched, obtained or {})


def drop_backlog(bus: Bus, layout: Layout) -> tuple[Frame, ...]:
    """Drop the frames that piled up while the recorder started: the loop would have to catch up with them first.

    Gives those that it must not miss.
    """
    begin_ns = bus.clock.now_ns()
    while (frame := bus.transport.receive(0)) is not None:
        bus.pass_over(frame, layout)
        if frame.time_ns >= begin_ns:
            break
    alarming = tuple(bus.overheard.values())
    bus.overheard.clear()
    return alarming


def observe(
    plan: Plan, bus: Bus, start_conditions: StartConditions, stop_requested: Callable[[], bool]
) -> BusStatistics:
    """Listen until a run may begin, or for the ``start_timeout`` of the bench."""
    monitor = BusMonitor(plan.layout, plan.bench, lambda _frame, _why: None)
    deadline_ns = bus.clock.now_ns() + round(plan.bench.watch.start_timeout * 1e9)

    def ready(sample: SensorSample, now_ns: int) -> bool:
        return not start_conditions.not_ready(monitor.status, sample, now_ns)

    receive, period_ns = bus.transport.receive, plan.bench.timing.sample_time_ns
    listen(monitor, receive, bus.clock, period_ns, deadline_ns, ready, stop_requested)
    if stop_requested():
        raise interrupted("before anything was sent")
    return monitor.statistics()


def findings(
    plan: Plan,
    bus: Bus,
    start_conditions: StartConditions,
    statistics: BusStatistics,
    duration: float,
    path: Path,
    watchdog: WatchdogHandle | None = None,
    obtained: dict[str, str] | None = None,
) -> Findings:
    """Findings for the pre-flight; the real-time settings are None where none were requested."""
    watched = ""
    if watchdog is not None:
        priority = watchdog.realtime.get("scheduler", "ordinary scheduling")
        watched = f"process {watchdog.pid}, heartbeat {plan.bench.watch.heartbeat * 1e3:g} ms, {priority}"
    settings = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in bus.transport.obtained.items())
    return Findings(
        plan=plan,
        start_conditions=start_conditions,
        duration=duration,
        statistics=statistics,
        bus=f"{bus.transport.name}{', in lock-step' if bus.simulated else ''}{', ' if settings else ''}{settings}",
        in_process=bus.in_process,
        end_stop_speed=end_stop_speed(plan.bench),
        needed=log_bytes(plan, duration),
        free=shutil.disk_usage(path.parent).free,
        watchdog=watched,
        core=compiled_core.running(),
        realtime=obtained,
    )


def start_recorder(
    plan: Plan, bus: Bus, run_type: RunType, path: Path, checks: tuple[Check, ...], steps: int
) -> Recorder:
    """Start the recorder; raises UsageError where the log cannot be written."""
    try:
        return Recorder.start(path, header(plan, bus.transport, bus.clock, run_type, checks, steps))
    except LogError as err:
        raise UsageError(f"--log: {err}") from err


def push_clock(recorder: Recorder, clock: Clock) -> None:
    """Record a reading of the clocks."""
    now_ns = clock.now_ns()
    recorder.push(ClockRecord(now_ns, now_ns + clock.wall_offset_ns()))


def _watch(plan: Plan, bus: Bus, stack: ExitStack) -> WatchdogHandle | None:
    """Start the watchdog, where another process can be on the bus; it ends with the stack."""
    if bus.in_process or not plan.precautions.watchdog:
        return None
    heartbeat, real_time = plan.bench.watch.heartbeat, plan.precautions.real_time
    try:
        watchdog = WatchdogHandle.start(bus.transport, plan.bench, heartbeat, real_time=real_time)
    except BusError as err:
        raise BusError(f"{err}; --no-watchdog runs without one") from err
    stack.callback(watchdog.finish)
    return watchdog


def paced_receive(bus: Bus, recorder: Recorder) -> Callable[[int], Frame | None]:
    """Receive function: from a simulated bus, whose time stands still meanwhile, no faster than the recorder writes."""
    receive = bus.transport.receive
    if not bus.simulated:
        return receive

    def wait_and_receive(deadline_ns: int) -> Frame | None:
        recorder.wait_for_room()
        return receive(deadline_ns)

    return wait_and_receive


def listen_only(plan: Plan, bus: Bus, path: Path, console: Console) -> tuple[dict[str, Any], tuple[Check, ...]]:
    """Listen for the duration of the plan, and log all that comes; nothing is ever sent.

    Returns:
        The result as a document, and the pre-flight of the bus.
    """
    recorder = start_recorder(plan, bus, RunType.LISTEN_ONLY, path, (), 0)
    clock, receive = bus.clock, paced_receive(bus, recorder)
    end = {"exit_reason": Fault.INTERNAL.name, "detail": "the listening ended before its time"}

    def note(code: str, detail: str) -> None:
        recorder.push(EventRecord(clock.now_ns(), code, detail))

    def receive_and_record(deadline_ns: int) -> Frame | None:
        frame = receive(deadline_ns)
        if frame is not None:
            recorder.push(FrameRecord(frame))
        return frame

    try:
        push_clock(recorder, clock)
        note(RunState.SILENT.name, "listening")
        monitor = BusMonitor(plan.layout, plan.bench, lambda _, why: note("FRAME_REJECTED", why))
        period_ns, deadline_ns = plan.bench.timing.sample_time_ns, clock.now_ns() + round(plan.duration * 1e9)
        refused: EmbError | None = None
        try:
            listen(monitor, receive_and_record, clock, period_ns, deadline_ns, lambda *_: False, console.stop_requested)
        except BusError as err:
            refused = err
        statistics, start_conditions = monitor.statistics(), plan.start_conditions(anywhere=False)
        checks = run_checks(findings(plan, bus, start_conditions, statistics, plan.duration, path))
        document = reading(plan, statistics, checks, refused or first_refusal(checks))
        result = document["result"]
        if result not in (DONE, REFUSED):
            note(result, document["detail"])
        push_clock(recorder, clock)
        found = {key: document[key] for key in ("detail", "heard", "preflight")}
        end = log_entries({"exit_reason": result.upper(), **found})
    finally:
        log = recorder.finish(end)
    exit_code = document["exit_code"] or (EXIT_DONE if log.complete else EXIT_LOG)
    return {**document, "exit_code": exit_code, **log_document(log)}, checks
