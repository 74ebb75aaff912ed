"""Exact real numbers in an SMT solver: a statement is proved when no numbers can be found that break it.

Z3 decides conjunctions of polynomial inequalities over the reals (Jovanović and de Moura, Solving non-linear
arithmetic, IJCAR 2012). Floats enter as the rational numbers that they are; rounding by the law itself is not
covered here.
"""

from __future__ import annotations

import importlib
import itertools
import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, NamedTuple

from emb_runtime.errors import needs
from proof.symbolic_execution import DeadEnd, Path, lift, walk

Real = Any  # A term, or a plain number

ORDERS = range(4)
"""Orders of the unknowns in which the solver looks at them; which of them is short is seldom known beforehand."""
STEPS = (200_000, 3_000_000)
"""Of the solver for one question, for each order in turn: a count of its own, so that no answer depends on the time."""


def solver_module() -> Any:
    """The solver.

    Raises:
        UsageError: it is not installed.
    """
    with needs("checking the shield's proof", "dev"):
        return importlib.import_module("z3")  # it comes without types


def _exact(value: Any) -> Any:
    if isinstance(value, Term):
        return value.z
    f = Fraction(value)
    return solver_module().Q(f.numerator, f.denominator)


class Term:
    """A real number that the solver knows; made by :meth:`Facts.real` and by arithmetic.

    A quotient stays one: a sum over the product of factors that are positive on this path. So an order between two of
    them is one between polynomials, and the solver need not find the quotients themselves.
    """

    __slots__ = ("facts", "over", "under")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, facts: Facts, over: Any, under: tuple[Any, ...] = ()) -> None:
        self.facts = facts
        self.over = over
        self.under = under

    @property
    def z(self) -> Any:
        """The number itself; for a quotient an unknown that times the factors is the sum."""
        if not self.under:
            return self.over
        quotient = self.facts.real("quotient")
        self.facts.assume(math.prod(self.under, start=quotient.over) == self.over)
        return quotient.over

    def __add__(self, other: Real) -> Term:
        return self._with(other, lambda a, b: a + b)

    __radd__ = __add__

    def __sub__(self, other: Real) -> Term:
        return self._with(other, lambda a, b: a - b)

    def __rsub__(self, other: Real) -> Term:
        return self._with(other, lambda a, b: b - a)

    def _with(self, other: Real, joined: Callable[[Any, Any], Any]) -> Term:
        mine, others, under = common(self, other)
        return Term(self.facts, joined(mine, others), under)

    def __mul__(self, other: Real) -> Term:
        over, under = _parts(other)
        return Term(self.facts, self.over * over, (*self.under, *under))

    __rmul__ = __mul__

    def __truediv__(self, other: Real) -> Term:
        return self.facts.ratio(self, other)

    def __rtruediv__(self, other: Real) -> Term:
        return self.facts.ratio(other, self)

    def __neg__(self) -> Term:
        return Term(self.facts, -self.over, self.under)

    def __abs__(self) -> Real:
        return self.facts.greater(self, -self)

    def __lt__(self, other: Real) -> bool:
        a, b, _ = common(self, other)
        return self.facts.decide(a < b)

    def __le__(self, other: Real) -> bool:
        a, b, _ = common(self, other)
        return self.facts.decide(a <= b)

    def __gt__(self, other: Real) -> bool:
        a, b, _ = common(self, other)
        return self.facts.decide(a > b)

    def __ge__(self, other: Real) -> bool:
        a, b, _ = common(self, other)
        return self.facts.decide(a >= b)

    def __eq__(self, other: object) -> bool:
        a, b, _ = common(self, other)
        return self.facts.decide(a == b)


def _parts(value: Any) -> tuple[Any, tuple[Any, ...]]:
    return (value.over, value.under) if isinstance(value, Term) else (_exact(value), ())


def common(first: Real, second: Real) -> tuple[Any, Any, tuple[Any, ...]]:
    """Two numbers over the same positive factors: both sums, and the factors."""
    (a, below_a), (b, below_b) = _parts(first), _parts(second)
    missing = list(below_b)
    only_a = [f for f in below_a if not _removed(missing, f)]
    return math.prod(missing, start=a), math.prod(only_a, start=b), (*below_a, *missing)


def _removed(factors: list[Any], factor: Any) -> bool:
    """Takes a factor out of a list, if it is there."""
    for i, each in enumerate(factors):
        if each.eq(factor):
            del factors[i]
            return True
    return False


def _unknowns(expression: Any) -> set[str]:
    """Names of the unknowns in an expression."""
    found, seen, waiting = set(), set(), [expression]
    while waiting:
        each = waiting.pop()
        if each.get_id() not in seen:
            seen.add(each.get_id())
            waiting.extend(each.children())
            if each.num_args() == 0 and each.decl().kind() == solver_module().Z3_OP_UNINTERPRETED:
                found.add(each.decl().name())
    return found


class Facts(Path):
    """Assumptions about the numbers on one path.

    Args:
        decisions: see :class:`Path`.
    """

    def __init__(self, decisions: tuple[bool, ...]) -> None:
        super().__init__(decisions)
        z3 = solver_module()
        self._z3 = z3
        self._known: list[Any] = []
        self._names = 0
        self.goals: list[tuple[str, Any]] = []

    def real(self, name: str, low: Real = None, high: Real = None) -> Term:
        """A number, between bounds if there are any; where both are the same one, that."""
        if isinstance(low, Term) and isinstance(high, Term) and not low.under and not high.under:
            least = self._z3.simplify(low.over)
            if least.eq(self._z3.simplify(high.over)):
                return Term(self, least)
        self._names += 1
        term = Term(self, self._z3.Real(f"{name}_{self._names}"))
        if low is not None:
            self.assume(term.z >= _exact(low))
        if high is not None:
            self.assume(term.z <= _exact(high))
        return term

    def constant(self, value: float | Fraction) -> Term:
        """A float as the rational number that it is."""
        return Term(self, _exact(value))

    def assume(self, condition: Any) -> None:
        """Assume a condition between the ``z`` of terms."""
        self._known.append(condition)

    def at_least(self, big: Real, small: Real) -> None:
        """Assume an order."""
        a, b, _ = common(big, small)
        self.assume(a >= b)

    def claim(self, label: str, big: Real, small: Real) -> None:
        """State an order that is to be proved on this path."""
        a, b, _ = common(big, small)
        self.goals.append((label, a >= b))

    def decide(self, condition: Any) -> bool:
        """Returns the way to go."""
        condition = self._z3.simplify(condition)
        if self._z3.is_true(condition):
            return True
        if self._z3.is_false(condition):
            return False
        negated = self._z3.Not(condition)
        if self.is_known:
            holds = self.choose(True, True)
        else:
            holds = self.choose(self.possible(condition), self.possible(negated))
        self.assume(condition if holds else negated)
        return holds

    def possible(self, condition: Any) -> bool:
        """Returns True if it can hold, and where the solver does not know."""
        return self.check(condition) != "unsat"

    def check(self, condition: Any) -> str:
        """``sat``, ``unsat`` or ``unknown``."""
        return self._ask(self._known, condition, ORDERS[0], STEPS[0])[0]

    def _ask(self, known: list[Any], condition: Any, order: int, steps: int) -> tuple[str, Any]:
        # Without the tactics around it that z3's default strategy has: they go by the clock.
        solver = self._z3.With("qfnra-nlsat", seed=order, shuffle_vars=order > 0).solver()
        solver.set("rlimit", steps)
        solver.add(*known, condition)
        return self._answer(solver), solver

    @staticmethod
    def _answer(solver: Any) -> str:
        answer = str(solver.check())
        if answer == "unknown" and solver.reason_unknown() == "interrupted from keyboard":
            raise KeyboardInterrupt  # z3 has a handler of its own while it searches
        return answer

    def refute(self, goal: Any) -> tuple[str, str]:
        """Searches numbers that break the goal: ``sat`` and the numbers, or another answer."""
        broken = self._z3.Not(goal)
        unknowns = _unknowns(goal)
        near = [fact for fact in self._known if _unknowns(fact) <= unknowns]
        # What holds of fewer facts holds of all; often these few are enough, and the question is a small one.
        if len(near) < len(self._known) and self._ask(near, broken, ORDERS[0], STEPS[0])[0] == "unsat":
            return "unsat", ""
        answer, solver = "unknown", None  # type: tuple[str, Any]
        for steps, order in itertools.product(STEPS, ORDERS):
            answer, solver = self._ask(self._known, broken, order, steps)
            if answer != "unknown":
                break
        if answer != "sat":
            return answer, ""
        model = solver.model()
        shown = sorted(model.decls(), key=lambda d: str(d.name()))
        return answer, ", ".join(f"{d.name()} = {_decimal(model[d])}" for d in shown)

    def sqrt(self, value: Real) -> Real:
        """The root of a number that cannot be negative here.

        Raises:
            ArithmeticError: it can be.
        """
        if not isinstance(value, Term):
            return math.sqrt(value)
        if self.possible(value.over < 0):
            raise ArithmeticError("the root of a number that may be negative")
        root = self.real("root", 0)
        self.assume(root.z * root.z == value.z)
        return root

    def ratio(self, over: Real, under: Real) -> Term:
        """A quotient whose divisor cannot be zero here.

        Raises:
            ArithmeticError: it can be.
        """
        (above, above_under), (below, below_under) = _parts(over), _parts(under)
        above = math.prod(below_under, start=above)
        if self._z3.is_rational_value(self._z3.simplify(below)):
            return Term(self, above / below, above_under)
        if not self.possible(below <= 0):
            return Term(self, above, (*above_under, below))
        if not self.possible(below >= 0):
            return Term(self, -above, (*above_under, -below))
        if self.possible(below == 0):
            raise ArithmeticError("a division by what may be zero")
        quotient = self.real("ratio")
        self.assume(quotient.over * below == above)
        return Term(self, quotient.over, above_under)

    def stand_in(self, low: float, asked: list[tuple[Real, ...]]) -> Callable[..., Term]:
        """Function whose result may be any number from ``low`` on; results and arguments are recorded."""

        def answer(*question: Real) -> Term:
            number = self.real("any", low)
            asked.append((number, *question))
            return number

        return answer

    def greater(self, first: Real, second: Real) -> Real:
        """``max``, without a fork."""
        if isinstance(first, Term) or isinstance(second, Term):
            a, b, under = common(first, second)
            return Term(self, self._z3.If(a >= b, a, b), under)
        return max(first, second)

    def smaller(self, first: Real, second: Real) -> Real:
        """``min``, without a fork."""
        if isinstance(first, Term) or isinstance(second, Term):
            a, b, under = common(first, second)
            return Term(self, self._z3.If(a <= b, a, b), under)
        return min(first, second)

    def lift(self, fn: Callable[..., Any], **scope: Any) -> Callable[..., Any]:
        """One of our functions on these numbers, with names in it replaced."""
        maths = SimpleNamespace(sqrt=self.sqrt, isfinite=lambda _: True, inf=math.inf)
        return lift(fn, {"math": maths, "max": self.greater, "min": self.smaller, **scope})


class Answer(NamedTuple):
    """Answer of the solver to one statement."""

    proved: bool
    paths: int  # Ways through the functions that were followed
    breaks: str  # Numbers that break it, or what the solver could not decide


def prove(statement: Callable[[Facts], None]) -> Answer:
    """Prove a statement on every path; it makes numbers, assumes, runs lifted functions, claims."""
    paths = 0

    def start(decisions: tuple[bool, ...]) -> tuple[Facts, Facts | None]:
        facts = Facts(decisions)
        try:
            statement(facts)
        except DeadEnd:
            return facts, None
        return facts, facts

    for facts in walk(start):
        if facts is None:
            continue
        paths += 1
        for label, goal in facts.goals:
            answer, numbers = facts.refute(goal)
            if answer != "unsat":
                broken = f"broken at {numbers}" if answer == "sat" else "undecided"
                return Answer(False, paths, f"{label}: {broken}")
    return Answer(paths > 0, paths, "" if paths else "nothing was stated")


def together(answers: Iterable[Answer]) -> Answer:
    """One answer to several statements; the first that is not proved is reported."""
    paths = 0
    for answer in answers:
        paths += answer.paths
        if not answer.proved:
            return answer._replace(paths=paths)
    return Answer(True, paths, "")


def _decimal(value: Any) -> str:
    try:
        return str(value.as_decimal(8)).rstrip("?")
    except AttributeError:
        return str(value)


def lifted_law(facts: Facts, law: Any) -> Any:
    """A law whose floats are exact; whole numbers stay what they are."""
    return with_floats(law, facts.constant)


def with_floats(law: Any, of: Callable[[float], Any]) -> Any:
    """A law, or part of it, with something else for each float."""
    if isinstance(law, tuple):
        values = (with_floats(value, of) for value in law)
        return type(law)(*values) if hasattr(law, "_fields") else tuple(values)
    return of(law) if isinstance(law, float) else law
