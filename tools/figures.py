"""Writes docs/figures.md from what its commands print: ``python -m tools.figures [TEXT ...]``.

Runs each command of the page that has one of the texts in it; all without a text, which takes a day. Lines that it
prints as ``| claim | limit | value |`` take the place of its rows, with the commit. A command that prints none fails.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

from emb_runtime.system.terminal import mention

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/figures.md"
ROW = re.compile(r"\| [^|]+ \| [^|]+ \| [^|]+ \| `([^`|]+)` \| \w+ \|")
PRINTED = re.compile(r"\| [^|]+ \| [^|]+ \| [^|]+ \|")
RUN = re.compile(r"(\w+=\w+ )*python ")  # What prints rows; the others are for people to enter


def main(texts: list[str]) -> int:
    """Run the commands and write the page after each of them; 1 if one fails or prints no row."""
    commands = dict.fromkeys(m[1] for line in PAGE.read_text("utf-8").splitlines() if (m := ROW.fullmatch(line)))
    selected = [c for c in commands if RUN.match(c) and (not texts or any(text in c for text in texts))]
    where = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    failed = not selected
    for command in selected:
        mention(command)
        done = subprocess.run(command, shell=True, cwd=ROOT, env=where, stdout=subprocess.PIPE, text=True, check=False)
        found = [line for line in done.stdout.splitlines() if PRINTED.fullmatch(line)]
        if found:
            PAGE.write_text(replaced(PAGE.read_text("utf-8"), command, found, commit.stdout.strip()), "utf-8")
        if not found or done.returncode:
            failed = True
            mention(f"  exit code {done.returncode}, {len(found)} rows")
    return int(failed)


def replaced(page: str, command: str, found: list[str], commit: str) -> str:
    """The page with these rows in place of the command's."""
    lines = page.splitlines()
    at = [n for n, line in enumerate(lines) if (m := ROW.fullmatch(line)) and m[1] == command]
    result = [line for n, line in enumerate(lines) if n not in at[1:]]
    result[at[0] : at[0] + 1] = [f"{row} `{command}` | {commit} |" for row in found]
    return "\n".join(result) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "texts", nargs="*", metavar="TEXT", help="commands that have one of these in them (default: all)"
    )
    sys.exit(main(parser.parse_args().texts))
