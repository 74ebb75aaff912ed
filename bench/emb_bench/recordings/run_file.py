"""An imported recording as a log: an MCAP file with ``/cycle``, the machine's bench file, and what it lacks."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import metadata
from pathlib import Path

import numpy as np

from emb_bench.logs.log import IMPORT
from emb_bench.output import new_file
from emb_bench.recordings.bench_text import bench_text
from emb_bench.recordings.map_file import RecordingMap, read_map
from emb_bench.recordings.readers import read_columns
from emb_bench.recordings.samples import Recorded, recorded
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import parse_bench
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.records import CycleRecord, NodeState, RunState
from emb_runtime.run_type import RunType
from emb_runtime.system.input_file import open_regular

COUNTERS = 15  # Values of the counter that each command gets, so that a reader knows which sample it answered


def import_recording(path: Path, map_path: Path, out: Path) -> Recorded:
    """Writes a recording as a log.

    Args:
        path: the recording.
        map_path: its map.
        out: log to make; never overwritten.

    Returns:
        What was written.

    Raises:
        UsageError: a file cannot be read or written, or the map does not fit the recording.
    """
    wanted, map_text = read_map(map_path)
    kind, timing = wanted.kind_of(path), wanted.timing
    names = [signal.column for signal in wanted.signals.given.values()] + ([timing.column] if timing.column else [])
    columns = read_columns(path, kind, wanted.file, map_path.parent, names)
    found = recorded(columns, wanted, kind, str(path))
    text = bench_of(found, wanted)
    parse_bench(text, f"{map_path}: the bench file made of it", analysis=True)
    with open_regular(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    write_run(
        found, wanted.name, {"bench.toml": text, "map.toml": map_text}, {"file": path.name, "sha256": digest}, out
    )
    return found


def bench_of(found: Recorded, wanted: RecordingMap) -> str:
    """Text of the machine's bench file."""
    reach = (
        float(found.angle.min()),
        float(found.angle.max()),
        float(np.abs(found.velocity).max()),
        float(np.abs(found.applied).max()),
    )
    return bench_text(wanted, found.sample_time, int(found.step[-1]), found.noise, reach, found.bandwidth)


def write_run(found: Recorded, name: str, texts: dict[str, str], source: dict[str, str], out: Path) -> None:
    """Writes the log.

    Args:
        found: the samples.
        name: of the recording.
        texts: the bench file and the map, by file name.
        source: name and digest of the recording.
        out: log to make.

    Raises:
        UsageError: it exists, or cannot be written.
    """
    steps = str(int(found.step[-1]))
    header = {
        "dbc": load_layout().text,
        "wall_offset_ns": 0,
        "start_ns": 0,
        "estimates": [],
        "metadata": {
            "emb.run": {
                "tool": f"emb-excite {metadata.version('emb-excite')}",
                "purpose": str(RunType.EXPERIMENT),
                "iface": "imported",
                "steps": steps,
                "bench_name": name,
            },
            IMPORT: {**source, "lacks": json.dumps(list(found.lacks), ensure_ascii=False)},
        },
        "attachments": [(file, "application/toml", base64.b64encode(text.encode())) for file, text in texts.items()],
    }
    with new_file(out) as file:
        writer = LogWriter(file, header)
        for record in _cycles(found):
            writer.write(record, record.receive_time_ns)
        writer.finish({"exit_reason": "DONE", "dropped_records": "0"})


def _cycles(found: Recorded) -> list[CycleRecord]:
    """One record for each sample; what the recording does not know is NaN or 0."""
    columns = (found.step, found.time, found.angle, found.velocity, found.applied, found.commanded)
    cycles = []
    for step, time, angle, velocity, applied, commanded in zip(*(c.tolist() for c in columns), strict=True):
        time_ns, known = round(time * 1e9), commanded == commanded
        cycles.append(
            CycleRecord(
                step=step,
                state=RunState.ACTIVE,
                reasons=0,
                counter=step % COUNTERS,
                command_counter=step % COUNTERS if known else NO_COUNTER,
                missed=0,
                node_state=NodeState.ACTIVE,
                angle=angle,
                velocity=velocity,
                applied_current=applied,
                policy_current=commanded,
                clipped_current=commanded,
                sent_current=commanded,
                device_time_ns=time_ns,
                receive_time_ns=time_ns,
                wake_time_ns=time_ns,
                decide_time_ns=time_ns,
                send_time_ns=time_ns if known else 0,
            )
        )
    return cycles
