"""What was found from all runs together: parameters, the check of the model, how sure it all is, what would help."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from emb_bench.analysis.conclusion import amount
from emb_bench.analysis.report import minima, remedies, warned
from emb_bench.analysis.study import Study
from emb_bench.brake.parameters import UNITS
from emb_bench.estimate.records import METHODS, NORMAL_95, Estimate
from emb_bench.estimate.refit import shared
from emb_bench.information.criteria import TRADED_OFF, criteria
from emb_bench.numbers import NOTHING, around, chance, chance_said, percent, plain, spread
from emb_bench.report import certainty
from emb_bench.report.content import Content
from emb_bench.report.markup import Child, Html, Section, listed, picture, table, tag


def parameters(study: Study) -> Section:
    """Values, and how sure they are."""
    e = study.estimate
    asked = [f"Method: {METHODS[e.method]}, model '{e.plant.name}' ({study.model_reason})."]
    if e.asked.prior is not None:
        asked.append(
            f"Known beforehand: the ranges '{e.asked.prior.name}', as a Gaussian of the same mean and variance."
        )
    if e.process_noise > 0.0:
        asked.append(f"Estimated random walk of the velocity: {plain(e.process_noise)} rad/s per √s.")
    lacking = "the method's bias" if study.biased else "the error of a wrong model"
    return Section(
        "Parameters",
        tag("p", " ".join(asked), cls="note"),
        _values(study),
        _deviations(study),
        None if study.holds else tag("p", f"No deviation above has {lacking} in it.", cls="bad"),
    )


def _values(study: Study) -> Html:
    e = study.estimate
    head: list[Child] = ["parameter", "estimate ± 95 %", "identified"]
    if study.truth is not None:
        head += ["simulated", "error in σ"]
    rows: list[list[Child]] = []
    for unknown, c, deviation in zip(e.unknowns, study.conclusions, e.deviations().tolist(), strict=True):
        yes = "yes" if study.holds else "biased" if study.biased else "if the model were right"
        row: list[Child] = [c.label, amount(c.value, c.interval, c.unit)]
        row.append(yes if c.told else tag("strong", "NO", cls="bad"))
        if study.truth is not None:
            true = getattr(study.truth, unknown.name, math.nan)
            scale = deviation * (abs(c.value) if unknown.relative else 1.0)
            error = (c.value - true) / scale if math.isfinite(scale) else math.nan
            row += [plain(true, 6), NOTHING if math.isnan(error) else f"{error:+.2f}".replace("-", "−")]
        rows.append(row)
    return table(head, rows, "What was estimated", words=(0, 1, 2))


def _deviations(study: Study) -> Html:
    e = study.estimate
    head: list[Child] = ["parameter", "used", "by Fisher", "by residuals"]
    boot = study.bootstrap
    weak = _weakest(e)
    head += ["by bootstrap"] if boot is not None else []
    head += ["weakest direction"] if weak else []
    rows: list[list[Child]] = []
    columns = (e.unknowns, e.labels, e.values, e.deviations(), e.cramer_rao(), e.robust())
    for unknown, label, value, *deviations in zip(*columns, strict=True):
        row: list[Child] = [label, *(spread(float(d), unknown.relative) for d in deviations)]
        if boot is not None:
            own = boot.deviations[boot.labels.index(label)] if label in boot.labels else math.nan
            size = abs(float(value)) if unknown.relative else 1.0
            row.append(spread(float(own) / size, unknown.relative) if label in boot.labels else NOTHING)
        if weak:
            row.append(percent(weak[label] ** 2) if label in weak else NOTHING)
        rows.append(row)
    return table(
        head,
        rows,
        "Standard deviations; weakest direction: the share of each in the combination that is told worst",
    )


def _weakest(e: Estimate) -> dict[str, float]:
    """The combination of parameters that is told worst; empty with fewer than two."""
    names = [e.labels[i] for i in shared(e) if e.unknowns[i].name in e.asked.params]
    return dict(criteria(e.information, e.labels, names).weakest) if len(names) > 1 else {}


def model_check(study: Study) -> Section:
    """Does the model explain the records?"""
    m = study.estimate.misfit
    low, high = m.expected
    rows = [
        [
            name,
            plain(test.statistic),
            chance(test.p_value),
            f"{test.correlation:+.2f} at {test.lag}".replace("-", "−"),
            plain(m.whiteness[name].statistic),
            chance(m.whiteness[name].p_value),
        ]
        for name, test in m.independence.items()
    ]
    head = ["residuals of the", "F, from the current", "p", "largest correlation", "Ljung-Box", "p"]
    return Section(
        "Does the model fit",
        tag(
            "p",
            f"χ²/n is {plain(m.ratio, 4)} of {m.freedom} degrees of freedom; the right model lies between {low:.3f} "
            f"and {high:.3f} but for one time in a hundred ({chance_said(m.chi2_p)}).",
        ),
        *([] if study.biased else [listed(m.alarms, "alarms"), listed(m.notes, "warnings")]),
        table(head, rows, "Do the residuals follow from the current, or from each other?"),
        _suspects(study.estimate),
        _held_out(study),
        name="model",
    )


def _suspects(e: Estimate) -> Child:
    suspects = e.misfit.suspects
    if not suspects:
        return None
    rows = [
        [s.name, f"{plain(s.value)} {UNITS.get(s.name, '')}", f"{s.sigmas:+.1f}".replace("-", "−")] for s in suspects
    ]
    return table(
        ["effect", "amount", "σ"],
        rows,
        "Effects that were not estimated, and how much of each the residuals ask for, to first order",
    )


def _held_out(study: Study) -> Child:
    predicted = (*study.held_out, *study.left_out)
    if not predicted:
        return None
    rows: list[list[Child]] = [
        [
            h.name,
            plain(h.ratio, 4),
            str(h.freedom),
            chance(h.p_value),
            "yes" if h.fits else tag("strong", "NO", cls="bad"),
        ]
        for h in predicted
    ]
    head = ["record", "χ²/n", "samples", "p", "predicted"]
    return table(head, rows, "Records predicted from the others, or held out", words=(0, 4))


def certainties(study: Study) -> Section:
    """Ellipses, correlation, profiles, bootstrap, where the searches ended."""
    e = study.estimate
    parts: list[Section] = []
    drawable = certainty.drawable(e)
    if len(drawable) > 1:
        names = ", ".join(e.labels[i] for i in drawable)
        truth = " The cross is what was simulated." if study.truth is not None else ""
        more = " Dots are draws from the posterior." if e.draws is not None else ""
        parts.append(
            Section(
                "Confidence ellipses",
                picture(
                    certainty.ellipses(e, study.truth),
                    f"95 % confidence ellipses of each pair of {names}, around the estimate",
                    f"Regions that hold each pair with 95\u00a0%, relative to the estimate.{truth}{more}",
                ),
            )
        )
    if len(e.labels) > 1:
        parts.append(Section("Correlation", _correlation(e)))
    if study.profiles:
        names = ", ".join(p.label for p in study.profiles)
        parts.append(
            Section(
                "Likelihood profiles",
                picture(
                    certainty.profiles(study.profiles, e),
                    f"Rise of chi-squared over {names}, beside the parabola of the Fisher information",
                    "How much worse the records are explained when one unknown is held, relative to its estimate, and "
                    "the others make up for it. Pale: what the Fisher information stands for. Below the dashed "
                    "line lie 95\u00a0%.",
                ),
                listed(f"{p.label}: {p.words}" for p in study.profiles),
            )
        )
    if study.bootstrap is not None:
        boot = study.bootstrap
        failed = f" {boot.failed} draws ended in no minimum and do not count." if boot.failed else ""
        parts.append(
            Section(
                "Bootstrap over runs",
                picture(
                    certainty.bootstrap(boot, e),
                    f"Histograms of {len(boot.values)} estimates from resampled runs, beside Gaussians",
                    f"What other runs like these would have given, in {len(boot.values)} draws, relative to the "
                    f"estimate; the lines are Gaussians of the deviations used.{failed}",
                ),
            )
        )
    if e.ends and e.method != "rls":  # whose sum of squares is of the regression, not of the samples
        parts.append(_searches(e))
    return Section("How sure", within=parts)


def _correlation(e: Estimate) -> list[Child]:
    matrix, labels = e.correlation(), e.labels
    rows: list[list[Child]] = []
    for label, row in zip(labels, matrix.tolist(), strict=True):
        rows.append([label, *(_shaded(value) for value in row)])
    pairs = [
        f"{labels[j]} and {labels[i]}"
        for i in range(len(labels))
        for j in range(i)
        if math.isfinite(matrix[i, j]) and abs(matrix[i, j]) > TRADED_OFF
    ]
    return [
        table(["", *labels], rows, "Correlation of the estimates"),
        tag("p", f"Nearly one number to these records: {'; '.join(pairs)}.", cls="care") if pairs else None,
    ]


def _shaded(value: float) -> Child:
    if not math.isfinite(value):
        return NOTHING
    colour = "0,114,178" if value > 0.0 else "213,94,0"
    text = f"{value:+.3f}".replace("-", "−")
    return tag("span", text, cls="r", style=f"background: rgba({colour},{0.35 * abs(value):.2f})")


def _searches(e: Estimate) -> Section:
    rows: list[list[Child]] = []
    groups = minima(e.ends)
    for group in groups:
        gave_up = sum(not end.converged for end in group)
        values = [plain(value, 5) for value in group[0].values]
        rows.append([str(len(group)), f"{group[0].cost:.6g}", str(gave_up), *values])
    alone = len(e.ends) > 1 and len(groups[0]) == 1
    return Section(
        "Where the searches ended",
        picture(
            certainty.waterfall(e.ends),
            f"Chi-squared where {len(e.ends)} local searches ended, in {len(groups)} different minima",
            f"{len(e.ends)} local searches from different brakes.",
        )
        if len(e.ends) > 1
        else None,
        table(["searches", "χ²", "gave up", *e.labels], rows, "The minima, best first"),
        tag("p", "The best minimum was found only once: ask for more --starts.", cls="care") if alone else None,
    )


def advice(study: Study) -> Section:
    """What to do next, and what has changed."""
    said: list[Child] = []
    if found := [*remedies(study), *(warned(study) if study.advice else [])]:
        said.append(listed(f"{line[0].upper()}{line[1:]}." for line in found))
    if not study.model_fits and not study.biased:
        said.append(tag("p", "More runs do not mend a wrong model."))
    for one in study.advice:
        rows = [
            [label, spread(one.before[label], label not in UNITS), spread(one.after[label], label not in UNITS)]
            for label in one.before
            if label in one.after
        ]
        said += [tag("h3", one.excitation), tag("p", one.words)]
        said.append(table(["parameter", "deviation now", "with one such run more"], rows, "What it would bring"))
    if not study.advice and study.holds:
        said.append(
            tag("p", "Nothing: all that was asked is told well.")
            if study.told
            else tag("p", "No excitation that was tried would tell what is missing.")
        )
    return Section("What to do next", said, name="next")


def drift(study: Study) -> Section | None:
    """What has changed since the last campaign."""
    if not study.drifts:
        return None
    rows: list[list[Child]] = []
    for d in study.drifts:
        relative = d.name not in UNITS
        change = f"{100.0 * d.relative_change:+.3g} %" if relative else f"{d.relative_change:+.3g} {UNITS[d.name]}"
        mark = tag("strong", "YES", cls="bad") if d.drifted else "no"
        rows.append(
            [
                d.name,
                around(d.last, NORMAL_95 * d.last_deviation),
                around(d.now, NORMAL_95 * d.deviation),
                change.replace("-", "−"),
                f"{d.sigmas:+.1f}".replace("-", "−"),
                mark,
                d.words,
            ]
        )
    head = ["parameter", "last", "now", "change", "σ", "drifted", ""]
    return Section("Since the last campaign", table(head, rows, "Values ± 95 %", words=(0, 5, 6)), name="drift")


def contributions(content: Content) -> Section | None:
    """Which run told how much; of several."""
    runs = [run for run in content.estimated if run.growth is not None]
    if content.study is None or len(runs) < 2:
        return None
    e = content.study.estimate
    names = [e.labels[i] for i in shared(e)]
    amounts = np.array([_alone(run.growth.labels, run.growth.samples, names) for run in runs if run.growth is not None])
    shares = amounts / np.where(amounts.sum(axis=0) > 0.0, amounts.sum(axis=0), 1.0)
    rows: list[list[Child]] = []
    for run, own in zip(runs, shares.tolist(), strict=True):
        assert run.growth is not None
        alone = criteria(run.growth.samples, run.growth.labels, e.asked.params)
        rows.append([run.name, plain(alone.log_det, 5), plain(alone.lambda_min), *(percent(share) for share in own)])
    asked = [e.labels[i] for i in shared(e) if e.unknowns[i].name in e.asked.params]
    if asked:
        joint = criteria(e.information, e.labels, asked)
        rows.append(["all together", plain(joint.log_det, 5), plain(joint.lambda_min), *("" for _ in names)])
    head = ["run", "log det", "smallest eigenvalue", *(f"share of {name}" for name in names)]
    return Section(
        "Which run told what",
        table(
            head,
            rows,
            "Physical information of each run by itself, and its share in what is told of each unknown alone",
        ),
        name="contributions",
    )


def _alone(labels: Sequence[str], samples: np.ndarray, names: Sequence[str]) -> list[float]:
    return [float(samples[labels.index(name), labels.index(name)]) for name in names]
