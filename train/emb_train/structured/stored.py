"""References that are kept: a small JSON file each, with how it came to be. The tuned ones are part of the package."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.errors import UsageError
from emb_train.names import reference_names
from emb_train.structured.adaptive_shield import SHIELDS, Shield
from emb_train.structured.law import TERMS, Loop, no_loop, speed_loop
from emb_train.structured.task import TASKS, Task

SCHEMA = 1

Form = Literal["current", "speed", "affine"]
FORMS: tuple[Form, ...] = ("current", "speed", "affine")
"""Blind sequence of currents, blind sequence of speeds, speeds that are affine in the estimate."""


@dataclass(frozen=True)
class Stored:
    """A reference, and what it was tuned for."""

    task: str
    """Name of a task of :data:`emb_train.structured.task.TASKS`."""
    form: Form
    plant: str
    """Name of the bench's plant that it was tuned on."""
    gain: float
    """Of the speed loop."""
    table: tuple[tuple[float, ...], ...]
    """See :func:`emb_train.structured.law.reference`."""
    seed: int
    """Of the search."""
    score: float
    """Mean over the brakes that it was tuned on."""
    draws: int
    """Number of those brakes."""
    command: str
    """Command that made it."""
    shield: Shield = "worst case"
    """Shield behind which it was tuned."""
    command_delay: tuple[int, int] = (0, 0)
    """Least and most samples that its commands waited."""
    start: str = ""
    """File name of the kept reference that the search began with; empty if it began with none."""
    start_sha256: str = ""
    """Of that file."""

    def array(self) -> Floats:
        """The table, shape [2 n − 1, TERMS]."""
        return np.array(self.table)

    def loop(self, bench: Bench) -> Loop:
        """Loop that follows it."""
        return no_loop(bench) if self.form == "current" else speed_loop(bench, self.gain)

    def asked(self) -> Task:
        """Task that it was tuned for."""
        return replace(TASKS[self.task], plant=self.plant, shield=self.shield, command_delay=self.command_delay)

    def on_a_bench(self, source: str) -> Task:
        """Task of a reference that a bench is to play.

        Raises:
            UsageError: no bench's shield covers the brakes that it is for; the message begins with ``source``.
        """
        task = self.asked()
        if task.share:
            raise UsageError(
                f"{source}: it is for brakes within {task.share:.0%}, which no bench's shield covers; only "
                "python -m studies.ladder plays it"
            )
        return task

    def to_json(self) -> str:
        """Text of the file in which it is kept."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1) + "\n"


def stored(name: str) -> Stored:
    """One that is part of the package, such as ``four-d-speed``.

    Raises:
        UsageError: there is none of that name.
    """
    if name not in reference_names():
        raise UsageError(f"no reference is called '{name}'; there are: {', '.join(reference_names())}")
    file = resources.files("emb_train.structured").joinpath("tuned", f"{name}.json")
    return read_text(file.read_text(encoding="utf-8"), name)


def read_file(path: Path) -> Stored:
    """One from elsewhere.

    Raises:
        UsageError: it cannot be read, or is something else.
    """
    return read_hashed(path)[0]


def read_hashed(path: Path) -> tuple[Stored, str]:
    """One from elsewhere, and the SHA-256 of its file.

    Raises:
        UsageError: it cannot be read, or is something else.
    """
    try:
        data = path.read_bytes()
        return read_text(data.decode("utf-8"), str(path)), hashlib.sha256(data).hexdigest()
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not UTF-8 text"
        raise UsageError(f"{path}: {reason}") from err


def read_text(text: str, source: str) -> Stored:
    """Read back what :meth:`Stored.to_json` wrote.

    Raises:
        UsageError: it is something else; the message begins with ``source`` and names what is wrong.
    """
    try:
        record = json.loads(text)
    except (ValueError, RecursionError) as err:
        raise UsageError(f"{source}: not valid JSON: {err}") from err
    kinds: dict[str, Any] = {
        "task": str,
        "form": str,
        "plant": str,
        "gain": float,
        "table": list,
        "seed": int,
        "score": float,
        "draws": int,
        "command": str,
        "shield": str,
        "command_delay": list,
        "start": str,
        "start_sha256": str,
    }
    if isinstance(record, dict):
        record = {"shield": "worst case", "command_delay": [0, 0], "start": "", "start_sha256": "", **record}
    if not isinstance(record, dict) or record.pop("schema", None) != SCHEMA or set(record) != set(kinds):
        raise UsageError(f"{source}: expected schema {SCHEMA} with {', '.join(kinds)}")
    for key, kind in kinds.items():
        if type(record[key]) is not kind:
            raise UsageError(f"{source}: {key}: expected {kind.__name__}, got {record[key]!r}")
    if record["task"] not in TASKS:
        raise UsageError(f"{source}: task: expected one of {', '.join(TASKS)}, got {record['task']!r}")
    if record["form"] not in FORMS:
        raise UsageError(f"{source}: form: expected one of {', '.join(FORMS)}, got {record['form']!r}")
    if record["shield"] not in SHIELDS:
        raise UsageError(f"{source}: shield: expected one of {', '.join(SHIELDS)}, got {record['shield']!r}")
    delay = record.pop("command_delay")
    if len(delay) != 2 or not all(type(d) is int for d in delay) or not 0 <= delay[0] <= delay[1] <= OLDEST_FRAME:
        raise UsageError(f"{source}: command_delay: expected least and most of 0 to {OLDEST_FRAME}, got {delay!r}")
    rows = record.pop("table")
    good = len(rows) % 2 == 1 and all(isinstance(row, list) and len(row) == TERMS for row in rows)
    if not good or not all(type(v) in (int, float) and math.isfinite(v) for row in rows for v in row):
        raise UsageError(f"{source}: table: expected an odd number of rows of {TERMS} finite numbers")
    table = tuple(tuple(float(v) for v in row) for row in rows)
    return Stored(table=table, command_delay=(delay[0], delay[1]), **record)
