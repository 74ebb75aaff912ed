"""The page of a report: its figures and tables, for one template.

The content of a log is not trusted: its metadata and events may contain anything. HTML is escaped wherever a value is
put into it, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import QUANTILES
from emb_bench.documents import to_json
from emb_bench.estimate.records import METHODS
from emb_bench.logs import timing
from emb_bench.logs.info import info_document
from emb_bench.logs.timing import INTERVALS, quantiles
from emb_bench.numbers import p_value, seconds, signed
from emb_bench.report import figures, sentences, tables
from emb_bench.report.caveats import caveats
from emb_bench.report.content import REASONS, Content, Run
from emb_bench.report.estimate import document as estimate_document
from emb_bench.report.text import Table
from emb_bench.report.trend import panels as trend_panels
from emb_bench.report.trend import table as run_table
from emb_bench.report.trend import trends
from emb_runtime.errors import BenchFileError
from emb_runtime.numbers import plain
from emb_runtime.safety.end_stop import end_stop_speed
from emb_runtime.system.terminal import escaped

UNITS_OF_METADATA = {
    "limit": "A", "current": "A", "angle_min": "rad", "angle_max": "rad", "top_speed": "rad/s",
    "unexplained": "rad/s", "unexplained_allowed": "rad/s", "gamma": "m",
    **{name: row.unit for name, row in PARAMETERS.items() if row.unit != "1"},
}  # fmt: skip
"""Units of numbers in a log's metadata, by the ends of their names."""
EVENTS = 200  # Most safety events that are shown; report.json has them all
LONGEST = 2000  # Characters of an event that are shown; report.json has them all
SHORT_HASH = 16  # Digits of a hash that are shown where there is no room for all


class Safety(NamedTuple):
    """Events of the safety chain, and what a loss of all commands would do."""

    speed: float | None  # At an end stop, at worst [rad/s]; None if unknown
    why_not: str
    events: Table
    more: int  # Events that are not shown


def report_page(content: Content) -> str:
    """The whole report as HTML: the verdict first, then what it rests on; evidence is folded."""
    study, several = content.shown, len(content.runs) > 1
    # Of an experiment that was cut short no value is used, nor a prediction with it.
    runs = [replace(run, predicted=None, residuals=None) if study is None else run for run in content.runs]
    found = trends(content.estimated) if len(content.estimated) > 1 else []
    correlation, pairs = (None, []) if study is None else tables.correlation(study.estimate)
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            content=content,
            study=study,
            runs=runs,
            figures_of=functools.cache(figures.of_run),
            run_table=run_table(content.runs, found) if several else None,
            trends=found,
            trend_panels=trend_panels(found),
            tested=_tested(content),
            correlation=correlation,
            pairs=pairs,
            profiles=figures.profiles(study.profiles, study.estimate) if study and study.profiles else None,
        )
    )


def _tested(content: Content) -> tuple[list[tuple[str, str]], Table | None]:
    """Device, conditions, versions and hashes, as the logs have them: what all runs share, and a table of the rest."""
    columns = [_identity(run) for run in content.runs]
    alike = {name: len({own[name] for own in columns}) == 1 for name in columns[0]}
    facts = [(name, columns[0][name]) for name, same in alike.items() if same]
    facts += [("evaluated by", content.made_by), ("report number", content.number)]
    names = [name for name, same in alike.items() if not same]
    if not names:
        return facts, None
    cut = [SHORT_HASH if "SHA" in name else LONGEST for name in names]
    rows = [
        [run.name, *(own[name][:most] for name, most in zip(names, cut, strict=True))]
        for run, own in zip(content.runs, columns, strict=True)
    ]
    title = f"Of each SHA-256 the first {SHORT_HASH} digits; the evidence has all"
    return facts, Table(title, ["run", *names], rows, words=range(len(names) + 1))


def _identity(run: Run) -> dict[str, str]:
    """Device, conditions, versions and hashes of one run."""
    entries, limits, noise = run.log.run, run.bench.limits, run.bench.noise
    name, digest = entries.get("bench_name", ""), entries.get("bench_hash", "")[:SHORT_HASH]
    found = {
        "device serial": entries.get("device_serial") or "not recorded (emb-run --serial)",
        "operator": entries.get("operator") or "not recorded (emb-run --operator)",
        "recorded": run.began,
        "recorded by": entries.get("tool", ""),
        "bench": f"{name}, SHA-256 {digest}" if name and digest else name,
        "conditions": f"{plain(1e3 * run.bench.timing.sample_time)} ms sample time; noise {plain(noise.angle)} rad, "
        f"{plain(noise.velocity)} rad/s; limits {plain(limits.angle[0])} to {plain(limits.angle[1])} rad, "
        f"{plain(limits.velocity)} rad/s, {plain(limits.current)} A",
        "policy SHA-256": entries.get("policy_sha256", ""),
        "log SHA-256": run.log_sha256,
    }
    if run.log.is_recording:
        del found["conditions"]
    return {key: value[:LONGEST] or "not recorded" for key, value in (found | _drive(run)).items()}


def _drive(run: Run) -> dict[str, str]:
    """A mapped drive, and what it lacks."""
    found = run.log.metadata.get("emb.drive", {})
    if not found:
        return {}
    lacks = "; ".join(f"{name}: {lost}" for name, lost in run.log.drive_lacks.items())
    return {
        "drive": f"{found['name']}, SHA-256 of the mapping {found['sha256'][:SHORT_HASH]}",
        "it lacks": lacks or "none",
    }


def with_units(entries: Mapping[str, str]) -> list[tuple[str, str]]:
    """Metadata of a log, numbers that have a unit with it and to four digits; others may be serial numbers."""
    found = []
    for name, text in entries.items():
        with suppress(ValueError):
            if unit := next((unit for end, unit in UNITS_OF_METADATA.items() if name.endswith(end)), ""):
                text = f"{plain(float(text), 4)} {unit}"
        found.append((name, text))
    return found


def intervals(run: Run) -> Table | None:
    """Intervals of the loop; None if no sample was answered, or there was none."""
    t = run.timing
    if t is None or not len(t.response):
        return None
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    header = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Table("Times of the loop, by the stamps in the log", header, rows)


def safety(run: Run) -> Safety | None:
    """Events and the worst that a loss of all commands would do; None of a recording of others."""
    if run.log.is_recording:
        return None
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
        "plain": plain,
        "signed": signed,
        "seconds": seconds,
        "p_value": p_value,
        "data_uri": _data_uri,
        "capitalize_first": lambda words: words[:1].upper() + words[1:],
    }
    made.globals |= {
        "METHODS": METHODS,
        "say": sentences,
        "caveats": caveats,
        "tables": tables,
        "reasons": REASONS,
        "obeyed": figures.applied_as_sent,
        "intervals_of": intervals,
        "with_units": with_units,
        "safety_of": safety,
        "digest": lambda data: hashlib.sha256(data).hexdigest(),
        "css": Markup(resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")),
    }
    return made


def _printable(value: Any) -> Any:
    """Text without characters that control or cannot be seen, but for spaces: a log may contain any."""
    if isinstance(value, Markup):
        return Markup(escaped(value, "\t\n\r"))
    return escaped(value, "\t\n\r") if isinstance(value, str) else value


def _data_uri(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")


def document(content: Content) -> dict[str, Any]:
    """JSON document with the content of the page; numbers may be infinite."""
    study = content.study
    found: dict[str, Any] = to_json(
        {
            "number": content.number,
            "simulated": bool(content.simulated),
            "made_by": content.made_by,
            "acceptance": None if content.acceptance is None else content.acceptance.document(),
            "model_fits": None if study is None else study.model_fits,
            "predicts": None if study is None else study.predicts,
            "why_no_estimate": content.why_not,
            "left_out": [{"log": path, "why": why} for path, why in content.left_out],
            "estimate": None if study is None else estimate_document(study),
            "runs": [_run_document(run) for run in content.runs],
        }
    )
    return found


def _run_document(run: Run) -> dict[str, Any]:
    found: dict[str, Any] = {
        "began": run.began,
        "simulated": bool(run.log.simulated),
        "why_not_estimated": run.why_not,
        "sha256": run.log_sha256,
        "info": None if run.log.is_recording else info_document(run.log),
        "timing": None if run.timing is None else timing.document(run.timing),
    }
    x, alone = run.experiment, run.alone
    if x is not None:
        found["experiment"] = {
            "planned": x.planned,
            "command_delay": x.command_delay,
            "missing": sentences.lacks(x),
            "notes": sentences.taken_for_acted(x),
            "periods": len(x.currents),
            "measured": x.measured.sum(),
            "braked_periods": x.braked,
            "applied_current": x.currents,
            "angle": x.all_samples[:, 0],
            "velocity": x.all_samples[:, 1],
        }
    if alone is not None:
        found["alone"] = {"model_fits": alone.model_fits, "conclusions": alone.conclusions}
    if run.residuals is not None:
        found["residuals"] = {"angle": run.residuals[:, 0], "velocity": run.residuals[:, 1]}
    return found
