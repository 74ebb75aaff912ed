"""The page of a report: its figures and tables, for one template.

The content of a log is not trusted: its metadata and events may contain anything. HTML is escaped wherever a value is
put into it, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from emb_bench import numbers
from emb_bench.analysis.growth import Growth
from emb_bench.analysis.study import Study
from emb_bench.config.bench import QUANTILES
from emb_bench.estimate.records import METHODS
from emb_bench.logs.estimates import learnt_history, learnt_ranges
from emb_bench.logs.timing import INTERVALS, Timing, quantiles
from emb_bench.numbers import percent, plain, seconds, signed
from emb_bench.report import certainty, figures, sentences, tables
from emb_bench.report.content import REASONS, ActiveCycles, Content, Run, StopSamples, stop_samples
from emb_bench.report.figures import Panel
from emb_bench.report.text import Table
from emb_bench.report.trend import panels as trend_panels
from emb_bench.report.trend import table as run_table
from emb_bench.report.trend import trends
from emb_runtime.errors import BenchFileError, LogError
from emb_runtime.log.mcap_schema import LEARNT
from emb_runtime.safety.end_stop import end_stop_speed

EVENTS = 200  # Most safety events that are shown; report.json has them all
LONGEST = 2000  # Characters of an event that are shown; report.json has them all
SHORT_HASH = 16  # Digits of a hash that are shown where there is no room for all
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
SETTING = "rt_"  # Prefix of the real-time settings among the entries of a run's outcome


@dataclass(frozen=True)
class View:
    """Tables and figures of one run, by their names in the template."""

    run: Run
    prefix: str  # Of the HTML identifiers of its sections; empty if it is the only run
    cycles: ActiveCycles | None
    after: StopSamples | None
    motion: list[Panel]
    obeyed: bool
    learnt: tuple[list[Panel], dict[str, list[float]]] | None
    residuals: Table | None
    information: tuple[list[Panel], Table, Table] | None
    timing: tuple[Table, list[Panel]] | None
    safety: Safety | None
    counts: Table
    settings: list[tuple[str, str]]
    outcome: list[tuple[str, str]]
    files: Table


class Safety(NamedTuple):
    """Events of the safety chain, and what a loss of all commands would do."""

    speed: float | None  # At an end stop, at worst [rad/s]; None if unknown
    why_not: str
    events: Table
    more: int  # Events that are not shown


def report_page(content: Content) -> str:
    """The whole report as HTML: the verdict first, then what it rests on; evidence is folded.

    Raises:
        UsageError: matplotlib is missing.
        LogError: a log cannot be read any more.
    """
    several = len(content.runs) > 1
    views = [view(run, f"run-{n}-" if several else "") for n, run in enumerate(content.runs, 1)]
    found = trends(content.estimated) if len(content.estimated) > 1 else []
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            content=content,
            study=content.study,
            views=views,
            acceptance=tables.acceptance_table(content.acceptance),
            runs=run_table(content.runs, found) if several else None,
            trends=found,
            trend_panels=trend_panels(found),
            tested=_tested(content),
            reasons=REASONS,
            terms=sentences.TERMS,
            **({} if content.study is None else _of_study(content, content.study)),
        )
    )


def _of_study(content: Content, study: Study) -> dict[str, Any]:
    """Tables and figures of the estimate, by their names in the template."""
    e = study.estimate
    correlation, pairs = tables.correlation(e)
    runs = [(run.name, run.growth) for run in content.estimated if run.growth is not None]
    checks = (tables.residual_tests(study), tables.suspects(e), tables.systematic(e), tables.predicted(study))
    return {
        "parameters": tables.parameters(study),
        "gains": [tables.gain(r) for r in study.advice],
        "checks": (*checks, tables.models(study), tables.growth_path(study)),
        "drifts": tables.drifts(study) if study.drifts else None,
        "contributions": tables.contributions(study, runs) if len(runs) > 1 else None,
        "deviations": tables.deviations(study),
        "ellipses": certainty.ellipses(e, study.truth) if len(certainty.drawable(e)) > 1 else None,
        "correlation": correlation,
        "pairs": pairs,
        "profiles": certainty.profiles(study.profiles, e) if study.profiles else None,
        "bootstrap": tables.bootstrap(study),
        "minima": tables.minima(study),
    }


def view(run: Run, prefix: str = "") -> View:
    """Tables and figures of one run."""
    log, growth = run.log, run.growth
    cycles, after = _cycles(run), stop_samples(run)
    end, driven = log.end, not log.imported
    attached = [[n, str(len(data)), hashlib.sha256(data).hexdigest()] for n, data in log.attachments.items()]
    return View(
        run=run,
        prefix=prefix,
        cycles=cycles if driven else None,
        after=after,
        motion=_motion(run, cycles, after),
        obeyed=cycles is not None and figures.applied_as_sent(run, cycles),
        learnt=_learnt(run) if log.counts.get(LEARNT.name) else None,
        residuals=None if run.residuals is None else _residuals(run.residuals),
        information=None if growth is None else (figures.information(growth), *_information(growth)),
        timing=_timing(run) if driven else None,
        safety=_safety(run) if driven else None,
        counts=Table("Messages in the file", ["topic", "messages"], [[t, str(n)] for t, n in log.counts.items()]),
        settings=[(key.removeprefix(SETTING), value) for key, value in end.items() if key.startswith(SETTING)],
        outcome=[(key, value) for key, value in end.items() if not key.startswith(SETTING)],
        files=Table("Files inside the log", ["attached file", "bytes", "SHA-256"], attached, words=(0, 2)),
    )


def _tested(content: Content) -> list[tuple[str, str]] | Table:
    """Device, bench, operator, versions and hashes, as the logs have them."""
    names = ["device serial", "operator", "bench", "recorded", "recorded by", "policy SHA-256", "log SHA-256"]
    columns = [_identity(run) for run in content.runs]
    if any(run.log.drive_files is not None for run in content.runs):
        names = [*names, "drive", "which lacks, accepted by name"]
        columns = [[*own, *_drive(run)] for own, run in zip(columns, content.runs, strict=True)]
    if len(columns) == 1:
        return [*zip(names, columns[0], strict=True), ("evaluated by", content.made_by)]
    cut = [SHORT_HASH if "SHA" in name else LONGEST for name in names]
    rows = [
        [run.name, *(value[:most] for value, most in zip(own, cut, strict=True))]
        for run, own in zip(content.runs, columns, strict=True)
    ]
    title = f"Evaluated by {content.made_by}. Of each SHA-256 the first {SHORT_HASH} digits; the evidence has all"
    return Table(title, ["run", *names], rows, words=range(len(names) + 1))


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
    found = run.log.metadata.get("emb.drive", {})
    drive = f"{found['name']}, SHA-256 of the mapping {found['sha256'][:SHORT_HASH]}" if found else ""
    lacks = "; ".join(f"{name}: {lost}" for name, lost in run.log.drive_lacks.items())
    return [value[:LONGEST] or "none" for value in (drive, lacks)]


def _motion(run: Run, cycles: ActiveCycles | None, after: StopSamples | None) -> list[Panel]:
    """Figures of what the brake did."""
    drawn = [] if cycles is None and run.experiment is None else figures.motion(run, cycles, after)
    if run.log.imported:
        drawn += [] if run.experiment is None else [figures.applied(run, run.experiment)]
    elif cycles is not None:
        drawn.append(figures.excitation(run, cycles, after))
    return drawn if run.residuals is None else [*drawn, figures.residuals(run, run.residuals)]


def _learnt(run: Run) -> tuple[list[Panel], dict[str, list[float]]]:
    steps, numbers = learnt_history(run.log)
    return figures.learnt(run, steps, numbers), learnt_ranges(numbers)


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


def _timing(run: Run) -> tuple[Table, list[Panel]] | None:
    """Intervals of the loop and their figures; None if no sample was answered."""
    t = run.timing
    if t is None or not len(t.response):
        return None
    return _intervals(t), [] if t.simulated else figures.times(t)


def _intervals(t: Timing) -> Table:
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    header = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Table("Times of the loop, by the stamps in the log", header, rows)


def _safety(run: Run) -> Safety:
    events = run.log.events
    active = [event.time_ns for event in events if event.code == "ACTIVE"]
    begin = min(active) if active else events[0].time_ns if events else 0
    rows = [
        [signed(1e-6 * (event.time_ns - begin), "+.3f"), event.code[:LONGEST], event.text[:LONGEST]]
        for event in events[:EVENTS]
    ]
    zero = "the experiment's begin" if active else "the first event"
    shown = Table(f"Events of the safety chain, since {zero}", ["time [ms]", "event", "what"], rows, words=(1, 2))
    more = len(events) - len(rows)
    try:
        return Safety(end_stop_speed(run.bench), "", shown, more)
    except BenchFileError as err:
        return Safety(None, str(err), shown, more)


@functools.cache
def environment() -> Environment:
    """The templates of this folder; values are escaped."""
    made = Environment(
        loader=PackageLoader("emb_bench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )
    made.filters |= {
        "plain": numbers.plain,
        "signed": numbers.signed,
        "seconds": numbers.seconds,
        "p_value": sentences.p_value,
        "data_uri": _data_uri,
        "capitalize_first": lambda words: words[:1].upper() + words[1:],
    }
    made.globals |= {
        "METHODS": METHODS,
        "say": sentences,
        "css": Markup(resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")),
    }
    return made


def _printable(value: Any) -> Any:
    """Control characters have no place in HTML; they are shown as a replacement."""
    if isinstance(value, Markup):
        return Markup(_CONTROL.sub("\ufffd", value))
    return _CONTROL.sub("\ufffd", value) if isinstance(value, str) else value


def _data_uri(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")
