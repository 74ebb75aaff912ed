"""References: levels and switches that are polynomials of the estimated parameters, as tables in small JSON files.

Each of l_0, l_1, … and t_1, t_2, … is l_i0 + Σ l_ij φ_j + Σ l_ijk φ_j φ_k, clipped to ±1, with φ the
logarithms of the estimates, scaled to −1..1 over their ranges and cut off there. With zeros for all slopes the
reference is blind: it depends on no measurement. A first level of small speed is a probe: its few milliseconds tell
the estimator enough to decide on the rest. How it is followed: :mod:`emb_runtime.estimator.speed_loop`.

The scalar functions also run compiled, in :mod:`emb_train.trial`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import OLDEST_FRAME, Ranges
from emb_runtime.config.typed import FieldError, read
from emb_runtime.errors import UsageError, near
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.kalman import Four, Model, State, believed, follow, make_model, relative, start
from emb_runtime.estimator.speed_loop import Scale, follow_reference, scale_of
from emb_runtime.policy.policy import Policy
from emb_runtime.system.input_file import read_bytes
from emb_train.play import Currents, Excitation, Seen
from emb_train.presets import FILES, TASKS, reference_names

FEATURES = 4  # Scaled estimates that a reference may depend on
PRODUCTS = tuple((i, j) for i in range(FEATURES) for j in range(i, FEATURES))
TERMS = 1 + FEATURES + len(PRODUCTS)  # Of a level or switch: constant, slopes, products in the order of ``PRODUCTS``


class Box(NamedTuple):
    """Relative parameters over whose ranges the features are scaled."""

    low: Four
    high: Four


def box_of(bench: Bench, ranges: Ranges) -> Box:
    """The box of a set of ranges."""
    return Box(relative(bench, ranges.low), relative(bench, ranges.high))


def scaled(value: float, low: float, high: float) -> float:
    """Logarithm of a value, −1..1 over its range and cut off there; 0 for one that is known."""
    if high <= low:
        return 0.0
    return min(max(math.log(value * value / (low * high)) / math.log(high / low), -1.0), 1.0)


def features(box: Box, parameters: Four) -> Four:
    """Features φ that levels and switches depend on."""
    (km, k1, tc, fv), low, high = parameters, box.low, box.high
    return (
        scaled(km, low[0], high[0]),
        scaled(k1, low[1], high[1]),
        scaled(tc, low[2], high[2]),
        scaled(fv, low[3], high[3]),
    )


def of_features(terms: Any, f: Four) -> float:
    """A level or a switch; ``terms`` has the shape [TERMS]."""
    f1, f2, f3, f4 = f
    total = terms[0] + terms[1] * f1 + terms[2] * f2 + terms[3] * f3 + terms[4] * f4
    total += f1 * (terms[5] * f1 + terms[6] * f2 + terms[7] * f3 + terms[8] * f4)
    total += f2 * (terms[9] * f2 + terms[10] * f3 + terms[11] * f4)
    total += f3 * (terms[12] * f3 + terms[13] * f4) + f4 * (terms[14] * f4)
    return float(total)


def set_reference(table: Any, f: Four, reference: Any) -> None:
    """Evaluate a table in place.

    Args:
        table: n levels, then n − 1 switches, shape [2 n − 1, TERMS].
        f: from :func:`features`.
        reference: becomes levels and switches, shape [2 n − 1].
    """
    for i in range(len(reference)):
        reference[i] = min(max(of_features(table[i], f), -1.0), 1.0)


def wanted_current(model: Model, state: State, scale: Scale, box: Box, table: Any, reference: Any) -> float:
    """Current for the newest sample [A].

    Args:
        model: of the estimator.
        state: estimate of the newest sample.
        scale: of the reference.
        box: of the features.
        table: of the reference, see :func:`set_reference`.
        reference: work space, shape [2 n − 1].
    """
    parameters = believed(model, state)
    set_reference(table, features(box, parameters), reference)
    levels = (len(reference) + 1) // 2
    return follow_reference(model, state, parameters, scale, reference[:levels], reference[levels:], state.step)


MAX_STORED_BYTES = 1 << 20  # Of a file; the tuned ones have some kilobytes
Form = Literal["blind", "quadratic"]  # Constants, or polynomials of the second degree in the estimate's logarithms
Row = Annotated[tuple[float, ...], Meta(min_length=TERMS, max_length=TERMS)]
Samples = Annotated[int, Meta(ge=0, le=OLDEST_FRAME)]


class Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A reference, and what it was tuned for."""

    schema: Literal[1] = 1
    task: str  # Name of a task, see :mod:`emb_train.trial`
    form: Form
    plant: str  # Name of the bench's plant that it was tuned on
    gain: float  # Of the speed loop
    table: tuple[Row, ...]  # See :func:`emb_train.reference.set_reference`
    seed: int  # Of the search
    score: float  # Mean over the brakes that it was tuned on
    draws: int  # Number of those brakes
    command: str  # Command that made it
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
            there = f"there are: {', '.join(reference_names())}{near(source, reference_names())}"
            raise UsageError(f"no reference is called '{source}'; {there}")
        return read_text(FILES.joinpath("references", f"{source}.json").read_bytes(), source)
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


class Following(Excitation):
    """A stored reference, one experiment after the other, each with an estimator of its own.

    Attributes:
        states: of the estimators.
    """

    def __init__(self, kept: Stored, bench: Bench, ranges: Ranges, *, sticks: bool = True) -> None:
        """Follow a reference with an estimator for these ranges."""
        self._model, self._scale = make_model(bench, ranges, sticks=sticks), kept.scale(bench)
        self._box, self._table = box_of(bench, ranges), kept.table
        self.states: list[State] = []

    def begin(self, count: int) -> None:
        """Begin N experiments anew."""
        self.states = [start(self._model)] * count

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`emb_train.play.Excitation`."""
        wanted, reference = np.zeros(len(seen)), [0.0] * len(self._table)
        for i, sample in enumerate(seen.tolist()):
            self.states[i] = state = follow(self._model, self.states[i], *sample)
            wanted[i] = wanted_current(self._model, state, self._scale, self._box, self._table, reference)
        return wanted


class PolicyFile(Excitation):
    """A policy file, one experiment after the other as the runtime calls it, each with an estimator of its own."""

    def __init__(self, policy: Policy, bench: Bench) -> None:
        """Use this policy, with estimators as the bench has them."""
        self._policy, self._bench = policy, bench
        self._estimators: list[Estimator] = []

    def begin(self, count: int) -> None:
        """Begin N experiments anew."""
        self._estimators = [Estimator(self._bench) for _ in range(count)]

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`emb_train.play.Excitation`."""
        wanted: Currents = np.zeros(len(seen))
        for i, (angle, velocity, step, applied) in enumerate(seen.tolist()):
            self._estimators[i].take(angle, velocity, step, applied)
            wanted[i] = self._policy.act(angle, velocity, step, self._estimators[i])
        return wanted
