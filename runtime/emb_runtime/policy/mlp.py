"""A trained network as a handful of numpy calls: for the control loop, where ONNX Runtime costs more than its sums.

One evaluation through ONNX Runtime reads the clock four times and touches far more memory than the weights; with caches
that others have used meanwhile it takes three times as long as this. What is built here is no second truth: the caller
holds it against ONNX Runtime before it is used, and where a graph has anything that is not known here, there is none.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from emb_runtime.policy.onnx_file import Floats, Graph, Node

INPUTS = 3  # Numbers in an observation
MOST_WEIGHTS = 9216  # Of one layer. OpenBLAS computes larger ones on several threads, which the loop must not wait for.
LARGEST_NUMBER = 1e6  # Of a constant: nothing overflows, so numpy has nothing to warn of

_GEMM = {"alpha": 1.0, "beta": 1.0, "transA": 0}


class _UnknownError(Exception):
    """Something in the graph that is not known here."""


class _Line(NamedTuple):
    """y = slope · x + offset."""

    slope: float = 1.0
    offset: float = 0.0

    def then(self, operator: str, constant: float) -> _Line:
        """Returns the line after one more operation."""
        slope, offset = self
        match operator:
            case "Add":
                return _Line(slope, offset + constant)
            case "Sub":
                return _Line(slope, offset - constant)
            case "Mul":
                return _Line(slope * constant, offset * constant)
            case "Div" if abs(constant) >= 1.0 / LARGEST_NUMBER:
                return _Line(slope / constant, offset / constant)
            case _:
                raise _UnknownError


class Network:
    """Three numbers in, layers with tanh between them, one number out; made by :func:`network`."""

    state: tuple[float, ...] = ()  # It remembers nothing,
    estimate: tuple[float, ...] = ()  # and estimates nothing

    def __init__(
        self, lines: Sequence[_Line], layers: Sequence[Floats], low: float, high: float, answer: _Line
    ) -> None:
        """Set up the calls.

        Args:
            lines: what happens to each input first.
            layers: weights of each layer, shape [outputs, inputs + 1]; the last column is the bias.
            low: least value of the last layer's output.
            high: greatest value.
            answer: what happens to it then.
        """
        first, *others = layers
        # The inputs are written through an array of Python's, which costs less than numpy's own items.
        self._row = array("f", [1.0] * first.shape[1])
        row = np.frombuffer(self._row, np.float32)
        self._lines = tuple(tuple(line) for line in lines)
        self._limits, self._answer = (low, high), answer
        calls: list[Callable[[], Any]] = []
        x: Floats = row
        for weights, after in pairwise((first, *others)):
            y = _with_one(after)
            inner = y[:-1]
            calls += [partial(weights.dot, x, inner), partial(np.tanh, inner, inner)]
            x = y
        self._result = np.empty(1, np.float32)
        self._calls: tuple[Callable[[], Any], ...] = (*calls, partial(layers[-1].dot, x, self._result))

    def begin(self) -> None:
        """Nothing is to be forgotten."""

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """The output for one observation; NaN for NaN. Not of the applied current: that is for actors with a state."""
        row = self._row
        (a, b), (c, d), (e, f) = self._lines
        row[0] = a * angle + b
        row[1] = c * velocity + d
        row[2] = e * step + f
        for call in self._calls:
            call()
        low, high = self._limits
        slope, offset = self._answer
        return slope * min(max(self._result.item(), low), high) + offset  # so written, NaN passes


def _with_one(weights: Floats) -> Floats:
    """Room for the inputs of a layer: the last one is 1, so that its weights are the biases."""
    return np.ones(weights.shape[1], np.float32)


def network(graph: Graph, input_name: str, output_name: str) -> Network | None:
    """Build the network of a graph from three numbers to one.

    Args:
        graph: from an ONNX file.
        input_name: name of the observation, shape [1, 3].
        output_name: name of the output, shape [1, 1].

    Returns:
        None if the graph is anything but elementwise sums and factors, layers with tanh between them, a clip, and sums
        and factors of the one number; or if it is too large.
    """
    try:
        return _network(_chain(graph, input_name, output_name), graph.constants)
    except _UnknownError:
        return None


def _chain(graph: Graph, input_name: str, output_name: str) -> list[Node]:
    """The nodes, each of which takes the output of the one before as its first input and constants for the others."""
    name = input_name
    for node in graph.nodes:
        if not node.plain or len(node.outputs) != 1 or node.inputs[:1] != (name,):
            raise _UnknownError
        if node.operator != "Gemm" and node.attributes:
            raise _UnknownError
        (name,) = node.outputs
    if name != output_name:
        raise _UnknownError
    return list(graph.nodes)


def _network(nodes: list[Node], constants: dict[str, Floats]) -> Network:
    lines, answer = [_Line()] * INPUTS, _Line()
    layers: list[Floats] = []
    low, high = -math.inf, math.inf
    bent = clipped = False
    for node in nodes:
        values = [_constant(constants, name) for name in node.inputs[1:]]
        match node.operator, values:
            case "Gemm", [weights, bias] if bent or not layers:
                layers.append(_layer(node, weights, bias, len(layers[-1]) if layers else INPUTS))
                bent = False
            case "Tanh", [] if layers and not bent and answer == _Line() and not clipped:
                bent = True
            case "Clip", [least, most] if layers and not bent and answer == _Line() and not clipped:
                (low,), (high,), clipped = _row(least, 1), _row(most, 1), True
            case operator, [constant] if not layers:
                lines = [line.then(operator, c) for line, c in zip(lines, _row(constant, INPUTS), strict=True)]
            case operator, [constant] if not bent:
                answer = answer.then(operator, *_row(constant, 1))
            case _:
                raise _UnknownError
    if not layers or len(layers[-1]) != 1 or bent:
        raise _UnknownError
    return Network(lines, layers, low, high, answer)


def _layer(node: Node, weights: Floats, bias: Floats, inputs: int) -> Floats:
    """Weights and biases of a layer, shape [outputs, inputs + 1]."""
    transposed = bool(node.attributes.get("transB", 0))
    if {**_GEMM, **node.attributes, "transB": 0} != {**_GEMM, "transB": 0} or weights.ndim != 2:
        raise _UnknownError
    rows = weights if transposed else weights.T
    if rows.shape[1] != inputs or rows.size + len(rows) > MOST_WEIGHTS:
        raise _UnknownError
    return np.ascontiguousarray(np.column_stack([rows, _row(bias, len(rows))]), np.float32)


def _row(constant: Floats, width: int) -> list[float]:
    """A constant for each number of a row of that width."""
    *leading, last = constant.shape or (1,)
    if last not in (1, width) or leading not in ([], [1]):
        raise _UnknownError
    return [float(c) for c in np.broadcast_to(constant.reshape(-1), (width,))]


def _constant(constants: dict[str, Floats], name: str) -> Floats:
    value = constants.get(name)
    if value is None or value.size == 0 or not np.all(np.abs(value) <= LARGEST_NUMBER):  # so written, NaN is refused
        raise _UnknownError
    return value
