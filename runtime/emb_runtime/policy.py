"""A trained actor as the runtime drives it: one ONNX file, checked against its contract and the bench.

What is loaded is not trusted: the file is bounded in size, must stand alone (no side-car, no control flow that could
run for ever), must have exactly the inputs and outputs of the contract, must fit the bench, and must reproduce its test
vectors before :func:`load_policy` returns it. What it says afterwards is still clipped, shielded and guarded.

ONNX Runtime judges every file. A plain network is then evaluated by :mod:`emb_runtime.network`, which is three times as
fast, if it says the same for every test vector and many more observations.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from emb_runtime.bench import Bench
from emb_runtime.contract import CONTRACT_KEY, OBSERVATION, VECTOR_TOLERANCE, Contract
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.network import Network, network
from emb_runtime.onnx_file import Graph, read_graph

INPUT_NAME = "obs"
OUTPUT_NAME = "action"

MAX_FILE_BYTES = 16 * 1024 * 1024
"""An actor is tens of kilobytes; what is far beyond is no actor."""

PROBES = 200
"""Observations, besides the test vectors, at which a faster evaluation must say the same."""

WARM_UP_RUNS = 20
"""ONNX Runtime allocates and selects kernels in its first runs; they must not fall into the experiment."""


def shipped_actor_path() -> Path:
    """Where the actor lies that is shipped with the package."""
    return Path(__file__).with_name("actor.onnx")


class _Session:
    """A graph in ONNX Runtime; one thread, no spinning."""

    def __init__(self, session: ort.InferenceSession) -> None:
        self._session = session
        self._observation = np.zeros((1, len(OBSERVATION)), np.float32)
        self._feed = {INPUT_NAME: self._observation}
        self._outputs = [OUTPUT_NAME]

    def act(self, angle: float, velocity: float, step: float) -> float:
        row = self._observation[0]
        row[0] = angle
        row[1] = velocity
        row[2] = step
        try:
            return float(self._session.run(self._outputs, self._feed)[0].item())
        except Exception as err:  # ONNX Runtime's errors have no public base class
            raise PolicyRefusedError(f"ONNX Runtime could not evaluate the policy: {_first_line(err)}") from err


class Policy:
    """An actor that passed all checks; made by :func:`load_policy` only.

    Attributes:
        contract: what it was trained for.
        data: the ONNX file as it was read, for the log.
        sha256: of :attr:`data`, in hexadecimal.
        evaluated_by: ``numpy``, or ``onnxruntime``.
    """

    def __init__(self, contract: Contract, data: bytes, evaluator: _Session | Network) -> None:
        self.contract = contract
        self.data = data
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.evaluated_by = "numpy" if isinstance(evaluator, Network) else "onnxruntime"
        self._act = evaluator.act

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
        return self._act(angle, velocity, step)


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
    graph = read_graph(data)
    contract = Contract.from_json(_contract_text(graph))
    contract.require_bench(bench)
    policy = Policy(contract, data, _Session(_open_session(data)))
    _replay_vectors(policy)
    fast = network(graph, INPUT_NAME, OUTPUT_NAME)
    if fast is not None and _agree(fast, policy, bench):
        policy = Policy(contract, data, fast)
    for _ in range(WARM_UP_RUNS):
        policy.act(0.0, 0.0, 0)
    return policy


def _agree(fast: Network, policy: Policy, bench: Bench) -> bool:
    """Whether a network says what a policy says, at its test vectors and all over the bench."""
    dice = np.random.default_rng(0)
    (low, high), speed = bench.limits.angle, bench.limits.velocity
    observations: list[Any] = [vector.observation for vector in policy.contract.vectors]
    observations += dice.uniform((low, -speed, 0.0), (high, speed, bench.timing.horizon), (PROBES, 3)).tolist()
    tolerance = VECTOR_TOLERANCE * policy.contract.action_limit
    # NaN compares false, so it is refused.
    return all(abs(fast.act(*seen) - policy.act(*seen)) <= tolerance for seen in observations)


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


def _contract_text(graph: Graph) -> str:
    """The contract in a file's metadata.

    Raises:
        PolicyRefusedError: there is none, or more than one.
    """
    texts = [value for key, value in graph.texts if key == CONTRACT_KEY]
    if len(texts) != 1:
        raise PolicyRefusedError(
            f"expected one '{CONTRACT_KEY}' in the ONNX metadata, got {len(texts)}: not exported by emb-export"
        )
    return texts[0]
