"""Policy files of references and of sequences of currents: an ONNX graph with its contract, and the proof of both."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from emb_bench.config.bench import Bench
from emb_bench.excitation import parse_excitation
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Ranges
from emb_runtime.errors import UsageError
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
from emb_train.reference import FEATURES, box_of, features, set_reference, stored
from emb_train.trial import Task

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
    wanted: NDArray[Any],
    provenance: Provenance,
    **contract: Any,
) -> bytes:
    """The graph with its contract, the same bytes for the same policy; it has passed each check of ``emb-run``.

    Args:
        model: the graph.
        bench: limits, sample time and horizon that it was made for.
        seen: inputs, shape [N, n].
        wanted: outputs for them, shape [N, m]: all are compared, and some become the test vectors.
        provenance: its origin.
        contract: the other fields of :class:`emb_runtime.policy.contract.Contract`.

    Raises:
        PolicyRefusedError: an output differs by more than the tolerance of a test vector.
    """

    def with_vectors(chosen: NDArray[Any]) -> bytes:
        vectors = [
            Vector(tuple(i), tuple(o)) for i, o in zip(seen[chosen].tolist(), wanted[chosen].tolist(), strict=True)
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
    for chosen in np.array_split(every, -(-len(every) // MAX_VECTORS)):
        load_policy(with_vectors(chosen), bench)
    return with_vectors(np.linspace(0, len(seen) - 1, MIN_VECTORS).astype(int))


def bounds(ranges: Ranges) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of each parameter."""
    return {name: (getattr(ranges.low, name), getattr(ranges.high, name)) for name in PARAMETER_NAMES}


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
    free = MatMul (terms, table)
    outputs = Clip (free, minus_one, one)
}"""


def reference_file(source: str, bench: Bench) -> bytes:
    """The file of a reference, see :func:`emb_train.reference.stored`.

    Raises:
        UsageError: there is no such reference, or the file is something else.
        BenchFileError: the bench lacks its set of ranges.
        PolicyRefusedError: the file would differ from the table.
    """
    kept = stored(source)
    task = Task.of(kept)
    ranges, table = bench.range_set(task.ranges), kept.array()
    box = box_of(bench, ranges)
    seen = np.random.default_rng(0).uniform(0.4, 1.6, (4 * MIN_VECTORS, FEATURES))
    wanted = np.zeros((len(seen), len(table)))
    for relative, reference in zip(seen.tolist(), wanted, strict=True):
        set_reference(table, features(box, tuple(relative)), reference)
    nominal = np.array([getattr(bench.brake, name) for name in PARAMETER_NAMES])
    kept_of = {name: getattr(kept, name) for name in ("task", "form", "plant", "seed", "command")}
    provenance = {"reference": Path(source).stem, **kept_of}
    low, high = (np.log(np.array(end) * nominal) for end in box)
    width = np.where(high > low, high - low, np.inf)  # 0 for a parameter that is known
    first, second = (np.eye(1 + FEATURES)[:, at] for at in np.triu_indices(1 + FEATURES))  # factors of a term: 1 or φ
    constants: dict[str, NDArray[Any]] = {
        "scale": np.diag(2.0 / width),
        "middle": -((low + high) / width)[None],
        "minus_one": np.array(-1.0),
        "one": np.array(1.0),
        "first": first[1:],
        "no_first": first[:1],
        "second": second[1:],
        "no_second": second[:1],
        "table": np.ascontiguousarray(table.T),
    }
    model = model_of(REFERENCE % (FEATURES, len(table)), constants)
    fields = {"kind": "reference", "inputs": PARAMETER_NAMES, "ranges": bounds(ranges), "gain": kept.gain}
    return policy_file(model, bench, seen * nominal, wanted, provenance, **fields)


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
    return policy_file(model, bench, seen, currents[:, None], {"sequence": what}, kind="current", inputs=SAMPLE)
