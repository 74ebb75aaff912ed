"""Policy files of references and of sequences of currents: an ONNX graph with its contract, and the proof of both."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import onnx.parser
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from emb_bench.config.bench import Bench
from emb_bench.excitation import parse_excitation
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Ranges
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import (
    CONTRACT_KEY,
    MIN_VECTORS,
    SAMPLE,
    VECTOR_TOLERANCE,
    Contract,
    PolicyLimits,
    Vector,
)
from emb_runtime.policy.inference import Inference
from emb_train.reference import FEATURES, PRODUCTS, Box, box_of, features, set_reference, stored
from emb_train.trial import Task

OPSET = 20  # Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows
IR_VERSION = 10  # Of the file format: the one that goes with the opset
VECTORS = MIN_VECTORS  # Test vectors in a contract

Kind = Literal["current", "reference"]
Provenance = Mapping[str, str | int | float]


def model_of(graph: str, constants: Mapping[str, NDArray[Any]]) -> onnx.ModelProto:
    """The model of a graph in ONNX's own text form, with its constants."""
    model = onnx.parser.parse_model(f'<ir_version: {IR_VERSION}, opset_import: ["" : {OPSET}]>\n{graph}')
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    return model


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
        kind: as of :class:`emb_runtime.policy.contract.Contract`, like ``inputs`` and ``gain``.
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
    bounds: Any = {n: (getattr(ranges.low, n), getattr(ranges.high, n)) for n in PARAMETER_NAMES} if ranges else {}
    contract = Contract(
        kind=kind,
        inputs=inputs,
        limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        vectors=tuple(Vector(tuple(seen[i].tolist()), tuple(wanted[i].tolist())) for i in chosen),
        ranges=bounds,
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


REFERENCE = """policy (double[1, %d] inputs) => (double[1, %d] outputs) {
    logarithm = Log (inputs)
    scaled = Gemm (logarithm, scale, middle)
    feature = Clip (scaled, minus_one, one)
    left = Gemm (feature, first, no_first)
    right = Gemm (feature, second, no_second)
    terms = Mul (left, right)
    free = Gemm (terms, slopes, constants)
    outputs = Clip (free, minus_one, one)
}"""


def reference_file(source: str, bench: Bench) -> tuple[bytes, float]:
    """The file of a reference (:func:`emb_train.reference.stored`), and the largest difference from its table.

    Raises:
        UsageError: there is no such reference, or the file is something else.
        BenchFileError: the bench lacks its set of ranges.
        PolicyRefusedError: the file would differ from the table.
    """
    kept = stored(source)
    task = Task.of(kept)
    ranges, table = bench.range_set(task.ranges), kept.array()
    box = box_of(bench, ranges)
    seen = np.random.default_rng(0).uniform(0.4, 1.6, (4 * VECTORS, FEATURES))
    wanted = np.zeros((len(seen), len(table)))
    for relative, reference in zip(seen.tolist(), wanted, strict=True):
        set_reference(table, features(box, tuple(relative)), reference)
    nominal = np.array([getattr(bench.brake, name) for name in PARAMETER_NAMES])
    kept_of = {name: getattr(kept, name) for name in ("task", "form", "plant", "seed", "command")}
    provenance = {"reference": Path(source).stem, **kept_of}
    model = model_of(REFERENCE % (FEATURES, len(table)), _constants(table, box, nominal))
    return policy_file(
        model, bench, "reference", PARAMETER_NAMES, seen * nominal, wanted, provenance, ranges, kept.gain
    )


def _constants(table: Floats, box: Box, nominal: Floats) -> dict[str, Floats]:
    """Scaling of the features over their ranges, the factors of each term, and the table."""
    low, high = (np.log(np.array(end) * nominal) for end in box)
    width = np.where(high > low, high - low, np.inf)  # 0 for a parameter that is known
    one, pairs = np.eye(FEATURES), np.array(PRODUCTS)
    return {
        "scale": np.diag(2.0 / width),
        "middle": -((low + high) / width)[None],
        "minus_one": np.array(-1.0),
        "one": np.array(1.0),
        "first": np.hstack([one, one[:, pairs[:, 0]]]),
        "no_first": np.zeros((1, FEATURES + len(PRODUCTS))),
        "second": np.hstack([0.0 * one, one[:, pairs[:, 1]]]),
        "no_second": np.repeat([[1.0, 0.0]], [FEATURES, len(PRODUCTS)], axis=1),
        "slopes": np.ascontiguousarray(table[:, 1:].T),
        "constants": table[:, :1].T.copy(),
    }


def read_sequence(text: str, bench: Bench) -> tuple[Floats, str]:
    """The currents [A], shape [horizon], of an excitation or of a ``.csv`` file of ``emb-design``; and their name.

    Raises:
        UsageError: there is no such excitation or file, it is for another bench, or it is a feedback law.
    """
    if Path(text).suffix == ".csv":
        from emb_bench.design.report import read_design  # scipy takes its time

        return read_design(Path(text), bench)
    excited = parse_excitation(text, bench)
    if excited.currents is None:
        raise UsageError(f"{excited.name} is a feedback law: expected an excitation that is a sequence of currents")
    return excited.currents, excited.text


SEQUENCE = """policy (float[1, 3] inputs) => (float[1, 1] outputs) {
    time = Gather <axis = 1> (inputs, time_index)
    step = Mul (time, rate)
    whole = Round (step)
    number = Cast <to = 7> (whole)
    place = Clip (number, begin, end)
    outputs = Gather <axis = 0> (currents, place)
}"""


def sequence_file(currents: Floats, what: str, bench: Bench) -> tuple[bytes, float]:
    """The file of a sequence of currents [A], shape [horizon], and its largest difference as a part of their limit.

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
    return policy_file(model, bench, "current", SAMPLE, seen, currents[:, None], {"sequence": what})
