"""The run's state machine and its faults, as pure data and pure functions: no clock, no socket.

A run passes INIT → SILENT → ARMED → ACTIVE → STOPPING → OVER. A fault latches: the first one is the run's, nothing
clears it, and once anything has been sent the only way out leads through the stop frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from emb_runtime.errors import EXIT_BUS, EXIT_SAFETY_STOP
from emb_runtime.records import RunState


class Event(IntEnum):
    """What moves a run from one state to the next."""

    PREPARED = 0
    """Bench, policy, shield, recorder and bus are ready."""
    NODE_READY = 1
    """The node has shown itself: valid pairs, idle, at home."""
    BEGIN = 2
    """The first sample of the experiment is in hand."""
    FINISHED = 3
    """The experiment's last sample has come."""
    FAULT = 4
    STOPPED = 5
    """The stop frames are out."""


_NEXT: dict[tuple[RunState, Event], RunState] = {
    (RunState.INIT, Event.PREPARED): RunState.SILENT,
    (RunState.SILENT, Event.NODE_READY): RunState.ARMED,
    (RunState.ARMED, Event.BEGIN): RunState.ACTIVE,
    (RunState.ACTIVE, Event.FINISHED): RunState.STOPPING,
    (RunState.STOPPING, Event.STOPPED): RunState.OVER,
    # Before arming nothing has left, so there is nothing to stop; after it, every way out sends stop frames.
    (RunState.INIT, Event.FAULT): RunState.OVER,
    (RunState.SILENT, Event.FAULT): RunState.OVER,
    (RunState.ARMED, Event.FAULT): RunState.STOPPING,
    (RunState.ACTIVE, Event.FAULT): RunState.STOPPING,
    (RunState.STOPPING, Event.FAULT): RunState.STOPPING,
}


def next_state(state: RunState, event: Event) -> RunState:
    """The state that follows.

    Raises:
        ValueError: the event is not possible in that state, which is an error in the program.
    """
    try:
        return _NEXT[state, event]
    except KeyError:
        raise ValueError(f"{event.name} cannot happen in {state.name}") from None


def may_send(state: RunState) -> bool:
    """Whether any frame may leave in this state."""
    return state in (RunState.ACTIVE, RunState.STOPPING)


def may_enable(state: RunState) -> bool:
    """Whether an enabled command, one with a current, may leave in this state."""
    return state is RunState.ACTIVE


class Fault(IntEnum):
    """Why a run was stopped. All latch: a new run is a new process."""

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


@dataclass(frozen=True)
class FaultInfo:
    """What a fault means to the operator."""

    cause: str
    advice: str
    exit_code: int


FAULTS: dict[Fault, FaultInfo] = {
    Fault.NO_NODE: FaultInfo(
        "no valid sensor pair came", "check that the node runs, on this interface, with this DBC", EXIT_BUS
    ),
    Fault.NODE_NOT_READY: FaultInfo(
        "the brake is not idle at the origin", "let it come to rest at home before arming", EXIT_SAFETY_STOP
    ),
    Fault.SENSOR_LOST: FaultInfo(
        "the sensor frames stopped",
        "check node, wiring and bus load; in a virtual machine the host may have been busy",
        EXIT_SAFETY_STOP,
    ),
    Fault.FRAMES_REJECTED: FaultInfo(
        "too many invalid or implausible sensor frames",
        "check DBC, wiring and sensor; the log lists each one",
        EXIT_SAFETY_STOP,
    ),
    Fault.OUT_OF_LIMITS: FaultInfo(
        "the brake left its limits", "the brake does not lie in the bench's shield ranges: widen them", EXIT_SAFETY_STOP
    ),
    Fault.NODE_STOPPED: FaultInfo(
        "the node began its own safe stop",
        "its stop reason is below; WATCHDOG: this computer answered too late; LIMIT: the brake is none of those that "
        "the shield is for",
        EXIT_SAFETY_STOP,
    ),
    Fault.NOT_OBEYED: FaultInfo(
        "the node obeyed no command for too long",
        "the computer answered too late, or the node ignores it: `emb-replay info` tells which",
        EXIT_SAFETY_STOP,
    ),
    Fault.FOREIGN_COMMAND: FaultInfo(
        "somebody else sends commands to the node",
        "stop the other commander; two on one bus is never safe",
        EXIT_SAFETY_STOP,
    ),
    Fault.POLICY_NOT_FINITE: FaultInfo(
        "the policy answered with a number that is not finite",
        "the actor is broken: train or export it again",
        EXIT_SAFETY_STOP,
    ),
    Fault.POLICY_BEYOND_CONTRACT: FaultInfo(
        "the policy asked for more current than its contract allows",
        "the actor is broken: export it again",
        EXIT_SAFETY_STOP,
    ),
    Fault.GUARD_REJECTED: FaultInfo(
        "the guard refused a command",
        "this is an error in the program: please report it with the log",
        EXIT_SAFETY_STOP,
    ),
    Fault.BUS_LOST: FaultInfo("the bus was lost", "check the interface and its cable", EXIT_BUS),
    Fault.INTERRUPTED: FaultInfo("stopped by the operator", "nothing to do", EXIT_SAFETY_STOP),
    Fault.INTERNAL: FaultInfo("an error in the program", "please report it with the log", EXIT_SAFETY_STOP),
}
