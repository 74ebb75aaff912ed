"""The User-Mode Linux kernel: an ordinary program with one processor, at native speed, in real time or slower.

Libraries may be preloaded into it: ``xstate_shim.c`` lets it run on a processor with AMX (Debian's, of Linux 6.1, keeps
2696 bytes of a thread's processor state, and AMX needs more), ``slow_shim.c`` slows its clock down.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import math
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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import IO, Any

from emb_bench.hil.guest import IP, JOB_FILE, RUNNING, SIGNAL_FILE, SIGNALS
from emb_runtime.cli.preflight import SLOW_MARK
from emb_runtime.errors import BusError
from emb_runtime.system.terminal import one_line

PROGRAM = "linux.uml"
PACKAGE = "user-mode-linux"
_MCONSOLE_MAGIC, _MCONSOLE_VERSION = 0xCAFEBABE, 2
_COMPILER_PACKAGES = "gcc libc6-dev"
_UBUNTU = (
    f"Ubuntu has no {PACKAGE}, but kernels with vcan: `sudo apt-get install linux-modules-extra-$(uname -r)`, "
    "`sudo ip link add dev vcan0 type vcan`, `sudo ip link set vcan0 up`"
)
SLOW_TOLD = "time runs slowly"  # Line that ``slow_shim.c`` prints on the kernel's console when it begins
XSTATE, SLOW = (Path(__file__).with_name(name) for name in ("xstate_shim.c", "slow_shim.c"))


def host_has_amx(cpuinfo: str) -> bool:
    """Returns True if the text of /proc/cpuinfo names a processor with AMX tiles."""
    return "amx_tile" in cpuinfo.split()


def cache_directory() -> Path:
    """The user's cache directory of this tool."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "emb-excite"


def compiled(source: Path) -> Path:
    """Path of the library made from one of the sources. Compiled once per source text, into the cache."""
    library = cache_directory() / f"{source.stem}-{hashlib.sha256(source.read_bytes()).hexdigest()[:16]}.so"
    if set(str(library)) & set(" :"):  # the loader takes either for the end of a name
        raise BusError(f"no library can be loaded from {library}: set XDG_CACHE_HOME to one without blanks")
    if library.exists():
        return library
    compiler = shutil.which("cc")
    if compiler is None:
        raise BusError(
            f"the kernel is to run with a library made from {source.name}, which takes a C compiler: "
            f"`sudo apt-get install {_COMPILER_PACKAGES}`"
        )
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BusError(f"no place for the compiled {source.name} ({error}): set XDG_CACHE_HOME") from error
    with tempfile.TemporaryDirectory(dir=library.parent) as directory:
        fresh = Path(directory, library.name)
        result = subprocess.run(
            [compiler, "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-o", fresh, source],
            capture_output=True,
            text=True,
            check=False,
        )
        if result.returncode != 0:
            raise BusError(f"{source} did not compile: {result.stderr.strip()}")
        fresh.replace(library)  # at once, so that two runs at a time never see half a library
    return library


@contextmanager
def own_processor() -> Iterator[int | None]:
    """Pin this process, and so the kernel, to a processor that no other kernel of this user has.

    The kernel has one processor and is several processes of the host. Spread over processors, they wake each other
    across them: the latency of a frame is then twice as long at the median, and different each time.

    Yields:
        The processor; None where all are taken, and nothing is pinned.
    """
    allowed = os.sched_getaffinity(0)
    for processor in sorted(allowed, reverse=True):  # interrupts come to the first ones
        if (lock := _lock_of(processor)) is not None:
            with lock:
                os.sched_setaffinity(0, {processor})
                try:
                    yield processor
                finally:
                    os.sched_setaffinity(0, allowed)
            return
    yield None


def _lock_of(processor: int) -> IO[str] | None:
    """Lock on a processor, held while the file is open; None where another kernel has it, or nothing can be locked."""
    try:
        cache_directory().mkdir(parents=True, exist_ok=True)
        lock = (cache_directory() / f"processor-{processor}.lock").open("w")
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        return None
    return lock


def _program() -> str:
    found = shutil.which(PROGRAM)
    if found is None:
        raise BusError(f"no User-Mode Linux kernel ({PROGRAM}) on PATH: `sudo apt-get install {PACKAGE}`. {_UBUNTU}")
    if not Path(IP).exists():
        raise BusError(f"no {IP}, which makes the interfaces in the kernel: `sudo apt-get install iproute2`")
    return found


def memory_directory(bytes_needed: int) -> Path:
    """Returns the directory for the kernel's memory file: it must have the room and allow PROT_EXEC.

    /dev/shm of a container is often 64 MB and mounted noexec; then the directory for temporary files does, slower.
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


LONGEST_LINE = 200  # Characters of the kernel's console that a message repeats
_GRACE = 10.0  # Time from a signal until the command is killed [s]
_POLL = 0.02  # Time between two looks at it [s]
# Standard input ends without a line when emb-hil dies, by kill -9 too.
_DEATH_WATCH = 'read -r _ || { kill -s KILL -- "-$1"; rm -rf -- "$2"; }'
_INIT = """#!/bin/sh
export PYTHONPATH={path} PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH={libraries}
exec {python} -P -S -s -m emb_bench.hil.guest {state}
"""


def _environment(state: Path, memory: int, slow: int) -> dict[str, str]:
    """Environment of the kernel's program, with the libraries that it needs on this computer."""
    environment = {"PATH": os.defpath, "HOME": str(state), "TMPDIR": str(memory_directory(memory << 20))}
    libraries = [compiled(XSTATE)] if host_has_amx(Path("/proc/cpuinfo").read_text()) else []
    if slow > 1:
        libraries.append(compiled(SLOW))
        environment |= {SLOW_MARK: str(slow), "EMB_SLOW_FROM": str((state / JOB_FILE).resolve())}
    return environment | {"LD_PRELOAD": ":".join(map(str, libraries))}


@contextlib.contextmanager
def state_directory() -> Iterator[Path]:
    """A private directory (it holds the environment), gone afterwards."""
    path = Path(tempfile.mkdtemp(prefix="emb-hil-"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


class KernelCommand:
    """The command inside the kernel.

    Args:
        command: with its arguments.
        state: private directory of the kernel.
        memory: of the kernel [MiB].
        slow: seconds of this computer's for each of its own.
        as_root: the command is root in the kernel.
        boot: time until it must run [s].
    """

    def __init__(self, command: list[str], state: Path, memory: int, slow: int, as_root: bool, boot: float) -> None:
        self._state = state
        self._is_slow = slow > 1
        program, environment = _program(), _environment(state, memory, slow)
        self._merged = os.path.sameopenfile(1, 2)
        self._write_job(command, as_root, {SLOW_MARK: str(slow)})
        self._streams = [(1, (state / "stdout").open("rb"))]
        if not self._merged:
            self._streams.append((2, (state / "stderr").open("rb")))
        with (state / "console").open("ab") as console:
            self._process = subprocess.Popen(
                [program, "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"init={init_program(state)}",
                 f"mem={memory}M", "con=null", "con0=null,fd:1", "ssl=null", f"uml_dir={state}", "umid=uml"],
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=console,
                env=environment,
                start_new_session=True,
            )  # fmt: skip
        _put_first(self._process.pid)
        self._watch = subprocess.Popen(
            ["/bin/sh", "-c", _DEATH_WATCH, "emb-hil", str(self._process.pid), str(state)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._boot, self._boot_until = boot, time.monotonic() + boot

    def _write_job(self, command: list[str], as_root: bool, extra_env: Mapping[str, str]) -> None:
        umask = os.umask(0o077)
        os.umask(umask)
        job: dict[str, Any] = {
            "command": command,
            "cwd": str(Path.cwd()),
            "env": dict(os.environ) | dict(extra_env),
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
                busy = f"load {os.getloadavg()[0]:.0f} on {os.cpu_count()} processors"
                what = f"the kernel did not come up within {self._boot:g} s ({busy}; last: {self._last()})"
                raise BusError(f"{what}: try again, or wait longer with --boot S")
            if self._is_slow and status and SLOW_TOLD not in (self._state / "console").read_text(errors="replace"):
                raise BusError(self._obituary(f"it did not say '{SLOW_TOLD}'"))
            return None
        last = status.splitlines()[-1:]
        if not last or last[0] == RUNNING.strip():
            raise BusError(self._obituary(f"died {'while' if last else 'before'} the command ran"))
        return int(last[0])

    def _pump(self) -> None:
        """Copy the new output of the command, in blocks, to the caller's descriptors."""
        for descriptor, stream in self._streams:
            while block := stream.read(65536):
                while block:
                    block = block[os.write(descriptor, block) :]

    def _obituary(self, what: str) -> str:
        return f"the kernel {what}; last: {self._last('panic', 'Error')}"

    def _last(self, *telling: str) -> str:
        """The last line of the console, or the last one with one of these words, if there is such a line."""
        lines = [line.strip() for line in (self._state / "console").read_text(errors="replace").splitlines()]
        told = [line for line in lines if any(word in line for word in telling)] or [line for line in lines if line]
        return f'"{one_line(told[-1], LONGEST_LINE)}"' if told else "nothing"

    def signal(self, number: int) -> None:
        """Hand the command a signal."""
        (self._state / SIGNAL_FILE.format(number)).touch()
        if self._status().startswith(RUNNING):  # before that the guest looks by itself when it starts the command
            with contextlib.suppress(OSError):  # it ends at this moment
                self._press_ctrl_alt_del()

    def _press_ctrl_alt_del(self) -> None:
        """Have the kernel's first process look for signals, through the kernel's management socket."""
        text = b"cad"
        message = struct.pack("=III", _MCONSOLE_MAGIC, _MCONSOLE_VERSION, len(text)) + text.ljust(512, b"\0")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.bind("")  # the kernel answers, so the socket needs an address
            sock.sendto(message, str(self._state / "uml" / "mconsole"))

    def kill(self) -> None:
        """End the kernel with all its processes, and with them the command."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._watch.communicate(b"done\n")
        with contextlib.suppress(BrokenPipeError):
            self._pump()
        for _, stream in self._streams:
            stream.close()


def supervise(start: Callable[[], KernelCommand]) -> int:
    """Start a command and wait for it; its exit status, or 128 + n if it was killed after signal n.

    The first signal is handed on with the command's grace to end in, a second one kills.
    """
    signals: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        signals.append(number)

    previous = {number: signal.signal(number, note) for number in SIGNALS}
    kill_at, handed_on = math.inf, 0
    command: KernelCommand | None = None
    try:
        command = start()
        while (status := command.poll()) is None:
            now = time.monotonic()
            if len(signals) > handed_on:
                kill_at = now if handed_on else now + command.grace
                handed_on = len(signals)
                command.signal(signals[-1])
            if now >= kill_at:
                return 128 + signals[-1]
            time.sleep(_POLL)
        return status
    finally:
        if command is not None:
            command.kill()
        for number, handler in previous.items():
            signal.signal(number, handler)


def _put_first(group: int) -> None:
    """Give a process group the processor before others, where that may be done: sched(7), nice and autogroup."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PGRP, group, -20)
        Path(f"/proc/{group}/autogroup").write_text("-20")  # sessions share first, and only then their processes


def init_program(state: Path) -> Path:
    """Path in the state directory of the first program of the caller's file system, a shell script."""
    return state / "init"
