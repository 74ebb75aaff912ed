"""Proof that a drive lets go by itself: after 0 A nothing is sent to it, and the state that it then reports decides.

A drive that reports that it is not armed has let go within the time since the last frame to it. Drives report their
state seldom (ODrive: each 100 ms). The silence begins so that one of these messages comes just after the time-out: a
longer time-out than the mapping file's then shows too, beyond :data:`PASSED_PERIODS`.
"""

from __future__ import annotations

from emb_runtime.drives.mapping import PASSED_PERIODS, State
from emb_runtime.drives.wire import DriveState

TIMEOUTS = 4  # Times ``state.timeout`` within which the drive must have reported its state often enough


class TimeOutProof:
    """One silence.

    Args:
        watchdog: the drive's time-out, as the mapping file has it [s].
        state: the signal of its state.
        period_ns: sample time [ns].
        polled: it only answers: a poll ends the silence.
        aim: periods after the time-out at which the message that decides is to come, at the earliest.
    """

    def __init__(self, watchdog: float, state: State, period_ns: int, *, polled: bool, aim: float = 1.0) -> None:
        self._watchdog = watchdog
        self._least_ns = round(watchdog * 1e9) + round(aim * period_ns)
        self._most_ns = round(watchdog * 1e9) + PASSED_PERIODS * period_ns
        self._longest_ns = self._most_ns + round(TIMEOUTS * state.timeout * 1e9)
        self._polled = polled
        self._since_ns: int | None = None
        self._report_ns: int | None = None
        self._begin_ns: int | None = None
        self._fed_ns = 0
        self.done = False
        """The drive has let go in time."""
        self.unresolved = False
        """The drive has let go, but reported it too late for a proof: another silence may show more."""
        self.failure = ""
        """Reason why it is not proved; empty if there is none so far."""
        self.seen_ns = 0
        """Time from the last frame to the drive to the message that decided [ns]."""

    @property
    def over(self) -> bool:
        """Returns True if it is decided."""
        return self.done or self.unresolved or bool(self.failure)

    @property
    def asks_ns(self) -> int | None:
        """Time of the poll that ends the silence [ns]; None before it begins."""
        return None if self._begin_ns is None else self._begin_ns + self._least_ns

    def silent(self, now_ns: int) -> bool:
        """Returns True if nothing may leave now."""
        if self.over or self._begin_ns is None:
            return False
        return now_ns > self._begin_ns and not (self._polled and now_ns >= self._begin_ns + self._least_ns)

    def fed(self, now_ns: int) -> None:
        """Note that a frame leaves to the drive, not before this time [ns]; the poll at its end does not count."""
        if self._begin_ns is None or now_ns <= self._begin_ns:
            self._fed_ns = now_ns

    def tick(self, now_ns: int) -> None:
        """Give up if the drive does not report its state."""
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        if not self.over and now_ns - self._since_ns > self._longest_ns:
            self.failure = "its time-out is not proved: it does not report often enough whether it is armed"

    def add_report(self, state: DriveState, time_ns: int) -> None:
        """Add the state that the drive reports, at the arrival of the message [ns]."""
        before, self._report_ns = self._report_ns, time_ns
        if self.over or before is None:
            return
        if self._begin_ns is None or time_ns <= self._begin_ns:  # one more message, or more often than it seemed
            wait_ns = 0 if self._polled else -self._least_ns % max(time_ns - before, 1)
            self._begin_ns = time_ns + wait_ns
            return
        self.seen_ns = time_ns - self._fed_ns
        if state is not DriveState.ACTIVE:
            self.done = self.seen_ns <= self._most_ns
            self.unresolved = not self.done
        elif self.seen_ns >= self._most_ns:
            self.failure = (
                f"its time-out did not act: {self.seen_ns * 1e-9:.3f} s after the last command it was still armed, "
                f"node.watchdog is {self._watchdog:g} s; switch it on in the drive"
            )
