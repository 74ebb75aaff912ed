"""``emb-replay export``: a log in the formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_bench.export.picture import ENDINGS, draw_run
from emb_bench.export.tables import write_csv, write_mf4, write_parquet
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.terminal import as_json, show

FRAMES = ("blf", "asc", "log")  # Formats of the frames on the bus
TABLES = ("csv", "parquet")  # Formats of one topic as a table
FORMATS = (*FRAMES, *TABLES, "mf4", "plot")
CYCLE = "/cycle"

HELP = "the log as BLF, ASC, candump, CSV, Parquet, MDF 4 or a picture"
DESCRIPTION = """\
Write a log in the format of another tool.

  blf asc log  every frame on the bus (Vector BLF and ASC, candump), received and sent
  csv parquet  one topic as a table, units in the head: the control cycles, or --topic
  mf4          every topic as a channel group (ASAM MDF 4.10), and the CAN frames as a bus log; time in seconds
  plot         a picture of the run, PNG, SVG or PDF by the ending of FILE

FILE ends as its format is called.
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
    if args.to in FRAMES:
        from emb_bench.export.frames import write_frames  # python-can takes its time to import

        written, missing = write_frames(args.log, args.to, args.out)
    else:
        log = read_log(args.log)
        written, missing = _write(log, args), log.missing
    if args.json:
        show(as_json({"log": str(args.log), "file": str(args.out), "holds": written, "missing": missing}))
    else:
        show("\n".join([f"WARNING: {missing}"] * bool(missing) + [f"{args.out}: {written}"]))
    return EXIT_DONE


def _write(log: RunLog, args: argparse.Namespace) -> str:
    match args.to:
        case "csv":
            return write_csv(log, args.topic or CYCLE, args.out)
        case "parquet":
            return write_parquet(log, args.topic or CYCLE, args.out)
        case "mf4":
            return write_mf4(log, args.out)
        case _:
            return draw_run(log, args.out)
