"""The frames of a log as files of other CAN tools, through python-can's own writers."""

from __future__ import annotations

import io
from collections.abc import Callable
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import can

from emb_bench.logs.can_files import McapReader
from emb_bench.output import new_file
from emb_runtime.errors import LogError


class _AscWriter(can.ASCWriter):
    """python-can's, which dates the file by today, and writes 38 milliseconds as ``.38``."""

    def __init__(self, file: BinaryIO, begin: float) -> None:
        self._begin = begin
        super().__init__(io.TextIOWrapper(file, encoding="ascii"))

    def _format_header_datetime(self, _dt: datetime) -> str:
        begin = datetime.fromtimestamp(self._begin)
        return begin.strftime(self.FORMAT_DATE.format(f"{begin.microsecond // 1000:03d}"))

    def log_event(self, message: str, timestamp: float | None = None) -> None:
        # The stamps of two frames need not go forward, and a time before the first one has no place in this format.
        super().log_event(message, None if timestamp is None else max(timestamp, self._begin))


def _blf(file: BinaryIO, _begin: float) -> can.io.generic.MessageWriter:
    return can.BLFWriter(file)


def _candump(file: BinaryIO, _begin: float) -> can.io.generic.MessageWriter:
    return can.CanutilsLogWriter(io.TextIOWrapper(file, encoding="ascii"))


WRITERS: dict[str, Callable[[BinaryIO, float], can.io.generic.MessageWriter]] = {
    "blf": _blf,
    "asc": _AscWriter,
    "log": _candump,
}
"""Formats, and who writes them, from the file and the first frame's time [s]."""


def write_frames(source: Path, form: str, target: Path) -> tuple[str, str]:
    """Write every frame, received and sent, in the order of the log, one at a time.

    Args:
        source: the log.
        form: a key of :data:`WRITERS`.
        target: the file to make.

    Returns:
        Descriptions of the file's content and of what is missing in the log; the latter is empty if nothing is.

    Raises:
        UsageError: a file cannot be read or written, or ``target`` exists.
        LogError: ``source`` is no log, or has no frame.
    """
    with McapReader(source) as reader:
        messages = iter(reader)
        first = next(messages, None)
        if first is None:
            raise LogError(f"{source}: the log has no frame: {'; '.join(reader.missing) or 'nothing was on the bus'}")
        count = 0
        with new_file(target) as file, WRITERS[form](file, first.timestamp) as writer:
            for message in chain([first], messages):
                writer.on_message_received(message)
                count += 1
    return f"{count} frames", "; ".join(reader.missing)
