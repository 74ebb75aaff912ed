"""Phases of a drive: each takes an event and returns the next phase.

    Off -> Arming -> Ready -> Active -> Stopping -> Ready after a stop of the host, else Off
    Arming, Ready -> Off when nobody wants the drive any more; Arming, Ready, Active, Stopping -> Failed

Pure, but for Arming, which sends the file's sequence. The node sends nothing in Off and Failed, 0 A while Arming and
Ready, the host's current while Active, that of its stop while Stopping. On the way to Off and to Failed it lets the
drive go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from emb_runtime.can.messages import StopReason
from emb_runtime.drives.mapping import Mapping, Step
from emb_runtime.drives.time_out_proof import TimeOutProof
from emb_runtime.drives.wire import DriveSample, DriveState, Outlet
from emb_runtime.records import NodeState

REST_TRAVEL = 0.05  # rad
REST_PERIODS = 50  # The brake rests when it has stayed within REST_TRAVEL for so many samples
LONGEST_STOP_PERIODS = 1000  # Samples after which a stopping drive is disarmed, at rest or not
ARMED_PERIODS = 600_000  # Samples after which a drive that is armed and not commanded is let go
AIMS = (1.0, 0.75, 1.0, 0.75)
"""Periods after the time-out at which the message that decides is to come: one more silence with each, if none does."""


class Phase:
    """A phase in which nothing moves."""

    state = NodeState.FAULT  # As our frames have it

    def on_sample(self, sample: DriveSample, is_outside: bool) -> Phase:
        """A sample has come, inside or outside the bench's limits."""
        return self

    def on_stop(self, is_last: bool) -> Phase:
        """The host has ended its run, or the operator the last one."""
        return Off() if is_last else self


@dataclass(frozen=True)
class Off(Phase):
    """Not armed by the node, or let go."""


@dataclass(frozen=True)
class Failed(Phase):
    """Given up for good."""

    why: str


class Arming(Phase):
    """On the way to armed: the file's sequence, a silence in which the drive lets go, and the sequence once more."""

    def __init__(self, mapping: Mapping, period_ns: int, outlet: Outlet) -> None:
        self._mapping = mapping
        self._period_ns = period_ns
        self._outlet = outlet
        self._steps: tuple[Step, ...] = ()
        self._until_ns = 0
        self._proof: TimeOutProof | None = None
        self._silences = 0
        self.time_ns = 0
        """Time up to which the drive was armed [ns]."""

    @property
    def time_out(self) -> str:
        """Proof of the drive's time-out, in words."""
        if self._proof is not None and self._proof.done:
            return f"disarmed within {self._proof.seen_ns * 1e-9:.3f} s without a command"
        if self._mapping.state is None:
            return "not provable: the drive does not report whether it is armed"
        return "not proved yet"

    @property
    def asks_ns(self) -> int | None:
        """Time of the poll after a silence [ns]; None if there is none."""
        return None if self._proof is None else self._proof.asks_ns

    def begin(self, now_ns: int) -> Phase:
        """Send the first frames (monotonic time [ns])."""
        self.time_ns, self._silences = now_ns, 0
        return self._prove(now_ns)

    def fed(self, now_ns: int) -> None:
        """Note that a frame leaves to the drive, not before this time [ns]."""
        if self._proof is not None:
            self._proof.fed(now_ns)

    def silent(self, now_ns: int) -> bool:
        """Returns True if nothing may leave now."""
        return self._proof is not None and not self._steps and self._proof.silent(now_ns)

    def on_report(self, state: DriveState, time_ns: int) -> None:
        """The drive has reported its state, by a message that came at this time [ns]."""
        if self._proof is not None and not self._steps:
            self._proof.add_report(state, time_ns)

    def on_time(self, now_ns: int, state: DriveState) -> Phase:
        """Send what is due; a state that does not come in time is a failure."""
        self.time_ns = now_ns
        if not self._steps:
            return self._continue_proof(now_ns)
        step = self._steps[0]
        if str(state) == step.state or (not step.state and now_ns >= self._until_ns):
            return self._send(self._steps[1:], now_ns)
        if step.state and now_ns >= self._until_ns:
            return Failed(f"the drive did not become {step.state} within {step.timeout:g} s")
        return self

    def _prove(self, now_ns: int) -> Phase:
        if self._mapping.state is not None:
            watchdog, polled, aim = self._mapping.watchdog, self._mapping.polled, AIMS[self._silences]
            self._proof = TimeOutProof(watchdog, self._mapping.state, self._period_ns, polled=polled, aim=aim)
            self._silences += 1
        return self._send(self._mapping.arm, now_ns)

    def _send(self, steps: tuple[Step, ...], now_ns: int) -> Phase:
        """Send steps up to one that waits."""
        for number, step in enumerate(steps):
            self._steps = steps[number:]
            for constant in step.frames:
                if refused := self._outlet.send(constant):
                    return Failed(refused)
            self.fed(now_ns)
            if step.timeout:
                self._until_ns = now_ns + round(step.timeout * 1e9)
                return self
        self._steps = ()
        return Ready() if self._proof is None or self._proof.done else self

    def _continue_proof(self, now_ns: int) -> Phase:
        proof = self._proof
        assert proof is not None
        proof.tick(now_ns)
        if proof.done:  # it has let go: arm it once more
            return self._send(self._mapping.arm, now_ns)
        if proof.unresolved and self._silences < len(AIMS):
            return self._prove(now_ns)
        if proof.unresolved:
            return Failed(
                f"its time-out is not proved: in {self._silences} silences it was not seen to act, the last one "
                f"{proof.seen_ns * 1e-9:.3f} s; set the drive's to node.watchdog = {self._mapping.watchdog:g} s"
            )
        return Failed(proof.failure) if proof.failure else self


@dataclass(frozen=True)
class Ready(Phase):
    """Armed: no command has come yet."""

    periods: int = 0
    state = NodeState.IDLE

    def on_sample(self, sample: DriveSample, is_outside: bool) -> Phase:
        """A drive that nobody commands does not stay armed."""
        return Off() if self.periods == ARMED_PERIODS else Ready(self.periods + 1)


@dataclass(frozen=True)
class Active(Phase):
    """Armed, and obeys the host."""

    state = NodeState.ACTIVE

    def on_sample(self, sample: DriveSample, is_outside: bool) -> Phase:
        """Outside its limits the brake is stopped."""
        return Stopping(StopReason.LIMIT, rest_angle=sample.angle, rest_periods=1) if is_outside else self

    def on_stop(self, is_last: bool) -> Phase:
        """The brake may move."""
        return Stopping(StopReason.DISABLED, is_last)


@dataclass(frozen=True)
class Stopping(Phase):
    """Armed, until the brake rests."""

    reason: StopReason
    is_last: bool = False  # The drive is let go after it
    periods: int = 0
    rest_angle: float = math.inf  # Within REST_TRAVEL of which the brake has stayed [rad]
    rest_periods: int = 0
    state = NodeState.STOPPING

    def on_sample(self, sample: DriveSample, is_outside: bool) -> Phase:
        """At rest the stop ends; after the longest one it ends anyhow."""
        stays = abs(sample.angle - self.rest_angle) <= REST_TRAVEL
        angle, rest_periods = (self.rest_angle, self.rest_periods + 1) if stays else (sample.angle, 1)
        if rest_periods > REST_PERIODS and self.reason is StopReason.DISABLED and not self.is_last:
            return Ready()
        if rest_periods > REST_PERIODS or self.periods == LONGEST_STOP_PERIODS:
            return Off()
        return replace(self, periods=self.periods + 1, rest_angle=angle, rest_periods=rest_periods)

    def on_stop(self, is_last: bool) -> Phase:
        """The stop goes on."""
        return replace(self, is_last=self.is_last or is_last)
