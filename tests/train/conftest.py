"""Finished trainings, for whoever looks at one."""

from __future__ import annotations

from pathlib import Path

import pytest

from emb_train.cli import main
from tests.train.trainings import make_tiny, short_bench


def trained(preset: str, folder: Path) -> Path:
    """A training in a new folder."""
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        bench = short_bench(folder)
        assert main(["ppo", preset, "--bench", str(bench), "--output", str(folder / "run")]) == 0
    return folder / "run"


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished training for a current; not to be changed."""
    return trained("single-viscous", tmp_path_factory.mktemp("finished"))


@pytest.fixture(scope="session")
def finished_speeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished training for speeds; not to be changed."""
    return trained("interval", tmp_path_factory.mktemp("speeds"))
