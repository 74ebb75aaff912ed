"""Policy files: an ONNX graph of one opset with its contract in the metadata, and the proof that it is right."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, VECTOR_TOLERANCE, Contract, PolicyLimits, Vector
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME, Inference

OPSET = 20  # Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows
IR_VERSION = 10  # Of the file format: the one that goes with the opset
VECTORS = MIN_VECTORS  # Test vectors in a contract

Kind = Literal["current", "reference"]
Provenance = Mapping[str, str | int | float]


def graph_of(
    nodes: list[onnx.NodeProto], constants: Mapping[str, NDArray[Any]], kind: Kind, shape: tuple[int, int]
) -> onnx.ModelProto:
    """A model of nodes from ``inputs`` to ``outputs``, whose numbers are as many as ``shape`` says."""
    number = TensorProto.FLOAT if kind == "current" else TensorProto.DOUBLE
    ports = zip((INPUT_NAME, OUTPUT_NAME), shape, strict=True)
    taken, given = (helper.make_tensor_value_info(name, number, [1, width]) for name, width in ports)
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "policy", [taken], [given], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def policy_file(
    model: onnx.ModelProto,
    bench: Bench,
    kind: Kind,
    inputs: tuple[str, ...],
    seen: NDArray[Any],
    wanted: NDArray[Any],
    provenance: Provenance,
    ranges: Ranges | None = None,
    gain: float = 1.0,
) -> tuple[bytes, float]:
    """The graph with its contract, the same bytes for the same policy; and its largest difference from what is wanted.

    Args:
        model: the graph.
        bench: limits, sample time and horizon that it was made for.
        kind: of the graph, see :class:`emb_runtime.policy.contract.Contract`, as the names of its inputs and the gain.
        inputs: names.
        seen: inputs, shape [N, n].
        wanted: outputs for them, shape [N, m]; some become the test vectors.
        provenance: its origin.
        ranges: parameters that it was made for; None for any.
        gain: of the speed loop.

    Raises:
        PolicyRefusedError: an output differs by more than the tolerance of a test vector.
    """
    chosen = np.linspace(0, len(seen) - 1, VECTORS).astype(int)
    contract = Contract(
        kind=kind,
        inputs=inputs,
        limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        vectors=tuple(Vector(tuple(seen[i].tolist()), tuple(wanted[i].tolist())) for i in chosen),
        ranges={} if ranges is None else _bounds(ranges),
        gain=gain,
        provenance={**provenance, **versions("emb-excite", "onnx", "numpy")},
    )
    helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    onnx.checker.check_model(model, full_check=True)
    data = bytes(model.SerializeToString(deterministic=True))
    scale = bench.limits.current if kind == "current" else 1.0
    difference = float(np.max(np.abs(answers(data, contract, seen) - wanted))) / scale
    if not difference <= VECTOR_TOLERANCE:  # this way round for NaN
        raise PolicyRefusedError(
            f"the exported graph differs from what it was made of by {difference:.3g}, at most {VECTOR_TOLERANCE:g} is "
            "allowed: nothing was written"
        )
    return data, difference


def _bounds(ranges: Ranges) -> Any:
    return {name: (getattr(ranges.low, name), getattr(ranges.high, name)) for name in PARAMETER_NAMES}


def answers(data: bytes, contract: Contract, seen: NDArray[Any]) -> Floats:
    """Outputs of a file for inputs of shape [N, n], by the runtime's own evaluation, shape [N, m]."""
    inference, found = Inference(data, contract), []
    for row in seen.tolist():
        inference.inputs[:] = array(inference.inputs.typecode, row)
        inference.run()
        found.append(inference.outputs.tolist())
    return np.array(found)


def versions(*names: str) -> dict[str, str]:
    """Versions of packages, for a provenance."""
    return {name: version(name) for name in names}
