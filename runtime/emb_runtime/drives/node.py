"""The software node: between a drive that speaks its own protocol and a loop that speaks ours.

Pure logic: frames of both sides and times go in, frames come out; no clock, no socket. To the loop it is a node like
any other, see ``emb.dbc``: it obeys a valid, enabled answer to the newest sample, brakes a period that has none, and
begins a stop after the bench's ``node.watchdog``. To the drive it is the commander: it arms by the file's sequence,
sends one current for each sample, and so feeds the drive's own watchdog only as long as samples come and are answered
or braked. A stop that the host asked for ends armed, at 0 A; after any other stop the drive is let go.

What differs from a node that measures and acts in one device: a command acts when it arrives, within the period of its
sample, or of the next one where the drive is polled. The bench says so by ``shield.frame_age``. Nothing here helps when
this computer or the cable is lost: the drive then holds its last current for its own time-out, and lets go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import StrEnum

from emb_runtime.can.codec import Signal
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, CounterCheck, LeakyCount
from emb_runtime.can.messages import Layout, StopReason, bench_identity
from emb_runtime.can.receiver import Reception
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Bench
from emb_runtime.drives.arming import Arming
from emb_runtime.drives.mapping import Mapping, Step
from emb_runtime.drives.sample_times import SampleTimes
from emb_runtime.drives.wire import DriveSample, DriveState, Encoder, Receiver
from emb_runtime.drives.wire_guard import WireGuard
from emb_runtime.errors import BusError, FrameError, SafetyStopError
from emb_runtime.records import CurrentCommand, Frame, NodeState, SensorSample
from emb_runtime.safety.shield import damped_current

STATUS_PERIODS = 100  # A status message every so many samples
ANSWER_PART = 0.75  # Part of a period after a sample within which its answer is obeyed; then the node brakes
SILENT_PERIODS = 3  # Periods without a sample after which an armed drive is let go: its speed is not known any more
READY_SAMPLES = 10  # Samples of a drive that broadcasts, before it is armed
REST_TRAVEL = 0.05  # rad
REST_PERIODS = 50  # The brake rests when it has stayed within REST_TRAVEL for so many samples
LONGEST_STOP_PERIODS = 1000  # Samples after which a stopping drive is disarmed, at rest or not
MOST_INTRUSIONS = 3  # Commands of another node after which a moving drive is let go: braking against them is no use
INTRUDED = "another node commands it; end that first, a second gateway maybe"
ARMED_PERIODS = 600_000  # Samples after which a drive that is armed and not commanded is let go
CONTRADICTIONS = 3
"""Samples in a row that contradict the one before, or a share of them, after which the drive is let go."""


class Phase(StrEnum):
    """Phase of the drive, as the node has brought it there."""

    OFF = "off"
    ARMING = "arming"
    READY = "ready"  # Armed, at 0 A: no command has come yet
    ACTIVE = "active"
    STOPPING = "stopping"
    FAILED = "failed"  # Given up: nothing is sent any more


ARMED = (Phase.READY, Phase.ACTIVE, Phase.STOPPING)
_STATES = {Phase.READY: NodeState.IDLE, Phase.ACTIVE: NodeState.ACTIVE, Phase.STOPPING: NodeState.STOPPING}


@dataclass
class NodeCounts:
    """Counts of a run."""

    samples: int = 0
    obeyed: int = 0
    braked: int = 0  # Periods without an answer in time, while active
    refused: int = 0  # Command frames of ours that were not obeyed
    not_sent: int = 0  # Commands for which the interface had no room


class DriveNode:
    """A drive on a bus of its own, as a node of ours.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        layout: our messages.
        send: puts a frame on the drive's bus.
    """

    def __init__(self, mapping: Mapping, bench: Bench, layout: Layout, send: Callable[[Frame], None]) -> None:
        self._mapping = mapping
        self._bench = bench
        self._layout = layout
        self._period_ns = bench.timing.sample_time_ns
        self._receiver = Receiver(mapping, bench.watch.stop_missed)
        self._encoder = Encoder(mapping)
        self.guard = WireGuard(mapping, bench.limits.current, send)
        self._identity = bench_identity(bench.identity_hash)
        self._watchdog_periods = math.ceil(bench.node.watchdog / bench.timing.sample_time - 1e-9)
        self._check = CounterCheck(COUNTER_MODULUS)
        self._counter = NO_COUNTER - 1  # the first sample has counter 0
        self._status_counter = 0
        self._sample: DriveSample | None = None
        self._follows = Reception(layout, bench, lambda _frame, _why: None).follows
        self._contradictions = LeakyCount(CONTRADICTIONS)
        self._device_ns = 0
        self._answered = self._braked = True
        self._obeyed_counter = NO_COUNTER
        self._said = self._said_before = 0.0  # currents that the last two frames said [A]
        self._pending: float | None = None
        self._poll_ns = 0
        self._armed_ns = self._let_go_ns = 0
        self._awaited = False  # a polled drive has not answered yet
        box = bench.range_set(bench.shield.ranges)
        self._moves_none = box.low.T_c / box.high.k_m  # current that moves no brake of the bench [A]
        self._largest = 0.0  # largest current of the latest run [A]
        self._unanswered = 0
        self._periods = 0  # samples since the phase began
        self._rest_angle, self._rest_periods = 0.0, 0
        self.arming = Arming(mapping, self._period_ns, self._send_step)
        self.times = SampleTimes(mapping, bench)
        self._is_ending = False  # the next stop ends with the drive let go
        self._intrusions = 0
        self.phase = Phase.OFF
        self.stop_reason = StopReason.NEVER_COMMANDED
        self.failure = ""
        """Reason why the drive was given up; empty if it was not."""
        self.counts = NodeCounts()

    @property
    def rejected(self) -> dict[str, int]:
        """Number of the drive's frames that were not believed, by reason."""
        return self._receiver.rejected

    @property
    def heard(self) -> str:
        """State that the drive reports, and its latest frame that was not believed, at the end of a sentence."""
        receiver, count = self._receiver, sum(self.rejected.values())
        refused = f"{count} frames were not believed, the last one {receiver.refusal}" if count else ""
        return "".join(f"; {text}" for text in (receiver.reported, refused) if text)

    @property
    def may_arm(self) -> bool:
        """True if the drive has been heard, or sends only what it is asked for."""
        return self._mapping.polled or self.counts.samples >= READY_SAMPLES

    @property
    def release_problem(self) -> str:
        """Reason why a drive that was let go may be armed; empty if it reports that it is not, or reports no state."""
        if self._mapping.state is None:
            return ""
        if self._receiver.said_ns <= self._let_go_ns:
            return "the drive has reported nothing since its disarming"
        if self._receiver.said is DriveState.ACTIVE:
            return "the drive still reports that it is armed: it ignores its disarming"
        return ""

    def due_ns(self, now_ns: int) -> int:
        """Time at which :meth:`tick` should be called next, at the latest [ns]."""
        times = [now_ns + self._period_ns]
        if self._mapping.polled:
            times += [self._poll_ns] if self._polls(now_ns) else []
            if self._silent(now_ns) and self.arming.asks_ns is not None:
                times.append(self.arming.asks_ns)
        elif self._sample is not None and not (self._answered or self._braked):
            times.append(self._deadline_ns())
        return max(now_ns, min(times))

    # --- requests of the host ---------------------------------------------------------------------------------------

    def arm(self, now_ns: int) -> None:
        """Begin to arm the drive; :attr:`phase` becomes READY, or FAILED.

        Where the drive reports its state, it must let go by its own time-out once before it is armed for good.

        Args:
            now_ns: monotonic [ns].
        """
        if self.phase is Phase.OFF:
            self.phase, self._armed_ns = Phase.ARMING, now_ns
            self.arming.begin(now_ns)
            self._after_arming()

    def disarm(self) -> None:
        """Stop if it moves, and let go."""
        self._is_ending = True
        if self.phase is Phase.ACTIVE:
            self._latch(StopReason.DISABLED)
        elif self.phase in (Phase.ARMING, Phase.READY):
            self._let_go()

    def intruded(self) -> bool:
        """Take note of a command of another node; returns True if the drive was armed, or about to be.

        A brake that moves is stopped, and the drive let go at rest; at once if such commands go on.
        """
        if self.phase not in (Phase.ARMING, *ARMED):
            return False
        self._intrusions += 1
        if self.phase in (Phase.ARMING, Phase.READY) or self._intrusions >= MOST_INTRUSIONS:
            self._give_up(INTRUDED)
        else:
            self.failure = INTRUDED
            self.disarm()
        return True

    def abandon(self) -> None:
        """Let an armed drive go at once, moving or not."""
        if self.phase is not Phase.OFF:
            self._give_up("the gateway ended while the drive was armed")

    def take_host(self, frame: Frame, now_ns: int) -> None:
        """Take a frame of ours; only a valid, fresh answer to the newest sample is obeyed."""
        if frame.identifier != self._layout.command.identifier or frame.extended:
            return
        try:
            taken = self._layout.decode_command(frame)
        except FrameError:
            self._check.reject()
            self.counts.refused += 1
            return
        fresh = self._check.step(taken.counter) != 0
        if not taken.enable:
            if self.phase is Phase.ACTIVE:
                self._latch(StopReason.DISABLED)
            self.counts.refused += not fresh or taken.current != 0.0
            return
        if not (fresh and self._may_obey(taken, now_ns)):
            self.counts.refused += 1
            return
        if self.phase is Phase.READY:
            self._enter(Phase.ACTIVE)
            self.stop_reason, self._largest = StopReason.NONE, 0.0
        self._answered = True
        if self._mapping.polled:
            self._pending, self._obeyed_counter = taken.current, taken.counter
        elif self._command(taken.current):
            self._obeyed_counter = taken.counter
            self.times.acted(now_ns)
        else:
            return
        self._unanswered = 0
        self.counts.obeyed += 1

    def _may_obey(self, taken: CurrentCommand, now_ns: int) -> bool:
        in_time = self._sample is not None and not (self._answered or self._braked) and now_ns < self._deadline_ns()
        permitted = self.phase in (Phase.READY, Phase.ACTIVE) and abs(taken.current) <= self._bench.limits.current
        return in_time and permitted and taken.answers == self._counter

    def _deadline_ns(self) -> int:
        assert self._sample is not None
        return self._sample.time_ns + round(ANSWER_PART * self._period_ns)

    # --- the drive's frames -----------------------------------------------------------------------------------------

    def take_drive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Take a frame from the drive's bus.

        Returns:
            Our frames: angle, velocity, now and then status, when it completes a sample.
        """
        said_ns = self._receiver.said_ns
        sample = self._receiver.take(frame)
        if self.phase is Phase.ARMING and self._receiver.said_ns != said_ns:
            self.arming.hear(self._receiver.state(now_ns), self._receiver.said_ns)
        self._watch_drive(now_ns)
        if self.phase in ARMED and (name := self._receiver.frames_missing):
            self._give_up(f"by its counter more than a fifth of the frames of {name} are missing: check its modulus")
        if sample is None or (self._mapping.polled and not self._awaited):
            return []  # an answer to a frame of a sequence is of no sample
        self._awaited = False
        return self._take_sample(sample)

    def _take_sample(self, sample: DriveSample) -> list[Frame]:
        device_ns = self.times.take(sample.time_ns)
        if not (self._answered or self._braked):
            self._miss()
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        self._watch_sensors(sample, device_ns)
        self._sample, self._answered, self._braked = sample, False, False
        self.counts.samples += 1
        self._periods += 1
        self._watch_limits(sample)
        applied = self._applied(sample)
        frames = self._frames(sample, applied, device_ns)
        if not self._mapping.polled:
            self._act_alone(sample.time_ns)
        return [frame._replace(time_ns=sample.time_ns) for frame in frames]

    def _applied(self, sample: DriveSample) -> float:
        """Current in the period that ended [A]: as measured, or as commanded where the measurement cannot tell them."""
        measured = self._mapping.current
        said = self._said_before if self._mapping.polled else self._said  # an answer is packed before it is obeyed
        if measured is None:
            return said
        step = measured.field.step(sample.current / measured.factor) * abs(measured.factor)
        return said if abs(sample.current - said) <= step else sample.current

    def _act_alone(self, sample_ns: int) -> None:
        """Send the node's own current at each sample: 0 A until the first command, and the stop."""
        if self._silent(sample_ns):
            return
        if self.phase in (Phase.ARMING, Phase.READY):  # a drive says late that it is armed, and its time-out runs
            if self._command(0.0):
                self.arming.fed(sample_ns)
        elif self.phase is Phase.STOPPING:
            self._command(self._own_current())

    def _watch_sensors(self, sample: DriveSample, device_ns: int) -> None:
        """Give the drive up where the angle does not follow from the velocity: with that no brake can be stopped."""
        before, elapsed_ns, self._device_ns = self._sample, device_ns - self._device_ns, device_ns
        if before is None or self._follows(_seen(before), _seen(sample), elapsed_ns * 1e-9):
            self._contradictions.forgive()
            return
        self._contradictions.reject()
        if self._contradictions.exceeded and self.phase in ARMED:
            self._give_up("angle and velocity contradict each other: with them no brake can be stopped")

    def _watch_limits(self, sample: DriveSample) -> None:
        noise, sigmas, (low, high) = self._bench.noise, self._bench.shield.noise_sigmas, self._bench.limits.angle
        outside = not low - sigmas * noise.angle <= sample.angle <= high + sigmas * noise.angle
        outside = outside or not abs(sample.velocity) <= self._bench.limits.velocity + sigmas * noise.velocity
        if self.phase is Phase.ACTIVE and outside:
            self._latch(StopReason.LIMIT)
        if self.phase is Phase.STOPPING:
            self._watch_rest(sample)
        elif self.phase is Phase.READY and self._periods > ARMED_PERIODS:
            self._let_go()

    def _watch_rest(self, sample: DriveSample) -> None:
        if abs(sample.angle - self._rest_angle) > REST_TRAVEL:
            self._rest_angle, self._rest_periods = sample.angle, 0
        self._rest_periods += 1
        if self._rest_periods > REST_PERIODS and self.stop_reason is StopReason.DISABLED and not self._is_ending:
            self._enter(Phase.READY)
        elif self._rest_periods > REST_PERIODS or self._periods > LONGEST_STOP_PERIODS:
            self._let_go()

    def _watch_drive(self, now_ns: int) -> None:
        """Give the drive up when it says that it is not armed, or says nothing."""
        if self.phase not in ARMED:
            return
        if self._mapping.state is not None and (state := self._receiver.state(now_ns)) is not DriveState.ACTIVE:
            self._give_up(f"the drive is {state}, it was armed")

    # --- time -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Do what is due by the time [ns]: poll, brake a sample without an answer, let go of a silent drive."""
        if self.phase is Phase.ARMING:
            self._armed_ns = now_ns
            self.arming.advance(now_ns, self._receiver.state(now_ns))
            self._after_arming()
        self._watch_drive(now_ns)
        heard_ns = self._armed_ns if self._sample is None else max(self._armed_ns, self._sample.time_ns)
        if self.phase in ARMED and now_ns - heard_ns > SILENT_PERIODS * self._period_ns:
            self._give_up(f"the drive is silent for {SILENT_PERIODS} periods")
        if self._mapping.polled:
            self._poll(now_ns)
        elif self._sample is not None and not (self._answered or self._braked) and now_ns >= self._deadline_ns():
            self._miss()

    def _miss(self) -> None:
        """A sample was not answered in time: brake in its period, and stop after too many."""
        self._braked = True
        if self.phase is not Phase.ACTIVE:
            return
        self.counts.braked += 1
        self._unanswered += 1
        if not self._mapping.polled:
            self._command(self._own_current())
        if self._unanswered >= self._watchdog_periods:
            self._latch(StopReason.WATCHDOG)

    def _polls(self, now_ns: int) -> bool:
        return self.phase not in (Phase.OFF, Phase.FAILED) and not self._silent(now_ns)

    def _poll(self, now_ns: int) -> None:
        if now_ns < self._poll_ns or not self._polls(now_ns):
            return
        late = now_ns - self._poll_ns >= self._period_ns
        self._poll_ns = now_ns + self._period_ns if late else self._poll_ns + self._period_ns
        if self.phase is Phase.ACTIVE and self._pending is None and not self._braked:
            self._miss()
        pending, self._pending = self._pending, None
        self._awaited = True
        if self.phase is Phase.ACTIVE and pending is not None:
            self._command(pending)
            self.times.acted(now_ns)
        else:
            if self._command(self._own_current() if self.phase in (Phase.ACTIVE, Phase.STOPPING) else 0.0):
                self.arming.fed(now_ns)
        self.times.asked(now_ns)

    def _own_current(self) -> float:
        """Current with which the node brakes by itself: the damped stop, or none [A].

        None where no brake can have been moved: with a current of a wrong scale the stop would set it in motion.
        """
        lets_go = self._bench.node.stop == "freewheel" or self._largest <= self._moves_none
        if lets_go or self._sample is None or self._contradictions.errors:
            return 0.0  # a velocity that may be wrong would drive the brake on
        limit = self._bench.limits.current
        return damped_current(self._sample.velocity, limit, self._bench.node.damping_velocity)

    # --- sequences --------------------------------------------------------------------------------------------------

    def _after_arming(self) -> None:
        if self.phase is Phase.ARMING and self.arming.failure:
            self._give_up(self.arming.failure)
        elif self.phase is Phase.ARMING and self.arming.done:
            self._enter(Phase.READY)

    def _silent(self, now_ns: int) -> bool:
        return self.phase is Phase.ARMING and self.arming.silent(now_ns)

    def _send_step(self, step: Step) -> bool:
        """Send a step's frames; returns False where the second guard refused one, and the drive is given up."""
        for constant in step.frames:
            try:
                self.guard.constant(self._encoder.constant(constant), constant)
            except TransmitQueueFullError:
                self.counts.not_sent += 1
            except SafetyStopError as refused:
                if self.phase is not Phase.FAILED:
                    self._give_up(str(refused))
                    return False
        return True

    def _enter(self, phase: Phase) -> None:
        self.phase, self._periods = phase, 0

    def _latch(self, reason: StopReason) -> None:
        self._enter(Phase.STOPPING)
        self.stop_reason = reason
        self._pending = None
        self._rest_angle, self._rest_periods = math.inf, 0

    def _let_go(self) -> None:
        """0 A, then the file's sequence."""
        self._command(0.0)
        if self.phase is Phase.FAILED:
            return
        self._enter(Phase.OFF)
        self._let_go_ns = self._receiver.said_ns
        for step in self._mapping.disarm:
            self._send_step(step)

    def _give_up(self, reason: str) -> None:
        if self.phase is Phase.FAILED:
            return
        self.phase, self.failure, self._let_go_ns = Phase.FAILED, reason, self._receiver.said_ns
        self._command(0.0)
        for step in self._mapping.disarm:
            self._send_step(step)

    def _command(self, current: float) -> bool:
        """Send a current through the second guard; returns True if it left."""
        try:
            said = self.guard.command(self._encoder.command(current), current)
        except TransmitQueueFullError:
            self.counts.not_sent += 1
            return False
        except BusError:
            raise
        except (FrameError, SafetyStopError) as refused:
            self._give_up(str(refused))
            return False
        self._said_before, self._said = self._said, said
        self._largest = max(self._largest, abs(current))
        return True

    # --- our frames -------------------------------------------------------------------------------------------------

    @property
    def state(self) -> NodeState:
        """State as our frames have it."""
        return _STATES.get(self.phase, NodeState.FAULT)

    def _frames(self, sample: DriveSample, applied: float, device_ns: int) -> list[Frame]:
        layout, counter, state = self._layout, self._counter, self.state
        angle = _saturated(sample.angle, layout.angle.signal("Angle"))
        velocity = _saturated(sample.velocity, layout.velocity.signal("Velocity"))
        applied = _saturated(applied, layout.velocity.signal("AppliedCurrent"))
        obeyed, self._obeyed_counter = self._obeyed_counter, NO_COUNTER
        frames = [
            layout.encode_angle(counter, angle, device_ns),
            layout.encode_velocity(counter, velocity, applied, state, obeyed),
        ]
        if self.counts.samples % STATUS_PERIODS == 1:
            refused = self.counts.refused
            frames.append(layout.encode_status(self._status_counter, state, self.stop_reason, refused, self._identity))
            self._status_counter = (self._status_counter + 1) % COUNTER_MODULUS
        return frames


def report(node: DriveNode) -> dict[str, str]:
    """Counts of a node, for the operator."""
    times, rejected = node.times, ", ".join(f"{reason} ({count})" for reason, count in node.rejected.items())
    return {f"drive_{name}": str(value) for name, value in asdict(node.counts).items()} | {
        "drive_largest_age_ns": str(times.largest_age_ns),
        "drive_largest_jitter_ns": str(times.largest_jitter_ns),
        "drive_frames_passed": str(node.guard.passed),
        "drive_frames_refused": str(node.guard.rejected),
        "drive_frames_not_believed": rejected or "none",
        "drive_time_out": node.arming.time_out,
        "drive_too_late": times.too_late,
        "drive_failure": node.failure or "none",
    }


def _seen(sample: DriveSample) -> SensorSample:
    """Angle and velocity of a sample for the plausibility check of our receiver."""
    return SensorSample(0, sample.angle, sample.velocity, 0, 0, 0.0, NO_COUNTER, NodeState.IDLE)


def _saturated(value: float, signal: Signal) -> float:
    """Value within a signal's range: what is beyond shows its end."""
    return min(max(value, signal.minimum), signal.maximum)
