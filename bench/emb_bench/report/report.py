"""Report on runs of one brake: the study, the acceptance, and the page about both."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from emb_bench.analysis.conclusion import Conclusion
from emb_bench.analysis.study import Code, StudiedRun, Study, Verdict, verdict
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import QUANTILES, Bench
from emb_bench.config.conditions import CONDITIONS
from emb_bench.documents import to_json
from emb_bench.estimate.records import DONE, METHODS
from emb_bench.logs import timing
from emb_bench.logs.info import info_document
from emb_bench.logs.timing import INTERVALS, Timing, quantiles
from emb_bench.numbers import p_value, seconds, signed
from emb_bench.report import figures, tables, trend
from emb_bench.report import sentences as say
from emb_bench.report.acceptance import Acceptance
from emb_bench.report.caveats import caveats
from emb_bench.report.estimate import study_document
from emb_bench.report.information import assumed_currents, lacks
from emb_bench.report.motion import REASONS, Motion
from emb_bench.report.page import (
    LONGEST,
    Block,
    Facts,
    Figures,
    Heading,
    Items,
    Page,
    Panel,
    Section,
    Text,
    Words,
    code,
)
from emb_bench.report.text import Cell, Table
from emb_runtime.errors import BenchFileError
from emb_runtime.numbers import plain
from emb_runtime.safety.end_stop import end_stop_speed

UNITS_OF_METADATA = {
    "limit": "A", "current": "A", "angle_min": "rad", "angle_max": "rad", "top_speed": "rad/s",
    "unexplained": "rad/s", "unexplained_allowed": "rad/s", "gamma": "m",
    **{name: row.unit for name, row in PARAMETERS.items() if row.unit != "1"},
}  # fmt: skip
"""Units of numbers in a log's metadata, by the ends of their names."""
EVENTS = 200  # Most safety events on the page; report.json has all
SHORT_HASH = 16  # Digits of an abbreviated hash
BLANK = ("Tested by, date", ""), ("Signature", "")  # Lines to be written on


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """A study with all further content of its page."""

    study: Study
    bench: Bench
    left_out: Sequence[tuple[Path, str]]  # Unusable files with the reasons
    made_by: str  # Name and version of the tool that made the report
    acceptance: Acceptance | None = None  # Results of the acceptance criteria; None if none were given

    def __repr__(self) -> str:
        """The verdict in one line."""
        return f"<Report on {', '.join(self.study.names)}: {self.sentence}>"

    @property
    def simulated(self) -> str:
        """Sentence on simulated runs; empty without any."""
        return say.simulated(self.study)

    @property
    def sentence(self) -> str:
        """The verdict in one line, after the sentence on simulated runs."""
        return " ".join(filter(None, (self.simulated, self._sentence)))

    @property
    def _sentence(self) -> str:
        code, stops, compared = self.verdict.code, self.study.stops, self.study.side_by_side
        if not compared and code in (Code.ABORTED, Code.STOPPED):
            more = f", and {len(stops) - 1} more" if len(stops) > 1 else ""
            return f"{'NOT ACCEPTED. ' if self.acceptance else ''}{say.stopped(stops[0])}{more}"
        if self.acceptance is not None:
            return self.acceptance.verdict
        if compared:
            return say.compared(compared)
        return say.ONLY_ALONE if code is Code.APART else say.headline(self.study)

    @property
    def verdict(self) -> Verdict:
        """The verdict, that of the acceptance criteria before that on the model."""
        return verdict(self.study, None if self.acceptance is None else self.acceptance.result)

    @property
    def without_part(self) -> list[str]:
        """Reason for each unused log, after its name."""
        runs = [f"{run.name}: not used in the estimate: {run.why_not}" for run in self.study.runs if run.why_not]
        return [*(f"{path.name}: left out: {why}" for path, why in self.left_out), *runs]

    @property
    def number(self) -> str:
        """Number of the report: the same logs have the same."""
        hashes = "".join(run.log.sha256 for run in self.study.runs)
        return hashlib.sha256(hashes.encode()).hexdigest()[:10].upper()


# ---- the page ----


def page_of(report: Report) -> Page:
    """The page about a report."""
    study, found, compared = report.study, report.verdict, report.study.side_by_side
    # An experiment that was cut short gives neither values nor a prediction.
    shown = study.joint is not None and found.code is not Code.ABORTED
    runs = study.runs
    one = runs[0] if len(runs) == 1 else None
    motions = [Motion.of(run, report.bench, run.alone if compared else study if shown else None) for run in runs]
    names = study.names
    began = sorted(filter(None, (run.log.began for run in study.reported)))
    sources = ", ".join(sorted({run.log.source for run in study.reported}))
    when = "" if not began else f", {began[0]}" + (f" to {began[-1]}" if began[-1] != began[0] else "")
    to_do = say.remedies(study, stopped=bool(study.stops)) if shown else []
    drawn = [figures.of_run(motion) for motion in motions]
    several = trend.trends(study.used) if len(study.used) > 1 and not compared else []
    facts, table = _tested(report)
    sections = [
        Section("compared", "Side by side", _compared(study, drawn)) if compared else None,
        None if one or compared else Section("runs", "Runs", _runs(runs, several)),
        Section("parameters", "Parameters", _parameters(study)) if shown else None,
        Section("next", "What to do next", _next(study, found, to_do)) if to_do else None,
        Section("motion", _measured(motions[0]), [_motion(motions[0], drawn[0])]) if one and drawn[0] else None,
        Section("tested", "What was tested", [facts, table, None if shown else _signature(study)]),
    ]
    parts = [part for part in sections if part is not None]
    return Page(
        mark="SIMULATED: " if report.simulated else "",
        number=report.number,
        title=", ".join(names),
        heading=", ".join(names) if len(names) < 4 else f"{len(names)} runs",
        lead=f"{sources}{when}",
        outside=[line + ("" if one else f" ({name})") for name, line in say.outside(study, report.bench)],
        verdict=Cell(report.sentence, found.tone),
        banners=list(_banners(report, found, shown=shown)),
        summary=Section("verdict", "Verdict", list(_summary(report, found, shown=shown))),
        links=[*((part.name, part.title) for part in parts), ("evidence", "Evidence")],
        sections=parts,
        evidence=[
            *(_evidence(study) if shown else ()),
            *_runs_in_full(report, motions, drawn),
            Section("words", "Terms", _words(study if shown else None), 3, folded=True),
        ],
        footer=f"Made by {report.made_by} from {', '.join(names)}. The JSON file beside this page has the same "
        "numbers. Copy this page only in full.",
    )


def _banners(report: Report, found: Verdict, *, shown: bool) -> Iterator[Text]:
    """Banners beside the verdict."""
    study = report.study
    if shown and (study.stops or report.acceptance):
        yield Text(say.headline(study), "note" if found.holds else "banner bad")
        if study.checks.apart:
            yield Text(say.ONLY_ALONE, "banner care")
    for run in study.reported:
        if not run.log.complete:
            yield Text(f"{run.name}: the log is NOT complete: {run.log.missing}", "banner care")
    yield from (Text(say.stopped(stop), "banner bad") for stop in study.stops[0 if study.side_by_side else 1 :])
    # Without an estimate the first sentence names the unused runs, but not the unusable files.
    lines = report.without_part if study.joint is not None else report.without_part[: len(report.left_out)]
    yield from (Text(line, "banner care") for line in lines)


def _summary(report: Report, found: Verdict, *, shown: bool) -> Iterator[Block | None]:
    """The verdict on the model, and on the run if there is one."""
    study, rows = report.study, list[tuple[str, Words | Sequence[Block]]]()
    one = study.runs[0] if len(study.runs) == 1 else None
    if study.side_by_side:
        for one_run in study.side_by_side:
            name = one_run.names[0]
            rows += [
                (f"Model, {name}", list(_model(one_run, verdict(one_run)))),
                (f"Run, {name}", _end(one_run.runs[0])),
            ]
    else:
        rows.append(("Model", list(_model(study, found)) if shown else _not_judged(study)))
    if one is not None:
        rows.append(("Run", _end(one)))
    for stop in study.stops:
        if stop.cause:
            rows.append(("Cause" if one else f"Cause, {stop.log}", stop.cause))
            rows.append(("Advice", f"{_capital(stop.advice)}. Find the cause before the next run."))
    yield Facts(rows)
    yield tables.acceptance_table(report.acceptance)
    if not shown and not study.side_by_side:
        return
    yield Text(f"sigma: {say.TERMS['sigma']}. chi2/n: {say.TERMS['chi2/n']}.", "note print")
    mark = "{}: {}" if study.side_by_side else "{1}"
    if defects := [
        mark.format(one_run.names[0], line)
        for one_run in study.side_by_side or [study]
        for line in (*say.missing(one_run), *caveats(one_run.estimate))
    ]:
        yield Heading("Before using a number", 3)
        yield Items(defects, "warnings")


def _not_judged(study: Study) -> Words:
    return [Cell(f"no verdict: {study.why_not or 'the experiment was cut short'}", "care")]


def _model(study: Study, found: Verdict) -> Iterator[Block]:
    e = study.estimate
    m = e.validation
    tested = not found.biased and not study.checks.apart
    if found.holds:
        size = f": chi2/n is {plain(m.ratio)}, {plain(m.expected[0])} to {plain(m.expected[1])} expected."
        yield Text([Cell("fits", "good"), size], paragraph=False)
    else:
        yield Text([Cell(found.standing, "bad")], paragraph=not tested)
        if tested:
            yield Items(say.alarms(e), "alarms")
        yield Items([f"{h.name}: {say.held_out(h)}" for h in study.checks.held_out if not h.fits], "alarms")
    models = f"{_capital(say.models(study))}." if say.models(study) else ""
    line = [f"Model '{e.plant.name}' ({say.model_reason(study)}). ", Cell(models, "care" if models else "")]
    yield Text(line, paragraph=False)
    if tested:
        yield Items(say.residual_notes(e), "warnings")


def _end(run: StudiedRun) -> Words:
    """End of a run, its samples, and whether its log is complete."""
    log, x = run.log, run.experiment
    detail, samples = log.end.get("detail"), 0 if x is None else int(x.measured.sum())
    periods = "" if x is None else f"{x.periods} of {x.quality.planned} periods, "
    counts = f"{periods}{samples} sample{'s' * (samples != 1)}; " if periods else ""
    completeness = Cell("the log is complete", "good") if log.complete else Cell("the log is NOT complete", "bad")
    end = Cell(log.exit_reason, "good" if log.exit_reason == DONE else "bad")
    return [end, f" ({detail})" if detail else "", f"; {counts}", completeness]


def _runs(runs: Sequence[StudiedRun], found: Sequence[trend.Trend]) -> list[Block | None]:
    """Each run alone, and the test whether they agree."""
    agreed: list[Words] = []
    for one in found:
        if (test := one.agreement) is not None:
            chance = p_value(test.p_value)
            sentence = f": the runs agree ({chance})." if test.constant else (
                f": the runs do NOT agree: they scatter {plain(test.scatter)} times as much as their intervals allow "
                f"({chance})."
            )  # fmt: skip
            agreed.append([Cell(one.label, "good" if test.constant else "bad"), sentence])
    panels = trend.panels(found)
    caption = (
        "Each run is evaluated alone, in the order of the logs. Shown is the distance from the median of the runs in "
        "which the model fits, ± total (95 %, k=2) without the errors that all runs share."
    )
    return [trend.table(runs, found), Items(agreed), Figures(panels, caption) if panels else None]


def _compared(study: Study, drawn: Sequence[Sequence[Panel]]) -> list[Block | None]:
    """Two runs in a column each: verdict, parameters, motion."""
    first, second = study.names
    pairs = [panel for pair in zip(*drawn, strict=False) for panel in pair]
    caption = f"Left (on a narrow page first) {first}, right {second}; each with the prediction of its estimate."
    wrong = [one.names[0] for one in study.side_by_side if not verdict(one).holds]
    return [
        tables.compared(study.side_by_side),
        *(Text(f"{name}: the intervals do not include the error of a wrong model.", "bad") for name in wrong),
        _care(say.changed_model(study.side_by_side[1])),
        Figures(pairs, caption),
    ]


def _parameters(study: Study) -> list[Block | None]:
    """Values, their method, doubts and budget."""
    e, found = study.estimate, verdict(study)
    note = say.intervals(e) if found.holds else f"{say.without(study)}."
    note += f" Method: {METHODS[e.method]}, model '{e.plant.name}' ({say.model_reason(study)})."
    note += f" Prior: {say.prior(e)}." if e.question.prior else ""
    walks = say.random_walks(e.bench.machine, e.process_noise, e.load_noise)
    note += "".join(f" Disturbance: {walk}." for walk in walks)
    bias = "the method's bias" if found.biased else "the error of a wrong model"
    return [
        tables.parameters(study),
        Text(note, "note"),
        Items([[Cell(c.label, "name"), f": {say.conclusion(c)}"] for c in study.conclusions if _notable(c)]),
        _care(say.changed_model(study)),
        None if found.holds else Text(f"The intervals do not include {bias}.", "bad"),
        tables.budget(study) if found.holds else None,
        tables.ratios(e) if found.holds else None,
        tables.clamping(study),
        _signature(study),
    ]


def _signature(study: Study) -> Facts:
    """Lines to be signed, with temperature and supply by the nodes, means of the runs."""
    logs, told = [run.log.conditions for run in study.reported], list[str]()
    for name, condition in CONDITIONS.items():
        if values := [one[name] for one in logs if name in one]:
            told.append(f"{plain(sum(values) / len(values), 4)} {condition.unit}")
    return Facts([("Temperature, supply", ", ".join(told)), *BLANK], "signature")


def _notable(c: Conclusion) -> bool:
    """Returns True for a parameter with doubts, trade-offs or a drift."""
    drifted = c.drift is not None and c.drift.drifted
    return bool(c.finding.doubts or c.finding.traded_with) or drifted


def _next(study: Study, found: Verdict, to_do: Sequence[str]) -> list[Block | None]:
    wrong = not study.model_fits and not found.biased
    return [Items([_capital(line) for line in to_do]), Text("More runs do not mend a wrong model.") if wrong else None]


def _measured(motion: Motion) -> str:
    return "Measured" if motion.predicted is None else "Measured against predicted"


def _motion(motion: Motion, drawn: Sequence[Panel]) -> Figures:
    caption = ""
    if motion.predicted is not None:
        caption += "Predicted: the model with the estimated parameters and the applied currents. "
    if motion.run.stop is not None:
        caption += "The red line is where the run was stopped"
        later = "; grey dots and the dotted current are from the stop until the recording ended. "
        caption += ". " if motion.after is None else later
    caption += "" if motion.run.log.is_recording else "Dashed: the bench's limits."
    return Figures(drawn, caption)


def _evidence(study: Study) -> Iterator[Section]:
    """Tests, changes and uncertainty behind the verdict."""
    e, checks = study.estimate, study.checks
    m = e.validation
    tested = not verdict(study).biased
    size = f"chi2/n is {plain(m.ratio, 4)} with {m.freedom} degrees of freedom; for the right model it lies between "
    size += f"{m.expected[0]:.3f} and {m.expected[1]:.3f} in 99 of 100 cases ({p_value(m.chi2_p)})."
    model = [
        Text(size),
        Items(say.assumptions(study), "warnings"),
        Items(say.alarms(e) if tested else (), "alarms"),
        Items(say.residual_notes(e) if tested else (), "warnings"),
        *tables.checks(study),
    ]
    yield Section("model", "Does the model fit", model, 3, folded=True)
    if checks.drifts:
        since = [tables.drifts(study), _care(say.changed_model(study))]
        yield Section("drift", "Since the last campaign", since, 3, folded=True)
    correlation, pairs = tables.correlation(e)
    blocks: list[Block | None] = [correlation, _care(say.pairs(pairs) if pairs else "")]
    if checks.profiles:
        labels = ", ".join(p.label for p in checks.profiles)
        shows = f"Increase of chi-squared with {labels}, beside the parabola of the Fisher information"
        caption = (
            "Increase of chi2 over the value of one unknown, relative to its estimate; all others are fitted again. "
            "Pale: the parabola of the Fisher information. Values below the dashed line are in the 95 % interval of a "
            "right model. The intervals above also include effects that the model may lack."
        )
        panel = Panel(figures.profiles(checks.profiles, e), shows)
        blocks += [Figures([panel], caption, wide=True)]
        blocks += [Items([f"{p.label}: {say.profile(p, e)}" for p in checks.profiles])]
    yield Section("uncertainty", "Uncertainty", [*blocks, _care(say.once(study))], 3, folded=True)


def _runs_in_full(report: Report, motions: Sequence[Motion], drawn: Sequence[Sequence[Panel]]) -> Iterator[Section]:
    """Evidence of each run; of several runs folded into one section for each."""
    if len(motions) == 1:
        yield from _of_run(motions[0])
        return
    for n, (motion, panels) in enumerate(zip(motions, drawn, strict=True), 1):
        alone = motion.run.alone if report.study.side_by_side else None
        parts = [*(() if alone is None else _evidence(alone)), *_of_run(motion)]
        first = _motion(motion, panels) if panels and alone is None else None
        inside = (replace(part, name=f"run-{n}-{part.name}", level=4, folded=False) for part in parts)
        yield Section(f"run-{n}", f"Run {n}: {motion.run.name}", [first, *inside], 3, folded=True)


def _of_run(motion: Motion) -> Iterator[Section]:
    if motion.cycles is not None:
        yield Section("excitation", "Excitation", _excitation(motion), 3, folded=True)
    punctual = motion.run.timing
    if punctual is not None and (table := intervals(punctual)) is not None:
        yield Section("timing", "Timing", _timing(punctual, table), 3, folded=True)
    if not motion.run.log.is_recording:
        yield Section("safety", "Safety", _safety(motion), 3, folded=True)
    yield Section("log", "The log", list(_log(motion.run)), 3, folded=True)


def _excitation(motion: Motion) -> list[Block | None]:
    x = motion.run.experiment
    summary = "The node applied the sent current in every period."
    if not figures.applied_as_sent(motion):
        summary = "In some periods the node did not apply the sent current, or its report was lost."
    if x is not None and x.quality.braked:
        summary += f" The node braked in {x.quality.braked} periods, because no command came in time."
    if x is not None and x.quality.command_delay:
        summary += f" Commands acted {x.quality.command_delay} samples late by the node's reports."
    marks = "The bars below the current mark periods in which the sent current differs from the requested one:"
    reasons = [f"{str(reason.name).lower()}: {words}" for reason, words in REASONS.items()]
    return [Text(summary), Text(marks), Items(reasons)]


def intervals(t: Timing) -> Table | None:
    """Intervals of the loop; None if no sample was answered."""
    if not len(t.response):
        return None
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    header = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Table("Times of the loop, by the stamps in the log", header, rows)


def _timing(t: Timing, table: Table) -> list[Block | None]:
    simulated = "The time is simulated: these are not the times of a computer or a bus."
    obeyed = "not reported" if t.not_obeyed is None else f"{t.not_obeyed} commands, by the node's reports"
    rows: list[tuple[str, Words]] = [
        ("periods missed", f"{t.missed}, no sample came"),
        ("unanswered", f"{t.unanswered} samples"),
        ("not obeyed", obeyed),
        ("least time to spare", seconds(float(t.slack.min()))),
    ]
    if t.clock is not None:
        slow = f"slow by {signed(1e6 * t.clock.drift)} ppm; arrivals scatter by {seconds(t.clock.jitter)}"
        rows.append(("node's clock", slow))
    return [Text(simulated, "care") if t.simulated else None, Facts(rows), table]


def _safety(motion: Motion) -> list[Block | None]:
    """Extremes, events of the safety chain, and the worst case of a loss of all commands."""
    log, cycles, limits = motion.run.log, motion.cycles, motion.bench.limits
    rows: list[tuple[str, Words]] = []
    if cycles is not None and (top := cycles.largest) is not None:
        for reason, where in cycles.reasons.items():
            count = f"{where.sum()} of {len(cycles.time)} periods, {REASONS[reason]}"
            rows.append((str(reason.name).lower(), count))
        angle = f"{plain(top.angle_min, 4)} to {plain(top.angle_max, 4)} rad"
        (low, high), speed = limits.angle, limits.velocity
        inside = low <= top.angle_min and top.angle_max <= high
        rows += [
            ("angle", [_inside(angle, inside), f", limits {plain(low)} and {plain(high)} rad"]),
            (
                "largest speed",
                [_inside(f"{plain(top.speed, 4)} rad/s", top.speed <= speed), f", limit {plain(speed)} rad/s"],
            ),
            ("largest current", f"{plain(top.current, 4)} A, limit {plain(limits.current)} A"),
        ]
    rows.append(("if all commands stopped at the worst moment", _impact(motion.bench)))
    if why := log.end.get("node_stop_reason"):
        rows.append(("the node's stop reason", why[:LONGEST]))
    events = _events(motion)
    more = len(log.events) - len(events.rows)
    return [
        Facts(rows),
        events if events.rows else Text("No event was recorded."),
        Text(f"{more} further events are in report.json.") if more else None,
    ]


def _impact(bench: Bench) -> Cell:
    """Effect of a loss of all commands, for any brake of the shield's set."""
    try:
        speed = end_stop_speed(bench)
    except BenchFileError as err:
        return Cell(f"unknown: {err}", "bad")
    how = "the node brakes" if bench.node.stop == "damped" else "the node switches the current off"
    if speed == 0.0:
        return Cell(f"{how}, and no brake of the set '{bench.shield.ranges}' reaches an end stop")
    return Cell(f"{how}, and a brake of the set may hit an end stop with {plain(speed, 3)} rad/s", "bad")


def _inside(text: str, inside: bool) -> str:
    return text if inside else Cell(f"{text}: BEYOND THE LIMIT", "bad")


def _events(motion: Motion) -> Table:
    events = motion.run.log.events
    active = [event.time_ns for event in events if event.code == "ACTIVE"]
    begin = min(active) if active else events[0].time_ns if events else 0
    rows = [
        [signed(1e-6 * (event.time_ns - begin), "+.3f"), event.code[:LONGEST], event.text[:LONGEST]]
        for event in events[:EVENTS]
    ]
    zero = "the start of the experiment" if active else "the first event"
    return Table(f"Events of the safety chain, since {zero}", ["time [ms]", "event", "what"], rows, words=(1, 2))


def _log(run: StudiedRun) -> Iterator[Block]:
    """The log's file, end, metadata and attachments."""
    log, x = run.log, run.experiment
    missing = [log.missing] if log.missing else []
    missing += [] if x is None else lacks(x)
    complete = Cell("complete: closed properly, every checksum right", "good")
    rows: list[tuple[str, Words]] = [
        ("file", Cell(str(log.path), "code")),
        ("completeness", complete if log.complete else Cell("NOT complete", "bad")),
        ("missing", "; ".join(missing) or "nothing"),
        ("exit reason", log.exit_reason),
    ]
    if detail := log.end.get("detail"):
        rows.append(("detail", detail[:LONGEST]))
    if x is not None:
        counts = f"{len(x.currents)} of {x.quality.planned} periods, {x.measured.sum()} samples received"
        rows.append(("experiment", counts))
    yield Facts(rows)
    for title, entries in log.metadata.items():
        if entries:
            yield Heading(title)
            yield Facts([(name, code(value)) for name, value in with_units(entries)])
    if log.attachments:
        yield Heading("attached files, SHA-256")
        yield Facts([(name, code(hashlib.sha256(data).hexdigest())) for name, data in log.attachments.items()])


def with_units(entries: Mapping[str, str]) -> list[tuple[str, str]]:
    """Metadata of a log; numbers with a unit to four digits, others may be serial numbers and stay."""
    found = []
    for name, text in entries.items():
        with suppress(ValueError):
            if unit := next((unit for end, unit in UNITS_OF_METADATA.items() if name.endswith(end)), ""):
                text = f"{plain(float(text), 4)} {unit}"
        found.append((name, text))
    return found


def _words(study: Study | None) -> list[Block | None]:
    effects: list[Block] = []
    if study is not None:
        effects.append(Heading("Effects of the score tests and of the uncertainty budget"))
        effects.append(Facts([*say.effects(study.estimate.bench.machine).items()]))
    return [Facts([*say.TERMS.items()]), *effects]


def _tested(report: Report) -> tuple[Facts, Table | None]:
    """Device, conditions, versions and hashes: those that all runs share, and a table of the others."""
    runs = report.study.runs
    columns = [_identity(run, report.bench) for run in runs]
    alike = {name: len({column[name] for column in columns}) == 1 for name in columns[0]}
    facts = [(name, columns[0][name]) for name, same in alike.items() if same]
    facts += [("evaluated by", report.made_by), ("report number", report.number)]
    shared = Facts([(name, code(value) if "SHA" in name else value) for name, value in facts])
    names = [name for name, same in alike.items() if not same]
    if not names:
        return shared, None
    cut = [SHORT_HASH if "SHA" in name else LONGEST for name in names]
    rows = [
        [run.name, *(column[name][:most] for name, most in zip(names, cut, strict=True))]
        for run, column in zip(runs, columns, strict=True)
    ]
    title = f"Of each SHA-256 the first {SHORT_HASH} digits; the evidence has all"
    return shared, Table(title, ["run", *names], rows, words=range(len(names) + 1))


def _identity(run: StudiedRun, its: Bench) -> dict[str, str]:
    """Device, conditions, versions and hashes of one run."""
    entries, limits, noise = run.log.run, its.limits, its.noise
    name, digest = entries.get("bench_name", ""), entries.get("bench_hash", "")[:SHORT_HASH]
    found = {
        "device serial": entries.get("device_serial") or "not recorded (emb-run --serial)",
        "operator": entries.get("operator") or "not recorded (emb-run --operator)",
        "recorded": run.log.began,
        "recorded by": entries.get("tool", ""),
        "bench": f"{name}, SHA-256 {digest}" if name and digest else name,
        "conditions": f"{plain(1e3 * its.timing.sample_time)} ms sample time; noise {plain(noise.angle)} rad, "
        f"{plain(noise.velocity)} rad/s; limits {plain(limits.angle[0])} to {plain(limits.angle[1])} rad, "
        f"{plain(limits.velocity)} rad/s, {plain(limits.current)} A",
        "policy SHA-256": entries.get("policy_sha256", ""),
        "log SHA-256": run.log.sha256,
    }
    if run.log.is_recording:
        del found["conditions"]
    if drive := run.log.metadata.get("emb.drive"):
        lacks = "; ".join(f"{name}: {lost}" for name, lost in run.log.drive_lacks.items())
        found["drive"] = f"{drive['name']}, SHA-256 of the mapping {drive['sha256'][:SHORT_HASH]}"
        found["it lacks"] = lacks or "none"
    return {key: value[:LONGEST] or "not recorded" for key, value in found.items()}


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _care(text: str) -> Text | None:
    return Text(f"{_capital(text)}.", "care") if text else None


# ---- the document ----


def report_document(report: Report) -> dict[str, Any]:
    """JSON document with the content of the page; numbers may be infinite."""
    study = report.study
    estimated = study.joint is not None
    studies = study.side_by_side or [study] * len(study.runs)
    found: dict[str, Any] = to_json(
        {
            "number": report.number,
            "simulated": any(run.log.simulated for run in study.reported),
            "made_by": report.made_by,
            "acceptance": None if report.acceptance is None else report.acceptance.document(),
            "model_fits": study.model_fits if estimated else None,
            "predicts": study.checks.predicts if estimated else None,
            "why_no_estimate": study.why_not,
            "left_out": [{"log": path, "why": why} for path, why in report.left_out],
            "estimate": study_document(study) if estimated else None,
            "compared": study.side_by_side[1].checks.drifts if study.side_by_side else None,
            "runs": [_run_document(run, one) for run, one in zip(study.runs, studies, strict=True)],
        }
    )
    return found


def _run_document(run: StudiedRun, study: Study) -> dict[str, Any]:
    found: dict[str, Any] = {
        "began": run.log.began,
        "simulated": bool(run.log.simulated),
        "why_not_estimated": run.why_not,
        "sha256": run.log.sha256,
        "info": None if run.log.is_recording else info_document(run.log),
        "timing": None if run.timing is None else timing.timing_numbers(run.timing),
    }
    x, alone = run.experiment, run.alone
    if x is not None:
        found["experiment"] = {
            "planned": x.quality.planned,
            "command_delay": x.quality.command_delay,
            "missing": lacks(x),
            "notes": assumed_currents(x),
            "periods": len(x.currents),
            "measured": x.measured.sum(),
            "braked_periods": x.quality.braked,
            "applied_current": x.currents,
            "angle": x.all_samples[:, 0],
            "velocity": x.all_samples[:, 1],
        }
    if alone is not None:
        found["alone"] = {"model_fits": alone.model_fits, "conclusions": alone.conclusions}
    if not run.why_not:
        residuals = study.residuals[study.logs.index(run.log)]
        found["residuals"] = {"angle": residuals[:, 0], "velocity": residuals[:, 1]}
    return found
