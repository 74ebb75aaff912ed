"""What is to be said of one run: what was done to the brake, what it did, and what kind of record that is."""

from __future__ import annotations

import hashlib
import math

import numpy as np

from emb_bench.logs.info import cycles_document
from emb_bench.logs.timing import INTERVALS, quantiles
from emb_bench.numbers import percent, plain, seconds
from emb_bench.report import figures
from emb_bench.report.content import REASONS, Content, Course, Run
from emb_bench.report.markup import Child, Section, facts, picture, table, tag
from emb_runtime.config.timing_budgets import QUANTILES
from emb_runtime.errors import BenchFileError, LogError
from emb_runtime.safety.end_stop import impact_speed

EVENTS = 200
"""Most safety events that are shown; report.json has them all."""
LONGEST = 2000
"""Characters of a metadata value that are shown; report.json has them all."""
NAMED = {
    "tool": "tool",
    "command": "command line",
    "iface": "interface",
    "steps": "periods planned",
    "bench_name": "bench",
    "bench_hash": "bench hash",
    "dbc_protocol": "DBC protocol",
    "bus_load_worst": "worst bus load",
    "policy_sha256": "policy SHA-256",
    "policy_provenance": "policy made by",
    "python": "Python",
    "kernel": "kernel",
}
"""What the entries of a run's identity are called."""
SETTING = "rt_"
"""How the names of the real-time settings begin, among the entries of a run's outcome."""


def sections(run: Run, content: Content, prefix: str) -> list[Section]:
    """The sections of one run; ``prefix`` begins what they are linked by."""
    course = _course(run)
    found = [
        _excitation(run, prefix) if course is not None else None,
        _motion(run, prefix) if course is not None else None,
        _residuals(run, content, prefix),
        _information(run, content, prefix),
        punctuality(run, prefix),
        _safety(run, course, prefix),
        _completeness(run, prefix),
        _identity(run, prefix),
    ]
    return [section for section in found if section is not None]


def _course(run: Run) -> Course | None:
    try:
        course = Course(run)
    except LogError:
        return None
    return course if len(course.time) else None


def _excitation(run: Run, prefix: str) -> Section:
    x = run.experiment
    said = ["The node applied what was sent."] if figures.applied_as_sent(run, Course(run)) else []
    if x is not None and x.braked:
        said.append(f"{x.braked} periods were braked by the node itself, because no command came in time.")
    if x is not None and x.command_delay:
        said.append(f"Commands acted {x.command_delay} samples late, as the node's reports tell.")
    return Section(
        "Excitation",
        picture(
            figures.excitation(run),
            "Current over time: wanted by the policy, clipped, sent and applied, with marks where they differ",
            "Current of each period; dashed: the bench's limits. The bars say where another current was sent than was "
            f"wanted: {'; '.join(f'{str(r.name).lower()}: {words}' for r, words in REASONS.items())}.",
        ),
        tag("p", " ".join(said)) if said else None,
        name=f"{prefix}excitation",
    )


def _motion(run: Run, prefix: str) -> Section:
    predicted = run.growth is not None
    return Section(
        "Measured against predicted" if predicted else "Measured",
        picture(
            figures.motion(run),
            "Angle and velocity over time: measured"
            + (", and predicted by the model at the estimate" if predicted else ""),
            (
                "What the model predicts of this run at the estimate, from the applied currents alone. "
                if predicted
                else ""
            )
            + "Dashed: the bench's limits.",
        ),
        name=f"{prefix}motion",
    )


def _residuals(run: Run, content: Content, prefix: str) -> Section | None:
    if run.residuals is None or run.experiment is None or content.study is None:
        return None
    e = run.residuals
    rows = []
    for i, name in enumerate(("angle", "velocity")):
        seen = e[np.isfinite(e[:, i]), i]
        if not len(seen):
            continue
        beyond = float(np.mean(np.abs(seen) > 2.0))
        rows.append(
            [
                name,
                str(len(seen)),
                plain(float(np.sqrt(np.mean(seen**2)))),
                _signed(float(seen.mean())),
                percent(beyond),
            ]
        )
    what = "innovations" if content.study.estimate.method == "pem" else "measured less predicted"
    return Section(
        "Residuals",
        picture(
            figures.residuals(run, e),
            "Residuals of angle and velocity over time, their correlation with each other and with the current",
            f"The residuals ({what}) in standard deviations of the sensors. Under the right model 95\u00a0% lie in the "
            "band, and so does each correlation 95 times in 100.",
        ),
        table(["residuals of the", "samples", "root mean square [σ]", "mean [σ]", "beyond 2 σ"], rows, "In numbers"),
        name=f"{prefix}residuals",
    )


def _information(run: Run, content: Content, prefix: str) -> Section | None:
    g = run.growth
    if g is None or content.study is None:
        return None
    rows = [
        [label, percent(angle), percent(velocity)]
        for label, (angle, velocity) in zip(g.labels, g.outputs.tolist(), strict=True)
    ]
    parts = [
        [
            f"{1e3 * begin:.0f} to {1e3 * end:.0f} ms",
            _signed(gain),
            *(percent(share) for share in shares),
        ]
        for begin, end, gain, shares in zip(g.borders, g.borders[1:], g.gains.tolist(), g.parts.tolist(), strict=False)
    ]
    prior = " It begins at what was known beforehand." if content.study.estimate.asked.prior is not None else ""
    noisy = "" if content.study.estimate.method == "oem" else " It is computed as if the sensors alone were noisy."
    return Section(
        "Information",
        picture(
            figures.information(g),
            "Growth of log det, smallest eigenvalue and Cramér-Rao bounds, and the share of each part of the run",
            "Physical Fisher information of this run at the estimate, and the least standard deviations it allows; "
            f"percentages are of what is told of each unknown by itself.{prior}{noisy}",
        ),
        table(["parameter", "from the angle", "from the velocity"], rows, "Which sensor told it"),
        table(
            ["part of the run", "gain of log det", *(f"share of {label}" for label in g.labels)],
            parts,
            "Which part of the run told it; the gain counts from where all parameters are told",
        ),
        name=f"{prefix}information",
    )


def punctuality(run: Run, prefix: str) -> Section | None:
    """How punctual it was: intervals of the loop, missed periods, the node's clock."""
    t = run.timing
    if t is None or not len(t.response):
        return None
    obeyed = "not known" if t.not_obeyed is None else f"{t.not_obeyed} answers, by the node's own account"
    said: list[tuple[str, Child]] = [
        ("periods missed", f"{t.missed}, no sample came"),
        ("unanswered", f"{t.unanswered} samples"),
        ("not obeyed", obeyed),
        ("least time to spare", seconds(float(t.slack.min()))),
    ]
    if t.clock is not None:
        drift = f"{1e6 * t.clock.drift:+.3g}".replace("-", "−")
        said.append(("node's clock", f"slow by {drift} ppm; arrivals scatter by {seconds(t.clock.jitter)}"))
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    head = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Section(
        "Timing",
        tag("p", "Time was simulated: these times say nothing of any computer or bus.", cls="care")
        if t.simulated
        else None,
        facts(said),
        table(head, rows, "Times of the loop, by the stamps in the log"),
        None
        if t.simulated
        else picture(
            figures.times(t),
            "Time from a sensor sample to its command over the run and as a histogram, and a histogram of the periods",
            "From a sample's arrival until the bus had taken its answer, over the run and as a histogram; and from one "
            "sample's arrival to the next one's. Counts are on a logarithmic scale, so that single ones show.",
        ),
        name=f"{prefix}timing",
    )


def _safety(run: Run, course: Course | None, prefix: str) -> Section:
    log, limits = run.log, run.bench.limits
    said: list[tuple[str, Child]] = []
    if course is not None:
        count = len(course.time)
        said += [
            (str(reason.name).lower(), f"{int(where.sum())} of {count} periods, {REASONS[reason]}")
            for reason, where in course.reasons.items()
        ]
        largest = cycles_document(log)["largest"]
        low, high, speed = largest["angle_min"], largest["angle_max"], largest["speed"]
        said += [
            (
                "angle",
                [
                    _against(
                        f"{plain(low, 4)} to {plain(high, 4)} rad",
                        limits.angle[0] <= low and high <= limits.angle[1],
                    ),
                    f", limits {plain(limits.angle[0])} and {plain(limits.angle[1])} rad",
                ],
            ),
            (
                "largest speed",
                [
                    _against(f"{plain(speed, 4)} rad/s", speed <= limits.velocity),
                    f", limit {plain(limits.velocity)} rad/s",
                ],
            ),
            ("largest current", [f"{plain(largest['current'], 4)} A, limit {plain(limits.current)} A"]),
        ]
    said.append(("if all commands stopped at the worst moment", _let_go(run)))
    if stopped := log.end.get("node_stop_reason"):
        said.append(("the node's stop reason", stopped[:LONGEST]))
    events = log.events
    begin = min(
        (event.time_ns for event in events if event.code == "ACTIVE"), default=events[0].time_ns if events else 0
    )
    rows = [
        [f"{1e-6 * (event.time_ns - begin):+.3f}".replace("-", "−"), event.code[:LONGEST], event.text[:LONGEST]]
        for event in events[:EVENTS]
    ]
    more = len(events) - len(rows)
    zero = "the experiment's begin" if any(event.code == "ACTIVE" for event in events) else "the first event"
    return Section(
        "Safety",
        facts(said) if said else None,
        table(["time [ms]", "event", "what"], rows, f"Events of the safety chain, since {zero}", words=(1, 2))
        if rows
        else tag("p", "No event was recorded."),
        tag("p", f"{more} further events are in report.json.") if more else None,
        name=f"{prefix}safety",
    )


def _let_go(run: Run) -> Child:
    """What a loss of all commands would have done, for any brake of the shield's set."""
    try:
        speed = impact_speed(run.bench)
    except BenchFileError as err:
        return tag("strong", f"unknown: {err}", cls="bad")
    how = "the node brakes" if run.bench.node.stop == "damped" else "the node lets go"
    if speed == 0.0:
        return f"{how}, and no brake of the set '{run.bench.shield.ranges}' reaches an end stop"
    return tag("strong", f"{how}, and a brake of the set may hit an end stop with {plain(speed, 3)} rad/s", cls="bad")


def _against(text: str, inside: bool) -> Child:
    return text if inside else tag("strong", f"{text}: BEYOND THE LIMIT", cls="bad")


def _completeness(run: Run, prefix: str) -> Section:
    log = run.log
    missing = [log.missing] if log.missing else []
    missing += [] if run.experiment is None else list(run.experiment.missing)
    said: list[tuple[str, Child]] = [
        (
            "file",
            tag("span", "complete: closed properly, every checksum right", cls="good")
            if log.complete
            else tag("strong", "NOT complete", cls="bad"),
        ),
        ("missing", "; ".join(missing) if missing else "nothing"),
        ("exit reason", log.exit_reason),
    ]
    if log.end.get("detail"):
        said.append(("detail", log.end["detail"][:LONGEST]))
    if run.experiment is not None:
        x = run.experiment
        said.append(
            ("experiment", f"{len(x.currents)} of {x.planned} periods, {int(x.measured.sum())} samples received")
        )
    counts = [[topic, str(count)] for topic, count in log.counts.items()]
    return Section(
        "Completeness of the log",
        facts(said),
        table(["topic", "messages"], counts, "Messages in the file"),
        name=f"{prefix}completeness",
    )


def _identity(run: Run, prefix: str) -> Section:
    log = run.log
    rows: list[tuple[str, Child]] = [
        ("file", tag("code", str(log.path))),
        ("recorded", run.began or "the log does not say"),
    ]
    rows += [(NAMED.get(key, key), _code(value)) for key, value in log.run.items()]
    settings = [(key.removeprefix(SETTING), _code(v)) for key, v in log.end.items() if key.startswith(SETTING)]
    outcome = [(key, _code(v)) for key, v in log.end.items() if not key.startswith(SETTING)]
    others = [
        Section(name, facts((key, _code(value)) for key, value in entries.items()), name=f"{prefix}identity-{n}")
        for n, (name, entries) in enumerate(log.metadata.items())
        if name not in ("emb.run", "emb.end")
    ]
    attached = [
        [name, str(len(data)), tag("code", hashlib.sha256(data).hexdigest())] for name, data in log.attachments.items()
    ]
    return Section(
        "Identity",
        facts(rows),
        tag("h4", "Real-time settings obtained"),
        facts(settings)
        if settings
        else tag("p", "None are recorded" + (": time was simulated." if run.simulated else ".")),
        [tag("h4", "Outcome as recorded"), facts(outcome)] if outcome else None,
        table(["attached file", "bytes", "SHA-256"], attached, "Files inside the log", words=(0, 2)),
        [(tag("h4", section.title), section.children) for section in others],
        name=f"{prefix}identity",
    )


def _code(value: str) -> Child:
    if not value:
        return "–"
    short = value[:LONGEST]
    return [tag("code", short), f" … {len(value) - LONGEST} further characters" if len(value) > LONGEST else None]


def _signed(value: float) -> str:
    if not math.isfinite(value):
        return plain(value)
    return f"{value:+.3g}".replace("-", "−")
