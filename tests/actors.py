"""Small actors as ONNX files, sane and hostile, made with nothing of ours but the contract."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import onnx
import onnx.parser
from onnx import TensorProto, helper

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.policy.contract import (
    ACTION,
    APPLIED_CURRENT,
    CONTRACT_KEY,
    MIN_VECTORS,
    OBSERVATION,
    Contract,
    Vector,
)

HONEST_STEPS = 100  # Hostile actors behave until this step, so that their test vectors, all of earlier steps, replay


def constant_actor(bench: Bench, current: float = 6.0, later: float | None = None, **changes: Any) -> bytes:
    """An actor that always asks for ``current`` [A].

    Args:
        bench: what its contract is made for.
        current: what it asks for.
        later: what it asks for from step :data:`HONEST_STEPS` on; NaN and 1e9 are possible.
        changes: fields of the contract that are to be other than right.
    """
    switched = current if later is None else later
    nodes = [
        helper.make_node("Slice", ["obs", "two", "three", "axis"], ["step"]),
        helper.make_node("Less", ["step", "honest"], ["early"]),
        helper.make_node("Where", ["early", "now", "later"], ["action"]),
    ]
    constants: dict[str, np.ndarray[Any, Any]] = {
        "two": np.array([2], np.int64),
        "three": np.array([3], np.int64),
        "axis": np.array([1], np.int64),
        "honest": np.array([[HONEST_STEPS]], np.float32),
        "now": np.array([[current]], np.float32),
        "later": np.array([[switched]], np.float32),
    }
    graph = helper.make_graph(
        nodes,
        "actor",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, len(OBSERVATION)])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, 1])],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    contract = contract_for(bench, current, changes)
    helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    return bytes(model.SerializeToString())


def contract_for(bench: Bench, current: float, changes: Mapping[str, Any]) -> Contract:
    """The contract of a constant actor."""
    box = bench.range_set(bench.shield.ranges)
    told = tuple(changes.get("initial_state", ())), (0.0,) * (2 * len(changes.get("estimates", ())))
    vectors = [Vector((float(n), -3.0 * n, float(n)), float(np.float32(current)), *told) for n in range(MIN_VECTORS)]
    fields: dict[str, Any] = {
        "observation": OBSERVATION,
        "action": ACTION,
        "action_limit": bench.limits.current,
        "sample_time": bench.timing.sample_time,
        "horizon": bench.timing.horizon,
        "bench_hash": bench.contract_hash,
        "ranges": {name: (getattr(box.low, name), getattr(box.high, name)) for name in PARAMETER_NAMES},
        "sequences": alone(vectors),
    }
    return Contract(**(fields | dict(changes)))


def alone(vectors: Iterable[Vector]) -> tuple[tuple[Vector, ...], ...]:
    """Each test vector as a sequence of its own."""
    return tuple((vector,) for vector in vectors)


class Leaky:
    """In plain Python what :func:`leaky_actor` says: a leaking integral of the current, and an estimate made up."""

    def begin(self) -> None:
        self.leak, self.count = LEAKY_STATE
        self.estimate: tuple[float, ...] = ()

    def act(self, _angle: float, _velocity: float, _step: float, applied_current: float) -> float:
        self.leak = 0.95 * self.leak + 0.025 * float(np.float32(applied_current))
        self.count += 1.0
        values = 0.05 * (1.0 + 0.1 / self.count), 2e-5
        deviations = 0.05 / self.count, 2e-4 / self.count
        self.estimate = tuple(np.array([*values, *deviations], np.float32).tolist())
        return float(np.float32(3.0 - self.leak))


LEAKY_STATE = (0.25, 0.0)
LEAKY_ESTIMATES = (Quantity("k_1", "N m/rad"), Quantity("f_v", "N m s/rad"))
WIDE = (*OBSERVATION, APPLIED_CURRENT)

LEAKY_GRAPH = """agent (float[1,4] obs, double[1,2] state)
    => (float[1,1] action, double[1,2] next_state, float[1,4] estimate)
    <int64[2] halves = {1, 1}, int64[4] parts = {1, 1, 1, 1}, double[1,1] one = {1.0}, double[1,1] limit = {1.0},
     double[1,1] keep = {0.95}, double[1,1] take = {0.025}, double[1,1] most = {3.0}, double[1,1] bad = {1.0},
     double[1,1] k = {0.05}, double[1,1] tenth = {0.1}, double[1,1] f = {0.00002}, double[1,1] spread = {0.0002}> {
    leak, count = Split<axis=1>(state, halves)
    angle, velocity, step, current = Split<axis=1>(obs, parts)
    applied = Cast<to=11>(current)
    kept = Mul(leak, keep)
    taken = Mul(applied, take)
    new_leak = Add(kept, taken)
    new_count = Add(count, one)
    late = Less(limit, new_count)
    factor = Where(late, bad, one)
    state_leak = Mul(new_leak, STATE)
    next_state = Concat<axis=1>(state_leak, new_count)
    wanted = Sub(most, new_leak)
    said = Mul(wanted, ACTION)
    action = Cast<to=1>(said)
    less = Div(tenth, new_count)
    more = Add(one, less)
    stiffness = Mul(k, more)
    value = Mul(stiffness, VALUE)
    uncertain = Div(k, new_count)
    deviation = Mul(uncertain, DEVIATION)
    friction = Div(spread, new_count)
    all = Concat<axis=1>(value, f, deviation, friction)
    estimate = Cast<to=1>(all)
}"""


def leaky_actor(
    bench: Bench, breaks: str = "", after: int = HONEST_STEPS, factor: float = math.nan, **changes: Any
) -> bytes:
    """An actor with a state and an estimate, in double precision: see :class:`Leaky`.

    Args:
        bench: what its contract is made for.
        breaks: STATE, ACTION, VALUE or DEVIATION: what is multiplied by ``factor`` after ``after`` samples.
        after: so many.
        factor: what with.
        changes: fields of the contract that are to be other than right.
    """
    text = LEAKY_GRAPH
    for part in ("STATE", "ACTION", "VALUE", "DEVIATION"):
        text = text.replace(f"{part})", "factor)" if part == breaks else "one)")
    model = onnx.parser.parse_model('<ir_version: 10, opset_import: ["" : 20]>\n' + text)
    for tensor in model.graph.initializer:
        if tensor.name in ("bad", "limit"):
            number = factor if tensor.name == "bad" else float(after)
            tensor.CopyFrom(onnx.numpy_helper.from_array(np.array([[number]]), tensor.name))
    right = {"observation": WIDE, "initial_state": LEAKY_STATE, "estimates": LEAKY_ESTIMATES}
    fields: dict[str, Any] = right | {"sequences": leaky_sequences()} | changes
    sizes = len(fields["initial_state"]), 2 * len(fields["estimates"])
    fields["sequences"] = tuple(tuple(resized(vector, *sizes) for vector in s) for s in fields["sequences"])
    contract = contract_for(bench, 1.0, fields)
    helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    return bytes(model.SerializeToString())


def resized(vector: Vector, state: int, estimate: int) -> Vector:
    """The same where the contract has another number of states or estimates, cut or filled up with zeros."""
    told = ((*numbers, *(0.0,) * size)[:size] for numbers, size in zip(vector[2:], (state, estimate), strict=True))
    return Vector(vector.observation, vector.action, *told)


def leaky_sequences() -> tuple[tuple[Vector, ...], ...]:
    """Two sequences, answered by :class:`Leaky`."""
    dice, leaky, sequences = np.random.default_rng(1), Leaky(), []
    for length in (MIN_VECTORS, 50):
        leaky.begin()
        seen = dice.uniform((0.0, -100.0, 0.0, -6.0), (50.0, 100.0, 500.0, 6.0), (length, 4)).tolist()
        answers = [(tuple(row), leaky.act(*row), (leaky.leak, leaky.count), leaky.estimate) for row in seen]
        sequences.append(tuple(Vector(*answer) for answer in answers))
    return tuple(sequences)
