"""``emb-design``: the current sequence with most information about parameters that are known."""

from __future__ import annotations

import argparse
import sys
from importlib import metadata
from pathlib import Path

from emb_bench.cli.estimate import at_least
from emb_bench.design.problem import COARSE_SEARCHES, make_problem
from emb_bench.figures import ENDINGS, require_place
from emb_bench.information.criteria import NAMES, criterion
from emb_bench.report.text import show
from emb_bench.sim.plant_spec import parse_assignments, true_parameters
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.system.terminal import complain, mention

EPILOG = """\
The parameters are taken as known: this is the ruler that every excitation of an unknown brake is measured with, and no
excitation for one: on a brake that differs it leaves the limits. What is found is the best of many local optima, which
are reported.

criteria: D log det M, A tr M^-1, E smallest eigenvalue, Ds log det of what is left for --of when the others of --params
are unknown too.

exit codes:
  0    done; the design keeps the limits on the brake that it was made for
  2    usage: wrong argument, unreadable bench file, file that cannot be written, no design found
  130  Ctrl-C: nothing is written
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-design",
        description="Find the current sequence that is optimal for known parameters, under the limits of the bench.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"emb-design {metadata.version('emb-excite')}")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped one)")
    p.add_argument("--criterion", choices=NAMES, default="D", help="what is optimised (default: %(default)s)")
    p.add_argument(
        "--params", default=",".join(PARAMETER_NAMES), metavar="NAMES", help="unknown parameters (default: %(default)s)"
    )
    p.add_argument("--of", default="", metavar="NAMES", help="Ds: those of --params that are wanted")
    p.add_argument(
        "--theta",
        default="",
        metavar="name=value,...",
        help="parameters that are not the bench's nominal ones",
    )
    p.add_argument("--model", default=DEFAULT_PLANT, metavar="PLANT", help="euler, exact or a plant of the bench file")
    p.add_argument("--kind", choices=("physical", "weighted"), default="physical", help="which Fisher information")
    p.add_argument("--no-return", action="store_true", help="the brake may end anywhere within the limits")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of the random starts (default: %(default)s)")
    p.add_argument(
        "--starts", type=int, default=COARSE_SEARCHES, metavar="N", help="coarse searches (default: %(default)s)"
    )
    p.add_argument("--out", type=Path, metavar="FILE", help="where the design goes: design.npz or design.csv")
    p.add_argument("--figure", type=Path, metavar="FILE", help="where the figure goes: design.png, .pdf, .svg")
    p.add_argument("--json", action="store_true", help="print everything that is known about the design as JSON")
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-design``."""
    args = parser().parse_args(argv)
    try:
        show(_design(args))
    except EmbError as err:
        return complain("emb-design", err)
    return EXIT_DONE


def _design(args: argparse.Namespace) -> str:
    at_least({"--starts": (args.starts, 1), "--seed": (args.seed, 0)})
    bench = load_bench(args.bench)
    params = _names(args.params)
    goal = criterion(args.criterion, params, _names(args.of))
    problem = make_problem(
        bench,
        goal,
        params,
        model=args.model,
        kind=args.kind,
        brake=true_parameters(bench, parse_assignments(args.theta, "--theta: "), option="--theta: "),
        returns=not args.no_return,
    )
    try:
        from emb_bench.design.report import make_report, write
        from emb_bench.report import render, tables
    except ImportError as err:
        raise UsageError("emb-design needs scipy and numba: pip install 'emb-excite[bench]'") from err
    require_place("--out", args.out, (".npz", ".csv"))
    require_place("--figure", args.figure, ENDINGS)
    # To the error stream, because standard output is for the result alone.
    mention(f"emb-design: {args.starts} coarse searches, the best go on and are polished: a minute or two")
    report = make_report(bench, problem, goal, args.kind, starts=args.starts, seed=args.seed)
    if args.out is not None:
        write(report, args.out)
    if args.figure is not None:
        from emb_bench.design.figure import draw

        draw(report, args.figure)
    if args.json:
        return report.json()
    return render.text("design.txt.j2", d=report.metadata(), checks=tables.design_checks(report))


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


if __name__ == "__main__":
    sys.exit(main())
