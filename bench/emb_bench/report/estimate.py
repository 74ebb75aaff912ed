"""A study as a document for programs and as text for a person."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from emb_bench.analysis.study import Code, Study, verdict
from emb_bench.brake.motion import Floats
from emb_bench.documents import to_json
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import METHODS
from emb_bench.information.identifiability import schur_complement
from emb_bench.numbers import p_value, signed
from emb_bench.report import sentences as say
from emb_bench.report import tables
from emb_bench.report.caveats import caveats
from emb_bench.report.information import directions, doubts, trade_offs
from emb_bench.report.text import Table, facts, listed, wrapped
from emb_runtime.numbers import plain

SCALE = "to improve: docs/howto/below-two-percent.md"  # If J limits an interval
NOTICED = 2.0  # Score above which an effect without an alarm is named [standard deviations]


def study_text(study: Study, *, verbose: bool = False) -> str:
    """Verdict, parameters, what limits them, next step; with ``verbose`` also the evidence."""
    e, found = study.estimate, verdict(study)
    lines = [
        *stops(study),
        *listed("", [*(line for _, line in say.outside(study, e.bench)), say.simulated(study)]),
        *listed("WARNING: ", say.missing(study)),
    ]
    if found.code is Code.ABORTED and not verbose:
        return "\n".join([*lines, "next: find the cause before the next run   (-v shows values until the stop)"])
    against = list(_against(study))
    lines += wrapped(say.headline(study))
    lines += listed("  - ", against if verbose or study.model_fits else against[:1])
    lines += listed("NOTE: ", _notes(study))
    lines += ["", *tables.parameters(study, brief=True).lines()]
    lines += listed("  - ", _remarks(study, trades=found.holds or verbose))
    if not any(math.isfinite(c.repeatability) for c in study.conclusions):
        lines += [""]
    elif found.holds or verbose:
        lines += [*wrapped(say.intervals(e), 0), ""]
        lines += listed("", [say.clamping(study), *_limits(study)])
    else:
        lines += [say.without(study), ""]
    return "\n".join([*lines, *_next(study), *(_evidence(study) if verbose else ())])


def stops(study: Study) -> Iterator[str]:
    """Lines on the runs that were stopped: cause and advice."""
    for stop in study.stops:
        yield from wrapped(say.stopped(stop))
        yield from facts(("  cause", stop.cause), ("  advice", stop.advice))


def _against(study: Study) -> Iterator[str]:
    """Reasons against the model."""
    if not verdict(study).biased:
        yield from say.alarms(study.estimate)
    yield from (f"{h.name}: {say.held_out(h)}" for h in study.checks.held_out if not h.fits)


def _notes(study: Study) -> list[str]:
    """Qualifications of the values."""
    apart = [say.apart(study)] if study.checks.apart else []
    return [*say.assumptions(study), *apart, say.changed_model(study), say.models(study), *caveats(study.estimate)]


def _remarks(study: Study, *, trades: bool) -> Iterator[str]:
    """Doubts and changes of parameters, with ``trades`` also trade-offs; equal remarks once, with all parameters."""
    labels_of: dict[str, list[str]] = {}
    for c in study.conclusions:
        remarks = [doubts(c.finding), trade_offs(c.finding) if trades else ""]
        remarks += [say.drift(c.drift)] if c.drift is not None else []
        if text := "; ".join(filter(None, remarks)):
            labels_of.setdefault(text, []).append(c.label)
    yield from (f"{', '.join(labels)}: {text}" for text, labels in labels_of.items())


def _limits(study: Study) -> Iterator[str]:
    """Effects that limit the intervals, and effects with a high score but no alarm."""
    e = study.estimate
    by: dict[str, list[str]] = {}
    for i in e.requested():
        if (suspect := e.largest_bias(i)) is not None and e.unmodelled_bias()[i] > e.cramer_rao()[i]:
            by.setdefault(say.limit(suspect, e), []).append(e.labels[i])
    if by:
        more = [SCALE] if any(name.startswith("J, known to") for name in by) else []
        yield "limited by  " + "; ".join([*(f"{name} ({', '.join(labels)})" for name, labels in by.items()), *more])
    if tested := e.validation.suspects:
        hints = [
            f"{s.name} {signed(s.sigmas, '+.1f')}"
            for s in tested
            if s.possible and abs(s.sigmas) >= NOTICED and s.p_value < 0.5
        ]
        if not hints:
            yield f"effects     {len(tested)} tested, none above {NOTICED:g} sigma"
        elif e.validation.fits:
            yield f"effects     {', '.join(hints[:4])} sigma, below the level of an alarm"


def _next(study: Study) -> list[str]:
    """The next step, or several to choose from."""
    found = say.remedies(study, stopped=bool(study.stops))
    found = ["find the cause of the stop before the next run"] if study.stops else found
    found = found or [f"emb-replay report {say.logs_of(study)} -o report.html   (-v shows the evidence)"]
    return listed("next: ", found) if len(found) == 1 else ["next", *listed("  - ", found)]


def _evidence(study: Study) -> Iterator[str]:
    """Tests and tables behind the answer."""
    e, m = study.estimate, study.estimate.validation
    measured = (
        f"{name}: {experiment.measured.sum()} of {experiment.periods} samples"
        for name, experiment in zip(study.names, e.experiments, strict=True)
    )
    expected = f"{plain(m.ratio, 4)} of {m.freedom}, {m.expected[0]:.3f} to {m.expected[1]:.3f} expected"
    yield ""
    yield from facts(
        *(("record", line) for line in measured),
        ("method", f"{METHODS[e.method]}, model {e.plant.name} ({say.model_reason(study)})"),
        ("prior", say.prior(e)),
        ("chi2/n", f"{expected} ({p_value(m.chi2_p)})"),
    )
    yield from listed("NOTE: ", () if verdict(study).biased else say.residual_notes(e))
    yield ""
    correlation, pairs = tables.correlation(e)
    found: list[Table | None] = [
        *(tables.models(study), tables.errors(study), tables.budget(study), tables.ratios(e)),
        *(tables.residual_tests(study), tables.suspects(e), tables.systematic(e), tables.predicted(study)),
        correlation,
    ]
    for table in found:
        yield from [] if table is None else table.text("  ")
    yield from listed("NOTE: ", [say.pairs(pairs) if pairs else "", say.once(study)])
    yield from listed("", directions(e.identifiability()))
    yield from listed("", (f"profile of {p.label}: {say.profile(p, e)}" for p in study.checks.profiles))


def study_document(study: Study) -> dict[str, Any]:
    """Everything about a study; numbers may be infinite."""
    e, checks = study.estimate, study.checks
    choice = checks.choice
    index, validation = e.requested(), e.validation
    found = {
        "simulated": any(log.simulated for log in study.logs),
        "method": METHODS[e.method],
        "method_name": e.method,
        "model": e.plant.name,
        "records": [
            {"name": log.path, "periods": len(r.currents), "measured": r.measured.sum()}
            for log, r in zip(study.logs, e.experiments, strict=True)
        ],
        "params": e.question.params,
        "nuisances": e.question.nuisances,
        "systematic": _systematic(e),
        "prior": e.question.prior.name if e.question.prior else None,
        "misfit": {
            **to_json(validation),
            "chi2_per_freedom": validation.ratio,
            "alarms": say.alarms(e),
            "notes": say.residual_notes(e),
        },
        "parameters": _parameters(study),
        "clamping": None if study.clamping is None else to_json(study.clamping),
        "ratios": {one.name: _fields(one, "value", "unit") | {"interval_95": one.interval} for one in e.ratios()},
        "models": [
            _fields(c, "fits", "deviance", "bic", "weight")
            | {"model": c.name, "held_out_log_density": c.held_out, "changes": choice.changes(c)}
            | {"chi2_per_freedom": c.estimate.validation.ratio}
            for c in (choice.candidates if choice is not None else ())
            if choice is not None
        ],
        "models_left_out": choice.same if choice is not None else (),
        "not_told_apart": [c.name for c in choice.plausible] if choice and len(choice.plausible) > 1 else None,
        "correlation": {
            "names": [e.labels[i] for i in index],
            "matrix": e.correlation()[np.ix_(index, index)],
        },
        "information": schur_complement(e.information, index),
        "directions": e.identifiability().directions,
        "left_to_prior": e.identifiability().left_to_prior,
        "profiles": [
            _fields(p, "label", "values", "rise", "doubt") | {"interval_95": p.interval} for p in checks.profiles
        ],
        "starts": [
            _fields(end, "cost", "converged", "evaluations")
            | {"values": _by_label(e, end.z), "from": _by_label(e, end.start)}
            for end in e.ends
        ],
    }
    found |= {
        "warnings": say.missing(study),
        "notes": say.assumptions(study),
        "model_reason": say.model_reason(study),
        "other_model": say.other_model(e, study.last),
        "caveats": caveats(e),
    }
    found |= {
        "stopped": [run.stop for run in study.used if run.stop],
        "model_fits": study.model_fits,
        "predicts": checks.predicts,
        "identified": not study.unidentified,
        "drifts": checks.drifts,
        "left_out": checks.held_out,
        "apart": checks.apart,
    }
    document: dict[str, Any] = to_json(found | _fields(e, "process_noise", "load_noise", "theta"))
    return document


def _fields(record: object, *names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


def _by_label(e: Estimate, z: Floats) -> dict[str, float]:
    """Values of the unknowns by label."""
    return dict(zip(e.labels, e.problem.values(z).tolist(), strict=True))


def _systematic(e: Estimate) -> dict[str, Any]:
    """Systematic errors that were estimated with the parameters."""
    return {
        label: {"value": value, "deviation": deviation, "deviation_before": e.question.systematic[unknown.name]}
        for unknown, label, value, deviation in zip(e.unknowns, e.labels, e.values, e.deviations(), strict=True)
        if unknown.name in e.question.systematic
    }


def _parameters(study: Study) -> dict[str, dict[str, Any]]:
    e, found = study.estimate, {}
    columns = (e.deviations(), e.cramer_rao(), e.robust(), e.unmodelled_bias())
    for i, c in zip(e.requested(), study.conclusions, strict=True):
        unknown = e.unknowns[i]
        used, bound, robust, model = (column[i] for column in columns)
        suspect = e.largest_bias(i)
        found[c.label] = {
            **_fields(c, "value", "unit", "repeatability", "identified", "standing", "outside"),
            **_fields(c.finding, "doubts", "traded_with"),
            "interval_95": c.interval,
            "deviation": used,
            "deviation_relative": unknown.relative,
            "deviation_between_runs": e.between_runs()[i],
            "effects": e.effects(i),
            "cramer_rao": bound,
            "sandwich": robust,
            "left_open": model,
            "left_open_by": None if suspect is None else suspect.name,
            "at_bound": c.label in e.at_bound,
        }
        if study.truth is not None and hasattr(study.truth, unknown.name):
            found[c.label]["true"] = getattr(study.truth, unknown.name)
    return found
