"""The way of a drive from off to armed: the file's sequence, and a silence after it that proves its time-out."""

from __future__ import annotations

from collections.abc import Callable

from emb_runtime.drives.mapping import Mapping, Step
from emb_runtime.drives.time_out_proof import TimeOutProof
from emb_runtime.drives.wire import DriveState

AIMS = (1.0, 0.75, 1.0, 0.75)
"""Periods after the time-out at which the message that decides is to come: one more silence with each, if none does."""


class Arming:
    """Brings one drive from off to armed.

    Args:
        mapping: the drive.
        period_ns: sample time [ns].
        send: puts a step's frames on the bus; returns False if the drive was given up at that.
    """

    def __init__(self, mapping: Mapping, period_ns: int, send: Callable[[Step], bool]) -> None:
        self._mapping = mapping
        self._period_ns = period_ns
        self._send = send
        self._steps: list[Step] = []
        self._until_ns = 0
        self._proof: TimeOutProof | None = None
        self._silences = 0
        self.done = False
        """The drive is armed, as far as it says so."""
        self.failure = ""
        """Reason why it cannot be armed; empty if there is none so far."""

    @property
    def time_out(self) -> str:
        """Proof of the drive's own time-out, in words."""
        if self._proof is not None and self._proof.done:
            return f"disarmed within {self._proof.seen_ns * 1e-9:.3f} s without a command"
        if self._mapping.state is None:
            return "not provable: the drive does not report whether it is armed"
        return "not proved yet"

    def begin(self, now_ns: int) -> None:
        """Send the first frames (monotonic time [ns])."""
        self._proof, self.done, self.failure = None, False, ""
        self._silences = 0
        self._prove(now_ns)

    def _prove(self, now_ns: int) -> None:
        if self._mapping.state is not None:
            watchdog, polled, aim = self._mapping.watchdog, self._mapping.polled, AIMS[self._silences]
            self._proof = TimeOutProof(watchdog, self._mapping.state, self._period_ns, polled=polled, aim=aim)
            self._silences += 1
        self._begin_sequence(now_ns)

    @property
    def asks_ns(self) -> int | None:
        """Time at which a polled drive is asked after a silence [ns]; None if there is none."""
        return None if self._proof is None else self._proof.asks_ns

    def fed(self, now_ns: int) -> None:
        """Note that a frame leaves to the drive, not before this time [ns]."""
        if self._proof is not None:
            self._proof.fed(now_ns)

    def silent(self, now_ns: int) -> bool:
        """Returns True if nothing may leave now."""
        return self._proof is not None and not self._steps and self._proof.silent(now_ns)

    def hear(self, said: DriveState, said_ns: int) -> None:
        """Take what the drive says of its state, at the arrival of the message [ns]."""
        if self._proof is not None and not self._steps:
            self._proof.take(said, said_ns)

    def advance(self, now_ns: int, said: DriveState) -> None:
        """Do what is due by the time [ns], with the state that the drive has said."""
        if not self._steps:
            self._continue_proof(now_ns)
            return
        step = self._steps[0]
        reached = step.state == str(said)
        if step.state and not reached and now_ns >= self._until_ns:
            self.failure = f"the drive did not become {step.state} within {step.timeout:g} s"
        elif reached or (not step.state and now_ns >= self._until_ns):
            self._steps.pop(0)
            self._go_on(now_ns)

    def _begin_sequence(self, now_ns: int) -> None:
        self._steps = list(self._mapping.arm)
        self._go_on(now_ns)

    def _go_on(self, now_ns: int) -> None:
        """Send steps up to one that waits."""
        while self._steps:
            step = self._steps[0]
            if not self._send(step):
                return
            self.fed(now_ns)
            if step.timeout:
                self._until_ns = now_ns + round(step.timeout * 1e9)
                return
            self._steps.pop(0)
        self.done = self._proof is None or self._proof.done

    def _continue_proof(self, now_ns: int) -> None:
        assert self._proof is not None
        self._proof.tick(now_ns)
        self.failure = self._proof.failure
        if self._proof.done:  # it has let go: arm it once more
            self._begin_sequence(now_ns)
        elif self._proof.unresolved and self._silences < len(AIMS):
            self._prove(now_ns)
        elif self._proof.unresolved:
            self.failure = (
                f"its time-out is not proved: in {self._silences} silences it was not seen to act, the last one "
                f"{self._proof.seen_ns * 1e-9:.3f} s; set the drive's to node.watchdog = {self._mapping.watchdog:g} s"
            )
