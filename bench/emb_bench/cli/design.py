"""``emb-design``: the current sequence with most information about parameters that are known."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from emb_bench import api
from emb_bench.cli.options import add, add_output_options, given, print_answer, summary
from emb_bench.output import require_place
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError
from emb_runtime.system.terminal import Parser, complain, mention

EPILOG = """\
A design is for known parameters: it shows how good an excitation can be. Do not use it on
a brake with other parameters, which would leave its limits. The result is the best of many
local optima.

criteria: T and I are sums of -2 ln of the relative deviations that emb-replay fim expects
of an estimate, T between runs, I by repeatability; the name of a parameter is its part of
T. For ideal sensors: D log det M, A tr M^-1, E smallest eigenvalue.

example:
  emb-design -o design.csv
  emb-export design.csv -o design.onnx && emb-run --policy design.onnx

exit codes:
  0    done; the design keeps the limits on the brake that it was made for
  2    usage: wrong argument, unreadable bench file, file that cannot be written, no design found
  130  Ctrl-C: the best design so far is written, if there is one
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-design",
        description=f"{summary(api.design.__doc__)}.",
        epilog=EPILOG,
    )
    add(p, api.DesignOptions)
    p.add_argument("-o", "--output", type=Path, metavar="FILE", help="file to write: design.csv")
    add_output_options(p)
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-design``."""
    args = parser().parse_args(argv)
    try:
        return _design(args)
    except EmbError as err:
        return complain("emb-design", err)


def _design(args: argparse.Namespace) -> int:
    told = mention if args.verbose and sys.stderr is not None and not sys.stderr.isatty() else None
    require_place("--output", args.output, (".csv",))
    report = api.design(given(args, api.DesignOptions), told=told)
    if args.output is not None:
        from emb_bench.design.report import write

        write(report, args.output)
    from emb_bench.report.design import design_text

    print_answer(args, report.metadata, lambda verbose: design_text(report, str(args.output or ""), verbose=verbose))
    if report.found.interrupted:
        mention("emb-design: interrupted; this is the best design so far")
        return EXIT_INTERRUPTED
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
