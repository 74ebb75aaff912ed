"""``emb-replay export``: a topic of a log as a table, or a picture of the run."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_bench.export.picture import ENDINGS, draw_run
from emb_bench.export.tables import write_csv, write_parquet
from emb_bench.logs.log import read_log
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.terminal import as_json, show

TABLES = {"csv": write_csv, "parquet": write_parquet}  # Formats of one topic as a table
FORMATS = (*TABLES, "plot")
CYCLE = "/cycle"

HELP = "a topic of the log as CSV or Parquet, or a picture of the run"
DESCRIPTION = """\
Write a part of a log for another tool.

  csv parquet  one topic as a table, with units: the control cycles, or --topic
  plot         a picture of the run, PNG, SVG or PDF by the ending of FILE

FILE ends as its format is called. The frames on the bus go to BLF, ASC and others by can_logconvert LOG FILE.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--to", choices=FORMATS, required=True, help="what to write")
    p.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="file to make; never overwritten")
    p.add_argument("--topic", metavar="TOPIC", help=f"for {' and '.join(TABLES)}: which one (default: {CYCLE})")
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Export a log; returns the exit code.

    Raises:
        UsageError: a wrong argument, a file that cannot be read or written, or a missing extra.
        LogError: it is no log, or too damaged.
    """
    if args.topic is not None and args.to not in TABLES:
        raise UsageError(f"--topic: expected with --to {' or '.join(TABLES)}, got it with --to {args.to}")
    endings = ENDINGS if args.to == "plot" else (f".{args.to}",)
    if args.out.suffix.lower() not in endings:
        raise UsageError(f"{args.out}: expected a file that ends in {', '.join(endings)} with --to {args.to}")
    log = read_log(args.log)
    written = draw_run(log, args.out) if args.to == "plot" else TABLES[args.to](log, args.topic or CYCLE, args.out)
    if args.json:
        show(as_json({"log": str(args.log), "file": str(args.out), "holds": written, "missing": log.missing}))
    else:
        show("\n".join([f"WARNING: {log.missing}"] * bool(log.missing) + [f"{args.out}: {written}"]))
    return EXIT_DONE
