"""Shapes of all results of a graph, and the work of one evaluation, found without computing anything.

A few bytes of a file can ask for gigabytes, or for hours. Every shape follows from those of the inputs and from numbers
in the file (:mod:`emb_runtime.policy.operators`), so how much there is to compute is known before ONNX Runtime sees it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.onnx_file import Graph, Node, Tensor

Shape = tuple[int, ...]

MAX_RESULT = 1 << 20  # Numbers in one result; the weights of the largest file are as many
MAX_RESULTS = 1 << 21  # Numbers in all results together
MAX_WORK = 1 << 24
"""Numbers read and written, and multiplications, in one evaluation: many times what fits into a sample time."""
WORK_PER_INPUT = 64  # By which every input of a node counts besides: to find it takes longer than to read a number


def require_bounded_work(graph: Graph) -> None:
    """Check that one evaluation of a graph takes little memory and time.

    Raises:
        PolicyRefusedError: it takes too much, or the inputs of a node do not fit together; the message names it.
    """
    known = {name: tensor.shape for name, tensor in graph.tensors.items()} | dict(graph.inputs)
    results = work = 0
    for node in graph.nodes:
        if any(name and name not in known for name in node.inputs):
            raise PolicyRefusedError(f"the policy's operator {node.operator} takes what nothing before it makes")
        call = _call(node, known, graph)
        shapes = call.results()
        made = [math.prod(shape) for shape in shapes]
        if max(made, default=0) > MAX_RESULT:
            raise PolicyRefusedError(
                f"the policy's operator {node.operator} makes {max(made):.3g} numbers, more than {MAX_RESULT}: "
                "not an actor of ours"
            )
        results += sum(made)
        work += sum(made) + sum(math.prod(shape) for shape in call.shapes if shape is not None) + call.products
        work += WORK_PER_INPUT * len(call.shapes)
        if results > MAX_RESULTS or work > MAX_WORK:
            raise PolicyRefusedError(
                f"one evaluation of the policy makes more than {MAX_RESULTS} numbers, or takes more than {MAX_WORK} "
                "operations: not an actor of ours"
            )
        known |= zip(node.outputs, shapes, strict=False)


def result_shapes(node: Node, known: Mapping[str, Shape], graph: Graph) -> list[Shape]:
    """Shapes of the results of a node.

    Args:
        node: of the graph.
        known: shapes of its inputs, by name.
        graph: has the numbers that stand in the file.

    Raises:
        PolicyRefusedError: its inputs do not fit together.
    """
    return _call(node, known, graph).results()


@dataclass
class _Call:
    """A node with what is known of its inputs."""

    node: Node
    shapes: Sequence[Shape | None]  # Of its inputs; None of one that is left out
    tensors: Mapping[str, Tensor]  # Those in the file, and the graph's constants
    products: int = field(default=0, init=False)
    """Multiplications besides one for each number of the inputs and the result."""

    def results(self) -> list[Shape]:
        """Shapes of the results."""
        try:
            return _RULES[self.node.operator](self)
        except (ValueError, IndexError, KeyError, TypeError, OverflowError, ZeroDivisionError) as err:
            raise PolicyRefusedError(
                f"the policy's operator {self.node.operator} does not fit its inputs: the file is damaged"
            ) from err

    @property
    def first(self) -> Shape:
        """Shape of the first input."""
        return self.shape(0)

    @property
    def outputs(self) -> int:
        """Count of the results."""
        return len(self.node.outputs)

    def shape(self, index: int) -> Shape:
        """Shape of an input that must be there."""
        shape = self.shapes[index]
        if shape is None:
            raise ValueError
        return shape

    def number(self, name: str, default: int) -> int:
        """An attribute."""
        return int(self.node.attributes.get(name, default))

    def told(self, index: int, name: str = "") -> tuple[float, ...] | None:
        """Numbers of an input, or of the attribute that had its place in earlier versions; None if there are none."""
        if index < len(self.node.inputs) and (source := self.node.inputs[index]):
            found = self.tensors[source].values
            if found is None:
                raise ValueError
            return found
        return self.node.lists.get(name)

    def sizes(self, index: int, name: str = "") -> list[int]:
        """Whole numbers of an input or an attribute, which must be there; see :meth:`told`."""
        found = self.told(index, name)
        if found is None:
            raise ValueError
        return [int(n) for n in found]

    def axes(self, index: int, rank: int) -> list[int]:
        """Axes counted from the front; all of them where none are told."""
        found = self.told(index, "axes")
        return [*range(rank)] if not found else [_axis(int(a), rank) for a in found]


def _call(node: Node, known: Mapping[str, Shape], graph: Graph) -> _Call:
    return _Call(node, [known[name] if name else None for name in node.inputs], graph.tensors)


def _axis(axis: int, rank: int) -> int:
    if not -rank <= axis < rank:
        raise IndexError
    return axis % rank


def _view(shape: Shape) -> NDArray[np.uint8]:
    """An array of a shape, which takes no memory."""
    return np.broadcast_to(np.uint8(0), shape)


def _broadcast(call: _Call) -> list[Shape]:
    return [np.broadcast_shapes(*(shape for shape in call.shapes if shape is not None))] * call.outputs


def _like_first(call: _Call) -> list[Shape]:
    return [call.first] * call.outputs


def _reduced(call: _Call) -> list[Shape]:
    rank = len(call.first)
    if call.number("noop_with_empty_axes", 0) and not call.told(1, "axes"):
        return [call.first]
    axes = call.axes(1, rank)
    return [_without(call.first, axes, call.number("keepdims", 1))]


def _without(shape: Shape, axes: Sequence[int], keep: int) -> Shape:
    return tuple(1 if k in axes else n for k, n in enumerate(shape) if keep or k not in axes)


def _arg(call: _Call) -> list[Shape]:
    return [_without(call.first, [_axis(call.number("axis", 0), len(call.first))], call.number("keepdims", 1))]


def _concat(call: _Call) -> list[Shape]:
    axis = _axis(call.number("axis", 1), len(call.first))
    shapes = [shape for shape in call.shapes if shape is not None]
    if any(s[:axis] + s[axis + 1 :] != call.first[:axis] + call.first[axis + 1 :] for s in shapes):
        raise ValueError
    return [(*call.first[:axis], sum(s[axis] for s in shapes), *call.first[axis + 1 :])]


def _constant(call: _Call) -> list[Shape]:
    if call.node.value is None:
        raise ValueError
    return [call.node.value.shape]


def _constant_of_shape(call: _Call) -> list[Shape]:
    return [_positive(call.sizes(0))]


def _positive(sizes: Sequence[int]) -> Shape:
    if min(sizes, default=0) < 0:
        raise ValueError
    return tuple(sizes)


def _einsum(call: _Call) -> list[Shape]:
    equation = call.node.texts["equation"].replace(" ", "")
    left, arrow, right = equation.partition("->")
    size: dict[str, int] = {}
    terms = []
    for term, shape in zip(left.split(","), (call.shape(k) for k in range(len(call.shapes))), strict=True):
        named = _labels(term, len(shape))
        for label, n in zip(named, shape, strict=True):
            size[label] = max(size.get(label, 1), n)
        terms.append(named)
    every = [label for named in terms for label in named]
    # Of an ellipsis the axes are numbered from the last one; they come first in the result.
    rest = sorted((label for label in size if len(label) > 1), key=lambda label: -int(label[1:]))
    if not arrow:
        result = rest + sorted(label for label in size if len(label) == 1 and every.count(label) == 1)
    else:
        before, dots, after = right.partition("...")
        result = [*before, *(rest if dots else ()), *after]
    call.products = math.prod(size.values())
    if call.products > MAX_WORK:  # results between are as large as that, at most
        raise PolicyRefusedError(
            f"the policy's operator Einsum takes {call.products:.3g} operations, more than {MAX_WORK}: "
            "not an actor of ours"
        )
    return [tuple(size[label] for label in result)]


def _labels(term: str, rank: int) -> list[str]:
    before, dots, after = term.partition("...")
    hidden = rank - len(before) - len(after) if dots else 0
    return [*before, *(f".{k}" for k in reversed(range(hidden))), *after]


def _expand(call: _Call) -> list[Shape]:
    return [np.broadcast_shapes(call.first, _positive(call.sizes(1)))]


def _flatten(call: _Call) -> list[Shape]:
    axis = call.number("axis", 1)
    axis += len(call.first) if axis < 0 else 0
    return [(math.prod(call.first[:axis]), math.prod(call.first[axis:]))]


def _gather(call: _Call) -> list[Shape]:
    axis = _axis(call.number("axis", 0), len(call.first))
    return [(*call.first[:axis], *call.shape(1), *call.first[axis + 1 :])]


def _gather_nd(call: _Call) -> list[Shape]:
    *places, depth = call.shape(1)
    return [(*places, *call.first[call.number("batch_dims", 0) + depth :])]


def _gemm(call: _Call) -> list[Shape]:
    (rows, inner), (depth, columns) = (
        call.shape(k)[::-1] if call.number(name, 0) else call.shape(k) for k, name in enumerate(("transA", "transB"))
    )
    return _product(call, (rows, inner), (depth, columns))


def _matmul(call: _Call) -> list[Shape]:
    left, right = call.first, call.shape(1)
    (result,) = _product(call, (1, *left) if len(left) == 1 else left, (*right, 1) if len(right) == 1 else right)
    result = result[:-2] + result[-1:] if len(left) == 1 else result
    return [result[:-1] if len(right) == 1 else result]


def _product(call: _Call, left: Shape, right: Shape) -> list[Shape]:
    if left[-1] != right[-2]:
        raise ValueError
    result = (*np.broadcast_shapes(left[:-2], right[:-2]), left[-2], right[-1])
    call.products = math.prod(result) * left[-1]
    return [result]


def _pad(call: _Call) -> list[Shape]:
    pads, rank = call.sizes(1, "pads"), len(call.first)
    axes = call.axes(3, rank)
    if len(pads) != 2 * len(axes):
        raise ValueError
    sizes = list(call.first)
    for k, axis in enumerate(axes):
        sizes[axis] += pads[k] + pads[k + len(axes)]
    return [_positive(sizes)]


def _range(call: _Call) -> list[Shape]:
    ((start,), (limit,), (delta,)) = (call.told(k) or () for k in range(3))
    return [(max(0, math.ceil((limit - start) / delta)),)]


def _recurrent(call: _Call) -> list[Shape]:
    weights, size = call.shape(1), call.number("hidden_size", 0) or call.shape(2)[-1]
    by_batch = call.number("layout", 0)
    steps, batch, width = call.first if not by_batch else (call.first[1], call.first[0], call.first[2])
    directions = weights[0]
    call.products = steps * batch * directions * weights[1] * (width + size)
    every = (batch, steps, directions, size) if by_batch else (steps, directions, batch, size)
    last = (batch, directions, size) if by_batch else (directions, batch, size)
    return [every, last, last][: call.outputs]


def _reshape(call: _Call) -> list[Shape]:
    sizes, total = call.sizes(1, "shape"), math.prod(call.first)
    if not call.number("allowzero", 0):
        sizes = [call.first[k] if n == 0 else n for k, n in enumerate(sizes)]
    if -1 in sizes:
        k = sizes.index(-1)
        sizes[k] = total // math.prod(n for n in sizes if n != -1)
    if math.prod(sizes) != total:
        raise ValueError
    return [_positive(sizes)]


def _shape(call: _Call) -> list[Shape]:
    end = call.node.attributes.get("end")
    return [(len(call.first[call.number("start", 0) : None if end is None else int(end)]),)]


def _slice(call: _Call) -> list[Shape]:
    starts, ends = call.sizes(1, "starts"), call.sizes(2, "ends")
    axes = call.told(3, "axes") or range(len(starts))
    steps = call.told(4) or [1] * len(starts)
    cut = [slice(None)] * len(call.first)
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        cut[_axis(int(axis), len(cut))] = slice(start, end, int(step))
    return [_view(call.first)[tuple(cut)].shape]


def _split(call: _Call) -> list[Shape]:
    axis = _axis(call.number("axis", 0), len(call.first))
    whole, count = call.first[axis], call.outputs
    told = call.told(1, "split")
    each = math.ceil(whole / count)
    borders = [min(whole, k * each) for k in range(count + 1)]
    sizes = [int(n) for n in told] if told else [b - a for a, b in pairwise(borders)]
    if sum(sizes) != whole:
        raise ValueError
    return [(*call.first[:axis], n, *call.first[axis + 1 :]) for n in _positive(sizes)]


def _squeeze(call: _Call) -> list[Shape]:
    found, rank = call.told(1, "axes"), len(call.first)
    axes = [k for k, n in enumerate(call.first) if n == 1] if not found else [_axis(int(a), rank) for a in found]
    return [_view(call.first).squeeze(tuple(axes)).shape]


def _tile(call: _Call) -> list[Shape]:
    return [_positive([n * r for n, r in zip(call.first, call.sizes(1), strict=True)])]


def _top_k(call: _Call) -> list[Shape]:
    axis = _axis(call.number("axis", -1), len(call.first))
    (count,) = call.told(1) or (call.number("k", 0),)
    return [(*call.first[:axis], int(count), *call.first[axis + 1 :])] * call.outputs


def _transpose(call: _Call) -> list[Shape]:
    return [_view(call.first).transpose(call.node.lists.get("perm")).shape]


def _unsqueeze(call: _Call) -> list[Shape]:
    axes = call.sizes(1, "axes")
    return [np.expand_dims(_view(call.first), tuple(axes)).shape]


Rule = Callable[[_Call], list[Shape]]


def _of(names: str, rule: Rule) -> dict[str, Rule]:
    return dict.fromkeys(names.split(), rule)


_RULES: Mapping[str, Rule] = (
    _of("Abs Acos Acosh Add And Asin Asinh Atan Atanh Cast Ceil Celu Clip Cos Cosh Div Elu Equal Erf Exp", _broadcast)
    | _of("Floor Gelu Greater GreaterOrEqual HardSigmoid HardSwish Identity IsInf IsNaN LeakyRelu Less", _broadcast)
    | _of("LessOrEqual Log Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow Reciprocal Relu Round Selu", _broadcast)
    | _of("Sigmoid Sign Sin Sinh Softplus Softsign Sqrt Sub Sum Tan Tanh ThresholdedRelu Where Xor", _broadcast)
    | _of("CastLike CumSum EyeLike LayerNormalization LogSoftmax ScatterElements ScatterND Softmax Trilu", _like_first)
    | _of("ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd", _reduced)
    | _of("ReduceSum ReduceSumSquare", _reduced)
    | _of("ArgMax ArgMin", _arg)
    | _of("GRU LSTM RNN", _recurrent)
    | {
        "Concat": _concat,
        "Constant": _constant,
        "ConstantOfShape": _constant_of_shape,
        "Einsum": _einsum,
        "Expand": _expand,
        "Flatten": _flatten,
        "Gather": _gather,
        "GatherElements": lambda call: [call.shape(1)],
        "GatherND": _gather_nd,
        "Gemm": _gemm,
        "MatMul": _matmul,
        "Pad": _pad,
        "Range": _range,
        "Reshape": _reshape,
        "Shape": _shape,
        "Size": lambda _: [()],
        "Slice": _slice,
        "Split": _split,
        "Squeeze": _squeeze,
        "Tile": _tile,
        "TopK": _top_k,
        "Transpose": _transpose,
        "Unsqueeze": _unsqueeze,
    }
)
"""By operator: the shapes of its results. :data:`emb_runtime.policy.operators.FIXED` has the same operators."""
