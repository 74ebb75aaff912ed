"""Evaluation: policies and reference excitations on the same new brakes with the same noise, paired by brake."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from emb_bench.config.bench import Bench, load_bench
from emb_bench.documents import to_json
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.excitation import ACTOR, COMPARED, parse_excitation
from emb_bench.information.symmetric import Floats
from emb_bench.numbers import Score
from emb_bench.parallel import processes
from emb_bench.report.text import WIDTH, Table
from emb_runtime.errors import PolicyRefusedError, UsageError, near
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.policy.trial import admit_policy
from emb_runtime.system.input_file import near_file
from emb_train.closed_loop import Conditions
from emb_train.optimum import optima, searchable
from emb_train.play import (
    Excitation,
    Measure,
    Outcome,
    Planned,
    bounds,
    fresh_draws,
    mean_score,
    middle_of,
    of_actor,
    of_law,
    play,
)
from emb_train.training import BENCH, ONNX, PLAN, load_plan

Tell = Callable[[str], object]


@dataclass(frozen=True, eq=False)
class Subject:
    """A policy, with its bench and ranges."""

    name: str  # As it was given
    bench: Bench
    excitation: Excitation
    ranges: str = ""  # Set of the bench that it was made for; empty if none of the bench's sets is that


def open_subject(given: str, bench_file: Path | None) -> Subject:
    """Opens a policy.

    Args:
        given: folder of a training, its plan, an ONNX file, or ``actor`` for the shipped one.
        bench_file: bench of a policy without one, as of a plan outside such a folder; the shipped one without.

    Raises:
        UsageError: there is nothing of that kind, or it sees what no bench measures, or is damaged.
        PolicyRefusedError: the file is damaged or does not fit the bench.
        BenchFileError: the bench file is not valid.
    """
    path = Path(given)
    torch.set_num_threads(1)  # more would get into each other's way at this size, and change the last digits
    if given == ACTOR or path.suffix == ".onnx":
        return _file(given, shipped_actor_path() if given == ACTOR else path, load_bench(bench_file))
    bench_beside = (path if path.is_dir() else path.parent) / BENCH
    if bench_beside.exists() and bench_file is not None:
        raise UsageError(f"--bench: {given} is evaluated on the bench that it was trained on; leave it out")
    if path.suffix == ".json":
        plan, bench = load_plan(path), load_bench(bench_beside if bench_beside.exists() else bench_file)
        return Subject(given, bench, of_actor(Planned(plan.speeds, bench, plan.gain), bench), plan.ranges)
    if not path.is_dir():
        hint = near(given, [ACTOR]) or near_file(path)
        raise UsageError(f"{given}: expected '{ACTOR}', an .onnx file, the folder of a training or its {PLAN}{hint}")
    if not bench_beside.exists() or not (path / ONNX).exists():
        raise UsageError(f"{given}: expected the folder of emb-train ppo, with {ONNX} and {BENCH}")
    return _file(given, path / ONNX, load_bench(bench_beside), trained_on=bench_beside)


def _file(name: str, path: Path, bench: Bench, trained_on: Path | None = None) -> Subject:
    try:
        policy = load_policy(path, bench) if path == shipped_actor_path() else admit_policy(path, bench)
    except PolicyRefusedError as err:
        raise PolicyRefusedError(f"{path}: {err}") from err
    if trained_on is not None and policy.contract.provenance.get("bench") != bench.identity_hash:
        raise UsageError(
            f"{trained_on}: not the bench that {path} was trained on; to evaluate it on this one, give "
            f"{path} --bench {trained_on}"
        )
    made_for = {str(name): pair for name, pair in policy.contract.ranges.items()}
    sets = [ranges.name for ranges in bench.ranges.values() if made_for == bounds(ranges)]
    return Subject(name, bench, of_actor(policy, bench), sets[0] if sets else "")


def references(bench: Bench) -> dict[str, Excitation]:
    """Every reference excitation by name, constant current of either sign among them."""
    limit = bench.limits.current
    names = [*COMPARED, *(f"step:amplitude={u:g}" for u in (limit, -limit))]
    return {name: of_law(parse_excitation(name, bench).law) for name in names}


@dataclass(frozen=True)
class Settings:
    """Measure, brakes and conditions of an evaluation."""

    measure: Measure
    parameters: tuple[str, ...]  # Those that vary in the ranges
    ranges: str  # Set of the bench that brakes are drawn from
    plants: tuple[str, ...]  # Plants: mechanics and instruments
    draws: int
    seed: int  # Seed of brakes and noise
    optimum: int  # Number of brakes, the first ones, whose optimum is searched for
    conditions: Conditions  # With the measure's kind of information


@dataclass(frozen=True, eq=False)
class Row:
    """One excitation on one plant."""

    name: str
    learned: bool  # False for a reference excitation
    measure: Score  # Mean over the draws
    against_optimum: Score | None
    """Mean share of the optimum over the draws that have one, see :meth:`emb_train.play.Measure.shares`."""
    first_ahead_by: Score  # Mean lead of the first policy, paired by draw
    violated: int  # Experiments that violated the limits, and were stopped there
    home: int  # Experiments that ended at home
    values: Floats  # The measure of each draw, shape [draws]


@dataclass(frozen=True, eq=False)
class PlantResult:
    """All rows on one plant."""

    optima: Floats  # The measure of the optimum for the first draws, shape [optimum draws], or [0]
    best_reference: str
    """The row with the largest mean on the draws of this evaluation, which favours it and not the policy."""
    over_policies: Score | None  # Mean of the policies' scores with its interval over them; None unless several
    rows: tuple[Row, ...]  # Policies first


def evaluate(bench: Bench, settings: Settings, subjects: Sequence[Subject], tell: Tell) -> dict[str, PlantResult]:
    """Play all on all plants; after a Ctrl-C, the plants that are done.

    Args:
        bench: of all subjects.
        settings: measure, brakes and conditions.
        subjects: the policies.
        tell: called with a line on the progress.

    Raises:
        EmbError: see :func:`emb_train.play.play` and :func:`emb_train.optimum.optima`.
    """
    ranges, measure, names = bench.range_set(settings.ranges), settings.measure, settings.parameters
    draws = fresh_draws(ranges, settings.seed, settings.draws)
    brakes = [middle_of(ranges), *(draw.brake for draw in draws[: settings.optimum])]
    excitations = {**{s.name: s.excitation for s in subjects}, **references(bench)}
    found: dict[str, PlantResult] = {}
    optima_of = {"": np.empty(0)}
    try:
        for plant in settings.plants:
            outcomes = {}
            for name, excitation in excitations.items():
                tell(f"plant {plant}: {name}")
                outcomes[name] = play(bench, ranges, names, excitation, draws, plant, settings.conditions)
            model = searchable(bench.plant(plant)) if settings.optimum else ""
            if model not in optima_of:
                optima_of[model] = optima(bench, measure, names, model, brakes, tell)[1:]
            drawn = [draw.brake for draw in draws]
            with processes() if isinstance(measure.goal, IntervalCriterion) else nullcontext() as pool:
                values = measure.of_outcomes(bench, plant, names, drawn, list(outcomes.values()), pool)
            found[plant] = result(measure, outcomes, values, len(subjects), optima_of[model])
    except KeyboardInterrupt:
        if not found:
            raise
    return found


def result(
    measure: Measure, outcomes: Mapping[str, Outcome], of_all: Sequence[Floats], policies: int, best: Floats
) -> PlantResult:
    """The rows of outcomes on one plant with their values, the first those of policies; ``best`` are the optima."""
    rows: list[Row] = []
    for (name, o), values in zip(outcomes.items(), of_all, strict=True):
        share = mean_score(measure.shares(values[: len(best)], best)) if len(best) else None
        ahead = mean_score((rows[0].values if rows else values) - values)
        learned, violations, home = len(rows) < policies, int(o.violated.sum()), int(o.home.sum())
        rows.append(Row(name, learned, mean_score(values), share, ahead, violations, home, values))
    means = np.array([row.measure.value for row in rows])
    over = mean_score(means[:policies]) if policies > 1 else None
    return PlantResult(best, rows[policies + int(np.argmax(means[policies:]))].name, over, tuple(rows))


HEADER = ("excitation", "measure", "against optimum", "first ahead by", "violated", "home")
UNIT: Mapping[str, str] = {"difference": "nat", "log-ratio": "nat", "ratio": ""}


def evaluation_text(settings: Settings, results: Mapping[str, PlantResult]) -> str:
    """The tables."""
    lines = textwrap.wrap(_scene(settings), WIDTH)
    for name, plant in results.items():
        found = f"the optimum if the brake were known: of the first {len(plant.optima)} draws"
        title = f"plant {name}; {found if len(plant.optima) else 'no optimum was searched for'}"
        rows = [_cells(settings.measure, row, row is plant.rows[0]) for row in plant.rows]
        lines += ["", *Table(title, HEADER, rows).text()[:-1]]
        if plant.over_policies is not None:
            lines.append(
                f"mean of the policies, interval over them: {_interval(plant.over_policies, settings.measure)}"
            )
        lines += textwrap.wrap(_verdict(settings.measure, plant), WIDTH)
    return "\n".join(lines)


def _scene(a: Settings) -> str:
    c = a.conditions
    delays = (
        f" Each experiment draws a delay of commands, {c.command_delay[0]} to {c.command_delay[1]} samples, which "
        "the shield covers."
    )
    return (
        f"{a.measure.label} of {', '.join(a.parameters)}, relative to the true values; {a.draws} brakes drawn from the "
        f"ranges '{a.ranges}' for evaluation alone, seed {a.seed}; the same brakes and noise for all, all behind the "
        "same shield. Brackets are 95 % intervals over the draws. 'violated': experiments that left the limits and "
        "were stopped there; 'home': share that ended at the origin; 'ahead': the first policy's measure minus that of "
        f"the line, paired by draw.{delays if c.varies else ''}"
    )


def _cells(measure: Measure, row: Row, first: bool) -> tuple[str, ...]:
    share, against = row.against_optimum, "-"
    if share is not None and measure.against == "difference":
        against = f"{_between(share, '+.3f')} nat"
    elif share is not None:
        against = f"{_between(Score(*(100.0 * value for value in share)), '.2f')} %"
    return (
        row.name,
        _interval(row.measure, measure),
        against,
        "" if first else _interval(row.first_ahead_by, measure),
        f"{row.violated}/{len(row.values)}",
        f"{100.0 * row.home / len(row.values):.4g} %",
    )


def _interval(score: Score, measure: Measure) -> str:
    return _between(score, ".3e" if measure.against == "ratio" else ".3f")


def _between(score: Score, form: str) -> str:
    """A mean and its interval; one value has none."""
    interval = "" if math.isnan(score.low) else f" [{score.low:{form}}, {score.high:{form}}]"
    return f"{score.value:{form}}{interval}"


def _verdict(measure: Measure, plant: PlantResult) -> str:
    """The first policy in a sentence."""
    first, best = plant.rows[0], next(row for row in plant.rows if row.name == plant.best_reference)
    ahead, count = best.first_ahead_by, len(first.values)
    how = "ahead of" if ahead.low > 0.0 else "behind" if ahead.high < 0.0 else "not significantly different from"
    return (
        f"{first.name} is {how} the best reference on these draws, {best.name}, by {_interval(ahead, measure)}; "
        f"{first.violated} of {count} runs left the limits, and {count - first.home} did not end at the origin"
    )


def evaluation_document(settings: Settings, results: Mapping[str, PlantResult]) -> dict[str, Any]:
    """The JSON document; a missing value is null."""
    measure = settings.measure
    of_settings = {name: getattr(settings, name) for name in ("parameters", "ranges", "draws", "seed")}
    of_measure = {"measure": measure.name, "measure_is": measure.label, "unit": UNIT[measure.against]}
    conditions = msgspec.structs.asdict(settings.conditions)
    return {**of_measure, **to_json({**of_settings, "conditions": conditions, "plants": results})}
