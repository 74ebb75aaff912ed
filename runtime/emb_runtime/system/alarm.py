"""Alarm: a POSIX timer whose signal ends a blocking system call of the main thread at a monotonic time.

Waiting for a descriptor first and reading it then are two system calls after each arrival. A read that blocks is one,
but its own time-out counts in ticks of the kernel: several milliseconds. The alarm is as exact as select().

A signal that comes just before the call which it is to end is lost on it, so it rings again, some times; whoever blocks
has the coarse time-out as well.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING

_SIGEV_THREAD_ID, _TIMER_ABSTIME = 4, 1  # <asm-generic/siginfo.h>, <linux/time.h>
_SIGNAL = getattr(signal, "SIGRTMIN", 0)  # 0: this system has no such timers
AGAIN_NS = 200_000  # Time between two rings [ns]
RINGS = 50  # Rings until it is silent


class _Event(ctypes.Structure):
    """The struct sigevent of <asm-generic/siginfo.h>."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("thread", ctypes.c_int),
        ("padding", ctypes.c_byte * 44),
    )


if TYPE_CHECKING:
    _Times = ctypes.Array[ctypes.c_long]


class Alarm:
    """One timer of this process; made by :meth:`here`.

    Args:
        library: the C library, which has it.

    Raises:
        OSError: the kernel makes no timer.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        event = _Event(signal=_SIGNAL, notify=_SIGEV_THREAD_ID, thread=threading.get_native_id())
        self._timer = ctypes.c_void_p()
        if library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(self._timer)) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        self._rings = 0
        signal.signal(_SIGNAL, self._rang)
        self._settime, self._delete = library.timer_settime, library.timer_delete
        self._settime.argtypes = (ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
        # A struct itimerspec: the interval, and when it rings first.
        self._times: _Times = (ctypes.c_long * 4)(0, AGAIN_NS)
        self._address = ctypes.addressof(self._times)
        atexit.register(self.close)  # once Python has given its handlers back, the signal would end the process

    @classmethod
    def here(cls) -> Alarm | None:
        """An alarm for this thread; None where there can be none: on another system, or beside the main thread."""
        if not sys.platform.startswith("linux") or threading.current_thread() is not threading.main_thread():
            return None
        try:
            return cls(ctypes.CDLL(None, use_errno=True))
        except (OSError, AttributeError):  # AttributeError: a C library that has its timers elsewhere
            return None

    def set(self, time_ns: int) -> None:
        """Ring from a monotonic time on [ns] that is not past, instead of from the one set before; at 0 never."""
        self._rings = 0
        self._times[2], self._times[3] = divmod(time_ns, 1_000_000_000)
        self._settime(self._timer, _TIMER_ABSTIME, self._address, None)

    def close(self) -> None:
        """Give the timer back."""
        atexit.unregister(self.close)
        self._delete(self._timer)

    def _rang(self, _number: int, _frame: object) -> None:
        self._rings += 1
        if self._rings == RINGS:
            self.set(0)
