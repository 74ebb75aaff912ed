"""A graph in ONNX Runtime, with its inputs and outputs held against the contract, and with its memory.

All arrays are made once, and ONNX Runtime reads and writes them in place. What the graph remembers is carried here from
one sample to the next, and looked at: a state or an estimate that is not finite is told at the sample at which it
became so, and not when it has found its way into a current.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import Contract

INPUT_NAME = "obs"
OUTPUT_NAME = "action"
STATE_NAME = "state"
NEXT_STATE_NAME = "next_state"
ESTIMATE_NAME = "estimate"

if TYPE_CHECKING:
    import onnxruntime as ort

_SINGLE, _DOUBLE = "tensor(float)", "tensor(double)"
_CODES = {_SINGLE: "f", _DOUBLE: "d"}


class Port(NamedTuple):
    """An input or an output of a graph; its shape is [1, width]."""

    name: str
    type: str  # Type name of ONNX Runtime
    width: int

    def __str__(self) -> str:
        return f"'{self.name}' {self.type} [1, {self.width}]"


def ports(contract: Contract) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Inputs and outputs that the graph of a contract has."""
    size, count = len(contract.initial_state), len(contract.estimates)
    inputs = [Port(INPUT_NAME, _SINGLE, len(contract.observation))]
    outputs = [Port(OUTPUT_NAME, _SINGLE, 1)]
    if size:  # double precision: the information of a running estimator grows beyond what single precision resolves
        inputs.append(Port(STATE_NAME, _DOUBLE, size))
        outputs.append(Port(NEXT_STATE_NAME, _DOUBLE, size))
    if count:
        outputs.append(Port(ESTIMATE_NAME, _SINGLE, 2 * count))
    return tuple(inputs), tuple(outputs)


class Inference:
    """One actor in ONNX Runtime; one thread, no spinning.

    Args:
        data: the ONNX file, which needs no other.
        contract: what its inputs and outputs must be.

    Raises:
        PolicyRefusedError: ONNX Runtime refuses it, or it has other inputs or outputs.
    """

    estimate: tuple[float, ...] = ()
    """The latest estimate: values, then standard deviations, in the contract's order; empty before the first."""

    def __init__(self, data: bytes, contract: Contract) -> None:
        session = open_session(data)
        inputs, outputs = ports(contract)
        _require_ports("input", session.get_inputs(), inputs)
        _require_ports("output", session.get_outputs(), outputs)
        self._session = session
        self._binding = session.io_binding()
        # ONNX Runtime gets their addresses only: none of them may change its size, and they live as long as this.
        numbers = {port.name: array(_CODES[port.type], [0.0] * port.width) for port in (*inputs, *outputs)}
        for some, bind in ((inputs, self._binding.bind_input), (outputs, self._binding.bind_output)):
            for port in some:
                address, _ = numbers[port.name].buffer_info()
                bind(port.name, "cpu", 0, np.dtype(_CODES[port.type]), [1, port.width], address)
        self._seen, self._said = numbers[INPUT_NAME], numbers[OUTPUT_NAME]
        self._sees_current = len(self._seen) > 3
        nothing = array("d")
        self._state, self._next_state = numbers.get(STATE_NAME, nothing), numbers.get(NEXT_STATE_NAME, nothing)
        self._initial = array("d", contract.initial_state)
        self._estimate = numbers.get(ESTIMATE_NAME, nothing)
        self.begin()

    @property
    def state(self) -> tuple[float, ...]:
        """State between samples."""
        return tuple(self._state)

    def begin(self) -> None:
        """Forget what was seen: the next sample is the first one."""
        self.estimate = ()
        self._state[:] = self._initial

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """See :meth:`emb_runtime.policy.policy.Policy.act`."""
        seen = self._seen
        seen[0], seen[1], seen[2] = angle, velocity, step
        if self._sees_current:
            seen[3] = applied_current
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as err:  # ONNX Runtime's errors have no public base class
            raise PolicyRefusedError(f"ONNX Runtime could not evaluate the policy: {_first_line(err)}") from err
        if self._state:
            require_finite(self._next_state, step)
            self._state[:] = self._next_state
        if self._estimate:
            self.estimate = believable(tuple(self._estimate), step)
        return self._said[0]


def require_finite(state: Sequence[float], step: float) -> None:
    """Check what is to be remembered.

    Raises:
        PolicyRefusedError: a number is not finite.
    """
    if not all(map(math.isfinite, state)):
        raise PolicyRefusedError(f"the policy's state is not finite after step {step:g}")


def believable(estimate: tuple[float, ...], step: float) -> tuple[float, ...]:
    """An estimate that is one.

    Raises:
        PolicyRefusedError: a number is not finite, or a standard deviation is negative.
    """
    if not all(map(math.isfinite, estimate)) or min(estimate[len(estimate) // 2 :]) < 0.0:
        told = ", ".join(f"{number:g}" for number in estimate)
        raise PolicyRefusedError(f"the policy's estimate is none after step {step:g}: {told}")
    return estimate


def open_session(data: bytes) -> ort.InferenceSession:
    """A graph in ONNX Runtime, from a file's bytes: one thread, no spinning.

    Raises:
        PolicyRefusedError: ONNX Runtime refuses it.
    """
    import onnxruntime as ort  # takes its time, and only a policy that it evaluates needs it

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # An actor has a hundred results of a few numbers each: to plan which memory to use twice costs a tenth of its time.
    options.enable_mem_reuse = False
    options.enable_cpu_mem_arena = False
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    # As onnx_file reads it: bytes can be ONNX there and yet bear the mark of ONNX Runtime's own format.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4  # what goes wrong is raised, and said once
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as err:  # ONNX Runtime's errors have no public base class
        raise PolicyRefusedError(f"ONNX Runtime refuses the policy file: {_first_line(err)}") from err


def _require_ports(kind: str, found: list[Any], wanted: tuple[Port, ...]) -> None:
    """In whatever order: they are bound by their names."""
    got = sorted((port.name, port.type, port.shape) for port in found)
    if got != sorted((port.name, port.type, [1, port.width]) for port in wanted):
        said = re.sub(r"[^ -~]", "?", ", ".join(f"'{n}' {t} {s}" for n, t, s in got))[:200] or "none"
        needed = ", ".join(map(str, wanted))
        raise PolicyRefusedError(f"the policy's {kind}s: the contract needs {needed}, the graph has {said}")


def _first_line(err: Exception) -> str:
    return re.sub(r"[^ -~]", " ", str(err).strip().split("\n")[0])[:300]
