"""What most tests of the bench share: a command of emb-replay with its output, and the log of a simulated run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from emb_bench.cli.replay import main
from emb_bench.config.bench import Bench

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.benches import SENSOR_BENCH  # isort: skip
from tests.conftest import SimRun, Simulate, simulating  # isort: skip

Log = Callable[..., Path]


@dataclass(frozen=True)
class Replay:
    """``emb-replay`` in this process; each call checks exit code and streams."""

    capsys: pytest.CaptureFixture[str]

    def text(self, *arguments: str | Path, code: int = 0) -> str:
        """What it prints; nothing may stand on the error stream."""
        out, err = self._run(arguments, code)
        assert err == ""
        return out

    def document(self, *arguments: str | Path, code: int = 0) -> dict[str, Any]:
        """What it prints with ``--json``."""

        def refuse(name: str) -> None:
            raise ValueError(f"{name} is no JSON")

        found: dict[str, Any] = json.loads(self.text(*arguments, "--json", code=code), parse_constant=refuse)
        return found

    def refused(self, *arguments: str | Path, code: int = 2) -> str:
        """The one line with which it says no."""
        out, err = self._run(arguments, code)
        assert out == ""
        assert err.startswith("emb-replay: ")
        assert err.count("\n") == 1
        return err

    def _run(self, arguments: tuple[str | Path, ...], code: int) -> tuple[str, str]:
        self.capsys.readouterr()  # what fixtures printed
        assert main([*map(str, arguments)]) == code
        return self.capsys.readouterr()


@pytest.fixture(scope="session")
def bench() -> Bench:
    """One whose velocity is measured: with an observer, a record has its angles alone."""
    return SENSOR_BENCH


@pytest.fixture(scope="session")
def simulate(bench: Bench) -> Simulate:
    return simulating(bench)


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]) -> Replay:
    return Replay(capsys)


@pytest.fixture
def log(tmp_path: Path, simulate: Simulate) -> Log:
    """Writes the log of a run of ``square`` on the simulated bench."""

    def write(name: str, options: str = "", **run: Any) -> Path:
        return write_log(tmp_path / name, simulate(square, options=options, **run))

    return write


STEPS = 60


@pytest.fixture
def run(simulate: Simulate) -> SimRun:
    """A short one."""
    return simulate(square, steps=STEPS, options="f_v=3e-5,seed=7")


@pytest.fixture
def path(tmp_path: Path, run: SimRun) -> Path:
    """Its log."""
    return write_log(tmp_path / "run.mcap", run, steps=STEPS)
