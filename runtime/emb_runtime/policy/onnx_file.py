"""Reading of an ONNX file by the runtime itself, before ONNX Runtime sees it.

The ``onnx`` package is not part of the base install, and needs more than what stands here. A policy may be made of
operators whose work is the same for every sample: the shape of each result follows from the shapes of the inputs and
from numbers in the file, never from what is measured. So the work of a graph is what it was when its test vectors were
replayed: there are no inputs for which it loops, or an array grows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources
from types import MappingProxyType
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from emb_runtime.errors import PolicyRefusedError

MAX_PARTS = 10_000
"""Nodes, attributes, tensors and texts, each. A policy has tens; an empty node takes two bytes of a file and a
thousand times as much to read and judge."""


class Node(NamedTuple):
    """One operation of a graph."""

    operator: str  # Its type, of the default domain; with the domain in front if it is of another
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class Graph(NamedTuple):
    """A graph without control flow and functions that needs no other file."""

    nodes: tuple[Node, ...]  # Each after those whose outputs it takes
    tensors: frozenset[str]  # Names of the numbers in the file: tensors, and the results of Constant nodes
    texts: tuple[tuple[str, str], ...]  # The file's metadata


def read_graph(data: bytes) -> Graph:
    """Read an ONNX file of unknown origin.

    Given bytes with external data, ONNX Runtime would open files beside the working directory; given a Loop, it could
    run for ever; given functions that call functions, it would write out each call. None of that is let through.

    Raises:
        PolicyRefusedError: not ONNX, too large, not self-contained, with control flow, or with functions.
    """
    model = _MODEL()
    try:
        model.ParseFromString(data)
        if not model.HasField("graph"):
            raise PolicyRefusedError("the policy file is not ONNX: it has no graph")
        graph = model.graph
        parts = max(
            len(graph.node),
            sum(len(node.attribute) for node in graph.node),
            len(graph.initializer),
            len(model.metadata_props),
        )
        if parts > MAX_PARTS:
            raise PolicyRefusedError(
                f"the policy has {parts} nodes, attributes or tensors, expected at most {MAX_PARTS}: not a policy of "
                "ours"
            )
        _require_plain(model)
        nodes = tuple(_node(node) for node in graph.node)
        constants = (name for node in nodes if node.operator == "Constant" for name in node.outputs)
        return Graph(
            nodes=nodes,
            tensors=frozenset((*(tensor.name for tensor in graph.initializer), *constants)),
            texts=tuple((entry.key, entry.value) for entry in model.metadata_props),
        )
    except (DecodeError, UnicodeDecodeError) as err:
        raise PolicyRefusedError("the policy file is not ONNX, or cut short") from err


def _require_plain(model: Any) -> None:
    """Refuse what no policy needs: graphs inside nodes, functions, sparse tensors, lists of tensors, other files."""
    attributes = [attribute for node in model.graph.node for attribute in node.attribute]
    if any(a.HasField("g") or a.graphs for a in attributes):
        raise PolicyRefusedError("the policy has control flow (a graph inside a node): its run time has no bound")
    if model.functions:
        raise PolicyRefusedError("the policy has functions: export it with what they do in their place")
    if model.graph.sparse_initializer or any(a.HasField("sparse_tensor") or a.sparse_tensors for a in attributes):
        raise PolicyRefusedError("the policy has sparse tensors: export it with dense ones")
    if any(a.tensors for a in attributes):
        raise PolicyRefusedError("the policy has a list of tensors inside a node: export it with one tensor each")
    if any(t.external_data or t.data_location for t in (*model.graph.initializer, *(a.t for a in attributes))):
        raise PolicyRefusedError("the policy keeps data in another file: export it as one file")


def _node(node: Any) -> Node:
    return Node(
        operator=node.op_type if node.domain in ("", "ai.onnx") else f"{node.domain}.{node.op_type}",  # one domain
        inputs=tuple(node.input),
        outputs=tuple(node.output),
    )


_PART = resources.files("emb_runtime.policy").joinpath("onnx_part.binpb").read_bytes()
_POOL = descriptor_pool.DescriptorPool()
_POOL.Add(descriptor_pb2.FileDescriptorSet.FromString(_PART).file[0])
_MODEL: Any = message_factory.GetMessageClass(_POOL.FindMessageTypeByName("emb_onnx_part.Model"))


_NO_NUMBERS = """
    Abs Acos Acosh Add And Asin Asinh Atan Atanh Cast Ceil Celu Clip Concat Constant Cos Cosh Div Elu Equal Erf Exp
    Flatten Floor Gather Gelu Gemm Greater GreaterOrEqual HardSigmoid HardSwish Identity IsInf IsNaN LayerNormalization
    LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max Mean Min Mish Mul Neg Not Or PRelu Pow Reciprocal Relu Round
    Selu Shrink Sigmoid Sign Sin Sinh Softmax Softplus Softsign Sqrt Sub Sum Swish Tan Tanh ThresholdedRelu Transpose
    Where Xor
"""
_NUMBERS = """
    Expand ReduceL1 ReduceL2 ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare
    Reshape Slice Split Squeeze Unsqueeze
"""
FIXED: Mapping[str, slice] = MappingProxyType(
    dict.fromkeys(_NO_NUMBERS.split(), slice(0, 0)) | dict.fromkeys(_NUMBERS.split(), slice(1, None))
)
"""By operator: which of its inputs must be numbers in the file: none, or all but the first."""


def require_bounded(graph: Graph) -> None:
    """Check that the graph's work does not depend on what it is given.

    PolicyRefusedError names another operator, or one that takes a size from a computation.
    """
    fixed = graph.tensors - {name for node in graph.nodes if node.operator != "Constant" for name in node.outputs}
    for node in graph.nodes:
        inputs = FIXED.get(node.operator)
        if inputs is None:
            operator = re.sub(r"[^!-~]", "?", node.operator)[:60]
            raise PolicyRefusedError(
                f"the policy has the operator '{operator}', which is none of those whose work is the same for "
                "every sample: make it of others"
            )
        if any(name and name not in fixed for name in node.inputs[inputs]):  # an empty name is a missing input
            raise PolicyRefusedError(
                f"the policy's operator {node.operator} takes a size or a place from a computation, "
                "so its work could grow with what is measured: make that a constant of the file"
            )
