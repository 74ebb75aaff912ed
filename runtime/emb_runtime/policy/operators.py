"""The operators that a policy may be made of: those whose work is the same for every sample.

The shape of each result follows from the shapes of the inputs and from numbers in the file, never from what is
measured. So the work of a graph is what it was when its test vectors were replayed: there are no inputs for which it
loops, or an array grows. How long that work takes is measured and watched elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.onnx_file import Graph, Node


def _of(names: str, inputs: slice) -> dict[str, slice]:
    return dict.fromkeys(names.split(), inputs)


FIXED: Mapping[str, slice] = MappingProxyType(
    _of("Abs Add And Cast Clip Concat Constant Cos Div Elu Equal Erf Exp Gather Gelu Gemm Greater", slice(0, 0))
    | _of("GreaterOrEqual Identity LayerNormalization LeakyRelu Less LessOrEqual Log MatMul Max Min", slice(0, 0))
    | _of("Mul Neg Not Or Pow Reciprocal Relu Round Selu Sigmoid Sign Sin Softmax Softplus Softsign", slice(0, 0))
    | _of("Sqrt Sub Tanh Transpose Where", slice(0, 0))
    | _of("Expand ReduceMax ReduceMean ReduceMin ReduceSum Reshape Slice Split Squeeze Unsqueeze", slice(1, None))
)
"""By operator: which of its inputs must be numbers in the file: none, or all but the first."""


def require_bounded(graph: Graph) -> None:
    """Check that the graph's work does not depend on what it is given.

    Raises:
        PolicyRefusedError: it has another operator, or one that takes a size from a computation; the message names it.
    """
    fixed = graph.tensors - {name for node in graph.nodes if node.operator != "Constant" for name in node.outputs}
    for node in graph.nodes:
        inputs = FIXED.get(node.operator)
        if inputs is None:
            raise PolicyRefusedError(
                f"the policy has the operator {_printable(node)}, which is none of those whose work is known to be the "
                "same for every sample: make it of others"
            )
        if _unknown(node.inputs[inputs], fixed):
            raise PolicyRefusedError(
                f"the policy's operator {node.operator} takes a size or a place from a computation, "
                "so its work could grow with what is measured: make that a constant of the file"
            )


def _unknown(names: Iterable[str], fixed: frozenset[str]) -> bool:
    """Returns True if one of these inputs is computed; an empty name is an input that is left out."""
    return any(name and name not in fixed for name in names)


def _printable(node: Node) -> str:
    return "'" + re.sub(r"[^!-~]", "?", node.operator)[:60] + "'"
