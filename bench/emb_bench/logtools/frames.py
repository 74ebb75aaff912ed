"""The frames of a log as files of other CAN tools, through python-can's own writers."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import can

from emb_bench.logtools.can_files import McapReader
from emb_bench.logtools.output import new_file
from emb_runtime.errors import LogError


def _blf(file: BinaryIO) -> can.io.generic.MessageWriter:
    return can.BLFWriter(file)


def _asc(file: BinaryIO) -> can.io.generic.MessageWriter:
    return can.ASCWriter(io.TextIOWrapper(file, encoding="ascii"))


def _candump(file: BinaryIO) -> can.io.generic.MessageWriter:
    return can.CanutilsLogWriter(io.TextIOWrapper(file, encoding="ascii"))


WRITERS: dict[str, Callable[[BinaryIO], can.io.generic.MessageWriter]] = {"blf": _blf, "asc": _asc, "log": _candump}
"""Formats, and who writes them."""


def write_frames(source: Path, form: str, target: Path) -> tuple[str, str]:
    """Write every frame, received and sent, in the order of the log, one at a time.

    Args:
        source: the log.
        form: a key of :data:`WRITERS`.
        target: the file to make.

    Returns:
        What is in the file, and what is missing in the log, in words; the latter is empty if nothing is.

    Raises:
        UsageError: a file cannot be read or written, or ``target`` exists.
        LogError: ``source`` is no log, or has no frame.
    """
    count = 0
    with McapReader(source) as reader, new_file(target) as file, WRITERS[form](file) as writer:
        for message in reader:
            writer.on_message_received(message)
            count += 1
        if not count:
            raise LogError(f"{source}: the log has no frame: {'; '.join(reader.missing) or 'nothing was on the bus'}")
    return f"{count} frames", "; ".join(reader.missing)
