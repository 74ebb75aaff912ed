"""A process of the runtime's own, from its first moment on."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.log.recorder import LogHeader, Recorder


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
