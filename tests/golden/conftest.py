"""The logs that the golden pages and documents are of."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest

from emb_runtime.config.bench import shipped_bench_text

from tests.bench.simulated_logs import WALL, square, write_log  # isort: skip
from tests.conftest import SimRun, Simulate  # isort: skip

HOUR = 3_600_000_000_000  # [ns]
ROOT = Path(__file__).parents[2]
STORED = (
    "tests/compatibility/golden/rejected.mcap",
    "examples/worn.mcap",
    "examples/recording.csv",
    "examples/map.toml",
)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    """Good runs, one of another brake, one that a fault ended, one that did not move; damaged logs, and stored ones."""
    folder = tmp_path_factory.mktemp("golden")

    def fails(angle: float, velocity: float, step: float) -> float:
        return math.nan if step >= 120 else square(angle, velocity, step)

    def write(name: str, run: SimRun) -> None:
        """An hour after the one before."""
        write_log(folder / f"{name}.mcap", run, begun_ns=WALL + HOUR * len(list(folder.glob("*.mcap"))))

    write("good", simulate(square, options="plant=exact,f_v=3e-5,seed=11"))
    write("again", simulate(square, options="plant=exact,f_v=3e-5,seed=6"))
    write("third", simulate(square, options="plant=exact,f_v=3e-5,seed=7"))
    write("worn", simulate(square, options="plant=exact,f_v=3.3e-5,seed=8"))
    write("other", simulate(square, options="plant=stribeck,seed=4"))
    write("aborted", simulate(fails, options="plant=exact,seed=5"))
    write("still", simulate(lambda *_: 0.02, options="plant=exact"))
    write("noisy", simulate(square, options="plant=exact,velocity_noise=1.6,angle_noise=1.5e-3,seed=18"))
    (folder / "broken.mcap").write_bytes(b"no log at all")
    for name in STORED:
        shutil.copy(ROOT / name, folder / Path(name).name.replace("worn", "used"))
    whole = (folder / "used.mcap").read_bytes()
    middle = len(whole) // 2
    (folder / "cut.mcap").write_bytes(whole[:middle])
    (folder / "damaged.mcap").write_bytes(whole[:middle] + bytes(64) + whole[middle + 64 :])
    short = shipped_bench_text().replace("horizon     = 500", "horizon     = 50")
    (folder / "short.toml").write_text(short, encoding="utf-8")
    return folder
