from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import pytest

from emb_bench.config.bench import Bench
from emb_bench.experiment.from_log import UNKNOWN, control_cycles, samples_before
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.can.messages import Layout
from emb_runtime.can.receiver import Reception
from emb_runtime.records import RunState, SensorSample

from tests.bench.hostile import HostileBus, drive, write_trace  # isort: skip

STEPS = 300
BUSES: dict[str, dict[str, Any]] = {
    "quiet": {},
    "lossy": {"lost": 0.02},
    "noisy": {"damaged": 0.02},
    "slow": {"slow": 0.1},
    "all at once": {"lost": 0.01, "damaged": 0.01, "slow": 0.05},
}


def law(_angle: float, _velocity: float, step: float) -> float:
    return 1.5 + math.sin(0.3 * step)


def taken(log: RunLog, layout: Layout, bench: Bench) -> list[SensorSample]:
    """All samples that the runtime's reception takes from the frames in a log."""
    reception = Reception(layout, bench, lambda _frame, _why: None)
    return [sample for frame in log.frames if (sample := reception.take(frame)) is not None]


@pytest.mark.parametrize("bus", BUSES)
@pytest.mark.parametrize("batch", [1, 4 << 20])
def test_the_samples_are_those_that_the_run_took_from_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench, layout: Layout, bus: str, batch: int
) -> None:
    monkeypatch.setattr("emb_bench.logs.log.BATCH", batch)
    run = drive(HostileBus(bench, layout, random.Random(len(bus)), **BUSES[bus]), law, STEPS)
    path = tmp_path / "run.mcap"
    write_trace(path, run.journal.records, bench, layout, run.outcome, steps=STEPS, flush_every=150)
    log = read_log(path)
    every = taken(log, layout, bench)
    first = next(cycle for cycle in run.journal.cycles if cycle.state == RunState.ACTIVE)
    begin = next(n for n, sample in enumerate(every) if sample.device_time_ns == first.device_time_ns)
    rows = [
        row
        for step, samples in control_cycles(log, bench, STEPS)
        for row in zip(*(column.tolist() for column in (step, *samples)), strict=True)
    ]
    assert rows
    assert UNKNOWN not in [row[7] for row in rows]
    t_s = bench.timing.sample_time_ns
    assert [(*row[1:3], row[4], row[7]) for row in rows] == [
        (s.angle, s.velocity, s.applied_current, s.command_counter) for s in every[begin : begin + len(rows)]
    ]
    assert [row[3] for row in rows] == [
        (s.device_time_ns - first.device_time_ns - row[0] * t_s) * 1e-9
        for s, row in zip(every[begin : begin + len(rows)], rows, strict=True)
    ]
    before = samples_before(log, bench, 50)
    expected = every[: begin + 1][-50:]
    assert [(s.angle, s.velocity, s.node_state) for s in before] == [
        (s.angle, s.velocity, s.node_state) for s in expected
    ]
