"""The log of a short run, to be written in another form."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.simulated_logs import square, write_log
from tests.conftest import SimRun, Simulate

STEPS = 60


@pytest.fixture
def run(simulate: Simulate) -> SimRun:
    return simulate(square, steps=STEPS)


@pytest.fixture
def path(tmp_path: Path, run: SimRun) -> Path:
    return write_log(tmp_path / "run.mcap", run, steps=STEPS)
