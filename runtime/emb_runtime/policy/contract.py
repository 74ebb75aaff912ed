"""The contract of a policy: what an actor was trained to see, to say, and on which bench.

It travels as JSON with full precision in the ONNX metadata under :data:`CONTRACT_KEY`. What is read from a file is
not trusted: every key, type and value is checked, and the first thing wrong is said in one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, NoReturn, TypedDict

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.config.validation import Rules, Table, shown
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.estimator.estimate import Quantity

CONTRACT_KEY = "emb.contract"  # Key of the contract in the ONNX ``metadata_props``

SCHEMA = 3
"""Of what is written. Older ones are still read: in schema 2 test vectors say nothing of state and estimate; actors of
schema 1 had neither, and each test vector stood for itself."""

MAX_JSON_CHARACTERS = 1_000_000
MAX_TEXT_CHARACTERS = 500
_RULES = Rules(PolicyRefusedError, MAX_TEXT_CHARACTERS, remedy="export the actor anew with emb-export")
MIN_VECTORS = 32
MAX_VECTORS = 4096
MAX_STATE = 1024  # Numbers that an actor may carry from one sample to the next
MAX_ESTIMATES = 12  # Quantities that an actor may estimate: with their deviations they fit into one record of the log
MAX_ESTIMATE_NAME = 32
MAX_PROVENANCE_NAME = 120

VECTOR_TOLERANCE = 1e-5
"""Largest difference of a replayed test vector from the recorded action, as a part of the action limit."""


OBSERVATION = (Quantity("angle", "rad"), Quantity("velocity", "rad/s"), Quantity("step", "1"))
"""Inputs of the actor in order, raw (thesis Table 4.2): the normaliser is part of the graph."""

APPLIED_CURRENT = Quantity("applied_current", "A")
"""Optional further input: the current that acted in the period that ends at the sample."""

ACTION = Quantity("current", "A")  # Output of the actor, scaled and clipped in the graph


class Vector(NamedTuple):
    """One observation with the action that the trained network gave for it, after those before it in its sequence."""

    observation: tuple[float, ...]  # Values in the order of the contract's observation
    action: float  # [A]
    state: tuple[float, ...] = ()  # State afterwards; empty if not recorded
    estimate: tuple[float, ...] = ()  # Estimate afterwards, values and standard deviations; empty if not recorded


@dataclass(frozen=True)
class Contract:
    """Everything that must agree between training and the bench before a policy may drive it."""

    observation: tuple[Quantity, ...]  # Inputs of the actor, in order
    action: Quantity  # Output of the actor
    action_limit: float  # Largest action, both signs, in the action's unit
    sample_time: float  # [s]
    horizon: int  # Samples in one experiment
    bench_hash: str  # :attr:`emb_runtime.config.bench.Bench.contract_hash` of the bench it was trained for
    ranges: Mapping[str, tuple[float, float]]
    """Lowest and highest value that it was trained on, for every parameter of
    :data:`emb_runtime.config.bench.PARAMETER_NAMES`, in SI units."""
    sequences: tuple[tuple[Vector, ...], ...]
    """Test vectors, replayed before the policy may arm: each sequence from the initial state. The last one of each
    tells state and estimate, if there are any; in a contract of schema 2 none does."""
    initial_state: tuple[float, ...] = ()  # State that the graph is given at the first sample; empty if it has none
    estimates: tuple[Quantity, ...] = ()
    """Estimated quantities in order; the standard deviation of each is in the same unit."""
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)
    """Provenance: preset, seed, steps, versions, command."""

    @property
    def vectors(self) -> tuple[Vector, ...]:
        """The test vectors of all sequences."""
        return tuple(vector for sequence in self.sequences for vector in sequence)

    def to_json(self) -> str:
        """The contract as JSON; floats keep their full precision."""
        record = {
            "schema": SCHEMA,
            "observation": [q._asdict() for q in self.observation],
            "action": {**self.action._asdict(), "limit": self.action_limit},
            "sample_time": self.sample_time,
            "horizon": self.horizon,
            "initial_state": list(self.initial_state),
            "estimates": [q._asdict() for q in self.estimates],
            "bench_hash": self.bench_hash,
            "ranges": {name: list(pair) for name, pair in self.ranges.items()},
            "provenance": dict(self.provenance),
            "sequences": [
                [{name: value for name, value in v._asdict().items() if value != ()} for v in sequence]
                for sequence in self.sequences
            ],
        }
        return json.dumps(record, sort_keys=True, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Contract:
        """Read a contract that nobody vouches for.

        Raises:
            PolicyRefusedError: it is not JSON, has another schema, lacks a key, has one too many, or a value of the
                wrong type or range.
        """
        if len(text) > MAX_JSON_CHARACTERS:
            raise PolicyRefusedError(f"contract: expected at most {MAX_JSON_CHARACTERS} characters, got {len(text)}")
        try:
            document = json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_unique_keys)
        except (ValueError, RecursionError) as err:
            raise PolicyRefusedError(f"contract: not valid JSON: {shown(str(err))}") from err
        top = Table("contract", "", document, _RULES)
        if not 1 <= (schema := top.integer("schema", 0, 2**31)) <= SCHEMA:
            raise top.fail("schema", f"this runtime reads 1 to {SCHEMA}, got {schema}: export it again")
        observation = tuple(_quantity(item) for item in top.tables("observation", 1, 64))
        action, limit = _action(top.table("action"))
        contract = cls(
            observation=observation,
            action=action,
            action_limit=limit,
            sample_time=_positive(top, "sample_time"),
            horizon=top.integer("horizon", 1, 1_000_000),
            bench_hash=top.text("bench_hash"),
            ranges=_ranges(top.table("ranges")),
            provenance=_provenance(top.table("provenance")),
            **(_without_memory if schema == 1 else _with_memory)(top, schema, _Shape(len(observation), limit)),
        )
        top.nothing_else()
        return contract

    def require_bench(self, bench: Bench) -> None:
        """Check that this policy was trained for this bench; the most telling difference is named first.

        Raises:
            PolicyRefusedError: sample time, horizon, signals, units, limit or bench hash differ, or it was trained for
                brakes that the bench's shield does not cover.
        """
        if self.observation not in (OBSERVATION, (*OBSERVATION, APPLIED_CURRENT)):
            needed = f"{_names(OBSERVATION)}, at most with {APPLIED_CURRENT.name} {APPLIED_CURRENT.unit} behind it"
            _differ("observation (order and units)", needed, _names(self.observation))
        if self.action != ACTION:
            _differ("action", _names((ACTION,)), _names((self.action,)))
        if self.sample_time != bench.timing.sample_time:
            _differ("sample time", f"{bench.timing.sample_time!r} s", f"{self.sample_time!r} s")
        if self.horizon != bench.timing.horizon:
            _differ("horizon", f"{bench.timing.horizon} samples", f"{self.horizon}")
        # A bench may be narrower than the policy, for the runtime clips; a wider one is not the bench it knows.
        if self.action_limit < bench.limits.current:
            _differ("action limit", f"at least {bench.limits.current!r} A", f"{self.action_limit!r} A")
        if self.bench_hash != bench.contract_hash:
            _differ("bench hash", bench.contract_hash, self.bench_hash)
        box = bench.range_set(bench.shield.ranges)
        for name, (low, high) in self.ranges.items():
            covered = getattr(box.low, name), getattr(box.high, name)
            if low < covered[0] or high > covered[1]:
                _differ(f"range of {name}", f"{covered[0]:g} to {covered[1]:g} at most", f"{low:g} to {high:g}")


def _differ(what: str, bench: str, policy: str) -> NoReturn:
    raise PolicyRefusedError(
        f"the policy does not fit this bench: {what}: the bench needs {bench}, the policy has {policy}; "
        "export one for this bench file: emb-export four-d-exact-quadratic --bench FILE --out actor.onnx"
    )


def _names(quantities: tuple[Quantity, ...]) -> str:
    return "[" + ", ".join(f"{q.name} {q.unit}" for q in quantities) + "]"


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of JSON")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) != len(pairs):
        raise ValueError("a key occurs twice")
    return record


def _quantity(table: Table) -> Quantity:
    quantity = Quantity(table.text("name"), table.text("unit"))
    table.nothing_else()
    return quantity


def _action(table: Table) -> tuple[Quantity, float]:
    result = Quantity(table.text("name"), table.text("unit")), _positive(table, "limit")
    table.nothing_else()
    return result


def _positive(table: Table, name: str) -> float:
    return table.number(name, lambda value: value > 0.0, "a positive number")


def _ranges(table: Table) -> dict[str, tuple[float, float]]:
    pairs = {}
    for name in PARAMETER_NAMES:
        low, high = table.number_pair(name)
        if low <= 0.0:
            raise table.fail(name, f"expected positive bounds, got {low:g}")
        pairs[name] = (low, high)
    table.nothing_else()
    return pairs


class _Memory(TypedDict):
    """Fields of a contract that schema 1 writes otherwise."""

    sequences: tuple[tuple[Vector, ...], ...]
    initial_state: tuple[float, ...]
    estimates: tuple[Quantity, ...]


class _Shape(NamedTuple):
    """Sizes that a test vector must have."""

    width: int  # Numbers in an observation
    limit: float  # Largest action
    optional: Mapping[str, int] = {}  # Numbers in each further entry that it may have


def _without_memory(top: Table, _: int, shape: _Shape) -> _Memory:
    """Reads schema 1: no state, no estimates, and each vector is a sequence of its own."""
    top.tables("recurrent", 0, 0)
    vectors = [_vector(item, shape) for item in top.tables("vectors", MIN_VECTORS, MAX_VECTORS)]
    return {"sequences": tuple((vector,) for vector in vectors), "initial_state": (), "estimates": ()}


def _with_memory(top: Table, schema: int, shape: _Shape) -> _Memory:
    """Reads schema 2, and 3, where the last vector of each sequence has state and estimate."""
    state = top.numbers("initial_state", 0, MAX_STATE)
    estimates = _estimates(top.tables("estimates", 0, MAX_ESTIMATES))
    optional = {} if schema == 2 else {"state": len(state), "estimate": 2 * len(estimates)}
    shape = shape._replace(optional=optional)
    items = top.table_lists("sequences", 1, MAX_VECTORS)
    if not MIN_VECTORS <= sum(map(len, items)) <= MAX_VECTORS:
        raise top.fail("sequences", f"expected {MIN_VECTORS} to {MAX_VECTORS} test vectors in all")
    sequences = tuple(tuple(_vector(each, shape) for each in sequence) for sequence in items)
    for i, vectors in enumerate(sequences):
        if any(len(getattr(vectors[-1], name)) != size for name, size in optional.items()):
            raise top.fail(f"sequences[{i}]", "expected state and estimate in the last vector of a sequence")
    return {"sequences": sequences, "initial_state": state, "estimates": estimates}


_NAME = re.compile(rf"[A-Za-z][A-Za-z0-9_]{{0,{MAX_ESTIMATE_NAME - 1}}}")
_TAKEN = frozenset({"step", "order", "time", "unixtime", "logtime", "publishtime"})
"""Field names that the log's table of estimates has already, without underscores, in lower case."""


def _estimates(tables: list[Table]) -> tuple[Quantity, ...]:
    """Names and units; each name becomes a field of the log, beside one for its deviation."""
    estimates, taken = [], set(_TAKEN)
    for table in tables:
        quantity = _quantity(table)
        key = quantity.name.replace("_", "").lower()
        if not _NAME.fullmatch(quantity.name) or key in taken or key.endswith("deviation"):
            wanted = "a name of letters, digits and underscores that is not taken, and does not end in 'deviation'"
            raise table.fail("name", f"expected {wanted}, got {shown(quantity.name)}")
        taken.add(key)
        estimates.append(quantity)
    return tuple(estimates)


def _vector(table: Table, shape: _Shape) -> Vector:
    observation = table.numbers("observation", shape.width, shape.width)
    bound = shape.limit * (1.0 + VECTOR_TOLERANCE)
    action = table.number("action", lambda value: abs(value) <= bound, f"an action within ±{shape.limit:g}")
    there = [(name, size) for name, size in shape.optional.items() if name in table.names()]
    further = {name: table.numbers(name, size, size) for name, size in there}
    table.nothing_else()
    return Vector(observation, action, **further)


def _provenance(table: Table) -> dict[str, str | int | float]:
    """Entries by name. The names are the file's own, and the pre-flight shows them on the terminal."""
    for name in table.names():
        if len(name) > MAX_PROVENANCE_NAME or not (name.isascii() and name.isprintable()):
            raise table.fail(name, f"expected a name of at most {MAX_PROVENANCE_NAME} printable ASCII characters")
    return {name: table.text_or_number(name) for name in table.names()}
