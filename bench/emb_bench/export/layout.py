"""``emb-replay layout``: a layout of our topics for Foxglove and Lichtblick."""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

from emb_bench.output import new_file
from emb_runtime.errors import EXIT_DONE
from emb_runtime.system.terminal import as_json, show


def layout_text() -> str:
    """The layout, JSON as Lichtblick and Foxglove import it."""
    return files("emb_bench.export").joinpath("layout.json").read_text("utf-8")


HELP = "a layout for Foxglove and Lichtblick"
DESCRIPTION = (
    "Write a layout of a run: angle, velocity, currents, timing, states, safety events, lines of text. "
    "Import it in Foxglove or Lichtblick, then open a log."
)


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="file to make; never overwritten")
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Write the layout; returns the exit code.

    Raises:
        UsageError: the file exists or cannot be written.
    """
    with new_file(args.out) as file:
        file.write(layout_text().encode())
    show(as_json({"file": str(args.out)}) if args.json else f"{args.out}: import it in Foxglove or Lichtblick")
    return EXIT_DONE
