"""The results as files: ``reproduction.md``, ``reproduction.json``, and a PNG for each table and figure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emb_train.checkpoint import write_text
from emb_train.reproduce.result import Result

MARKDOWN, DOCUMENT = "reproduction.md", "reproduction.json"


@dataclass(frozen=True)
class Made:
    """How the results came to be."""

    command: str
    """The command line."""
    seeds: tuple[int, ...]
    """Of trainings that are repeated."""
    most: int | None
    """Steps of a training at most; None for as many as its preset has."""
    steps: int
    """Environment steps of all trainings."""
    seconds: float
    """How long the trainings took [s]."""


def write_report(folder: Path, made: Made, results: Sequence[Result]) -> None:
    """Write both files beside the pictures.

    Raises:
        UsageError: they cannot be written.
    """
    write_text(folder / MARKDOWN, markdown(made, results))
    write_text(folder / DOCUMENT, json.dumps(document(made, results), indent=1, allow_nan=False) + "\n")


def summary(results: Sequence[Result]) -> str:
    """How many statements agree."""
    statements = [s for r in results for s in r.statements]
    return f"{sum(s.agrees for s in statements)} of {len(statements)} statements agree"


def markdown(made: Made, results: Sequence[Result]) -> str:
    """For a person."""
    lines = [
        "# The thesis's trainings, made again",
        "",
        f"    {made.command}",
        "",
        f"Seeds {', '.join(map(str, made.seeds))}; {made.steps:,} environment steps in {made.seconds:,.0f} s.",
        *(["", f"Trainings were cut at {made.most:,} steps: no verdict counts."] if made.most else []),
        "",
        f"{summary(results)}. A number agrees if it is within 20 % of the printed one, or if the printed one lies "
        "between our seeds.",
    ]
    for result in results:
        lines += ["", f"## {result.title}", "", f"![{result.title}]({result.target}.png)", ""]
        if result.rows:
            lines += [_row(result.columns), _row(["---"] * len(result.columns)), *map(_row, result.rows), ""]
        lines += [f"- {statement.sentence}" for statement in result.statements]
    return "\n".join(lines) + "\n"


def document(made: Made, results: Sequence[Result]) -> dict[str, Any]:
    """As JSON."""
    return {
        "command": made.command,
        "seeds": list(made.seeds),
        "most_steps": made.most,
        "steps": made.steps,
        "seconds": made.seconds,
        "results": [
            {
                "target": result.target,
                "title": result.title,
                "statements": [s.document() for s in result.statements],
                "columns": list(result.columns),
                "rows": [list(row) for row in result.rows],
            }
            for result in results
        ],
    }


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
