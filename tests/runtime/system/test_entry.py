"""A command's exit code is that of its work, whoever reads what it prints."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

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
    code = "import sys; from emb_runtime.system.entry import start; sys.exit(start('command', 'interrupted'))"
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
