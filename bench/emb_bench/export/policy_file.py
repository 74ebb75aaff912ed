"""A policy file: an ONNX graph with its contract, and the proof of both; that of a sequence of currents."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
import onnx
import onnx.parser
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.policy.contract import (
    CONTRACT_KEY,
    MAX_VECTORS,
    MIN_VECTORS,
    SAMPLE,
    Contract,
    PolicyLimits,
    Vector,
)
from emb_runtime.policy.policy import load_policy

OPSET = 20  # Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows
IR_VERSION = 10  # Of the file format: the one that goes with the opset

Provenance = Mapping[str, str | int | float]


def model_of(graph: str, constants: Mapping[str, NDArray[Any]]) -> onnx.ModelProto:
    """The model of a graph in ONNX's own text form, with its constants."""
    model = onnx.parser.parse_model(f'<ir_version: {IR_VERSION}, opset_import: ["" : {OPSET}]>\n{graph}')
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    return model


def policy_file(
    model: onnx.ModelProto,
    bench: Bench,
    seen: NDArray[Any],
    expected: NDArray[Any],
    provenance: Provenance,
    **contract: Any,
) -> bytes:
    """The graph with its contract, the same bytes for the same policy; it has passed each check of ``emb-run``.

    Args:
        model: the graph.
        bench: limits, sample time and horizon that it was made for.
        seen: inputs, shape [N, n].
        expected: outputs for them, shape [N, m]: all are compared, and some become the test vectors.
        provenance: its origin.
        contract: the other fields of :class:`emb_runtime.policy.contract.Contract`.

    Raises:
        PolicyRefusedError: an output differs by more than the tolerance of a test vector.
    """

    def with_vectors(rows: NDArray[Any]) -> bytes:
        vectors = [
            Vector(tuple(i), tuple(o)) for i, o in zip(seen[rows].tolist(), expected[rows].tolist(), strict=True)
        ]
        text = Contract(
            limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
            sample_time=bench.timing.sample_time,
            horizon=bench.timing.horizon,
            vectors=tuple(vectors),
            velocity=bench.sensors.velocity,
            provenance={**provenance, **versions("emb-excite", "onnx", "numpy")},
            **contract,
        ).to_json()
        helper.set_model_props(model, {CONTRACT_KEY: text})
        onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString(deterministic=True))

    every = np.resize(np.arange(len(seen)), max(len(seen), MIN_VECTORS))  # a short one again, up to the least number
    for rows in np.array_split(every, -(-len(every) // MAX_VECTORS)):
        load_policy(with_vectors(rows), bench)
    return with_vectors(np.linspace(0, len(seen) - 1, MIN_VECTORS).astype(int))


def versions(*names: str) -> dict[str, str]:
    """Versions of packages, for a provenance."""
    return {name: version(name) for name in names}


SEQUENCE = """policy (float[1, 3] inputs) => (float[1, 1] outputs) {
    time = Gather <axis = 1> (inputs, time_index)
    step = Mul (time, rate)
    rounded = Round (step)
    number = Cast <to = 7> (rounded)
    place = Clip (number, begin, end)
    outputs = Gather <axis = 0> (currents, place)
}"""


def sequence_file(currents: Floats, what: str, bench: Bench) -> bytes:
    """The file of a sequence of currents [A], shape [horizon].

    Raises:
        PolicyRefusedError: the file would differ from the sequence.
    """
    last, t_s = len(currents) - 1, bench.timing.sample_time
    constants: dict[str, NDArray[Any]] = {
        "currents": currents.astype(np.float32),
        "time_index": np.array([2]),
        "rate": np.array(1.0 / t_s, np.float32),
        "begin": np.array(0),
        "end": np.array(last),
    }
    model = model_of(SEQUENCE, constants)
    seen = np.zeros((len(currents), len(SAMPLE)))
    seen[:, 2] = t_s * np.arange(len(currents))
    provenance = {"sequence": printable(what)}
    return policy_file(model, bench, seen, currents[:, None], provenance, kind="current", inputs=SAMPLE)


def printable(text: str) -> str:
    """A text of others as a contract takes it."""
    return re.sub(r"[^ -~]", "?", text)[:200]
