"""What comes first: whether the numbers can be believed, and what they say in words."""

from __future__ import annotations

from emb_bench.analysis.study import Study
from emb_bench.estimate.records import DONE
from emb_bench.numbers import plain
from emb_bench.report.content import Content, Run
from emb_bench.report.markup import Child, Html, Section, facts, listed, tag


def opening(content: Content) -> list[Html]:
    """The loudest sentence first, then what the page is about."""
    names = [run.name for run in content.reported]
    return [
        tag("p", content.headline, cls=f"banner {_colour(content)}", role="alert"),
        *_cautions(content),
        tag("h1", "Report of ", ", ".join(names) if len(names) < 4 else f"{len(names)} runs"),
        tag("p", _subtitle(content), cls="lead"),
    ]


def _colour(content: Content) -> str:
    if content.study is None:
        return "care"
    if not content.study.holds:
        return "bad"
    return "good" if content.study.told else "care"


def _cautions(content: Content) -> list[Html]:
    """Of the logs: what is not whole or did not count."""
    words = [
        f"{run.name}: the log is NOT complete: {run.log.missing}" for run in content.reported if not run.log.complete
    ]
    words += content.stopped
    # Without an estimate the first sentence says why of the runs, and not of the files that are left out.
    words += content.without_part if content.study is not None else content.without_part[: len(content.left_out)]
    return [tag("p", line, cls="banner care") for line in words]


def _subtitle(content: Content) -> str:
    began = sorted(run.began for run in content.reported if run.began)
    when = "" if not began else began[0] if began[0] == began[-1] else f"{began[0]} to {began[-1]}"
    what = sorted({run.source for run in content.reported})
    return ", ".join(part for part in (*what, when) if part)


def verdict(content: Content) -> Section:
    """In words: model, parameters, runs."""
    study = content.study
    rows: list[tuple[str, Child]] = []
    if study is None:
        rows.append(("Model", tag("span", f"not judged: {content.why_not}", cls="care")))
    else:
        rows += [("Model", _model(study)), ("Parameters", _parameters(study))]
    label = "Run" if len(content.runs) == 1 else "Runs"
    lines = [_outcome(run, len(content.runs) > 1) for run in content.runs]
    rows.append((label, lines[0] if len(lines) == 1 else listed(lines)))
    warnings = listed((*study.warnings, *study.estimate.caveats), "warnings") if study is not None else None
    return Section(
        "Verdict", facts(rows), [tag("h3", "To know before believing a number"), warnings] if warnings else None
    )


def _model(study: Study) -> list[Child]:
    e, m = study.estimate, study.estimate.misfit
    said: list[Child] = []
    if study.holds:
        said.append(tag("strong", "fits", cls="good"))
        said.append(f": χ²/n is {plain(m.ratio)}, {plain(m.expected[0])} to {plain(m.expected[1])} expected. ")
    else:
        said.append(tag("strong", _failure(study), cls="bad"))
        unpredicted = [f"{h.name}: {h.words}" for h in (*study.held_out, *study.left_out) if not h.fits]
        said.append(listed([*([] if study.biased else m.alarms), *unpredicted], "alarms"))
    said.append(f"Model '{e.plant.name}' ({study.model_reason}).")
    said.append(None if study.biased else listed(m.notes, "warnings"))
    return said


def _failure(study: Study) -> str:
    if study.biased:
        return "not judged by a method that is biased"
    return "DOES NOT PREDICT" if study.model_fits else "DOES NOT FIT"


def _parameters(study: Study) -> Child:
    lines: list[Child] = []
    for c in study.conclusions:
        if not c.of_interest:
            continue
        mark = tag("strong", c.label, cls="good" if c.told and study.holds else "care")
        lines.append([mark, ": ", c.words])
    return listed(lines)


def _outcome(run: Run, named: bool) -> list[Child]:
    reason = run.log.exit_reason
    ended = tag("strong", reason, cls="good" if reason == DONE else "bad")
    detail = run.log.end.get("detail", "")
    whole = (
        tag("span", "the log is complete", cls="good")
        if run.log.complete
        else tag("strong", "the log is NOT complete", cls="bad")
    )
    taken: Child = None
    if run.experiment is not None:
        x = run.experiment
        taken = f"{len(x.currents)} of {x.planned} periods, {int(x.measured.sum())} samples; "
    return [f"{run.name}: " if named else None, ended, f" ({detail})" if detail else None, "; ", taken, whole]
