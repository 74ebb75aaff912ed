"""The rest of a cut or damaged log as a finished file that any viewer opens."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap import records as mcap
from mcap.writer import CompressionType, Writer

from emb_bench.logs.log import REPAIR
from emb_bench.logs.mcap_file import McapFile
from emb_bench.output import replacing
from emb_runtime.errors import LogError, UsageError
from emb_runtime.log.recorder_process import CHUNK
from emb_runtime.system.input_file import open_regular


class Repaired(NamedTuple):
    """Content of a damaged log that was written anew."""

    missing: tuple[str, ...]  # Descriptions of the missing parts
    kept: int  # Messages that are saved


def repair(source: Path, target: Path) -> Repaired | None:
    """Write what is left of a log as a finished one, in two passes, chunk by chunk.

    Returns None if the log is whole, and nothing was written.
    """
    try:
        with open_regular(source) as file:
            size = os.fstat(file.fileno()).st_size  # a log that is being recorded grows between the passes
            whole, counts = McapFile(source, file, size), Counter[int]()
            for _, _, chunk in whole.chunks():
                counts.update(chunk.headers["channel"].tolist())
            # The copy of a description in the summary will do if it is lost with the first chunk.
            described = {n: c for n, c in whole.channels.items() if c.schema_id in whole.schemas}
            kept = sum(counts[number] for number in described)
            if lost := counts.total() - kept:
                whole.name_missing(f"{lost} messages of a topic whose description is lost")
            if not whole.missing:
                return None
            if not kept:
                raise LogError(f"{source}: not one message is left in this log: {'; '.join(whole.missing)}")
            note = {
                "missing": "; ".join(filter(None, (whole.metadata.get(REPAIR, {}).get("missing"), *whole.missing))),
                "source_sha256": _sha256(file, size),
                "repaired_by": f"emb-excite/{version('emb-excite')}",
            }
            with replacing(target) as beside, beside.open("wb") as output:
                _write(McapFile(source, file, size), whole, described, note, output)
    except OSError as err:
        raise UsageError(f"{source}: cannot read the log: {err.strerror}") from err
    return Repaired(tuple(whole.missing), kept)


def _write(
    again: McapFile, whole: McapFile, described: dict[int, mcap.Channel], note: dict[str, str], output: BinaryIO
) -> None:
    """Copy what can be trusted: ``again`` is read, ``whole`` has been."""
    writer = Writer(output, chunk_size=CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile=whole.header.profile, library=whole.header.library)
    writer.add_metadata(REPAIR, note)  # first: a file that is cut in its turn still has it
    for name, metadata in whole.metadata.items():
        if name != REPAIR:
            writer.add_metadata(name, metadata)
    for a in whole.attachments.values():
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
    schemas = {n: writer.register_schema(s.name, s.encoding, s.data) for n, s in sorted(whole.schemas.items())}
    channels = {
        number: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
        for number, c in sorted(described.items())
    }
    for _, _, chunk in again.chunks():
        for message in chunk.messages():
            if (number := channels.get(message.channel_id)) is not None:
                writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()  # type: ignore[no-untyped-call]


def _sha256(file: BinaryIO, size: int) -> str:
    """Digest of the first bytes of a file."""
    digest = hashlib.sha256()
    file.seek(0)
    while size and (block := file.read(min(size, 1 << 20))):
        digest.update(block)
        size -= len(block)
    return digest.hexdigest()
