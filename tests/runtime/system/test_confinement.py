"""A confined process computes, and can do little else."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROGRAM = """
import ctypes, json, os, signal, socket, sys, threading
from emb_runtime.system.confinement import confine
path, parent = sys.argv[1], os.getppid()
fd = os.open(path, os.O_RDONLY)
libc = ctypes.CDLL(None, use_errno=True)
def call(name, *arguments):
    if getattr(libc, name)(*arguments) != 0:
        raise OSError(ctypes.get_errno(), name)
filtered = confine(64 << 20, 1.0)
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
    "signal to a thread": tried(lambda: call("tgkill", parent, parent, 0)),
    "handle of a process": tried(lambda: os.pidfd_open(parent)),
    "mode": tried(lambda: os.chmod(path, 0o600)),
    "mode of an open file": tried(lambda: os.fchmod(fd, 0o600)),
    "owner": tried(lambda: os.chown(path, os.getuid(), -1)),
    "owner of an open file": tried(lambda: os.fchown(fd, os.getuid(), -1)),
    "owner of a link": tried(lambda: os.lchown(path, os.getuid(), -1)),
    "owner in a folder": tried(lambda: call("fchownat", -100, path.encode(), os.getuid(), -1, 0)),
    "times": tried(lambda: os.utime(path, (1, 1))),
    "times of an open file": tried(lambda: os.utime(fd, (1, 1))),
    "attribute": tried(lambda: os.setxattr(path, "user.one", b"1")),
    "attribute of an open file": tried(lambda: os.setxattr(fd, "user.one", b"1")),
    "attribute of a link": tried(lambda: os.setxattr(path, "user.one", b"1", follow_symlinks=False)),
    "no attribute": tried(lambda: os.removexattr(path, "user.none")),
    "no attribute of an open file": tried(lambda: os.removexattr(fd, "user.none")),
    "no attribute of a link": tried(lambda: os.removexattr(path, "user.none", follow_symlinks=False)),
    "mount": tried(lambda: call("mount", b"none", path.encode(), b"tmpfs", 0, None)),
    "memory": tried(lambda: bytearray(128 << 20)),
}), flush=True)
while True:
    pass
"""


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, Any], Path]:
    path = tmp_path_factory.mktemp("confined") / "file"
    path.write_bytes(b"there")
    path.chmod(0o644)
    os.utime(path, (1e9, 1e9))
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
    refused = set(found) - {"filtered", "compute", "read", "memory"}
    assert {name: found[name] for name in refused} == dict.fromkeys(refused, "PermissionError")
    assert path.read_bytes() == b"there"
    assert (path.stat().st_mode & 0o777, path.stat().st_mtime) == (0o644, 1e9)
    assert list(path.parent.iterdir()) == [path]


def test_it_does_not_begin_when_the_one_that_started_it_is_gone() -> None:
    code = "from emb_runtime.system.confinement import end_with\nend_with(1)\nprint('here')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
