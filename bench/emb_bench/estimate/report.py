"""An estimate in words, the verdict on the model first, and as a document for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from emb_bench.brake.unknowns import UNITS
from emb_bench.criteria import TRADED_OFF, combination
from emb_bench.estimate.records import End, Estimate, Misfit
from emb_runtime.bench import BrakeParameters

SAME = 1.0
"""Local searches whose weighted sums of squares differ by less ended in the same minimum: a shift of one sigma."""
SI = {"k_m": "N·m/A", "k_1": "N/rad", "T_c": "N·m", "f_v": "N·m·s/rad", "J": "kg·m²"}
SUSPICIOUS = 4.0
"""Standard deviations from which on an effect that the model lacks is named."""
SHOWN = 3
"""Most of them."""


def document(
    e: Estimate, warnings: Sequence[str], model_reason: str, truth: BrakeParameters | None = None
) -> dict[str, Any]:
    """Everything about an estimate; numbers may be infinite."""
    verdict = e.verdict()
    shared = {finding.name: finding for finding in verdict.findings}
    rows = zip(e.unknowns, e.labels, e.values, e.intervals(), e.deviations(), e.cramer_rao(), e.robust(), strict=True)
    parameters = {}
    for unknown, label, value, interval, used, bound, robust in rows:
        finding = shared.get(label)
        parameters[label] = {
            "value": float(value),
            "unit": SI.get(unknown.name) or UNITS[unknown.name],
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
        "method": "output error",
        "model": e.plant.name,
        "model_reason": model_reason,
        "model_fits": e.misfit.fits,
        "warnings": list(warnings),
        "records": [{"name": r.name, "periods": len(r.currents), "measured": int(r.measured.sum())} for r in e.records],
        "params": list(e.asked.params),
        "nuisances": list(e.asked.nuisances),
        "prior": e.asked.prior.name if e.asked.prior else None,
        "misfit": _misfit(e.misfit),
        "theta": e.theta._asdict(),
        "parameters": parameters,
        "correlation": {"names": list(e.labels), "matrix": e.correlation().tolist()},
        "information": e.information.tolist(),
        "told": verdict.told,
        "directions": [asdict(direction) for direction in verdict.directions],
        "left_to_prior": [dict(shares) for shares in verdict.left_to_prior],
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


def text(e: Estimate, warnings: Sequence[str], model_reason: str, truth: BrakeParameters | None = None) -> str:
    """The same for a person: what is wrong comes before any number."""
    lines = [f"WARNING: {warning}" for warning in warnings]
    lines += [*_verdict_on_the_model(e), ""]
    for record in e.records:
        lines.append(f"record       {record.name}: {int(record.measured.sum())} of {len(record.currents)} samples")
    lines += [f"method       output error, model {e.plant.name} ({model_reason})"]
    if e.asked.prior is not None:
        lines.append(f"prior        the ranges '{e.asked.prior.name}', as a Gaussian of the same mean and variance")
    lines += ["", *_parameters(e, truth), ""]
    verdict = e.verdict()
    lines += [direction.text() for direction in verdict.directions]
    lines += [f"from the prior alone: {combination(shares)}" for shares in verdict.left_to_prior]
    return "\n".join([*lines, *_correlation(e), *_waterfall(e)])


def _verdict_on_the_model(e: Estimate) -> list[str]:
    m = e.misfit
    low, high = m.expected
    lines = []
    if m.fits:
        lines.append(f"the model '{e.plant.name}' may be the right one: nothing in the residuals speaks against it")
    else:
        lines.append(f"WARNING: THE MODEL '{e.plant.name}' DOES NOT FIT: the values below are the best that it can do,")
        lines.append("         and their deviations do not cover what is wrong with it")
        lines += [f"  - {alarm}" for alarm in m.alarms]
        found = [s for s in m.suspects[:SHOWN] if abs(s.sigmas) >= SUSPICIOUS]
        if found:
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
    return lines


def _parameters(e: Estimate, truth: BrakeParameters | None) -> list[str]:
    lines = [
        f"{'parameter':11}{'estimate':>14} {'95 %':>12} {'':11}{'sigma':>11}{'residuals':>12}  verdict",
        f"{'':11}{'':14} {'':12} {'':11}{'':11}{'say':>12}",
    ]
    findings = {finding.name: finding for finding in e.verdict().findings}
    rows = zip(e.unknowns, e.labels, e.values, e.intervals(), e.deviations(), e.robust(), strict=True)
    for unknown, label, value, (low, high), used, robust in rows:
        words = []
        if (finding := findings.get(label)) is not None:
            words.append("identified" if finding.told else f"NOT identified: {finding.why_not}")
            words += [] if math.isfinite(used) else ["the value is one of many"]
            words += [f"traded off with {', '.join(finding.traded_with)}"] if finding.traded_with else []
        if label in e.at_bound:
            words.append("AT THE BORDER of what is searched")
        if truth is not None and hasattr(truth, unknown.name) and math.isfinite(used):
            true = getattr(truth, unknown.name)
            words.append(f"simulated {true:.6g}: {(value - true) / (used * abs(value)):+.2f} sigma")
        unit = SI.get(unknown.name) or UNITS[unknown.name]
        lines.append(
            f"{label:11}{value:14.8g} {f'± {0.5 * (high - low):.3g}':>12} {unit:11}"
            f"{_spread(used, unknown.relative):>11}{_spread(robust, unknown.relative):>12}  {'; '.join(words)}"
        )
    return lines


def _spread(deviation: float, relative: bool) -> str:
    return f"{100.0 * deviation:.3g} %" if relative else f"{deviation:.3g}"


def _correlation(e: Estimate) -> list[str]:
    if len(e.unknowns) < 2:
        return []
    labels, matrix = e.labels, e.correlation()
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
    groups = minima(e.ends)
    lines = [f"where {len(e.ends)} local searches ended, best first"]
    for group in groups:
        values = ", ".join(f"{label} {value:.5g}" for label, value in zip(e.labels, group[0].values, strict=True))
        given_up = sum(not end.converged for end in group)
        lines.append(
            f"  {len(group):3} x chi2 {group[0].cost:12.6g}   {values}"
            + (f"   ({given_up} did not converge)" if given_up else "")
        )
    if len(e.ends) > 1 and len(groups[0]) == 1:
        lines.append("NOTE: the best minimum was found only once: ask for more --starts")
    return lines
