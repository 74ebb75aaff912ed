"""A log as a file of python-can: ``can.LogReader("run.mcap")``, ``can_logconvert run.mcap run.blf``, ``can_player``.

python-can finds the class by the entry point ``can.io.message_reader``. Its times are float seconds, which at today's
date are steps of 0.24 us: good enough to replay frames, not to keep a master log in.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from can import Message
from can.io.generic import MessageReader
from can.typechecking import StringPathLike
from google.protobuf.message import DecodeError
from mcap import records as mcap

from emb_bench.logs.log import missing_in
from emb_bench.logs.mcap_file import McapFile
from emb_runtime.errors import LogError, UsageError
from emb_runtime.log.recorder_process import RUN
from emb_runtime.log.topics import message_class
from emb_runtime.system.input_file import open_regular

_FRAME, _FRAMES = message_class("CanFrame"), ("/can/rx", "/can/tx")
_SECOND = 10**9  # [ns]


class McapReader(MessageReader):
    """The frames of a log, received and sent, in the order in which they were recorded.

    A log that was cut or damaged is read as far as it goes, and what is missing is logged as a warning.
    """

    def __init__(self, file: StringPathLike, **kwargs: Any) -> None:
        self._path = Path(os.fspath(file))
        self.missing: tuple[str, ...] = ()  # Descriptions of the missing parts; known when all of the log has been read
        try:
            self._file = open_regular(self._path)
            self._size = os.fstat(self._file.fileno()).st_size
        except OSError as err:
            raise UsageError(f"{self._path}: cannot read the log: {err.strerror}") from err
        try:
            next(self._mcap().chunks(), None)
        except BaseException:
            self._file.close()
            raise

    def __iter__(self) -> Iterator[Message]:
        """Messages; ``timestamp`` is Unix time [s], ``is_rx`` is False for what was sent."""
        log, lost = self._mcap(), 0
        for _, _, chunk in log.chunks():
            received = {number: c.topic == "/can/rx" for number, c in log.channels.items() if c.topic in _FRAMES}
            bus = _bus(log.metadata.get(RUN, {}).get("iface"))
            for message in chunk.messages():
                if message.channel_id in received:
                    yield self._message(message, received[message.channel_id], bus)
                lost += message.channel_id not in log.channels
        if lost:
            log.name_missing(
                f"{lost} messages of a topic whose description is lost, or comes later: "
                "emb-replay export --topic /can/rx -o FILE.csv finds a later one"
            )
        self.missing = missing_in(log)
        for what in self.missing:
            logging.getLogger(__name__).warning("%s: %s", self._path, what)

    def stop(self) -> None:
        """Close the file."""
        self._file.close()

    def _mcap(self) -> McapFile:
        return McapFile(self._path, self._file, self._size)

    def _message(self, record: mcap.Message, received: bool, bus: str | None) -> Message:
        try:
            frame = _FRAME.FromString(record.data)
        except DecodeError as err:
            raise LogError(f"{self._path}: a frame in the log is not readable ({err})") from err
        return Message(
            timestamp=record.publish_time / _SECOND,  # of two integers, the nearest float
            arbitration_id=frame.id,
            is_extended_id=frame.is_extended,
            is_remote_frame=frame.is_rtr,
            is_error_frame=frame.is_error,
            is_rx=received,
            channel=bus,
            dlc=frame.dlc,
            data=None if frame.is_rtr else frame.data,
        )


def _bus(iface: str | None) -> str | None:
    """The bus without its options: python-can takes digits at the end of the name for a number."""
    return None if iface is None else iface.partition(":")[0]
