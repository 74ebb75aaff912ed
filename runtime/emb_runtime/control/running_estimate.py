"""Running estimate of an experiment, and the stop condition on its precision."""

from __future__ import annotations

from emb_runtime.config.bench import Bench
from emb_runtime.control.memory import Memory
from emb_runtime.control.stop_condition import REACHED, StopCondition
from emb_runtime.estimator.estimate import LOST
from emb_runtime.estimator.estimator import Estimator, estimated
from emb_runtime.log.ring_buffer import EstimateRecord
from emb_runtime.records import SensorSample


class RunningEstimate:
    """Estimate of one run."""

    def __init__(self, bench: Bench, condition: StopCondition | None, *, homing: bool) -> None:
        self.estimator = Estimator(bench)
        self.numbers: tuple[float, ...] = ()  # The latest estimate; empty if there is none
        self.goal_ns: int | None = None
        """Device time from the first sample to the one that met the stop condition [ns]; the brake then returns
        home."""
        self._condition = condition
        self._available = not homing and bool(estimated(bench))  # there is an estimate, and it was finite so far

    def record(self, sample: SensorSample, memory: Memory) -> None:
        """Record the estimate at the newest sample; once it is not finite, the run has none."""
        if not self._available:
            return
        self.numbers = numbers = self.estimator.estimate
        if not numbers:
            self._available = False
            text = "not finite: the measurements do not fit the bench's noise; the run goes on without an estimate"
            memory.note(sample.receive_time_ns, LOST, text)
            return
        memory.records.append(EstimateRecord(sample.receive_time_ns, memory.step, numbers))
        condition = self._condition
        if condition is not None and self.goal_ns is None and condition.reached(numbers):
            self.goal_ns = sample.device_time_ns - memory.start_ns
            memory.note(sample.receive_time_ns, REACHED, condition.describe(numbers))
