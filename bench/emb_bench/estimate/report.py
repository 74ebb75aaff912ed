"""A study in words, the verdict on the model first, and as a document for programs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from emb_bench.brake.unknowns import UNITS
from emb_bench.criteria import TRADED_OFF, combination
from emb_bench.estimate.bootstrap import Bootstrap
from emb_bench.estimate.conclusion import unit_of
from emb_bench.estimate.held_out import HeldOut
from emb_bench.estimate.profile import Profile, between
from emb_bench.estimate.records import METHODS, End, Estimate, Misfit
from emb_bench.estimate.refit import shared
from emb_bench.estimate.study import Study
from emb_runtime.bench import BrakeParameters

SAME = 1.0
"""Local searches whose weighted sums of squares differ by less ended in the same minimum: a shift of one sigma."""
SUSPICIOUS = 4.0
"""Standard deviations from which on an effect that the model lacks is named."""
SHOWN = 3
"""Most of them."""
WIDTH = 110
"""Columns of the text."""


def document(study: Study) -> dict[str, Any]:
    """Everything about a study; numbers may be infinite."""
    e, truth = study.estimate, study.truth
    verdict = e.verdict()
    findings = {finding.name: finding for finding in verdict.findings}
    rows = zip(e.unknowns, e.labels, e.values, e.intervals(), e.deviations(), e.cramer_rao(), e.robust(), strict=True)
    parameters = {}
    for unknown, label, value, interval, used, bound, robust in rows:
        finding = findings.get(label)
        parameters[label] = {
            "value": float(value),
            "unit": unit_of(unknown.name),
            "interval_95": interval.tolist(),
            "deviation": float(used),
            "deviation_relative": unknown.relative,
            "cramer_rao": float(bound),
            "sandwich": float(robust),
            "told": None if finding is None else finding.told,
            "why_not": "" if finding is None else finding.why_not,
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
        "model_fits": e.misfit.fits,
        "predicts": all(h.fits for h in (*study.held_out, *study.left_out)),
        "warnings": list(study.warnings),
        "records": [{"name": r.name, "periods": len(r.currents), "measured": int(r.measured.sum())} for r in e.records],
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
        "told": verdict.told,
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
    """The same for a person: what is wrong comes before any number."""
    e = study.estimate
    lines = [f"WARNING: {warning}" for warning in study.warnings]
    lines += [*_verdict_on_the_model(study), ""]
    lines += [f"record       {r.name}: {int(r.measured.sum())} of {len(r.currents)} samples" for r in e.records]
    lines += [f"method       {METHODS[e.method]}, model {e.plant.name} ({study.model_reason})"]
    if e.asked.prior is not None:
        lines.append(f"prior        the ranges '{e.asked.prior.name}', as a Gaussian of the same mean and variance")
    lines += [f"NOTE: {caveat}" for caveat in e.caveats]
    lines += ["", *_parameters(e, study.truth), "", *_conclusions(study), ""]
    verdict = e.verdict()
    lines += [direction.text() for direction in verdict.directions]
    lines += [f"from the prior alone: {combination(shares)}" for shares in verdict.left_to_prior]
    lines += [f"advice: {advice.words}" for advice in study.advice]
    lines += [f"profile      {profile.label}: {profile.words}" for profile in study.profiles]
    lines += _drawn_again(study.bootstrap)
    lines += [*_correlation(e), *_waterfall(e)]
    return "\n".join(piece for line in lines for piece in _wrapped(line))


def _wrapped(line: str) -> list[str]:
    """A line that is too long as several, those after the first one indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    pieces = textwrap.wrap(
        line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )
    return pieces or [""]


def _verdict_on_the_model(study: Study) -> list[str]:
    e, predicted = study.estimate, [*study.held_out, *study.left_out]
    m = e.misfit
    low, high = m.expected
    lines = []
    if study.fits:
        lines.append(f"the model '{e.plant.name}' may be the right one: nothing in the residuals speaks against it")
    elif m.fits:
        lines.append(
            f"WARNING: THE MODEL '{e.plant.name}' DOES NOT PREDICT what it was not fitted to: the values below"
        )
        lines.append("         hold for the records that they come from, and perhaps for no other")
    else:
        lines.append(f"WARNING: THE MODEL '{e.plant.name}' DOES NOT FIT: the values below are the best that it can do,")
        lines.append("         and their deviations do not cover what is wrong with it")
    lines += [f"  - {alarm}" for alarm in m.alarms]
    lines += [f"  - {h.name}: {h.words}" for h in predicted if not h.fits]
    found = [s for s in m.suspects[:SHOWN] if abs(s.sigmas) >= SUSPICIOUS]
    if found and not m.fits:
        amounts = "; ".join(f"{s.name} {s.value:+.3g} {UNITS[s.name]} ({abs(s.sigmas):.0f} sigma)" for s in found)
        lines.append(f"  - the residuals look like, each to first order: {amounts}; see --nuisance")
    lines += [f"NOTE: {note}" for note in m.notes]
    lines += ["", f"chi2/n       {m.ratio:.4g} of {m.freedom}, {low:.3f} to {high:.3f} expected (p = {m.chi2_p:.2g})"]
    for name, test in m.independence.items():
        white = m.whiteness[name]
        lines.append(
            f"{name:12} from the current: F = {test.statistic:.3g}, p = {test.p_value:.2g}; "
            f"from each other: Ljung-Box {white.statistic:.3g}, p = {white.p_value:.2g}"
        )
    return [*lines, *_predictions("held out", study.held_out), *_predictions("left out", study.left_out)]


def _predictions(title: str, found: Sequence[HeldOut]) -> list[str]:
    return [f"{title:12} {h.name}: {h.words}" for h in found]


def _parameters(e: Estimate, truth: BrakeParameters | None) -> list[str]:
    known = ["simulated", "off by"] if truth is not None else []
    lines = [
        f"{'parameter':11}{'estimate':>13} {'95 %':>11} {'':10}{'sigma':>12}{'robust':>12}"
        + "".join(f"{title:>13}" for title in known)
    ]
    rows = zip(e.unknowns, e.labels, e.values, e.intervals(), e.deviations(), e.robust(), strict=True)
    for unknown, label, value, (low, high), used, robust in rows:
        cells = []
        if truth is not None and hasattr(truth, unknown.name):
            true = getattr(truth, unknown.name)
            off = f"{(value - true) / (used * abs(value)):+.2f} sigma" if math.isfinite(used) else "-"
            cells = [f"{true:13.6g}", f"{off:>13}"]
        lines.append(
            f"{label:11}{value:13.7g} {f'± {0.5 * (high - low):.3g}':>11} {unit_of(unknown.name):10}"
            f"{_spread(used, unknown.relative):>12}{_spread(robust, unknown.relative):>12}{''.join(cells)}"
        )
    return lines


def _spread(deviation: float, relative: bool) -> str:
    return f"{100.0 * deviation:.3g} %" if relative else f"{deviation:.3g}"


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
    if not e.ends:
        return []
    groups = minima(e.ends)
    lines = [f"where {len(e.ends)} local searches ended, best first"]
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
