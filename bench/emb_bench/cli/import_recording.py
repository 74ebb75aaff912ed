"""``emb-replay import``: a recording that others made, as a log."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_runtime.errors import EXIT_DONE
from emb_runtime.system.terminal import as_json, show

HELP = "a recording of another machine (CSV, Parquet, MATLAB, MDF) as a log, by a map file"
DESCRIPTION = """\
Read a recording that was not made by emb-run, and write it as a log that fim, estimate, report and campaign read. The
map file says which column is what, in which unit, and what is known of the machine: docs/howto/recordings-of-others.md.

  csv parquet  columns by their names
  matlab       variables up to version 7; struct.field too
  mdf          channels, with their own times (ASAM MDF 3 and 4)

What the recording lacks, such as a velocity or a measured current, is said here and by every command that reads it.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("recording", type=Path, metavar="FILE", help="the recording")
    p.add_argument("--map", type=Path, required=True, metavar="FILE", help="map file")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="log to make; never overwritten")
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Import a recording; gives the exit code.

    Raises:
        UsageError: a file cannot be read or written, the map does not fit it, or a library is missing.
    """
    from emb_bench.recordings.run_file import import_recording

    found = import_recording(args.recording, args.map, args.output)
    periods, t_s = int(found.step[-1]), found.sample_time
    if args.json:
        document = {"log": str(args.output), "samples": len(found.step), "periods": periods, "sample_time": t_s}
        show(as_json({**document, "lacks": list(found.lacks)}))
        return EXIT_DONE
    show(f"{args.output}: {len(found.step)} samples, {periods * t_s:g} s at {t_s:g} s")
    for lack in found.lacks:
        show(f"  - {lack}")
    return EXIT_DONE
