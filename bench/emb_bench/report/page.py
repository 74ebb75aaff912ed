"""The page of a report: its figures and tables, in the order in which they are read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from emb_bench.analysis.growth import Growth
from emb_bench.analysis.study import Study
from emb_bench.estimate.records import TERMS
from emb_bench.logs.learnt import history, last_ranges
from emb_bench.logs.timing import INTERVALS, Timing, quantiles
from emb_bench.numbers import percent, plain, seconds, signed
from emb_bench.report import certainty, figures, tables
from emb_bench.report.content import REASONS, ActiveCycles, Content, Run, stop_samples
from emb_bench.report.render import html, section
from emb_bench.report.text import Table
from emb_bench.report.trend import panels as trend_panels
from emb_bench.report.trend import table as run_table
from emb_bench.report.trend import trends
from emb_runtime.config.timing_budgets import QUANTILES
from emb_runtime.errors import BenchFileError, LogError
from emb_runtime.log.mcap_schema import LEARNT
from emb_runtime.safety.end_stop import end_stop_speed

EVENTS = 200  # Most safety events that are shown; report.json has them all
LONGEST = 2000  # Characters of an event that are shown; report.json has them all
SHORT_HASH = 16  # Digits of a hash that are shown where there is no room for all
SETTING = "rt_"  # Prefix of the real-time settings among the entries of a run's outcome


class Part(NamedTuple):
    """A section of the page."""

    name: str  # HTML identifier, the target of links
    title: str
    body: Markup = Markup()
    parts: tuple[Part, ...] = ()  # Sections inside it
    folded: bool = False  # True if it is closed until the reader opens it, and printed only if it is open


def report_page(content: Content) -> str:
    """The whole report as HTML: the verdict first, then what it rests on; evidence is folded.

    Raises:
        UsageError: matplotlib is missing.
        LogError: a log cannot be read any more.
    """
    study, several = content.study, len(content.runs) > 1
    parts = [
        Part(
            "verdict",
            "Verdict",
            section("verdict.html.j2", "verdict", content, tables.acceptance_table(content.acceptance)),
        )
    ]
    if several:
        parts += _of_several_runs(content)
    if study is not None:
        shown = tables.parameters(study)
        parts.append(Part("parameters", "Parameters", section("estimate.html.j2", "parameters", study, shown)))
        parts += _next(study)
    if several:
        folded = [
            Part(
                f"run-{n}",
                f"Run {n}: {run.name}",
                parts=(*_seen(run, f"run-{n}-"), *_of_a_run(run, content, f"run-{n}-")),
            )
            for n, run in enumerate(content.runs, 1)
        ]
    else:
        run = content.runs[0]
        parts += [*_seen(run, ""), _tested(content)]
        folded = [*_of_a_run(run, content, "")]
    if several:
        parts.append(_tested(content))
    evidence = [] if study is None else [*_of_all_runs(content, study)]
    folded = [*evidence, *folded, Part("words", "What the words mean", section("run.html.j2", "words", TERMS))]
    parts += [part._replace(folded=True) for part in folded]
    names = ", ".join(run.name for run in content.reported)
    return html(
        "page.html.j2",
        title=f"Report of {names}",
        opening=section("verdict.html.j2", "opening", content),
        parts=parts,
        closing=f"Made by {content.made_by} from {names}. The JSON file beside this page has the same as numbers.",
    )


def _tested(content: Content) -> Part:
    """Device, bench, operator, versions and hashes, as the logs have them; and the place for a signature."""
    names = ["device serial", "operator", "bench", "recorded", "recorded by", "policy SHA-256", "log SHA-256"]
    columns = [_identity(run) for run in content.runs]
    if any(run.log.drive_files is not None for run in content.runs):
        names = [*names, "drive", "which lacks, accepted by name"]
        columns = [[*own, *_drive(run)] for own, run in zip(columns, content.runs, strict=True)]
    if len(columns) == 1:
        one = [*zip(names, columns[0], strict=True), ("evaluated by", content.made_by)]
        return Part("tested", "What was tested", section("verdict.html.j2", "tested", one, None))
    cut = [SHORT_HASH if "SHA" in name else LONGEST for name in names]
    rows = [
        [run.name, *(value[:most] for value, most in zip(own, cut, strict=True))]
        for run, own in zip(content.runs, columns, strict=True)
    ]
    title = f"Evaluated by {content.made_by}. Of each SHA-256 the first {SHORT_HASH} digits; the evidence has all"
    found = Table(title, ["run", *names], rows, words=range(len(names) + 1))
    return Part("tested", "What was tested", section("verdict.html.j2", "tested", [], found))


def _identity(run: Run) -> list[str]:
    entries = run.log.run
    bench = entries.get("bench_name", "")
    if bench and (digest := entries.get("bench_hash", "")):
        bench = f"{bench}, SHA-256 {digest[:SHORT_HASH]}"
    found = (
        entries.get("device_serial", ""),
        entries.get("operator", ""),
        bench,
        run.began,
        entries.get("tool", ""),
        entries.get("policy_sha256", ""),
        run.log_sha256,
    )
    return [value[:LONGEST] or "not recorded" for value in found]


def _drive(run: Run) -> list[str]:
    mapping = run.log.metadata.get("emb.drive", {}).get("sha256", "")
    drive = f"{run.log.run.get('bus_drive', '')}, SHA-256 of the mapping {mapping[:SHORT_HASH]}" if mapping else ""
    lacks = "; ".join(f"{name}: {lost}" for name, lost in run.log.drive_lacks.items())
    return [value[:LONGEST] or "none" for value in (drive, lacks)]


def _of_several_runs(content: Content) -> Iterator[Part]:
    of = content.estimated
    found = trends(of) if len(of) > 1 else []
    drawn = trend_panels(found) if found else []
    yield Part("runs", "Runs", section("estimate.html.j2", "runs", run_table(content.runs, found), drawn, found))


def _next(study: Study) -> Iterator[Part]:
    """Recommended next step, where there is something to do."""
    if study.advice or not study.holds or study.stopped:
        gains = [tables.gain(r) for r in study.advice]
        yield Part("next", "What to do next", section("estimate.html.j2", "next", study, gains))


def _seen(run: Run, prefix: str) -> Iterator[Part]:
    """Figures of what the brake did."""
    cycles, after = _cycles(run), stop_samples(run)
    drawn = [] if cycles is None and run.experiment is None else figures.motion(run, cycles, after)
    if run.log.imported:
        drawn += [] if run.experiment is None else [figures.applied(run, run.experiment)]
    elif cycles is not None:
        drawn.append(figures.excitation(run, cycles, after))
    if run.residuals is not None:
        drawn.append(figures.residuals(run, run.residuals))
    if drawn:
        title = "Measured" if run.growth is None else "Measured against predicted"
        yield Part(f"{prefix}motion", title, section("run.html.j2", "motion", run, drawn, after))


def _of_all_runs(content: Content, study: Study) -> Iterator[Part]:
    def part(name: str, title: str, macro: str, *values: object) -> Part:
        return Part(name, title, section("estimate.html.j2", macro, *values))

    e = study.estimate
    models = [tables.models(study), tables.growth_path(study)]
    checks = (tables.residual_tests(study), tables.suspects(e), tables.systematic(e), tables.predicted(study))
    yield part("model", "Does the model fit", "model", study, *checks, models)
    if study.drifts:
        drifts = tables.drifts(study)
        yield part("drift", "Since the last campaign", "one_table", drifts)
    runs = [(run.name, run.growth) for run in content.estimated if run.growth is not None]
    if len(runs) > 1:
        yield part("contributions", "Information of each run", "one_table", tables.contributions(study, runs))
    drawable = certainty.drawable(e)
    drawn = {
        "ellipses": certainty.ellipses(e, study.truth) if len(drawable) > 1 else None,
        "profiles": certainty.profiles(study.profiles, e) if study.profiles else None,
    }
    labels = [e.labels[i] for i in drawable]
    found = (*tables.correlation(e), tables.minima(study), tables.bootstrap(study))
    yield part("uncertainty", "Uncertainty", "certainty", study, labels, drawn, tables.deviations(study), *found)


def _of_a_run(run: Run, content: Content, prefix: str) -> Iterator[Part]:
    def part(name: str, title: str, *values: object) -> Part:
        return Part(f"{prefix}{name}", title, section("run.html.j2", name, *values))

    cycles, study = None if run.log.imported else _cycles(run), content.study
    if cycles is not None:
        reasons = [f"{str(reason.name).lower()}: {words}" for reason, words in REASONS.items()]
        yield part("excitation", "Excitation", run, figures.applied_as_sent(run, cycles), reasons)
    if run.log.counts.get(LEARNT.name):
        steps, numbers = history(run.log)
        drawn = figures.learnt(run, steps, numbers)
        yield part("learnt", "What the shield learnt", drawn, last_ranges(numbers), run.log.run)
    if run.residuals is not None and study is not None:
        yield part("residuals", "Residuals", _residuals(run.residuals), study.estimate.method)
    if run.growth is not None and study is not None:
        panels = figures.information(run.growth)
        yield part("information", "Information", panels, *_information(run.growth), study.estimate)
    if not run.log.imported:  # nothing was driven: no loop was punctual, and no limit was held
        if (found := timing_part(run, prefix)) is not None:
            yield found
        yield _safety(run, cycles, prefix)
    counts = [[topic, str(count)] for topic, count in run.log.counts.items()]
    messages = Table("Messages in the file", ["topic", "messages"], counts)
    yield part("completeness", "Completeness of the log", run, messages)
    settings = [(key.removeprefix(SETTING), value) for key, value in run.log.end.items() if key.startswith(SETTING)]
    outcome = [(key, value) for key, value in run.log.end.items() if not key.startswith(SETTING)]
    attached = [[n, str(len(data)), hashlib.sha256(data).hexdigest()] for n, data in run.log.attachments.items()]
    files = Table("Files inside the log", ["attached file", "bytes", "SHA-256"], attached, words=(0, 2))
    yield part("identity", "Identity", run, settings, outcome, files)


def _cycles(run: Run) -> ActiveCycles | None:
    try:
        cycles = ActiveCycles(run)
    except LogError:
        return None
    return cycles if len(cycles.time) else None


def _residuals(errors: np.ndarray) -> Table:
    rows = []
    for i, name in enumerate(("angle", "velocity")):
        seen = errors[np.isfinite(errors[:, i]), i]
        if len(seen):
            size, beyond = float(np.sqrt(np.mean(seen**2))), float(np.mean(np.abs(seen) > 2.0))
            rows.append([name, str(len(seen)), plain(size), signed(float(seen.mean())), percent(beyond)])
    header = ["residuals of", "samples", "root mean square [sigma]", "mean [sigma]", "beyond 2 sigma"]
    return Table("In numbers", header, rows)


def _information(g: Growth) -> tuple[Table, Table]:
    """Tables of the information by sensor and by part of the run."""
    sensors = [
        [label, percent(angle), percent(velocity)]
        for label, (angle, velocity) in zip(g.labels, g.outputs.tolist(), strict=True)
    ]
    parts = [
        [f"{1e3 * begin:.0f} to {1e3 * end:.0f} ms", signed(gain), *map(percent, shares)]
        for begin, end, gain, shares in zip(g.borders, g.borders[1:], g.gains.tolist(), g.parts.tolist(), strict=False)
    ]
    gains = "Information by part of the run; the gain counts from where all parameters are identified"
    return (
        Table("Information by sensor", ["parameter", "from the angle", "from the velocity"], sensors),
        Table(gains, ["part of the run", "gain of log det", *(f"share of {n}" for n in g.labels)], parts),
    )


def timing_part(run: Run, prefix: str) -> Part | None:
    """Intervals of the loop, missed periods, the node's clock; None if no sample was answered."""
    t = run.timing
    if t is None or not len(t.response):
        return None
    drawn = [] if t.simulated else figures.times(t)
    return Part(f"{prefix}timing", "Timing", section("run.html.j2", "timing", t, _intervals(t), drawn))


def _intervals(t: Timing) -> Table:
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    header = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Table("Times of the loop, by the stamps in the log", header, rows)


def _safety(run: Run, cycles: ActiveCycles | None, prefix: str) -> Part:
    events = run.log.events
    active = [event.time_ns for event in events if event.code == "ACTIVE"]
    begin = min(active) if active else events[0].time_ns if events else 0
    rows = [
        [signed(1e-6 * (event.time_ns - begin), "+.3f"), event.code[:LONGEST], event.text[:LONGEST]]
        for event in events[:EVENTS]
    ]
    zero = "the experiment's begin" if active else "the first event"
    shown = Table(f"Events of the safety chain, since {zero}", ["time [ms]", "event", "what"], rows, words=(1, 2))
    speed, why_not = None, ""
    try:
        speed = end_stop_speed(run.bench)
    except BenchFileError as err:
        why_not = str(err)
    more = len(events) - len(rows)
    body = section("run.html.j2", "safety", run, cycles, REASONS, speed, why_not, shown, more)
    return Part(f"{prefix}safety", "Safety", body)
