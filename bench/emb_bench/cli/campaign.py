"""``emb-replay campaign``: many logs, one row each."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from emb_bench.batch.distribute import Evaluate, in_processes, on_ray
from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.find import find
from emb_bench.batch.row import ENDINGS as ROWS
from emb_bench.batch.row import NONE, Options, Row, Source, write_rows
from emb_bench.batch.summary import document, mark_copies, summarise, text
from emb_bench.cli.estimate import NUISANCES_EXPLAINED, add_question, at_least, named
from emb_bench.estimate.records import METHODS, EstimationProblem
from emb_bench.experiment.evaluation import Question
from emb_bench.figures import ENDINGS, require_place
from emb_bench.output import replacing, reported_if_interrupted, say_if_compiling
from emb_bench.parallel.progress import Progress
from emb_bench.parallel.ray_tasks import LOCAL
from emb_bench.report.text import show
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_LOG, UsageError
from emb_runtime.system.realtime import processors
from emb_runtime.system.terminal import as_json

SHORTEST, LONGEST = 1e-3, 1e6  # Of a time limit [s]
HELP = "many logs in parallel: one row each in a Parquet or CSV file, and what they say together"
DESCRIPTION = f"""\
Evaluate many logs, each on its own, and write one row for each to a Parquet or CSV file: what the run was, its Fisher
information at the bench's nominal brake, and an estimate of the parameters. A log that cannot be evaluated becomes a
row with the reason, and costs the others nothing. The rows are the same however many processes or machines made them.
{NUISANCES_EXPLAINED}"""

ON_A_CLUSTER = "\nOn a cluster (--ray ADDRESS) all machines need emb-excite and the logs at the same paths.\n"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.epilog = f"{p.epilog}{ON_A_CLUSTER}"
    p.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="log, or folder to search for *.mcap")
    p.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="file to write, Parquet or CSV by its ending; one that is there is replaced",
    )
    p.add_argument(
        "--method",
        choices=(NONE, *METHODS),
        default="oem",
        help=f"how parameters are estimated: {', '.join(f'{k} ({v})' for k, v in METHODS.items())}, or {NONE}, for "
        "information alone (default: %(default)s)",
    )
    add_question(p)
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the one in each log)")
    p.add_argument("--jobs", type=int, metavar="N", help="logs at a time (default: one for each processor)")
    p.add_argument(
        "--time-limit",
        type=float,
        default=600.0,
        metavar="S",
        help="longest time for one log, in seconds; what takes longer has failed (default: %(default)g)",
    )
    p.add_argument(
        "--ray",
        nargs="?",
        const=LOCAL,
        metavar="ADDRESS",
        help="use Ray: the cluster at this address, without one a Ray of its own on this machine",
    )
    p.add_argument("--plot", type=Path, metavar="FILE", help="figure of the parameters over time, of 4 runs or more")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")


def run(args: argparse.Namespace) -> int:
    """Evaluate a campaign; gives the exit code.

    Raises:
        UsageError: a wrong argument, no log, a missing library, or a result that cannot be written.
    """
    options = _options(args)
    require_place("--output", args.output, ROWS)
    require_place("--plot", args.plot, ENDINGS)
    _check_libraries()
    sources = find(args.paths)
    say_if_compiling()
    with reported_if_interrupted("emb-replay campaign"), replacing(args.output) as beside:
        rows = mark_copies(_evaluated(sources, _rows(args, partial(evaluate_one, options=options), sources)))
        write_rows(beside, args.output.suffix, rows, options)
    found = summarise(rows, options, str(args.output))
    if args.plot is not None:
        from emb_bench.batch.figure import draw

        draw(found, args.plot)
    show(as_json(document(found)) if args.json else text(found))
    if not found.evaluated:
        return EXIT_LOG
    return EXIT_CHECK_FAILED if found.failed else EXIT_DONE


def _options(args: argparse.Namespace) -> Options:
    """Options from the arguments; a wrong argument is refused before any log is read."""
    jobs = 1 if args.jobs is None else args.jobs
    at_least({"--starts": (args.starts, 1), "--seed": (args.seed, 0), "--jobs": (jobs, 1)})
    if not SHORTEST <= args.time_limit <= LONGEST:
        raise UsageError(f"--time-limit: expected {SHORTEST:g} to {LONGEST:g} s, got {args.time_limit:g}")
    params, nuisances = named(args, None)
    if args.method != NONE:
        EstimationProblem(params, nuisances)
    Question(params, nuisances)
    bench = None if args.bench is None else load_bench(args.bench, analysis=True)
    if bench is not None:
        if args.model is not None:
            bench.plant(args.model)
        if args.prior is not None:
            Question(params, nuisances, bench.range_set(args.prior))
    return Options(
        method=args.method,
        params=params,
        nuisances=nuisances,
        model=args.model,
        prior=args.prior,
        bench_text=None if bench is None else bench.text,
        starts=args.starts,
        seed=args.seed,
    )


def _check_libraries() -> None:
    """Refuses to begin if a library that the evaluation needs is missing."""
    try:
        import numba  # noqa: F401
        import pyarrow  # noqa: F401
        import scipy  # noqa: F401
    except ImportError as err:
        raise UsageError(f"emb-replay campaign needs {err.name}: pip install 'emb-excite[bench]'") from err


def _rows(
    args: argparse.Namespace, evaluate: Evaluate, sources: Sequence[Source]
) -> Generator[tuple[int, Row], None, None]:
    if args.ray is not None:
        return on_ray(evaluate, sources, args.jobs, args.time_limit, args.ray)
    return in_processes(evaluate, sources, args.jobs or len(processors()), args.time_limit)


def _evaluated(sources: Sequence[Source], numbered: Generator[tuple[int, Row], None, None]) -> list[Row]:
    """All rows in the order of the logs; reports each as it comes."""
    progress, rows = Progress(sys.stderr, len(sources), time.monotonic), dict[int, Row]()
    try:
        with closing(numbered):  # processes end here, whatever happens
            for number, row in numbered:
                rows[number] = row
                progress.took(row.error)
    finally:
        progress.end()
    return [rows[number] for number in range(len(sources))]
