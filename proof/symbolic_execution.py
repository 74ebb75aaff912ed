"""The very functions that run, on other numbers than floats.

A lifted function is compiled from the same source; in its globals ``math`` is a version that knows the other numbers,
functions of ours are lifted as well, and what is replaced by name is replaced. A comparison of such numbers asks the
path that is being walked which way to go; :func:`walk` repeats the call until every way has been gone. What only
selects one of two numbers by their order need not fork: ``b if b < a else a`` is lifted as ``min(a, b)``.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from types import CodeType, FunctionType
from typing import Any, TypeVar

PACKAGES = ("emb_runtime", "emb_bench")
PATHS = 20_000  # More ways through one function are an error in the lemma

R = TypeVar("R")


class DeadEnd(Exception):  # noqa: N818 - not an error: nothing takes this way
    """Nothing that is left can take this way."""


class Path:
    """One way through a computation: decisions in the order in which they came up.

    Args:
        decisions: the first of them, fixed.
    """

    def __init__(self, decisions: tuple[bool, ...] = ()) -> None:
        self._fixed = decisions
        self.decisions: list[bool] = []
        self.forks: list[tuple[bool, ...]] = []
        """Beginnings of the other ways, one for each decision at which both were open and the first was taken."""

    def choose(self, can_hold: bool, can_fail: bool) -> bool:
        """Chooses the way of this path where a comparison can hold, fail, or both.

        Raises:
            DeadEnd: it can do neither.
        """
        position = len(self.decisions)
        if position < len(self._fixed):
            taken = self._fixed[position]
        elif can_hold or can_fail:
            taken = can_hold
            if can_hold and can_fail:
                self.forks.append((*self.decisions, False))
        else:
            raise DeadEnd
        self.decisions.append(taken)
        return taken

    @property
    def is_known(self) -> bool:
        """Returns True if the next decision was made on an earlier walk."""
        return len(self.decisions) < len(self._fixed)


def walk(start: Callable[[tuple[bool, ...]], tuple[Path, R]]) -> Iterator[R]:
    """Every way through a computation.

    Args:
        start: runs it from its beginning on a path with these decisions; gives back the path and what came out.
    """
    waiting: list[tuple[bool, ...]] = [()]
    walked = 0
    while waiting:
        path, result = start(waiting.pop())
        waiting.extend(path.forks)
        yield result
        walked += 1
        if walked > PATHS:
            raise RuntimeError(f"more than {PATHS} ways through one lemma: split it")


def lift(fn: Callable[..., Any], scope: Mapping[str, Any]) -> Callable[..., Any]:
    """The function on other numbers.

    Args:
        fn: a module-level function of ours.
        scope: what names mean in it and in everything of ours that it calls, in place of what they mean there.
    """
    lifted: Callable[..., Any] = _lift(fn, scope, {})
    return lifted


def _lift(fn: Any, scope: Mapping[str, Any], done: dict[Any, Any]) -> Any:
    if fn in done:
        return done[fn]
    inside = dict(fn.__globals__)
    lifted = FunctionType(_code(fn), inside, fn.__name__, fn.__defaults__)
    done[fn] = lifted
    for name in fn.__code__.co_names:
        value = inside.get(name)
        if isinstance(value, FunctionType) and value.__module__.partition(".")[0] in PACKAGES:
            inside[name] = _lift(value, scope, done)
    inside.update(scope)
    return lifted


@cache
def _code(fn: FunctionType) -> CodeType:
    """Code of a function in which each selection is a call."""
    tree = _Selections().visit(ast.parse(inspect.getsource(fn)))
    module = compile(ast.fix_missing_locations(tree), fn.__code__.co_filename, "exec")
    return next(part for part in module.co_consts if isinstance(part, CodeType) and part.co_name == fn.__name__)


class _Selections(ast.NodeTransformer):
    """Makes each conditional expression that selects the lesser or the greater of two numbers ``min`` or ``max``."""

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        self.generic_visit(node)
        name = selection(node)
        return ast.Call(ast.Name(name, ast.Load()), [node.orelse, node.body], []) if name else node


def selection(node: ast.IfExp) -> str:
    """``min`` or ``max`` if a conditional expression gives one of the two numbers that it compares; else empty."""
    test = node.test
    if not isinstance(test, ast.Compare) or not isinstance(test.ops[0], ast.Lt | ast.LtE | ast.Gt | ast.GtE):
        return ""
    compared = [ast.unparse(part) for part in (test.left, *test.comparators)]
    chosen = [ast.unparse(part) for part in (node.body, node.orelse)]
    if sorted(compared) != sorted(chosen):
        return ""
    return "min" if isinstance(test.ops[0], ast.Lt | ast.LtE) == (chosen == compared) else "max"
