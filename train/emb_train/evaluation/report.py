"""An evaluation as tables for a person and as a document for programs, with the same numbers."""

from __future__ import annotations

import math
import textwrap
from typing import Any

from emb_bench.compare.report import WIDTH, Sheet
from emb_bench.compare.scores import Score
from emb_train.evaluation.evaluation import REFERENCE, Asked, Evaluation, OnPlant, Row, worst
from emb_train.evaluation.measure import Measure

HEADER = ("excitation", "measure", "against optimum", "actor ahead by", "left", "home", "end rad", "end rad/s")
UNIT = {"difference": "nat", "log-ratio": "nat", "ratio": ""}


def text(e: Evaluation) -> str:
    """For a person."""
    lines = textwrap.wrap(_scene(e.asked), WIDTH)
    for plant in e.plants:
        lines += ["", *_sheet(e, plant).text()[:-1], *_remarks(e, plant)]
    return "\n".join(lines)


def document(e: Evaluation) -> dict[str, Any]:
    """For programs; what is not there is null."""
    a = e.asked
    return {
        "actors": list(e.subjects),
        "measure": a.measure.name,
        "measure_is": a.measure.label,
        "unit": UNIT[a.measure.against],
        "parameters": list(a.parameters),
        "ranges": a.ranges,
        "shield": a.shield or None,
        "draws": a.draws,
        "ruler_draws": a.ruler_draws,
        "seed": a.seed,
        "agree": e.agree if any(p.apart for p in e.plants) else None,
        "brakes": [d.brake._asdict() for d in e.draws],
        "plants": {p.plant: _on_plant(e, p) for p in e.plants},
    }


def _scene(a: Asked) -> str:
    shield = f"shield, which covers '{a.shield}'" if a.shield else "shield"
    return (
        f"{a.measure.label} of {', '.join(a.parameters)}, relative to the true values; {a.draws} brakes drawn from the "
        f"ranges '{a.ranges}' for evaluation alone, seed {a.seed}; the same brakes and noise for all, all behind the "
        f"same {shield}. Brackets are 95 % intervals over the draws. 'left': experiments that left the limits and were "
        "stopped there; 'home': share that ended at the origin; 'end': the worst angle and speed at the end. 'ahead': "
        "the first actor's measure less that of the line, paired by draw."
    )


def _sheet(e: Evaluation, plant: OnPlant) -> Sheet:
    count, where = len(plant.optima), plant.ruler_plant
    ruler = f"optimum if the brake were known: on {where}, {count} draws" if count else "no optimum was looked for"
    title = f"plant {plant.plant}; {ruler}"
    return Sheet(title, HEADER, tuple(_cells(e.asked.measure, plant, row) for row in plant.rows))


def _cells(measure: Measure, plant: OnPlant, row: Row) -> tuple[str, ...]:
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


def _remarks(e: Evaluation, plant: OnPlant) -> list[str]:
    lines = []
    if plant.apart:
        said = "agree" if e.agree else "DO NOT AGREE: export it again"
        lines.append(f"network and file differ by {worst(plant.apart):.2g} of the current limit at most: they {said}")
    seeds = e.over_seeds(plant)
    if seeds is not None:
        lines.append(f"mean of the {len(e.subjects)} actors, interval over actors: {_interval(seeds, e.asked.measure)}")
    return lines


def _on_plant(e: Evaluation, plant: OnPlant) -> dict[str, Any]:
    seeds = e.over_seeds(plant)
    return {
        "ruler_plant": plant.ruler_plant,
        "optima": plant.optima.tolist(),
        "largest_difference": worst(plant.apart),
        "over_actors": None if seeds is None else seeds._asdict(),
        "rows": [_row(e.asked.measure, plant, row) for row in plant.rows],
    }


def _row(measure: Measure, plant: OnPlant, row: Row) -> dict[str, Any]:
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
