"""Hostile files are refused, or read as far as they can be, and a command ends at once when it is told to."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.searches.interrupt import interrupted

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("seed", [0, 5_000_000])
def test_hostile_files_end_no_command_badly_and_take_little_time_and_memory(seed: int) -> None:
    """A part of what ``tests/searches/hostile_files.py`` does."""
    command = [sys.executable, "-m", "tests.searches.hostile_files", "--count", "40", "--seed", str(seed)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "40 files, 0 faults" in done.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("part", [0.0, 0.2, 0.5, 0.9])
def test_emb_run_ends_cleanly_at_any_moment_and_leaves_nothing(
    tmp_path: Path, part: float, number: signal.Signals
) -> None:
    """Some of the moments of ``tests/searches/interrupt.py``, which measures how long it takes, too."""
    moment = part + random.Random(f"{part} {number}").uniform(0.0, 0.3)
    ended = interrupted(tmp_path, moment, number)
    assert ended.code in (0, 3, -ended.number)  # by the signal itself while nothing was open
    assert "Traceback" not in ended.said
    assert ended.left == ()
