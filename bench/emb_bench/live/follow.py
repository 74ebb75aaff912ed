"""The chunks of a log that is still being written, and the logs that appear in a folder.

The recorder closes a chunk every tenth of a second. Who reads them takes nothing from the run: the loop and the
recorder do not know of a reader.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from mcap import records as mcap
from mcap.opcode import Opcode

from emb_bench.logs.log import UNREADABLE, read_log
from emb_bench.logs.mcap_file import (
    DAMAGE,
    LARGEST,
    MAGIC,
    MOST_CARRIED,
    Chunk,
    message_class,
    message_of,
    unpack_chunk,
)
from emb_runtime.errors import LogError
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.log.mcap_schema import CYCLE, ESTIMATE, SAFETY, deviation_of
from emb_runtime.records import Reason, RunState
from emb_runtime.system.input_file import open_regular

_RECORD = struct.Struct("<BQ")  # opcode, length of what follows


def chunks(path: Path, wait: Callable[[], bool]) -> Iterator[Chunk]:
    """The chunks of a log, each as soon as it is whole; ends with the log's footer.

    ``wait`` is called where the file has no more yet, waits a little, and is False if nothing more is to be waited for.

    Raises:
        LogError: it cannot be read, or is no log.
    """
    try:
        with open_regular(path) as file:
            if _read(file, len(MAGIC), wait) not in (MAGIC, None):
                raise LogError(f"{path}: not an MCAP file")
            while (head := _read(file, _RECORD.size, wait)) is not None:
                opcode, length = _RECORD.unpack(head)
                if length > max(LARGEST, MOST_CARRIED):
                    raise LogError(f"{path}: a record in it claims {length} bytes, none of ours has so many")
                body = _read(file, length, wait)
                if body is None or opcode == Opcode.FOOTER:
                    return
                if opcode == Opcode.CHUNK:
                    yield unpack_chunk(body)
    except OSError as err:
        raise LogError(f"{path}: {err.strerror}") from err
    except DAMAGE as err:
        raise LogError(f"{path}: damaged: {err}") from err


def _read(file: BinaryIO, count: int, wait: Callable[[], bool]) -> bytes | None:
    """So many bytes, once they are there; None where they will not come."""
    data, goes_on = b"", True
    while len(data) < count:
        data += file.read(count - len(data))
        if len(data) < count:
            if not goes_on:
                return None
            goes_on = wait()  # what came meanwhile is read once more
    return data


class NewLogs:
    """The logs that appear in a folder, the oldest first; with ``old`` those that are there already, too."""

    def __init__(self, folder: Path, pattern: str = "*.mcap", old: bool = False) -> None:
        self._folder = folder
        self._pattern = pattern
        self._seen = set() if old else set(self._logs())

    def next(self) -> Path | None:
        """The next log, if there is one yet."""
        new = self._new()
        self._seen.update(new[:1])
        return new[0] if new else None

    @property
    def waiting(self) -> bool:
        """Returns True if there is a next log."""
        return bool(self._new())

    def _new(self) -> list[Path]:
        return [path for path in self._logs() if path not in self._seen]

    def _logs(self) -> list[Path]:
        try:
            return sorted(self._folder.glob(self._pattern), key=lambda path: path.stat().st_mtime_ns)
        except OSError:  # removed between two looks
            return []


class Viewer(Protocol):
    """Takes the chunks of one log after the other."""

    def begin(self) -> None:
        """Another log begins."""

    def add(self, chunk: Chunk) -> None:
        """Take a chunk."""

    def end(self, reason: str) -> None:
        """The log is whole: the run's exit reason."""


def follow(
    logs: NewLogs,
    viewer: Viewer,
    wait: Callable[[], bool],
    complain: Callable[[LogError], object],
    once: bool = False,
) -> None:
    """Give a viewer every log that appears, or the first only, as it grows, until ``wait`` says that no more comes.

    ``complain`` takes what is wrong with a log; the next is followed all the same.
    """
    goes_on = True
    while goes_on or (logs.waiting and not once):
        if (path := logs.next()) is None:
            goes_on = wait()
            continue
        viewer.begin()
        try:
            # A run that was killed leaves a log that has no end.
            for chunk in chunks(path, lambda: wait() and not logs.waiting):
                viewer.add(chunk)
            viewer.end(read_log(path).exit_reason)
        except LogError as err:
            complain(err)
        except UNREADABLE as err:
            complain(LogError(f"{path}: its messages are not readable: {message_of(err)}"))
        goes_on &= not once


TOLD = (CYCLE.name, ESTIMATE, SAFETY.name)
RUNNING = (RunState.ACTIVE, RunState.HOMING)
SHIELD = Reason.LIMITED | Reason.RETURNING | Reason.LEFT


class Decoder:
    """The messages of one log that the page shows: cycles, estimates and transitions."""

    def __init__(self) -> None:
        self._schemas: dict[int, mcap.Schema] = {}
        self._classes: dict[int, tuple[str, Any]] = {}
        self.units: dict[str, str] = {}  # Of the estimated parameters

    def messages(self, chunk: Chunk) -> Iterator[tuple[str, Any]]:
        """Topic and content of each message in a chunk.

        Raises:
            TypeError, KeyError, ValueError, google.protobuf.message.DecodeError: its schemas or messages are damaged.
        """
        for record in chunk.described:
            if isinstance(record, mcap.Schema):
                self._schemas[record.id] = record
            elif record.topic in TOLD and record.schema_id in self._schemas:
                schema = self._schemas[record.schema_id]
                self._classes[record.id] = (record.topic, message_class(schema.name, schema.data))
                if record.topic == ESTIMATE:
                    self.units = dict(json.loads(record.metadata.get("units", "{}")))
        for message in chunk.messages():
            if message.channel_id in self._classes:
                topic, factory = self._classes[message.channel_id]
                yield topic, factory.FromString(message.data)


def intervals(estimate: Any) -> Iterator[tuple[str, float, float]]:
    """Name, value and half of the 95 % interval of each parameter in an estimate."""
    names = [field.name for field in estimate.DESCRIPTOR.fields]
    for name in names:
        if deviation_of(name) in names:
            yield name, getattr(estimate, name), NORMAL_95 * getattr(estimate, deviation_of(name))
