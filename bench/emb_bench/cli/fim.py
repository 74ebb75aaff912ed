"""``emb-replay fim``: how much a recorded experiment told about the brake's parameters."""

from __future__ import annotations

import argparse
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.brake.parameters import UNITS, UNKNOWNS
from emb_bench.experiment.evaluation import (
    Evaluation,
    Question,
    default_model,
    evaluate_all,
    evenly,
    in_samples,
    names_of,
    other_sample_time,
    read_theta,
)
from emb_bench.experiment.experiment import open_experiment
from emb_bench.experiment.model_evaluator import KINDS, Fit
from emb_bench.information.criteria import Criteria
from emb_bench.information.series import criteria_series
from emb_bench.logs.log import read_log, require_driven
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench
from emb_runtime.config.plants import EVERY
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.terminal import as_json, show

INSTANTS = 10
"""Rows of the table over time; ``--json`` has more."""


def add_parser(commands: Any, epilog: str) -> None:
    """Add the command ``fim`` to those of ``emb-replay``."""
    f = commands.add_parser(
        "fim",
        help="Fisher information: how much the experiment told about the parameters",
        description="Both Fisher informations of the recorded experiment, in relative parameters: 'physical' (SI "
        "units, the one with a Cramer-Rao bound) and 'weighted' (the thesis's reward).",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    f.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    f.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    f.add_argument(
        "--model",
        metavar=f"NAME|{EVERY}",
        help="which of the bench's plants to evaluate with (default: the one that was simulated; exact where the log "
        f"does not say), or {EVERY} of them side by side",
    )
    f.add_argument(
        "--params",
        default=",".join(PARAMETER_NAMES),
        metavar="NAMES",
        help="unknown parameters that count, what is not named is known (default: %(default)s)",
    )
    f.add_argument(
        "--nuisance",
        default="",
        metavar="NAMES",
        help=f"what is unknown besides, of {', '.join(UNKNOWNS)} (default: nothing)",
    )
    f.add_argument(
        "--prior",
        metavar="RANGES",
        help="set of ranges of the bench in which the parameters were known to lie beforehand (default: nothing known)",
    )
    f.add_argument(
        "--theta",
        default="nominal",
        metavar="THETA",
        help="where to evaluate: nominal, the bench's brake; true, which the log of a simulated one knows; "
        "name=value,name=value; or a TOML file with lines such as 'f_v = 3e-5' (default: nominal)",
    )
    f.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the one inside the log)")
    f.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Evaluate a log; gives the exit code.

    Raises:
        UsageError: a wrong argument, an unreadable file, or one of a run that only listened.
        LogError: the log is none, or too damaged.
    """
    params, nuisances = names_of(args.params), names_of(args.nuisance)
    Question(params, nuisances)  # a wrong name needs no log to be refused
    log = read_log(args.log)
    require_driven(log)
    bench = log.bench if args.bench is None else load_bench(args.bench)
    if (its := other_sample_time(log, bench)) is not None:
        ours = bench.timing.sample_time
        raise UsageError(f"{args.bench}: expected the sample time of the log, {its:g} s, got {ours:g} s")
    question = Question(params, nuisances, None if args.prior is None else bench.range_set(args.prior))
    model, why = (args.model, "asked for") if args.model is not None else default_model(log)
    plants = list(bench.plants.values()) if args.model == EVERY else [bench.plant(model)]
    theta_name, theta = read_theta(args.theta, log, bench)
    experiment = open_experiment(log, bench)
    evaluations = evaluate_all(log, experiment, bench, plants, question, theta_name, theta)
    if args.model != EVERY:
        show(as_json(fim_document(evaluations[0])) if args.json else fim_text(evaluations[0], why))
    else:
        show(as_json({"models": [fim_document(e) for e in evaluations]}) if args.json else models_text(evaluations))
    return EXIT_DONE


def fim_document(evaluation: Evaluation) -> dict[str, Any]:
    """Everything about the information, for ``--json``; a number that is not finite becomes null."""
    e = evaluation
    document: dict[str, Any] = {
        "log": str(e.log.path),
        "complete": e.log.complete and not e.experiment.missing,
        "warnings": e.warnings,
        "notes": e.notes,
        "exit_reason": e.log.exit_reason,
        "samples": {
            "planned": e.experiment.planned,
            "periods": e.experiment.periods,
            "measured": e.experiment.samples,
            "braked_periods": e.experiment.braked,
            "command_delay": e.experiment.command_delay,
        },
        "model": e.plant.name,
        "theta": {"name": e.theta_name, **e.theta._asdict()},
        "normalise_by": e.fisher("physical").normalise_by,  # each parameter by its value in theta
        "params": list(e.question.params),
        "nuisances": list(e.question.nuisances),
        "prior": e.question.prior.name if e.question.prior else None,
        "fit_sigmas": {"angle": e.fit.angle, "velocity": e.fit.velocity, "fits": e.fit.fits},
    }
    times = ((np.array(e.instants) + 1) * e.bench.timing.sample_time).tolist()
    for kind in KINDS:
        fisher = e.fisher(kind)
        document[kind] = {"matrix": fisher.matrix.tolist(), **_numbers(fisher.criteria())}
        series = criteria_series(e.histories[kind], e.question.names, e.question.params)
        document[kind]["over_time"] = {
            "time": times,
            **{name: values.tolist() for name, values in series._asdict().items()},
        }
    fisher, verdict = e.fisher("physical"), e.verdict()
    document["physical"] |= {
        "cramer_rao": fisher.cramer_rao(),
        "correlation": fisher.correlation().tolist(),
        "told": verdict.told,
        "findings": [asdict(finding) for finding in verdict.findings],
        "directions": [asdict(direction) for direction in verdict.directions],
    }
    return document


def _numbers(c: Criteria) -> dict[str, Any]:
    return {
        "log_det": c.log_det,
        "lambda_min": c.lambda_min,
        "trace_inverse": c.trace_inverse,
        "condition": c.condition,
        "singular": c.singular,
        "verdict": c.verdict(),
    }


def fim_text(evaluation: Evaluation, why_this_model: str) -> str:
    """The same for a person; what is missing comes before any number."""
    e = evaluation
    lines = [f"WARNING: {warning}" for warning in e.warnings] + [f"NOTE: {note}" for note in e.notes]
    lines += [
        *_heading(e),
        f"model        {e.plant.name} ({why_this_model})",
        f"model fit    angle {e.fit.angle:.3g} sigma, velocity {e.fit.velocity:.3g} sigma (1 if it fits, "
        f"{e.fit.expected:.2f} at most)",
        *_unknowns(e.question),
        "",
    ]
    if not e.fisher("weighted").matrix.any():  # which has no prior
        return "\n".join([*lines, "nothing was excited: the record does not depend on any of these parameters"])
    lines.append(f"{'Fisher information':28}{'physical':>14}{'weighted':>14}")
    final = {kind: e.fisher(kind).criteria() for kind in KINDS}
    for label, name in (
        ("log det M", "log_det"),
        ("lambda_min", "lambda_min"),
        ("tr M^-1", "trace_inverse"),
        ("condition number", "condition"),
    ):
        lines.append(f"  {label:26}" + "".join(f"{getattr(final[kind], name):14.6g}" for kind in KINDS))
    lines += [f"  {final['physical'].verdict()}", ""]
    bound = "Cramer-Rao bound, least" if e.question.prior is None else "with the prior, to first order, least"
    lines += [f"{bound} standard deviation, and what the record tells", *_indented(e.verdict().text())]
    lines += ["", f"{'time [ms]':>10}{'log det physical':>18}{'lambda_min':>14}{'tr M^-1':>14}{'log det weighted':>18}"]
    steps, names = evenly(e.experiment.periods, INSTANTS), (e.question.names, e.question.params)
    rows = [bisect_left(e.instants, k) for k in steps]
    physical, weighted = (criteria_series(e.histories[kind][rows], *names) for kind in KINDS)
    for k, log_det, lambda_min, trace_inverse, weighted_log_det in zip(steps, *physical, weighted.log_det, strict=True):
        time_ms = (k + 1) * e.bench.timing.sample_time * 1e3
        lines.append(f"{time_ms:10.6g}{log_det:18.4f}{lambda_min:14.5g}{trace_inverse:14.5g}{weighted_log_det:18.4f}")
    return "\n".join(lines)


def models_text(evaluations: Sequence[Evaluation]) -> str:
    """The same record seen with every model of the brake, side by side."""
    first = evaluations[0]
    lines = [f"WARNING: {missing}" for missing in (first.log.missing, *first.experiment.missing) if missing]
    if not any(e.fit.fits for e in evaluations):
        lines.append(f"WARNING: no model fits at {first.theta_name} parameters: they are not this brake's")
    names = first.question.names
    lacking = {name: [e.plant.name for e in evaluations if name in e.absent] for name in names}
    lines += [
        f"NOTE: {name} is zero in {', '.join(models)}: there it neither shows nor costs the others"
        for name, models in lacking.items()
        if models
    ]
    columns = [(heading, max(14, len(heading))) for heading in (f"{n} [{UNITS.get(n, '%')}]" for n in names)]
    lines += [
        *_heading(first),
        *_unknowns(first.question),
        "",
        "physical Fisher information, fit in sigmas, and the least standard deviation of each estimate",
        f"{'model':12}{'angle':>9}{'velocity':>9}{'fits':>6}{'log det':>10}{'lambda_min':>12}{'tr M^-1':>11}  "
        + "".join(f" {heading:>{width}}" for heading, width in columns),
    ]
    for e in evaluations:
        fisher = e.fisher("physical")
        c, bounds = fisher.criteria(), fisher.cramer_rao()
        lines.append(
            f"{e.plant.name:12}{e.fit.angle:9.3g}{e.fit.velocity:9.3g}{_fits(e.fit):>6}"
            f"{c.log_det:10.3f}{c.lambda_min:12.4g}{c.trace_inverse:11.4g}  "
            + "".join(
                f" {bounds[name] * (1.0 if name in UNITS else 100.0):{width}.4g}"
                for name, (_, width) in zip(names, columns, strict=True)
            )
        )
    if any(e.fit.loose for e in evaluations):
        lines.append("loose: the model expects more noise than there is, and its bounds are too large")
    if truth := default_model(first.log)[0] if first.log.truth else None:
        lines.append(f"what was simulated: {truth}")
    return "\n".join(lines)


def _fits(fit: Fit) -> str:
    if fit.loose:
        return "loose"
    return "yes" if fit.fits else "no"


def _heading(e: Evaluation) -> list[str]:
    late = e.experiment.command_delay
    return [
        f"log          {e.log.path}",
        f"run          {e.log.exit_reason}",
        f"experiment   {e.experiment.periods} of {e.experiment.planned} periods, "
        f"{e.experiment.samples} samples, {e.experiment.braked} periods braked by the node"
        + (f"; commands acted {in_samples(late)} late" if late else ""),
        f"theta        {e.theta_name}: "
        + ", ".join(f"{name} = {getattr(e.theta, name):.4g}" for name in PARAMETER_NAMES),
    ]


def _unknowns(question: Question) -> list[str]:
    lines = []
    if question.nuisances:
        lines.append(f"unknown too  {', '.join(question.nuisances)}; the criteria are those of the others (Ds)")
    if question.prior is not None:
        lines.append(f"prior        the ranges '{question.prior.name}'; the physical information begins there")
    return lines


def _indented(text: str) -> list[str]:
    return [f"  {line}" for line in text.splitlines()]
