"""The contract of a policy: what an actor was trained to see, to say, and on which bench.

It travels as JSON with full precision in the ONNX metadata under :data:`CONTRACT_KEY`. What is read from a file is
not trusted: every key, type and value is checked, and the first thing wrong is said in one line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, NoReturn, TypedDict

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.errors import PolicyRefusedError

CONTRACT_KEY = "emb.contract"
"""Key of the contract in the ONNX ``metadata_props``."""

SCHEMA = 3
"""Of what is written. Older ones are still read: in schema 2 test vectors say nothing of state and estimate; actors of
schema 1 had neither, and each test vector stood for itself."""

MAX_JSON_CHARACTERS = 1_000_000
MAX_TEXT_CHARACTERS = 500
MIN_VECTORS = 32
MAX_VECTORS = 4096
MAX_STATE = 1024
"""Numbers that an actor may carry from one sample to the next."""
MAX_ESTIMATES = 12
"""Quantities that an actor may estimate: with their deviations they fit into one record of the log."""
MAX_ESTIMATE_NAME = 32

VECTOR_TOLERANCE = 1e-5
"""How far a replayed test vector may lie from the recorded action, as a part of the action limit."""


class Quantity(NamedTuple):
    """A signal with its unit."""

    name: str
    unit: str


OBSERVATION = (Quantity("angle", "rad"), Quantity("velocity", "rad/s"), Quantity("step", "1"))
"""What the actor sees, in this order, raw (thesis Table 4.2): the normaliser is part of the graph."""

APPLIED_CURRENT = Quantity("applied_current", "A")
"""What an actor may ask for besides: the current that acted in the period that ends at the sample."""

ACTION = Quantity("current", "A")
"""What the actor says: already scaled and clipped in the graph."""


class Vector(NamedTuple):
    """One observation with the action that the trained network gave for it, after those before it in its sequence."""

    observation: tuple[float, ...]
    """Values in the order of the contract's observation."""
    action: float
    """[A]."""
    state: tuple[float, ...] = ()
    """What it remembers then; empty where that is not told."""
    estimate: tuple[float, ...] = ()
    """What it estimates then, values and standard deviations; empty where that is not told."""


@dataclass(frozen=True)
class Contract:
    """Everything that must agree between training and the bench before a policy may drive it."""

    observation: tuple[Quantity, ...]
    """Inputs of the actor, in order."""
    action: Quantity
    """Output of the actor."""
    action_limit: float
    """Largest action, both signs, in the action's unit."""
    sample_time: float
    """[s]."""
    horizon: int
    """Samples in one experiment."""
    bench_hash: str
    """:attr:`emb_runtime.config.bench.Bench.contract_hash` of the bench it was trained for."""
    ranges: Mapping[str, tuple[float, float]]
    """Lowest and highest value that it was trained on, for every parameter of
    :data:`emb_runtime.config.bench.PARAMETER_NAMES`, in SI units."""
    sequences: tuple[tuple[Vector, ...], ...]
    """Test vectors, replayed before the policy may arm: each sequence from the initial state. The last one of each
    tells state and estimate, if there are any; in a contract of schema 2 none does."""
    initial_state: tuple[float, ...] = ()
    """What the graph is given as its state at the first sample; empty if it has none."""
    estimates: tuple[Quantity, ...] = ()
    """What the graph estimates, in order; the standard deviation of each is in the same unit."""
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)
    """How it came to be: preset, seed, steps, versions, command."""

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
            raise PolicyRefusedError(f"contract: not valid JSON: {_one_line(str(err))}") from err
        top = _Node("contract", document)
        if not 1 <= (schema := top.integer("schema", 0, 2**31)) <= SCHEMA:
            raise PolicyRefusedError(
                f"contract: schema: this runtime reads 1 to {SCHEMA}, got {schema}: export it again"
            )
        observation = tuple(_quantity(item) for item in top.items("observation", 1, 64))
        action, limit = _action(top.child("action"))
        contract = cls(
            observation=observation,
            action=action,
            action_limit=limit,
            sample_time=top.positive("sample_time"),
            horizon=top.integer("horizon", 1, 1_000_000),
            bench_hash=top.text("bench_hash"),
            ranges=_ranges(top.child("ranges")),
            provenance=_provenance(top.child("provenance")),
            **(_plain if schema == 1 else _with_memory)(top, schema, _Shape(len(observation), limit)),
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
        "train and export it with this bench file"
    )


def _names(quantities: tuple[Quantity, ...]) -> str:
    return "[" + ", ".join(f"{q.name} {q.unit}" for q in quantities) + "]"


def _one_line(text: str) -> str:
    """Foreign text, shortened and without line breaks or control characters, fit for a message."""
    clean = re.sub(r"[^ -~]", "?", text)
    return clean if len(clean) <= 120 else clean[:117] + "..."


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of JSON")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) != len(pairs):
        raise ValueError("a key occurs twice")
    return record


class _Node:
    """One JSON value with its place; every complaint names the place, what was expected and what came."""

    def __init__(self, path: str, value: object) -> None:
        self._path = path
        self._value = value
        self._read: set[str] = set()

    def fail(self, expected: str) -> NoReturn:
        raise PolicyRefusedError(f"{self._path}: expected {expected}, got {_one_line(repr(self._value))}")

    def names(self) -> list[str]:
        if not isinstance(self._value, dict):
            self.fail("an object")
        for key in self._value:
            if len(key) > MAX_TEXT_CHARACTERS or _one_line(key) != key:
                self.fail("keys that are short and printable")
        return list(self._value)

    def child(self, key: str) -> _Node:
        if key not in self.names():
            raise PolicyRefusedError(f"{self._path}: '{key}' is missing")
        self._read.add(key)
        assert isinstance(self._value, dict)
        return _Node(f"{self._path}: {key}", self._value[key])

    def elements(self, least: int, most: int) -> list[_Node]:
        if not isinstance(self._value, list) or not least <= len(self._value) <= most:
            self.fail(f"a list of {least} to {most} entries")
        return [_Node(f"{self._path}[{i}]", v) for i, v in enumerate(self._value)]

    def as_number(self) -> float:
        if isinstance(self._value, bool) or not isinstance(self._value, int | float):
            self.fail("a number")
        try:
            number = float(self._value)
        except OverflowError:
            self.fail("a number that fits a double")
        if not math.isfinite(number):
            self.fail("a finite number")
        return number

    def as_text(self) -> str:
        if not isinstance(self._value, str) or not self._value or len(self._value) > MAX_TEXT_CHARACTERS:
            self.fail(f"a text of 1 to {MAX_TEXT_CHARACTERS} characters")
        if not self._value.isprintable():
            self.fail("a printable text")
        return self._value

    def as_plain(self) -> str | int | float:
        if isinstance(self._value, str):
            return self.as_text()
        number = self.as_number()
        return self._value if isinstance(self._value, int) else number

    def items(self, key: str, least: int, most: int) -> list[_Node]:
        return self.child(key).elements(least, most)

    def number(self, key: str) -> float:
        return self.child(key).as_number()

    def positive(self, key: str) -> float:
        node = self.child(key)
        value = node.as_number()
        if value <= 0.0:
            node.fail("a positive number")
        return value

    def text(self, key: str) -> str:
        return self.child(key).as_text()

    def integer(self, key: str, low: int, high: int) -> int:
        node = self.child(key)
        value = node._value
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            node.fail(f"a whole number from {low} to {high}")
        return value

    def nothing_else(self) -> None:
        for key in self.names():
            if key not in self._read:
                raise PolicyRefusedError(f"{self._path}: unknown key '{key}'")


def _quantity(node: _Node) -> Quantity:
    quantity = Quantity(node.text("name"), node.text("unit"))
    node.nothing_else()
    return quantity


def _action(node: _Node) -> tuple[Quantity, float]:
    result = Quantity(node.text("name"), node.text("unit")), node.positive("limit")
    node.nothing_else()
    return result


def _ranges(node: _Node) -> dict[str, tuple[float, float]]:
    pairs = {}
    for name in PARAMETER_NAMES:
        entry = node.child(name)
        low, high = (e.as_number() for e in entry.elements(2, 2))
        if not 0.0 < low <= high:
            entry.fail("0 < lower <= upper")
        pairs[name] = (low, high)
    node.nothing_else()
    return pairs


class _Memory(TypedDict):
    """What schema 1 says otherwise."""

    sequences: tuple[tuple[Vector, ...], ...]
    initial_state: tuple[float, ...]
    estimates: tuple[Quantity, ...]


class _Shape(NamedTuple):
    """What a test vector has to be like."""

    width: int
    """Numbers in an observation."""
    limit: float
    """Largest action."""
    told: Mapping[str, int] = {}
    """Numbers in what it may tell besides."""


def _plain(top: _Node, _: int, shape: _Shape) -> _Memory:
    """Of schema 1: no state, no estimates, and each vector is a sequence of its own."""
    top.items("recurrent", 0, 0)
    vectors = [_vector(item, shape) for item in top.items("vectors", MIN_VECTORS, MAX_VECTORS)]
    return {"sequences": tuple((vector,) for vector in vectors), "initial_state": (), "estimates": ()}


def _with_memory(top: _Node, schema: int, shape: _Shape) -> _Memory:
    """Of schema 2, and of 3, where each sequence ends with what is remembered and estimated then."""
    state = tuple(item.as_number() for item in top.items("initial_state", 0, MAX_STATE))
    estimates = _estimates(top.child("estimates"))
    told = {} if schema == 2 else {"state": len(state), "estimate": 2 * len(estimates)}
    shape = shape._replace(told=told)
    node = top.child("sequences")
    items = [item.elements(1, MAX_VECTORS) for item in node.elements(1, MAX_VECTORS)]
    if not MIN_VECTORS <= sum(map(len, items)) <= MAX_VECTORS:
        node.fail(f"{MIN_VECTORS} to {MAX_VECTORS} test vectors in all")
    sequences = tuple(tuple(_vector(each, shape) for each in sequence) for sequence in items)
    for sequence, vectors in zip(items, sequences, strict=True):
        if any(len(getattr(vectors[-1], name)) != size for name, size in told.items()):
            sequence[-1].fail("state and estimate in the last vector of a sequence")
    return {"sequences": sequences, "initial_state": state, "estimates": estimates}


_NAME = re.compile(rf"[A-Za-z][A-Za-z0-9_]{{0,{MAX_ESTIMATE_NAME - 1}}}")
_TAKEN = frozenset({"step", "order", "time", "unixtime", "logtime", "publishtime"})
"""What the log's table of estimates calls something else; here and below without underscores, in lower case."""


def _estimates(node: _Node) -> tuple[Quantity, ...]:
    """Names and units; each name becomes a field of the log, beside one for its deviation."""
    estimates, taken = [], set(_TAKEN)
    for item in node.elements(0, MAX_ESTIMATES):
        quantity = _quantity(item)
        key = quantity.name.replace("_", "").lower()
        if not _NAME.fullmatch(quantity.name) or key in taken or key.endswith("deviation"):
            item.fail("a name of letters, digits and underscores that is not taken, and does not end in 'deviation'")
        taken.add(key)
        estimates.append(quantity)
    return tuple(estimates)


def _vector(node: _Node, shape: _Shape) -> Vector:
    observation = tuple(e.as_number() for e in node.items("observation", shape.width, shape.width))
    action = node.number("action")
    if abs(action) > shape.limit * (1.0 + VECTOR_TOLERANCE):
        node.fail(f"an action within ±{shape.limit:g}")
    there = [(name, size) for name, size in shape.told.items() if name in node.names()]
    told = {name: tuple(e.as_number() for e in node.items(name, size, size)) for name, size in there}
    node.nothing_else()
    return Vector(observation, action, **told)


def _provenance(node: _Node) -> dict[str, str | int | float]:
    return {key: node.child(key).as_plain() for key in node.names()}
