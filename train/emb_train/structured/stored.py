"""References that are kept: a small JSON file each, with how it came to be. The tuned ones are part of the package."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import OLDEST_FRAME
from emb_runtime.config.typed import FieldError, read
from emb_runtime.errors import UsageError
from emb_runtime.estimator.speed_loop import Scale, scale_of
from emb_runtime.system.input_file import read_bytes
from emb_train.names import reference_names
from emb_train.structured.law import TERMS
from emb_train.structured.learning import Shield
from emb_train.structured.task import TASKS, Task

MAX_STORED_BYTES = 1 << 20  # Of a file; the tuned ones have some kilobytes

Form = Literal["blind", "quadratic"]
FORMS: tuple[Form, ...] = get_args(Form)  # Constants, or polynomials of the second degree in the estimate's logarithms
Row = Annotated[tuple[float, ...], Meta(min_length=TERMS, max_length=TERMS)]
Samples = Annotated[int, Meta(ge=0, le=OLDEST_FRAME)]


class Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A reference, and what it was tuned for."""

    schema: Literal[1] = 1
    task: str  # Name of a task of :data:`emb_train.structured.task.TASKS`
    form: Form
    plant: str  # Name of the bench's plant that it was tuned on
    gain: float  # Of the speed loop
    table: tuple[Row, ...]  # See :func:`emb_train.structured.law.set_reference`
    seed: int  # Of the search
    score: float  # Mean over the brakes that it was tuned on
    draws: int  # Number of those brakes
    command: str  # Command that made it
    shield: Shield  # Shield behind which it was tuned
    command_delay: tuple[Samples, Samples]  # Least and most samples that its commands waited

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise FieldError("task", f"expected one of {', '.join(TASKS)}")
        if len(self.table) % 2 == 0:
            raise FieldError("table", f"expected an odd number of rows, got {len(self.table)}")
        if self.command_delay[0] > self.command_delay[1]:
            raise FieldError("command_delay", "expected the smaller number first")

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
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode() + "\n"


def stored(source: str) -> Stored:
    """One that is part of the package, such as ``four-e-exact-quadratic``, or a ``.json`` file from elsewhere.

    Raises:
        UsageError: there is none of that name, or the file cannot be read or is something else; the message names what.
    """
    if not source.endswith(".json"):
        if source not in reference_names():
            raise UsageError(f"no reference is called '{source}'; there are: {', '.join(reference_names())}")
        file = resources.files("emb_train.structured").joinpath("tuned", f"{source}.json")
        return read_text(file.read_bytes(), source)
    try:
        return read_text(read_bytes(Path(source), MAX_STORED_BYTES), source)
    except OSError as err:
        raise UsageError(f"{source}: {err.strerror}") from err


def read_text(text: str | bytes, source: str) -> Stored:
    """Read back what :meth:`Stored.to_json` wrote.

    Raises:
        UsageError: see :func:`stored`.
    """
    try:
        document = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as err:
        raise UsageError(f"{source}: not valid JSON: {err}") from err
    return read(Stored, document, source, UsageError, remedy="make it anew with emb-train", longest_text=10_000)
