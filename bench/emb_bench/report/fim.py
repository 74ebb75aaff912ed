"""Fisher information of a record, as a document for programs and as text; needs nothing but the base install."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from emb_bench.brake.parameters import UNITS
from emb_bench.brake.quantities import quantity
from emb_bench.experiment.evaluation import Evaluation, Question, default_model, evenly
from emb_bench.experiment.model_evaluator import KINDS, Fit
from emb_bench.information.criteria import Criteria, criteria_series
from emb_bench.numbers import in_samples
from emb_bench.report.text import Table, facts
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.units import CURRENT

INSTANTS = 10  # Rows of the table over time; the document has more
CRITERIA = {
    "log det M": "log_det",
    "lambda_min": "lambda_min",
    "tr M^-1": "trace_inverse",
    "condition number": "condition",
}


def document(evaluation: Evaluation) -> dict[str, Any]:
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
            "measured": int(e.experiment.measured.sum()),
            "braked_periods": e.experiment.braked,
            "command_delay": e.experiment.command_delay,
        },
        "model": e.plant.name,
        "theta": {"name": e.theta_name, **e.theta._asdict()},
        "systematic": e.errors._asdict(),
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
        "identified": verdict.identified,
        "findings": [asdict(finding) | {"identified": finding.identified} for finding in verdict.findings],
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


def text(e: Evaluation, why_this_model: str) -> str:
    """The information for a person; what is missing comes before any number."""
    fit = f"angle {e.fit.angle:.3g} sigma, velocity {e.fit.velocity:.3g} sigma"
    lines = [
        *(f"WARNING: {warning}" for warning in e.warnings),
        *(f"NOTE: {note}" for note in e.notes),
        *_heading(e),
        *facts(
            ("model", f"{e.plant.name} ({why_this_model})"),
            ("model fit", f"{fit} (1 if it fits, {e.fit.expected:.2f} at most)"),
        ),
        *_unknowns(e.question),
        "",
    ]
    if not e.fisher("weighted").matrix.any():  # which has no prior
        return "\n".join([*lines, "nothing was excited: the record does not depend on any of these parameters"])
    final = {kind: e.fisher(kind).criteria().shown(e.bench.machine) for kind in KINDS}
    rows = [[label, *(f"{getattr(final[kind], name):.6g}" for kind in KINDS)] for label, name in CRITERIA.items()]
    lines += [*Table("", ("Fisher information", *KINDS), rows).lines(), f"  {final['physical'].verdict()}", ""]
    bound = "Cramer-Rao bound" if e.question.prior is None else "with the prior, to first order"
    lines.append(f"{bound}: smallest standard deviation, and what the record identifies")
    lines += [f"  {line}" for line in e.verdict().shown(e.bench.machine).text().splitlines()]
    return "\n".join([*lines, "", *_over_time(e).lines()])


def _over_time(e: Evaluation) -> Table:
    steps, names = evenly(e.experiment.periods, INSTANTS), (e.question.names, e.question.params)
    at = [bisect_left(e.instants, k) for k in steps]
    physical, weighted = (criteria_series(e.histories[kind][at], *names) for kind in KINDS)
    rows = [
        [
            f"{(k + 1) * e.bench.timing.sample_time * 1e3:.6g}",
            f"{det:.4f}",
            f"{least:.5g}",
            f"{trace:.5g}",
            f"{w:.4f}",
        ]
        for k, det, least, trace, w in zip(steps, *physical, weighted.log_det, strict=True)
    ]
    return Table("", ("time [ms]", "log det physical", "lambda_min", "tr M^-1", "log det weighted"), rows, words=())


def models_text(evaluations: Sequence[Evaluation]) -> str:
    """Fisher information of one record for every model of the brake, side by side, as text."""
    first = evaluations[0]
    lines = [f"WARNING: {missing}" for missing in (first.log.missing, *first.experiment.missing) if missing]
    if not any(e.fit.fits for e in evaluations):
        lines.append(f"WARNING: no model fits at {first.theta_name} parameters: they are not this brake's")
    names = first.question.names
    shown = {name: quantity(first.bench.machine, name) for name in names}
    lines += [
        f"NOTE: {name} is zero in {', '.join(lacking)}: there it neither shows nor costs the others"
        for name in names
        if (lacking := [e.plant.name for e in evaluations if name in e.absent])
    ]
    rows = []
    for e in evaluations:
        fisher = e.fisher("physical")
        c, bounds = fisher.criteria(), fisher.cramer_rao()
        rows.append(
            [
                *(e.plant.name, f"{e.fit.angle:.3g}", f"{e.fit.velocity:.3g}", _fits(e.fit)),
                *(f"{c.log_det:.3f}", f"{c.lambda_min:.4g}", f"{c.trace_inverse:.4g}"),
                *(f"{bounds[name] * (shown[name].factor if name in UNITS else 100.0):.4g}" for name in names),
            ]
        )
    header = ["model", "angle", "velocity", "fits", "log det", "lambda_min", "tr M^-1"]
    header += [f"{shown[name].name} [{shown[name].unit if name in UNITS else '%'}]" for name in names]
    title = "physical Fisher information, fit in sigmas, and the smallest standard deviation of each estimate"
    lines += [*_heading(first), *_unknowns(first.question), "", title, *Table("", header, rows).lines()]
    if any(e.fit.loose for e in evaluations):
        lines.append("loose: the model expects more noise than there is, and its bounds are too large")
    if first.log.truth:
        lines.append(f"what was simulated: {default_model(first.log)[0]}")
    return "\n".join(lines)


def _fits(fit: Fit) -> str:
    if fit.loose:
        return "loose"
    return "yes" if fit.fits else "no"


def _heading(e: Evaluation) -> list[str]:
    x, late, machine = e.experiment, e.experiment.command_delay, e.bench.machine
    periods = f"{x.periods} of {x.planned} periods, {int(x.measured.sum())} samples"
    if not e.log.imported:
        periods += f", {x.braked} periods braked by the node"
    if machine is None:
        theta = ", ".join(f"{name} = {getattr(e.theta, name):.4g}" for name in PARAMETER_NAMES)
    else:
        values = e.theta._asdict()
        names = [n for n in (*PARAMETER_NAMES, "J") if values[n] and (n != "k_m" or machine.command in CURRENT)]
        known = ((quantity(machine, name), values[name]) for name in names)
        theta = ", ".join(f"{shown.name} = {value * shown.factor:.4g} {shown.unit}" for shown, value in known)
    return facts(
        ("log", str(e.log.path)),
        ("run", "a recording that was imported" if e.log.imported else e.log.exit_reason),
        ("experiment", periods + (f"; commands acted {in_samples(late)} late" if late else "")),
        ("theta", f"{e.theta_name}: {theta}"),
    )


def _unknowns(q: Question) -> list[str]:
    also = f"{', '.join(q.nuisances)}; the criteria are those of the others (Ds)" if q.nuisances else ""
    prior = f"the ranges '{q.prior.name}'; the physical information begins there" if q.prior is not None else ""
    return facts(("unknown too", also), ("prior", prior))
