"""What is asked of every command of ours that refuses: nothing printed, and one line that says why."""

from __future__ import annotations

from collections.abc import Callable

import pytest


def refused(run: Callable[[], int], capsys: pytest.CaptureFixture[str], code: int = 2) -> str:
    """The line on the error stream with which a command refuses; ``run`` calls it, and gives its exit code."""
    capsys.readouterr()  # what was printed before
    assert run() == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err
