"""Proof that a drive lets go by itself: at 0 A it is told nothing, and what it then says of its state decides.

Drives say their state seldom (ODrive: each 100 ms). The silence begins so that the next of these messages comes just
after the time-out: a longer time-out than the mapping file's then shows too.
"""

from __future__ import annotations

from emb_runtime.drives.mapping import State
from emb_runtime.drives.wire import DriveState

MARGIN_PERIODS = 2
"""Periods by which a drive may let go late: it looks at its clock, and its message may wait for the bus."""
TIMEOUTS = 4  # Times ``state.timeout`` within which the drive must have said often enough what it is doing


class TimeOutProof:
    """One silence.

    Args:
        watchdog: the drive's time-out, as the mapping file has it [s].
        state: the signal that says what it is doing.
        period_ns: sample time [ns].
        polled: it speaks only when it is spoken to: after the silence it is asked.
    """

    def __init__(self, watchdog: float, state: State, period_ns: int, *, polled: bool) -> None:
        self._watchdog = watchdog
        self._period_ns = period_ns
        self._length_ns = round(watchdog * 1e9) + MARGIN_PERIODS * period_ns
        self._longest_ns = self._length_ns + round(TIMEOUTS * state.timeout * 1e9)
        self._polled = polled
        self._since_ns: int | None = None
        self._said_ns: int | None = None
        self._begin_ns: int | None = None
        self.done = False
        """The drive has let go."""
        self.failure = ""
        """Reason why it is not proved; empty if there is none so far."""
        self.seen_ns = 0
        """Time from the last command to the message that showed it [ns]."""

    def silent(self, now_ns: int) -> bool:
        """Returns True if nothing may leave now."""
        if self.done or self.failure or self._begin_ns is None:
            return False
        return now_ns >= self._begin_ns and not (self._polled and now_ns >= self._begin_ns + self._length_ns)

    def tick(self, now_ns: int) -> None:
        """Give up if the drive does not say what it is doing."""
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        if not self.done and now_ns - self._since_ns > self._longest_ns:
            self.failure = (
                self.failure or "its time-out is not proved: it does not say often enough whether it is armed"
            )

    def take(self, said: DriveState, time_ns: int) -> None:
        """Take what the drive says of its state, at the arrival of the message [ns]."""
        before, self._said_ns = self._said_ns, time_ns
        if self.done or self.failure or before is None:
            return
        if self._begin_ns is None:
            wait_ns = time_ns - before - self._length_ns - self._period_ns
            self._begin_ns = time_ns + max(0, wait_ns)
        elif time_ns >= self._begin_ns + self._length_ns:
            self.seen_ns = time_ns - self._begin_ns
            self.done = said is not DriveState.ACTIVE
            if not self.done:
                self.failure = (
                    f"its time-out did not act: {self.seen_ns * 1e-9:.3f} s after the last command it was still armed, "
                    f"node.watchdog says {self._watchdog:g} s; switch it on in the drive"
                )
