"""Commands on a recording of others: they work, or say in one line what it lacks; the page has the same table."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from emb_bench.cli.replay import main

WORKS: dict[str, tuple[str, ...]] = {
    "fim": ("fim",),
    "estimate": ("estimate", "--starts", "1"),
    "estimate --method pem": ("estimate", "--method", "pem", "--starts", "1"),
    "report": ("report", "--starts", "1", "-o", "OUT.html"),
}
LACKS: dict[str, tuple[tuple[str, ...], str]] = {
    "estimate --method rls": (("estimate", "--method", "rls"), "another method does"),
    "estimate --model all": (("estimate", "--model", "all"), "expected --method oem"),
    "estimate --params k_1": (("estimate", "--params", "k_1"), "zero in this bench"),
}


def called(words: tuple[str, ...], recording: tuple[str, ...], folder: Path) -> int:
    command, *options = words
    return main([command, *recording, *(option.replace("OUT", str(folder / "out")) for option in options)])


class Saying(NamedTuple):
    """What a command printed, and where it has written."""

    out: str
    folder: Path


Say = Callable[[str], Saying]


@pytest.fixture(scope="module")
def say(recording: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> Say:
    """Calls a command that works, once."""

    @cache
    def of(name: str) -> Saying:
        folder = tmp_path_factory.mktemp("said")
        with contextlib.redirect_stdout(io.StringIO()) as out:
            assert called(WORKS[name], recording, folder) in (0, 1)
        return Saying(out.getvalue(), folder)

    return of


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n == "estimate --method pem" else n for n in WORKS]
)
def test_a_command_works_and_says_nothing_of_a_loop(name: str, say: Say) -> None:
    for nonsense in ("missed", "unanswered", "returning home", "braked by the node", "nan", "sensor to command"):
        assert nonsense not in say(name).out


def test_an_estimate_prints_a_linear_machine_in_kilograms_and_newtons(say: Say) -> None:
    said = say("estimate").out
    for label, unit in (("mass", "kg"), ("F_c", "N"), ("F_v", "N·s/m")):
        line = next(line for line in said.splitlines() if line.startswith(f"{label} "))
        assert f" {unit} " in line
    for foreign in ("kg·m²", "N·m ", "rad ", "T_c", "f_v", "stiffness", "hysteresis"):
        assert foreign not in said
    assert "which their ratios do not need" in " ".join(said.split())


def test_the_report_shows_the_machine_and_nothing_of_a_loop_or_a_limit(say: Say) -> None:
    page = (say("report").folder / "out.html").read_text(encoding="utf-8")
    for own in ("mass", "N·s/m", "Force that acted over time", "Residuals of angle over time"):
        assert own in page
    assert "residuals of the velocity" not in page  # which the recording does not have
    for foreign in ("kg·m²", "shield", "the node", 'id="safety"', 'id="timing"', "rad/s, limit"):
        assert foreign not in page


@pytest.mark.parametrize("name", LACKS)
def test_a_command_says_in_one_line_what_it_lacks(
    name: str, recording: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = LACKS[name]
    capsys.readouterr()
    assert called(words, recording, tmp_path) == 2
    said = capsys.readouterr().err.strip()
    assert expected in said
    assert "\n" not in said


def test_the_page_has_every_case() -> None:
    page = (Path(__file__).parents[3] / "docs/howto/recordings-of-others.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for name in (*WORKS, *LACKS):
        assert any(f"`{name}`" in row for row in rows), name
