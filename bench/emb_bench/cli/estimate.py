"""``emb-replay estimate``: parameters from logs."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from emb_bench.brake.parameters import PARAMETERS
from emb_bench.estimate.records import METHODS, STARTS, TERMS, WINDOW, EstimationProblem
from emb_bench.experiment.evaluation import names_of
from emb_bench.logs.log import read_log, require_driven
from emb_bench.output import reported_if_interrupted, say_if_compiling
from emb_bench.report.text import show
from emb_bench.sim.plant_spec import parse_assignments
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench
from emb_runtime.config.plants import EVERY
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, UsageError
from emb_runtime.system.terminal import as_json

if TYPE_CHECKING:
    from emb_bench.analysis.study import StudyOptions

PRIOR = (
    "name of ranges in the bench file that were known beforehand; the shipped one has viscous, viscous-stiffness, pm50 "
    "and envelope (default: none)"
)
METHODS_EXPLAINED = """\
methods:
  oem      output error: the brake whose simulated angle and velocity lie nearest to the measured ones
  pem      prediction error: a Kalman filter follows the brake, for brakes that are disturbed by more than the model
  rls      recursive least squares: simple and biased, as a baseline
  windows  output error over windows, each with a start of its own: for machines without a spring and disturbed ones
"""
NUISANCES_EXPLAINED = "\nunknowns for --nuisance, besides the parameters:\n" + "".join(
    f"  {name:17} {row.about}\n" for name, row in PARAMETERS.items() if row.about
)
HELP = "the brake's parameters, with uncertainties, and whether the model fits"
DESCRIPTION = f"""\
Estimate parameters from logs of one brake, which are taken together; x1_0, x2_0 and offset are each log's own. Whether
the model explains the logs is said before any number; then each parameter with its interval, whether it is identified,
and which further run would help. Of several logs, each is also predicted from the others.

{METHODS_EXPLAINED}{NUISANCES_EXPLAINED}"""
GLOSSARY = textwrap.fill(". ".join(f"{name}: {said}" for name, said in TERMS.items()) + ".", 110) + "\n\n"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    add_options(p)
    p.epilog = f"{GLOSSARY}{p.epilog}"
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    p.add_argument(
        "--strict",
        action="store_true",
        help="exit with 1 if the model does not fit, does not predict a log, or a parameter is not identified",
    )
    p.add_argument(
        "--profile",
        action="store_true",
        help="likelihood profiles of all parameters, which need no linearisation (default: of those identified badly)",
    )


def add_options(p: argparse.ArgumentParser) -> None:
    """Add the arguments of every command that estimates: the logs, and the options of the estimation."""
    p.add_argument("logs", nargs="+", type=Path, metavar="RUN", help="MCAP file of emb-run")
    p.add_argument(
        "--method", choices=METHODS, help="see above (default: oem; windows for a recording that was imported)"
    )
    add_question(p, all_models=True)
    p.add_argument(
        "--grow",
        action="store_true",
        help="begin with --model, or exact, and add the features that the logs ask for until they ask for nothing more",
    )
    p.add_argument(
        "--bounds",
        default="",
        metavar="NAME=LOW:HIGH,...",
        help="where to search, SI units, k_m=0.01:0.1 for one (default: nominal/10 to nominal*10)",
    )
    p.add_argument(
        "--window",
        type=float,
        default=0.0,
        metavar="S",
        help=f"length of the windows, with --method windows (default: what the map says, or {WINDOW:g})",
    )
    p.add_argument(
        "--bootstrap", type=int, default=0, metavar="N", help="draw the logs N times again, from 3 logs (default: not)"
    )
    p.add_argument(
        "--hold-out",
        action="append",
        default=[],
        type=Path,
        metavar="RUN",
        help="log that is predicted, not estimated from; may be given more than once",
    )
    p.add_argument(
        "--last", type=Path, metavar="FILE", help="JSON of an earlier estimate or report: say what has changed since"
    )
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the one in the first log)")


def add_question(p: argparse.ArgumentParser, *, all_models: bool = False) -> None:
    """Add the options of the estimation from a log: parameters, prior knowledge, and number of searches.

    Args:
        p: the parser.
        all_models: True if the command can compare all plants.
    """
    every = f"; or {EVERY}: each is fitted, and the one that explains the logs best answers" if all_models else ""
    p.add_argument(
        "--params",
        metavar="NAMES",
        help=f"what to estimate (default: {','.join(PARAMETER_NAMES)}; what the map of an imported recording guesses)",
    )
    p.add_argument(
        "--nuisance",
        metavar="NAMES",
        help=f"what is unknown besides, of {', '.join(PARAMETERS)}, see above (default: nothing, or what the map says)",
    )
    p.add_argument(
        "--model",
        metavar=f"NAME|{EVERY}" if all_models else "NAME",
        help="plant of the bench to estimate with, such as exact, euler or stribeck; 'emb-run --write-bench FILE' "
        f"shows all{every} (default: the one that was simulated; exact where a log does not say)",
    )
    p.add_argument(
        "--systematic",
        choices=("bench", "none"),
        default="bench",
        help="systematic errors that are estimated along, each with its prior in [systematic] of the bench file, and "
        "that intervals allow for; 'none' trusts sensors, clock and plant completely (default: %(default)s)",
    )
    p.add_argument("--prior", metavar="RANGES", help=PRIOR)
    p.add_argument("--starts", type=int, default=STARTS, metavar="N", help="local searches (default: %(default)s)")
    p.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of where they begin, and of draws (default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Estimate; text for a person, or with ``--json`` for a program. Gives the exit code.

    Raises:
        UsageError: a wrong argument, logs that do not go together, or scipy or numba is missing.
        LogError: a log cannot be read.
    """
    asked = asked_of(args)
    try:
        import numba  # noqa: F401

        from emb_bench.analysis.drift import read_last
        from emb_bench.analysis.study import make_study
        from emb_bench.report.estimate import document, text
    except ImportError as err:
        raise UsageError("emb-replay estimate needs scipy and numba: pip install 'emb-excite[bench]'") from err
    last = None if args.last is None else read_last(args.last)
    logs, held_out = [read_log(path) for path in args.logs], [read_log(path) for path in args.hold_out]
    for log in (*logs, *held_out):
        require_driven(log)
    bench = logs[0].bench if args.bench is None else load_bench(args.bench, analysis=True)
    say_if_compiling()
    with reported_if_interrupted("emb-replay estimate"):
        study = make_study(bench, logs, options_of(args, asked, bench), held_out=held_out, last=last)
    show(as_json(document(study)) if args.json else text(study))
    return EXIT_CHECK_FAILED if args.strict and not (study.holds and study.identified) else EXIT_DONE


def asked_of(args: argparse.Namespace) -> EstimationProblem:
    """The estimation problem without its prior, which needs a bench; a wrong argument is refused without a log.

    Raises:
        UsageError: a wrong argument.
    """
    at_least({"--starts": (args.starts, 1), "--seed": (args.seed, 0), "--bootstrap": (args.bootstrap, 0)})
    if not (args.window == 0.0 or 1e-3 <= args.window <= 3600.0):
        raise UsageError(f"--window: expected a time from 0.001 to 3600 s, got {args.window:g}")
    params, nuisances = named(args, None)
    return EstimationProblem(params, nuisances, None, bounds_of(args.bounds), window=args.window)


def named(args: argparse.Namespace, bench: Bench | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Parameters and nuisances; where an option does not name them, those of the bench's machine, if it has one."""
    machine = None if bench is None else bench.machine
    params = PARAMETER_NAMES if machine is None else machine.unknown
    nuisances = () if machine is None else machine.nuisances
    return (
        params if args.params is None else names_of(args.params),
        nuisances if args.nuisance is None else names_of(args.nuisance),
    )


def at_least(options: Mapping[str, tuple[int, int]]) -> None:
    """Check numbers against the least that each may be.

    Raises:
        UsageError: one is smaller.
    """
    for option, (value, least) in options.items():
        if value < least:
            raise UsageError(f"{option}: expected a number from {least}, got {value}")


def options_of(args: argparse.Namespace, asked: EstimationProblem, bench: Bench) -> StudyOptions:
    """Options of a study: the estimation problem with its prior, and the method.

    Raises:
        UsageError: the bench has no such ranges, or no given parameter varies in them.
    """
    from emb_bench.analysis.study import StudyOptions

    prior = None if args.prior is None else bench.range_set(args.prior)
    params, nuisances = named(args, bench)
    return StudyOptions(
        replace(asked, params=params, nuisances=nuisances, prior=prior),
        args.method or ("oem" if bench.machine is None else "windows"),
        args.model,
        args.starts,
        args.seed,
        args.profile,
        args.bootstrap,
        grow=args.grow,
        systematic=args.systematic == "bench",
    )


def bounds_of(text: str) -> dict[str, tuple[float, float]]:
    """``k_m=0.01:0.1,f_v=1e-6:1e-4`` as a mapping to two numbers.

    Raises:
        UsageError: the text is not of that form.
    """
    found = {}
    for name, pair in parse_assignments(text, "--bounds: ").items():
        low, _, high = pair.partition(":")
        try:
            found[name] = (float(low), float(high))
        except ValueError:
            raise UsageError(f"--bounds: {name}: expected two numbers as in 0.01:0.1, got '{pair}'") from None
    return found
