"""Fisher information of a record, as a document for programs and as text; needs nothing but the base install."""

from __future__ import annotations

from bisect import bisect_left
from typing import TYPE_CHECKING, Any

import numpy as np

from emb_bench.brake.parameters import UNITS, quantity
from emb_bench.config.machine import LOADS
from emb_bench.documents import to_json
from emb_bench.information.criteria import criteria_series
from emb_bench.information.evaluation import KINDS, Evaluation, Question, default_model, evenly
from emb_bench.information.identifiability import combination
from emb_bench.numbers import in_samples, relative
from emb_bench.report import information as say
from emb_bench.report.text import Table, facts, listed, wrapped
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import EmbError, needs
from emb_runtime.estimator.estimate import NORMAL_95, total
from emb_runtime.numbers import NOTHING, plain

if TYPE_CHECKING:  # the base install has no scipy
    from emb_bench.estimate.expected import Interval

LONGEST = 60_000  # Periods of a record whose interval is computed, which takes memory for all of them
INSTANTS = 10  # Rows of the table over time; the document has more
CRITERIA = {
    "log det M": "log_det",
    "lambda_min": "lambda_min",
    "tr M^-1": "trace_inverse",
    "condition number": "condition",
}


def fim_document(e: Evaluation) -> dict[str, Any]:
    """Everything about the information, for ``--json``; a number that is not finite becomes null."""
    x, question, fisher, verdict = e.experiment, e.question, e.fisher("physical"), e.identifiability()
    times = (np.array(e.instants) + 1) * e.bench.timing.sample_time
    numbers = ("log_det", "lambda_min", "trace_inverse", "condition", "singular")
    found: dict[str, Any] = {
        "log": e.log.path,
        "complete": e.log.complete and not x.quality.lacks,
        "warnings": say.warnings(e),
        "notes": say.notes(e),
        "exit_reason": e.log.exit_reason,
        "samples": {
            "planned": x.quality.planned,
            "periods": x.periods,
            "measured": x.measured.sum(),
            "braked_periods": x.quality.braked,
            "command_delay": x.quality.command_delay,
        },
        "model": e.plant.name,
        "theta": {"name": e.theta_name, **e.theta._asdict()},
        "systematic": e.errors,
        "params": question.params,
        "nuisances": question.nuisances,
        "prior": question.prior.name if question.prior else None,
        "fit_sigmas": {"angle": e.fit.angle, "velocity": e.fit.velocity, "fits": e.fit.fits},
    }
    for kind in KINDS:
        final, series = e.fisher(kind), criteria_series(e.histories[kind], question.names, question.params)
        found[kind] = {"matrix": final.matrix, "over_time": {"time": times, **series._asdict()}}
        found[kind] |= {name: getattr(final.criteria(), name) for name in numbers}
    found["physical"] |= {
        "cramer_rao": fisher.cramer_rao(),
        "correlation": fisher.correlation(),
        "identified": verdict.identified,
        "findings": [to_json(finding) | {"identified": finding.identified} for finding in verdict.findings],
        "directions": verdict.directions,
    }
    interval = expected_interval(e)
    if not isinstance(interval, str):
        deviations = {key: getattr(interval, key).tolist() for key in ("repeatability", "between_runs", "total")}
        found["estimate"] = {
            **{key: dict(zip(interval.names, row, strict=True)) for key, row in deviations.items()},
            "T": interval.of_comparison,
            "I": interval.of_repeatability,
            "budget": {one.name: dict(zip(interval.names, one.bias, strict=True)) for one in interval.budget},
        }
    document: dict[str, Any] = to_json({"estimate": None} | found)
    return document


def expected_interval(e: Evaluation) -> Interval | str:
    """The interval that an estimate from the record will have, or the reason that there is none."""
    if e.absent:
        return f"{', '.join(e.absent)}: zero in the model"
    if e.experiment.periods > LONGEST:
        return f"the record has more than {LONGEST} periods"
    try:
        with needs("the interval of an estimate", "bench"):
            from emb_bench.estimate.expected import of_information
        return of_information(e)
    except EmbError as err:
        return str(err)


def fim_text(e: Evaluation, *, verbose: bool = False) -> str:
    """Defects of the log, then the smallest possible repeatabilities; with ``verbose`` the criteria over time."""
    doubts, lines = [*listed("WARNING: ", say.warnings(e)), *listed("NOTE: ", say.notes(e))], _heading(e)
    velocity = "" if e.fit.velocity is None else f", velocity {plain(e.fit.velocity)}"
    fit = f"rms: angle {plain(e.fit.angle)}{velocity} sigma (at most {e.fit.expected:.2f} if the model fits)"
    lines += [*facts(("model", f"{e.plant.name} ({_why(e)})"), ("residuals", fit)), *_unknowns(e.question)]
    if not e.fisher("weighted").matrix.any():  # which has no prior
        return "\n".join([*doubts, "no information: the record does not depend on any of these parameters", *lines])
    verdict = e.identifiability().renamed(e.bench.machine)
    prior = "" if e.question.prior is None else ", with the prior"
    head = [*_expected(e, prior), *wrapped(f"smallest possible repeatability ± 95 % (k=2){prior}, of ideal sensors")]
    rows = [[f.name, _half(f.deviation, f.unit), say.finding(f)] for f in verdict.findings]
    head += [*(row.rstrip() for row in Table("", ("", "", ""), rows, words=(0, 2)).lines("  ")[1:])]
    if e.bench.machine is None:
        bounds = {f.name: NORMAL_95 * f.deviation for f in verdict.findings if f.name in PARAMETER_NAMES}
        head += listed("  ", [total(bounds, e.bench.systematic)])
    head += listed("  ", say.directions(verdict))
    final = e.fisher("physical").criteria().renamed(e.bench.machine)
    smallest, condition = plain(final.lambda_min), plain(final.condition)
    shown = f"log det {final.log_det:.5g}, smallest eigenvalue {smallest}, condition {condition}"
    lines = [*head, "", *lines, *facts(("information", shown))]
    return "\n".join([*doubts, *lines, *(_details(e) if verbose else ())])


def _expected(e: Evaluation, prior: str) -> list[str]:
    """Intervals that an estimate of the record will have, with the largest effect of each."""
    interval = expected_interval(e)
    if isinstance(interval, str):
        return listed("no interval of an estimate: ", [interval])
    from emb_bench.estimate.effects import shown_as

    machine, rows = e.bench.machine, []
    for i, name in enumerate(interval.names):
        shown, most = quantity(machine, name), interval.largest(i)
        kinds = (interval.repeatability, interval.between_runs, interval.total)
        halves = [_half(float(kind[i]), shown.unit if name in UNITS else "") for kind in kinds]
        rows.append([shown.name, *halves, "" if most is None else shown_as(most, machine).name])
    header = ("", "repeatability", "between runs", "total", "largest between runs")
    title = f"expected from emb-replay estimate, ± 95 % (k=2){prior}"
    return [title, *Table("", header, rows, words=(0, 4)).lines("  "), ""]


def _why(e: Evaluation) -> str:
    """Reason for the model."""
    name, why = default_model(e.log)
    return why if name == e.plant.name else "as requested"


def _half(deviation: float, unit: str) -> str:
    """Half an interval, in percent without a unit."""
    half = relative(NORMAL_95 * deviation, not unit)
    return half if half == NOTHING else f"± {half} {unit}".rstrip()


def _details(e: Evaluation) -> list[str]:
    """Criteria of both informations, at the end and over time."""
    final = {kind: e.fisher(kind).criteria().renamed(e.bench.machine) for kind in KINDS}
    rows = [[label, *(plain(getattr(final[kind], name), 6) for kind in KINDS)] for label, name in CRITERIA.items()]
    table = Table("", ("Fisher information", *KINDS), rows).lines()
    weakest = f"least determined: {combination(final['physical'].weakest)}"
    return ["", *table, *wrapped(f"  {weakest}"), "", *_over_time(e).lines()]


def _over_time(e: Evaluation) -> Table:
    steps, names = evenly(e.experiment.periods, INSTANTS), (e.question.names, e.question.params)
    at = [bisect_left(e.instants, k) for k in steps]
    physical, weighted = (criteria_series(e.histories[kind][at], *names) for kind in KINDS)
    rows = [
        [
            f"{(k + 1) * e.bench.timing.sample_time * 1e3:.6g}",
            f"{det:.4f}",
            plain(least, 5),
            plain(trace, 5),
            f"{w:.4f}",
        ]
        for k, det, least, trace, w in zip(steps, *physical, weighted.log_det, strict=True)
    ]
    return Table("", ("time [ms]", "log det", "lambda_min", "tr M^-1", "log det weighted"), rows, words=())


def _heading(e: Evaluation) -> list[str]:
    x, late, machine = e.experiment, e.experiment.quality.command_delay, e.bench.machine
    run = "recording" if e.log.is_recording else e.log.exit_reason
    run += f", {x.periods} of {x.quality.planned} periods, {x.measured.sum()} samples"
    run += f", {x.quality.braked} braked by the node" if x.quality.braked else ""
    run += f"; commands acted {in_samples(late)} late" if late else ""
    if machine is None:
        theta = ", ".join(f"{name} {plain(getattr(e.theta, name), 4)}" for name in PARAMETER_NAMES) + " (SI)"
    else:
        values = e.theta._asdict()
        names = [n for n in (*PARAMETER_NAMES, "J") if values[n] and (n != "k_m" or machine.command not in LOADS)]
        given = ((quantity(machine, name), values[name]) for name in names)
        theta = ", ".join(f"{shown.name} = {plain(value, 4)} {shown.unit}" for shown, value in given)
    return facts(
        ("log", f"{e.log.path}: {run}"),
        ("theta", f"{e.theta_name}: {theta}"),
    )


def _unknowns(q: Question) -> list[str]:
    also = f"{', '.join(q.nuisances)}; log det is of the others (Ds)" if q.nuisances else ""
    prior = f"the ranges '{q.prior.name}', in the physical information" if q.prior is not None else ""
    return facts(("unknown too", also), ("prior", prior))
