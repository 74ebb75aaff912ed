"""Small policies as ONNX files, sane and hostile, made with nothing of ours but the contract."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnx.parser
from onnx import helper

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, SAMPLE, Contract, PolicyLimits, Vector

HONEST_STEPS = 100  # Hostile policies behave until this step, so that their test vectors, all of earlier steps, replay


def constant_actor(bench: Bench, current: float = 6.0, later: float | None = None, **changes: Any) -> bytes:
    """A policy that always asks for ``current`` [A]; with ``kind="speed"`` it is a target speed [rad/s].

    Args:
        bench: what its contract is made for.
        current: what it asks for.
        later: what it asks for from step :data:`HONEST_STEPS` on; NaN and 1e9 are possible.
        changes: fields of the contract that are to be other than right.
    """
    text = """agent (float[1,3] inputs) => (float[1,1] outputs)
    <int64[1] two = {2}, int64[1] three = {3}, int64[1] axis = {1}, float[1,1] honest = {1.0},
     float[1,1] now = {0.0}, float[1,1] later = {0.0}> {
        time = Slice(inputs, two, three, axis)
        early = Less(time, honest)
        outputs = Where(early, now, later) }"""
    model = parsed(text)
    honest = (HONEST_STEPS - 0.5) * bench.timing.sample_time
    numbers = {"honest": honest, "now": current, "later": current if later is None else later}
    for tensor in model.graph.initializer:
        if tensor.name in numbers:
            array = np.array([[numbers[tensor.name]]], np.float32)
            tensor.CopyFrom(onnx.numpy_helper.from_array(array, tensor.name))
    return with_contract(model, contract_for(bench, current, **changes))


def parsed(text: str) -> onnx.ModelProto:
    """A model from ONNX's own text form."""
    return onnx.parser.parse_model('<ir_version: 10, opset_import: ["" : 20]>\n' + text)


def with_contract(model: onnx.ModelProto, contract: Contract) -> bytes:
    """The file of a model with a contract."""
    helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    return bytes(model.SerializeToString())


def contract_for(bench: Bench, current: float, **changes: Any) -> Contract:
    """The contract of a constant policy."""
    box, t_s = bench.range_set(bench.shield.ranges), bench.timing.sample_time
    answer = float(np.float32(current))
    fields: dict[str, Any] = {
        "kind": "current",
        "inputs": SAMPLE,
        "limits": PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        "sample_time": t_s,
        "horizon": bench.timing.horizon,
        "vectors": tuple(Vector((float(n), -3.0 * n, n * t_s), (answer,)) for n in range(MIN_VECTORS)),
        "ranges": {name: (getattr(box.low, name), getattr(box.high, name)) for name in PARAMETER_NAMES},
        "velocity": bench.sensors.velocity,
    }
    return Contract(**(fields | changes))


def speed_network(bench: Bench, weights: tuple[float, float, float], phase: float) -> bytes:
    """A policy that jumps from one speed limit to the other with the sine of what it sees; at 0 that of ``phase``."""
    text = """agent (float[1,3] inputs) => (float[1,1] outputs)
    <float[3,1] weights = {0., 0., 0.}, float[1,1] phase = {0.0}, float[1,1] loud = {1e6}, float least = {0.0},
     float most = {0.0}> {
        product = MatMul(inputs, weights)
        shifted = Add(product, phase)
        wave = Sin(shifted)
        large = Mul(wave, loud)
        outputs = Clip(large, least, most) }"""
    model, limit = parsed(text), bench.limits.velocity
    numbers = {"weights": [[w] for w in weights], "phase": [[phase]], "least": -limit, "most": limit}
    for tensor in model.graph.initializer:
        if tensor.name in numbers:
            tensor.CopyFrom(onnx.numpy_helper.from_array(np.array(numbers[tensor.name], np.float32), tensor.name))
    vectors = (Vector((0.0, 0.0, 0.0), (float(np.sign(phase)) * limit,)),) * MIN_VECTORS
    return with_contract(model, contract_for(bench, limit, kind="speed", vectors=vectors))
