"""A recording of others, opened by its map file: its experiment, and a bench file of the machine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomlkit

from emb_bench.config.bench import parse_bench
from emb_bench.config.plants import RECORDED_PLANT
from emb_bench.experiment.experiment import Lack
from emb_bench.experiment.from_log import Recording
from emb_bench.logs.log import Chunks
from emb_bench.recordings.map_file import RecordingMap, read_map
from emb_bench.recordings.readers import read_columns
from emb_bench.recordings.signals import Found, experiment_of
from emb_runtime.config.bench import Systematic
from emb_runtime.errors import UsageError

ACCURACY = 4e-11  # Local error of the velocity, as a share of the largest one: that of a brake at 250 rad/s
LOOSEST = 1e-8  # Largest local error [rad/s], [m/s] of a linear machine


def open_recording(path: Path, map_path: Path) -> Recording:
    """Open a recording by its map.

    Raises:
        UsageError: a file cannot be read, the map does not fit the recording, or a library is missing.
    """
    recording_map, map_text = read_map(map_path)
    kind, lacks = recording_map.kind_of(path), dict[Lack, tuple[float, ...]]()
    columns = read_columns(path, kind, recording_map.file, recording_map.places, lacks, map_path.parent)
    found = experiment_of(columns, recording_map, kind, str(path), lacks)
    text = bench_of(found, recording_map)
    try:
        parse_bench(text, f"{map_path}: the bench file made of it", analysis=True)
    except UsageError:
        if faults := found.experiment.quality.faults:  # the cause of a guess that no bench file takes
            raise UsageError(f"{map_path}: {faults[0]}") from None
        raise
    return Recording(
        path=path,
        complete=True,
        missing="",
        metadata={"emb.run": {"bench_name": recording_map.name}},
        attachments={"bench.toml": text.encode(), "map.toml": map_text.encode()},
        size=path.stat().st_size,
        span=(0, 0),
        chunks=Chunks(path, ()),
        topics={},
        experiment=found.experiment,
    )


def bench_of(found: Found, recording_map: RecordingMap) -> str:
    """Text of the bench file of a machine for analysis, from its map and its samples."""
    machine = recording_map.machine
    samples = found.experiment.all_samples
    low, high = float(np.nanmin(samples[:, 0])), float(np.nanmax(samples[:, 0]))
    speed, current = float(np.nanmax(np.abs(samples[:, 1]))), float(np.abs(found.experiment.currents).max())
    slack = 0.5 * (high - low) + 1.0
    brake = {"J": 1.0, "gamma": 1.0, "k_m": 1.0, "k_1": 0.0, "T_c": 1.0, "f_v": 1.0} | machine.parameters
    tolerance = min(LOOSEST, ACCURACY * speed) or LOOSEST  # of a machine that stands still any is right
    plant = {name: 0.0 for name in machine.unknown if name not in brake} | {"tolerance": tolerance}
    document = {
        "schema": 1,
        "name": recording_map.name,
        "machine": {
            "unknown": [*machine.unknown],
            "nuisances": [*machine.nuisances],
            "window": machine.window,
            "angle": recording_map.signals.angle.unit,
            "command": recording_map.command_unit,
        },
        "brake": brake,
        "limits": {
            "current": 2.0 * current + 1e-6,
            "angle": [min(low - slack, -1.0), max(high + slack, 1.0)],
            "velocity": 3.0 * speed + 1.0,
        },
        "noise": {"angle": found.noise[0], "velocity": found.noise[1]},
        "timing": {"sample_time": found.sample_time, "horizon": found.experiment.periods},
        "systematic": {
            name: 0.0 for name in Systematic.__dataclass_fields__ if name != "k_m"
        },  # a map says what is exact
        "plants": {
            RECORDED_PLANT: plant | ({"observer_bandwidth": found.bandwidth} if found.bandwidth else {}),
        },
    }
    return f"# A machine for the analysis of recordings: nothing is driven with it.\n{tomlkit.dumps(document)}"
