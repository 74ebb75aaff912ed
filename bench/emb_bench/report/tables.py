"""Tables of an estimate, the same in the text and on the page; and that of a design."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from emb_bench.analysis.acceptance import Acceptance, Result
from emb_bench.analysis.growth import Growth
from emb_bench.analysis.recommendation import Recommendation
from emb_bench.analysis.study import Study
from emb_bench.brake.parameters import UNITS
from emb_bench.estimate.records import NORMAL_95, Estimate
from emb_bench.estimate.suspects import shown_as
from emb_bench.information.criteria import criteria
from emb_bench.information.identifiability import TRADED_OFF
from emb_bench.numbers import NOTHING, amount, around, chance, percent, plain, share, signed, spread
from emb_bench.report.render import deviation
from emb_bench.report.text import Cell, Table

if TYPE_CHECKING:  # a search for designs takes a second to import
    from emb_bench.design.report import Report

TONES = {Result.PASS: "good", Result.FAIL: "bad", Result.CANNOT_TELL: "care"}  # Colours of results


def answer(yes: bool, *, good: bool = True) -> Cell:
    """Yes or no; the one that is not ``good`` stands out."""
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
    header = ["criterion", "required", "found (± 95 %)", "result", "why"]
    return Table(f"Acceptance criteria of {acceptance.criteria.source}", header, rows, words=range(len(header)))


def parameters(study: Study) -> Table:
    """Values with their 95 % intervals in the parameter's unit and as a share, and beside the nominal value."""
    e = study.estimate
    header = ["parameter", "estimate ± 95 %", "± 95 %", "from nominal", "identified"]
    header += ["simulated", "error in sigma"] if study.truth is not None else []
    yes = Cell("yes", "good") if study.holds else Cell("biased" if study.biased else "if the model were right", "care")
    rows = []
    for i, c in zip(e.wanted(), study.conclusions, strict=True):
        unknown, own = e.unknowns[i], float(e.deviations()[i])
        row: list[str] = [c.label, amount(c.value, c.interval, c.unit)]
        half = 0.5 * (c.interval[1] - c.interval[0])
        relative = unknown.relative and math.isfinite(half) and c.value != 0.0
        row.append(share(half / abs(c.value)) if relative else NOTHING)
        nominal = getattr(e.bench.brake, unknown.name, None)
        row.append(_from_nominal(float(e.values[i]) / nominal - 1.0) if nominal and unknown.relative else NOTHING)
        row.append(yes if c.identified else Cell("NO", "bad"))
        if study.truth is not None:
            true = getattr(study.truth, unknown.name, math.nan)
            scale = own * (abs(c.value) if unknown.relative else 1.0)
            row += [plain(true, 6), signed((c.value - true) / scale if math.isfinite(scale) else math.nan, "+.2f")]
        rows.append(row)
    return Table("Estimates with their 95 % intervals", header, rows, words=(0, 4))


def _from_nominal(change: float) -> str:
    """A relative change, in ppm where it is small."""
    return share(change, 3) if change < 0.0 else f"+{share(change, 3)}"


def values(study: Study) -> Table:
    """Values with their intervals, and the error of each where the truth is known."""
    e = study.estimate
    header = ["parameter", "estimate ± 95 %", "identified"]
    header += ["simulated", "error in sigma"] if study.truth is not None else []
    yes = Cell("yes" if study.holds else "biased" if study.biased else "if the model were right")
    rows = []
    for i, c in zip(e.wanted(), study.conclusions, strict=True):
        unknown, own = e.unknowns[i], float(e.deviations()[i])
        row: list[str] = [c.label, amount(c.value, c.interval, c.unit), yes if c.identified else Cell("NO", "bad")]
        if study.truth is not None:
            true = getattr(study.truth, unknown.name, math.nan)
            scale = own * (abs(c.value) if unknown.relative else 1.0)
            row += [plain(true, 6), signed((c.value - true) / scale if math.isfinite(scale) else math.nan, "+.2f")]
        rows.append(row)
    return Table("What was estimated", header, rows, words=(0, 2))


def models(study: Study) -> Table | None:
    """Models that were compared, best first, with what each would change."""
    if study.choice is None:
        return None
    best, rows = study.choice.best, []
    names = [change.name for change in study.choice.changes(best)]
    for c in study.choice.candidates:
        changes = [f"{change.percent:+.2g} % ({change.deviations:+.1f})" for change in study.choice.changes(c)]
        differences = [f"{value:.1f}" for value in (c.bic - best.bic, c.aic - best.aic, c.held_out - best.held_out)]
        cells = [NOTHING] * len(changes) if c is best else changes
        rows.append(
            [c.name, answer(c.fits), plain(c.estimate.validation.ratio), *differences, percent(c.weight), *cells]
        )
    header = ["model", "fits", "chi2/n", "BIC", "AIC", "held-out", "weight", *names]
    along = ", each with the systematic errors estimated along" if best.estimate.asked.systematic else ""
    title = (
        f"Models fitted, best first{along}. BIC, AIC, and logarithm of the density of what was held out: difference "
        "from the first model. Parameters: change from the first model's values, and in brackets that in its standard "
        "deviations"
    )
    return Table(title, header, rows, words=(0, 1))


def growth_path(study: Study) -> Table | None:
    """Features that the records asked for, round by round."""
    if study.growth is None:
        return None
    rows = []
    for one in study.growth.rounds:
        for i, trial in enumerate(one.trials or (None,)):
            begin = [one.model, plain(one.ratio)] if i == 0 else ["", ""]
            if trial is None:
                rows.append([*begin, "nothing", NOTHING, NOTHING, NOTHING, NOTHING])
                continue
            said = "added" if trial.accepted else "no"
            if trial.accepted and one.removed:
                said += ", without " + ", ".join(one.removed)
            cells = [f"{value:+.1f}" for value in (trial.sigmas, trial.bic, trial.held_out)]
            rows.append([*begin, trial.name, *cells, said])
    header = ["model", "chi2/n", "the residuals ask for", "sigma", "BIC", "held-out", "added"]
    return Table(
        "Growth of the model; change of BIC and of the held-out density by each", header, rows, words=(0, 2, 6)
    )


def deviations(study: Study) -> Table:
    """Standard deviations by each method that gives them."""
    e, boot = study.estimate, study.bootstrap
    names = [e.labels[i] for i in e.shared() if e.unknowns[i].name in e.asked.params]
    weak = dict(criteria(e.information, e.labels, names).weakest) if len(names) > 1 else {}
    header = ["parameter", "used", "by Fisher", "by residuals"]
    moved = e.open()
    header += ["left open by the model"] if moved.any() else []
    header += ["by bootstrap"] if boot is not None else []
    header += ["weakest direction"] if weak else []
    rows = []
    columns = (e.unknowns, e.shown, e.labels, e.values.tolist(), e.deviations(), e.cramer_rao(), e.robust())
    for unknown, shown, label, value, *found in zip(*columns, *([moved] if moved.any() else []), strict=True):
        if unknown.name in e.asked.along:
            continue
        factor = 1.0 if unknown.relative else shown.factor
        row = [label, *(spread(float(d) * factor, unknown.relative) for d in found)]
        if (suspect := e.left_open_by(e.labels.index(label))) is not None:
            row[-1] += f" ({shown_as(suspect, e.bench.machine).name})"
        if boot is not None:
            size = abs(value) if unknown.relative else 1.0
            known = label in boot.labels
            own = float(boot.deviations[boot.labels.index(label)]) / size if known else math.nan
            row.append(spread(own * factor, unknown.relative) if known else NOTHING)
        if weak:
            row.append(percent(weak[label] ** 2) if label in weak else NOTHING)
        rows.append(row)
    title = "Standard deviations"
    title += "; left open: by the effect in brackets, as far as the record does not exclude it" if moved.any() else ""
    title += "; weakest direction: share of each in the combination with the largest uncertainty" if weak else ""
    return Table(title, header, rows)


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
    return Table("Residuals: dependence on the current, and on each other", header, rows)


def systematic(e: Estimate) -> Table | None:
    """Systematic errors that were estimated along, with the priors of the bench file."""
    rows = []
    for unknown, label, value, own in zip(e.unknowns, e.labels, e.values, e.deviations(), strict=True):
        if unknown.name in e.asked.along and unknown.name in e.asked.systematic:
            unit = UNITS[unknown.name].replace("1", "")
            before = e.asked.systematic[unknown.name]
            estimated = around(float(value), NORMAL_95 * float(own))
            rows.append([label, f"{estimated} {unit}".strip(), f"{plain(before)} {unit}".strip()])
    title = "Systematic errors that were estimated along; ± is half the 95 % interval"
    return Table(title, ["error", "estimate", "sigma in [systematic]"], rows) if rows else None


def suspects(e: Estimate) -> Table | None:
    """Effects that the model may lack."""
    rows = []
    for s in e.validation.suspects:
        name, unit, factor = shown_as(s, e.bench.machine)
        suggested = f"{plain(s.value * factor)} {unit}" if unit else share(s.value, 3)
        rows.append([name, suggested, signed(s.sigmas, "+.1f"), chance(s.p_value)])
    title = (
        "Effects that were not estimated, and how much of each the residuals suggest, to first order; p is near 1 "
        "where an effect cannot have that sign"
    )
    return Table(title, ["effect", "amount", "sigma", "p"], rows) if rows else None


def predicted(study: Study) -> Table | None:
    """Records predicted by an estimate of others."""
    rows = [
        [h.name, plain(h.ratio, 4), str(h.freedom), chance(h.p_value), answer(h.fits)]
        for h in (*study.held_out, *study.left_out)
    ]
    header = ["record", "chi2/n", "samples", "p", "predicted"]
    return Table("Records predicted from the others, or held out", header, rows, words=(0, 4)) if rows else None


def correlation(e: Estimate) -> tuple[Table | None, list[str]]:
    """Correlations of the estimates, and the pairs that the records hardly separate; of what all records share."""
    index = [i for i in e.shared() if i in e.wanted()]
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


def minima(study: Study) -> Table | None:
    """Minima where the local searches ended."""
    rows = [
        [
            str(len(group)),
            f"{group[0].cost:.6g}",
            str(sum(not end.converged for end in group)),
            *(plain(group[0].values[i] * study.estimate.shown[i].factor, 5) for i in study.estimate.wanted()),
        ]
        for group in study.minima
    ]
    header = ["searches", "chi2", "not converged", *(study.estimate.labels[i] for i in study.estimate.wanted())]
    return Table("Minima where the local searches ended, best first", header, rows) if rows else None


def bootstrap(study: Study) -> Table | None:
    """Intervals by the bootstrap over runs."""
    b = study.bootstrap
    if b is None:
        return None
    factors = np.array([study.estimate.factor(label) for label in b.labels])
    columns = (b.labels, (b.intervals * factors[:, None]).tolist(), (b.deviations * factors).tolist())
    rows = [
        [label, f"{plain(low, 4)} to {plain(high, 4)}", plain(own, 2)]
        for label, (low, high), own in zip(*columns, strict=True)
    ]
    draws = len(b.values) + b.failed
    failed = f"; {b.failed} did not end in a minimum and do not count" if b.failed else ""
    return Table(f"Bootstrap over runs, {draws} draws{failed}", ["parameter", "95 % interval", "sigma"], rows)


def gain(r: Recommendation) -> Table:
    """Deviations before and after a recommended run."""
    rows = [[n, deviation(r.before[n], n), deviation(r.after[n], n)] for n in r.before if n in r.after]
    return Table("Standard deviations", ["parameter", "now", "with one such run more"], rows)


def design_checks(report: Report) -> Table:
    """A design simulated again, on its own brake first."""
    rows = [
        [
            *(c.plant, f"{c.log_det:.4f}", f"{c.lambda_min:.5g}", f"{c.trace_inverse:.5g}"),
            *(f"{c.lowest_angle:.4f} to {c.highest_angle:.4f}", f"{c.largest_speed:.4f}"),
            *(f"{c.end_angle:.3f}", f"{c.end_velocity:.3f}"),
            *("limits held" if c.limits_held else "LIMITS LEFT", "home" if c.home else "not home"),
        ]
        for c in report.checks
    ]
    header = ["simulated again", "log det", "lambda_min", "tr M^-1", "angle [rad]", "speed", "end [rad]", "[rad/s]"]
    return Table("", [*header, "", ""], rows, words=(0, 8, 9))


def drifts(study: Study, words: Sequence[str]) -> Table:
    """Values of an earlier estimate and of this one; ``words`` describe the change of each."""
    rows = []
    for d, said in zip(study.drifts, words, strict=True):
        change = f"{signed(100.0 * d.relative_change)} %" if d.relative else f"{signed(d.relative_change)} {d.unit}"
        rows.append(
            [
                d.name,
                around(d.last, NORMAL_95 * d.last_deviation),
                around(d.now, NORMAL_95 * d.deviation),
                change,
                signed(d.sigmas, "+.1f"),
                answer(d.drifted, good=False),
                said,
            ]
        )
    header = ["parameter", "last", "now", "change", "sigma", "drifted", ""]
    return Table("Values ± 95 %", header, rows, words=(0, 5, 6))


def contributions(study: Study, runs: Sequence[tuple[str, Growth]]) -> Table:
    """Information of each run by itself, and its share in the information on each unknown alone."""
    e = study.estimate
    names = [e.labels[i] for i in e.shared() if i in e.wanted()]
    amounts = np.array([[g.samples[i, i] for i in map(g.labels.index, names)] for _, g in runs])
    shares = amounts / np.where(amounts.sum(axis=0) > 0.0, amounts.sum(axis=0), 1.0)
    rows = []
    for (name, g), own in zip(runs, shares.tolist(), strict=True):
        alone = criteria(g.samples, g.labels, g.params)
        rows.append([name, plain(alone.log_det, 5), plain(alone.lambda_min), *map(percent, own)])
    if asked := [e.labels[i] for i in e.shared() if e.unknowns[i].name in e.asked.params]:
        joint = criteria(e.information, e.labels, asked)
        rows.append(["all together", plain(joint.log_det, 5), plain(joint.lambda_min), *("" for _ in names)])
    header = ["run", "log det", "smallest eigenvalue", *(f"share of {name}" for name in names)]
    title = "Physical information of each run by itself, and its share in what is known of each unknown alone"
    return Table(title, header, rows)
