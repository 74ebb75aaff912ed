"""A command inside a User-Mode Linux kernel: an ordinary child process with the caller's files as its root.

A private state directory carries what passes between the two: the job in, the command's output as files that grow
(pipes do not pass through the kernel's file system), its exit status, signals, and the kernel's console text.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emb_bench.hil.guest import JOB_FILE, RUNNING, SIGNAL_FILE
from emb_bench.hil.supervise import ParentDeathWatch
from emb_runtime.errors import BusError

_CONSOLE_LINES = 40
_BOOT_LIMIT = 60.0  # Time until the command must run [s]
_GRACE = 10.0  # Time from a signal until the command is killed [s]
_INIT = """#!/bin/sh
export PYTHONPATH={path} PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH={libraries}
exec {python} -S -s -m emb_bench.hil.guest {state}
"""


@dataclass(frozen=True)
class Kernel:
    """Description of a kernel: its program and the way to reach it."""

    arguments: Sequence[str]  # of the program that it runs in
    environment: Mapping[str, str]  # of that program
    extra_env: Mapping[str, str]  # added to the environment of the command
    console_marker: str  # text that its console must have before the command may run; empty for none
    send_signal: Callable[[], None]  # sends its first process a SIGINT, which makes it look for signals


@contextlib.contextmanager
def state_directory() -> Iterator[Path]:
    """A private directory (it holds the environment), gone afterwards."""
    path = Path(tempfile.mkdtemp(prefix="emb-hil-"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


class KernelCommand:
    """The command inside the kernel; a :class:`~emb_bench.hil.supervise.Child`."""

    def __init__(self, command: list[str], kernel: Kernel, state: Path, as_root: bool) -> None:
        self._kernel = kernel
        self._state = state
        self._merged = os.path.sameopenfile(1, 2)
        self._write_job(command, as_root)
        self._streams = [(1, (state / "stdout").open("rb"))]
        if not self._merged:
            self._streams.append((2, (state / "stderr").open("rb")))
        with (state / "console").open("ab") as console:
            self._process = subprocess.Popen(
                kernel.arguments,
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=console,
                env=kernel.environment,
                start_new_session=True,
            )
        _put_first(self._process.pid)
        self._watch = ParentDeathWatch(self._process.pid, str(state))
        self._boot_until = time.monotonic() + _BOOT_LIMIT

    def _write_job(self, command: list[str], as_root: bool) -> None:
        umask = os.umask(0o077)
        os.umask(umask)
        job: dict[str, Any] = {
            "command": command,
            "cwd": str(Path.cwd()),
            "env": dict(os.environ) | dict(self._kernel.extra_env),
            "umask": umask,
            "host": socket.gethostname(),
            "uid": 0 if as_root else os.getuid(),
            "gid": os.getgid(),
            "groups": os.getgroups(),
            "merged": self._merged,
        }
        (self._state / JOB_FILE).write_text(json.dumps(job))
        for name in ("stdout", "stderr", "status"):
            (self._state / name).touch()
        words = {
            "path": str(Path(__file__).parents[2]),
            "libraries": os.environ.get("LD_LIBRARY_PATH", ""),  # some builds of Python do not start without
            "python": sys.executable,
            "state": str(self._state),
        }
        init = init_program(self._state)
        init.write_text(_INIT.format_map({name: shlex.quote(word) for name, word in words.items()}))
        init.chmod(0o700)

    @property
    def grace(self) -> float:
        """Seconds that the command gets to end in after a signal; none while it does not run yet."""
        return _GRACE if self._status().startswith(RUNNING) else 0.0

    def _status(self) -> bytes:
        return (self._state / "status").read_bytes()

    def poll(self) -> int | None:
        """Move its output on; its exit status as a shell has it, None while it runs.

        Raises:
            BusError: the kernel did not come up, or died before the command ended; with its last console lines.
        """
        ended = self._process.poll() is not None
        self._pump()
        status = self._status()
        if not ended:
            if not status and time.monotonic() > self._boot_until:
                raise BusError(self._obituary(f"the kernel did not come up within {_BOOT_LIMIT:.0f} s"))
            if (
                self._kernel.console_marker
                and status
                and self._kernel.console_marker not in (self._state / "console").read_text(errors="replace")
            ):
                raise BusError(self._obituary(f"it did not say '{self._kernel.console_marker}'"))
            return None
        last = status.splitlines()[-1:]
        if not last or last[0] == RUNNING.strip():
            raise BusError(self._obituary("the kernel died " + ("while" if last else "before") + " the command ran"))
        return int(last[0])

    def _pump(self) -> None:
        """Copy what the command wrote since the last time, in blocks, to the caller's own descriptors."""
        for descriptor, stream in self._streams:
            while block := stream.read(65536):
                while block:
                    block = block[os.write(descriptor, block) :]

    def _obituary(self, what: str) -> str:
        lines = (self._state / "console").read_text(errors="replace").splitlines()
        return "\n".join([f"User-Mode Linux: {what}. Its last console lines:", *lines[-_CONSOLE_LINES:]])

    def signal(self, number: int) -> None:
        """Hand the command a signal."""
        (self._state / SIGNAL_FILE.format(number)).touch()
        if self._status().startswith(RUNNING):  # before that the guest looks by itself when it starts the command
            with contextlib.suppress(OSError):  # it ends at this moment
                self._kernel.send_signal()

    def kill(self) -> None:
        """End the kernel with all its processes, and with them the command."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._watch.release()
        with contextlib.suppress(BrokenPipeError):
            self._pump()
        for _, stream in self._streams:
            stream.close()


def _put_first(group: int) -> None:
    """Give a process group the processor before others, where that may be done: sched(7), nice and autogroup."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PGRP, group, -20)
        Path(f"/proc/{group}/autogroup").write_text("-20")  # sessions share first, and only then their processes


def init_program(state: Path) -> Path:
    """Path in the state directory of the first program of the caller's file system, a shell script."""
    return state / "init"
