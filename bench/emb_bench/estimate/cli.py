"""``emb-replay estimate``: parameters from logs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emb_bench.estimate.records import ESTIMATED, STARTS, Asked, Record, record_of
from emb_bench.evaluation import default_model, names_of, other_sample_time
from emb_bench.experiment import Experiment, read_experiment
from emb_bench.log import RunLog, read_log
from emb_runtime.bench import PARAMETER_NAMES, Bench, BrakeParameters, load_bench
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.terminal import as_json, show

DESCRIPTION = """\
Estimate parameters by the output-error method: those whose simulated angle and velocity lie nearest to the measured
ones. Whether the model explains the record is said before any number. Several logs of one brake are estimated
together; x1_0, x2_0 and offset are then each log's own.
"""


def add_parser(commands: Any, epilog: str) -> None:
    """Add the command ``estimate`` to those of ``emb-replay``."""
    p = commands.add_parser(
        "estimate",
        help="the brake's parameters, with uncertainties, and whether the model fits",
        description=DESCRIPTION,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    p.add_argument(
        "--params", default=",".join(PARAMETER_NAMES), metavar="NAMES", help="what to estimate (default: %(default)s)"
    )
    p.add_argument(
        "--nuisance",
        default="",
        metavar="NAMES",
        help=f"what is unknown besides, of {', '.join(ESTIMATED)} (default: nothing)",
    )
    p.add_argument(
        "--model",
        metavar="NAME",
        help="plant of the bench to estimate with (default: the one that was simulated; exact where a log does not "
        "say)",
    )
    p.add_argument("--prior", metavar="RANGES", help="ranges of the bench that were known beforehand (default: none)")
    p.add_argument("--starts", type=int, default=STARTS, metavar="N", help="local searches (default: %(default)s)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of where they begin (default: %(default)s)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the one in the first log)")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Estimate; text for a person, or with ``--json`` for a program. Gives the exit code.

    Raises:
        UsageError: a wrong argument, logs that do not go together, or scipy or numba is missing.
        LogError: a log cannot be read.
    """
    params, nuisances = names_of(args.params), names_of(args.nuisance)
    Asked(params, nuisances)  # a wrong name needs no log to be refused
    for option, value, least in (("--starts", args.starts, 1), ("--seed", args.seed, 0)):
        if value < least:
            raise UsageError(f"{option}: expected a number from {least}, got {value}")
    try:
        import numba  # noqa: F401

        from emb_bench.estimate.output_error import estimate
        from emb_bench.estimate.report import document, text
    except ImportError as err:
        raise UsageError("emb-replay estimate needs scipy and numba: install emb-excite[bench]") from err
    logs = [read_log(path) for path in args.logs]
    bench = logs[0].bench if args.bench is None else load_bench(args.bench)
    _same_time(bench, logs)
    asked = Asked(params, nuisances, None if args.prior is None else bench.range_set(args.prior))
    name, why = (args.model, "asked for") if args.model is not None else _model(logs)
    plant = bench.plant(name)
    records: list[Record] = []
    warnings: list[str] = []
    for log in logs:
        experiment = read_experiment(log, bench)
        records.append(record_of(str(log.path), experiment, bench, plant))
        said = [log.missing] if log.missing else []
        said += [*experiment.missing, *_hidden(experiment)]
        warnings += [f"{log.path}: {warning}" if len(logs) > 1 else warning for warning in said]
    found = estimate(bench, plant, records, asked, starts=args.starts, seed=args.seed)
    truth = _truth(logs)
    show(as_json(document(found, warnings, why, truth)) if args.json else text(found, warnings, why, truth))
    return EXIT_DONE


def _hidden(experiment: Experiment) -> list[str]:
    """Periods of which neither a report is left nor, as a rule, a command: the sample before them was lost as well."""
    lost = ~experiment.measured
    hidden = int((lost[1:] & lost[:-1]).sum())
    if not hidden:
        return []
    return [
        f"{hidden} periods lie between lost samples: what acted in them is assumed, and may be wrong enough "
        "for the right model not to fit"
    ]


def _same_time(bench: Bench, logs: Sequence[RunLog]) -> None:
    """Refuse logs on another time grid."""
    for log in logs:
        if (its := other_sample_time(log, bench)) is not None:
            raise UsageError(f"{log.path}: expected a sample time of {bench.timing.sample_time:g} s, got {its:g} s")


def _model(logs: Sequence[RunLog]) -> tuple[str, str]:
    models = {default_model(log) for log in logs}
    if len({name for name, _ in models}) > 1:
        names = ", ".join(sorted(name for name, _ in models))
        raise UsageError(f"the logs are of different brakes ({names}): say which model to use, with --model")
    return sorted(models)[0]


def _truth(logs: Sequence[RunLog]) -> BrakeParameters | None:
    """What was simulated, if that is known and the same in all logs."""
    truths = {log.truth for log in logs}
    return truths.pop() if len(truths) == 1 else None
