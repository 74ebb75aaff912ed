"""Exchange with the host: samples and status go out, answers to the newest sample come in. Pure."""

from __future__ import annotations

import math

from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, CounterCheck
from emb_runtime.can.messages import Layout, StopReason, bench_identity
from emb_runtime.config.bench import Bench
from emb_runtime.drives.wire import DriveSample
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState

STATUS_PERIODS = 100  # A status message every so many samples
OLDEST_CONDITION_NS = 2_000_000_000  # Two conditions that came further apart are no reading together
ANSWER_PART = 0.75  # Part of a period after a sample within which its answer is obeyed; then the node brakes


class Answers:
    """The newest sample and its answer, which comes in time or is missed."""

    def __init__(self, layout: Layout, bench: Bench) -> None:
        self._layout = layout
        self._limit = bench.limits.current
        self._window_ns = round(ANSWER_PART * bench.timing.sample_time_ns)
        self._tolerated = math.ceil(bench.node.watchdog / bench.timing.sample_time - 1e-9)
        self._identity = bench_identity(bench.identity_hash)
        self._check = CounterCheck(COUNTER_MODULUS)
        self._counter = NO_COUNTER - 1  # the first sample has counter 0
        self._obeyed_counter = NO_COUNTER
        self._unanswered = 0  # samples in a row, while the host commands
        self.sample: DriveSample | None = None
        self._answered = self.missed = True
        self.samples = self.obeyed = self.braked = self.refused = 0
        """Numbers of samples, of commands that were obeyed, of samples without one in time while the host commands, and
        of commands that were not obeyed."""
        self.conditions = dict[str, tuple[float, int]]()
        """Temperature [degC] and supply voltage [V], the newest since they were last sent, and when each came."""
        self._conditions_counter = COUNTER_MODULUS - 1  # the first ones have counter 0

    @property
    def deadline_ns(self) -> int | None:
        """Time by which the newest sample is to be answered [ns]; None if it has been answered, or missed."""
        if self.sample is None or self._answered or self.missed:
            return None
        return self.sample.time_ns + self._window_ns

    def accept(self, frame: Frame, now_ns: int, obeys: bool) -> CurrentCommand | None:
        """The command of a frame, if it is to be followed: a disabled one, or an answer in time, of a node that obeys.

        At a monotonic time [ns]; each other command is counted.
        """
        if frame.identifier != self._layout.command.identifier or frame.extended:
            return None
        try:
            command = self._layout.decode_command(frame)
        except FrameError:
            self._check.reject()
            self.refused += 1
            return None
        is_new = self._check.advance(command.counter) != 0
        if not command.enable:
            self.refused += not is_new or command.current != 0.0
            return command
        in_time = self.deadline_ns is not None and now_ns < self.deadline_ns and command.answers == self._counter
        if not (obeys and is_new and in_time and abs(command.current) <= self._limit):
            self.refused += 1
            return None
        self._answered = True
        return command

    def obey(self, command: CurrentCommand) -> None:
        """Note that a command is obeyed: the next frames name it."""
        self._obeyed_counter, self._unanswered = command.counter, 0
        self.obeyed += 1

    def miss(self, is_active: bool) -> bool:
        """Note that the newest sample was not answered in time; returns True if a host that commands is lost by it."""
        self.missed = True
        self._unanswered += is_active
        self.braked += is_active
        return is_active and self._unanswered >= self._tolerated

    def frames(
        self, sample: DriveSample, applied: float, device_ns: int, state: NodeState, reason: StopReason
    ) -> list[Frame]:
        """Angle, velocity, and now and then status and conditions, of a new sample, which may be answered from now on.

        With the current in the period that ended [A], the time since the first sample [ns], the node's state, and the
        reason of its latest stop.
        """
        layout, (status, nth) = self._layout, divmod(self.samples, STATUS_PERIODS)
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        self.sample, self._answered, self.missed = sample, False, False
        self.samples += 1
        angle = layout.angle.signal("Angle").saturated(sample.angle)
        velocity = layout.velocity.signal("Velocity").saturated(sample.velocity)
        applied = layout.velocity.signal("AppliedCurrent").saturated(applied)
        obeyed, self._obeyed_counter = self._obeyed_counter, NO_COUNTER
        frames = [
            layout.encode_angle(self._counter, angle, device_ns),
            layout.encode_velocity(self._counter, velocity, applied, state, obeyed),
        ]
        if nth == 0:
            number = status % COUNTER_MODULUS
            frames.append(layout.encode_status(number, state, reason, self.refused, self._identity))
            frames += self._conditions_frames(sample.time_ns)
        return [frame._replace(time_ns=sample.time_ns) for frame in frames]

    def _conditions_frames(self, now_ns: int) -> list[Frame]:
        """The frame of the conditions, once both have come of late, and if their signals carry them."""
        late = {name: value for name, (value, at) in self.conditions.items() if now_ns - at <= OLDEST_CONDITION_NS}
        temperature, voltage = (late.get(name, math.nan) for name in ("temperature", "supply_voltage"))
        counter = (self._conditions_counter + 1) % COUNTER_MODULUS
        try:
            frame = self._layout.encode_conditions(counter, temperature, voltage)
        except FrameError:  # NaN too: it has not come
            return []
        self.conditions.clear()
        self._conditions_counter = counter
        return [frame]
