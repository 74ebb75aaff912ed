"""A comparison as tables for a person, as Markdown, and as a document for programs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

from emb_bench.numbers import Score
from emb_bench.report.text import WIDTH, Table
from studies.comparison.comparison import Comparison, Standing
from studies.comparison.conclusion import against, conclude, interval, number

NAME_WIDTH = 26
AGAINST = (
    "The first one against each other one; in brackets, its median |error| over the other's, and the 95 % interval."
)


def sheets(c: Comparison) -> list[Table]:
    """All tables: those of the plant that is the model first."""
    found = []
    if c.matched is not None:
        standings = c.standings[c.asked.model]
        found += [_information(standings), _motion(standings, c.asked.model)]
        found += [_parameter(standings, j, name) for j, name in enumerate(c.asked.params)]
    for plant, standings in c.standings.items():
        if plant != c.asked.model:
            found.append(_mismatched(standings, plant, c.asked.params, c.asked.model))
    return found


def _name(standing: Standing) -> str:
    name = standing.candidate.name
    return name if len(name) <= NAME_WIDTH else name[: NAME_WIDTH - 3] + "..."


def _rate(score: Score) -> str:
    text = interval(score, 100.0)
    return text if text == "-" else text.replace(" [", " % [")


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{100.0 * value:.3g} %"


def _information(standings: Sequence[Standing]) -> Table:
    title = (
        "physical information of the runs under the shield, medians; D-efficiency against the best of these in each "
        "run and against the best design if the brake were known; how often a model that fits is called wrong, and how "
        "often the lowest minimum was missed"
    )
    rows = [
        (
            _name(s),
            "-" if math.isnan(s.log_det) else f"{s.log_det:.2f}",
            number(s.lambda_min),
            _rate(s.of_best),
            _rate(s.of_known),
            _rate(s.alarms),
            _share(s.missed),
        )
        for s in standings
    ]
    header = ("excitation", "log det", "lambda_min", "of the best", "of the known", "false alarms", "missed")
    return Table(title, header, tuple(rows))


def _motion(standings: Sequence[Standing], plant: str) -> Table:
    title = (
        f"plant {plant}: brakes on which a run leaves the limits and the bench stops it, with the shield and without; "
        "runs that came to their end at home; time on the bench"
    )
    rows = [
        (
            _name(s),
            _rate(s.stopped),
            _rate(s.stopped_free),
            _share(s.home),
            f"{s.top_speed:.1f} rad/s",
            f"{s.angles[0]:.1f} .. {s.angles[1]:.1f} rad",
            f"{s.seconds:.3g} s",
        )
        for s in standings
    ]
    header = ("excitation", "stopped", "without shield", "home", "top speed", "angles", "until at rest")
    return Table(title, header, tuple(rows))


def _parameter(standings: Sequence[Standing], j: int, name: str) -> Table:
    title = f"{name}: relative error of the estimate in millionths (ppm), and whether its 95 % interval held the truth"
    rows = []
    for s in standings:
        e = s.parameters[j]
        rows.append(
            (
                _name(s),
                number(1e6 * e.bound),
                interval(e.median, 1e6),
                number(1e6 * e.upper.value),
                interval(e.efficiency),
                _rate(e.covered),
                _share(e.told),
            )
        )
    header = ("excitation", "bound", "median |error|", "95 % below", "rms/bound", "covered", "told")
    return Table(title, header, tuple(rows))


def _mismatched(standings: Sequence[Standing], plant: str, params: Sequence[str], model: str) -> Table:
    title = (
        f"plant {plant}, estimated as {model}: brakes on which a run leaves the limits and the bench stops it; on the "
        "others, how often the wrong model is noticed, and the median |error| that comes with it"
    )
    rows = [
        (
            _name(s),
            _rate(s.stopped),
            _share(s.home),
            _rate(s.alarms),
            *("-" if math.isnan(e.median.value) else f"{number(100.0 * e.median.value, 2)} %" for e in s.parameters),
        )
        for s in standings
    ]
    return Table(title, ("excitation", "stopped", "home", "alarms", *params), tuple(rows))


def _scene(c: Comparison) -> list[str]:
    a, shielded = c.asked, c.bench.range_set(c.bench.shield.ranges)
    drawn = c.bench.range_set(a.ranges)
    lines = [
        f"{a.brakes} brakes drawn from the ranges '{a.ranges}', {a.draws} draws of the noise on each, seed {a.seed}; "
        "the same brakes and the same noise for all, so that differences are paired. Brackets are 95 % intervals over "
        f"brakes. Estimated by output error with the model '{a.model}', from nominal values: {', '.join(a.params)}.",
        "A run that leaves the limits is stopped there, as on the bench, and not estimated: information and errors are "
        "of the brakes on which an excitation was never stopped.",
    ]
    if beyond := shielded.uncovered(drawn.low, drawn.high):
        lines.append(
            f"WARNING: {', '.join(beyond)} reaches beyond the ranges '{shielded.name}': the shield holds for those."
        )
    return lines


def text(c: Comparison) -> str:
    """Returns the tables for a terminal, at most ``WIDTH`` columns wide."""
    lines = [line for paragraph in _scene(c) for line in textwrap.wrap(paragraph, WIDTH)]
    lines += ["", *(f"{one.name:{NAME_WIDTH}}{one.origin}"[:WIDTH] for one in c.candidates), ""]
    for sheet in sheets(c):
        lines += sheet.text()
    for paragraph in (*([AGAINST, *against(c), ""] if c.pairs else []), *conclude(c)):
        lines += textwrap.wrap(paragraph, WIDTH, subsequent_indent="  ") or [""]
    return "\n".join(lines).rstrip()


def markdown(c: Comparison, command: str, seconds: float, jobs: int) -> str:
    """Returns the comparison in Markdown, with the verdict first."""
    lines = ["# Which excitation is worth its half second", ""]
    lines += [f"`{command}`, {seconds:.0f} s with {jobs} processes.", "", *_scene(c), ""]
    if verdict := conclude(c):
        lines += ["## Verdict", "", *(f"- {line}" for line in verdict), ""]
    lines += ["![errors and information](comparison.png)", "", "## Who takes part", ""]
    lines += [*(f"- `{one.name}`: {one.origin}" for one in c.candidates), "", "## Tables", ""]
    for sheet in sheets(c):
        lines += sheet.markdown()
    if sentences := against(c):
        lines += [
            f"## {c.candidates[0].name} against each other one",
            "",
            AGAINST,
            "",
            *(f"- {line}" for line in sentences),
            "",
        ]
    return "\n".join(lines)


def document(c: Comparison) -> dict[str, Any]:
    """Everything for programs; numbers may be infinite or NaN."""
    a = c.asked
    return {
        "bench": c.bench.name,
        "contract_hash": c.bench.contract_hash,
        "ranges": a.ranges,
        "params": list(a.params),
        "model": a.model,
        "brakes": a.brakes,
        "draws": a.draws,
        "known": a.known,
        "seed": a.seed,
        "contestants": [{"name": o.name, "origin": o.origin, "learned": o.learned} for o in c.candidates],
        "plants": {
            plant: {s.candidate.name: _standing(s, a.params) for s in standings}
            for plant, standings in c.standings.items()
        },
        "pairs": [
            {
                "first": c.candidates[0].name,
                "other": pair.other,
                "parameter": pair.parameter,
                "ratio_of_median_errors": _score(pair.ratio),
                "verdict": {-1: "better", 0: "not told apart", 1: "worse"}[pair.sign],
            }
            for pair in c.pairs
        ],
        "conclusion": conclude(c),
    }


def _standing(s: Standing, params: Sequence[str]) -> dict[str, Any]:
    return {
        "log_det": s.log_det,
        "lambda_min": s.lambda_min,
        "d_efficiency_of_best": _score(s.of_best),
        "d_efficiency_of_known": _score(s.of_known),
        "stopped": _score(s.stopped),
        "stopped_without_shield": _score(s.stopped_free),
        "home": s.home,
        "top_speed": s.top_speed,
        "angles": list(s.angles),
        "seconds": s.seconds,
        "alarms": _score(s.alarms),
        "missed_minima": s.missed,
        "parameters": {
            name: {
                "bound": e.bound,
                "median_error": _score(e.median),
                "upper_error": _score(e.upper),
                "rms_over_bound": _score(e.efficiency),
                "covered": _score(e.covered),
                "told": e.told,
            }
            for name, e in zip(params, s.parameters, strict=True)
        },
    }


def _score(score: Score) -> dict[str, float]:
    return score._asdict()
