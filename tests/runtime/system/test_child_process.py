"""A process of the runtime's own: its answers, the limits of one that handles what nobody vouches for, real time."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.system.child_process import Child


def test_what_is_no_answer_is_an_error_and_no_exception(monkeypatch: pytest.MonkeyPatch) -> None:
    started = subprocess.Popen
    for said in ("no JSON", "[1]", "3", '"ready"', "[" * 100_000, "\xff"):
        told = f"import sys; sys.stdout.buffer.write({said!r}.encode('latin-1') + b'\\n')"

        def babbling(_command: list[str], told: str = told, **keywords: Any) -> subprocess.Popen[bytes]:
            return started([sys.executable, "-c", told], **keywords)

        monkeypatch.setattr(subprocess, "Popen", babbling)
        with pytest.raises(ChildProcessError, match="the trial process wrote what is no answer"):
            Child("trial", "none", {}, 60.0)


PROGRAM = """
import json, signal, sys
from emb_runtime.system.child_process import confine
confine(64 << 20, 1.0)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
def tried(action):
    try:
        action()
    except BaseException as err:
        return type(err).__name__
    return ""
def written():
    with open(sys.argv[1], "wb", buffering=0) as file:
        file.write(b"x")
print(json.dumps([tried(lambda: sum(range(1000))), tried(lambda: bytearray(128 << 20)), tried(written)]), flush=True)
while True:
    pass
"""


def test_memory_processor_time_and_files_are_limited(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, check=False, timeout=100)
    assert json.loads(done.stdout) == ["", "MemoryError", "OSError"]
    assert done.returncode == -signal.SIGKILL


def test_it_does_not_begin_when_the_one_that_started_it_is_gone() -> None:
    code = "from emb_runtime.system.child_process import end_with\nend_with(1)\nprint('here')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")


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
