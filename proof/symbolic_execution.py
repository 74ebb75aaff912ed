"""The very functions that run, on other numbers than floats.

A lifted function is the same code object; in its globals ``math`` is a version that knows the other numbers, functions
of ours are lifted as well, and what is replaced by name is replaced. A comparison of such numbers asks the path that is
being walked which way to go; :func:`walk` repeats the call until every way has been gone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import FunctionType
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
    lifted = FunctionType(fn.__code__, inside, fn.__name__, fn.__defaults__)
    done[fn] = lifted
    for name in fn.__code__.co_names:
        value = inside.get(name)
        if isinstance(value, FunctionType) and value.__module__.partition(".")[0] in PACKAGES:
            inside[name] = _lift(value, scope, done)
    inside.update(scope)
    return lifted
