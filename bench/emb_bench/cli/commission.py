"""``emb-commission``: an unknown brake, from a data sheet's ranges to a bench file, by runs of ``emb-run``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from emb_bench.config.bench import load_bench
from emb_bench.documents import to_json
from emb_runtime.can.interfaces import open_transport
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError, needs
from emb_runtime.system.terminal import Parser, complain, is_interactive, json_document, mention, show

EPILOG = """\
Each step is a run of emb-run behind shield, guard and watchdog, and uses the results of the steps before. Its policy
and log are in DIR. After an interruption the same command continues with the first step that has no completed log. The
result is the bench file DIR/bench.toml.

example:
  emb-commission new --bench data-sheet.toml --iface can0 --serial 8

exit codes:
  0    done
  2    usage: wrong argument, a file that cannot be read or written, a parameter outside the data sheet's ranges
  3    a step was stopped, or contradicts the data sheet
  4 to 8  exit code of an emb-run that failed
  130  Ctrl-C while a log was evaluated
"""


def folder(text: str) -> Path:
    """The folder of a commissioning, by its name."""
    if not text:
        raise argparse.ArgumentTypeError("expected the name of a folder, got an empty one")
    return Path(text)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-commission",
        description="Take an unknown brake into service: from a data sheet's ranges to a bench file.",
        epilog=EPILOG,
    )
    p.add_argument("folder", type=folder, metavar="DIR", help="folder for bench files, policies and logs")
    p.add_argument(
        "--bench", type=Path, metavar="FILE", help="bench file with the data sheet's ranges in the set of its shield"
    )
    p.add_argument("--iface", default="sim", metavar="NAME", help="the bus, as for emb-run (default: sim)")
    asking = p.add_mutually_exclusive_group()
    asking.add_argument("--confirm", action="store_true", help="confirm each step (default where the bus is real)")
    asking.add_argument("--yes", action="store_true", help="do not ask")
    p.add_argument("--json", action="store_true", help="print the result as JSON")
    each = p.add_argument_group("passed to each emb-run (see emb-run --help)")
    for option, value in (("--drive", "FILE@BUS"), ("--operator", "NAME"), ("--serial", "TEXT")):
        each.add_argument(option, metavar=value)
    for option in ("--no-rt", "--no-watchdog", "--long-timeouts"):
        each.add_argument(option, action="store_true")
    return p


def options(args: argparse.Namespace) -> list[str]:
    """Options of each run. On a bus that another program can be on, each one is confirmed."""
    given = [f"--{name.replace('_', '-')}" for name in ("no_rt", "no_watchdog", "long_timeouts") if getattr(args, name)]
    for name in ("drive", "operator", "serial"):
        if getattr(args, name) is not None:
            given += [f"--{name}", getattr(args, name)]
    bus = args.iface.rpartition("@")[2] if args.iface.startswith("map:") else args.iface
    in_process = bus.partition(":")[0] in ("sim", "sim-drive")
    if args.yes:
        return [*given, "--yes"]
    return [*given, "--confirm"] if args.confirm or not in_process else given


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-commission``."""
    args = parser().parse_args(argv)
    try:
        sheet = load_bench(args.bench)
        with needs("commissioning", "bench"):
            from emb_bench.commission.commissioning import Commissioning, emb_run
        each = options(args)
        open_transport(args.iface, sheet, ())[0].close()  # refuses a wrong bus before any step
        if "--confirm" in each and not is_interactive():
            raise UsageError("--confirm: expected a terminal on standard input; --yes runs without asking")
        try:
            args.folder.mkdir(parents=True, exist_ok=True)
            result = Commissioning(args.folder, sheet, args.iface, each, emb_run, mention).run()
        except OSError as err:
            where, expected = err.filename or args.folder, "expected a folder to write in, made if there is none"
            raise UsageError(f"{where}: {err.strerror}; {expected}") from err
        show(json_document(to_json({"result": "done", **vars(result)})) if args.json else str(result))
    except EmbError as err:
        return complain("emb-commission", err)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
