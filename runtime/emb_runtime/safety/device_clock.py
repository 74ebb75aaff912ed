"""Monitor of the node's clock: device time against this computer's, in both directions, accumulated.

A sample arrives late but never early, so the offset between its arrival and its device time is the offset of the two
clocks plus a latency that is not negative. The least offset of the pairs before arming is the reference. From then on

- no offset may fall below the reference by more than the allowance: the device's clock would have gone on by more
  than this computer's, as after a jump forward or with a clock that is fast;
- the least offset of no :data:`WINDOW` samples may exceed it by more than the allowance: the device's clock would have
  gone on by less. A latency of that size in every sample of a window is no excuse: nothing could be answered in time.

The reference follows the least offset of each window by at most :data:`QUARTZ`, which is more than two quartzes differ
by, so that what is beyond adds up: a clock that is off by a share r is noticed when (r - QUARTZ) t reaches the
allowance, one that is slow up to two windows later. All that a device time can hide is therefore the allowance, once.

False alarm only if every arming sample was delayed beyond the allowance and a later one was not, or each one of a
window was. Times are integers [ns]; no clock is read here.
"""

from __future__ import annotations

from typing import Final

from emb_runtime.can.e2e import LeakyCount

WINDOW: Final = 20  # Samples of which one at least comes without a noticeable latency
QUARTZ: Final = 500  # Difference of two honest clocks, at most: each is off by 200 [ppm], with some to spare
ALLOWED_PERIODS: Final = 2  # Sampling periods by which the clocks may seem to differ: an older sample is not answered
LEAST_ALLOWANCE_NS: Final = 2_000_000
"""The same, at least: a step of the wall clock may make a stamp of the kernel look up to a period too old [ns]."""
OFF_GRID: Final = 5  # Samples off the sampling grid, by a leaky count, that are too many


class DeviceClock:
    """Checks the device time of each sample of a node with this sampling period."""

    _reference_ns: int
    _device_ns: int  # Of the last sample

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.allowance_ns = max(ALLOWED_PERIODS * period_ns, LEAST_ALLOWANCE_NS)
        """Difference of the clocks beyond which the node's is wrong [ns]."""
        self._step_ns = WINDOW * period_ns * QUARTZ // 1_000_000  # by which the reference follows a window, at most
        self._first_ns: int | None = None  # offset of the first pair of the reference
        self._window: list[int] = []  # offsets in the present one
        self._off_grid = LeakyCount(OFF_GRID)
        self.problem = ""  # Fault of the clock; "" as long as there is none. Never taken back.

    def restart(self) -> None:
        """Forget the pairs before arming: the next one begins the reference."""
        self._first_ns = None

    def learn(self, device_ns: int, receive_ns: int) -> bool:
        """Take a pair before arming: its device time and its arrival, monotonic [ns].

        Returns:
            False if it arrived earlier than the first one by more than the allowance: the first ones had piled up, or
            the clock is fast. The pair is then the first of a new reference.
        """
        offset_ns = receive_ns - device_ns
        steady = self._first_ns is None or offset_ns >= self._first_ns - self.allowance_ns
        if self._first_ns is None or not steady:
            self._first_ns = self._reference_ns = offset_ns
        self._reference_ns = min(self._reference_ns, offset_ns)
        self._device_ns = device_ns
        return steady

    def time_problem(self, device_ns: int, receive_ns: int, seen_ns: int) -> str:
        """Judge a sample after arming; gives :attr:`problem`.

        Args:
            device_ns: its device time [ns].
            receive_ns: its arrival by its stamp, which a step of the wall clock may make too early [ns].
            seen_ns: when it was in hand, monotonic, read after it had arrived [ns].
        """
        if not self.problem:
            self._judge_grid(device_ns)
            self._judge_slow(receive_ns - device_ns)
            self._judge_fast(seen_ns - device_ns)
        return self.problem

    def _judge_grid(self, device_ns: int) -> None:
        """Hold the time since the last sample against multiples of the sampling period."""
        elapsed_ns, self._device_ns = device_ns - self._device_ns, device_ns
        quarter_ns = self._period_ns // 4
        if elapsed_ns <= 0:
            self.problem = f"it went from one sample to the next by {elapsed_ns / 1e6:.3f} ms"
        elif elapsed_ns > quarter_ns and (elapsed_ns + quarter_ns) % self._period_ns <= 2 * quarter_ns:
            self._off_grid.forgive()
        else:
            self._off_grid.reject()
        if self._off_grid.exceeded:
            apart = f"its samples are {elapsed_ns / 1e6:.3f} ms apart"
            self.problem = f"{apart}, the bench's period is {self._period_ns / 1e6:g} ms"

    def _judge_slow(self, offset_ns: int) -> None:
        """Hold the least offset of a window against the reference, which then follows it."""
        self._window.append(offset_ns)
        if len(self._window) < WINDOW:
            return
        behind_ns = min(self._window) - self._reference_ns
        self._window.clear()
        if behind_ns > self.allowance_ns:
            self.problem = f"it has lost {behind_ns / 1e6:.3f} ms on this computer's"
        self._reference_ns += min(max(behind_ns, -self._step_ns), self._step_ns)

    def _judge_fast(self, offset_ns: int) -> None:
        ahead_ns = self._reference_ns - offset_ns
        if ahead_ns > self.allowance_ns:
            self.problem = f"it has gained {ahead_ns / 1e6:.3f} ms on this computer's"
