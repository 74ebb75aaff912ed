"""A trained actor as the runtime drives it: one ONNX file, checked against its contract and the bench.

What is loaded is not trusted: the file is bounded in size, must stand alone (no side-car, no control flow that could
run for ever), must have exactly the inputs and outputs of the contract, must fit the bench, and must reproduce its test
vectors before :func:`load_policy` returns it. What it says afterwards is still clipped, shielded and guarded.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from emb_runtime.bench import Bench
from emb_runtime.contract import CONTRACT_KEY, OBSERVATION, VECTOR_TOLERANCE, Contract
from emb_runtime.errors import PolicyRefusedError, UsageError

INPUT_NAME = "obs"
OUTPUT_NAME = "action"

MAX_FILE_BYTES = 16 * 1024 * 1024
"""An actor is tens of kilobytes; what is far beyond is no actor."""

WARM_UP_RUNS = 20
"""ONNX Runtime allocates and selects kernels in its first runs; they must not fall into the experiment."""


def shipped_actor_path() -> Path:
    """Where the actor lies that is shipped with the package."""
    return Path(__file__).with_name("actor.onnx")


class Policy:
    """An actor that passed all checks. One thread, no spinning; made by :func:`load_policy` only.

    Attributes:
        contract: what it was trained for.
        data: the ONNX file as it was read, for the log.
        sha256: of :attr:`data`, in hexadecimal.
    """

    def __init__(self, contract: Contract, data: bytes, session: ort.InferenceSession) -> None:
        self.contract = contract
        self.data = data
        self.sha256 = hashlib.sha256(data).hexdigest()
        self._session = session
        self._observation = np.zeros((1, len(contract.observation)), np.float32)
        self._feed = {INPUT_NAME: self._observation}
        self._outputs = [OUTPUT_NAME]

    def act(self, angle: float, velocity: float, step: float) -> float:
        """What the actor wants for the period that begins at this sample.

        Args:
            angle: measured [rad].
            velocity: measured [rad/s].
            step: samples since the experiment began.

        Returns:
            The current [A] as the graph gives it: whether it is finite and within limits is for the caller to check.

        Raises:
            PolicyRefusedError: ONNX Runtime could not evaluate the graph.
        """
        row = self._observation[0]
        row[0] = angle
        row[1] = velocity
        row[2] = step
        try:
            return float(self._session.run(self._outputs, self._feed)[0].item())
        except Exception as err:  # ONNX Runtime's errors have no public base class
            raise PolicyRefusedError(f"ONNX Runtime could not evaluate the policy: {_first_line(err)}") from err


def load_policy(source: str | Path | bytes, bench: Bench) -> Policy:
    """Read, check and warm up an actor.

    Args:
        source: path of the ONNX file, or its bytes.
        bench: what it is to drive.

    Raises:
        UsageError: the file cannot be read.
        PolicyRefusedError: it is damaged, not self-contained, has another signature than the contract's, does not
            fit the bench, or does not reproduce its test vectors.
    """
    data = source if isinstance(source, bytes) else _read(Path(source))
    if len(data) > MAX_FILE_BYTES:
        raise PolicyRefusedError(f"the policy file is larger than {MAX_FILE_BYTES} bytes: not an actor of ours")
    contract = Contract.from_json(_self_contained_contract(data))
    contract.require_bench(bench)
    policy = Policy(contract, data, _open_session(data))
    _replay_vectors(policy)
    for _ in range(WARM_UP_RUNS):
        policy.act(0.0, 0.0, 0)
    return policy


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MAX_FILE_BYTES + 1)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the policy file: {err.strerror}") from err


def _open_session(data: bytes) -> ort.InferenceSession:
    """A session on one thread that has exactly the inputs and outputs of an actor."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # what goes wrong is raised, and said once
    try:
        session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as err:  # ONNX Runtime's errors have no public base class
        raise PolicyRefusedError(f"ONNX Runtime refuses the policy file: {_first_line(err)}") from err
    _require_ports("input", session.get_inputs(), INPUT_NAME, [1, len(OBSERVATION)])
    _require_ports("output", session.get_outputs(), OUTPUT_NAME, [1, 1])
    return session


def _require_ports(kind: str, ports: list[Any], name: str, shape: list[int]) -> None:
    found = [(p.name, p.type, p.shape) for p in ports]
    if found != [(name, "tensor(float)", shape)]:
        got = re.sub(r"[^ -~]", "?", ", ".join(f"'{n}' {t} {s}" for n, t, s in found))[:200] or "none"
        raise PolicyRefusedError(f"the policy's {kind}s: expected one, '{name}' tensor(float) {shape}, got {got}")


def _replay_vectors(policy: Policy) -> None:
    tolerance = VECTOR_TOLERANCE * policy.contract.action_limit
    for index, (observation, action) in enumerate(policy.contract.vectors):
        angle, velocity, step = observation
        got = policy.act(angle, velocity, step)
        if not abs(got - action) <= tolerance:  # written so that NaN is refused
            raise PolicyRefusedError(
                f"test vector {index}: the policy should say {action:.7g} A and says {got:.7g} A: the file is damaged "
                "or this ONNX Runtime computes something else; export it again"
            )


def _first_line(err: Exception) -> str:
    return re.sub(r"[^ -~]", " ", str(err).strip().split("\n")[0])[:300]


def _self_contained_contract(data: bytes) -> str:
    """The contract's text of an ONNX file that needs no other file and has no control flow.

    It is read before ONNX Runtime sees the file: given bytes with external data, ONNX Runtime would open files beside
    the working directory; given a Loop, it could run for ever.

    Raises:
        PolicyRefusedError: not ONNX, not self-contained, or no contract.
    """
    model = _MODEL()
    try:
        model.ParseFromString(data)
    except DecodeError as err:
        raise PolicyRefusedError("the policy file is not ONNX, or cut short") from err
    if not model.HasField("graph"):
        raise PolicyRefusedError("the policy file is not ONNX: it has no graph")
    tensors = list(model.graph.initializer)
    for sparse in model.graph.sparse_initializer:
        tensors += [sparse.values, sparse.indices]
    nodes = list(model.graph.node)
    for function in model.functions:
        nodes += function.node
    for attribute in (a for node in nodes for a in node.attribute):
        if attribute.HasField("g") or attribute.graphs:
            raise PolicyRefusedError("the policy has control flow (a graph inside a node): its run time has no bound")
        tensors += [attribute.t, *attribute.tensors]
        for sparse in (attribute.sparse_tensor, *attribute.sparse_tensors):
            tensors += [sparse.values, sparse.indices]
    if any(t.external_data or t.data_location for t in tensors):
        raise PolicyRefusedError("the policy keeps data in another file: export it as one file")
    texts = [p.value for p in model.metadata_props if p.key == CONTRACT_KEY]
    if len(texts) != 1:
        raise PolicyRefusedError(
            f"expected one '{CONTRACT_KEY}' in the ONNX metadata, got {len(texts)}: not exported by emb-export"
        )
    return str(texts[0])


# The part of onnx.proto3 that these checks read, as (field, number, type): a type with a star repeats, a type that
# names a row of this table is a message. The rest of a file stays unread, for ONNX Runtime to judge.
_ONNX_PART: dict[str, tuple[tuple[str, int, str], ...]] = {
    "Model": (("graph", 7, "Graph"), ("metadata_props", 14, "*Entry"), ("functions", 25, "*Function")),
    "Entry": (("key", 1, "string"), ("value", 2, "string")),
    "Graph": (("node", 1, "*Node"), ("initializer", 5, "*Tensor"), ("sparse_initializer", 15, "*Sparse")),
    "Function": (("node", 7, "*Node"),),
    "Node": (("attribute", 5, "*Attribute"),),
    "Attribute": (
        ("t", 5, "Tensor"),
        ("g", 6, "Graph"),
        ("tensors", 10, "*Tensor"),
        ("graphs", 11, "*Graph"),
        ("sparse_tensor", 22, "Sparse"),
        ("sparse_tensors", 23, "*Sparse"),
    ),
    "Sparse": (("values", 1, "Tensor"), ("indices", 2, "Tensor")),
    "Tensor": (("external_data", 13, "*Entry"), ("data_location", 14, "int32")),
}


def _build_reader() -> Any:
    """A message class that reads :data:`_ONNX_PART`; the ``onnx`` package is not part of the base install."""
    field_type = descriptor_pb2.FieldDescriptorProto
    scalars = {"string": field_type.TYPE_STRING, "int32": field_type.TYPE_INT32}
    file = descriptor_pb2.FileDescriptorProto(name="emb_onnx_part.proto", package="emb_onnx_part", syntax="proto3")
    for name, fields in _ONNX_PART.items():
        message = file.message_type.add(name=name)
        for field_name, number, kind in fields:
            label = field_type.LABEL_REPEATED if kind.startswith("*") else field_type.LABEL_OPTIONAL
            kind = kind.removeprefix("*")
            entry = message.field.add(name=field_name, number=number, label=label)
            if kind in scalars:
                entry.type = scalars[kind]
            else:
                entry.type, entry.type_name = field_type.TYPE_MESSAGE, f".{file.package}.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("emb_onnx_part.Model"))


_MODEL = _build_reader()
