"""The operators that an actor may be made of: those whose work is the same for every sample.

The shape of each result follows from the shapes of the inputs and from numbers in the file, never from what is measured
or remembered; and so does the number of steps of a GRU, LSTM or RNN. So the work of a graph is what it was when its
test vectors were replayed: there is no observation at which it loops, or an array grows. How long that work takes is
not decided here; that is measured, and watched.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.onnx_file import Graph, Node


def _of(names: str, inputs: slice) -> dict[str, slice]:
    return dict.fromkeys(names.split(), inputs)


NONE = slice(0, 0)

FIXED: Mapping[str, slice] = MappingProxyType(
    # One number of the result from one number of each input, which are stretched to one shape.
    _of("Abs Acos Acosh Add And Asin Asinh Atan Atanh Cast CastLike Ceil Celu Clip Cos Cosh Div Elu Equal Erf", NONE)
    | _of("Exp Floor Gelu Greater GreaterOrEqual HardSigmoid HardSwish Identity IsInf IsNaN LeakyRelu Less", NONE)
    | _of("LessOrEqual Log Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow Reciprocal Relu Round Selu Sigmoid", NONE)
    | _of("Sign Sin Sinh Softplus Softsign Sqrt Sub Sum Tan Tanh ThresholdedRelu Where Xor", NONE)
    # Others whose result has a shape that follows from those of the inputs.
    | _of("ArgMax ArgMin Concat Constant Einsum EyeLike Flatten Gather GatherElements GatherND Gemm", NONE)
    | _of("LayerNormalization LogSoftmax MatMul ScatterElements ScatterND Shape Size Softmax Transpose", NONE)
    # What is told how many steps of its input to take.
    | _of("GRU LSTM RNN", slice(4, 5))
    # What is told a size, an axis or a place.
    | _of("CumSum Expand Pad Reshape Slice Split Squeeze Tile TopK Trilu Unsqueeze", slice(1, None))
    | _of("ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd", slice(1, None))
    | _of("ReduceSum ReduceSumSquare", slice(1, None))
    | _of("ConstantOfShape Range", slice(0, None))
)
"""By operator: which of its inputs must be numbers in the file."""


def require_bounded(graph: Graph) -> None:
    """Check that the graph's work does not depend on what it is given.

    Raises:
        PolicyRefusedError: it has another operator, or one that takes a size from a computation; the message names it.
    """
    computed = {name for node in graph.nodes if node.operator != "Constant" for name in node.outputs}
    fixed = graph.tensors.keys() - computed
    for node in graph.nodes:
        inputs = FIXED.get(node.operator)
        if inputs is None:
            raise PolicyRefusedError(
                f"the policy has the operator {_printable(node)}, which is none of those whose work is known to be the "
                "same for every sample: make it of others"
            )
        if _unknown(node.inputs[inputs], fixed):
            raise PolicyRefusedError(
                f"the policy's operator {node.operator} takes a size, a place or a number of steps from a computation, "
                "so its work could grow with what is measured: make that a constant of the file"
            )


def _unknown(names: Iterable[str], fixed: set[str]) -> bool:
    """Returns True if one of these inputs is computed; an empty name is an input that is left out."""
    return any(name and name not in fixed for name in names)


def _printable(node: Node) -> str:
    return "'" + re.sub(r"[^!-~]", "?", node.operator)[:60] + "'"
