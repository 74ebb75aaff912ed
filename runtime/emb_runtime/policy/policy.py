"""A policy: one ONNX file that gives a current or a target speed, from a sample and the estimate.

A file is of unknown origin: it is bounded in size, must stand alone (no other file, no control flow), must be made of
operators whose work is the same for every sample (:mod:`emb_runtime.policy.onnx_file`), must have exactly the input and
the output of its contract, must fit the bench, and must reproduce its test vectors before :func:`load_policy` returns
it. Its currents are still clipped, shielded and guarded.
"""

from __future__ import annotations

import hashlib
import math
import re
from array import array
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_runtime.config.bench import CEILING_CURRENT, CEILING_VELOCITY, Bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.contract import CONTRACT_KEY, ROUNDING, SAMPLE, VECTOR_TOLERANCE, Contract, read_contract
from emb_runtime.policy.onnx_file import read_graph, require_bounded
from emb_runtime.system.input_file import open_regular

if TYPE_CHECKING:
    import onnxruntime as ort

INPUT_NAME = "inputs"
OUTPUT_NAME = "outputs"
CODE = "f"  # Of single precision
MAX_FILE_BYTES = 4 * 1024 * 1024  # A policy is a few to hundreds of kilobytes


def shipped_actor_path(quick: bool = False) -> Path:
    """Path of the policy that is shipped with the package: the one for a whole experiment, or for a short one."""
    return Path(str(resources.files("emb_runtime.policy").joinpath("quick.onnx" if quick else "actor.onnx")))


class Inference:
    """A graph in ONNX Runtime, one thread, no spinning, with arrays for input and output that are read in place.

    PolicyRefusedError where the graph has other ones than its contract.
    """

    def __init__(self, data: bytes, contract: Contract) -> None:
        self._session = open_session(data)
        self.inputs = array(CODE, contract.vectors[0].inputs)
        self.outputs = array(CODE, contract.vectors[0].outputs)
        ports = {INPUT_NAME: self.inputs, OUTPUT_NAME: self.outputs}
        expected = [(name, "tensor(float)", [1, len(numbers)]) for name, numbers in ports.items()]
        found = [(port.name, port.type, port.shape) for port in self._session.get_inputs()]
        found += [(port.name, port.type, port.shape) for port in self._session.get_outputs()]
        if found != expected:
            given = re.sub(r"[^ -~]", "?", str(found))[:200]
            raise PolicyRefusedError(
                f"the policy's inputs and outputs: the contract needs {expected}, the graph has {given}"
            )
        self._binding = self._session.io_binding()
        # ONNX Runtime gets their addresses only: neither changes its size, and both live as long as this.
        for bind, name in ((self._binding.bind_input, INPUT_NAME), (self._binding.bind_output, OUTPUT_NAME)):
            bind(name, "cpu", 0, np.dtype(CODE), [1, len(ports[name])], ports[name].buffer_info()[0])

    def run(self) -> None:
        """Compute the outputs of the inputs; PolicyRefusedError if ONNX Runtime could not."""
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as err:  # ONNX Runtime's errors have no public base class
            raise PolicyRefusedError(f"ONNX Runtime could not evaluate the policy: {_first_line(err)}") from err


def open_session(data: bytes) -> ort.InferenceSession:
    """A graph in ONNX Runtime, from a file's bytes; PolicyRefusedError if it refuses it."""
    import onnxruntime as ort  # takes its time, and most commands need none

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.enable_mem_reuse = False  # planning it costs more than it saves at this size
    options.enable_cpu_mem_arena = False
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    # As onnx_file reads it: bytes can be ONNX there and yet bear the mark of ONNX Runtime's format.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4  # errors are raised
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as err:  # ONNX Runtime's errors have no public base class
        raise PolicyRefusedError(f"ONNX Runtime refuses the policy file: {_first_line(err)}") from err


def _first_line(err: Exception) -> str:
    """The reason in ONNX Runtime's message, behind the function in its source that found it."""
    line = re.sub(r"[^ -~]", " ", str(err).strip().split("\n")[0])
    return re.sub(r"/\S*\.(?:cc|h):\d+ .*?\) (?:\[\w+\] )?(?=\S)", "", line, count=1)[:600]


class Policy:
    """A policy that passed all checks; made by :func:`load_policy` only.

    Attributes:
        contract: what it computes, and what it was made for.
        data: the ONNX file as it was read, for the log.
        sha256: of :attr:`data`, in hexadecimal.
        warnings: differences of the bench from those that it was made for.
    """

    def __init__(self, data: bytes, contract: Contract, inference: Inference, bench: Bench) -> None:
        self.contract = contract
        self.data = data
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.warnings = contract.warnings(bench)
        self._inference = inference
        self._kind = contract.kind
        self._estimates = len(contract.inputs) > len(SAMPLE)
        self._sample_time = bench.timing.sample_time
        self._greatest = contract.greatest

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Current for the period that begins at a sample [A]; finite and within limits only if the caller checks it.

        The sample, ``step`` samples after the experiment began, is measured [rad, rad/s], and in the estimate.
        The speed loop cuts off every current at the limit. So a target speed that is not finite gives NaN, and one
        beyond the contract a current that is so many times beyond its limit. PolicyRefusedError if ONNX Runtime could
        not evaluate the graph.
        """
        numbers = estimator.parameters if self._estimates else ()
        self._inference.inputs[:] = array(CODE, (angle, velocity, step * self._sample_time, *numbers))
        self._inference.run()
        output = self._inference.outputs[0]
        if self._kind == "current":
            return output
        if not math.isfinite(output):
            return math.nan
        share = abs(output) / self._greatest
        if share > 1.0 + ROUNDING:
            return self.contract.limits.current * (share + ROUNDING)  # beyond the limit, however it is rounded
        return current_for(estimator.model, estimator.state, estimator.relative, output, self.contract.gain)


def load_policy(source: str | Path | bytes, bench: Bench) -> Policy:
    """Read and check a policy, by its path or its bytes, in this process: a shipped one, or one that was tried.

    A file of unknown origin goes through :func:`emb_runtime.policy.trial.admit_policy`.

    Raises:
        UsageError: the file cannot be read.
        PolicyRefusedError: it is damaged, not self-contained, has work that depends on what is measured, has another
            signature than the contract's, does not fit the bench, or does not reproduce its test vectors.
    """
    data = source if isinstance(source, bytes) else read_policy(Path(source))
    if len(data) > MAX_FILE_BYTES:
        raise PolicyRefusedError(f"the policy file is larger than {MAX_FILE_BYTES} bytes: not a policy of ours")
    graph = read_graph(data)
    texts = [value for key, value in graph.texts if key == CONTRACT_KEY]
    if len(texts) != 1:
        raise PolicyRefusedError(
            f"expected one '{CONTRACT_KEY}' in the ONNX metadata, got {len(texts)}: export it first, "
            "by emb-export FILE --output policy.onnx"
        )
    contract = read_contract(texts[0])
    if problem := contract.bench_problem(bench):
        raise PolicyRefusedError(f"the policy does not fit this bench: {problem}: narrow the bench, or make one for it")
    require_bounded(graph)
    inference = Inference(data, contract)
    if difference := _difference(inference, contract):
        raise PolicyRefusedError(
            f"test vector {difference}: the file is damaged or this ONNX Runtime computes something else; export it "
            "again"
        )
    return Policy(data, contract, inference, bench)


def _difference(inference: Inference, contract: Contract) -> str:
    """First test vector that is not reproduced; "" if all are.

    The tolerance is a part of the output's limit, which a contract cannot widen beyond all currents or speeds.
    """
    largest = min(contract.greatest, CEILING_CURRENT if contract.kind == "current" else CEILING_VELOCITY)
    for index, vector in enumerate(contract.vectors):
        inference.inputs[:] = array(CODE, vector.inputs)
        inference.run()
        expected, got = vector.outputs[0], inference.outputs[0]
        if not abs(expected - got) <= VECTOR_TOLERANCE * largest:  # this way round, NaN differs
            return f"{index}: the output should be {expected:.7g} and is {got:.7g}"
    return ""


def read_policy(path: Path) -> bytes:
    """Bytes of a policy file, one more than are allowed at most; UsageError if it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read(MAX_FILE_BYTES + 1)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the policy file: {err.strerror}") from err
