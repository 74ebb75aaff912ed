"""Exact real numbers in an SMT solver: a statement is proved when no numbers can be found that break it.

Z3 decides conjunctions of polynomial inequalities over the reals (Jovanović and de Moura, Solving non-linear
arithmetic, IJCAR 2012). Floats enter as the rational numbers that they are; rounding by the law itself is not
covered here.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, NamedTuple

from emb_runtime.errors import UsageError
from tools.proof.symbolic_execution import DeadEnd, Path, lift, walk

Real = Any
"""A term, or a plain number."""

QUESTION_MS = 20_000
"""Time for one question to the solver [ms]."""
PATIENT_MS = 240_000
"""Time where the first answer was none [ms]."""
LONGEST = 900.0
"""Time limit of one statement [s]; M3f takes minutes."""


def solver_module() -> Any:
    """The solver.

    Raises:
        UsageError: it is not installed.
    """
    try:
        return importlib.import_module("z3")  # it comes without types
    except ImportError as err:
        raise UsageError("checking the shield's proof needs z3: pip install 'emb-excite[dev]'") from err


def _exact(value: Any) -> Any:
    if isinstance(value, Term):
        return value.z
    f = Fraction(value)
    return solver_module().Q(f.numerator, f.denominator)


class Term:
    """A real number that the solver knows; made by :meth:`Facts.real` and by arithmetic."""

    __slots__ = ("facts", "z")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, facts: Facts, z: Any) -> None:
        self.facts = facts
        self.z = z

    def __add__(self, other: Real) -> Term:
        return Term(self.facts, self.z + _exact(other))

    __radd__ = __add__

    def __sub__(self, other: Real) -> Term:
        return Term(self.facts, self.z - _exact(other))

    def __rsub__(self, other: Real) -> Term:
        return Term(self.facts, _exact(other) - self.z)

    def __mul__(self, other: Real) -> Term:
        return Term(self.facts, self.z * _exact(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Real) -> Term:
        return self.facts.ratio(self, other)

    def __rtruediv__(self, other: Real) -> Term:
        return self.facts.ratio(other, self)

    def __neg__(self) -> Term:
        return Term(self.facts, -self.z)

    def __abs__(self) -> Real:
        return self.facts.greater(self, -self)

    def __lt__(self, other: Real) -> bool:
        return self.facts.decide(self.z < _exact(other))

    def __le__(self, other: Real) -> bool:
        return self.facts.decide(self.z <= _exact(other))

    def __gt__(self, other: Real) -> bool:
        return self.facts.decide(self.z > _exact(other))

    def __ge__(self, other: Real) -> bool:
        return self.facts.decide(self.z >= _exact(other))

    def __eq__(self, other: object) -> bool:
        return self.facts.decide(self.z == _exact(other))


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
        self.law: Any = None
        """Law of unknown brakes on this path, see :func:`tools.proof.cases.law_terms`."""
        self.goals: list[tuple[str, Any]] = []

    def real(self, name: str, low: Real = None, high: Real = None) -> Term:
        """A number, between bounds if there are any."""
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
        self.assume(_exact(big) >= _exact(small))

    def claim(self, label: str, big: Real, small: Real) -> None:
        """State an order that is to be proved on this path."""
        self.goals.append((label, _exact(big) >= _exact(small)))

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
        solver = self._solver(condition)
        return self._answer(solver)

    def _solver(self, condition: Any, patient: bool = False) -> Any:
        solver = self._z3.SolverFor("QF_NRA") if patient else self._z3.Solver()
        solver.set("timeout", PATIENT_MS if patient else QUESTION_MS)
        solver.add(*self._known, condition)
        return solver

    @staticmethod
    def _answer(solver: Any) -> str:
        answer = str(solver.check())
        if answer == "unknown" and solver.reason_unknown() == "interrupted from keyboard":
            raise KeyboardInterrupt  # z3 has a handler of its own while it searches
        return answer

    def refute(self, goal: Any) -> tuple[str, str]:
        """Searches numbers that break the goal: ``sat`` and the numbers, or another answer."""
        solver = self._solver(self._z3.Not(goal))
        answer = self._answer(solver)
        if answer == "unknown":  # what the default strategy leaves open, the one for polynomials may not
            solver = self._solver(self._z3.Not(goal), patient=True)
            answer = self._answer(solver)
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
        if self.possible(value.z < 0):
            raise ArithmeticError("the root of a number that may be negative")
        root = self.real("root", 0)
        self.assume(root.z * root.z == value.z)
        return root

    def ratio(self, over: Real, under: Real) -> Term:
        """A quotient whose divisor cannot be zero here.

        Raises:
            ArithmeticError: it can be.
        """
        below = _exact(under)
        if self._z3.is_rational_value(self._z3.simplify(below)):
            return Term(self, _exact(over) / below)
        if self.possible(below == 0):
            raise ArithmeticError("a division by what may be zero")
        quotient = self.real("ratio")
        self.assume(quotient.z * below == _exact(over))
        return quotient

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
            a, b = _exact(first), _exact(second)
            return Term(self, self._z3.If(a >= b, a, b))
        return max(first, second)

    def smaller(self, first: Real, second: Real) -> Real:
        """``min``, without a fork."""
        if isinstance(first, Term) or isinstance(second, Term):
            a, b = _exact(first), _exact(second)
            return Term(self, self._z3.If(a <= b, a, b))
        return min(first, second)

    def lift(self, fn: Callable[..., Any], **scope: Any) -> Callable[..., Any]:
        """One of our functions on these numbers, with names in it replaced."""
        maths = SimpleNamespace(sqrt=self.sqrt, isfinite=lambda _: True, inf=math.inf)
        return lift(fn, {"math": maths, "max": self.greater, "min": self.smaller, **scope})


class Answer(NamedTuple):
    """Answer of the solver to one statement."""

    proved: bool
    paths: int
    """Ways through the functions that were followed."""
    breaks: str
    """Numbers that break it, or what the solver could not decide."""


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

    begun = time.monotonic()
    for facts in walk(start):
        if time.monotonic() - begun > LONGEST:
            return Answer(False, paths, f"undecided after {LONGEST:g} s")
        if facts is None:
            continue
        paths += 1
        for label, goal in facts.goals:
            answer, numbers = facts.refute(goal)
            if answer != "unsat":
                broken = f"broken at {numbers}" if answer == "sat" else "undecided in time"
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


def lifted_law(facts: Facts, law: Any, **changed: Real) -> Any:
    """A law whose floats are exact; whole numbers stay what they are."""
    exact: Mapping[str, Any] = {
        name: facts.constant(value) for name, value in law._asdict().items() if isinstance(value, float)
    }
    return law._replace(**{**exact, **changed})
