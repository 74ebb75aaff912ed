"""References that are kept: a small JSON file each, with how it came to be. The tuned ones are part of the package."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.config.validation import Rules, Table, shown
from emb_runtime.errors import UsageError
from emb_runtime.estimator.speed_loop import Scale, scale_of
from emb_runtime.system.input_file import read_bytes
from emb_train.names import reference_names
from emb_train.structured.law import TERMS
from emb_train.structured.learning import SHIELDS, Shield
from emb_train.structured.task import TASKS, Task

SCHEMA = 1
RULES = Rules(UsageError, 10_000, remedy="make it anew with emb-train tune")
MAX_STORED_BYTES = 1 << 20  # Of a file; the tuned ones have some kilobytes

Form = Literal["blind", "quadratic"]
FORMS: tuple[Form, ...] = get_args(Form)  # Constants, or polynomials of the second degree in the estimate's logarithms


@dataclass(frozen=True)
class Stored:
    """A reference, and what it was tuned for."""

    task: str  # Name of a task of :data:`emb_train.structured.task.TASKS`
    form: Form
    plant: str  # Name of the bench's plant that it was tuned on
    gain: float  # Of the speed loop
    table: tuple[tuple[float, ...], ...]  # See :func:`emb_train.structured.law.set_reference`
    seed: int  # Of the search
    score: float  # Mean over the brakes that it was tuned on
    draws: int  # Number of those brakes
    command: str  # Command that made it
    shield: Shield  # Shield behind which it was tuned
    command_delay: tuple[int, int]  # Least and most samples that its commands waited

    def array(self) -> Floats:
        """The table, shape [2 n − 1, TERMS]."""
        return np.array(self.table)

    def scale(self, bench: Bench) -> Scale:
        """Its scale on a bench."""
        return scale_of(bench, self.gain)

    def asked(self) -> Task:
        """Task that it was tuned for."""
        return replace(TASKS[self.task], plant=self.plant, shield=self.shield, command_delay=self.command_delay)

    def to_json(self) -> str:
        """Text of the file in which it is kept."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1) + "\n"


def stored(source: str) -> Stored:
    """One that is part of the package, such as ``four-e-exact-quadratic``, or a ``.json`` file from elsewhere.

    Raises:
        UsageError: there is none of that name, or the file cannot be read or is something else.
    """
    if source.endswith(".json"):
        return _read(Path(source))
    if source not in reference_names():
        raise UsageError(f"no reference is called '{source}'; there are: {', '.join(reference_names())}")
    file = resources.files("emb_train.structured").joinpath("tuned", f"{source}.json")
    return read_text(file.read_text(encoding="utf-8"), source)


def _read(path: Path) -> Stored:
    try:
        return read_text(read_bytes(path, MAX_STORED_BYTES).decode("utf-8"), str(path))
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
    table = Table(source, "", record, RULES)
    table.schema(SCHEMA)
    found = Stored(
        task=table.text("task", tuple(TASKS)),
        form=cast(Form, table.text("form", FORMS)),
        plant=table.text("plant"),
        gain=table.number("gain"),
        table=_rows(table, source),
        seed=table.integer("seed"),
        score=table.number("score"),
        draws=table.integer("draws"),
        command=table.text("command"),
        shield=cast(Shield, table.text("shield", SHIELDS)),
        command_delay=table.integer_pair("command_delay", OLDEST_FRAME),
    )
    table.nothing_else()
    return found


def _rows(table: Table, source: str) -> tuple[tuple[float, ...], ...]:
    """Levels and switches: an odd number of rows of finite numbers."""
    rows = table.get("table")
    if not isinstance(rows, list) or len(rows) % 2 == 0:
        raise table.fail("table", f"expected an odd number of rows, got {shown(rows)}")
    each = Table(source, "", {f"table[{i}]": row for i, row in enumerate(rows)}, RULES)
    return tuple(each.numbers(name, TERMS, TERMS) for name in each.names())
