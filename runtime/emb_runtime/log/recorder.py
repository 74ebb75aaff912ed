"""The runtime's side of the log: a handle that pushes records into shared memory and never waits.

Another process writes the file (:mod:`emb_runtime.log.recorder_process`), and outlives this one: if the runtime is
killed, it writes what the ring still holds and closes the file properly.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from msgspec import to_builtins

from emb_runtime.errors import LogError
from emb_runtime.log.ring_buffer import LogHeader, Record, Ring, pack
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child

START_TIMEOUT: Final = 30.0  # Longest wait for the recorder process to have the file on disk [s]
FINISH_TIMEOUT: Final = 30.0  # Longest wait for it to empty the ring and close the file [s]
READ_BACK: Final = 20e6  # Rate at which the slowest disk gives the file back, which takes longer [bytes per second]


class RecorderResult(NamedTuple):
    """Outcome of writing a log."""

    path: Path
    messages: int  # Messages in the file, decoded ones included
    bytes: int  # Size of the file
    dropped: int  # Records that did not fit into the ring, or could not be written: they are not in the file
    complete: bool  # The file was closed properly and holds everything that was pushed
    error: str  # Reason for an incomplete log in one line; empty if it is complete


class _WriterHere:
    """Writer in this process, where there are no others: the time of a simulated run stands still meanwhile."""

    def __init__(self, ring: Ring, document: Mapping[str, Any]) -> None:
        # By name, because the compiler would follow into it, and with it into libraries that it does not need.
        begin_recording = importlib.import_module("emb_runtime.log.recorder_process").begin_recording
        self.pid, self.alive = os.getpid(), True
        self._answer: dict[str, Any] = {}
        self._recording = begin_recording(ring, document)

    def make_room(self) -> None:
        self._recording.drain()

    def tell(self, document: Mapping[str, Any]) -> None:
        self._answer = self._recording.finish(dict(document))

    def read_answer(self, _timeout: float) -> dict[str, Any]:
        return self._answer

    def join(self) -> None:
        pass


class Recorder:
    """A running recorder process. Made by :meth:`start`, ended by :meth:`finish`."""

    def __init__(self, path: Path, ring: Ring, child: Child | _WriterHere) -> None:
        self.path = path
        self._ring = ring
        self._child = child

    @classmethod
    def start(
        cls, path: str | Path, header: LogHeader, slots: int = 1 << 14, timeout: float = START_TIMEOUT
    ) -> Recorder:
        """Start the recorder process and wait until the new file's first chunk is on disk; slots are a power of two.

        LogError if the file exists or cannot be made, or the process did not start in time.
        """
        path = Path(path)
        document = {"path": str(path), "parent": os.getpid(), "header": to_builtins(header, str_keys=True)}
        try:
            with contextlib.ExitStack() as opened:
                ring = Ring.create(slots)
                opened.callback(ring.close)
                child: Child | _WriterHere = (
                    Child("recorder", "emb_runtime.log.recorder_process", document, timeout, [ring.fd])
                    if HAS_CHILD_PROCESSES
                    else _WriterHere(ring, document)
                )
                opened.pop_all()
        except (OSError, LogError) as err:
            raise LogError(f"{path}: cannot record: {err}") from err
        return cls(path, ring, child)

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._child.pid

    def wait_for_room(self) -> None:
        """Wait until the ring is less than half full: for a simulated run, whose time can stand still meanwhile."""
        while len(self._ring) > self._ring.slots // 2 and self._child.alive:
            self._child.make_room()

    @property
    def _size(self) -> int:
        """Size of what is at the log's path now [bytes]."""
        return self.path.stat().st_size if self.path.exists() else 0

    def push(self, record: Record) -> None:
        """Record anything; never waits."""
        self._ring.push(*pack(record))

    def finish(self, trailer: Mapping[str, str], timeout: float = FINISH_TIMEOUT) -> RecorderResult:
        """Have the rest written and the file closed; ends the process in any case. A failure is in the result.

        The trailer, the outcome of the run, becomes the metadata ``emb.end``.
        """
        with contextlib.suppress(OSError):  # if the process is gone, its last answer follows
            self._child.tell(trailer)
        answer = self._child.read_answer(timeout + self._size / READ_BACK)
        lost = self._ring.dropped + int(answer.get("lost", len(self._ring)))
        self._child.join()
        self._ring.close()
        error = str(answer.get("error", ""))
        if not error and lost:
            error = f"{lost} records did not fit into the ring"
        return RecorderResult(self.path, int(answer.get("messages", 0)), self._size, lost, not error, error)
