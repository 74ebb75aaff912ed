"""A process of the runtime's own."""

from __future__ import annotations

import subprocess
import sys
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
        child = Child("trial", "none", {}, [])
        try:
            assert child.answer(60.0) == {"error": "the trial process said what is no answer"}
        finally:
            child.kill()
