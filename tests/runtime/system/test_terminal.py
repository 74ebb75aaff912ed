"""A command's exit code is that of its work, whoever reads what it prints; nothing printed controls a terminal."""

from __future__ import annotations

import os
import subprocess
import sys
import unicodedata
from pathlib import Path
from typing import Any

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
    without_folders,
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
    "soft\u00adhyphen\u180e\ue000": "soft\\xadhyphen\\u180e\\ue000",
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
        unseen = unicodedata.category(character) in ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
        if unseen or unicodedata.bidirectional(character) in DIRECTIONS:
            assert escaped(character) != character
            assert escaped(character).isascii()
    assert escaped("grün 30 µs, ±6 A → 10⁻³ 漢字 🚗 x̂") == "grün 30 µs, ±6 A → 10⁻³ 漢字 🚗 x̂"


DIRECTIONS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


def test_a_string_from_outside_is_one_line_and_cut() -> None:
    assert (LONGEST_STRING, LONGEST_MESSAGE) == (2000, 1000)  # SECURITY.md
    assert one_line("a\nb") == "a\\nb"
    assert one_line("x" * 1_000_000) == "x" * LONGEST_STRING + " … (1000000 characters)"


def test_a_message_that_repeats_a_long_name_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    complain("emb-run", UsageError("x" * 1_000_000))
    assert len(capsys.readouterr().err) < LONGEST_MESSAGE + 100


def test_colours_of_ours_are_put_on_behind_the_escaping(capsys: pytest.CaptureFixture[str]) -> None:
    show("a\x1b[31m", lambda text: f"\x1b[1m{text}\x1b[0m")
    assert capsys.readouterr().out == "\x1b[1ma\\x1b[31m\x1b[0m\n"


COMMAND = """\
import argparse
from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import complain, mention, show

def main():
    mention("limits held: ±6 A, 30 µs, θ → 10⁻³")
    show("±6 A, 30 µs, θ → 10⁻³")
    return complain("command", UsageError("θ")) and 5
"""
HELP = """\
import argparse

def main():
    argparse.ArgumentParser(epilog="θ → 10⁻³ " * 2000).parse_args(["--help"])
"""


def started(folder: Path, text: str, encoding: str, **streams: Any) -> subprocess.CompletedProcess[bytes]:
    (folder / "command.py").write_text(text, encoding="utf-8")
    code = "import sys; from emb_runtime.system import entry; sys.exit(entry.run_command('command', 'interrupted'))"
    paths = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONPATH": paths}
    ran: subprocess.CompletedProcess[bytes] = subprocess.run(
        [sys.executable, "-c", code], env=environment, timeout=120, check=False, **streams
    )
    return ran


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "ascii:strict", "utf-8"])
def test_a_result_is_printed_whatever_the_encoding_of_the_output_lacks(tmp_path: Path, encoding: str) -> None:
    ran = started(tmp_path, COMMAND, encoding, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert ran.returncode == 5
    said = ran.stdout.decode(encoding.partition(":")[0])
    assert said.encode("ascii", "backslashreplace") == b"\\xb16 A, 30 \\xb5s, \\u03b8 \\u2192 10\\u207b\\xb3\n"
    assert b"Traceback" not in ran.stderr


@pytest.mark.parametrize(("text", "code"), [(COMMAND, 5), (HELP, 0)])
def test_a_reader_that_has_had_enough_does_not_change_the_exit_code(tmp_path: Path, text: str, code: int) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ran = started(tmp_path, text, "ascii", stdout=writing, stderr=writing)
    finally:
        os.close(writing)
    assert ran.returncode == code


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("/home/ann/run.mcap", "run.mcap"),
        ("/home/ann/runs/", "runs/"),
        ("--log=/home/ann b/run.mcap", "--log=run.mcap"),
        ("map:/home/ann/vesc.toml@sim:seed=2", "map:vesc.toml@sim:seed=2"),
        ("C:\\Users\\Ann\\run.mcap", "run.mcap"),
        ("runs/run.mcap", "runs/run.mcap"),
        ("sim:plant=exact,seed=1", "sim:plant=exact,seed=1"),
        ("8/15", "8/15"),
        ("/", "/"),
        ("", ""),
    ],
)
def test_an_argument_is_told_without_folders_of_its_user(typed: str, told: str) -> None:
    assert without_folders(typed) == told
