"""The chunks of a log that is still being written, and the logs that appear in a folder.

The recorder closes a chunk every tenth of a second. Who reads them takes nothing from the run: the loop and the
recorder do not know of a reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from mcap import records as mcap
from mcap.opcode import Opcode

from emb_bench.live.serve import Server
from emb_bench.logs.log import LARGEST_TEXT, UNREADABLE, read_log
from emb_bench.logs.mcap_file import (
    DAMAGE,
    LARGEST,
    MAGIC,
    MOST_CARRIED,
    RECORD,
    Chunk,
    message_of,
    stream_of,
    unpack_chunk,
)
from emb_runtime.errors import LogError
from emb_runtime.system.input_file import open_regular


def chunks(path: Path, wait: Callable[[], bool], bench: Callable[[bytes], object] = len) -> Iterator[Chunk]:
    """The chunks of a log, each as soon as it is complete; ends with the log's footer.

    ``wait`` is called where the file has no more yet, waits a little, and is False if nothing more is to be waited for.
    ``bench`` gets the bench file inside the log.

    Raises:
        LogError: it cannot be read, or is no log.
    """
    try:
        with open_regular(path) as file:
            if _bytes_once_there(file, len(MAGIC), wait) not in (MAGIC, None):
                raise LogError(f"{path}: not an MCAP file")
            while (head := _bytes_once_there(file, RECORD.size, wait)) is not None:
                opcode, length = RECORD.unpack(head)
                if length > max(LARGEST, MOST_CARRIED):
                    raise LogError(f"{path}: a record in it claims {length} bytes, none of ours has so many")
                body = _bytes_once_there(file, length, wait)
                if body is None or opcode == Opcode.FOOTER:
                    return
                if opcode == Opcode.CHUNK:
                    yield unpack_chunk(body)
                elif opcode == Opcode.ATTACHMENT:
                    attached = mcap.Attachment.read(stream_of(body))
                    if attached.name == "bench.toml" and len(attached.data) <= LARGEST_TEXT:
                        bench(attached.data)
    except OSError as err:
        raise LogError(f"{path}: {err.strerror}") from err
    except DAMAGE as err:
        raise LogError(f"{path}: damaged: {err}") from err


def _bytes_once_there(file: BinaryIO, count: int, wait: Callable[[], bool]) -> bytes | None:
    """So many bytes, once they are there; None where they will not come."""
    data, goes_on = b"", True
    while len(data) < count:
        data += file.read(count - len(data))
        if len(data) < count:
            if not goes_on:
                return None
            goes_on = wait()  # bytes that came meanwhile are read once more
    return data


MOST_LISTED = 100  # Logs of a folder in a page's list


class NewLogs:
    """The logs that appear in a folder, the oldest first; with ``old`` those that are there already, too.

    The one of :meth:`choose` comes before them.
    """

    def __init__(self, folder: Path, pattern: str = "*.mcap", old: bool = False) -> None:
        self._folder = folder
        self._pattern = pattern
        self._seen = set() if old else set(self._logs())
        self._first: Path | None = None

    def next(self) -> Path | None:
        """The next log, if there is one yet."""
        new = self._new()[:1]
        self._first = None
        self._seen.update(new)
        return new[0] if new else None

    def choose(self, name: str) -> None:
        """Let the log of a name be the next, if it is here."""
        self._first = next((path for path in self._logs() if path.name == name), None)

    @property
    def names(self) -> list[str]:
        """Names of the latest logs, the newest first."""
        return [path.name for path in self._logs()[: -MOST_LISTED - 1 : -1]]

    @property
    def waiting(self) -> bool:
        """Returns True if there is a next log."""
        return bool(self._new())

    def _new(self) -> list[Path]:
        first = [] if self._first is None else [self._first]
        return first + [path for path in self._logs() if path not in self._seen]

    def _logs(self) -> list[Path]:
        try:
            return sorted(self._folder.glob(self._pattern), key=lambda path: path.stat().st_mtime_ns)
        except OSError:  # removed between two looks
            return []


def follow(
    logs: NewLogs,
    server: Server,
    wait: Callable[[], bool],
    complain: Callable[[LogError], object],
) -> None:
    """Give a server every log that appears or that a page chooses, as it grows, until ``wait`` is False.

    ``complain`` takes what is wrong with a log; the next is followed all the same.
    """
    goes_on = True
    server.choose = logs.choose
    while goes_on or logs.waiting:
        if (path := logs.next()) is None:
            goes_on = wait()
            continue
        server.begin(path.name, logs.names)
        try:
            # A run that was killed leaves a log that has no end.
            for chunk in chunks(path, lambda: wait() and not logs.waiting, server.know):
                server.add(chunk)
            server.end(read_log(path).exit_reason)
        except (LogError, *UNREADABLE) as err:
            error = LogError(f"{path}: its messages are not readable: {message_of(err)}")
            error = err if isinstance(err, LogError) else error
            server.end(str(error))
            complain(error)
