"""Idle states of the processor are held off as long as the process lives, where the kernel lets it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

OBTAIN_TWICE = """
import sys
from pathlib import Path
from emb_runtime.system import realtime
realtime.WAKE_UP_LATENCY = sys.argv[1]
for _ in range(2):
    print(realtime.obtain()["idle_states"])
links = [link for link in Path("/proc/self/fd").iterdir() if link.exists()]
print(sum(str(link.readlink()) in (sys.argv[1], "/dev/full") for link in links))
"""


@pytest.mark.parametrize(
    ("make", "obtained", "left_open"),
    [
        (Path.touch, "none that takes time to leave", 1),
        (lambda device: None, "not managed by this kernel", 0),
        (Path.mkdir, "not obtained: {device}: Is a directory", 0),
        (lambda device: device.symlink_to("/dev/full"), "not obtained: {device}: No space left on device", 0),
    ],
    ids=["a device", "none", "it cannot be opened", "it refuses the value"],
)
def test_no_latency_is_asked_for_once_for_the_life_of_the_process(
    make: Callable[[Path], None], obtained: str, left_open: int, tmp_path: Path
) -> None:
    """In a process of its own, which its scheduling and memory may belong to."""
    device = tmp_path / "cpu_dma_latency"
    make(device)
    done = subprocess.run([sys.executable, "-c", OBTAIN_TWICE, str(device)], capture_output=True, text=True, check=True)
    line = obtained.format(device=device)
    assert done.stdout.splitlines() == [line, line, str(left_open)]
    assert not left_open or device.read_bytes() == bytes(4)
