"""A study as a document for programs and as text for a person."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from emb_bench.analysis.study import Study, file_names
from emb_bench.estimate.records import METHODS
from emb_bench.estimate.suspects import explained
from emb_bench.information.identifiability import schur_complement
from emb_bench.report import render, tables
from emb_bench.report.render import phrase


def document(study: Study) -> dict[str, Any]:
    """Everything about a study; numbers may be infinite."""
    e, m, verdict, b = study.estimate, study.estimate.validation, study.estimate.verdict(), study.bootstrap
    drifts, wanted = {d.name: phrase("drift", d) for d in study.drifts}, e.wanted()
    factors = np.array([quantity.factor for quantity in e.shown])
    shared = np.array([e.factor(label) for label in b.labels]) if b is not None else factors
    return {
        "method": METHODS[e.method],
        "method_name": e.method,
        "caveats": list(e.caveats),
        "process_noise": e.process_noise,
        "load_noise": e.load_noise,
        "model": e.plant.name,
        "model_reason": study.model_reason,
        "model_fits": study.model_fits,
        "predicts": study.predicts,
        "warnings": list(study.warnings),
        "notes": list(study.notes),
        "records": [
            {"name": str(path), "periods": len(r.currents), "measured": int(r.measured.sum())}
            for path, r in zip(study.logs, e.records, strict=True)
        ],
        "params": list(e.asked.params),
        "nuisances": list(e.asked.nuisances),
        "systematic": {
            e.labels[i]: {
                "value": float(e.values[i]),
                "deviation": float(e.deviations()[i]),
                "deviation_before": e.asked.systematic[unknown.name],
            }
            for i, unknown in enumerate(e.unknowns)
            if unknown.name in e.asked.systematic
        },
        "prior": e.asked.prior.name if e.asked.prior else None,
        "bounds": {name: list(pair) for name, pair in e.asked.bounds.items()},
        "misfit": {
            "chi2": m.chi2,
            "freedom": m.freedom,
            "chi2_per_freedom": m.ratio,
            "expected": list(m.expected),
            "p_value": m.chi2_p,
            "whiteness": {name: asdict(test) for name, test in m.whiteness.items()},
            "independence": {name: asdict(test) for name, test in m.independence.items()},
            "suspects": [_fields(s, "name", "value", "sigmas", "p_value") for s in m.suspects],
            "suspected": [
                _fields(s, "name", "value", "sigmas", "p_value") | {"words": explained(s, e.bench.machine)}
                for s in m.suspected
            ],
            "suspects_together": None if m.together is None else _fields(m.together, "statistic", "p_value"),
            "alarms": list(m.alarms),
            "notes": list(m.notes),
        },
        "held_out": [asdict(h) | {"words": phrase("held_out", h)} for h in study.held_out],
        "left_out": [asdict(h) | {"words": phrase("held_out", h)} for h in study.left_out],
        "theta": e.theta._asdict(),
        "parameters": _parameters(study),
        "conclusions": [
            _fields(c, "label", "value", "unit")
            | {"interval": list(c.interval)}
            | {"of_interest": c.of_interest, "identified": c.identified, "why_not": c.why_not}
            | {"words": phrase("conclusion", c)}
            for c in study.conclusions
        ],
        "apart": [asdict(one) for one in study.apart],
        "models": _models(study),
        "models_left_out": list(study.choice.same) if study.choice is not None else [],
        "not_told_apart": None
        if study.choice is None or len(study.choice.left_over) < 2
        else {"models": [c.name for c in study.choice.left_over], "words": phrase("models", study)},
        "growth": [asdict(one) for one in study.growth.rounds] if study.growth is not None else [],
        "correlation": {
            "names": [e.labels[i] for i in wanted],
            "matrix": e.correlation()[np.ix_(wanted, wanted)].tolist(),
        },
        "information": schur_complement(e.information, wanted).tolist(),
        "identified": study.identified,
        "directions": [asdict(direction) for direction in verdict.directions],
        "left_to_prior": [dict(shares) for shares in verdict.left_to_prior],
        "advice": [
            _fields(r, "excitation", "direction", "before", "after") | {"words": phrase("recommendation", r)}
            for r in study.advice
        ],
        "drifts": [
            _fields(d, "name", "last", "last_deviation", "now", "deviation", "relative_change", "sigmas", "drifted")
            | {"words": drifts[d.name]}
            for d in study.drifts
        ],
        "profiles": [
            {
                "label": p.label,
                "values": p.values.tolist(),
                "rise": p.rise.tolist(),
                "interval_95": list(p.interval),
                "shape": p.shape,
                "words": phrase("profile", p, e),
            }
            for p in (own.scaled(e.factor(own.label)) for own in study.profiles)
        ],
        "bootstrap": None
        if b is None
        else {
            "labels": list(b.labels),
            "draws": len(b.values) + b.failed,
            "failed": b.failed,
            "intervals_95": dict(zip(b.labels, (b.intervals * shared[:, None]).tolist(), strict=True)),
            "deviations": dict(zip(b.labels, (b.deviations * shared).tolist(), strict=True)),
        },
        "starts": [
            {
                "cost": end.cost,
                "values": dict(zip(e.labels, np.multiply(end.values, factors).tolist(), strict=True)),
                "from": dict(zip(e.labels, np.multiply(end.start, factors).tolist(), strict=True)),
                "converged": end.converged,
                "evaluations": end.evaluations,
            }
            for end in e.ends
        ],
    }


def _models(study: Study) -> list[dict[str, Any]]:
    """Models that were compared, best first; empty if one was given."""
    choice = study.choice
    return [
        {
            "model": c.name,
            "fits": c.fits,
            "chi2_per_freedom": c.estimate.validation.ratio,
            "deviance": c.deviance,
            "aic": c.aic,
            "bic": c.bic,
            "held_out_log_density": c.held_out,
            "weight": c.weight,
            "changes": [asdict(change) for change in choice.changes(c)],
        }
        for c in (choice.candidates if choice is not None else ())
        if choice is not None
    ]


def _parameters(study: Study) -> dict[str, dict[str, Any]]:
    e, found = study.estimate, {}
    findings = {finding.name: finding for finding in e.verdict().findings}
    columns = (e.deviations(), e.cramer_rao(), e.robust(), e.open())
    for i, c in zip(e.wanted(), study.conclusions, strict=True):
        unknown = e.unknowns[i]
        factor = 1.0 if unknown.relative else e.shown[i].factor
        used, bound, robust, left_open = (factor * column[i] for column in columns)
        finding = findings.get(c.label)
        found[c.label] = {
            "value": c.value,
            "unit": c.unit,
            "interval_95": list(c.interval),
            "deviation": float(used),
            "deviation_relative": unknown.relative,
            "cramer_rao": float(bound),
            "sandwich": float(robust),
            "left_open": float(left_open),
            "left_open_by": None if (suspect := e.left_open_by(i)) is None else suspect.name,
            "identified": c.identified,
            "why_not": c.why_not,
            "traded_with": {} if finding is None else dict(finding.traded_with),
            "at_bound": c.label in e.at_bound,
        }
        if study.truth is not None and hasattr(study.truth, unknown.name):
            found[c.label]["true"] = getattr(study.truth, unknown.name)
    return found


def _fields(record: object, *names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


def text(study: Study) -> str:
    """Text of a study: warnings, conclusions, recommended runs, and then their evidence."""
    e = study.estimate
    correlation, pairs = tables.correlation(e)
    shared = {e.labels[i] for i in e.shared()}
    said = [c for c in study.conclusions if c.label in shared or not c.identified]
    return render.text(
        "estimate.txt.j2",
        study=study,
        e=e,
        records=list(zip(file_names(study.logs), e.records, strict=True)),
        said=said,
        width=max(9, *(len(c.label) + 2 for c in said)),
        values=tables.values(study),
        deviations=tables.deviations(study),
        tests=tables.residual_tests(study),
        suspects=tables.suspects(e),
        systematic=tables.systematic(e),
        predicted=tables.predicted(study),
        models=tables.models(study),
        growth=tables.growth_path(study),
        bootstrap=tables.bootstrap(study),
        correlation=correlation,
        pairs=pairs,
        minima=tables.minima(study),
        verdict=e.verdict(),
    )
