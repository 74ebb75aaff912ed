"""The recorder process: takes records out of the ring and writes them into one MCAP file.

``python -m emb_runtime.log.recorder_process RING_FD HEADER_FD``, started only by
:class:`emb_runtime.log.recorder.Recorder`. It answers on standard output, one JSON object per line: first ``ready`` or
``error``, at the end the state of the file. Its standard input carries the trailer. If the input ends without one, the
runtime has died; the file is then completed, too.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import mcap
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from msgspec import convert

from emb_runtime.can.codec import FrameRejectedError, from_document
from emb_runtime.can.transport import SocketCan
from emb_runtime.errors import BusError, EmbError, LogError
from emb_runtime.log import topics
from emb_runtime.log.ring_buffer import (
    TOPICS,
    ClockRecord,
    EstimateRecord,
    EventRecord,
    FrameRecord,
    InputRecord,
    LogHeader,
    Record,
    Ring,
    encodable,
    unpack,
)
from emb_runtime.system import child_process
from emb_runtime.system.clock import MonotonicClock
from emb_runtime.system.input_file import open_regular
from emb_runtime.system.realtime import step_back

CHUNK = 256 * 1024  # Bytes after which a chunk is closed
FLUSH = 0.1
"""Longest time until a record is in the file [s]: the loss if this process is killed, and the delay of a viewer."""
POLL = 0.005  # Time between two looks into the ring [s]
BATCH = 128  # Records between two looks at the clock

RUN = "emb.run"
END = "emb.end"  # Names of the metadata records with the run's identity and with its outcome
OPTIONAL = {"/estimate", "/drive/rx", "/emb/EMB_Charge", "/emb/EMB_Conditions"}  # Topics that not every log has
DIED = "the runtime process died"  # Exit reason in a log whose runtime ended without saying why


class LogWriter:
    """Converts records to MCAP messages, which it writes to ``output``. Reads no clock."""

    def __init__(self, output: BinaryIO, header: LogHeader) -> None:
        self._messages = {message.identifier: message for message in header.messages}
        self._offset = header.wall_offset_ns
        self._mcap = Writer(output, chunk_size=CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True)
        tool = header.metadata.get(RUN, {}).get("tool", "emb-excite").replace(" ", "/")
        self._mcap.start(profile="", library=f"{tool} mcap-python/{mcap.__version__}")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self.messages = 0  # Messages written
        self.undecoded = 0  # Frames that are not valid frames of the DBC: the log has them as raw frames only
        begin = self._offset + header.start_ns
        for name, entries in header.metadata.items():
            self._add_metadata(name, entries)
        for name, media_type, data in (("emb.dbc", "text/plain", header.dbc.encode()), *header.attachments):
            self._mcap.add_attachment(create_time=begin, log_time=begin, name=name, media_type=media_type, data=data)
        there = {*header.topics, "/drive/rx"} if header.drive_bus else header.topics
        for topic in topics.TOPICS:
            if topic not in OPTIONAL or topic in there:
                self._register(topic)
        # A chunk is written only with a message, and a reader of a cut file needs this chunk.
        self.write(ClockRecord(header.start_ns, begin), begin)
        self.flush()

    def write(self, record: Record, log_time: int) -> None:
        """Write one record of monotonic times, and what it decodes to, at a Unix time [ns]."""
        if isinstance(record, FrameRecord):
            self.write_frame("/can/tx" if record.frame.own else "/can/rx", record, log_time)
            try:
                message = self._messages[record.frame.identifier]
                signals = message.decode(record.frame)
            except (KeyError, FrameRejectedError):
                self.undecoded += 1
            else:
                self._add(f"/emb/{message.name}", log_time, record.time_ns, signals)
            return
        values: tuple[Any, ...] = record
        if isinstance(record, EventRecord | InputRecord):
            values = record[1:]
        elif isinstance(record, EstimateRecord):
            values = record.step, *record.numbers
        topic, name = TOPICS[type(record)]
        names = topics.message_class(name).DESCRIPTOR.fields_by_name
        self._add(topic, log_time, record.time_ns, dict(zip(names, values, strict=True)))

    def write_frame(self, topic: str, record: FrameRecord, log_time: int) -> None:
        """Write a raw frame, without decoding it."""
        frame = record.frame
        values = {
            "id": frame.identifier,
            "is_rtr": frame.remote,
            "is_extended": frame.extended,
            "is_error": frame.error,
            "dlc": len(frame.data),
            "data": frame.data,
            "dropped": frame.dropped,
            "read_time_ns": record.read_ns,
        }
        self._add(topic, log_time, frame.time_ns, values)

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def finish(self, trailer: Mapping[str, str]) -> None:
        """Write the outcome and close the file's structure."""
        self.flush()  # a log that is cut before its last message must not contain the outcome
        self._add_metadata(END, {**trailer, "undecoded_frames": str(self.undecoded)})
        self._mcap.finish()  # type: ignore[no-untyped-call]

    def _register(self, topic: str) -> None:
        message = topics.TOPICS[topic]
        if message not in self._schemas:
            data = topics.schema(message)
            self._schemas[message] = self._mcap.register_schema(f"emb.{message}", SchemaEncoding.Protobuf, data)
        self._channels[topic] = self._mcap.register_channel(
            topic, MessageEncoding.Protobuf, self._schemas[message], topics.metadata(message)
        )

    def _add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        self._mcap.add_metadata(name, {key: encodable(text) for key, text in entries.items()})

    def _add(self, topic: str, log_time: int, time_ns: int, values: Mapping[str, Any]) -> None:
        if topic not in self._channels:
            self._register(topic)
        channel = self._channels[topic]
        self._sequences[channel] = sequence = self._sequences.get(channel, 0) + 1
        data = topics.message_class(topics.TOPICS[topic])(**values).SerializeToString()
        self._mcap.add_message(channel, log_time, data, time_ns + self._offset, sequence)
        self.messages += 1


class NewFile(io.FileIO):
    """A new file that records the size and the checksum of all that was written to it."""

    def __init__(self, path: Path) -> None:
        """Create the file; raises OSError, FileExistsError if it exists."""
        super().__init__(path, "xb")
        self.path = path
        self._size = self._checksum = 0

    def write(self, data: Any) -> int:
        """Write as much as possible; returns the number of bytes."""
        count = super().write(data)
        self._checksum = zlib.crc32(memoryview(data)[:count], self._checksum)
        self._size += count
        return count

    def is_as_written(self) -> bool:
        """Returns True if the file at its path contains all that was written, and nothing else."""
        checksum = 0
        try:
            with open_regular(self.path) as file:
                if os.fstat(file.fileno()).st_size != self._size:
                    return False
                while block := file.read(1 << 20):
                    checksum = zlib.crc32(block, checksum)
                return checksum == self._checksum
        except OSError:
            return False


class Recording:
    """One recording: the ring at one end, the file at the other."""

    def __init__(self, ring: Ring, document: Mapping[str, Any], file: NewFile) -> None:
        messages = tuple(map(from_document, document["header"]["messages"]))
        header = replace(convert({**document["header"], "messages": ()}, LogHeader), messages=messages)
        self._ring = ring
        self._parent = int(document["parent"])
        self._simulated, self._offset = header.simulated, header.wall_offset_ns
        self._now = header.start_ns + header.wall_offset_ns
        self._inbox = b""
        self._file, self._output = file, io.BufferedWriter(file)
        self._drive_bus = SocketCan(header.drive_bus, MonotonicClock()) if header.drive_bus else None
        self.writer = LogWriter(self._output, header)
        self.lost = 0  # Records that could not be written
        self.error = ""  # The first failure to write
        self.drive_error = ""  # Loss of the drive's bus, which does not end the recording

    def run(self) -> dict[str, Any]:
        """Record until the trailer comes or the parent is gone; then write the rest and report."""
        trailer: dict[str, str] | None = None
        flushed = time.monotonic()
        wait = POLL
        while trailer is None:
            trailer = self._listen(wait)
            wait = 0.0 if self._drain() | self._read_drive_bus() else POLL
            if time.monotonic() - flushed >= FLUSH:
                self._guarded(self.writer.flush)
                flushed = time.monotonic()
        return self.finish(trailer)

    def drain(self) -> None:
        """Write all that the ring holds."""
        while self._drain():
            pass

    def _read_drive_bus(self) -> bool:
        """Write what has come on a mapped drive's bus; True if there may be more."""
        if self._drive_bus is None:
            return False
        read_ns = time.monotonic_ns()
        for _ in range(BATCH):
            try:
                frame = self._drive_bus.receive(0)
            except BusError as err:
                self.drive_error, self._drive_bus = str(err), None  # the log of the run goes on without it
                return False
            if frame is None:
                return False
            log_time = max(read_ns, frame.time_ns) + self._offset
            self._guarded(partial(self.writer.write_frame, "/drive/rx", FrameRecord(frame, read_ns), log_time))
        return True

    def finish(self, trailer: dict[str, str]) -> dict[str, Any]:
        """Write the rest, close the file and report."""
        self.drain()
        self.lost += len(self._ring)  # not empty only if the producer died between two stores
        trailer["dropped_records"] = str(self._ring.dropped + self.lost)
        if self.drive_error:
            trailer["drive_bus_error"] = self.drive_error
        self._guarded(partial(self._close, trailer))
        if not self.error and not self._file.is_as_written():
            self.error = "it was removed, replaced or changed while it was written: run again, and leave it alone"
        with contextlib.suppress(OSError):  # what could not be written is not tried again
            self._output.close()
        return {"messages": self.writer.messages, "lost": self.lost, "error": self.error}

    def _close(self, trailer: Mapping[str, str]) -> None:
        self.writer.finish(trailer)
        self._output.flush()
        os.fsync(self._output.fileno())

    def _listen(self, wait: float) -> dict[str, str] | None:
        """The trailer when it has come, or the one for a dead parent when the parent has ended; else None."""
        readable, _, _ = select.select([0], [], [], wait)
        if readable:
            data = os.read(0, 65536)
            self._inbox += data
            if b"\n" in self._inbox:
                trailer: dict[str, str] = json.loads(self._inbox)
                return trailer
            if not data:
                return {"exit_reason": DIED}
        # A process that the runtime forked may hold the other end of the pipe open.
        return {"exit_reason": DIED} if os.getppid() != self._parent else None

    def _drain(self) -> bool:
        """Write a batch; True if there may be more."""
        if not self._simulated:
            self._now = time.monotonic_ns() + self._offset  # one clock read for the batch
        for _ in range(BATCH):
            item = self._ring.pop()
            if item is None:
                return False
            if self.error:
                self.lost += 1
            else:
                self._guarded(partial(self._write, *item))
        return True

    def _write(self, kind: int, payload: bytes) -> None:
        record = unpack(kind, payload)
        # A record is not logged before its own time; in simulated time, which does not advance, it is logged at it.
        self._now = max(self._now, record.time_ns + self._offset)
        self.writer.write(record, self._now)

    def _guarded(self, action: Callable[[], None]) -> None:
        """Do an action; store its failure. The ring is still emptied, as a full one would drop records."""
        if self.error:
            return
        try:
            action()
        except Exception as err:
            self.error = f"writing failed: {_reason(err)}"
            self.lost += 1


def begin_recording(ring: Ring, document: Mapping[str, Any]) -> Recording:
    """Create the file, with its first chunk; raises LogError if that fails."""
    try:
        file = NewFile(Path(document["path"]))
    except FileExistsError as err:
        raise LogError("the file exists; logs are never overwritten, choose another name") from err
    except OSError as err:
        raise LogError(err.strerror or str(err)) from err
    try:
        return Recording(ring, document, file)
    except Exception as err:
        file.close()  # what could not be written is not tried again
        file.path.unlink(missing_ok=True)
        told = str(err) if isinstance(err, EmbError) else f"{_reason(err)}; the file was begun, and is removed"
        raise LogError(told) from err


def _reason(err: Exception) -> str:
    """Reason of a failure in one line: the system's message, or else class and message."""
    return (isinstance(err, OSError) and err.strerror) or f"{type(err).__name__}: {err}".partition("\n")[0]


def main(arguments: list[str]) -> int:
    """Record one run. Returns the exit status."""
    child_process.leave_ending_to_parent()
    step_back()
    ring_fd, header_fd = map(int, arguments)
    document = child_process.read_document(header_fd)
    try:
        recording = begin_recording(Ring(ring_fd), document)
    except LogError as err:
        child_process.write_answer({"error": str(err)})
        return 1
    child_process.write_answer({"ready": True})
    answer = recording.run()
    child_process.write_answer(answer)
    return 1 if answer["error"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
