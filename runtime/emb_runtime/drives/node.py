"""The software node: between a drive that speaks its own protocol and a loop that speaks ours.

Pure logic: frames of both sides and times go in, frames come out; no clock, no socket. To the loop it is a node like
any other, see ``emb.dbc``: it obeys a valid, enabled answer to the newest sample, brakes a period that has none, and
begins a stop after the bench's ``node.watchdog``. To the drive it is the commander: it sends one current for each
sample, and so feeds the drive's watchdog only as long as samples come and are answered or braked.

A command acts when it arrives, within the period of its sample, or of the next one where the drive is polled: see
``shield.frame_age`` of the bench. Nothing here helps when this computer or the cable is lost: the drive then holds its
last current for its time-out, and lets go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from emb_runtime.can.messages import Layout, StopReason
from emb_runtime.config.bench import Bench
from emb_runtime.drives.answers import Answers
from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.phases import Active, Arming, Failed, Off, Phase, Ready, Stopping
from emb_runtime.drives.samples import SampleTimes, SensorCheck
from emb_runtime.drives.wire import DriveState, Outlet, Receiver, conditions_in
from emb_runtime.errors import FrameError, SafetyStopError
from emb_runtime.records import Frame
from emb_runtime.safety.shield import damped_current

SILENT_PERIODS = 3  # Periods without a sample after which an armed drive is let go: its speed is then unknown
READY_SAMPLES = 10  # Samples of a drive that broadcasts, before it is armed
MOST_INTRUSIONS = 3  # Commands of another node after which a moving drive is let go: braking against them is no use
INTRUDED = "another node commands it; end that first, a second gateway maybe"


@dataclass
class Poll:
    """Exchange with a drive that only answers: each command requests a sample."""

    due_ns: int = 0
    is_awaited: bool = False  # The sample has not come yet
    current: float | None = None  # The host's, for the next poll [A]


class DriveNode:
    """A drive, to whose bus frames are sent, as a node of ours, with a bench's limits, timing and stop."""

    def __init__(self, mapping: Mapping, bench: Bench, layout: Layout, send: Callable[[Frame], None]) -> None:
        self._mapping = mapping
        self._bench = bench
        self._period_ns = bench.timing.sample_time_ns
        self.receiver = Receiver(mapping, bench.watch.stop_missed)
        self.outlet = Outlet(mapping, bench.limits.current, send)
        self.answers = Answers(layout, bench)
        self._sensors = SensorCheck(bench)
        self._poll = Poll() if mapping.polled else None
        box = bench.range_set(bench.shield.ranges)
        self._moves_none = box.low.T_c / box.high.k_m  # current that moves no brake of the bench [A]
        self.arming = Arming(mapping, self._period_ns, self.outlet)
        self.times = SampleTimes(mapping, bench)
        self.phase: Phase = Off()
        self.stop_reason = StopReason.NEVER_COMMANDED
        self.failure = ""
        """Reason why the drive was given up; empty if it was not."""
        self._intrusions = 0
        self._released_ns = 0

    @property
    def reported(self) -> str:
        """State that the drive reports, and its latest frame that was not believed, at the end of a sentence."""
        receiver, count = self.receiver, sum(self.receiver.rejected.values())
        refused = f"{count} frames were not believed, the last one {receiver.refusal}" if count else ""
        return "".join(f"; {text}" for text in (receiver.reported, refused) if text)

    @property
    def may_arm(self) -> bool:
        """True if the drive has sent samples, or only answers."""
        return self._poll is not None or self.answers.samples >= READY_SAMPLES

    @property
    def release_problem(self) -> str:
        """Reason why a drive that was let go may be armed; empty if it reports that it is not, or reports no state."""
        if self._mapping.state is None:
            return ""
        if self.receiver.state_ns <= self._released_ns:
            return "the drive has reported nothing since its disarming"
        is_armed = self.receiver.last_state is DriveState.ACTIVE
        return "the drive still reports that it is armed: it ignores its disarming" if is_armed else ""

    def due_ns(self, now_ns: int) -> int:
        """Time at which :meth:`tick` is due, at the latest [ns]: for a poll, or for a sample without an answer."""
        due_ns, latest_ns = self.answers.deadline_ns, now_ns + self._period_ns
        if self._poll is not None:
            due_ns = self.arming.asks_ns if self._is_silent(now_ns) else self._poll.due_ns
            due_ns = None if isinstance(self.phase, Off | Failed) else due_ns
        return latest_ns if due_ns is None else max(now_ns, min(latest_ns, due_ns))

    def arm(self, now_ns: int) -> None:
        """Begin to arm the drive at a monotonic time [ns]; :attr:`phase` becomes Ready, or Failed.

        Where the drive reports its state, it must let go by its time-out once before it is armed for good.
        """
        if isinstance(self.phase, Off):
            self._enter(self.arming)
            self._enter(self.arming.begin(now_ns))

    def disarm(self) -> None:
        """Stop if it moves, and let go."""
        self._enter(self.phase.on_stop(is_last=True))

    def abandon(self) -> None:
        """Let an armed drive go at once, moving or not."""
        if not isinstance(self.phase, Off):
            self._enter(Failed("the gateway ended while the drive was armed"))

    def handle_intrusion(self) -> bool:
        """Take note of a command of another node; returns True if the drive was armed, or about to be.

        A brake that moves is stopped, and the drive let go at rest; at once if such commands go on.
        """
        if isinstance(self.phase, Off | Failed):
            return False
        self._intrusions += 1
        if isinstance(self.phase, Arming | Ready) or self._intrusions >= MOST_INTRUSIONS:
            self._enter(Failed(INTRUDED))
        self.failure = INTRUDED
        self.disarm()
        return True

    def handle_host(self, frame: Frame, now_ns: int) -> None:
        """Take a frame of ours; only a valid, fresh answer to the newest sample is obeyed."""
        command = self.answers.accept(frame, now_ns, obeys=isinstance(self.phase, Ready | Active))
        if command is None:
            return
        if not command.enable:
            self._enter(self.phase.on_stop(is_last=False))
            return
        if isinstance(self.phase, Ready):
            self._enter(Active())
            self.stop_reason, self.outlet.largest = StopReason.NONE, 0.0
        if self._poll is not None:
            self._poll.current = command.current
        elif self._command(command.current):
            self.times.acted(now_ns)
        else:
            return
        self.answers.obey(command)

    def handle_drive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Take a frame of the drive; gives our angle and velocity if it completes a sample, now and then status, too.

        Behind a status come the conditions, where the mapping names both and they have come since the last ones.
        """
        receiver, before_ns = self.receiver, self.receiver.state_ns
        self.answers.conditions |= {name: (one, now_ns) for name, one in conditions_in(self._mapping, frame).items()}
        sample = receiver.add_frame(frame)
        if isinstance(self.phase, Arming) and receiver.state_ns != before_ns:
            self.arming.on_report(receiver.state(now_ns), receiver.state_ns)
        self._check_drive(now_ns)
        if name := receiver.frames_missing:
            self._fail(f"by its counter more than a fifth of the frames of {name} are missing: check its modulus")
        if sample is None or (self._poll is not None and not self._poll.is_awaited):
            return []  # an answer to a frame of a sequence is of no sample
        if self._poll is not None:
            self._poll.is_awaited = False
        device_ns = self.times.add_sample(sample.time_ns)
        if self.answers.deadline_ns is not None:
            self._miss()
        self._sensors.update(sample, device_ns)
        if self._sensors.contradictions.exceeded:
            self._fail("angle and velocity contradict each other: with them no brake can be stopped")
        self._enter(self.phase.on_sample(sample, self._sensors.is_outside(sample)))
        frames = self.answers.frames(sample, self.outlet.applied(sample), device_ns, self.phase.state, self.stop_reason)
        # While Arming too: a drive reports late that it is armed, and its time-out runs.
        sends = self._poll is None and isinstance(self.phase, Arming | Ready | Stopping)
        if sends and not self._is_silent(sample.time_ns):
            self._send_own(sample.time_ns)
        return frames

    def tick(self, now_ns: int) -> None:
        """Do what is due by the time [ns]: poll, brake a sample without an answer, let go of a silent drive."""
        if isinstance(self.phase, Arming):
            self._enter(self.arming.on_time(now_ns, self.receiver.state(now_ns)))
        self._check_drive(now_ns)
        sample, since_ns = self.answers.sample, self.arming.time_ns
        since_ns = since_ns if sample is None else max(since_ns, sample.time_ns)
        if now_ns - since_ns > SILENT_PERIODS * self._period_ns:
            self._fail(f"the drive is silent for {SILENT_PERIODS} periods")
        is_due = self.due_ns(now_ns) <= now_ns
        if is_due and self._poll is not None:
            self._send_poll(self._poll, now_ns)
        elif is_due:
            self._miss()

    def _send_poll(self, poll: Poll, now_ns: int) -> None:
        is_late = now_ns - poll.due_ns >= self._period_ns
        poll.due_ns = (now_ns if is_late else poll.due_ns) + self._period_ns
        current, poll.current, poll.is_awaited = poll.current, None, True
        if current is not None and isinstance(self.phase, Active):
            self._command(current)
            self.times.acted(now_ns)
        else:
            if not self.answers.missed and isinstance(self.phase, Active):
                self._miss()
            self._send_own(now_ns)
        self.times.polled(now_ns)

    def _check_drive(self, now_ns: int) -> None:
        """Give the drive up when it reports that it is not armed, or reports nothing."""
        if self._mapping.state is not None and (state := self.receiver.state(now_ns)) is not DriveState.ACTIVE:
            self._fail(f"the drive is {state}, it was armed")

    def _miss(self) -> None:
        """A sample was not answered in time: brake in its period, and stop after too many."""
        is_active = isinstance(self.phase, Active)
        is_lost = self.answers.miss(is_active)
        if is_active and self._poll is None:
            self._command(self._own_current())
        if is_lost:
            self._enter(Stopping(StopReason.WATCHDOG))

    def _is_silent(self, now_ns: int) -> bool:
        return isinstance(self.phase, Arming) and self.arming.silent(now_ns)

    def _own_current(self) -> float:
        """Current with which the node brakes by itself: the damped stop, or none [A].

        None where no brake can have been moved: with a current of a wrong scale the stop would set it in motion; and
        none with a velocity that may be wrong, which would drive the brake on.
        """
        sample, node = self.answers.sample, self._bench.node
        may_move = isinstance(self.phase, Active | Stopping) and self.outlet.largest > self._moves_none
        if sample is None or not may_move or node.stop == "freewheel" or self._sensors.contradictions.errors:
            return 0.0
        return damped_current(sample.velocity, self._bench.limits.current, node.damping_velocity)

    def _send_own(self, now_ns: int) -> None:
        if self._command(self._own_current()):
            self.arming.fed(now_ns)

    def _command(self, current: float) -> bool:
        """Send a current [A]; returns True if it was sent. One that is refused ends in Failed."""
        try:
            return self.outlet.command(current)
        except (FrameError, SafetyStopError) as refused:
            self._enter(Failed(str(refused)))
            return False

    def _fail(self, reason: str) -> None:
        """Give up a drive that is armed."""
        if isinstance(self.phase, Ready | Active | Stopping):
            self._enter(Failed(reason))

    def _enter(self, phase: Phase) -> None:
        """Go on to a phase; a drive that is let go gets 0 A and the file's sequence."""
        if phase == self.phase or isinstance(self.phase, Failed):
            return
        lets_go = isinstance(phase, Off | Failed)
        if isinstance(phase, Failed):  # now, as a frame may be refused on this way, too
            self.phase, self.failure = phase, phase.why
        if lets_go:
            self._released_ns = self.receiver.state_ns
            self._command(0.0)
        if isinstance(self.phase, Failed) and self.phase != phase:  # that was refused on the way to Off
            return
        self.phase = phase
        if isinstance(phase, Stopping):
            self.stop_reason = phase.reason
        for constant in (frame for step in self._mapping.disarm if lets_go for frame in step.frames):
            if refused := self.outlet.send(constant):
                self._enter(Failed(refused))


def report(node: DriveNode) -> dict[str, str]:
    """Counts of a node, for the operator."""
    times, guard, rejected = node.times, node.outlet.guard, node.receiver.rejected.items()
    return {
        f"drive_{name}": str(getattr(node.answers, name)) for name in ("samples", "obeyed", "braked", "refused")
    } | {
        "drive_not_sent": str(node.outlet.not_sent),
        "drive_largest_age_ns": str(times.largest_age_ns),
        "drive_largest_jitter_ns": str(times.largest_jitter_ns),
        "drive_frames_passed": str(guard.passed),
        "drive_frames_refused": str(guard.rejected),
        "drive_frames_not_believed": ", ".join(f"{reason} ({count})" for reason, count in rejected) or "none",
        "drive_time_out": node.arming.time_out,
        "drive_too_late": times.too_late,
        "drive_failure": node.failure or "none",
    }
