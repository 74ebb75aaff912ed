"""The first process inside the User-Mode Linux kernel: makes the interfaces, runs the command, switches the kernel off.

Runs without site-packages. Mounts and modules go through libc, because a minimal Debian has neither insmod nor halt.
What it prints is kernel console text, never the command's output.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import traceback
from pathlib import Path
from types import FrameType
from typing import Any

INTERFACE, SECOND_INTERFACE = "vcan0", "vcan1"
IP = "/sbin/ip"  # Of the package iproute2
#: In the order of their dependencies, each with its parameters.
_MODULES = (
    ("can", ""), ("can-raw", ""), ("can-bcm", ""), ("can-gw", ""), ("can-dev", ""),
    # Without echo a vcan hands frames to its listeners before its queue, and no queue could delay or lose them.
    ("vcan", "echo=1"),
    ("vxcan", ""), ("sch_netem", ""),
)  # fmt: skip
#: Which signals the host hands in, each as a file named like this in the state directory.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SIGNAL_FILE = "signal-{:d}"
#: What it is to do: read by it before all else.
JOB_FILE = "job.json"
#: First line of the status file once the command runs; the second is its exit status.
RUNNING = b"running\n"

MODULE_ROOTS = ("/usr/lib/uml/modules", "/lib/modules")

_MOUNTS = (
    ("proc", "/proc"),
    ("sysfs", "/sys"),
    ("tmpfs", "/run"),
    ("tmpfs", "/dev/shm"),
    ("devpts", "/dev/pts"),
)
_SYS_INIT_MODULE = 175  # x86-64, the only architecture of this kernel
_POWER_OFF, _CAD_OFF = 0x4321FEDC, 0
_libc = ctypes.CDLL(None, use_errno=True)


def _checked(result: int, what: str) -> None:
    if result != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), what)


def _mount() -> None:
    for directory in ("/dev/shm", "/dev/pts"):
        Path(directory).mkdir(exist_ok=True)
    for kind, where in _MOUNTS:
        _checked(_libc.mount(kind.encode(), where.encode(), kind.encode(), 0, None), where)
    for name, target in (("fd", ""), ("stdin", "/0"), ("stdout", "/1"), ("stderr", "/2")):
        with contextlib.suppress(FileExistsError):
            Path("/dev", name).symlink_to(f"/proc/self/fd{target}")


def _load_modules() -> None:
    """Load the modules that are there; a missing one shows later."""
    release = os.uname().release
    for root in MODULE_ROOTS:
        found = {path.stem: path for path in Path(root, release).rglob("*.ko")}
        for name, parameters in _MODULES:
            if name in found:
                image = found[name].read_bytes()
                result = _libc.syscall(_SYS_INIT_MODULE, image, ctypes.c_ulong(len(image)), parameters.encode())
                _checked(result, str(found[name]))
        if found:
            return
    sys.stderr.write(f"emb-hil: no modules for kernel {release} under {' or '.join(MODULE_ROOTS)}\n")


def _make_interfaces() -> None:
    for name in (INTERFACE, SECOND_INTERFACE):
        _ip("add", "dev", name, "type", "vcan")
    for name in ("lo", INTERFACE, SECOND_INTERFACE):
        _ip("set", name, "up")


def _ip(*words: str) -> None:
    subprocess.run([IP, "link", *words], check=True)


def _raise_soft_interrupts() -> None:
    """Let the kernel thread that delivers received frames run before every real-time process.

    Under load it takes that work over from the sender's system call, at ordinary priority: on this one processor
    frames would then wait until all real-time processes sleep.
    """
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with contextlib.suppress(OSError):  # a process that has ended meanwhile
            if comm.read_text().startswith("ksoftirqd/"):
                os.sched_setscheduler(int(comm.parent.name), os.SCHED_FIFO, os.sched_param(99))


def _start(job: dict[str, Any], out: int, err: int) -> subprocess.Popen[bytes]:
    identity: dict[str, Any] = {}
    if job["uid"] != 0:
        identity = {"user": job["uid"], "group": job["gid"], "extra_groups": job["groups"]}
    return subprocess.Popen(
        job["command"],
        cwd=job["cwd"],
        env=job["env"],
        umask=job["umask"],
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=err,
        start_new_session=True,
        **identity,
    )


def not_started(name: str, error: OSError) -> tuple[str, int]:
    """The line to print and the exit status, as a shell's, where the command ``name`` could not be started."""
    return f"emb-hil: {name}: {error.strerror}\n", 126 if isinstance(error, PermissionError) else 127


def _run(job: dict[str, Any], state: int, out: int, err: int, status: int) -> int:
    """Start the command, hand it the host's signals, reap whatever is orphaned here; its exit status as a shell's."""
    try:
        child = _start(job, out, err)
    except OSError as error:
        message, code = not_started(job["command"][0], error)
        os.write(err, message.encode())
        return code

    def forward(_number: int, _frame: FrameType | None) -> None:
        for number in SIGNALS:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                os.unlink(SIGNAL_FILE.format(number), dir_fd=state)
                os.killpg(child.pid, number)

    signal.signal(signal.SIGINT, forward)  # Ctrl-Alt-Del, by which the host makes this process look
    os.write(status, RUNNING)
    forward(signal.SIGINT, None)  # a signal that came during the start
    while True:
        pid, result = os.wait()
        if pid == child.pid:
            code = os.waitstatus_to_exitcode(result)
            return code if code >= 0 else 128 - code


def main(directory: str) -> None:
    """Do the job in the state ``directory``, then switch the kernel off: process 1 never returns."""
    try:
        _libc.reboot(_CAD_OFF)
        # Opened before anything is mounted over the directory that they may be in.
        job = json.loads(Path(directory, JOB_FILE).read_text())
        state = os.open(directory, os.O_RDONLY)
        out = os.open("stdout", os.O_WRONLY | os.O_APPEND, dir_fd=state)
        err = out if job["merged"] else os.open("stderr", os.O_WRONLY | os.O_APPEND, dir_fd=state)
        status = os.open("status", os.O_WRONLY | os.O_APPEND, dir_fd=state)
        socket.sethostname(job["host"])
        _mount()
        _load_modules()
        _raise_soft_interrupts()
        _make_interfaces()
        os.write(status, f"{_run(job, state, out, err, status)}\n".encode())
    except BaseException:
        traceback.print_exc()  # to the console, whose last lines the host shows
    finally:
        sys.stderr.flush()
        os.sync()
        _libc.reboot(_POWER_OFF)


if __name__ == "__main__":
    main(sys.argv[1])
