"""Small actors as ONNX files, sane and hostile, made with nothing of ours but the contract."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper

from emb_runtime.bench import PARAMETER_NAMES, Bench
from emb_runtime.contract import ACTION, CONTRACT_KEY, MIN_VECTORS, OBSERVATION, Contract, Vector

HONEST_STEPS = 100
"""Hostile actors behave until this step, so that their test vectors, all of earlier steps, replay."""


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
    vectors = tuple(Vector((float(n), -3.0 * n, float(n)), float(np.float32(current))) for n in range(MIN_VECTORS))
    fields: dict[str, Any] = {
        "observation": OBSERVATION,
        "action": ACTION,
        "action_limit": bench.limits.current,
        "sample_time": bench.timing.sample_time,
        "horizon": bench.timing.horizon,
        "bench_hash": bench.contract_hash,
        "ranges": {name: (getattr(box.low, name), getattr(box.high, name)) for name in PARAMETER_NAMES},
        "vectors": vectors,
    }
    return Contract(**(fields | dict(changes)))
