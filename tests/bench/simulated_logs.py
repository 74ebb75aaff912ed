"""Logs of simulated runs, written without a recorder process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from emb_runtime.can.messages import load_layout
from emb_runtime.cli.documents import trailer
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.log.ring_buffer import (
    Attachment,
    EventRecord,
    FrameRecord,
    LogHeader,
    Record,
)

from tests.conftest import SimRun  # isort: skip

WALL = 1_700_000_000_000_000_000


def write_log(
    path: Path, run: SimRun, *, steps: int = 500, flush_every: int = 40, begun_ns: int | None = None, **changes: Any
) -> Path:
    """Write what a run's journal holds as the recorder would.

    Args:
        path: the file to make.
        run: the run.
        steps: what the run was to have.
        flush_every: records in one chunk.
        begun_ns: time of the first record [ns since 1970]; None for one that this computer's clock moves.
        changes: entries of the header that are to be other.
    """
    records = sorted(_records(run), key=lambda item: item[0])
    wall = WALL if begun_ns is None else begun_ns - records[0][0]
    header = LogHeader(
        start_ns=records[0][0],
        wall_offset_ns=wall,
        simulated=True,
        dbc=load_layout().text,
        messages=load_layout().all_messages,
        metadata={
            "emb.run": {"steps": str(steps), "iface": "sim", "purpose": "experiment", "limit": "6.0"},
            "emb.truth": {name: str(value) for name, value in run.transport.truth.items()},
        },
        attachments=[Attachment("bench.toml", "application/toml", run.bench.text.encode())],
    )
    header = replace(header, **changes)
    with path.open("wb") as file:
        writer = LogWriter(file, header)
        for n, (time_ns, record) in enumerate(records):
            writer.write(record, wall + time_ns)
            if n % flush_every == 0:
                writer.flush()
        writer.finish({**trailer(run.outcome, {}), "dropped_records": "0"})
    return path


def _records(run: SimRun) -> Iterator[tuple[int, Record]]:
    journal = run.journal
    for frame in journal.frames:
        yield frame.time_ns, FrameRecord(frame)
    for cycle in journal.cycles:
        yield cycle.receive_time_ns, cycle
    for event in journal.events:
        yield event[0], EventRecord(*event)


def square(_angle: float, _velocity: float, step: float) -> float:
    """3 A, the other way every 25 ms: excites everything and stays far from the limits."""
    return 3.0 if step // 25 % 2 == 0 else -3.0
