"""Operations on single numbers in double precision, and an actor that is a sequence of them.

An actor with an estimator is hundreds of operations on a few numbers each. ONNX Runtime takes a third of a microsecond
for each of its nodes, whatever they do; here an operation takes some nanoseconds where this module is compiled, and
less than a tenth of a microsecond where it is not, with the same result. What makes a graph into operations is
:mod:`emb_runtime.policy.scalar_graph`.

Nothing raises: what has no value is NaN, and what is too large is infinite, as in ONNX Runtime. NaN passes Max and Min.
A condition is 1 or 0.

What runs in each cycle is chained and not kept in lists: compiled code asks each element of a list for its type, which
takes longer than most operations. What is one step of the estimator's algebra, such as a - b c, is one operation.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Final

from emb_runtime.policy.inference import believable, require_finite

LARGEST_EXPONENT: Final = 709.78  # Beyond it the exponential is more than the largest number
LARGEST_SINGLE: Final = 3.4e38  # Up to it a number is finite in single precision


class Number:
    """A number: an input, or one of those below."""

    __slots__ = ("value",)

    def __init__(self, value: float = 0.0) -> None:
        self.value = value


class Constant(Number):
    """A number that stays as it is."""

    __slots__ = ()


class Operation(Number):
    """A number that is computed from others."""

    __slots__ = ("following",)

    def __init__(self) -> None:
        super().__init__()
        self.following: Operation | None = None
        """The next one to compute."""

    def run(self) -> None:
        """Compute the value anew."""
        self._compute()

    def _compute(self) -> None:
        raise NotImplementedError


class Unary(Operation):
    """An operation on one number."""

    __slots__ = ("a",)

    def __init__(self, a: Number) -> None:
        super().__init__()
        self.a = a


class Binary(Operation):
    """An operation on two numbers."""

    __slots__ = ("a", "b")

    def __init__(self, a: Number, b: Number) -> None:
        super().__init__()
        self.a, self.b = a, b


class Add(Binary):
    """Sum."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.a.value + self.b.value


class Subtract(Binary):
    """Difference."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.a.value - self.b.value


class Multiply(Binary):
    """Product."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.a.value * self.b.value


class Ternary(Operation):
    """An operation on three numbers."""

    __slots__ = ("a", "b", "c")

    def __init__(self, a: Number, b: Number, c: Number) -> None:
        super().__init__()
        self.a, self.b, self.c = a, b, c


class AddProduct(Ternary):
    """a + b c, rounded twice."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.a.value + self.b.value * self.c.value


class SubtractProduct(Ternary):
    """a - b c, rounded twice."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.a.value - self.b.value * self.c.value


class Divide(Binary):
    """Quotient, of IEEE 754 where the divisor is zero."""

    __slots__ = ()

    def _compute(self) -> None:
        a, b = self.a.value, self.b.value
        if b != 0.0:
            self.value = a / b
        elif a > 0.0 or a < 0.0:
            self.value = math.copysign(math.inf, a) * math.copysign(1.0, b)
        else:
            self.value = math.nan


class Maximum(Binary):
    """The larger one."""

    __slots__ = ()

    def _compute(self) -> None:
        a, b = self.a.value, self.b.value
        self.value = a if a > b or a != a else b


class Minimum(Binary):
    """The smaller one."""

    __slots__ = ()

    def _compute(self) -> None:
        a, b = self.a.value, self.b.value
        self.value = a if a < b or a != a else b


class Greater(Binary):
    """a > b."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = 1.0 if self.a.value > self.b.value else 0.0


class GreaterOrEqual(Binary):
    """a ≥ b."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = 1.0 if self.a.value >= self.b.value else 0.0


class Equal(Binary):
    """a = b."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = 1.0 if self.a.value == self.b.value else 0.0


class Absolute(Unary):
    """Magnitude."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = abs(self.a.value)


class Sign(Unary):
    """−1, 0 or 1."""

    __slots__ = ()

    def _compute(self) -> None:
        a = self.a.value
        self.value = 1.0 if a > 0.0 else -1.0 if a < 0.0 else a


class SquareRoot(Unary):
    """Square root."""

    __slots__ = ()

    def _compute(self) -> None:
        a = self.a.value
        self.value = math.sqrt(a) if a >= 0.0 else math.nan


class Exponential(Unary):
    """Exponential."""

    __slots__ = ()

    def _compute(self) -> None:
        a = self.a.value
        self.value = math.inf if a > LARGEST_EXPONENT else math.exp(a)


class Logarithm(Unary):
    """Natural logarithm."""

    __slots__ = ()

    def _compute(self) -> None:
        a = self.a.value
        self.value = math.log(a) if a > 0.0 else -math.inf if a == 0.0 else math.nan


class HyperbolicTangent(Unary):
    """Hyperbolic tangent."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = math.tanh(self.a.value)


class Where(Ternary):
    """b where the condition a holds, else c."""

    __slots__ = ()

    def _compute(self) -> None:
        self.value = self.b.value if self.a.value != 0.0 else self.c.value


class AddProducts(Operation):
    """A number and three products, added from left to right: a part of an element of a product of matrices."""

    __slots__ = ("a", "b", "c", "d", "e", "f", "start")

    def __init__(self, start: Number, a: Number, b: Number, c: Number, d: Number, e: Number, f: Number) -> None:
        """Take the number, then a b, c d and e f."""
        super().__init__()
        self.start = start
        self.a, self.b, self.c, self.d, self.e, self.f = a, b, c, d, e, f

    def _compute(self) -> None:
        total = self.start.value + self.a.value * self.b.value
        total += self.c.value * self.d.value
        self.value = total + self.e.value * self.f.value


class Remembered:
    """A number of the state, and what it becomes with the next sample."""

    __slots__ = ("becomes", "following", "kept", "number")

    def __init__(self, number: Number, becomes: Number, following: Remembered | None) -> None:
        """Take the next one to keep as the last argument."""
        self.number, self.becomes, self.following = number, becomes, following
        self.kept = 0.0


class ScalarActor:
    """An actor as a sequence of operations; made by :func:`emb_runtime.policy.scalar_graph.scalar_actor`."""

    def __init__(
        self,
        operations: Sequence[Operation],
        seen: Sequence[Number],
        state: Sequence[Number],
        initial_state: Sequence[float],
        results: tuple[Number, Sequence[Number], Sequence[Number]],
    ) -> None:
        """Set it up.

        Args:
            operations: in an order in which each comes after those that it takes.
            seen: the observation: angle, velocity, step, and perhaps the applied current.
            state: what is remembered.
            initial_state: its values before the first sample.
            results: the action, the next state, and the estimates with their standard deviations.
        """
        self._first: Operation | None = None
        for operation in reversed(operations):
            operation.following, self._first = self._first, operation
        self._angle, self._velocity, self._step, self._applied, *_ = (*seen, Number())
        self._state, self._initial = list(state), tuple(initial_state)
        action, next_state, estimate = results
        self._action, self._estimate = action, list(estimate)
        self._deviations = self._estimate[len(estimate) // 2 :]
        self._memory: Remembered | None = None
        for number, becomes in zip(state, next_state, strict=True):
            self._memory = Remembered(number, becomes, self._memory)
        # The graph's observation, action and estimate are in single precision.
        self._observed, self._said = array("f", [0.0] * 4), array("f", [0.0])
        self.begin()

    @property
    def state(self) -> tuple[float, ...]:
        """State between samples."""
        return tuple([number.value for number in self._state])

    @property
    def estimate(self) -> tuple[float, ...]:
        """The latest estimate: values, then standard deviations; empty before the first."""
        return tuple(array("f", [number.value for number in self._estimate])) if self._has_acted else ()

    def begin(self) -> None:
        """Forget what was seen: the next sample is the first one."""
        self._has_acted = False
        for number, value in zip(self._state, self._initial, strict=True):
            number.value = value

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """See :meth:`emb_runtime.policy.policy.Policy.act`."""
        observed = self._observed
        observed[0], observed[1], observed[2], observed[3] = angle, velocity, step, applied_current
        self._angle.value, self._velocity.value = observed[0], observed[1]
        self._step.value, self._applied.value = observed[2], observed[3]
        operation = self._first
        while operation is not None:
            operation._compute()
            operation = operation.following
        self._remember(step)
        self._has_acted = True
        self._require_believable(step)
        said = self._said
        said[0] = self._action.value
        action: float = said[0]
        return action

    def _remember(self, step: float) -> None:
        doubt = 0.0
        memory = self._memory
        while memory is not None:
            memory.kept = kept = memory.becomes.value
            doubt += kept - kept  # zero of what is finite, else NaN
            memory = memory.following
        if doubt != 0.0:
            require_finite([math.nan], step)
        memory = self._memory
        while memory is not None:  # once all are read: one may become another
            memory.number.value = memory.kept
            memory = memory.following

    def _require_believable(self, step: float) -> None:
        for number in self._estimate:
            if not -LARGEST_SINGLE <= number.value <= LARGEST_SINGLE:
                believable(self.estimate, step)
        for number in self._deviations:
            if number.value < 0.0:
                believable(self.estimate, step)
