"""The results as files: ``reproduction.md``, ``reproduction.json``, and a PNG for each table and figure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emb_train.training.checkpoint import write_text
from studies.thesis.training.result import CLOSE, Result

MARKDOWN, DOCUMENT = "reproduction.md", "reproduction.json"


@dataclass(frozen=True)
class Made:
    """Origin of the results."""

    command: str  # The command line
    seeds: tuple[int, ...]  # Seeds of trainings that are repeated
    trainings: Sequence[tuple[str, int, int, float]]
    """All of them: preset, seed, environment steps, and how long it took [s]."""

    @property
    def steps(self) -> int:
        """Environment steps of all trainings."""
        return sum(steps for _, _, steps, _ in self.trainings)

    @property
    def seconds(self) -> float:
        """Duration of all trainings, one after the other [s]."""
        return sum(seconds for *_, seconds in self.trainings)


def write_report(folder: Path, made: Made, results: Sequence[Result]) -> None:
    """Write both files beside the pictures.

    Raises:
        UsageError: they cannot be written.
    """
    write_text(folder / MARKDOWN, markdown(made, results))
    write_text(folder / DOCUMENT, json.dumps(document(made, results), indent=1, allow_nan=False) + "\n")


def summary(results: Sequence[Result]) -> str:
    """Returns how many statements agree, of those that count."""
    statements = [s for r in results if not r.note for s in r.statements]
    agree = f"{sum(s.agrees for s in statements)} of {len(statements)} statements agree"
    rehearsed = sum(bool(r.note) for r in results)
    if rehearsed == 0:
        return agree
    return "a rehearsal, no verdict counts" if not statements else f"{agree}, {rehearsed} results are a rehearsal"


def markdown(made: Made, results: Sequence[Result]) -> str:
    """Returns the results in Markdown."""
    lines = [
        "# The thesis's trainings, made again",
        "",
        f"    {made.command}",
        "",
        f"Seed{'s' if len(made.seeds) > 1 else ''} {', '.join(map(str, made.seeds))}; {made.steps:,} environment "
        f"steps in {made.seconds:,.0f} s of training.",
        "",
        f"{_capital(summary(results))}. A number agrees if the mean of our seeds is within {100 * CLOSE:.0f} % of the "
        "printed one.",
    ]
    for result in results:
        lines += ["", f"## {result.title}", "", f"![{result.title}]({result.target}.png)", ""]
        lines += [f"{_capital(result.note)}.", ""] if result.note else []
        lines += [*_table(result.columns, result.rows), ""] if result.rows else []
        lines += [f"- {statement.sentence(not result.note)}" for statement in result.statements]
    rows = [(preset, str(seed), f"{steps:,}", f"{seconds:,.0f}") for preset, seed, steps, seconds in made.trainings]
    lines += ["", "## Trainings", "", *_table(("preset", "seed", "environment steps", "time [s]"), rows)]
    return "\n".join(lines) + "\n"


def document(made: Made, results: Sequence[Result]) -> dict[str, Any]:
    """Returns the results as a JSON document."""
    return {
        "command": made.command,
        "seeds": list(made.seeds),
        "steps": made.steps,
        "seconds": made.seconds,
        "trainings": [list(training) for training in made.trainings],
        "results": [
            {
                "target": result.target,
                "title": result.title,
                "note": result.note,
                "statements": [s.document(not result.note) for s in result.statements],
                "columns": list(result.columns),
                "rows": [list(row) for row in result.rows],
            }
            for result in results
        ],
    }


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_row(columns), _row(["---"] * len(columns)), *map(_row, rows)]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
