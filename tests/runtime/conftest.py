"""Fixtures for tests of emb-run as a command."""

from __future__ import annotations

import os
import pty
import signal
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from emb_runtime.can.interfaces import open_transport
from emb_runtime.config.bench import Bench, shipped_bench_text
from tests.actors import constant_actor
from tests.runtime.operating import Edited, EmbRun, Keyboard, Sim


@pytest.fixture
def handlers() -> Iterator[None]:
    """main() takes the signals; the test runner wants them back."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a test runner under nohup ignores it, and main() would as well
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.fixture
def actor(tmp_path: Path, bench: Bench) -> Path:
    path = tmp_path / "actor.onnx"
    path.write_bytes(constant_actor(bench))
    return path


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recorder and trial of the policy run in this process: starting theirs takes most of a short run's time."""
    for module in ("log.recorder", "log.ring_buffer", "policy.trial"):
        monkeypatch.setattr(f"emb_runtime.{module}.HAS_CHILD_PROCESSES", False)


@pytest.fixture
def emb_run(tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str], one_process: None) -> EmbRun:
    """emb-run with an actor of constant current, and a log that need not be named."""
    return EmbRun(("--policy", str(actor)), capsys, tmp_path / "run.mcap")


@pytest.fixture
def edited(tmp_path: Path) -> Edited:
    def write(old: str, new: str) -> str:
        path = tmp_path / "edited.toml"
        assert old in shipped_bench_text()
        path.write_text(shipped_bench_text().replace(old, new))
        return str(path)

    return write


@pytest.fixture
def sim(monkeypatch: pytest.MonkeyPatch) -> Sim:
    spy = Sim()
    for module in ("experiment", "main"):
        monkeypatch.setattr(
            f"emb_runtime.cli.{module}.open_transport",
            lambda iface, bench, identifiers=None: (
                spy.open(iface.partition(":")[2], bench)
                if iface.startswith("sim")
                else open_transport(iface, bench, identifiers)
            ),
        )
    return spy


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Keyboard]:
    """A terminal as standard input, into which something is typed, at a question if there was none yet."""
    mine, theirs = pty.openpty()
    answers: list[str] = []
    questions = 0
    forget = termios.tcflush

    def asked(terminal: object, queue: int) -> None:
        nonlocal questions
        questions += 1
        forget(terminal, queue)  # type: ignore[arg-type]
        os.write(mine, "".join(answers).encode())
        answers.clear()

    def typed(text: str, before: bool = False) -> None:
        if before or questions:
            os.write(mine, text.encode())
        else:
            answers.append(text)

    with os.fdopen(theirs, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr(termios, "tcflush", asked)
        yield typed
    os.close(mine)
