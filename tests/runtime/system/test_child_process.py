"""A process of the runtime's own, from its first moment on."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.log.recorder import LogHeader, Recorder
from emb_runtime.system.child_process import Child


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_every_process_of_a_run_does_not_end_one_that_boots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    class Struck(subprocess.Popen[bytes]):
        def __init__(self, *args: Any, **keywords: Any) -> None:
            super().__init__(*args, **keywords)
            self.send_signal(number)  # long before its interpreter can have a say

    monkeypatch.setattr(subprocess, "Popen", Struck)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    recorder = Recorder.start(tmp_path / "run.mcap", LogHeader(0, 0, True, load_layout().text, {}))
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == blocked
    assert recorder.finish({}).complete


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_process_whose_start_is_interrupted_is_left_by_nobody_although_a_thread_takes_the_signal(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """A library's thread blocks nothing, and Python then calls the handler in the main thread."""
    started: list[subprocess.Popen[bytes]] = []

    class Interrupted(subprocess.Popen[bytes]):
        def __init__(self, *args: Any, **keywords: Any) -> None:
            super().__init__(*args, **keywords)
            started.append(self)
            thread = threading.Thread(target=strike)
            thread.start()
            thread.join()

    def strike() -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
        signal.pthread_kill(threading.get_ident(), number)

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    before = signal.signal(number, interrupt)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        with pytest.raises(KeyboardInterrupt):
            Child("trial", "emb_runtime.policy.trial_process", {}, [])
        assert signal.getsignal(number) is interrupt
    finally:
        signal.signal(number, before)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == blocked
    assert [one.returncode for one in started] == [-signal.SIGKILL]


@pytest.mark.parametrize("said", ["no JSON", "[1]", "3", '"ready"', "[" * 100_000, "\xff"])
def test_what_is_no_answer_is_an_error_and_no_exception(monkeypatch: pytest.MonkeyPatch, said: str) -> None:
    class Babbling(subprocess.Popen[bytes]):
        def __init__(self, _command: list[str], **keywords: Any) -> None:
            told = f"import sys; sys.stdout.buffer.write({said!r}.encode('latin-1') + b'\\n')"
            super().__init__([sys.executable, "-c", told], **keywords)

    monkeypatch.setattr(subprocess, "Popen", Babbling)
    child = Child("trial", "none", {}, [])
    try:
        assert child.answer(60.0) == {"error": "the trial process said what is no answer"}
    finally:
        child.kill()
