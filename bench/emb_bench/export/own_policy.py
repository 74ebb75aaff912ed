"""Policy files of the ONNX graphs of others.

What is exported keeps its function: the graph gets the names, the type and the shape of the contract around it, and a
clip at the bench's largest current or speed behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.compose
import onnx.inliner
import onnx.shape_inference
import onnx.version_converter
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from emb_bench.config.bench import Bench
from emb_bench.export.policy_file import IR_VERSION, OPSET, Provenance, policy_file, printable
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import (
    CONTRACT_KEY,
    INPUTS,
    MIN_VECTORS,
    ROUNDING,
    SAMPLE,
    UNITS,
    VECTOR_TOLERANCE,
    greatest_output,
)
from emb_runtime.policy.onnx_file import read_graph, require_bounded
from emb_runtime.policy.policy import INPUT_NAME, MAX_FILE_BYTES, OUTPUT_NAME, open_session
from emb_runtime.system.input_file import read_bytes

OBSERVATIONS = 2000
MOST_NUMBERS = 1 << 20  # Of one result inside a graph
APART = 1e-3  # Largest difference by rounding from the source of a graph, part of the output's limit
WIDTHS = {len(names): names for names in INPUTS}  # Inputs by their number
PORT = f"expected {' or '.join(map(str, WIDTHS))} numbers: angle, velocity, time, or these and the running estimate"
FLOATS = {TensorProto.FLOAT: np.float32, TensorProto.DOUBLE: np.float64, TensorProto.FLOAT16: np.float16}
INSIDE = "net."  # Before each name of the graph that is wrapped


def onnx_policy(path: Path, bench: Bench, kind: str) -> tuple[bytes, str]:
    """The policy file of an ONNX file, and its origin in words; ``kind`` is one of :data:`UNITS`.

    Raises:
        UsageError: the file cannot be read.
        PolicyRefusedError: it is not ONNX, has another signature than one number of 3 or 11, or operators that
            ``emb-run`` refuses; it is a policy already; or an output is not finite.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(read_bytes(path, MAX_FILE_BYTES))
    except OSError as err:
        raise UsageError(f"{path}: cannot read the ONNX file: {err.strerror}") from err
    except DecodeError as err:
        raise PolicyRefusedError(f"{path}: not ONNX, or cut short") from err
    try:
        _take_in(model, path.parent)
        return own_policy(model, bench, {"graph": printable(path.name)}, f"the graph of {path.name}", None, kind)
    except PolicyRefusedError as err:
        raise PolicyRefusedError(f"{path}: {err}") from err


def observations(bench: Bench, width: int = len(SAMPLE)) -> NDArray[np.float32]:
    """Inputs all over the limits, beyond them, and near the origin, shape [OBSERVATIONS, width]."""
    rng = np.random.default_rng(0)
    low, high = bench.limits.angle
    reach = np.array([2.0 * (high - low), 3.0 * bench.limits.velocity]) * 10.0 ** -rng.uniform(
        0.0, 4.0, (OBSERVATIONS, 1)
    )
    time = rng.integers(0, bench.timing.horizon, (OBSERVATIONS, 1)) * bench.timing.sample_time
    columns = [rng.uniform(-reach, reach), time]
    if width > len(SAMPLE):
        nominal = np.array([getattr(bench.brake, name) for name in PARAMETER_NAMES])
        shape = (OBSERVATIONS, len(nominal))
        columns += [nominal * rng.uniform(0.4, 1.6, shape), nominal * 10.0 ** -rng.uniform(0.3, 4.0, shape)]
    return np.hstack(columns).astype(np.float32)


def own_policy(
    model: onnx.ModelProto,
    bench: Bench,
    provenance: Provenance,
    what: str,
    source: Callable[[NDArray[np.float32]], Floats] | None,
    kind: str,
) -> tuple[bytes, str]:
    """The policy file of a graph, and its origin in words.

    Args:
        model: the graph.
        bench: limits, sample time and horizon that it is for.
        provenance: its origin, for the contract.
        what: its origin in words.
        source: gives the outputs for inputs, shape [N, width]; without, ONNX Runtime with the graph as it is.
        kind: of the output, one of :data:`UNITS`.

    Raises:
        PolicyRefusedError: see :func:`onnx_policy`.
    """
    if any(entry.key == CONTRACT_KEY for entry in model.metadata_props):
        raise PolicyRefusedError("it is a policy already: emb-run --policy takes it as it is")
    try:
        model = bare(onnx.inliner.inline_local_functions(model))
        require_bounded(read_graph(model.SerializeToString()))
        port, width, answer = _ports(model)
        wrapped = _wrapped(model, port, width, answer, greatest_output(kind, bench.limits))
        _require_small(wrapped)
        return finished(wrapped, bench, provenance, what, source or _evaluated(model, port), kind)
    except PolicyRefusedError:
        raise
    except Exception as err:  # the errors of the onnx package share no base class
        raise PolicyRefusedError(f"the onnx package refuses it: {first_line(err)}") from err


def finished(
    graph: onnx.ModelProto,
    bench: Bench,
    provenance: Provenance,
    what: str,
    source: Callable[[NDArray[np.float32]], Floats],
    kind: str,
    **contract: Any,
) -> tuple[bytes, str]:
    """The policy file of a graph with input and output of the contract, compared with its source; and its origin.

    Arguments as of :func:`own_policy`, and other fields of the contract.

    Raises:
        PolicyRefusedError: an output is not finite, or differs by more than rounding.
    """
    (port,) = graph.graph.input
    width, limit = port.type.tensor_type.shape.dim[-1].dim_value, greatest_output(kind, bench.limits)
    seen = observations(bench, width)
    outputs = source(seen)
    if outputs.size != len(seen):
        shape = list(outputs.shape[1:])
        raise PolicyRefusedError(f"its output has the shape {shape}: expected one {kind} [{UNITS[kind]}], shape [1, 1]")
    outputs = outputs.reshape(len(seen), 1)
    for row in seen[~np.isfinite(outputs[:, 0])]:
        named = ", ".join(f"{name} {value:.4g}" for name, value in zip(WIDTHS[width], row.tolist(), strict=True))
        raise PolicyRefusedError(f"its {kind} is not finite for {named}")
    expected = np.clip(outputs, -limit, limit)
    found = _evaluated(graph, port)(seen).reshape(expected.shape)
    apart = np.abs(found - expected)[:, 0] / limit
    if not apart.max() <= APART:
        raise PolicyRefusedError(
            f"its graph differs from it by {apart.max() * limit:.3g} {UNITS[kind]}, expected rounding alone"
        )
    alike = apart <= 0.25 * VECTOR_TOLERANCE  # a test vector has to be met on other computers, too
    if alike.sum() < MIN_VECTORS:
        raise PolicyRefusedError(
            f"its {kind}s round by more than {VECTOR_TOLERANCE * limit:g} {UNITS[kind]}: scale its inputs"
        )
    fields = {"kind": kind, "inputs": WIDTHS[width], **contract}
    data = policy_file(graph, bench, seen[alike], expected[alike], provenance, **fields)
    beyond = int((np.abs(outputs) > limit * (1.0 + ROUNDING)).sum())
    clipped = f"; {beyond} of {len(seen)} {kind}s are beyond {limit:g} {UNITS[kind]}: clipped" if beyond else ""
    return data, f"{what} ({kind} of {', '.join(WIDTHS[width])}) at {len(seen)} inputs{clipped}"


def _take_in(model: onnx.ModelProto, folder: Path) -> None:
    """Take in the weights that the exporter of torch writes in a file beside the graph: no other file is read."""
    for tensor in model.graph.initializer:
        if not tensor.external_data:
            continue
        place = {entry.key: entry.value for entry in tensor.external_data}
        name = place.get("location", "")
        if name != Path(name).name or not name:
            raise PolicyRefusedError(f"it keeps weights in '{printable(name)}': expected a file in the same folder")
        try:
            offset, length = int(place.get("offset", 0)), int(place.get("length", -1))
            data = read_bytes(folder / name, MAX_FILE_BYTES)
        except (OSError, ValueError) as err:
            reason = err.strerror if isinstance(err, OSError) else "its place is no number"
            raise PolicyRefusedError(f"its weights in '{printable(name)}' cannot be read: {reason}") from err
        tensor.raw_data = data[offset : offset + length if length >= 0 else None]
        del tensor.external_data[:]
        tensor.ClearField("data_location")


def bare(model: onnx.ModelProto) -> onnx.ModelProto:
    """The graph without traces of what made it: stack traces have paths of this machine."""
    graph = model.graph
    del graph.value_info[:]
    parts: list[Any] = [model, graph, *graph.node, *graph.initializer, *graph.input, *graph.output]
    for part in parts:
        part.doc_string = ""
        del part.metadata_props[:]
    return model


def _ports(model: onnx.ModelProto) -> tuple[Any, int, Any]:
    """The input, its width, and the output.

    Raises:
        PolicyRefusedError: there are several, or of another type or shape than those of one number.
    """
    initialised = {tensor.name for tensor in model.graph.initializer}
    ports = []
    for what, found in (
        ("input", [p for p in model.graph.input if p.name not in initialised]),
        ("output", model.graph.output),
    ):
        if len(found) != 1:
            names = printable(", ".join(port.name for port in found)) or "none"
            raise PolicyRefusedError(f"expected one {what}, got {len(found)} ({names}): export the one of the policy")
        kind = found[0].type.tensor_type.elem_type
        if kind not in FLOATS:
            kind_name = TensorProto.DataType.Name(kind).lower()
            raise PolicyRefusedError(f"its {what} is of type {kind_name}: expected float32, float64 or float16")
        ports.append(found[0])
    shape = [d.dim_value or "N" for d in ports[0].type.tensor_type.shape.dim]
    if not 1 <= len(shape) <= 2 or shape[-1] not in WIDTHS or (len(shape) == 2 and shape[0] not in (1, "N")):
        sizes = ", ".join(map(str, shape))
        raise PolicyRefusedError(f"its input has the shape [{sizes}]: {PORT}, shape [1, 3] or [1, 11]")
    return ports[0], int(shape[-1]), ports[1]


def _evaluated(model: onnx.ModelProto, port: Any) -> Callable[[NDArray[np.float32]], Floats]:
    """Evaluates a graph as it is by ONNX Runtime."""
    session = open_session(model.SerializeToString())
    kind, rank = FLOATS[port.type.tensor_type.elem_type], len(port.type.tensor_type.shape.dim)

    def source(seen: NDArray[np.float32]) -> Floats:
        rows = seen.astype(kind) if rank == 1 else seen.astype(kind)[:, None]
        try:
            return np.array([session.run(None, {port.name: row})[0] for row in rows], np.float64)
        except Exception as err:  # ONNX Runtime's errors have no public base class
            raise PolicyRefusedError(f"ONNX Runtime could not evaluate it: {first_line(err)}") from err

    return source


def _wrapped(model: onnx.ModelProto, port: Any, width: int, answer: Any, limit: float) -> onnx.ModelProto:
    """The graph with the contract's input and output around it, in the opset of all policies, clipped at the limit."""
    rank, into = len(port.type.tensor_type.shape.dim), port.type.tensor_type.elem_type
    dims = port.type.tensor_type.shape.dim
    dims[0].dim_value = 1 if rank == 2 else width
    model = onnx.compose.add_prefix(_of_opset(model), INSIDE)
    graph = model.graph
    before = [
        helper.make_node("Cast", [INPUT_NAME], ["cast"], to=into),
        helper.make_node("Reshape", ["cast", "row"], [INSIDE + port.name]),
    ]
    after = [
        helper.make_node("Cast", [INSIDE + answer.name], ["output"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["output", "one"], ["number"]),
        helper.make_node("Clip", ["number", "least", "greatest"], [OUTPUT_NAME]),
    ]
    nodes = [*before, *graph.node, *after]
    del graph.node[:], graph.input[:], graph.output[:]
    graph.node.extend(nodes)
    graph.input.append(helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, [1, width]))
    graph.output.append(helper.make_tensor_value_info(OUTPUT_NAME, TensorProto.FLOAT, [1, 1]))
    graph.name = "policy"
    for name, value in (
        ("row", np.array([1, width][2 - rank :])),
        ("one", np.array([1, 1])),
        ("least", np.array(-limit, np.float32)),
        ("greatest", np.array(limit, np.float32)),
    ):
        graph.initializer.append(numpy_helper.from_array(value, name))
    return model


def _require_small(model: onnx.ModelProto) -> None:
    """Refuse a graph that would take memory as no policy does, before it is evaluated."""
    for value in onnx.shape_inference.infer_shapes(model, data_prop=True).graph.value_info:
        numbers = math.prod(d.dim_value for d in value.type.tensor_type.shape.dim)
        if numbers > MOST_NUMBERS:
            raise PolicyRefusedError(f"a result inside has {numbers} numbers, expected at most {MOST_NUMBERS}")


def _of_opset(model: onnx.ModelProto) -> onnx.ModelProto:
    versions_ = {entry.domain: entry.version for entry in model.opset_import}
    version = versions_.get("", versions_.get("ai.onnx", 0))
    if version != OPSET:
        try:
            model = bare(onnx.version_converter.convert_version(model, OPSET))
        except Exception as err:  # it has several
            raise PolicyRefusedError(
                f"it is of opset {version}, and cannot be written in {OPSET}, the one of policies: export it with "
                f"opset_version={OPSET}"
            ) from err
    del model.opset_import[:]
    model.opset_import.append(helper.make_opsetid("", OPSET))
    model.ir_version = IR_VERSION
    return model


def first_line(err: Exception) -> str:
    """The error of a library, in one line of plain letters."""
    return printable(next(iter(str(err).strip().split("\n")), "")) or type(err).__name__
