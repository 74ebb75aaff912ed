"""Operations on single numbers in double precision, and an actor that is a sequence of them.

An actor with an estimator is hundreds of operations on a few numbers each. ONNX Runtime takes a third of a microsecond
for each of its nodes, whatever they do; here an operation takes some nanoseconds where this module is compiled, and
less than a tenth of a microsecond where it is not, with the same result. What makes a graph into operations is
:mod:`emb_runtime.policy.scalar_graph`.

Nothing raises: what has no value is NaN, and what is too large is infinite, as in ONNX Runtime. NaN passes Max and Min.
A condition is 1 or 0.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

from emb_runtime.policy.inference import believable, require_finite

LARGEST_EXPONENT = 709.78
"""Beyond it the exponential is more than the largest number."""


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

    __slots__ = ()

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


class Where(Operation):
    """a where the condition holds, else b."""

    __slots__ = ("a", "b", "condition")

    def __init__(self, condition: Number, a: Number, b: Number) -> None:
        super().__init__()
        self.condition, self.a, self.b = condition, a, b

    def _compute(self) -> None:
        self.value = self.a.value if self.condition.value != 0.0 else self.b.value


class SumOfProducts(Operation):
    """a_1 b_1 + a_2 b_2 + …, in this order: an element of a product of matrices."""

    __slots__ = ("products",)

    def __init__(self, *factors: Number) -> None:
        """Take a_1, b_1, a_2, b_2, …."""
        super().__init__()
        self.products = list(zip(factors[::2], factors[1::2], strict=True))

    def _compute(self) -> None:
        total = 0.0
        for a, b in self.products:
            total += a.value * b.value
        self.value = total


class ScalarActor:
    """An actor as a sequence of operations; made by :func:`emb_runtime.policy.scalar_graph.scalar_actor`."""

    estimate: tuple[float, ...] = ()
    """The latest estimate: values, then standard deviations; empty before the first."""

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
        self._operations = list(operations)
        self._seen, self._state = list(seen), list(state)
        self._initial = tuple(initial_state)
        action, next_state, estimate = results
        self._action, self._next_state, self._estimate = action, list(next_state), list(estimate)
        # The graph's observation, action and estimate are in single precision.
        self._observed, self._said = array("f", [0.0] * len(seen)), array("f", [0.0] * (1 + len(estimate)))
        self.begin()

    @property
    def state(self) -> tuple[float, ...]:
        """State between samples."""
        return tuple([number.value for number in self._state])

    def begin(self) -> None:
        """Forget what was seen: the next sample is the first one."""
        self.estimate = ()
        for number, value in zip(self._state, self._initial, strict=True):
            number.value = value

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """See :meth:`emb_runtime.policy.policy.Policy.act`."""
        observed = self._observed
        observed[0], observed[1], observed[2] = angle, velocity, step
        if len(observed) > 3:
            observed[3] = applied_current
        for number, value in zip(self._seen, observed, strict=True):
            number.value = value
        for operation in self._operations:
            operation._compute()
        if self._state:
            following = [number.value for number in self._next_state]
            require_finite(following, step)
            for number, value in zip(self._state, following, strict=True):
                number.value = value
        said = self._said
        said[0] = self._action.value
        if self._estimate:
            for i, number in enumerate(self._estimate, 1):
                said[i] = number.value
            self.estimate = believable(tuple(said[1:]), step)
        action: float = said[0]
        return action
