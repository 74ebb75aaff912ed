"""Identities of what is learnt, by the very functions that run, in exact rational arithmetic (B2 to B4).

Both sides are rational functions of low degree. Where they agree at a few points that are drawn from many, they agree
everywhere (Schwartz, J. ACM 27, 1980; Zippel 1979): a false identity of degree d passes one point of 2^40 numbers a
coordinate with a probability of d/2^40 at most.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, NamedTuple

from emb_runtime.learning import bounded
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.known import HIGH, LOW
from tools.proof.cases import Case
from tools.proof.symbolic_execution import lift

POINTS = 3  # Points at which both sides are compared
WINDOWS = (1, 2, 3, 5, 8)  # Lengths of windows that are looked at


class Compared(NamedTuple):
    """Result of comparing both sides of an identity."""

    proved: bool
    points: int
    breaks: str  # The side that is wrong, and where


class Exact(Fraction):
    """A rational number that stays one beside a float, which is one as well."""

    __slots__ = ()

    def __add__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction.__add__(self, Fraction(other)))

    __radd__ = __add__  # type: ignore[assignment]

    def __sub__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction.__sub__(self, Fraction(other)))

    def __rsub__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction(other) - Fraction(self))

    def __mul__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction.__mul__(self, Fraction(other)))

    __rmul__ = __mul__  # type: ignore[assignment]

    def __truediv__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction.__truediv__(self, Fraction(other)))

    def __rtruediv__(self, other: Any) -> Exact:  # type: ignore[override]
        return Exact(Fraction(other) / Fraction(self))

    def __neg__(self) -> Exact:
        return Exact(Fraction.__neg__(self))

    def __abs__(self) -> Exact:
        return Exact(Fraction.__abs__(self))


Vector = list[Any]


def _number(draw: random.Random, low: float = -1.0, high: float = 1.0) -> Any:
    share = Exact(draw.randrange(1, 2**40), 2**40)
    return Exact(low) + share * (Exact(high) - Exact(low))


def _exact(assumptions: Assumptions, **changed: Any) -> Any:
    numbers: dict[str, Any] = {n: Exact(v) for n, v in assumptions._asdict().items() if type(v) is float}
    numbers |= {n: tuple(Exact(x) for x in getattr(assumptions, n)) for n in ("low", "high")}
    return assumptions._replace(**{**numbers, **changed})


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return sum((x * y for x, y in zip(a, b, strict=True)), Exact(0))


def _triangle(matrix: list[Vector]) -> Vector:
    return [matrix[i][j] for i in range(len(matrix)) for j in range(i, len(matrix))]


def _square(triangle: Sequence[Any], size: int) -> list[Vector]:
    found = [[Exact(0)] * size for _ in range(size)]
    entries = iter(triangle)
    for i in range(size):
        for j in range(i, size):
            found[i][j] = found[j][i] = next(entries)
    return found


def _at_points(check: Callable[[random.Random], str]) -> Compared:
    """Compare both sides at :data:`POINTS`."""
    draw = random.Random(1)
    for point in range(POINTS):
        if broken := check(draw):
            return Compared(False, point + 1, f"broken at a point: {broken}")
    return Compared(True, POINTS, "")


def windows_are_exact(case: Case) -> Compared:
    """Without errors the strips of Euler's brake are identities, and with all of them their pads are enough (B2, B3).

    The strip is linear in each error as long as no angle changes its sign: each is made 1 in turn, and the absolute
    values are added.
    """

    def check(draw: random.Random) -> str:
        a = _exact(make_assumptions(case.bench), flow=False, model_error=Exact(50), current_error=Exact(1, 100))
        for n in WINDOWS:
            for name, length in (("_rise", n), ("_bend", 2 * n)):
                theta = [_number(draw, 0.5, 1.5) for _ in range(4)]
                currents = [_number(draw, -6.0, 6.0) for _ in range(length)]
                errors = [Exact(0)] * (4 * (length + 1))
                exact, pad = _residual(a, name, n, theta, currents, errors)
                if exact != 0:
                    return f"{name[1:]} of {n} periods"
                sizes = (a.angle_noise, a.velocity_noise, a.model_error, a.current_error)
                worst = Exact(0)
                for i in range(len(errors)):
                    one = [sizes[j % 4] if j == i else Exact(0) for j in range(len(errors))]
                    worst += abs(_residual(a, name, n, theta, currents, one)[0])
                if worst > pad:
                    return f"{name[1:]} of {n} periods is off by {float(worst / pad):.6f} of its pad"
        return ""

    return _at_points(check)


def _residual(a: Any, name: str, n: int, theta: Vector, currents: Vector, errors: Vector) -> tuple[Exact, Exact]:
    """φ·θ − value of a strip for an Euler brake in contact, moving up, with these errors; and the strip's pad."""
    taken: list[tuple[Any, ...]] = []
    state: Any = [Exact(0)] * bounded.SIZE
    state[HIGH : HIGH + 4], state[bounded.DIRECTION] = theta, Exact(1)
    x: Any = Exact(20)
    v: Any = Exact(250)
    t = a.sample_time
    for j in range(len(currents) + 1):
        e, w, model, current = errors[4 * j : 4 * j + 4]
        reported: Any = currents[j - 1] if j else Exact(0)
        bounded._record(a, state, x + e, v + w, reported)
        state[bounded.FOLLOWS] = Exact(1)
        if j < len(currents):
            acting = currents[j] + current
            pulled = a.motor * theta[0] * acting - a.spring * theta[1] * x
            x, v = x + t * v, v + t * (pulled - a.coulomb * theta[2] - a.viscous * theta[3] * v + model)
    lift(getattr(bounded, name), {"_take": lambda *args: taken.append(args)})(a, state, n)
    ((_, f1, f2, f3, f4, value, pad),) = taken
    return _dot((f1, f2, f3, f4), theta) - value, pad


def strips_are_enclosed(_: Case) -> Compared:
    """The ellipsoid after a strip is the one of B4, for a ρ > 0: scale, middle and matrix."""

    def check(draw: random.Random) -> str:
        size = range(4)
        # Rows of a unit root and a φ of a known length: the root in the function is then a number.
        root = [
            [_number(draw, 0.5, 1.0) if i == j else _number(draw) if j < i else Exact(0) for j in size] for i in size
        ]
        q = [Exact(2), Exact(4), Exact(5), Exact(6)]  # of length 9
        phi = [Exact(0)] * 4
        for i in reversed(size):  # rootᵀ φ = q
            phi[i] = (q[i] - sum((root[k][i] * phi[k] for k in range(i + 1, 4)), Exact(0))) / root[i][i]
        matrix = [[_dot(r, s) for s in root] for r in root]
        state: Any = [Exact(0)] * bounded.SIZE
        state[bounded.SHAPE : bounded.SHAPE + 10], state[bounded.UNKNOWNS] = _triangle(matrix), Exact(4)
        state[LOW : LOW + 4], state[HIGH : HIGH + 4] = [Exact(-99)] * 4, [Exact(99)] * 4
        low, high = _number(draw, -3.0, -1.0), _number(draw, 1.5, 4.0)
        sqrt = SimpleNamespace(sqrt=_root)
        lift(bounded._cut_ellipsoid, {"math": sqrt})(state, *phi, low, high)
        after = _square(state[bounded.SHAPE : bounded.SHAPE + 10], 4)
        centre = state[bounded.CENTRE : bounded.CENTRE + 4]
        g, square = [_dot(r, phi) for r in matrix], Exact(81)
        # Across φ only the scale acts, along φ what is left of the axis as well.
        across = [g[1], -g[0], Exact(0), Exact(0)]
        scale = _form(after, across) / _form(matrix, across)
        left = _form(after, phi) / (scale * square)
        rho = square * left / (1 - left)
        nu, half = (low + high) / 2, (high - low) / 2
        if not 0 < left < 1:
            return "ρ is not positive"
        if scale != (1 + half**2 / rho - nu**2 / (square + rho)) * Exact(1.0 + bounded.ROUNDING):
            return "the scale"
        if centre != [x * nu / (square + rho) for x in g]:
            return "the middle"
        wanted = [[scale * (matrix[i][j] - g[i] * g[j] / (square + rho)) for j in size] for i in size]
        return "" if after == wanted else "the matrix"

    return _at_points(check)


def _form(matrix: list[Vector], w: Vector) -> Exact:
    value: Exact = _dot(w, [_dot(r, w) for r in matrix])
    return value


def _root(value: Any) -> Exact:
    """The root, exact where there is one; a number near it where only a choice depends on it."""
    exact = Exact(value)
    over, under = math.isqrt(exact.numerator), math.isqrt(exact.denominator)
    return Exact(over, under) if Exact(over, under) ** 2 == exact else Exact(math.sqrt(exact))
