"""Runs a command as on another operating system: ``python -m tests.other_system darwin|win32 COMMAND [ARGUMENT]...``.

What only Linux has, or on Windows what only POSIX has, is taken away before anything of ours is imported: names of
modules, whole modules, the C library's symbols, ``pass_fds``. Other libraries are imported first, for they look at the
system that they really run on.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import importlib
import os
import pkgutil
import select
import signal
import socket
import subprocess
import sys
import time
from types import ModuleType, SimpleNamespace
from typing import Any, NoReturn

LIBRARIES = """
    asyncio can cantools concurrent.futures.process gymnasium jinja2
    logging.handlers matplotlib.backends.backend_agg matplotlib.figure mcap.writer multiprocessing.connection
    multiprocessing.popen_spawn_posix multiprocessing.queues multiprocessing.resource_tracker
    multiprocessing.synchronize numba numpy onnx onnxruntime pandas
    pyarrow.parquet safetensors.torch scipy.optimize scipy.stats tempfile torch torch._dynamo torch.onnx
"""
NOT_ON: dict[str, dict[ModuleType, str]] = {
    "darwin": {
        os: """
            MFD_CLOEXEC SCHED_FIFO SCHED_OTHER SCHED_RESET_ON_FORK eventfd memfd_create pidfd_open posix_fadvise
            sched_getaffinity sched_param sched_setaffinity sched_setscheduler
        """,
        socket: """
            AF_CAN CAN_EFF_FLAG CAN_EFF_MASK CAN_ERR_FLAG CAN_ERR_MASK CAN_RAW CAN_RAW_FILTER CAN_RAW_RECV_OWN_MSGS
            CAN_RTR_FLAG CAN_SFF_MASK MSG_CONFIRM PF_CAN SOL_CAN_RAW
        """,
        select: "epoll",
        signal: "sigtimedwait sigwaitinfo",
        time: "CLOCK_BOOTTIME CLOCK_TAI",
    },
    "win32": {
        os: """
            O_CLOEXEC O_NOCTTY O_NONBLOCK fchmod fchown fork forkpty getegid geteuid getgid getloadavg getsid getuid
            killpg nice openpty pread pwrite register_at_fork setsid uname
        """,
        socket: "CMSG_LEN CMSG_SPACE MSG_DONTWAIT",
        select: "poll",
        signal: """
            ITIMER_REAL SIGALRM SIGHUP SIGPIPE SIG_BLOCK SIG_SETMASK SIG_UNBLOCK alarm getitimer pause pthread_kill
            pthread_sigmask setitimer sigwait
        """,
        time: "CLOCK_MONOTONIC CLOCK_REALTIME clock_gettime",
    },
}
"""Names that a module lacks; Windows lacks those of both."""
MODULES = {"darwin": ("spwd",), "win32": ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")}


def become(system: str) -> None:
    """Take away what a system does not have: ``darwin`` or ``win32``, which has less than that."""
    os.environ["EMB_CORE"] = "python"  # the compiled core is for Linux
    for name in LIBRARIES.split():
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for taken in ("darwin", system) if system != "darwin" else ("darwin",):
        for module, names in NOT_ON[taken].items():
            for name in names.split():
                if hasattr(module, name):
                    delattr(module, name)
        sys.modules.update(dict.fromkeys(MODULES[taken]))  # type: ignore[arg-type]
    sys.platform = system
    libraries = ctypes.CDLL

    def library(name: str | None, *arguments: Any, **keywords: Any) -> ctypes.CDLL:
        if name is None:
            raise OSError("there is no C library of Linux here")
        return libraries(name, *arguments, **keywords)

    ctypes.CDLL = library  # type: ignore[assignment, misc]
    if system == "win32":
        lock, alone = fcntl.flock, fcntl.LOCK_EX | fcntl.LOCK_NB
        standing_in: Any = ModuleType("msvcrt")
        standing_in.LK_NBLCK, standing_in.locking = 2, lambda file, _mode, _count: lock(file, alone)
        sys.modules["msvcrt"] = standing_in
        tracker = sys.modules["multiprocessing.resource_tracker"]
        vars(tracker)["_HAVE_SIGMASK"] = False
        semaphores = sys.modules["multiprocessing.synchronize"]  # a child of this system takes a name, not a handle
        vars(semaphores)["sys"] = SimpleNamespace(platform="linux")

    class Popen(subprocess.Popen[bytes]):
        def __init__(self, command: list[str], pass_fds: Any = (), **keywords: Any) -> None:
            raise AssertionError(f"a process is started, with the descriptors {pass_fds}")

    subprocess.Popen = Popen  # type: ignore[assignment, misc]


def modules(*packages: str) -> list[str]:
    """Names of all modules of packages, but those that are run by a process of their own, on Linux, or by emb-hil."""
    found = []
    for package in packages:
        root = importlib.import_module(package)
        found += [each.name for each in pkgutil.walk_packages(root.__path__, f"{package}.", onerror=print)]
    return [name for name in found if not name.endswith("__main__") and ".hil" not in name and ".native" not in name]


def main() -> NoReturn:
    """Run a command, or import everything."""
    system, command, *arguments = sys.argv[1:]
    become(system)
    if command == "import":
        for name in modules("emb_runtime", "emb_bench", "emb_train", "emb_export"):
            importlib.import_module(name)
        sys.exit(0)
    from importlib.metadata import entry_points

    (entry,) = entry_points(group="console_scripts", name=command)
    sys.argv = [command, *arguments]
    sys.exit(entry.load()())


if __name__ == "__main__":
    main()
