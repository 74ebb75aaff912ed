"""MCAP as a file format of python-can: ``can.LogReader("run.mcap")``, ``can.Logger("new.mcap")`` and its commands.

python-can finds both classes by the entry points ``can.io.message_reader`` and ``can.io.message_writer``. Its times are
float seconds, which at today's date are steps of 0.24 us: good enough to replay frames, not to keep a master log in.
"""

from __future__ import annotations

import logging
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from can import Message
from can.io.generic import MessageReader, MessageWriter
from can.typechecking import StringPathLike
from google.protobuf.message import DecodeError
from mcap import records as mcap
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from emb_bench.logs.log import reported_missing
from emb_bench.logs.mcap_reader import CAN_LIBRARY, RecordReader
from emb_runtime.errors import FrameError, LogError, UsageError
from emb_runtime.log.mcap_schema import CAN_RX, CAN_TX
from emb_runtime.log.recorder_process import CHUNK, RUN
from emb_runtime.system.input_file import open_regular

FLUSH = 0.5  # Longest time that a frame stays out of the file [s]
INTERFACE = "interface"  # Key in a channel's metadata: the bus that its frames are of

_FRAME = CAN_RX.factory
_SECOND = 10**9  # [ns]
_LAST_TIME = 2**63 / _SECOND  # [s]


class McapReader(MessageReader):
    """The frames of a log, received and sent, in the order in which they were recorded.

    A log that was cut or damaged is read as far as it goes, and what is missing is logged as a warning.

    Args:
        file: path of the log.
        kwargs: options of other readers of python-can; not used.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log of ours.
    """

    def __init__(self, file: StringPathLike, **kwargs: Any) -> None:
        self._path = Path(os.fspath(file))
        try:
            self._file = open_regular(self._path)
            self._size = os.fstat(self._file.fileno()).st_size
        except OSError as err:
            raise UsageError(f"{self._path}: cannot read the log: {err.strerror}") from err
        try:
            self._reader()
        except BaseException:
            self._file.close()
            raise
        self.missing: tuple[str, ...] = ()
        """Descriptions of the missing parts; known when all of the log has been read."""

    def __iter__(self) -> Iterator[Message]:
        """Messages; ``timestamp`` is Unix time [s], ``is_rx`` is False for what was sent."""
        reader = self._reader()
        channels: dict[int, mcap.Channel] = {}
        metadata: dict[str, dict[str, str]] = {}
        lost = 0
        for record in reader.one_by_one():
            match record:
                case mcap.Channel():
                    channels[record.id] = record
                case mcap.Metadata():
                    metadata[record.name] = record.metadata
                case mcap.Message():
                    channel = channels.get(record.channel_id)
                    if channel is None:
                        lost += 1
                    elif channel.topic in (CAN_RX.name, CAN_TX.name):
                        name = channel.metadata.get(INTERFACE, _bus(metadata.get(RUN, {}).get("iface")))
                        yield self._message(record, channel.topic == CAN_RX.name, name)
        if lost:
            reader.missing.append(
                f"{lost} messages of a topic whose description is lost, or comes later: repair the log"
            )
        self.missing = (*reader.missing, *reported_missing(metadata))
        for what in self.missing:
            logging.getLogger(__name__).warning("%s: %s", self._path, what)

    def stop(self) -> None:
        """Close the file."""
        self._file.close()

    def _reader(self) -> RecordReader:
        return RecordReader(self._path, self._file, self._size)

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
            channel=int(bus) if bus is not None and bus.isdecimal() else bus,
            dlc=frame.dlc,
            data=None if frame.is_rtr else frame.data,
        )


def _bus(iface: str | None) -> str | None:
    """The bus without its options: python-can takes digits at the end of the name for a number."""
    return None if iface is None else iface.partition(":")[0]


class McapWriter(MessageWriter):
    """Frames into an MCAP file with the topics ``/can/rx`` and ``/can/tx`` of our logs; finished by :meth:`stop`.

    It is not a log of a run: it has no control cycles, no bench and no clock.

    Args:
        file: path of the file to make; one that exists is never overwritten.
        flush_every: longest time that a frame stays out of the file [s].
        kwargs: what other writers of python-can take; ``append`` is refused, the others are not used.

    Raises:
        UsageError: the file exists or cannot be made, or it was to be appended to.
    """

    def __init__(self, file: StringPathLike, flush_every: float = FLUSH, **kwargs: Any) -> None:
        self._path = Path(os.fspath(file))
        if kwargs.get("append", False):
            raise UsageError(f"{self._path}: an MCAP file cannot be appended to: write a new one")
        try:
            self._file = self._path.open("xb")
        except FileExistsError as err:
            raise UsageError(f"{self._path}: exists, and logs are never overwritten: choose another name") from err
        except OSError as err:
            raise UsageError(f"{self._path}: cannot write: {err.strerror}") from err
        self._mcap = Writer(self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._mcap.start(profile="", library=f"{CAN_LIBRARY}{version('emb-excite')} mcap-python/{version('mcap')}")
        self._schema = self._mcap.register_schema(
            CAN_RX.message, SchemaEncoding.Protobuf, CAN_RX.descriptor.SerializeToString()
        )
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}
        self._lock = threading.Lock()  # python-can hands messages over in threads of its own
        self._stopped = threading.Event()
        self._failure: OSError | None = None
        self._flushing = threading.Thread(target=self._flush_now_and_then, args=(flush_every,), daemon=True)
        self._flushing.start()

    def on_message_received(self, msg: Message) -> None:
        """Write one frame.

        Raises:
            FrameError: it is a CAN FD frame, or its time is not one.
            UsageError: the file cannot be written.
        """
        if msg.is_fd:
            raise FrameError(
                f"expected a classical CAN frame, got CAN FD, {msg.arbitration_id:#x}: it has no place here"
            )
        if not (math.isfinite(msg.timestamp) and 0.0 <= msg.timestamp < _LAST_TIME):
            raise FrameError(f"expected a time in seconds since 1970, got {msg.timestamp!r}")
        whole, part = divmod(msg.timestamp, 1.0)
        time_ns = int(whole) * _SECOND + round(part * _SECOND)
        frame = _FRAME(
            id=msg.arbitration_id,
            is_rtr=msg.is_remote_frame,
            is_extended=msg.is_extended_id,
            is_error=msg.is_error_frame,
            dlc=msg.dlc,
            data=bytes(msg.data),
        )
        with self._lock, self._complaining():
            if self._failure is not None:
                raise self._failure
            channel = self._channel(msg)
            self._sequences[channel] = sequence = self._sequences.get(channel, 0) + 1
            self._mcap.add_message(channel, time_ns, frame.SerializeToString(), time_ns, sequence)

    def stop(self) -> None:
        """Finish and close the file; a second time does nothing.

        Raises:
            UsageError: the file cannot be written.
        """
        self._stopped.set()
        self._flushing.join()
        if self._file.closed:
            return
        with self._complaining():
            try:
                if self._failure is not None:
                    raise self._failure
                self._mcap.finish()  # type: ignore[no-untyped-call]
            finally:
                self._file.close()

    def _channel(self, msg: Message) -> int:
        """The MCAP channel of a message; each bus has two of its own, which share their topics with other buses."""
        bus = "" if msg.channel is None else str(msg.channel)
        if (bus, CAN_RX.name) not in self._channels:
            for topic in (CAN_RX, CAN_TX):
                metadata = topic.metadata | ({INTERFACE: bus} if bus else {})
                self._channels[bus, topic.name] = self._mcap.register_channel(
                    topic.name, MessageEncoding.Protobuf, self._schema, metadata
                )
        return self._channels[bus, (CAN_RX if msg.is_rx else CAN_TX).name]

    def _flush_now_and_then(self, every: float) -> None:
        while not self._stopped.wait(every):
            with self._lock:
                try:
                    self._mcap.flush()  # type: ignore[no-untyped-call]
                except OSError as err:
                    self._failure = err  # raised at the next frame, or at the end
                    return

    @contextmanager
    def _complaining(self) -> Iterator[None]:
        try:
            yield
        except OSError as err:
            raise UsageError(f"{self._path}: cannot write: {err.strerror}") from err
