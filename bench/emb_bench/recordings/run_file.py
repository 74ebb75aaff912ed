"""An imported recording as a log: an MCAP file with ``/cycle``, the machine's bench file, and what it lacks."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import metadata
from pathlib import Path

import numpy as np

from emb_bench.config.bench import Systematic, parse_bench
from emb_bench.config.plants import IMPORTED_PLANT
from emb_bench.logs.log import IMPORT
from emb_bench.output import new_file
from emb_bench.recordings.map_file import RecordingMap, read_map
from emb_bench.recordings.readers import Recorded, read_columns, recorded
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.records import CycleRecord, NodeState, RunState, RunType
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


def bench_text(
    wanted: RecordingMap,
    sample_time: float,
    horizon: int,
    noise: tuple[float, float],
    reach: tuple[float, float, float, float],
    bandwidth: float,
) -> str:
    """Text of the bench file.

    Args:
        wanted: the map.
        sample_time: [s].
        horizon: periods.
        noise: standard deviations of angle [rad] and velocity [rad/s].
        reach: lowest and highest angle [rad], largest speed [rad/s], largest current [A].
        bandwidth: of the observer that made the velocity [rad/s]; 0 if it was measured.
    """
    low, high, speed, current = reach
    slack = 0.5 * (high - low) + 1.0
    machine = wanted.machine
    own = {"J": 1.0, "gamma": 1.0, "k_m": 1.0, "k_1": 0.0, "T_c": 1.0, "f_v": 1.0} | machine.parameters
    by_direction = [name for name in machine.unknown if name not in own]
    lines = [
        "# A machine for the analysis of recordings: nothing is driven with it.",
        "schema = 1",
        f"name = {_text(wanted.name)}",
        "",
        "[machine]",
        f"unknown = {_list(machine.unknown)}",
        f"nuisances = {_list(machine.nuisances)}",
        *([f"window = {machine.window!r}  # s"] if machine.window else []),
        f"between = {_text(wanted.between)}",
        *([f"travel = {machine.travel!r}  # m/rad"] if machine.travel else []),
        "",
        "[machine.units]",
        *(f"{key} = {_text(unit)}" for key, unit in wanted.shown.items()),
        "",
        "[brake]",
        *(f"{key} = {own[key]!r}" for key in ("J", "gamma", *PARAMETER_NAMES)),
        "",
        "[limits]",
        f"current = {2.0 * current + 1e-6!r}",
        f"angle = [{min(low - slack, -1.0)!r}, {max(high + slack, 1.0)!r}]",
        f"velocity = {3.0 * speed + 1.0!r}",
        "",
        "[noise]",
        f"angle = {noise[0]!r}",
        f"velocity = {noise[1]!r}",
        "",
        "[timing]",
        f"sample_time = {sample_time!r}",
        f"horizon = {horizon}",
        "",
        "[systematic]  # what a map can say of a bench is exact",
        *(f"{key} = 0.0" for key in Systematic.__dataclass_fields__),
        "",
        f"[plants.{IMPORTED_PLANT}]",
        *([f"observer_bandwidth = {bandwidth!r}"] if bandwidth else []),
        *(f"{key} = 0.0" for key in by_direction),
    ]
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)  # a JSON string of printable characters is a TOML string


def _list(values: tuple[str, ...]) -> str:
    return json.dumps(list(values))
