"""Clocks: the computer's, and the unwrapped one of a device."""

from __future__ import annotations

import time
from typing import Final, Protocol

_UNDISTURBED_NS: Final = 2_000  # Time that reading both clocks takes, if nothing comes between [ns]
_NEVER: Final = 1 << 62


class Clock(Protocol):
    """Source of time."""

    def now_ns(self) -> int:
        """Monotonic time [ns]."""
        ...

    def wall_offset_ns(self) -> int:
        """Offset from monotonic to Unix time [ns]."""
        ...

    def sleep_until(self, time_ns: int) -> int:
        """Wait until a monotonic time [ns]; gives the time that it is then, which may be later."""
        ...


class MonotonicClock:
    """The computer's monotonic clock."""

    now_ns = staticmethod(time.monotonic_ns)
    """Monotonic time [ns]; the function itself, because every cycle calls it several times."""

    def wall_offset_ns(self) -> int:
        """Offset from monotonic to Unix time [ns], as measured now.

        The wall clock is read between two readings of the monotonic one, again if that took long. Of three tries
        the shortest counts: an interrupted one does not.
        """
        tightest, offset = _NEVER, 0
        for _ in range(3):
            before = time.monotonic_ns()
            wall = time.time_ns()
            after = time.monotonic_ns()
            if after - before < tightest:
                tightest, offset = after - before, wall - (before + after) // 2
            if tightest < _UNDISTURBED_NS:
                break
        return offset

    def sleep_until(self, time_ns: int) -> int:
        """Wait until a monotonic time [ns]; gives the time that it is then, which may be later."""
        while (now_ns := time.monotonic_ns()) < time_ns:
            time.sleep((time_ns - now_ns) * 1e-9)
        return now_ns


class TimeUnwrapper:
    """Unwraps a device time by the arrival of each stamp.

    The arrival gives the device's clock to well within half a wrap; the stamp gives it exactly.
    Silences of any length are bridged as long as the two clocks drift less than half a wrap apart meanwhile.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._device_ns: int | None = None
        self._arrival_ns = 0

    def unwrap(self, stamp_ns: int, arrival_ns: int) -> int:
        """Unwrapped device time [ns] of a stamp, 0..period, that arrived at a monotonic time [ns]."""
        if self._device_ns is None:
            device_ns = stamp_ns
        else:
            expected_ns = self._device_ns + (arrival_ns - self._arrival_ns)
            half_ns = self._period_ns // 2
            device_ns = expected_ns + (stamp_ns - expected_ns + half_ns) % self._period_ns - half_ns
        self._device_ns, self._arrival_ns = device_ns, arrival_ns
        return device_ns
