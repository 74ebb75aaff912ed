"""The chunks of a log that is still being written, and the logs that appear in a folder.

The recorder closes a chunk every tenth of a second. Who reads them takes nothing from the run: the loop and the
recorder do not know of a reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from emb_bench.live.serve import Server
from emb_bench.logs.estimates import known_errors
from emb_bench.logs.log import UNREADABLE, read_log
from emb_bench.logs.mcap_file import DAMAGE, LARGEST, MAGIC, MOST_CARRIED, RECORD, Chunk, message_of, unpack_chunk
from emb_runtime.errors import LogError
from emb_runtime.system.input_file import open_regular


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
            while (head := _read(file, RECORD.size, wait)) is not None:
                opcode, length = RECORD.unpack(head)
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


def follow(
    logs: NewLogs,
    server: Server,
    wait: Callable[[], bool],
    complain: Callable[[LogError], object],
    once: bool = False,
) -> None:
    """Give a server every log that appears, or the first only, as it grows, until ``wait`` says that no more comes.

    ``complain`` takes what is wrong with a log; the next is followed all the same.
    """
    goes_on = True
    while goes_on or (logs.waiting and not once):
        if (path := logs.next()) is None:
            goes_on = wait()
            continue
        server.begin()
        try:
            # A run that was killed leaves a log that has no end.
            for number, chunk in enumerate(chunks(path, lambda: wait() and not logs.waiting)):
                if number == 0:  # the attachments lie before it
                    server.know(known_errors(read_log(path)))
                server.add(chunk)
            server.end(read_log(path).exit_reason)
        except LogError as err:
            complain(err)
        except UNREADABLE as err:
            complain(LogError(f"{path}: its messages are not readable: {message_of(err)}"))
        goes_on &= not once
