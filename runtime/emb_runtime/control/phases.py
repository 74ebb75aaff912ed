"""Phases of a run: each processes a sample and returns the next phase, or itself.

    Silent -> Control -> Stopping
              Control -> Coasting -> Stopping

Silent waits until the node is ready. Control checks each sample and answers it. Coasting lets friction stop a brake of
which motor or sensors may have the wrong sign. Stopping observes the node until it is at rest. No phase returns
Stopping: the core enters it when the run has ended, or has failed by a StopError.
"""

from __future__ import annotations

from typing import Final

from emb_runtime.control.monitors import IDLE, OBEYING
from emb_runtime.control.setup import Setup
from emb_runtime.control.start_conditions import READY_PAIRS
from emb_runtime.records import Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import Decision, checked, decide
from emb_runtime.safety.motion_balance import REST_SAMPLES, unheld_motion
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import late_step
from emb_runtime.safety.state_machine import Event, Fault, StopError, may_enable

HOME_PAIRS: Final = 50  # Valid pairs in a row, at home, that end a way home
UNSTEADY: Final = "its samples come earlier and earlier by its clock: they had piled up, or that clock is fast"
"""Reason why a node is not ready."""
SILENT_WAIT: Final = 10  # Periods after which a driver that waits for the node asks again for the operator's wish
COVERAGE: Final = 0.8
"""Minimum share of periods with a sample and an applied command."""
ARMED: Final = RunState.ARMED


class Phase:
    """A phase of a run."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.memory = setup.memory
        self.machine = setup.machine

    @property
    def deadline_ns(self) -> int:
        """Time until which the next frames are waited for, monotonic [ns]."""
        return self.memory.deadline_ns

    def process_sample(self, sample: SensorSample) -> Phase:
        """Process a valid sample; returns the next phase."""
        raise NotImplementedError

    def decide(self) -> Decision | None:
        """Decide on a command for the newest sample, after all frames of a read; a phase without commands: None."""
        self.miss()
        return None

    def miss(self) -> None:
        """Count a period in which no sample came until the deadline."""


class Silent(Phase):
    """Phase before arming: listens until enough samples in a row meet the start conditions; nothing leaves."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._control = Control(setup)
        self._ready = 0  # samples in a row that met the conditions
        self._not_ready = ""  # reason why the last one did not

    @property
    def deadline_ns(self) -> int:
        """Time until which the next frames are waited for, monotonic [ns]."""
        return min(self._give_up_ns, self.memory.read_ns + SILENT_WAIT * self.memory.period_ns)

    @property
    def _give_up_ns(self) -> int:
        return self.machine.run.since_ns + round(self.setup.bench.watch.start_timeout * 1e9)

    def process_sample(self, sample: SensorSample) -> Phase:
        """Arm, if the node is ready."""
        setup, memory = self.setup, self.memory
        before = memory.add_sample(sample)
        reason = setup.conditions.not_ready(setup.reception.status, sample, memory.read_ns)
        in_row = self._ready > 0 and not reason and memory.is_next(before, sample)
        steady = setup.guard.learn_time(sample, first=not in_row)
        self._ready = 0 if reason else self._ready + 1 if in_row and steady else 1
        self._not_ready = reason or ("" if steady else UNSTEADY)
        self._control.warm_up(sample)
        if self._ready < READY_PAIRS:
            return self
        self.machine.handle_event(Event.NODE_READY, memory.read_ns)
        return self._control

    def miss(self) -> None:
        """Give up a node that has not shown itself in time."""
        if self.memory.read_ns >= self._give_up_ns:
            unpaired = self.setup.reception.pairing_problem
            fault = Fault.NODE_NOT_READY if unpaired or self.memory.newest is not None else Fault.NO_NODE
            waited = f"within {self.setup.bench.watch.start_timeout:g} s"
            raise StopError(fault, self._not_ready or unpaired or waited)


class Control(Phase):
    """Phase from arming to the end: checks and answers each sample. The first begins the experiment or the way home."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._late_step = late_step(setup.law)
        self._at_home = 0  # samples in a row at home, once the brake is to return
        self._unanswered: SensorSample | None = None  # newest sample of the read, which is to be answered

    def warm_up(self, sample: SensorSample) -> None:
        """Warm-up: run one dummy cycle so that the interpreter specialises the code."""
        setup, estimator = self.setup, self.setup.estimate.estimator
        setup.sensors.warm_up(sample, setup.command_limits.current)
        estimator.begin_run()
        estimator.add_sample(sample.angle, sample.velocity, 0, sample.applied_current)
        decide(setup.law, setup.command_limits, sample.angle, sample.velocity, 0.0, NO_PAST, 0.0, 0)

    def process_sample(self, sample: SensorSample) -> Phase:
        """Count the periods since the sample before, and check that the sensors can be right."""
        setup, memory = self.setup, self.memory
        before, missed, phase = memory.add_sample(sample), memory.missed, self
        if before is not None and may_enable(self.machine.run.state):
            setup.sensors.update_balance()
            memory.follow(before, sample)
            phase = self._check_sensors(sample)
            if self._unanswered is not None:  # overtaken: the node obeys an answer to its newest sample only
                memory.pass_missed(missed)
                memory.unanswered(self._unanswered, missed)
        phase._unanswered = sample
        return phase

    def decide(self) -> Decision | None:
        """Check the newest sample, and decide on a command for it; None at the last one, which ends the run."""
        sample, self._unanswered = self._unanswered, None
        if sample is None:
            return None
        setup, memory, estimate = self.setup, self.memory, self.setup.estimate
        # Before its device time tells its step, which may be the last one. A stamp may be just ahead of now.
        setup.guard.check_time(sample, max(memory.read_ns, sample.receive_time_ns))
        if self.machine.run.state is ARMED:
            self._begin(sample)
        else:
            returns = setup.homing or estimate.goal_ns is not None
            self._at_home = self._at_home + 1 if returns and setup.conditions.bounds.is_home(sample) else 0
        step = memory.step = memory.step_of(sample)
        if self._is_last(step):
            self._finish(sample, step)
            return None
        for check in setup.monitors:
            check(sample, memory)
        if memory.missed:
            memory.pass_missed(memory.missed)
        estimate.estimator.add_sample(sample.angle, sample.velocity, step, sample.applied_current)
        request = setup.actor.act(sample.angle, sample.velocity, step, estimate.estimator)
        return self._command(sample, checked(request, setup.current_limit), step)

    def miss(self) -> None:
        """Count a period without a sample; too many in a row end the run."""
        memory, watch = self.memory, self.setup.bench.watch
        deadline_ns, silent = memory.miss()
        if silent >= watch.stop_missed:
            raise StopError(Fault.SENSOR_LOST, f"{silent} periods without a valid pair")
        if silent == watch.soft_missed:
            self.machine.record_fault(Fault.SENSOR_LATE, f"{silent} so far", deadline_ns)

    def _begin(self, sample: SensorSample) -> None:
        setup, memory = self.setup, self.memory
        memory.start_run(sample)
        self.machine.handle_event(Event.BEGIN_HOMING if setup.homing else Event.BEGIN, memory.read_ns)
        setup.sensors.begin_run(sample)
        setup.estimate.estimator.begin_run()

    def _is_last(self, step: int) -> bool:
        return step >= self.setup.law.steps or self._at_home >= HOME_PAIRS

    def _check_sensors(self, sample: SensorSample) -> Control:
        """Coast if the sign may be wrong and friction alone can stop the brake.

        With a wrong sign the node's stop would drive it on.
        """
        sensors = self.setup.sensors
        try:
            sensors.check(sample, self.memory)
        except StopError as stop:
            time = sensors.monitor.coasting_time(sample)
            if time == 0.0:
                raise
            # Now, since something else may end the run meanwhile, and would hide it.
            self.machine.record_fault(stop.fault, stop.detail, sample.receive_time_ns)
            return Coasting(self.setup, stop, time)
        return self

    def _command(self, sample: SensorSample, requested: float, step: int) -> Decision:
        """Command for a sample, in the shield's view of time: on the way home the end is always near."""
        setup, memory, sensors, limits = self.setup, self.memory, self.setup.sensors, self.setup.command_limits
        last, returns, current = memory.slew_reference(sample), setup.estimate.goal_ns is not None, requested
        if setup.homing:
            step = self._late_step
        elif returns:
            step, current = max(step, self._late_step), 0.0
        if (most := sensors.monitor.largest_current(limits.current)) < limits.current:
            limits = limits._replace(current=max(most, abs(last) - limits.slew))  # down to it as fast as may be
        decision = decide(sensors.law, limits, sample.angle, sample.velocity, current, memory.past, last, step)
        if returns:
            return decision._replace(requested=requested, reasons=decision.reasons | Reason.RETURNING)
        return decision

    def _finish(self, sample: SensorSample, step: int) -> None:
        """Check at its last sample that the run is complete."""
        setup, memory = self.setup, self.memory
        memory.record(sample, step, 0, memory.missed)
        if setup.homing and self._at_home < HOME_PAIRS:
            raise StopError(Fault.NOT_HOME, f"at {sample.angle:.2f} rad after {step} periods")
        if not setup.homing:
            self._check_complete(sample, min(step, setup.law.steps))
            setup.sensors.check_balance()
        self.machine.handle_event(Event.FINISHED, memory.read_ns)

    def _check_complete(self, end: SensorSample, periods: int) -> None:
        """Check that an experiment of so many periods is complete."""
        setup, counters = self.setup, self.memory.counters
        acted = counters.answered + counters.left - counters.not_obeyed
        if acted < COVERAGE * periods:
            found = f"{acted} of {periods} periods had a sample and a command that acted"
            raise StopError(Fault.INCOMPLETE, f"{found}, at least {COVERAGE:.0%} must")
        # Below the bench's limit the shield cannot always bring the brake home in time: that is the operator's choice.
        if not setup.conditions.bounds.is_home(end) and setup.limit >= setup.bench.limits.current:
            found = f"at {end.angle:.2f} rad and {end.velocity:.1f} rad/s after {periods} periods"
            raise StopError(Fault.INCOMPLETE, f"the brake is not home: {found}")


class Coasting(Control):
    """Phase of a brake of which motor or sensors may have the wrong sign: 0 A until friction has stopped it.

    Then the fault ends the run. Meanwhile everything but the sensors' sums and the end of the run is checked as ever.
    """

    def __init__(self, setup: Setup, stop: StopError, time: float) -> None:
        super().__init__(setup)
        self._stop = stop
        self._time = time  # until friction has stopped it [s]

    def _check_sensors(self, sample: SensorSample) -> Control:
        """End the run once the brake has been stopped."""
        self.setup.sensors.response.watch(sample)
        self._time -= self.memory.interval.elapsed
        if self._time <= 0.0:
            raise self._stop
        return self

    def _is_last(self, step: int) -> bool:
        return False

    def _command(self, sample: SensorSample, requested: float, step: int) -> Decision:
        """0 A, as fast as may be."""
        last, slew = self.memory.slew_reference(sample), self.setup.command_limits.slew
        return Decision(requested, 0.0, min(max(0.0, last - slew), last + slew), int(Reason.LIMITED))


class Stopping(Phase):
    """Phase after the end, or a fault: observes the node until it is at rest."""

    def __init__(self, setup: Setup, end: SensorSample | None) -> None:
        super().__init__(setup)
        self.end = end  # The newest sample before; None of a run that never armed
        self.rests = False  # The newest sample since then reports idle
        self._has_stopped = False  # the node was not ACTIVE in a sample since then
        self._samples: list[SensorSample] = []  # the last ones since then

    def process_sample(self, sample: SensorSample) -> Phase:
        """Store the newest samples, and whether the node was not ACTIVE in one."""
        self.memory.newest = sample  # not added: from the end on no deadline runs
        self.setup.sensors.response.watch(sample)
        if sample.node_state is not OBEYING and not self._has_stopped:
            self._has_stopped = True
            self.setup.reception.status = None  # its reason was that of another stop
        self.rests = sample.node_state is IDLE
        self._samples = [*self._samples[1 - REST_SAMPLES :], sample]
        return self

    def check_rest(self) -> None:
        """Check that the node has come to rest; raises StopError."""
        newest = self.memory.newest
        if not self.rests:
            found = "" if newest is None else f"the node's last state is {newest.node_state.name}"
            raise StopError(Fault.NOT_AT_REST, found)
        if speed := unheld_motion(self.setup.bench, self._samples):
            moves = f"in the stop the node goes on to measure {speed:.1f} rad/s, where friction holds any brake"
            raise StopError(Fault.MOTION_UNEXPLAINED, moves)
