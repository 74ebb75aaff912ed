"""The brake as a CAN node: it owns the current, obeys what is fresh, valid and enabled, and stops by itself.

Pure logic: frames and ticks go in, frames come out; no clock and no socket. ``emb-node`` drives it in real time, the
``sim`` transport in lock-step.

In the tick of sample k the node takes the command that answered sample k − 1, advances the brake over the period
between them with that current, measures, and sends angle and velocity. So a command acts in the very period whose
beginning it answers, or never: a late one is refused as stale, and a period without a command is braked.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from emb_bench.brake.euler import step
from emb_runtime.bench import Bench, BrakeParameters
from emb_runtime.e2e import COUNTER_MODULUS, NO_COUNTER, CounterCheck
from emb_runtime.errors import FrameError
from emb_runtime.frames import Layout, Signal, StopReason, bench_identity
from emb_runtime.records import CurrentCommand, Frame, NodeState

STATUS_PERIODS = 100
"""A status message every so many samples."""

REST_TRAVEL = 0.05  # rad
REST_TIME = 0.05  # s
"""The brake rests when it has stayed within REST_TRAVEL for so long. The velocity cannot tell: Euler's sign() makes it
chatter by ± T_c t_s / J = 2.2 rad/s where the brake stands still."""

Noise = Callable[[], tuple[float, float]]
"""Draws one error of the angle sensor [rad] and one of the velocity observer [rad/s]."""


class BrakeNode:
    """A brake with its drive and sensors on the bus.

    Args:
        bench: limits, timing, what the node does by itself.
        layout: the bus layout.
        theta: the brake's true parameters.
        noise: draws the sensors' errors.
    """

    def __init__(self, bench: Bench, layout: Layout, theta: BrakeParameters, noise: Noise) -> None:
        self._bench = bench
        self._layout = layout
        self._theta = theta
        self._noise = noise
        self._t_s = bench.timing.sample_time
        self._watchdog_periods = math.ceil(bench.node.watchdog / self._t_s - 1e-9)
        self._current_step = layout.command.signal("Current").factor
        self._identity = bench_identity(bench.contract_hash)
        self._check = CounterCheck(saturation=COUNTER_MODULUS)
        self._counter = NO_COUNTER - 1  # the first sample has counter 0
        self._status_counter = 0
        self._command: CurrentCommand | None = None
        self._idle_periods = 0
        self._rest_angle = 0.0
        self._rest_periods = 0
        self.samples = 0
        """Samples sent so far."""
        self.periods = 0
        """Sampling periods passed, those without a sample (the node was late) included."""
        self.angle = 0.0
        """True angle [rad]."""
        self.velocity = 0.0
        """True velocity [rad/s]."""
        self.state = NodeState.IDLE
        self.stop_reason = StopReason.NEVER_COMMANDED
        self.obeyed = 0
        """Commands obeyed."""
        self.braked = 0
        """Periods without an obeyed command while active."""
        self.rejected = 0
        """Command frames not obeyed."""
        self.angle_range = (0.0, 0.0)
        """Lowest and highest true angle so far [rad]."""
        self.top_speed = 0.0
        """Highest true speed so far [rad/s]."""

    def receive(self, frame: Frame) -> None:
        """Take one frame from the bus; only a valid, fresh command for this sample is kept."""
        if frame.identifier != self._layout.command.identifier or frame.own or frame.error:
            return
        try:
            command = self._layout.decode_command(frame)
        except FrameError:
            self._check.reject()
            self.rejected += 1
            return
        stale = command.answers != self._counter and command.enable
        if self._check.step(command.counter) == 0 or stale or not self._permitted(command):
            self.rejected += 1
            return
        self._command = command

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let one sampling period pass, and more if the node was late; measure at the end of the last one.

        Args:
            skipped: periods that passed before it without a sample: nobody could answer, so they are braked.

        Returns:
            The frames to send: angle, velocity, now and then status.
        """
        applied = 0.0
        answered_by = NO_COUNTER
        for _ in range(skipped + 1):
            applied, answered_by = self._choose_current()
            self._advance(applied)
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        self.samples += 1
        return self._measure(applied, answered_by)

    def _permitted(self, command: CurrentCommand) -> bool:
        if abs(command.current) > self._bench.limits.current:
            return False
        # A stop that has latched is finished first, and a disabled command is always heard.
        return not command.enable or self.state in (NodeState.IDLE, NodeState.ACTIVE)

    def _choose_current(self) -> tuple[float, int]:
        """Current for the coming period, and the counter of the command that asked for it."""
        command, self._command = self._command, None
        if command is not None and command.enable:
            self.state, self.stop_reason = NodeState.ACTIVE, StopReason.NONE
            self._idle_periods = 0
            self.obeyed += 1
            return command.current, command.counter
        if command is not None and self.state is NodeState.ACTIVE:
            self._latch(StopReason.DISABLED)
        if self.state is NodeState.ACTIVE:
            self.braked += 1
            self._idle_periods += 1
            if self._idle_periods >= self._watchdog_periods:
                self._latch(StopReason.WATCHDOG)
        return self._own_current(), NO_COUNTER

    def _latch(self, reason: StopReason) -> None:
        self.state, self.stop_reason = NodeState.STOPPING, reason
        self._rest_angle, self._rest_periods = self.angle, 0

    def _own_current(self) -> float:
        """What the drive does when nobody commands it: damp, or nothing."""
        if self.state is NodeState.IDLE or self._bench.node.stop == "freewheel":
            return 0.0
        limit = self._bench.limits.current
        damping = -limit * self.velocity / self._bench.node.damping_velocity
        return round(min(max(damping, -limit), limit) / self._current_step) * self._current_step

    def _advance(self, current: float) -> None:
        self.angle, self.velocity = step(self._theta, self.angle, self.velocity, current, self._t_s)
        self.periods += 1
        self.angle_range = (min(self.angle_range[0], self.angle), max(self.angle_range[1], self.angle))
        self.top_speed = max(self.top_speed, abs(self.velocity))
        low, high = self._bench.limits.angle
        outside = not low <= self.angle <= high or abs(self.velocity) > self._bench.limits.velocity
        if outside and self.state is NodeState.ACTIVE:
            self._latch(StopReason.LIMIT)
        if self.state is NodeState.STOPPING:
            self._watch_rest()

    def _watch_rest(self) -> None:
        if abs(self.angle - self._rest_angle) > REST_TRAVEL:
            self._rest_angle, self._rest_periods = self.angle, 0
            return
        self._rest_periods += 1
        if self._rest_periods * self._t_s >= REST_TIME:
            self.state = NodeState.IDLE
            self._check = CounterCheck(saturation=COUNTER_MODULUS)  # whoever commands next counts anew

    def _measure(self, applied: float, answered_by: int) -> list[Frame]:
        angle_error, velocity_error = self._noise()
        layout, counter = self._layout, self._counter
        time_ns = self.periods * self._bench.timing.sample_time_ns
        frames = [
            layout.encode_angle(counter, _saturated(self.angle + angle_error, layout.angle.signal("Angle")), time_ns),
            layout.encode_velocity(
                counter,
                _saturated(self.velocity + velocity_error, layout.velocity.signal("Velocity")),
                applied,
                self.state,
                answered_by,
            ),
        ]
        if self.samples % STATUS_PERIODS == 1:
            frames.append(
                layout.encode_status(
                    self._status_counter,
                    self.state,
                    self.stop_reason,
                    self.rejected,
                    self._identity,
                )
            )
            self._status_counter = (self._status_counter + 1) % COUNTER_MODULUS
        return frames


def _saturated(value: float, signal: Signal) -> float:
    """A sensor at the end of its range says so; it does not wrap and does not fall silent."""
    return min(max(value, signal.minimum), signal.maximum)
