"""Real-time settings of this process: each is best effort, and the *obtained* ones are returned for the log.

The loop has one thread and no garbage collector. SCHED_FIFO limits the longest wake-up latency under load; without load
the default timer slack of 50 µs determines the median. On an idle computer most of a cycle's time is the wake-up from
sleep states, so the processors are kept awake until this process ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import struct

PRIORITY = 80  # Scheduling priority of the loop

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 29, 41
WAKE_UP_LATENCY = "/dev/cpu_dma_latency"
"""Device that limits the wake-up latency of idle states [µs] while it is open."""
_awake: int | None = None  # Its descriptor


def obtain(priority: int = PRIORITY) -> dict[str, str]:
    """Request real-time behaviour; returns what was obtained, or why not, per setting.

    Call it last before the loop: after warm-up, and after every child was started.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return {
        "garbage_collector": "frozen, off",
        "timer_slack": _set(_PR_SET_TIMERSLACK, "1 ns"),
        # The kernel merges pages to huge ones at ordinary priority; an access to one of them waits meanwhile.
        "huge_pages": _set(_PR_SET_THP_DISABLE, "none are made"),
        "idle_states": _stay_awake(),
        "memory_lock": _lock_memory(),
        "scheduler": _fifo(priority),
    }


def step_back() -> None:
    """Give this process a lower priority than the loop: ordinary scheduling, niced. Best effort."""
    for action in (lambda: os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0)), lambda: os.nice(10)):
        with contextlib.suppress(OSError):
            action()


def _stay_awake() -> str:
    """Keep all processors awake until this process ends; returns what was obtained."""
    global _awake
    try:
        if _awake is None:
            device = os.open(WAKE_UP_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
            try:
                os.write(device, struct.pack("=i", 0))
            except OSError:
                os.close(device)
                raise
            _awake = device
    except FileNotFoundError:
        return "not managed by this kernel"
    except OSError as err:
        return f"not obtained: {WAKE_UP_LATENCY}: {err.strerror}"
    return "none that takes time to leave"


def _set(option: int, obtained: str) -> str:
    """Set a switch of this process to 1: prctl(2)."""
    # Arguments of the length that the kernel reads: it refuses an unused one that is not zero.
    return _called("prctl", option, *map(ctypes.c_ulong, (1, 0, 0, 0)), obtained=obtained)


def _lock_memory() -> str:
    # With MCL_FUTURE under a low limit a later allocation would fail, in the middle of a run.
    import resource  # not on Windows

    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        return f"not obtained: the memlock limit is {soft} bytes"
    return _called("mlockall", _MCL_CURRENT | _MCL_FUTURE, obtained="current and future pages")


def _called(function: str, *arguments: object, obtained: str) -> str:
    result = getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments)
    return obtained if result == 0 else f"not obtained: {os.strerror(ctypes.get_errno())}"


def _fifo(priority: int) -> str:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as err:
        return f"not obtained: {err.strerror}"
    return f"FIFO {priority}"
