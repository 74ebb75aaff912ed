"""A process of the runtime's own: its answers, and the limits of one that handles what nobody vouches for."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
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
