"""Child processes: each takes one document, answers in lines of JSON, and ends when its standard input does.

The runtime's side is :class:`Child`; the functions below it are for the child.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import math
import os
import select
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emb_runtime.system.terminal import ENDING

HAS_CHILD_PROCESSES = sys.platform == "linux"  # True where child processes are started
END_TIMEOUT = 1.0  # Time for the process to end once its input is closed; then it is killed [s]

MAX_ANSWER = 1 << 20  # Longest line that it may answer [bytes]
_PR_SET_PDEATHSIG = 1


class Child:
    """A running process ``python -m MODULE FD... DOCUMENT_FD`` that is ready, within a time-out [s].

    OSError, with the name and the reason, if it cannot be started or has answered ``error``.
    """

    def __init__(
        self, name: str, module: str, document: Mapping[str, Any], timeout: float, fds: Sequence[int] = ()
    ) -> None:
        import subprocess  # not in the process itself, whose start the runtime waits for

        self._name = name
        self._answers = b""
        # The document goes through shared memory: a pipe could fill up, and block, while the process boots.
        fd = os.memfd_create(name, os.MFD_CLOEXEC)
        with os.fdopen(fd, "wb") as memory:
            memory.write(json.dumps(document).encode())
            memory.flush()
            # -P: modules of the working directory are not ours. A new group: Ctrl-C is for the runtime.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, *map(str, fds), str(fd)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(*fds, fd),
                process_group=0,
                env=os.environ | {"EMB_CORE": "python"},  # msgspec reads no compiled record
            )
        answer = self.read_answer(timeout)
        if "ready" not in answer:
            self.kill()
            raise ChildProcessError(answer.get("error", f"the {name} process is not ready"))
        self.ready: Any = answer["ready"]
        """Content of its first answer."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Returns True if it has not ended yet."""
        return self._process.poll() is None

    def make_room(self) -> None:
        """Wait a moment for it to go on with its work."""
        time.sleep(0.001)

    def tell(self, document: Mapping[str, Any]) -> None:
        """Write one line of JSON to its standard input; raises OSError if it is gone."""
        pipe = self._process.stdin
        assert pipe is not None
        pipe.write(json.dumps(dict(document)).encode() + b"\n")
        pipe.flush()

    def read_answer(self, timeout: float) -> dict[str, Any]:
        """The next line from the process as a dictionary; one with ``error`` if none came within ``timeout`` [s]."""
        pipe = self._process.stdout
        assert pipe is not None
        deadline = time.monotonic() + timeout
        while b"\n" not in self._answers:
            ready, _, _ = select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                return {"error": f"the {self._name} process did not answer within {timeout:g} s"}
            chunk = os.read(pipe.fileno(), 65536)
            if not chunk:
                code = self._process.wait()
                ending = f"signal {-code}" if code < 0 else f"exit status {code}"
                return {"error": f"the {self._name} process died ({ending})"}
            self._answers += chunk
            if len(self._answers) > MAX_ANSWER:
                return {"error": f"the {self._name} process wrote more than {MAX_ANSWER} bytes at once"}
        line, _, self._answers = self._answers.partition(b"\n")
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            answer = None
        return answer if isinstance(answer, dict) else {"error": f"the {self._name} process wrote what is no answer"}

    @property
    def exit_code(self) -> int | None:
        """Exit status once it has ended, and minus the signal that ended it; None before."""
        return self._process.poll()

    def kill(self) -> None:
        """End it at once, unless it has ended."""
        self._process.kill()
        self._process.wait()
        self.join()

    def release(self) -> None:
        """Close its standard input: it may end now."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def join(self) -> None:
        """Wait until it has ended, and kill it if it does not."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):  # what the pipe still has goes nowhere
                pipe.close()
        deadline = time.monotonic() + END_TIMEOUT
        while self.alive and time.monotonic() < deadline:
            time.sleep(0.001)
        if self.alive:
            self._process.kill()
        self._process.wait()


# --- the child's side ------------------------------------------------------------------------------------------------


def leave_ending_to_parent() -> None:
    """Ignore the signals that end a run: the runtime decides when it is over."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def read_document(fd: int) -> dict[str, Any]:
    """Read what the parent has written for this process, from the memory that it has passed as a file descriptor."""
    gc.freeze()  # or Python searches all that was imported for garbage before it ends
    with os.fdopen(fd, "rb") as memory:
        memory.seek(0)
        document: dict[str, Any] = json.loads(memory.read())
    return document


def write_answer(document: Mapping[str, Any]) -> None:
    """Write one line of JSON to the parent, unless it is gone."""
    with contextlib.suppress(OSError):
        os.write(1, json.dumps(dict(document)).encode() + b"\n")


def end_with(parent: int) -> None:
    """End this process when the one with this id, which started it, ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, *map(ctypes.c_ulong, (signal.SIGKILL, 0, 0, 0)))
    if os.getppid() != parent:  # it was gone before
        os._exit(1)


def confine(memory: int, seconds: float) -> None:
    """Limit this process for good to so many bytes and so much processor time [s] more.

    It keeps the rights of its user. The limits are against files that take too much, not against ones that take over
    the process, and hold for each process: a copy that it makes of itself has them anew.
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
