"""``emb-replay import``: a recording of others as a log with ``/cycle``, a machine's bench file, and what it lacks."""

from __future__ import annotations

import argparse
import hashlib
import json
from importlib import metadata
from pathlib import Path

import numpy as np
import tomlkit

from emb_bench.config.bench import Systematic, parse_bench
from emb_bench.config.plants import IMPORTED_PLANT
from emb_bench.logs.log import IMPORT
from emb_bench.output import replacing
from emb_bench.recordings.map_file import RecordingMap, read_map
from emb_bench.recordings.readers import Recorded, read_columns, recorded
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import load_layout
from emb_runtime.errors import EXIT_DONE
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.log.ring_buffer import Attachment, LogHeader
from emb_runtime.records import CycleRecord, NodeState, RunState, RunType
from emb_runtime.system.input_file import open_regular
from emb_runtime.system.terminal import as_json, show

COUNTERS = 15  # Values of the counter that each command gets, so that a reader knows which sample it answered

HELP = "a recording of another machine (CSV, Parquet, MATLAB, MDF) as a log, by a map file"
DESCRIPTION = """\
Read a recording that was not made by emb-run, and write it as a log that fim, estimate, report and campaign read. The
map file says which column is what, in which unit, and what is known of the machine: docs/howto/recordings-of-others.md.

  csv parquet  columns by their names
  matlab       variables up to version 7; struct.field too
  mdf          channels, with their own times (ASAM MDF 3 and 4)

What the recording lacks, such as a velocity or a measured current, is said here and by every command that reads it.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("recording", type=Path, metavar="FILE", help="the recording")
    p.add_argument("--map", type=Path, required=True, metavar="FILE", help="map file")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="log to write")
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Import a recording; gives the exit code."""
    found = import_recording(args.recording, args.map, args.output)
    periods, t_s = int(found.step[-1]), found.sample_time
    if args.json:
        document = {"log": str(args.output), "samples": len(found.step), "periods": periods, "sample_time": t_s}
        show(as_json({**document, "lacks": list(found.lacks)}))
        return EXIT_DONE
    show(f"{args.output}: {len(found.step)} samples, {periods * t_s:g} s at {t_s:g} s")
    for lack in found.lacks:
        show(f"  - {lack}")
    return EXIT_DONE


def import_recording(path: Path, map_path: Path, out: Path) -> Recorded:
    """Write a recording as a log, by its map; gives what was written."""
    wanted, map_text = read_map(map_path)
    kind, timing = wanted.kind_of(path), wanted.timing
    names = [signal.column for signal in wanted.signals.given.values()] + ([timing.column] if timing.column else [])
    columns = read_columns(path, kind, wanted.file, names)
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
    """Text of the bench file of a machine for analysis, from its map and its samples."""
    machine = wanted.machine
    low, high = float(found.angle.min()), float(found.angle.max())
    speed, current = float(np.abs(found.velocity).max()), float(np.abs(found.applied).max())
    slack = 0.5 * (high - low) + 1.0
    brake = {"J": 1.0, "gamma": 1.0, "k_m": 1.0, "k_1": 0.0, "T_c": 1.0, "f_v": 1.0} | machine.parameters
    plant = {name: 0.0 for name in machine.unknown if name not in brake}
    document = {
        "schema": 1,
        "name": wanted.name,
        "machine": {
            "unknown": [*machine.unknown],
            "nuisances": [*machine.nuisances],
            "between": wanted.between,
            **({"window": machine.window} if machine.window else {}),
            **({"travel": machine.travel} if machine.travel else {}),
            "units": wanted.shown,
        },
        "brake": brake,
        "limits": {
            "current": 2.0 * current + 1e-6,
            "angle": [min(low - slack, -1.0), max(high + slack, 1.0)],
            "velocity": 3.0 * speed + 1.0,
        },
        "noise": {"angle": found.noise[0], "velocity": found.noise[1]},
        "timing": {"sample_time": found.sample_time, "horizon": int(found.step[-1])},
        "systematic": dict.fromkeys(Systematic.__dataclass_fields__, 0.0),  # what a map can say of a bench is exact
        "plants": {
            IMPORTED_PLANT: plant | ({"observer_bandwidth": found.bandwidth} if found.bandwidth else {}),
        },
    }
    return f"# A machine for the analysis of recordings: nothing is driven with it.\n{tomlkit.dumps(document)}"


def write_run(found: Recorded, name: str, texts: dict[str, str], source: dict[str, str], out: Path) -> None:
    """Write the log, with the bench file and the map as attached texts, and name and digest of the recording."""
    steps = str(int(found.step[-1]))
    header = LogHeader(
        start_ns=0,
        wall_offset_ns=0,
        simulated=False,
        dbc=load_layout().text,
        messages=load_layout().known,
        metadata={
            "emb.run": {
                "tool": f"emb-excite {metadata.version('emb-excite')}",
                "purpose": str(RunType.EXPERIMENT),
                "iface": "imported",
                "steps": steps,
                "bench_name": name,
            },
            IMPORT: {**source, "lacks": json.dumps(list(found.lacks), ensure_ascii=False)},
        },
        attachments=[Attachment(file, "application/toml", text.encode()) for file, text in texts.items()],
    )
    with replacing(out) as beside, beside.open("wb") as file:
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
