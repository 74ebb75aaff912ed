"""A policy's graph in ONNX Runtime: one thread, no spinning, arrays that it reads and writes in place."""

from __future__ import annotations

import re
from array import array
from typing import TYPE_CHECKING

import numpy as np

from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import Contract

if TYPE_CHECKING:
    import onnxruntime as ort

INPUT_NAME = "inputs"
OUTPUT_NAME = "outputs"
CODE = "f"  # Of single precision


class Inference:
    """A graph of an ONNX file, with the input and the output that its contract has; else PolicyRefusedError."""

    def __init__(self, data: bytes, contract: Contract) -> None:
        self._session = open_session(data)
        self.inputs = array(CODE, contract.vectors[0].inputs)
        self.outputs = array(CODE, contract.vectors[0].outputs)
        ports = {INPUT_NAME: self.inputs, OUTPUT_NAME: self.outputs}
        wanted = [(name, "tensor(float)", [1, len(numbers)]) for name, numbers in ports.items()]
        found = [(port.name, port.type, port.shape) for port in self._session.get_inputs()]
        found += [(port.name, port.type, port.shape) for port in self._session.get_outputs()]
        if found != wanted:
            given = re.sub(r"[^ -~]", "?", str(found))[:200]
            raise PolicyRefusedError(
                f"the policy's inputs and outputs: the contract needs {wanted}, the graph has {given}"
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
    # As onnx_file reads it: bytes can be ONNX there and yet bear the mark of ONNX Runtime's own format.
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
