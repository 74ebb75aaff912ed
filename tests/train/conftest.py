"""A finished training, for whoever looks at one."""

from __future__ import annotations

from pathlib import Path

import pytest

from emb_train.cli import main
from tests.train.trainings import make_tiny, short_bench


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished training; not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        bench = short_bench(folder)
        assert main(["ppo", "single-viscous", "--bench", str(bench), "--output", str(folder / "run")]) == 0
    return folder / "run"
