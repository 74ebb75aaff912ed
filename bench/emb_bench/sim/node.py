"""The brake as a CAN node: it drives the motor, obeys fresh, valid and enabled commands, and stops by itself.

Pure logic: frames and ticks go in, frames come out; no clock and no socket. ``emb-node`` drives it in real time, the
``sim`` transport in lock-step.

In the tick of sample k the node takes the command that answered sample k − 1, advances the brake over the period
between them with that current, measures, and sends angle and velocity. So a command acts in the very period whose
beginning it answers, or never: a late one is refused as stale, and a period without a command is braked.

A plant with a command delay applies an accepted command some periods later. The node then reports the counter of the
accepted command and the current that acts, which a drive measures. The node's braking has no delay. The time stamps are
those of the grid, without a delay of the measurement or jitter of the clock.
"""

from __future__ import annotations

import math

from emb_bench.config.plants import BUILT_IN, DEFAULT_PLANT, Plant
from emb_bench.sim.simulated_brake import Noise, SimulatedBrake
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, CounterCheck, next_counter
from emb_runtime.can.messages import Layout, StopReason, bench_identity
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from emb_runtime.safety.shield import damped_current

STATUS_PERIODS = 100  # A status message every so many periods

REST_TRAVEL = 0.05  # rad
REST_TIME = 0.05  # s
"""The brake rests when it has stayed within REST_TRAVEL for so long. The velocity is no criterion: Euler's sign() makes
it chatter by ± T_c t_s / J = 2.2 rad/s where the brake stands still."""

NO_COMMAND = math.nan  # Current without a command


class Rest:
    """Watch over a brake that stops, from a first angle on [rad]."""

    def __init__(self, angle: float) -> None:
        self._angle = angle
        self._periods = 0  # within REST_TRAVEL of that angle

    def reached(self, angle: float, t_s: float) -> bool:
        """Returns True if the brake rests; the angle after each period [rad]."""
        if abs(angle - self._angle) > REST_TRAVEL:
            self._angle, self._periods = angle, 0
            return False
        self._periods += 1
        return self._periods * t_s >= REST_TIME


class BrakeNode(SimulatedBrake):
    """A brake with its drive and sensors on the bus; on request it sends charge and conditions along."""

    def __init__(
        self,
        bench: Bench,
        layout: Layout,
        theta: BrakeParameters,
        noise: Noise,
        plant: Plant | None = None,
        *,
        charge: bool = False,
        conditions: tuple[float, ...] = (),
    ) -> None:
        super().__init__(theta, noise, plant or BUILT_IN[DEFAULT_PLANT], bench.timing.sample_time)
        self._bench = bench
        self._layout = layout
        self._watchdog_periods = math.ceil(bench.node.watchdog / self._t_s - 1e-9)
        self._identity = bench_identity(bench.identity_hash)
        self._check = CounterCheck(COUNTER_MODULUS)
        self._status = 0, 1  # counter of the next status, and the period from which on it is due
        self._charge = 0.0 if charge else None
        self._conditions = conditions  # temperature [degC] and supply voltage [V]; empty if they are not sent
        self._command: CurrentCommand | None = None
        self._idle_periods = 0
        self._rest = Rest(0.0)
        self.samples = 0  # Samples sent so far
        self.state = NodeState.IDLE
        self.stop_reason = StopReason.NEVER_COMMANDED
        self.obeyed = 0  # Commands obeyed
        self.braked = 0  # Periods without an obeyed command while active
        self.rejected = 0  # Command frames not obeyed

    @property
    def _counter(self) -> int:
        """Counter of the newest sample: the first one has 0."""
        return (self.samples - 1) % COUNTER_MODULUS

    def receive(self, frame: Frame) -> None:
        """Take one frame from the bus; only a valid, fresh command for this sample is accepted."""
        if frame.identifier != self._layout.command.identifier or frame.own or frame.error:
            return
        try:
            taken = self._layout.decode_command(frame)
        except FrameError:
            self._check.reject()
            self.rejected += 1
            return
        stale = taken.answers != self._counter and taken.enable
        if self._check.advance(taken.counter) == 0 or stale or not self._permitted(taken):
            self.rejected += 1
            return
        if not taken.enable and taken.current != 0.0:
            self.rejected += 1  # contradictory, but it stops the brake all the same
        self._command = taken

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let one sampling period pass, measure at its end, and give the frames to send.

        Periods that were ``skipped`` before it, because the node was late, had no sample: no command could answer, so
        they are braked.
        """
        for _ in range(skipped + 1):
            commanded, answered_by = self._take_command()
            commanded = self._delayed(commanded)
            obeys = self.state is NodeState.ACTIVE and not math.isnan(commanded)
            applied = commanded if obeys else self._stop_current()
            angle, velocity = self._advance(applied)
            if self._charge is not None:
                self._charge += applied * self._t_s
        self.samples += 1
        return self._frames(angle, velocity, applied, answered_by)

    def _permitted(self, taken: CurrentCommand) -> bool:
        if abs(taken.current) > self._bench.limits.current:
            return False
        # A latched stop is finished first; a disabled command is always accepted.
        return not taken.enable or self.state in (NodeState.IDLE, NodeState.ACTIVE)

    def _take_command(self) -> tuple[float, int]:
        """Current of the command for the coming period [A], NaN for none, and the command's counter."""
        taken, self._command = self._command, None
        if taken is not None and taken.enable:
            self.state, self.stop_reason = NodeState.ACTIVE, StopReason.NONE
            self._idle_periods = 0
            self.obeyed += 1
            return taken.current, taken.counter
        if taken is not None and self.state is NodeState.ACTIVE:
            self._latch(StopReason.DISABLED)
        if self.state is NodeState.ACTIVE:
            self.braked += 1
            self._idle_periods += 1
            if self._idle_periods >= self._watchdog_periods:
                self._latch(StopReason.WATCHDOG)
        return NO_COMMAND, NO_COUNTER

    def _latch(self, reason: StopReason) -> None:
        self.state, self.stop_reason = NodeState.STOPPING, reason
        self._rest = Rest(self.angle)

    def _stop_current(self) -> float:
        """Current of a drive without commands: the damped stop, or none [A]."""
        if self.state is NodeState.IDLE or self._bench.node.stop == "freewheel":
            return 0.0
        limit = self._bench.limits.current
        damping = damped_current(self.velocity, limit, self._bench.node.damping_velocity)
        step = self._layout.command.signal("Current").factor
        return round(damping / step) * step

    def _advance(self, current: float) -> tuple[float, float]:
        measured = super()._advance(current)
        low, high = self._bench.limits.angle
        outside = not low <= self.angle <= high or abs(self.velocity) > self._bench.limits.velocity
        if outside and self.state is NodeState.ACTIVE:
            self._latch(StopReason.LIMIT)
        if self.state is NodeState.STOPPING and self._rest.reached(self.angle, self._t_s):
            self.state = NodeState.IDLE
        return measured

    def _frames(self, angle: float, velocity: float, applied: float, answered_by: int) -> list[Frame]:
        layout, counter = self._layout, self._counter
        time_ns = self.periods * self._bench.timing.sample_time_ns
        frames = [
            layout.encode_angle(counter, layout.angle.signal("Angle").saturated(angle), time_ns),
            layout.encode_velocity(
                counter, layout.velocity.signal("Velocity").saturated(velocity), applied, self.state, answered_by
            ),
        ]
        if self._charge is not None:
            frames.insert(0, layout.encode_charge(counter, self._charge))
        number, due = self._status
        if self.periods >= due:
            self._status = next_counter(number), self.periods + STATUS_PERIODS
            frames.append(layout.encode_status(number, self.state, self.stop_reason, self.rejected, self._identity))
            if self._conditions:
                frames.append(layout.encode_conditions(number, *self._conditions))
        return frames
