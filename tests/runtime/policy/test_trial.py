"""A policy file from outside is tried by a confined process, which can be ended at any moment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy import trial
from emb_runtime.policy.policy import shipped_actor_path
from emb_runtime.policy.trial import admit_policy
from emb_runtime.system.child_process import Child
from tests.actors import constant_actor
from tests.runtime.operating import refusal

BENCH = load_bench()


def children() -> set[str]:
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def test_an_honest_actor_is_admitted_and_no_process_is_left() -> None:
    before = children()
    assert admit_policy(shipped_actor_path(), BENCH).act(0.0, 0.0, 0, 0.0) == pytest.approx(
        admit_policy(shipped_actor_path().read_bytes(), BENCH).act(0.0, 0.0, 0, 0.0)
    )
    assert children() == before


def test_the_reason_of_a_refusal_is_the_one_that_the_process_found() -> None:
    before = children()
    assert "has no graph" in refusal(lambda: admit_policy(b"", BENCH))
    assert "test vector 0" in refusal(
        lambda: admit_policy(constant_actor(BENCH, 2.0).replace(b'"action": 2.0', b'"action": 1.0'), BENCH)
    )
    assert children() == before


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("while True: pass", "takes more than 2 s of processor time"),
        ("raise MemoryError", "takes more than 256 MiB of memory"),
        ("bytearray(1 << 30)", "takes more than 256 MiB of memory"),
        ("import ctypes; ctypes.string_at(0)", r"could not be tried: the trial process died \(signal 11\)"),
        ("import os; os._exit(0)", r"could not be tried: the trial process died \(exit status 0\)"),
        ("import os; os.write(1, b'x' * (1 << 21))", "could not be tried: the trial process said more than"),
    ],
)
def test_whatever_happens_to_the_process_is_a_refusal_of_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, said: str
) -> None:
    """In the place of ONNX Runtime is what a file could make of it."""
    (tmp_path / "tried.py").write_text(
        "import sys\nfrom emb_runtime.policy import policy, trial_process\n"
        f"def load_policy(data, bench):\n    {code}\n"
        "policy.load_policy = load_policy\nsys.exit(trial_process.main(sys.argv[1:]))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(trial, "PROGRAM", "tried")
    before = children()
    with pytest.raises(PolicyRefusedError, match=said) as refused:
        admit_policy(b"", BENCH)
    assert "\n" not in str(refused.value)
    assert children() == before


def test_a_process_that_cannot_be_started_is_no_fault_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "PROGRAM", "no.such.module")
    with pytest.raises(UsageError, match="cannot try the policy"):
        admit_policy(b"", BENCH)

    def full(*_: object) -> Child:
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(trial, "Child", full)
    with pytest.raises(UsageError, match="cannot start the process that tries the policy: Resource temporarily"):
        admit_policy(b"", BENCH)


def test_a_ctrl_c_ends_the_trial_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tried.py").write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(trial, "PROGRAM", "tried")
    before = children()
    pressed = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    pressed.start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        admit_policy(b"", BENCH)
    assert time.monotonic() - began < 30.0  # and not the sixty seconds
    pressed.join()
    assert children() == before


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
@pytest.mark.parametrize("option", ["--policy", "--bench"])
def test_emb_run_refuses_a_pipe_and_a_device_at_once(tmp_path: Path, option: str, make: Callable[[Path], None]) -> None:
    path = tmp_path / "given"
    make(path)
    command = [sys.executable, "-m", "emb_runtime.cli.main", option, str(path), "--log", str(tmp_path / "run.mcap")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "expected a regular file, and it is a" in done.stderr
