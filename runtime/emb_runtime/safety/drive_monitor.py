"""Monitor of the drive: the current that it reports against the last ones commanded.

A current loop needs time, and a command may act some periods later, so a reported current is not compared with one
command: it must lie among the last few that the node reports as obeyed, as opendbc compares a torque with the last
six measured. Where the node brakes by itself, its current must lie within the bench's limit. A leaky count forgives a
single disturbance.
"""

from __future__ import annotations

import math
from typing import Final

from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, LeakyCount

COMMANDS: Final = 6  # Obeyed commands between which a reported current may lie
TOLERATED: Final = 5
"""Reports out of place in a row that are too many; see :class:`~emb_runtime.can.e2e.LeakyCount` for a share."""


class DriveCheck(LeakyCount):
    """Judges what the node reports, and counts the reports out of place.

    Args:
        tolerance: by how much a report may lie outside [A].
        limit: largest current with which the node brakes by itself [A].
    """

    def __init__(self, tolerance: float, limit: float) -> None:
        super().__init__(TOLERATED)
        self._tolerance = tolerance
        self._limit = limit
        self._sent = [math.nan] * COUNTER_MODULUS
        self._recent = [0.0] * COMMANDS  # the last commands obeyed, in no order; one may be there more than once
        self._oldest = 0  # place of the oldest of them

    def sent(self, counter: int, current: float) -> None:
        """Remember a command: its alive counter, 0..14, and its current [A]."""
        self._sent[counter] = current

    def current_problem(self, command_counter: int, applied: float) -> str:
        """Fault of the drive, once too many samples reported what is out of place; "" otherwise.

        Args:
            command_counter: counter of the command that the node obeyed in the period before, 15 if none.
            applied: the current that it measured [A].
        """
        if command_counter == NO_COUNTER:
            return self._judge_braking(applied)
        commanded = self._sent[command_counter]
        was_sent = math.isfinite(commanded)
        if was_sent:
            self._recent[self._oldest] = commanded
            self._oldest = (self._oldest + 1) % COMMANDS
        low, high = min(self._recent), max(self._recent)
        if was_sent and low - self._tolerance <= applied <= high + self._tolerance:  # this way round, NaN is outside
            self.forgive()
            return ""
        self.reject()
        if not self.exceeded:
            return ""
        if not was_sent:
            return f"it reports that it obeyed command {command_counter}, which was never sent"
        return f"it reports {applied:.2f} A, commanded were {low:.2f} to {high:.2f} A"

    def _judge_braking(self, applied: float) -> str:
        """Take a report of the node's braking: the next command's current begins there."""
        possible = abs(applied) <= self._limit + self._tolerance  # this way round, NaN is not
        self._recent = [applied if possible else 0.0] * COMMANDS
        if possible:
            return ""
        self.reject()
        return f"it reports {applied:.2f} A of its braking, at most {self._limit:g} A" if self.exceeded else ""
