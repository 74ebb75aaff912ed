"""``vcan0`` on the host itself, where its kernel knows CAN."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import Iterator

from emb_bench.hil import link
from emb_bench.hil.guest import INTERFACE, not_started
from emb_bench.hil.supervise import ParentDeathWatch
from emb_runtime.errors import BusError
from emb_runtime.system.terminal import mention


@contextlib.contextmanager
def interface(name: str = INTERFACE) -> Iterator[None]:
    """``name`` exists and is up within the context; afterwards it is gone again only if it was made here.

    Raises:
        BusError: the host cannot have it; the message says why.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise BusError(f"this kernel has no CAN sockets ({error.strerror})") from error
    made = not link.exists(name)
    try:
        if made:
            link.add(name)
        elif not link.is_up(name):
            link.set_up(name)
    except OSError as error:
        raise BusError(f"{name} cannot be {'made' if made else 'set up'} here ({error.strerror})") from error
    try:
        yield
    finally:
        if made:
            with contextlib.suppress(OSError):  # the command may have removed it itself
                link.remove(name)


class HostCommand:
    """The command as an ordinary child, in a session of its own; a :class:`~emb_bench.hil.supervise.Child`."""

    grace = 10.0

    def __init__(self, command: list[str]) -> None:
        self._started: tuple[subprocess.Popen[bytes], ParentDeathWatch] | None = None
        self._status = 0
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            message, self._status = not_started(command[0], error)
            mention(message.removesuffix("\n"))
        else:
            self._started = process, ParentDeathWatch(process.pid, "")

    def poll(self) -> int | None:
        """Its exit status as a shell has it, None while it runs."""
        if self._started is None:
            return self._status
        status = self._started[0].poll()
        return status if status is None or status >= 0 else 128 - status

    def signal(self, number: int) -> None:
        """Hand its process group a signal."""
        if self._started is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._started[0].pid, number)

    def kill(self) -> None:
        """End its process group."""
        self.signal(signal.SIGKILL)
        if self._started is not None:
            self._started[0].wait()
            self._started[1].release()
