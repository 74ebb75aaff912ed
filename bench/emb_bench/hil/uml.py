"""The User-Mode Linux kernel as an ordinary child process whose root is the caller's file system.

A private state directory carries what passes between the two: the job in, the command's output as files that grow
(pipes do not pass through hostfs), its exit status, signals, and the kernel's own console text.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from emb_bench.hil.guest import RUNNING, SIGNAL_FILE
from emb_bench.hil.leash import Leash
from emb_bench.hil.shim import ShimUse, shim_library
from emb_runtime.errors import BusError

KERNEL = "linux.uml"
PACKAGE = "user-mode-linux"
_BOOT_LIMIT_S = 60.0
_CONSOLE_LINES = 12
_MCONSOLE_MAGIC, _MCONSOLE_VERSION = 0xCAFEBABE, 2

_INIT = """#!/bin/sh
export PYTHONPATH={path} PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH={libraries}
exec {python} -S -s -m emb_bench.hil.guest {state}
"""


def kernel() -> str:
    """Path of the kernel's program.

    Raises:
        BusError: it is not installed; says what to install.
    """
    found = shutil.which(KERNEL)
    if found is None:
        raise BusError(
            f"no User-Mode Linux kernel ({KERNEL}) on PATH: "
            f"`sudo apt-get install {PACKAGE}`, or as root `emb-hil --setup`"
        )
    return found


def memory_directory(bytes_needed: int) -> Path:
    """Where the kernel keeps its memory as a file: must have the room and allow PROT_EXEC.

    /dev/shm of a container is often 64 MB and mounted noexec; then the directory for temporary files does, slower.

    Raises:
        BusError: neither is fit.
    """
    refused = []
    for directory in (Path("/dev/shm"), Path(tempfile.gettempdir())):
        try:
            status = os.statvfs(directory)
        except OSError as error:
            refused.append(f"{directory}: {error.strerror}")
            continue
        room = status.f_bavail * status.f_frsize
        if status.f_flag & os.ST_NOEXEC:
            refused.append(f"{directory}: mounted noexec")
        elif room < bytes_needed:
            refused.append(f"{directory}: {room >> 20} MB free of {bytes_needed >> 20} MB needed")
        else:
            return directory
    raise BusError(f"no place for the kernel's memory ({'; '.join(refused)}): free some, or lower --memory")


class UmlCommand:
    """The command inside the kernel; a :class:`~emb_bench.hil.supervise.Child`."""

    def __init__(self, command: list[str], memory_mb: int, shim: ShimUse, state: Path) -> None:
        program = kernel()
        self._state = state
        self._merged = os.path.sameopenfile(1, 2)
        self._write_job(command)
        self._streams = [(1, (state / "stdout").open("rb"))]
        if not self._merged:
            self._streams.append((2, (state / "stderr").open("rb")))
        environment = {"PATH": os.defpath, "HOME": str(state), "TMPDIR": str(memory_directory(memory_mb << 20))}
        preload = shim_library(shim)
        if preload is not None:
            environment["LD_PRELOAD"] = str(preload)
        with (state / "console").open("wb") as console:
            self._process = subprocess.Popen(
                [program, "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"init={state}/init",
                 f"mem={memory_mb}M", "con=null", "con0=null,fd:1", "ssl=null", f"uml_dir={state}", "umid=uml"],
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=console,
                env=environment,
                start_new_session=True,
            )  # fmt: skip
        self._leash = Leash(self._process.pid, str(state))
        self._boot_until = time.monotonic() + _BOOT_LIMIT_S

    def _write_job(self, command: list[str]) -> None:
        umask = os.umask(0o077)
        os.umask(umask)
        job = {
            "command": command,
            "cwd": str(Path.cwd()),
            "env": dict(os.environ),
            "umask": umask,
            "host": socket.gethostname(),
            "uid": os.getuid(),
            "gid": os.getgid(),
            "groups": os.getgroups(),
            "merged": self._merged,
        }
        (self._state / "job.json").write_text(json.dumps(job))
        for name in ("stdout", "stderr", "status"):
            (self._state / name).touch()
        words = {
            "path": str(Path(__file__).parents[2]),
            "libraries": os.environ.get("LD_LIBRARY_PATH", ""),  # some builds of Python do not start without
            "python": sys.executable,
            "state": str(self._state),
        }
        init = self._state / "init"
        init.write_text(_INIT.format_map({name: shlex.quote(word) for name, word in words.items()}))
        init.chmod(0o700)

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
                raise BusError(self._obituary(f"the kernel did not come up within {_BOOT_LIMIT_S:.0f} s"))
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
        """Hand the command a signal; while the kernel still boots, as soon as it runs."""
        (self._state / SIGNAL_FILE.format(number)).touch()
        if self._status().startswith(RUNNING):  # before that the guest looks by itself when it starts the command
            self._press_ctrl_alt_del()

    def _press_ctrl_alt_del(self) -> None:
        """Through the kernel's management socket; inside, process 1 gets a SIGINT."""
        text = b"cad"
        message = struct.pack("=III", _MCONSOLE_MAGIC, _MCONSOLE_VERSION, len(text)) + text.ljust(512, b"\0")
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.bind("")  # the kernel answers, so the socket needs an address
            sock.sendto(message, str(self._state / "uml" / "mconsole"))

    def kill(self) -> None:
        """End the kernel with all its processes, and with them the command."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._leash.release()
        with contextlib.suppress(BrokenPipeError):
            self._pump()
        for _, stream in self._streams:
            stream.close()


@contextlib.contextmanager
def state_directory() -> Iterator[Path]:
    """A private directory (it holds the environment), gone afterwards."""
    path = Path(tempfile.mkdtemp(prefix="emb-hil-"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
