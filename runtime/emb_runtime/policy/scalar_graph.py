"""A graph as operations on single numbers, where it has many nodes with few numbers each.

Every tensor is an array of numbers (:mod:`emb_runtime.policy.scalar_operations`); numpy moves them about as the graph
says. What places and picks numbers (Concat, Split, products with matrices of zeros and ones) is done here, once, and
leaves no operation. A product with a constant zero is zero, whatever the other factor. All is computed in double
precision.

What is built here is no second truth: the caller holds it against ONNX Runtime before it is used, and where a graph has
anything that is not known here, there is none.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_runtime.policy.contract import Contract
from emb_runtime.policy.inference import ESTIMATE_NAME, INPUT_NAME, NEXT_STATE_NAME, OUTPUT_NAME, STATE_NAME, ports
from emb_runtime.policy.onnx_file import Graph, Node
from emb_runtime.policy.scalar_operations import (
    Absolute,
    Add,
    AddProduct,
    AddProducts,
    Constant,
    Divide,
    Equal,
    Exponential,
    Greater,
    GreaterOrEqual,
    HyperbolicTangent,
    Logarithm,
    Maximum,
    Minimum,
    Multiply,
    Number,
    Operation,
    ScalarActor,
    Sign,
    SquareRoot,
    Subtract,
    SubtractProduct,
    Where,
)

OPERATIONS_PER_NODE = 5  # At most, on average, each product in a sum counted: with more, ONNX Runtime is as fast
MOST_WORK = 100_000  # Numbers looked at to build an actor

Numbers = NDArray[np.object_]  # An array of :class:`Number`

Key = tuple[Any, ...]  # A kind of operation, and its operands

_FLOATING = (1, 11)  # TensorProto.DataType


class _UnknownError(Exception):
    """Something in the graph that is not known here, or too much of it."""


def scalar_actor(graph: Graph, contract: Contract) -> ScalarActor | None:
    """Build the operations of a graph that ONNX Runtime has taken, with inputs and outputs as the contract says.

    Returns:
        None if it has an operator or an attribute that is not known here, or is too large.
    """
    try:
        return _Translation(graph, contract).actor()
    except (_UnknownError, LookupError, TypeError, ValueError):  # of numpy too, for what does not fit together
        return None


class _Translation:
    """A graph on its way to operations."""

    def __init__(self, graph: Graph, contract: Contract) -> None:
        self._graph, self._contract = graph, contract
        self._operations: dict[Key, Operation] = {}  # in the order in which they are made
        self._constants: dict[str, Constant] = {}
        self._work = 0
        inputs, _ = ports(contract)
        self._tensors: dict[str, Numbers] = {
            port.name: np.array([[Number() for _ in range(port.width)]], np.object_) for port in inputs
        }

    def actor(self) -> ScalarActor:
        """The actor.

        Raises:
            _UnknownError: something is not known here, or there is too much of it.
        """
        for node in self._graph.nodes:
            if node.operator != "Constant":
                self._tensors |= zip(node.outputs, self._results(node), strict=True)
        seen, state, action, next_state, estimate = (
            list(self._tensors[name][0]) if name in self._tensors else []
            for name in (INPUT_NAME, STATE_NAME, OUTPUT_NAME, NEXT_STATE_NAME, ESTIMATE_NAME)
        )
        needed = self._needed([*action, *next_state, *estimate])
        operations = _joined(needed, {*action, *next_state, *estimate})
        action, next_state, estimate = (
            [operations.get(number, number) for number in numbers] for numbers in (action, next_state, estimate)
        )
        results = action[0], next_state, estimate
        return ScalarActor(list(operations.values()), seen, state, self._contract.initial_state, results)

    def _needed(self, results: Sequence[Number]) -> dict[Operation, Key]:
        """The operations that results depend on, each after those that it takes."""
        wanted, count = set(results), 0
        needed: dict[Operation, Key] = {}
        for key, operation in reversed(self._operations.items()):
            if operation in wanted:
                _, *operands = key
                wanted.update(operands)
                count += max(len(operands) // 2, 1)
                needed[operation] = key
        if count > OPERATIONS_PER_NODE * len(self._graph.nodes):
            raise _UnknownError
        return dict(reversed(needed.items()))

    def _spend(self, count: int) -> None:
        self._work += count
        if self._work > MOST_WORK:
            raise _UnknownError

    # --- numbers ----------------------------------------------------------------------------------------------------

    def constant(self, value: float) -> Number:
        """A number that stays as it is; equal ones are one."""
        return self._constants.setdefault(value.hex(), Constant(value))

    def made(self, kind: Callable[..., Operation], *operands: Number) -> Number:
        """The result of an operation: of constants a constant, and the same of the same."""
        key = kind, *operands
        if key in self._operations:
            return self._operations[key]
        self._spend(1)
        operation = kind(*operands)
        if all(isinstance(operand, Constant) for operand in operands):
            operation.run()
            return self.constant(operation.value)
        for one, *other in (operands, operands[::-1]):
            if isinstance(one, Constant):
                if kind is Multiply and one.value == 0.0:
                    return one
                if (kind is Multiply and one.value == 1.0) or (kind is Add and one.value == 0.0):
                    return other[0]
        self._operations[key] = operation
        return operation

    # --- tensors ----------------------------------------------------------------------------------------------------

    def _tensor(self, name: str) -> Numbers:
        """A tensor that was computed, or that is part of the file."""
        if name not in self._tensors:
            values = self._graph.constants.get(name)
            if values is None:
                tensor = self._graph.tensors[name]
                values = np.array(tensor.values, np.float64).reshape(tensor.shape)
            self._spend(values.size)
            self._tensors[name] = self._each(self.constant, values.astype(np.float64))
        return self._tensors[name]

    def _whole(self, name: str) -> list[int]:
        """Whole numbers that are part of the file: sizes, axes, places."""
        return [int(value) for value in self._graph.tensors[name].values or ()]

    def _each(self, function: Callable[..., Number], *tensors: NDArray[Any]) -> Numbers:
        """A function of single numbers, of each number of tensors that are stretched to one shape."""
        self._spend(math.prod(np.broadcast_shapes(*(tensor.shape for tensor in tensors))))
        results = np.frompyfunc(function, len(tensors), 1)(*tensors)
        return np.asarray(results, np.object_)

    def _results(self, node: Node) -> list[Numbers]:
        """Results of a node."""
        name, numbers = node.operator, node.attributes
        if name in _ELEMENTWISE:
            tensors = [self._tensor(name) for name in node.inputs]
            return [self._each(_ELEMENTWISE[name](self), *tensors)]
        first = self._tensor(node.inputs[0])
        axis = int(numbers.get("axis", 0))
        match name, node.inputs[1:]:
            case "Cast", [] if numbers["to"] in _FLOATING:
                return [first]
            case "Concat", others:
                return [np.concatenate([first, *map(self._tensor, others)], axis)]
            case "Split", [sizes]:
                return np.split(first, np.cumsum(self._whole(sizes))[:-1], axis)
            case "Split", [] if first.shape[axis] % int(numbers["num_outputs"]) == 0:
                return np.split(first, int(numbers["num_outputs"]), axis)
            case "Reshape", [shape] if 0 not in self._whole(shape):
                return [first.reshape(self._whole(shape))]
            case "Transpose", []:
                return [first.transpose(node.lists["perm"])]
            case "Slice", [starts, ends, axes, steps]:
                slices = [slice(None)] * first.ndim
                for at, *ends_and_step in zip(*map(self._whole, (axes, starts, ends, steps)), strict=True):
                    slices[at] = slice(*ends_and_step)
                return [first[tuple(slices)]]
            case "ReduceSum", [axes] if numbers.get("keepdims", 1) == 1 and len(self._whole(axes)) == 1:
                (at,) = self._whole(axes)
                ones = np.full(first.shape[at], self.constant(1.0), np.object_)
                return [np.expand_dims(self._sums(np.moveaxis(first, at, -1), ones), at)]
            case "MatMul", [other] if first.ndim > 1 < self._tensor(other).ndim:
                columns = np.swapaxes(self._tensor(other), -1, -2)
                return [self._sums(first[..., :, None, :], columns[..., None, :, :])]
            case _:
                raise _UnknownError

    def _sums(self, a: Numbers, b: Numbers) -> Numbers:
        """Sums of products over the last axis."""
        shape = np.broadcast_shapes(a.shape, b.shape)
        self._spend(math.prod(shape))
        a, b = np.broadcast_to(a, shape), np.broadcast_to(b, shape)
        results = np.empty(shape[:-1], np.object_)
        for place in np.ndindex(results.shape):
            results[place] = self._sum(a[place], b[place])
        return results

    def _sum(self, a: Numbers, b: Numbers) -> Number:
        zero = self.constant(0.0)
        pairs = [pair for pair in zip(a, b, strict=True) if zero not in pair]
        match pairs:
            case []:
                return zero
            case [pair]:
                return self.made(Multiply, *pair)
            case _:
                total = zero
                for at in range(0, len(pairs), 3):
                    three = [*pairs[at : at + 3], (zero, zero), (zero, zero)][:3]
                    total = self.made(AddProducts, total, *chain.from_iterable(three))
                return total


def _joined(operations: Mapping[Operation, Key], results: Collection[Number]) -> dict[Number, Operation]:
    """Operations made anew, with a product that is used once, to be added or subtracted, joined to that.

    Args:
        operations: in an order in which each comes after those that it takes.
        results: what is wanted besides.

    Returns:
        The new ones, in such an order, by the ones that they stand for.
    """
    uses = Counter(operand for _, *operands in operations.values() for operand in operands)
    uses.update(results)
    products = {
        operation: factors
        for operation, (kind, *factors) in operations.items()
        if kind is Multiply and uses[operation] == 1
    }
    joint: dict[Operation, Key] = {}
    taken = set()
    for operation, (kind, *operands) in operations.items():
        if kind in (Add, Subtract):
            a, b = operands
            if kind is Add and b not in products:
                a, b = b, a
            if b in products:
                joint[operation] = (AddProduct if kind is Add else SubtractProduct, a, *products[b])
                taken.add(b)
    anew: dict[Number, Operation] = {}
    for operation, key in operations.items():
        if operation not in taken:
            kind, *operands = joint.get(operation, key)
            anew[operation] = kind(*[anew.get(operand, operand) for operand in operands])
    return anew


_ELEMENTWISE: Mapping[str, Callable[[_Translation], Callable[..., Number]]] = MappingProxyType(
    {
        "Abs": lambda t: partial(t.made, Absolute),
        "Add": lambda t: partial(t.made, Add),
        "And": lambda t: partial(t.made, Multiply),
        "Clip": lambda t: lambda x, low, high: t.made(Minimum, t.made(Maximum, x, low), high),
        "Div": lambda t: partial(t.made, Divide),
        "Equal": lambda t: partial(t.made, Equal),
        "Exp": lambda t: partial(t.made, Exponential),
        "Greater": lambda t: partial(t.made, Greater),
        "GreaterOrEqual": lambda t: partial(t.made, GreaterOrEqual),
        "Less": lambda t: lambda a, b: t.made(Greater, b, a),
        "LessOrEqual": lambda t: lambda a, b: t.made(GreaterOrEqual, b, a),
        "Log": lambda t: partial(t.made, Logarithm),
        "Max": lambda t: partial(t.made, Maximum),
        "Min": lambda t: partial(t.made, Minimum),
        "Mul": lambda t: partial(t.made, Multiply),
        "Neg": lambda t: partial(t.made, Multiply, t.constant(-1.0)),
        "Relu": lambda t: partial(t.made, Maximum, t.constant(0.0)),
        "Sign": lambda t: partial(t.made, Sign),
        "Sqrt": lambda t: partial(t.made, SquareRoot),
        "Sub": lambda t: partial(t.made, Subtract),
        "Tanh": lambda t: partial(t.made, HyperbolicTangent),
        "Where": lambda t: partial(t.made, Where),
    }
)
