"""Hostile files are refused, or read as far as they can be, and a command ends at once when it is told to."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from tests.searches.interrupt import interrupted

ROOT = Path(__file__).parents[2]


def test_hostile_files_end_no_command_badly_and_take_little_time_and_memory(tmp_path: Path) -> None:
    """Five of ``tests/searches/broken_files.py``, of which 2,000 are played at night, in a process with no more memory.

    What it damages of logs is in ``tests/bench/logs/test_damaged_logs.py``.
    """
    code = (
        "import sys; from pathlib import Path; from tests.searches.broken_files import hostile\n"
        "sys.exit(hostile(Path(sys.argv[1]), range(5_000_000, 5_000_005)))"
    )
    command = [sys.executable, "-W", "ignore", "-c", code, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| 0 of 5; " in done.stdout


def test_emb_run_ends_cleanly_at_any_moment_and_leaves_nothing() -> None:
    """Some of the moments of ``tests/searches/interrupt.py``, which measures how long it takes, too."""
    for moment, number in ((0.4, signal.SIGTERM), (0.7, signal.SIGINT)):
        ended = interrupted("emb-run", moment, number)
        assert ended.code in (0, 3, -ended.number), ended  # by the signal itself while nothing was open
        assert "Traceback" not in ended.said
        assert ended.left == {}
