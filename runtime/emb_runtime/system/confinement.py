"""Confinement of a process that handles what nobody vouches for: little memory and processor time, no file written.

It keeps the rights of its user: the limits are against files that take too much, not against ones that take over the
process. They hold for each process: a copy that it makes of itself has them anew.
"""

from __future__ import annotations

import ctypes
import math
import os
import signal
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def end_with(parent: int) -> None:
    """End this process when the one that started it ends.

    Args:
        parent: its process id.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, *map(ctypes.c_ulong, (signal.SIGKILL, 0, 0, 0)))
    if os.getppid() != parent:  # it was gone before
        os._exit(1)


def confine(memory: int, seconds: float) -> None:
    """Confine this process for good.

    Args:
        memory: bytes that it may take besides those that it has.
        seconds: processor time that it may take besides what it has taken; rounded up to whole seconds.
    """
    import resource  # Linux only, as all of this

    def limit(which: int, value: int) -> None:
        """Set a limit, unless there is a narrower one."""
        _, most = resource.getrlimit(which)
        value = value if most == resource.RLIM_INFINITY else min(value, most)
        resource.setrlimit(which, (value, value))

    used = resource.getrusage(resource.RUSAGE_SELF)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit(resource.RLIMIT_AS, pages * resource.getpagesize() + memory)
    limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + seconds))
    limit(resource.RLIMIT_FSIZE, 0)
    limit(resource.RLIMIT_CORE, 0)
