"""``emb-replay fim``: the information of a recorded experiment about the brake's parameters."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_bench.brake.parameters import PARAMETERS
from emb_bench.cli.estimate import named
from emb_bench.experiment.evaluation import (
    Question,
    bench_for,
    default_model,
    evaluate_all,
)
from emb_bench.experiment.from_log import read_experiment
from emb_bench.experiment.theta import read_theta
from emb_bench.logs.log import read_log, require_driven
from emb_bench.report.fim import document, models_text, text
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.plants import EVERY
from emb_runtime.errors import EXIT_DONE
from emb_runtime.system.terminal import as_json, show

HELP = "Fisher information: how much information the experiment has about the parameters"
DESCRIPTION = (
    "Both Fisher informations of the recorded experiment, in relative parameters: 'physical' (SI "
    "units, the one with a Cramer-Rao bound) and 'weighted' (the thesis's reward)."
)


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    p.add_argument(
        "--model",
        metavar=f"NAME|{EVERY}",
        help="which of the bench's plants to evaluate with (default: the one that was simulated; exact where the log "
        f"does not say), or {EVERY} of them side by side",
    )
    p.add_argument(
        "--params",
        metavar="NAMES",
        help="unknown parameters that count, what is not named is known (default: "
        f"{','.join(PARAMETER_NAMES)}; what the map of an imported recording guesses)",
    )
    p.add_argument(
        "--nuisance",
        metavar="NAMES",
        help=f"what is unknown besides, of {', '.join(PARAMETERS)} (default: nothing, or what the map says)",
    )
    p.add_argument(
        "--prior",
        metavar="RANGES",
        help="set of ranges of the bench in which the parameters were known to lie beforehand (default: nothing known)",
    )
    p.add_argument(
        "--theta",
        default="nominal",
        metavar="THETA",
        help="where to evaluate: nominal, the bench's brake; true, which the log of a simulated one knows; "
        "name=value,name=value; a TOML file with lines such as 'f_v = 3e-5'; or the JSON of 'emb-replay estimate' "
        "or of a report (default: nominal)",
    )
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the one inside the log)")


def run(args: argparse.Namespace) -> int:
    """Evaluate a log; gives the exit code.

    Raises:
        UsageError: a wrong argument, an unreadable file, or one of a run that only listened.
        LogError: the log is none, or too damaged.
    """
    Question(*named(args, None))  # a wrong name needs no log to be refused
    log = read_log(args.log)
    require_driven(log)
    bench = bench_for(log, args.bench)
    question = Question(*named(args, bench), None if args.prior is None else bench.range_set(args.prior))
    model, why = (args.model, "asked for") if args.model is not None else default_model(log)
    plants = list(bench.plants.values()) if args.model == EVERY else [bench.plant(model)]
    theta_name, theta, errors = read_theta(args.theta, log, bench)
    experiment = read_experiment(log, bench)
    evaluations = evaluate_all(log, experiment, bench, plants, question, theta_name, theta, errors)
    if args.model != EVERY:
        show(as_json(document(evaluations[0])) if args.json else text(evaluations[0], why))
    else:
        show(as_json({"models": [document(e) for e in evaluations]}) if args.json else models_text(evaluations))
    return EXIT_DONE
