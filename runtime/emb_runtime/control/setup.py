"""Setup of a run: what it is given, and the parts that its phases share."""

from __future__ import annotations

from dataclasses import dataclass

from emb_runtime.can.messages import Layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.control.actor import Actor
from emb_runtime.control.memory import Memory
from emb_runtime.control.monitors import Sensors, monitors
from emb_runtime.control.running_estimate import RunningEstimate
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.control.stop_condition import StopCondition
from emb_runtime.safety.command_limits import CommandLimits
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import StateMachine


@dataclass
class Setup:
    """Setup of one run: an experiment, or the way home."""

    bench: Bench
    layout: Layout
    law: ShieldLaw  # Its steps are the samples to answer; on the way home, at most
    actor: Actor
    current_limit: float  # Largest current that the policy's contract allows it to request [A]
    guard: Guard
    limit: float = CEILING_CURRENT  # A current narrower than the bench's, where the operator gave one [A]
    homing: bool = False  # Begin anywhere, let the shield bring the brake home, and end when it rests there
    stop_condition: StopCondition | None = None  # Precision of the estimate at which the way home begins early

    def __post_init__(self) -> None:
        """Make the parts."""
        bench, law = self.bench, self.law
        self.memory = memory = Memory(bench, homing=self.homing)
        self.machine = StateMachine(memory.note)
        self.reception = Reception(
            self.layout, bench, lambda frame, why: memory.note(frame.time_ns, "FRAME_REJECTED", why)
        )
        self.conditions = StartConditions(bench, self.layout, Bounds(bench), anywhere=self.homing)
        self.monitors = monitors(self.conditions, self.reception, self.guard)
        self.sensors = Sensors(bench, law, homing=self.homing)
        limit = self.layout.current_within(min(self.limit, bench.limits.current))
        self.command_limits = CommandLimits(limit, bench.guard.slew * bench.timing.sample_time)
        self.estimate = RunningEstimate(bench, self.stop_condition, homing=self.homing)
