"""The commands of the tutorial, run as they stand there: ``python -m tools.tutorial`` writes their output anew.

A block that begins with ```` ```console ```` has commands behind ``$``, each with its output below it. They run one
after the other in one empty folder, with standard error in between as at a terminal.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from emb_runtime.system.terminal import show

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "docs" / "tutorial.md"
_BLOCK = re.compile(r"(?<=^```console\n)(.*?)(?=^```$)", re.DOTALL | re.MULTILINE)
_TIMEOUT = 300.0  # Time limit of one command [s]


def commands(page: str) -> list[str]:
    """The commands of a page, in their order."""
    return [line[2:] for block in _BLOCK.findall(page) for line in block.splitlines() if line.startswith("$ ")]


def outputs(page: str, folder: Path) -> dict[str, str]:
    """Run the commands of a page.

    Args:
        page: Markdown.
        folder: where they run; empty at first.

    Returns:
        The output of each command.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    found = {}
    for command in commands(page):
        done = subprocess.run(
            command,
            shell=True,
            cwd=folder,
            env={**os.environ, "PATH": path, "COLUMNS": "80", "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=_TIMEOUT,
            check=True,
        )
        found[command] = done.stdout
    return found


def written_anew(page: str, found: Mapping[str, str]) -> str:
    """A page with the outputs of its commands in place of those that stand there."""

    def block(match: re.Match[str]) -> str:
        return "".join(f"$ {command}\n{found[command]}" for command in commands(f"```console\n{match[0]}```\n"))

    return _BLOCK.sub(block, page)


def main() -> None:
    """Write the tutorial anew."""
    page = TUTORIAL.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        TUTORIAL.write_text(written_anew(page, outputs(page, Path(folder))), encoding="utf-8")
    show(f"{TUTORIAL.relative_to(ROOT)}: {len(commands(page))} commands")


if __name__ == "__main__":
    main()
