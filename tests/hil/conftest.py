"""Every test in this directory needs a real ``vcan0``. Where none can be had it fails; it never skips."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence

import pytest

EMB_HIL = [sys.executable, "-m", "emb_bench.hil.cli"]

Hil = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def hil() -> Hil:
    """``hil(command, timeout=60.0, options=())``: run ``command`` through emb-hil and return what came of it."""

    def run(
        command: Sequence[str], timeout: float = 60.0, options: Sequence[str] = ()
    ) -> subprocess.CompletedProcess[str]:
        result = subprocess.run(
            ["timeout", str(timeout), *EMB_HIL, *options, "--", *command],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if result.returncode == 4 and "emb-hil: " in result.stderr:
            pytest.fail(f"no vcan0 for the hardware-in-the-loop tests: {result.stderr}")
        return result

    return run
