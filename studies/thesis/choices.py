"""Comparison of the values that the thesis does not print: how many statements agree in trainings with each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from emb_bench.config.bench import Bench
from emb_runtime.errors import UsageError, near
from studies.thesis.agents import FIGURES, agent_facts
from studies.thesis.trainings import Choice, SpentError, Trainings

GRID = tuple(Choice(deviation=a, tracking=w) for a in (1.0, 6.0) for w in (1.0, 0.1))
"""First standard deviations [A] and factors of the tracking weights that are compared."""


@dataclass(frozen=True)
class Count:
    """Statements of one figure that agree in the trainings of one seed with one choice."""

    deviation: float  # [A]
    tracking: float
    figure: str
    seed: int
    agree: int
    statements: int


def compared(
    folder: Path,
    bench: Bench,
    figures: Sequence[str],
    seeds: Sequence[int],
    steps: int | None,
    tell: Callable[[str], object],
    until: float,
) -> list[Count]:
    """Counts of all figures, seed by seed; those that are done by :func:`time.monotonic` ``until``.

    A later call goes on with the rest.
    """
    counts, beside = [], [(choice, seed) for choice in GRID for seed in seeds]
    for seed in seeds:
        for figure in figures:
            for choice in GRID:
                trainings = Trainings(folder, bench, (seed,), steps, tell, choice, until, beside)
                try:
                    facts = agent_facts(figure, trainings)
                except SpentError:
                    continue
                agree = sum(fact.agrees is True for fact in facts)
                counts.append(Count(choice.deviation, choice.tracking, figure, seed, agree, len(facts)))
    return counts


def document(counts: Sequence[Count]) -> list[dict[str, Any]]:
    """The counts for JSON."""
    return [asdict(count) for count in counts]


def text(counts: Sequence[Count]) -> str:
    """A table: for each figure and choice the statements that agree, seed by seed; then their share in all."""
    if not counts:
        return "no figure has all its trainings yet: more --minutes"
    heads = [f"{choice.deviation:g} A, weights x {choice.tracking:g}" for choice in GRID]
    lines = [f"{'':11}{'seeds':7}" + "".join(f"{head:>22}" for head in heads)]
    for figure in (name for name in FIGURES if any(count.figure == name for count in counts)):
        own = [count for count in counts if count.figure == figure]
        cells = []
        for choice in GRID:
            found = [c for c in own if (c.deviation, c.tracking) == (choice.deviation, choice.tracking)]
            cells.append(", ".join(str(c.agree) for c in found) + (f" of {found[0].statements}" if found else "-"))
        seeds = sorted({count.seed for count in own})
        lines.append(f"{figure:11}{','.join(map(str, seeds)):7}" + "".join(f"{cell:>22}" for cell in cells))
    shares, totals = [], []
    for choice in GRID:
        own = [c for c in counts if (c.deviation, c.tracking) == (choice.deviation, choice.tracking)]
        totals.append(total := sum(c.statements for c in own))
        shares.append(f"{100.0 * sum(c.agree for c in own) / total:.0f} %" if total else "-")
    lines.append(f"{'agree':18}" + "".join(f"{share:>22}" for share in shares))
    if len(set(totals)) > 1:
        lines.append("not every choice has the same trainings yet: the shares cannot be compared")
    return "\n".join(lines)


def set_choice(changes: Sequence[str]) -> Choice:
    """A choice from texts such as ``deviation=6``.

    Raises:
        UsageError: there is no such value, or it is none.
    """
    values: dict[str, str] = {}
    for change in changes:
        name, mark, value = change.partition("=")
        if not mark or name not in Choice.__struct_fields__ or name in values:
            names = ", ".join(Choice.__struct_fields__)
            raise UsageError(
                f"--set {change}: expected one of {names}, each once, as in deviation=6{near(name, names.split(', '))}"
            )
        values[name] = value
    try:
        return msgspec.convert(values, Choice, strict=False)
    except msgspec.ValidationError as err:
        raise UsageError(f"--set: {err}") from err
