"""A study in words, the verdict on the model first, and as a document for programs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from emb_bench.analysis.bootstrap import Bootstrap
from emb_bench.analysis.held_out import HeldOut
from emb_bench.analysis.profile import Profile
from emb_bench.analysis.study import Study, file_names
from emb_bench.brake.parameters import SI, UNITS
from emb_bench.estimate.records import METHODS, End, Estimate, Misfit, chance
from emb_bench.estimate.refit import shared
from emb_bench.information.criteria import TRADED_OFF, combination
from emb_bench.numbers import between, spread
from emb_runtime.config.bench import BrakeParameters

SAME = 1.0
"""Local searches whose weighted sums of squares differ by less ended in the same minimum: a shift of one sigma."""
SUSPICIOUS = 4.0
"""Standard deviations from which on an effect that the model lacks is named."""
SHOWN = 3
"""Most of them."""
SIMULATING = ("oem", "ensemble")
"""Methods that take the brake to move as the model says and nothing else."""
DISTURBED = "if no other model fits, something may disturb the brake: --method pem takes that into account"
WIDTH = 110
"""Columns of the text."""


def document(study: Study) -> dict[str, Any]:
    """Everything about a study; numbers may be infinite."""
    e, truth = study.estimate, study.truth
    verdict = e.verdict()
    findings = {finding.name: finding for finding in verdict.findings}
    rows = zip(e.unknowns, study.conclusions, e.deviations(), e.cramer_rao(), e.robust(), strict=True)
    parameters = {}
    for unknown, concluded, used, bound, robust in rows:
        label, finding = concluded.label, findings.get(concluded.label)
        parameters[label] = {
            "value": concluded.value,
            "unit": concluded.unit,
            "interval_95": list(concluded.interval),
            "deviation": float(used),
            "deviation_relative": unknown.relative,
            "cramer_rao": float(bound),
            "sandwich": float(robust),
            "told": concluded.told,
            "why_not": concluded.why_not,
            "traded_with": {} if finding is None else dict(finding.traded_with),
            "at_bound": label in e.at_bound,
        }
        if truth is not None and hasattr(truth, unknown.name):
            parameters[label]["true"] = getattr(truth, unknown.name)
    return {
        "method": METHODS[e.method],
        "method_name": e.method,
        "caveats": list(e.caveats),
        "process_noise": e.process_noise,
        "model": e.plant.name,
        "model_reason": study.model_reason,
        "model_fits": study.model_fits,
        "predicts": study.predicts,
        "warnings": list(study.warnings),
        "records": [
            {"name": str(path), "periods": len(r.currents), "measured": int(r.measured.sum())}
            for path, r in zip(study.logs, e.records, strict=True)
        ],
        "params": list(e.asked.params),
        "nuisances": list(e.asked.nuisances),
        "prior": e.asked.prior.name if e.asked.prior else None,
        "bounds": {name: list(pair) for name, pair in e.asked.bounds.items()},
        "misfit": _misfit(e.misfit),
        "held_out": [asdict(h) for h in study.held_out],
        "left_out": [asdict(h) for h in study.left_out],
        "theta": e.theta._asdict(),
        "parameters": parameters,
        "conclusions": [asdict(c) | {"interval": list(c.interval)} for c in study.conclusions],
        "correlation": {"names": list(e.labels), "matrix": e.correlation().tolist()},
        "information": e.information.tolist(),
        "identified": study.told,
        "directions": [asdict(direction) for direction in verdict.directions],
        "left_to_prior": [dict(shares) for shares in verdict.left_to_prior],
        "advice": [asdict(advice) for advice in study.advice],
        "drifts": [asdict(drift) for drift in study.drifts],
        "profiles": [_profile(profile) for profile in study.profiles],
        "bootstrap": None if study.bootstrap is None else _bootstrap(study.bootstrap),
        "starts": [
            {
                "cost": end.cost,
                "values": dict(zip(e.labels, end.values, strict=True)),
                "from": dict(zip(e.labels, end.start, strict=True)),
                "converged": end.converged,
                "evaluations": end.evaluations,
            }
            for end in e.ends
        ],
    }


def _misfit(m: Misfit) -> dict[str, Any]:
    return {
        "chi2": m.chi2,
        "freedom": m.freedom,
        "chi2_per_freedom": m.ratio,
        "expected": list(m.expected),
        "p_value": m.chi2_p,
        "whiteness": {name: asdict(test) for name, test in m.whiteness.items()},
        "independence": {name: asdict(test) for name, test in m.independence.items()},
        "suspects": [asdict(suspect) for suspect in m.suspects],
        "alarms": list(m.alarms),
        "notes": list(m.notes),
    }


def _profile(p: Profile) -> dict[str, Any]:
    return {
        "label": p.label,
        "values": p.values.tolist(),
        "rise": p.rise.tolist(),
        "interval_95": list(p.interval),
        "shape": p.shape,
        "words": p.words,
    }


def _bootstrap(b: Bootstrap) -> dict[str, Any]:
    return {
        "labels": list(b.labels),
        "draws": len(b.values) + b.failed,
        "failed": b.failed,
        "intervals_95": dict(zip(b.labels, b.intervals.tolist(), strict=True)),
        "deviations": dict(zip(b.labels, b.deviations.tolist(), strict=True)),
    }


def text(study: Study) -> str:
    """The same for a person: what is wrong, what is known, what to do, and then what that stands on."""
    e = study.estimate
    lines = [f"WARNING: {warning}" for warning in study.warnings]
    lines += [*_verdict_on_the_model(study), *(f"NOTE: {caveat}" for caveat in e.caveats)]
    lines += ["", *_conclusions(study), *_next(study)]
    lines += ["", "what this stands on", ""]
    records = zip(e.records, file_names(study.logs), strict=True)
    lines += [f"record       {name}: {int(r.measured.sum())} of {len(r.currents)} samples" for r, name in records]
    lines += [f"method       {METHODS[e.method]}, model {e.plant.name} ({study.model_reason})"]
    if e.asked.prior is not None:
        lines.append(f"prior        the ranges '{e.asked.prior.name}', as a Gaussian of the same mean and variance")
    lines += ["", *_parameters(e, study.truth), "", *_tests(study), ""]
    verdict = e.verdict()
    lines += [direction.text() for direction in verdict.directions]
    lines += [f"from the prior alone: {combination(shares)}" for shares in verdict.left_to_prior]
    lines += [f"profile      {profile.label}: {profile.words}" for profile in study.profiles]
    lines += _drawn_again(study.bootstrap)
    lines += [*_correlation(e), *_waterfall(e)]
    return "\n".join(piece for line in lines for piece in _wrapped(line)).rstrip()


def _wrapped(line: str) -> list[str]:
    """A line that is too long as several, those after the first one indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    pieces = textwrap.wrap(
        line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )
    return pieces or [""]


def _verdict_on_the_model(study: Study) -> list[str]:
    m = study.estimate.misfit
    lines = [study.headline]
    if not study.biased:  # the tests then speak of the method
        lines += [f"  - {alarm}" for alarm in m.alarms] + [f"NOTE: {note}" for note in m.notes]
    return [*lines, *(f"  - {h.name}: {h.words}" for h in (*study.held_out, *study.left_out) if not h.fits)]


def remedies(study: Study) -> list[str]:
    """What to try where the model does not fit or predict, first things first."""
    e = study.estimate
    if study.holds:
        return []
    if study.biased:
        return ["ask another method: --method oem"]
    if study.model_fits:
        return [
            "find out what differs between the runs: something that changed, the homing (--nuisance offset), or a "
            "model that is right only where it was fitted (--model)"
        ]
    lines = ["find the plant that fits: emb-replay fim LOG --model all, then --model with its name"]
    if found := [s for s in e.misfit.suspects[:SHOWN] if abs(s.sigmas) >= SUSPICIOUS]:
        amounts = "; ".join(f"{s.name} {s.value:+.3g} {UNITS[s.name]} ({abs(s.sigmas):.0f} sigma)" for s in found)
        lines.append(f"if none does: the residuals look like, each to first order: {amounts}; see --nuisance")
    return [*lines, *([DISTURBED] if e.method in SIMULATING else [])]


def warned(study: Study) -> list[str]:
    """What may come in the way of a further run."""
    if not study.stopped:
        return []
    return [
        f"a run of this brake was stopped ({', '.join(study.stopped)}): the next one may be stopped as well, and tell "
        "less than is said here; find out why first"
    ]


def _next(study: Study) -> list[str]:
    """What to do, first things first."""
    lines = [*remedies(study), *(advice.words for advice in study.advice)]
    if study.advice:
        lines += warned(study)
    return ["", "what to do next", *(f"  - {line}" for line in lines)] if lines else []


def _tests(study: Study) -> list[str]:
    """The numbers that the verdict on the model stands on."""
    m = study.estimate.misfit
    low, high = m.expected
    lines = [f"chi2/n       {m.ratio:.4g} of {m.freedom}, {low:.3f} to {high:.3f} expected ({chance(m.chi2_p)})"]
    for name, test in m.independence.items():
        white = m.whiteness[name]
        lines.append(
            f"{name:12} from the current: F = {test.statistic:.3g}, {chance(test.p_value)}; "
            f"from each other: Ljung-Box {white.statistic:.3g}, {chance(white.p_value)}"
        )
    return [*lines, *_predictions("held out", study.held_out), *_predictions("left out", study.left_out)]


def _predictions(title: str, found: Sequence[HeldOut]) -> list[str]:
    return [f"{title:12} {h.name}: {h.words}" for h in found]


def _parameters(e: Estimate, truth: BrakeParameters | None) -> list[str]:
    known = ["simulated", "off by"] if truth is not None else []
    lines = [
        f"{'parameter':11}{'estimate':>13} {'':10}{'sigma':>14}{'robust':>14}"
        + "".join(f"{title:>13}" for title in known)
    ]
    rows = zip(e.unknowns, e.labels, e.values, e.deviations(), e.robust(), strict=True)
    for unknown, label, value, used, robust in rows:
        cells = []
        if truth is not None and hasattr(truth, unknown.name):
            true = getattr(truth, unknown.name)
            off = f"{(value - true) / (used * abs(value)):+.2f} sigma" if math.isfinite(used) else "-"
            cells = [f"{true:13.6g}", f"{off:>13}"]
        lines.append(
            f"{label:11}{value:13.7g} {SI[unknown.name]:10}"
            f"{spread(used, unknown.relative):>14}{spread(robust, unknown.relative):>14}{''.join(cells)}"
        )
    return lines


def _conclusions(study: Study) -> list[str]:
    """Of every parameter, and of the nuisances that are not as they should be."""
    said = [c for c in study.conclusions if c.of_interest or not c.told]
    return ["in words", *(f"  {c.label:9}{c.words}" for c in said)]


def _drawn_again(b: Bootstrap | None) -> list[str]:
    if b is None:
        return []
    draws = len(b.values) + b.failed
    lines = [
        f"bootstrap over runs, {draws} draws" + (f", {b.failed} of which did not end in a minimum" * (b.failed > 0))
    ]
    rows = zip(b.labels, b.intervals.tolist(), b.deviations.tolist(), strict=True)
    return [*lines, *(f"  {label:9}{between(low, high)} (sigma {s:.2g})" for label, (low, high), s in rows), ""]


def _correlation(e: Estimate) -> list[str]:
    """Of what all records share."""
    index = shared(e)
    if len(index) < 2:
        return []
    labels, matrix = [e.labels[i] for i in index], e.correlation()[index][:, index]
    lines = ["correlation " + "".join(f"{label:>10}" for label in labels)]
    for label, row in zip(labels, matrix.tolist(), strict=True):
        lines.append(f"  {label:10}" + "".join(f"{value:10.3f}" for value in row))
    pairs = [
        f"{labels[i]} and {labels[j]}"
        for i in range(len(labels))
        for j in range(i)
        if abs(matrix[i, j]) > TRADED_OFF and math.isfinite(matrix[i, j])
    ]
    return [*lines, *([f"NOTE: nearly one number to these records: {', '.join(pairs)}"] if pairs else []), ""]


def minima(ends: Sequence[End]) -> list[list[End]]:
    """Local searches by the minimum where they ended, best first."""
    groups: list[list[End]] = []
    for end in ends:
        if groups and end.cost - groups[-1][0].cost <= SAME:
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


def _waterfall(e: Estimate) -> list[str]:
    if not e.ends or e.method == "rls":  # whose sum of squares is of the regression, not of the samples
        return []
    groups = minima(e.ends)
    count = f"{len(e.ends)} local searches" if len(e.ends) > 1 else "the local search"
    lines = [f"where {count} ended, best first"]
    for group in groups:
        values = ", ".join(f"{e.labels[i]} {group[0].values[i]:.5g}" for i in shared(e))
        given_up = sum(not end.converged for end in group)
        lines.append(
            f"  {len(group):3} x chi2 {group[0].cost:12.6g}   {values}"
            + (f"   ({given_up} did not converge)" if given_up else "")
        )
    if len(e.ends) > 1 and len(groups[0]) == 1:
        lines.append("NOTE: the best minimum was found only once: ask for more --starts")
    return lines
