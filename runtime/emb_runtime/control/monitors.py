"""Monitors of a run: each checks the newest sample, and ends the run by a StopError.

Every sample in control is checked by :class:`Sensors`, but for the first one and those while the brake coasts; a fault
that they find may begin the coasting. One that is to be answered is checked by the guard's clock, before its step is
told from its device time, and then by :func:`monitors`: limits, node, obeyed, lost, drive. :func:`check_bus` checks
what no sample shows.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Final

from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout, StatusFrame
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import Bench
from emb_runtime.control.memory import Memory
from emb_runtime.control.start_conditions import StartConditions
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.motion_balance import MotionBalance
from emb_runtime.safety.response import Response
from emb_runtime.safety.sensor_monitor import SensorMonitor
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

IDLE: Final = NodeState.IDLE
OBEYING: Final = NodeState.ACTIVE
UNFIT: Final = (NodeState.STOPPING, NodeState.FAULT)


Monitor = Callable[[SensorSample, Memory], None]
"""Checks the newest sample; raises StopError."""


def monitors(conditions: StartConditions, reception: Reception, guard: Guard) -> tuple[Monitor, ...]:
    """Monitors of each sample that is to be answered, in the order in which they check it."""

    def check_limits(sample: SensorSample, memory: Memory) -> None:
        if outside := conditions.bounds.outside(sample):
            raise StopError(Fault.OUT_OF_LIMITS, outside)

    def check_drive(sample: SensorSample, memory: Memory) -> None:
        guard.check_drive(sample)

    return check_limits, Node(conditions, reception).check, check_obeyed, check_lost, check_drive


def check_bus(layout: Layout, reception: Reception) -> None:
    """Check that nobody else commands the node, and that its frames can be trusted; raises StopError."""
    if reception.foreign_command:
        raise StopError(Fault.FOREIGN_COMMAND, f"identifier {layout.command.identifier:#05x}")
    if reception.too_many_rejected:
        raise StopError(Fault.FRAMES_REJECTED, f"{reception.rejected} so far")


def check_obeyed(sample: SensorSample, memory: Memory) -> None:
    """Check that the node obeys most commands."""
    if memory.unobeyed.exceeded:
        counters = memory.counters
        found = f"{counters.not_obeyed} commands not obeyed, {counters.unanswered} samples not answered"
        raise StopError(Fault.NOT_OBEYED, f"{found} of {counters.pairs}, a fifth or too many in a row")


def check_lost(sample: SensorSample, memory: Memory) -> None:
    """Check that most samples come."""
    if memory.lost.exceeded:
        missed = memory.counters.missed
        found = f"{missed} of {missed + memory.counters.pairs} periods without a valid pair"
        found += ", more than a fifth or too many in a row"
        if memory.skipped:
            found += f"; {memory.skipped} of them are missing by the node's counter and not by its time"
        raise StopError(Fault.SENSOR_LOST, found)


class Node:
    """Monitor of the node: its state, and its identity since the run began."""

    def __init__(self, conditions: StartConditions, reception: Reception) -> None:
        self._conditions = conditions
        self._reception = reception
        self._was_active = False  # it has obeyed a command of this run
        self._status: StatusFrame | None = None  # the newest one that was checked
        self._active_then = False  # it came when the node had obeyed

    def check(self, sample: SensorSample, memory: Memory) -> None:
        """Check the state that a sample reports, and a new status; raises StopError."""
        if sample.node_state in UNFIT:
            raise StopError(Fault.NODE_STOPPED, f"the node's state is {sample.node_state.name}")
        if changed := self._change(sample):
            raise StopError(Fault.NODE_CHANGED, changed)

    def _change(self, sample: SensorSample) -> str:
        """Property of the node that has changed since the run began, in words; empty if none has."""
        # Before the first obeyed command it may be idle: the first ones may be lost.
        self._was_active |= sample.node_state is OBEYING
        if sample.node_state is IDLE and (self._was_active or sample.command_counter != NO_COUNTER):
            return "the node's state is IDLE after it has obeyed a command of this run"
        status = self._reception.status
        if status is self._status:
            return ""
        # The first one may be from before the run, when the node was still in another stop.
        found = self._contradiction(status) if self._status is not None and status is not None else ""
        self._status = status
        return found or self._conditions.mismatch(status)

    def _contradiction(self, status: StatusFrame) -> str:
        """Contradiction of a new status to the pairs, in words; empty if there is none.

        A node that stops or has a fault is not in control, whatever its pairs say: an honest one that sends its status
        first ends the run with its next pair. That it is idle it may have sent just before it obeyed the first command,
        but not once an earlier status has come while it did.
        """
        before, self._active_then = self._active_then, self._was_active
        if status.node_state in UNFIT:
            raise StopError(Fault.NODE_STOPPED, f"the node's status is {status.node_state.name}")
        idle = before and status.node_state is IDLE
        return "the node's status is IDLE while its pairs report ACTIVE" if idle else ""


class Sensors:
    """Monitor of the sensors: they agree with each other and with the currents; one brake explains the motion."""

    def __init__(self, bench: Bench, law: ShieldLaw, *, homing: bool) -> None:
        self._law = law
        self._homing = homing
        self.monitor = SensorMonitor(law, sensor_thresholds(bench, law))
        self.response = Response(bench, law)
        self._balance = MotionBalance(bench)
        self._pending: tuple[SensorSample, bool] | None = None  # newest sample for the balance; True if it follows
        self.unexplained = math.nan, math.inf  # Velocity that no brake explains, and what is allowed [rad/s]

    def begin_run(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        self.monitor.begin_run(sample)
        self.response.begin_run(sample)
        self._balance.begin_run(sample)

    def check(self, sample: SensorSample, memory: Memory) -> None:
        """Check the newest sample against the one before; raises StopError. Queues it for the motion balance."""
        interval = memory.interval
        try:
            self.monitor.check(interval.elapsed, sample, interval.obeyed, interval.command)
            self.response.add_sample(sample, interval.follows, interval.command)
        except StopError as stop:
            if stop.fault is not Fault.RESPONSE_LATE:  # that sample is already in the rows of the response
                self.response.watch(sample)
            raise
        if not self._homing:
            self._pending = sample, interval.follows

    def update_balance(self) -> None:
        """Update the motion balance with the newest sample, after its command was sent (not time critical)."""
        if self._pending is not None:
            (sample, follows), self._pending = self._pending, None
            self._balance.add_sample(sample, follows)

    def check_balance(self) -> None:
        """Check the motion of a whole experiment."""
        self.update_balance()
        self.unexplained = self._balance.check_motion()
        self._balance.check_origin()

    def warm_up(self, sample: SensorSample, limit: float) -> None:
        """Warm-up: run one dummy cycle, which :meth:`begin_run` forgets."""
        self.monitor.begin_run(sample)
        with contextlib.suppress(StopError):
            self.monitor.check(self._law.sample_time, sample, True, 0.0)
        self.monitor.largest_current(limit)
        self.response.begin_run(sample)
        with contextlib.suppress(StopError):
            self.response.add_sample(sample, True, 0.0)
        self._balance.begin_run(sample)
        self._balance.add_sample(sample, True)
        self._balance.check_motion()

    @property
    def law(self) -> ShieldLaw:
        """Law of the shield. Before the sign is shown the current is limited, and a way home may need all of it."""
        return self.response.law if self.monitor.obeys else self._law
