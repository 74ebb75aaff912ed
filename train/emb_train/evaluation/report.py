"""Text and JSON of an evaluation."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict
from typing import Any

from emb_bench.numbers import Score
from emb_bench.report.text import WIDTH, Table
from emb_train.envs.measure import Measure
from emb_train.evaluation.evaluation import REFERENCE, Evaluation, PlantResult, Row, Settings, worst

HEADER = ("excitation", "measure", "against optimum", "actor ahead by", "left", "home", "end rad", "end rad/s")
AGAINST = HEADER.index("against optimum")
UNIT = {"difference": "nat", "log-ratio": "nat", "ratio": ""}


def text(e: Evaluation) -> str:
    """Returns the tables."""
    lines = textwrap.wrap(_scene(e.settings), WIDTH)
    lines += [f"of {s.name} is played: {s.origin}" for s in e.subjects if s.origin]
    for plant in e.plants:
        lines += ["", *_sheet(e, plant).text()[:-1], *_remarks(e, plant), *textwrap.wrap(_verdict(e, plant), WIDTH)]
    return "\n".join(lines)


def document(e: Evaluation) -> dict[str, Any]:
    """Returns the JSON document; what is not there is null."""
    a = e.settings
    return {
        "actors": [s.name for s in e.subjects],
        "origins": [s.origin or None for s in e.subjects],
        "measure": a.measure.name,
        "measure_is": a.measure.label,
        "unit": UNIT[a.measure.against],
        "parameters": list(a.parameters),
        "ranges": a.ranges,
        "shield": a.shield or None,
        "randomised": _own(a),
        "draws": a.draws,
        "optimum_draws": a.optimum_draws,
        "seed": a.seed,
        "agree": e.agree if any(p.apart for p in e.plants) else None,
        "brakes": [d.brake._asdict() for d in e.draws],
        "plants": {p.plant: _on_plant(e, p) for p in e.plants},
    }


def _own(a: Settings) -> dict[str, list[float]]:
    """Least and most of each property that is drawn for each experiment, by name."""
    return {name: list(pair) for name, pair in asdict(a.randomised).items() if any(pair)}


def _scene(a: Settings) -> str:
    shield = f"shield, which covers '{a.shield}' instead of what the bench names" if a.shield else "shield"
    own = ", ".join(f"{name} from {least:g} to {most:g}" for name, (least, most) in _own(a).items())
    own = f" Each experiment has its own {own}; the shield is widened to cover delay and lag." if own else ""
    return (
        f"{a.measure.label} of {', '.join(a.parameters)}, relative to the true values; {a.draws} brakes drawn from the "
        f"ranges '{a.ranges}' for evaluation alone, seed {a.seed}; the same brakes and noise for all, all behind the "
        f"same {shield}. Brackets are 95 % intervals over the draws. 'left': experiments that left the limits and were "
        "stopped there; 'home': share that ended at the origin; 'end': the worst angle and speed at the end. 'ahead': "
        f"the first actor's measure less that of the line, paired by draw.{own}"
    )


def _sheet(e: Evaluation, plant: PlantResult) -> Table:
    count, where = len(plant.optima), plant.optimum_plant
    optimum = f"optimum if the brake were known: on {where}, {count} draws" if count else "no optimum was searched for"
    title = f"plant {plant.plant}; {optimum}"
    shown = [column for column in range(len(HEADER)) if count or column != AGAINST]
    rows = [HEADER, *(_cells(e.settings.measure, plant, row) for row in plant.rows)]
    header, *cells = (tuple(row[column] for column in shown) for row in rows)
    return Table(title, header, tuple(cells))


def _cells(measure: Measure, plant: PlantResult, row: Row) -> tuple[str, ...]:
    count = len(row.values)
    home = f"{100.0 * row.outcome.home.sum() / count:.4g} %"
    first = row is plant.rows[0]
    ahead = "" if first else _interval(plant.ahead(row), measure)
    ends = (f"{row.worst_angle:.3f}", f"{row.worst_speed:.2f}")
    return (
        row.name,
        _interval(row.score, measure),
        _share(plant.share(row, measure), measure),
        ahead,
        f"{row.outcome.left.sum()}/{count}",
        home,
        *ends,
    )


def _interval(score: Score, measure: Measure) -> str:
    return _between(score, ".3e" if measure.against == "ratio" else ".3f")


def _share(score: Score | None, measure: Measure) -> str:
    if score is None:
        return "-"
    if measure.against == "difference":
        return f"{_between(score, '+.3f')} nat"
    return f"{_between(Score(*(100.0 * value for value in score)), '.2f')} %"


def _between(score: Score, form: str) -> str:
    """A mean and its interval; one value has none."""
    interval = "" if math.isnan(score.low) else f" [{score.low:{form}}, {score.high:{form}}]"
    return f"{score.value:{form}}{interval}"


def _remarks(e: Evaluation, plant: PlantResult) -> list[str]:
    lines = []
    if plant.apart:
        said = "agree" if e.agree else "DO NOT AGREE: export it again"
        lines.append(f"network and file differ by {worst(plant.apart):.2g} of the current limit at most: they {said}")
    seeds = e.over_seeds(plant)
    if seeds is not None:
        lines.append(
            f"mean of the {len(e.subjects)} actors, interval over actors: {_interval(seeds, e.settings.measure)}"
        )
    return lines


def best_reference(plant: PlantResult) -> Row:
    """That with the largest mean on the draws of this evaluation, which favours it and not the actor."""
    return max((row for row in plant.rows if row.form == REFERENCE), key=lambda row: row.score.value)


def _verdict(e: Evaluation, plant: PlantResult) -> str:
    """The first actor in a sentence."""
    actor, best = plant.rows[0], best_reference(plant)
    ahead, count = plant.ahead(best), len(actor.values)
    how = "ahead of" if ahead.low > 0.0 else "behind" if ahead.high < 0.0 else "not significantly different from"
    left, away = int(actor.outcome.left.sum()), int((~actor.outcome.home).sum())
    kept = f"{left} of {count} runs left the limits" if left else "every run kept the limits"
    home = f"{away} did not end at the origin" if away else "ended at the origin"
    return (
        f"{actor.name} is {how} the best reference on these draws, {best.name}, by "
        f"{_interval(ahead, e.settings.measure)}; {kept} and {home}"
    )


def _on_plant(e: Evaluation, plant: PlantResult) -> dict[str, Any]:
    seeds = e.over_seeds(plant)
    return {
        "optimum_plant": plant.optimum_plant,
        "optima": plant.optima.tolist(),
        "largest_difference": worst(plant.apart),
        "best_reference": best_reference(plant).name,
        "over_actors": None if seeds is None else seeds._asdict(),
        "rows": [_row(e.settings.measure, plant, row) for row in plant.rows],
    }


def _row(measure: Measure, plant: PlantResult, row: Row) -> dict[str, Any]:
    share, outcome = plant.share(row, measure), row.outcome
    return {
        "name": row.name,
        "form": row.form,
        "learned": row.form != REFERENCE,
        "measure": row.score._asdict(),
        "against_optimum": None if share is None else share._asdict(),
        "first_ahead_by": plant.ahead(row)._asdict(),
        "left": int(outcome.left.sum()),
        "home": int(outcome.home.sum()),
        "runs": len(row.values),
        "worst_end_angle": row.worst_angle,
        "worst_end_speed": row.worst_speed,
        "values": row.values.tolist(),
        "end_angle": outcome.angle.tolist(),
        "end_velocity": outcome.velocity.tolist(),
    }
