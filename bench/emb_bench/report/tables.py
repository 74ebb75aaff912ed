"""Tables of an estimate, the same in the text and on the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from emb_bench.analysis.conclusion import Standing
from emb_bench.analysis.drift import Drift
from emb_bench.analysis.study import Result, Study, verdict
from emb_bench.brake.parameters import UNITS
from emb_bench.estimate.effects import shown_as
from emb_bench.estimate.estimate import OF_THE_BENCH, Estimate
from emb_bench.estimate.records import NORMAL_95
from emb_bench.information.identifiability import TRADED_OFF
from emb_bench.numbers import amount, chance, percent, relative, signed
from emb_bench.report.acceptance import Acceptance
from emb_bench.report.sentences import drift, limit
from emb_bench.report.text import Cell, Table
from emb_runtime.numbers import NOTHING, SMALL, around, plain

STANDINGS = {
    Standing.IDENTIFIED: Cell("yes", "good"),
    Standing.BIASED: Cell("biased", "care"),
    Standing.IF_MODEL_RIGHT: Cell("(yes)", "care"),
    Standing.NOT_IDENTIFIED: Cell("NO", "bad"),
}
TONES = {Result.PASS: "good", Result.FAIL: "bad", Result.CANNOT_TELL: "care"}  # Colours of results


def answer(yes: bool, *, good: bool = True) -> Cell:
    """Yes or no; the bad one stands out."""
    word = "yes" if yes else "no"
    return Cell(word) if yes is good else Cell(word.upper(), "bad")


def acceptance_table(acceptance: Acceptance | None) -> Table | None:
    """Acceptance criteria with their results."""
    if acceptance is None:
        return None
    rows = [
        [one.name, one.required, one.found, Cell(one.result.value, TONES[one.result]), one.why]
        for one in acceptance.results
    ]
    header = ["criterion", "required", "found (95 % interval)", "result", "why"]
    return Table(f"Acceptance criteria of {acceptance.source}", header, rows, words=range(len(header)))


def parameters(study: Study, *, brief: bool = False) -> Table:
    """Values with total and repeatability, and whether each is identified."""
    e, found = study.estimate, verdict(study)
    header = ["" if brief else "parameter", "value ± total", "total", "repeatability", "identified"]
    if not found.holds:
        header.remove("repeatability")  # it has no meaning for a wrong model
    words = (0, len(header) - 1)
    header += [] if brief else ["from nominal"]
    header += ["simulated", "error in sigma"] if study.truth is not None and not brief else []
    rows = []
    for i, c in zip(e.requested(), study.conclusions, strict=True):
        unknown = e.unknowns[i]
        size = c.value if unknown.relative else 0.0
        row: list[str] = [c.label, amount(c.value, c.interval, c.unit)]
        row += [relative(0.5 * (c.interval[1] - c.interval[0]), size)]
        row += [relative(c.repeatability, size)] if found.holds else []
        row.append(STANDINGS[c.standing])
        if not brief:
            nominal = getattr(e.bench.brake, unknown.name, None)
            change = float(e.values[i]) / nominal - 1.0 if nominal and unknown.relative else math.nan
            row += [NOTHING if math.isnan(change) else f"{signed(100.0 * change)} %"]
        rows.append(row)
    if study.truth is not None and not brief:
        rows = [[*row, *true] for row, true in zip(rows, _errors(study), strict=True)]
    return Table("Estimates; total and repeatability are each half of a 95 % interval (k=2)", header, rows, words=words)


def _errors(study: Study) -> list[list[str]]:
    """True value of each parameter of a simulated brake, and the error in standard deviations."""
    e, rows = study.estimate, []
    for i, c in zip(e.requested(), study.conclusions, strict=True):
        unknown, true = e.unknowns[i], getattr(study.truth, e.unknowns[i].name, math.nan)
        scale = float(e.deviations()[i]) * (abs(c.value) if unknown.relative else 1.0)
        error = (c.value - true) / scale if math.isfinite(scale) else math.nan
        rows.append([plain(true, 6), signed(error, "+.2f")])
    return rows


def errors(study: Study) -> Table | None:
    """True values of a simulated brake, and the errors; None of a real one."""
    if study.truth is None:
        return None
    rows = [[c.label, *row] for c, row in zip(study.conclusions, _errors(study), strict=True)]
    return Table("Errors of the estimates", ["parameter", "simulated", "error in sigma"], rows)


def models(study: Study) -> Table | None:
    """Compared models, best first, with the changes of the parameters."""
    choice = study.checks.choice
    if choice is None:
        return None
    best, rows = choice.best, []
    names = [change.name for change in choice.changes(best)]
    for c in choice.candidates:
        changes = [f"{signed(change.percent)} % ({change.deviations:+.1f})" for change in choice.changes(c)]
        differences = [f"{value:.1f}" for value in (c.bic - best.bic, c.held_out - best.held_out)]
        cells = [NOTHING] * len(changes) if c is best else changes
        rows.append(
            [c.name, answer(c.fits), plain(c.estimate.validation.ratio), *differences, percent(c.weight), *cells]
        )
    header = ["model", "fits", "chi2/n", "BIC", "held-out", "weight", *names]
    title = (
        "Models, best first. BIC and held-out log density: difference from the first model. Parameters: change "
        "from the first model's values, and (in its standard deviations)"
    )
    return Table(title, header, rows, words=(0, 1))


def budget(study: Study) -> Table | None:
    """Contributions to the uncertainty of each parameter; None if only the noise counts."""
    if not (study.estimate.question.systematic or study.estimate.validation.budget):
        return None
    e, rows = study.estimate, []
    bound, other, every = e.cramer_rao(), e.unmodelled_bias(OF_THE_BENCH), e.unmodelled_bias()
    columns = (bound, np.sqrt(np.maximum(every**2 - other**2, 0.0)), other, e.robust())
    for i, c in zip(e.requested(), study.conclusions, strict=True):
        factor = NORMAL_95 * float(e.scale[i])
        jointly, shared, effects, residuals = (factor * float(column[i]) for column in columns)
        systematic = math.sqrt(max(jointly**2 - c.repeatability**2, 0.0)) if math.isfinite(jointly) else math.inf
        systematic = systematic if systematic > SMALL * jointly else 0.0  # below it is rounding
        halves = [c.repeatability, systematic, shared, effects, 0.5 * (c.interval[1] - c.interval[0]), residuals]
        size = c.value if e.unknowns[i].relative else 0.0
        largest = e.largest_bias(i)
        rows.append(
            [c.label, *(relative(half, size) for half in halves), NOTHING if largest is None else limit(largest, e)]
        )
    header = ["parameter", "noise", "sensors", "J, scales", "effects", "total", "by residuals", "largest"]
    title = (
        "Uncertainty budget of the total, each half of a 95 % interval (k=2): noise and systematic errors of the "
        "sensors; inertia, scales of angle and current; effects that the record cannot exclude. By residuals: the "
        "noise's part computed from the scatter of the residuals"
    )
    return Table(title, header, rows, words=(0, 7))


def ratios(e: Estimate) -> Table | None:
    """Ratios of the parameters to the inertia."""
    rows = [
        [
            one.name,
            amount(one.value, one.interval, one.unit),
            relative(0.5 * (one.interval[1] - one.interval[0]), one.value),
        ]
        for one in e.ratios()
    ]
    title = "Ratios, which do not depend on the error of the inertia; ± is the total (95 %, k=2)"
    return Table(title, ["ratio", "value ± total", "total"], rows) if rows else None


def clamping(study: Study) -> Table | None:
    """Clamping force of a brake that is applied; None if a parameter is not identified."""
    found = study.clamping
    if found is None:
        return None
    names = {"force": found.force, "current that holds it": found.current, "friction band, ±": found.friction}
    rows = [[name, amount(*one.with_interval), relative(one.total, one.value)] for name, one in names.items()]
    title = (
        f"Clamping force at {plain(found.angle)} rad from contact. Friction band: largest difference "
        "between the force and that of the current while the brake rests; ± is the total (95 %, k=2)"
    )
    return Table(title, ["clamping", "value ± total", "total"], rows)


def residual_tests(study: Study) -> Table:
    """Tests of the residuals."""
    m = study.estimate.validation
    rows = [
        [
            name,
            plain(test.statistic),
            chance(test.p_value),
            f"{signed(test.correlation, '+.2f')} at {test.lag}",
            plain(m.whiteness[name].statistic),
            chance(m.whiteness[name].p_value),
        ]
        for name, test in m.independence.items()
    ]
    header = ["residuals of", "F, from the current", "p", "largest correlation", "Ljung-Box", "p"]
    return Table("Tests of the residuals: independence of the current (F), whiteness (Ljung-Box)", header, rows)


def systematic(e: Estimate) -> Table | None:
    """Estimated systematic errors, with the priors of the bench file."""
    rows = []
    for unknown, label, value, deviation in zip(e.unknowns, e.labels, e.values, e.deviations(), strict=True):
        if unknown.name in e.question.default_nuisances and unknown.name in e.question.systematic:
            unit = UNITS[unknown.name].replace("1", "")
            before = e.question.systematic[unknown.name]
            estimated = around(float(value), NORMAL_95 * float(deviation))
            rows.append([label, f"{estimated} {unit}".strip(), f"{plain(before)} {unit}".strip()])
    title = "Systematic errors, estimated with the parameters; ± is the total (95 %, k=2)"
    return Table(title, ["error", "estimate", "sigma in [systematic]"], rows) if rows else None


def suspects(e: Estimate) -> Table | None:
    """Effects that the model may lack."""
    rows = []
    for s in e.validation.suspects:
        name, unit = shown_as(s, e.bench.machine)
        suggested = f"{plain(s.value)} {unit}" if unit else f"{plain(100.0 * s.value)} %"
        suggested = suggested if s.possible else NOTHING
        rows.append([name, suggested, signed(s.sigmas, "+.1f"), chance(s.p_value)])
    title = (
        "Score tests for effects that the model lacks: amount to first order, if it is possible; one-sided p if the "
        "effect cannot be negative"
    )
    return Table(title, ["effect", "amount", "sigma", "p"], rows) if rows else None


def checks(study: Study) -> list[Table | None]:
    """Tables behind the verdict on the model."""
    e = study.estimate
    return [residual_tests(study), suspects(e), systematic(e), predicted(study), models(study)]


def predicted(study: Study) -> Table | None:
    """Records predicted by an estimate of others."""
    rows = [
        [h.name, plain(h.ratio, 4), str(h.freedom), chance(h.p_value), answer(h.fits)] for h in study.checks.held_out
    ]
    header = ["record", "chi2/n", "samples", "p", "predicted"]
    return Table("Predictions of held-out records", header, rows, words=(0, 4)) if rows else None


def correlation(e: Estimate) -> tuple[Table | None, list[str]]:
    """Correlations of the shared unknowns, and the pairs that the records hardly separate."""
    index = [i for i in e.shared() if i in e.requested()]
    labels = [e.labels[i] for i in index]
    matrix = e.correlation()[np.ix_(index, index)].tolist()
    rows = [
        [label, *(Cell(signed(value, "+.3f"), shade=value) if math.isfinite(value) else NOTHING for value in row)]
        for label, row in zip(labels, matrix, strict=True)
    ]
    pairs = [
        f"{labels[j]} and {labels[i]}" for i in range(len(labels)) for j in range(i) if abs(matrix[i][j]) > TRADED_OFF
    ]
    return (Table("Correlation of the estimates", ["", *labels], rows), pairs) if len(labels) > 1 else (None, [])


def compared(studies: Sequence[Study]) -> Table:
    """Two runs, each estimated alone, in a column each: verdict, parameters and their differences."""
    first, second = studies
    changes, found = {d.name: d for d in second.checks.drifts}, [verdict(first), verdict(second)]
    rows: list[list[str]] = [["verdict", *(Cell(one.code.value, one.tone) for one in found), "", "", ""]]
    for c in (c for c in first if c.label in second):
        tones = ((v, "" if v.standing is Standing.IDENTIFIED else "care") for v in (c, second[c.label]))
        row: list[str] = [c.label, *(Cell(amount(v.value, v.interval, v.unit), tone) for v, tone in tones)]
        d = changes.get(c.label)
        if d is None or math.isinf(d.detectable):
            rows.append([*row, NOTHING, NOTHING, Cell("not compared", "care")])
        else:
            rows.append([*row, _change(d), signed(d.sigmas, "+.1f"), answer(d.drifted, good=False)])
    title = "Value ± total (95 %, k=2); difference: second less first; sigma: in its deviations between runs of a brake"
    return Table(title, ["", *(one.names[0] for one in studies), "difference", "sigma", "differs"], rows, words=(0, 5))


def _change(d: Drift) -> str:
    return f"{signed(100.0 * d.relative_change)} %" if d.relative else f"{signed(d.relative_change)} {d.unit}"


def drifts(study: Study) -> Table:
    """Values of an earlier estimate and of this one."""
    rows = [
        [
            d.name,
            around(d.last, NORMAL_95 * d.last_deviation),
            around(d.now, NORMAL_95 * d.deviation),
            _change(d),
            signed(d.sigmas, "+.1f"),
            answer(d.drifted, good=False),
            drift(d),
        ]
        for d in study.checks.drifts
    ]
    header = ["parameter", "last", "now", "change", "sigma", "drifted", ""]
    return Table("Values ± total (95 %, k=2), without the errors that all runs share", header, rows, words=(0, 5, 6))
