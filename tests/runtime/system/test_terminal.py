"""A terminal that is not there is told, and never a traceback."""

from __future__ import annotations

import subprocess
import sys
import unicodedata

import pytest

from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import (
    LONGEST_MESSAGE,
    LONGEST_STRING,
    complain,
    escaped,
    mention,
    one_line,
    show,
)


@pytest.mark.parametrize(
    ("closed", "said"), [(">&-", "emb-replay: the result cannot be written"), (">&- 2>&-", ""), ("2>&-", "")]
)
def test_a_command_whose_output_is_closed_ends_with_its_exit_code(closed: str, said: str) -> None:
    code = (
        "from emb_runtime.errors import EmbError\n"
        "from emb_runtime.system.terminal import complain, show\n"
        "import sys\n"
        "try:\n"
        "    show('result')\n"
        "except EmbError as err:\n"
        "    sys.exit(complain('emb-replay', err))\n"
    )
    shell = ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, code]
    ran = subprocess.run(shell, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == (0 if closed == "2>&-" else 2)
    assert ran.stderr.startswith(said)
    assert "Traceback" not in ran.stderr


HOSTILE = {
    "\x1b[2J": "\\x1b[2J",
    "\x1b]52;c;QUJD\x07": "\\x1b]52;c;QUJD\\x07",
    "\x1b]8;;http://x\x1b\\y\x1b]8;;\x1b\\": "\\x1b]8;;http://x\\x1b\\y\\x1b]8;;\\x1b\\",
    "\x9b31m\x85\x90": "\\x9b31m\\x85\\x90",
    "a\rb\tc\x00\x7f\x08": "a\\rb\\tc\\x00\\x7f\\x08",
    "\u202egnp.exe\u2066\u200f\u061c": "\\u202egnp.exe\\u2066\\u200f\\u061c",
    "zero\u200bwidth\ufeff\u2028": "zero\\u200bwidth\\ufeff\\u2028",
    "\udcff\U000e0041": "\\udcff\\U000e0041",
}


@pytest.mark.parametrize("hostile", HOSTILE)
def test_nothing_that_controls_a_terminal_reaches_it(hostile: str, capsys: pytest.CaptureFixture[str]) -> None:
    show(f"a {hostile}\nb")
    mention(hostile)
    assert complain("emb-run", UsageError(f"{hostile}x")) == 2
    out, err = capsys.readouterr()
    assert out == f"a {HOSTILE[hostile]}\nb\n"
    assert err.startswith(f"{HOSTILE[hostile]}\nemb-run: ")
    assert err.isprintable() or err.replace("\n", "").isprintable()


def test_every_control_character_is_escaped_and_no_letter_is() -> None:
    for code in range(0x110000):
        character = chr(code)
        if unicodedata.category(character) in ("Cc", "Cs") or unicodedata.bidirectional(character) in DIRECTIONS:
            assert escaped(character) != character
    assert escaped("grün 30 µs, ±6 A → 10⁻³ 漢字 🚗 x̂") == "grün 30 µs, ±6 A → 10⁻³ 漢字 🚗 x̂"


DIRECTIONS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


def test_a_string_from_outside_is_one_line_and_cut() -> None:
    assert one_line("a\nb") == "a\\nb"
    assert one_line("x" * 1_000_000) == "x" * LONGEST_STRING + " … (1000000 characters)"


def test_a_message_that_repeats_a_long_name_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    complain("emb-run", UsageError("x" * 1_000_000))
    assert len(capsys.readouterr().err) < LONGEST_MESSAGE + 100


def test_colours_of_ours_are_put_on_behind_the_escaping(capsys: pytest.CaptureFixture[str]) -> None:
    show("a\x1b[31m", lambda text: f"\x1b[1m{text}\x1b[0m")
    assert capsys.readouterr().out == "\x1b[1ma\\x1b[31m\x1b[0m\n"
