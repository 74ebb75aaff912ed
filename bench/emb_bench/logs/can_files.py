"""A log as a file of python-can: ``can.LogReader("run.mcap")``, ``can_logconvert run.mcap run.blf``, ``can_player``.

python-can finds the class by the entry point ``can.io.message_reader``. Its times are float seconds, which at today's
date are steps of 0.24 us: good enough to replay frames, not to keep a master log in.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from typing import Any

from can import Message
from can.io.generic import MessageReader
from can.typechecking import StringPathLike

from emb_bench.logs.log import read_log

_SECOND = 10**9  # [ns]


class McapReader(MessageReader):
    """The frames of a log, received and sent, in the order in which they were recorded.

    A log that was cut or damaged is read as far as it goes, and what is missing is logged as a warning.
    """

    def __init__(self, file: StringPathLike, **kwargs: Any) -> None:
        self._log = read_log(os.fspath(file))
        self.missing = self._log.missing  # Description of the missing parts; empty if there are none

    def __iter__(self) -> Iterator[Message]:
        """Messages; ``timestamp`` is Unix time [s], ``is_rx`` is False for a sent frame."""
        # Without the bus's options: python-can takes digits at the end of a channel's name for its number.
        bus = self._log.run["iface"].partition(":")[0] if "iface" in self._log.run else None
        for frame in self._log.frames_by_unix_time():
            yield Message(
                timestamp=frame.time_ns / _SECOND,  # of two integers, the nearest float
                arbitration_id=frame.identifier,
                is_extended_id=frame.extended,
                is_remote_frame=frame.remote,
                is_error_frame=frame.error,
                is_rx=not frame.own,
                channel=bus,
                dlc=len(frame.data),
                data=None if frame.remote else frame.data,
            )
        if self.missing:
            logging.getLogger(__name__).warning("%s: %s", self._log.path, self.missing)

    def stop(self) -> None:
        """Do nothing: the file is open while it is read."""
