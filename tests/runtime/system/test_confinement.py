"""A confined process computes, and can do little else."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROGRAM = """
import json, os, socket, sys, threading
from emb_runtime.system.confinement import confine
filtered = confine(os.getppid(), 64 << 20, 1.0)
def tried(action):
    try:
        action()
    except BaseException as err:
        return type(err).__name__
    return ""
print(json.dumps({
    "filtered": filtered,
    "compute": tried(lambda: sum(range(1000))),
    "read": tried(lambda: open(sys.argv[1]).close()),
    "write": tried(lambda: open(sys.argv[1], "r+").close()),
    "make": tried(lambda: open(sys.argv[1] + ".new", "w").close()),
    "remove": tried(lambda: os.unlink(sys.argv[1])),
    "move": tried(lambda: os.rename(sys.argv[1], sys.argv[1] + ".moved")),
    "socket": tried(lambda: socket.socket()),
    "program": tried(lambda: os.execv(sys.executable, [sys.executable, "-c", ""])),
    "signal": tried(lambda: os.kill(os.getppid(), 0)),
    "memory": tried(lambda: bytearray(128 << 20)),
}), flush=True)
while True:
    pass
"""


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, Any], Path]:
    path = tmp_path_factory.mktemp("confined") / "file"
    path.write_bytes(b"there")
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(path)], capture_output=True, check=False, timeout=100)
    return done.returncode, json.loads(done.stdout), path


def test_memory_and_processor_time_are_limited(outcome: tuple[int, dict[str, Any], Path]) -> None:
    code, found, _ = outcome
    assert (found["compute"], found["read"], found["memory"]) == ("", "", "MemoryError")
    assert code == -signal.SIGKILL


def test_files_the_network_other_programs_and_signals_are_out_of_reach(
    outcome: tuple[int, dict[str, Any], Path],
) -> None:
    _, found, path = outcome
    assert found["filtered"]
    refused = ("write", "make", "remove", "move", "socket", "program", "signal")
    assert {name: found[name] for name in refused} == dict.fromkeys(refused, "PermissionError")
    assert path.read_bytes() == b"there"
    assert list(path.parent.iterdir()) == [path]


def test_it_does_not_begin_when_the_one_that_started_it_is_gone() -> None:
    code = "from emb_runtime.system.confinement import confine\nconfine(1, 1 << 20, 1.0)\nprint('here')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
