"""``emb-replay repair``: the rest of a cut or damaged log as a finished file that any viewer opens."""

from __future__ import annotations

import argparse
import hashlib
import os
from collections import Counter
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from mcap import records as mcap
from mcap.writer import CompressionType, Writer

from emb_bench.logs.log import REPAIR
from emb_bench.logs.mcap_reader import RecordReader
from emb_bench.output import new_file
from emb_runtime.errors import EXIT_DONE, LogError, UsageError
from emb_runtime.log.recorder_process import CHUNK
from emb_runtime.system.input_file import open_regular
from emb_runtime.system.terminal import as_json, show

HELP = "a cut or damaged log as a finished file that viewers open"
DESCRIPTION = """\
Write what can be saved of a log that was cut (kill -9, full disk, lost power) or damaged as a finished MCAP file, with
summary, indexes and checksums. Topics, schemas, times, sequence numbers, attachments and metadata stay as they were.
The new file says in itself what is missing, so that nothing takes it for a complete log. A log that is whole is left
alone, and nothing is written.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="file to make; never overwritten")
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Repair a log; returns the exit code.

    Raises:
        UsageError: a file cannot be read or written.
        LogError: it is no log, or nothing in it can be saved.
    """
    found = repair(args.log, args.out)
    if args.json:
        written = None if found is None else str(args.out)
        missing, kept = ("", None) if found is None else ("; ".join(found.missing), found.kept)
        show(as_json({"log": str(args.log), "written": written, "missing": missing, "messages": kept}))
    elif found is None:
        show(f"{args.log}: the log is whole, there is nothing to repair, and nothing was written")
    else:
        show("\n".join([*(f"missing  {what}" for what in found.missing), f"{args.out}: {found.kept} messages saved"]))
    return EXIT_DONE


@dataclass
class Found:
    """Content of a damaged log."""

    missing: list[str] = field(default_factory=list)  # Descriptions of the missing parts
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)  # Those whose schema is left
    kept: int = 0  # Messages of these channels
    earlier: str = ""  # Missing parts that an earlier repair reported


def repair(source: Path, target: Path) -> Found | None:
    """Write what is left of a log as a finished one, in two passes, record by record.

    Args:
        source: the log.
        target: the file to make.

    Returns:
        What was found; None if the log is whole, and nothing was written.

    Raises:
        UsageError: a file cannot be read or written, or ``target`` exists.
        LogError: ``source`` is no log, or not one message in it can be saved.
    """
    try:
        with open_regular(source) as file:
            size = os.fstat(file.fileno()).st_size  # a log that is being recorded grows between the passes
            found = _look(RecordReader(source, file, size))
            if not found.missing:
                return None
            if not found.kept:
                raise LogError(f"{source}: not one message is left in this log: {'; '.join(found.missing)}")
            digest = _sha256(file, size)
            with new_file(target) as output:
                _write(RecordReader(source, file, size), found, digest, output)
    except OSError as err:
        raise UsageError(f"{source}: cannot read the log: {err.strerror}") from err
    return found


def _look(reader: RecordReader) -> Found:
    """The first pass: what there is, and what is missing."""
    found = Found()
    counts: Counter[int] = Counter()
    for record in reader.one_by_one():
        match record:
            case mcap.Schema():
                found.schemas.setdefault(record.id, record)
            case mcap.Channel():  # if it is lost with the first chunk, the copy in the summary will do
                found.channels.setdefault(record.id, record)
            case mcap.Message():
                counts[record.channel_id] += 1
            case mcap.Metadata() if record.name == REPAIR:
                found.earlier = record.metadata.get("missing", "")
    found.missing = reader.missing
    for number, channel in list(found.channels.items()):
        if channel.schema_id not in found.schemas:
            del found.channels[number]
    found.kept = sum(counts[number] for number in found.channels)
    if lost := counts.total() - found.kept:
        found.missing.append(f"{lost} messages of a topic whose description is lost")
    return found


def _write(reader: RecordReader, found: Found, digest: str, output: BinaryIO) -> None:
    """The second pass: copy what can be believed."""
    writer = Writer(output, chunk_size=CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile=reader.header.profile, library=reader.header.library)
    missing = "; ".join(filter(None, (found.earlier, *found.missing)))
    note = {"missing": missing, "source_sha256": digest, "repaired_by": f"emb-excite/{version('emb-excite')}"}
    writer.add_metadata(REPAIR, note)  # first: a file that is cut in its turn still has it
    schemas = {n: writer.register_schema(s.name, s.encoding, s.data) for n, s in sorted(found.schemas.items())}
    channels = {
        number: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
        for number, c in sorted(found.channels.items())
    }
    for record in reader.one_by_one():
        match record:
            case mcap.Message() if record.channel_id in channels:
                number = channels[record.channel_id]
                writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)
            case mcap.Metadata() if record.name != REPAIR:
                writer.add_metadata(record.name, record.metadata)
            case mcap.Attachment():
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
    writer.finish()  # type: ignore[no-untyped-call]


def _sha256(file: BinaryIO, size: int) -> str:
    """Digest of the first bytes of a file."""
    digest = hashlib.sha256()
    file.seek(0)
    while size and (block := file.read(min(size, 1 << 20))):
        digest.update(block)
        size -= len(block)
    return digest.hexdigest()
