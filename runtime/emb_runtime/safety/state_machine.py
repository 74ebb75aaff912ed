"""State machine of a run, and its faults: no clock, no socket.

A run passes INIT → SILENT → ARMED → ACTIVE → STOPPING → OVER; on the way home HOMING stands in place of ACTIVE.
:func:`next_run` is the whole machine, as a pure function: a run's state and an event with its time give the next state;
:class:`StateMachine` keeps the state and records the changes. A fault that latches is the run's for good: the first one
counts, nothing clears it, and once anything may have been sent the only way out leads through the stop frames. A soft
fault is reported and counted, and passes by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from emb_runtime.errors import EXIT_BUS, EXIT_DONE, EXIT_SAFETY_STOP, EXIT_UNEXPLAINED
from emb_runtime.records import RunState


class Event(IntEnum):
    """Events that move a run on; a :class:`Fault` is one as well."""

    PREPARED = 0  # Bench, policy, shield, recorder and bus are ready
    NODE_READY = 1  # The node has shown itself: valid pairs, idle, where the run may begin
    BEGIN = 2  # The first sample of the experiment is in hand
    BEGIN_HOMING = 3  # The first sample of the way home is in hand
    FINISHED = 4  # The last sample has come
    STOPPED = 5  # The stop frames are out, and the node has been given its time to come to rest


class Fault(IntEnum):
    """Faults of a run. The numbers are codes: they never change."""

    NO_NODE = 1
    NODE_NOT_READY = 2
    SENSOR_LOST = 3
    FRAMES_REJECTED = 4
    OUT_OF_LIMITS = 5
    NODE_STOPPED = 6
    FOREIGN_COMMAND = 7
    POLICY_NOT_FINITE = 8
    POLICY_BEYOND_CONTRACT = 9
    GUARD_REJECTED = 10
    BUS_LOST = 11
    INTERRUPTED = 12
    INTERNAL = 13
    NOT_OBEYED = 14
    CURRENT_MISMATCH = 15
    WATCHDOG_TRIPPED = 16
    WATCHDOG_LOST = 17
    NOT_HOME = 18
    SENSORS_CONTRADICT = 19
    MOTION_OUTSIDE_SET = 20
    WRONG_POLARITY = 21
    DEVICE_TIME = 22
    INCOMPLETE = 23
    NODE_CHANGED = 24
    MOTION_UNEXPLAINED = 26
    NOT_AT_REST = 27
    RESPONSE_LATE = 28
    SENSOR_LATE = 101
    SEND_QUEUE_FULL = 102
    FRAMES_DROPPED = 103
    BUS_ERRORS = 104
    PERMISSION_LOST = 105


class Run(NamedTuple):
    """State of a run."""

    state: RunState = RunState.INIT
    since_ns: int = 0  # Beginning of this state, monotonic [ns]
    fault: Fault | None = None  # The first one that latched


_NEXT: Final[dict[tuple[RunState, Event], RunState]] = {
    (RunState.INIT, Event.PREPARED): RunState.SILENT,
    (RunState.SILENT, Event.NODE_READY): RunState.ARMED,
    (RunState.ARMED, Event.BEGIN): RunState.ACTIVE,
    (RunState.ARMED, Event.BEGIN_HOMING): RunState.HOMING,
    (RunState.ACTIVE, Event.FINISHED): RunState.STOPPING,
    (RunState.HOMING, Event.FINISHED): RunState.STOPPING,
    (RunState.STOPPING, Event.STOPPED): RunState.OVER,
}
_ENABLING: Final = (RunState.ACTIVE, RunState.HOMING)
_SENDING: Final = (*_ENABLING, RunState.STOPPING)


def next_run(run: Run, event: Event | Fault, now_ns: int) -> Run:
    """State of a run after an event at a monotonic time [ns].

    Raises:
        ValueError: the event cannot happen in that state, which is an error in the program.
    """
    if isinstance(event, Fault):
        return _faulted(run, event, now_ns)
    try:
        return run._replace(state=_NEXT[run.state, event], since_ns=now_ns)
    except KeyError:
        raise ValueError(f"{event.name} cannot happen in {run.state.name}") from None


def _faulted(run: Run, fault: Fault, now_ns: int) -> Run:
    if not FAULTS[fault].latched or run.state is RunState.OVER:
        return run
    first = run.fault or fault
    if run.state is RunState.STOPPING:  # the stop goes on as it is
        return run._replace(fault=first)
    # Before arming nothing was sent, so there is nothing to stop; after it, every way out sends stop frames.
    nothing_sent = run.state in (RunState.INIT, RunState.SILENT)
    return run._replace(state=RunState.OVER if nothing_sent else RunState.STOPPING, since_ns=now_ns, fault=first)


def may_send(state: RunState) -> bool:
    """Returns True if any frame may leave in this state."""
    return state in _SENDING


def may_enable(state: RunState) -> bool:
    """Returns True if an enabled command, one with a current, may leave in this state."""
    return state in _ENABLING


class StopError(Exception):
    """Ends a run with a fault that latches."""

    def __init__(self, fault: Fault, detail: str = "") -> None:
        super().__init__(fault.name)
        self.fault = fault
        self.detail = detail


class FaultInfo(NamedTuple):
    """Cause of a fault, advice to the operator, and exit code."""

    cause: str
    advice: str
    exit_code: int = EXIT_SAFETY_STOP
    latched: bool = True  # It ends the run; one that does not latch is reported and counted, and the run goes on


def _soft(cause: str, advice: str) -> FaultInfo:
    return FaultInfo(cause, advice, EXIT_DONE, latched=False)


FAULTS: dict[Fault, FaultInfo] = {
    Fault.NO_NODE: FaultInfo(
        "no valid sensor pair came", "check that the node runs, on this interface, with this DBC", EXIT_BUS
    ),
    Fault.NODE_NOT_READY: FaultInfo(
        "the node is not ready for a run",
        "bring the brake to the origin with --home; else check the node and its bench file",
    ),
    Fault.SENSOR_LOST: FaultInfo(
        "the sensor frames stopped", "check node, wiring and bus load; in a virtual machine the host may have been busy"
    ),
    Fault.FRAMES_REJECTED: FaultInfo(
        "too many invalid or implausible sensor frames", "check DBC, wiring and sensor; the log lists each one"
    ),
    Fault.OUT_OF_LIMITS: FaultInfo(
        "the brake left its limits", "the brake is outside the bench's shield ranges: widen them"
    ),
    Fault.NODE_STOPPED: FaultInfo(
        "the node began a safe stop",
        "its stop reason is below; WATCHDOG: this computer answered too late; LIMIT: the brake is outside the "
        "bench's shield ranges",
    ),
    Fault.NOT_OBEYED: FaultInfo(
        "the node obeyed no command for too long",
        "the computer answered too late, or the node ignores it: `emb-replay info` shows which",
    ),
    Fault.CURRENT_MISMATCH: FaultInfo(
        "the drive does not apply the current that it is commanded",
        "check the drive's current loop and its supply; a slow one needs a greater guard.current_error",
    ),
    Fault.FOREIGN_COMMAND: FaultInfo(
        "another sender commands the node", "stop the other sender; two on one bus are never safe"
    ),
    Fault.POLICY_NOT_FINITE: FaultInfo(
        "the policy answered with a number that is not finite", "the actor is broken: train or export it again"
    ),
    Fault.POLICY_BEYOND_CONTRACT: FaultInfo(
        "the policy requested more than its contract allows", "the actor is broken: export it again"
    ),
    Fault.GUARD_REJECTED: FaultInfo(
        "the guard refused a command", "this is an error in the program: please report it with the log"
    ),
    Fault.WATCHDOG_TRIPPED: FaultInfo(
        "the loop stalled, and the watchdog process stopped the run",
        "the computer is too busy or the policy too slow: `emb-replay timing` shows which",
    ),
    Fault.WATCHDOG_LOST: FaultInfo(
        "the watchdog process ended or stalled", "find what ended it (out of memory?), and run again"
    ),
    Fault.NOT_HOME: FaultInfo(
        "the brake did not come to rest at the origin in time",
        "turn it there by hand; the brake may lie outside the bench's shield ranges",
    ),
    Fault.SENSORS_CONTRADICT: FaultInfo(
        "angle and velocity contradict each other",
        "one of them drifts, is scaled, frozen or late: check the sensor, its supply and its units",
    ),
    Fault.MOTION_OUTSIDE_SET: FaultInfo(
        "no brake in the ranges of the shield moves like this",
        "the brake is stuck, loose or outside the bench's shield ranges, or sensor or drive is scaled, frozen or late",
    ),
    Fault.WRONG_POLARITY: FaultInfo(
        "the brake moves against the current",
        "motor or sensor is connected with the wrong sign: swap it, and begin again with --limit",
    ),
    Fault.DEVICE_TIME: FaultInfo(
        "the node's clock and this computer's disagree",
        "check the node's clock and the source of its time stamps",
    ),
    Fault.INCOMPLETE: FaultInfo(
        "the experiment was not completed",
        "`emb-replay info` shows what is missing; check the load of computer and bus, or the brake if it is not home",
    ),
    Fault.NODE_CHANGED: FaultInfo(
        "the node changed during the run",
        "it restarted, or another sender uses its identifiers: check its supply and the bus",
    ),
    Fault.MOTION_UNEXPLAINED: FaultInfo(
        "no single brake explains what the node reported",
        "check the scale and drift of both sensors, the angle's zero, the reported current and the drive's gain, and "
        "whether friction or stiffness changed during the run; do not estimate from this log",
        EXIT_UNEXPLAINED,
    ),
    Fault.NOT_AT_REST: FaultInfo(
        "the node did not report rest after the stop frames",
        "switch the drive off before anybody comes near; then check its stop (of a mapped drive, its disarming)",
    ),
    Fault.RESPONSE_LATE: FaultInfo(
        "the velocity does not follow the commands as the bench file declares",
        "declare what is named above in the bench file, or make it faster; --limit and a slower policy do not help",
    ),
    Fault.BUS_LOST: FaultInfo("the bus was lost", "check the interface and its cable", EXIT_BUS),
    Fault.INTERRUPTED: FaultInfo(
        "stopped by the operator", "if the brake is not home, bring it there with --home before the next run"
    ),
    Fault.INTERNAL: FaultInfo("an error in the program", "please report it with the log"),
    Fault.SENSOR_LATE: _soft("several periods without a valid sensor pair", "check node, wiring and bus load"),
    Fault.SEND_QUEUE_FULL: _soft(
        "the interface had no room for a command, which is lost",
        "check that another node acknowledges, and the bus load",
    ),
    Fault.FRAMES_DROPPED: _soft(
        "the kernel's receive buffer was full, and frames were dropped",
        "give the loop real-time priority, or raise net.core.rmem_max",
    ),
    Fault.BUS_ERRORS: _soft("the CAN controller reports errors", "check cable, termination and bit rate"),
    Fault.PERMISSION_LOST: _soft(
        "a message of the node is overdue: no current is commanded until it comes", "check the node"
    ),
}


class StateMachine:
    """A run's state, moved on by events; each change and each fault is recorded: time [ns], code and text."""

    _latched: tuple[Run, int]  # State before the fault that was latched last, and its time [ns]

    def __init__(self, push_event: Callable[[int, str, str], object]) -> None:
        self._push_event = push_event
        self.run = Run()

    def handle_event(self, event: Event, now_ns: int) -> None:
        """Take an event."""
        before, self.run = self.run, next_run(self.run, event, now_ns)
        self._note_change(before, event, now_ns)

    def latch(self, fault: Fault, now_ns: int) -> None:
        """Take a fault that latches; :meth:`explain` records it, once the stop has begun."""
        self._latched = self.run, now_ns
        self.run = next_run(self.run, fault, now_ns)

    def explain(self, fault: Fault, detail: str) -> None:
        """Record the fault that was latched last, and the change of the state."""
        before, time_ns = self._latched
        self.record_fault(fault, detail, time_ns)
        self._note_change(before, fault, time_ns)

    def record_fault(self, fault: Fault, detail: str, now_ns: int) -> None:
        """Record a fault; a soft one changes nothing else."""
        cause = FAULTS[fault].cause
        self._push_event(now_ns, fault.name, f"{cause}: {detail}" if detail else cause)

    def _note_change(self, before: Run, event: Event | Fault, now_ns: int) -> None:
        if self.run.state is not before.state:
            self._push_event(now_ns, self.run.state.name, f"after {event.name}")
