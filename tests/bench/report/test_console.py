"""Colours of verdicts on a terminal."""

from __future__ import annotations

import io

import pytest

from emb_bench.report.text import show

TEXT = "WARNING: THE MODEL 'x' DOES NOT FIT.\n  k_m  1 ± 2 N·m/A  yes\n  f_v  3; NOT identified: [b]flat[/b]"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("no_color", ["", "1"])
def test_a_terminal_shows_verdicts_in_colour_unless_it_is_asked_not_to(
    monkeypatch: pytest.MonkeyPatch, no_color: str
) -> None:
    out = Terminal()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setenv("TERM", "xterm-256color")
    show(TEXT)
    shown = out.getvalue()
    assert ("\x1b[1;31mWARNING: THE MODEL" in shown, "\x1b[32myes" in shown) == (not no_color, not no_color)
    assert "[b]flat[/b]" in shown


def test_everywhere_else_it_is_plain(capsys: pytest.CaptureFixture[str]) -> None:
    show(TEXT)
    assert capsys.readouterr().out == f"{TEXT}\n"
