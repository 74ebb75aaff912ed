"""Trials: the tests of a module with one change of it, each in a process of its own, until the first failure.

The libraries are imported once, and each trial is a fork, so that nothing that a mutant does outlives it and no file is
written. A change inside a function that nothing calls while the tests are collected is put into the collected tests:
the function gets other code. For any other change the tests are collected anew, with an import hook that gives the
module changed.

A trial has a limit of processor time, which does not depend on how busy the machine is. hypothesis draws the same
examples every time.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import importlib
import importlib.machinery
import importlib.util
import io
import itertools
import json
import math
import multiprocessing
import os
import resource
import select
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import _exit
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType

import hypothesis
import pytest

from tests.mutation.operators import changes

ROOT = Path(__file__).parents[2]
WORKERS = 2
ALLOWANCE = 3.0
"""Times the unchanged module's processor time, and seconds more, until a mutant counts as one that hangs."""
MEMORY = 4 << 30  # Bytes of data that a mutant may take
UNCHANGED = -1  # In place of a mutant's number
CONTROL = -2  # The same: every function raises


@dataclass(frozen=True)
class Mutant:
    """One change of a module."""

    module: str
    number: int  # Among the changes of the module
    line: int
    operator: str
    where: str  # Qualified name of the function or class
    in_body: bool  # Whether it leaves the function's or class's first line alone
    was: str  # The statement
    becomes: str

    def __str__(self) -> str:
        place = f"{self.module}.py:{self.line} {self.operator} in {self.where or 'the module'}"
        return f"{place}\n    - {self.was}\n    + {self.becomes}"


@dataclass(frozen=True)
class Trial:
    """What the tests said of one change."""

    by: str  # The test that failed first, or how else the process ended; empty if all passed
    durations: Mapping[str, float]  # Of each test [s]
    processor_time: float  # [s]


@dataclass
class Experience:
    """What earlier trials of a module have taught: which tests to begin with, and when to give up."""

    kills: dict[str, Counter[str]] = field(default_factory=dict)  # By each test, of the mutants in each function
    durations: Mapping[str, float] = field(default_factory=dict)  # Of each test, with the module unchanged [s]
    limit: float = 600.0  # Processor time until a mutant counts as one that hangs [s]


Tell = Callable[[Mutant, str], None]


class UntrustworthyError(Exception):
    """The tests of a module cannot judge its mutants; the message says why."""


def mutants_of(module: str) -> list[Mutant]:
    """All mutants of a module, in the order of its source."""
    return [
        Mutant(
            module,
            number,
            change.line,
            change.operator,
            change.where,
            not isinstance(change.statement, (ast.FunctionDef, ast.ClassDef)),
            *change.texts(),
        )
        for number, change in enumerate(changes(ast.parse(path_of(module).read_bytes())))
    ]


def judge_all(module: str, tests: Sequence[str], tell: Tell) -> None:
    """Judge every mutant of a module, and tell which test noticed it or how its process ended; empty if it survived.

    Raises :class:`UntrustworthyError`: the tests fail without a change, or pass with one that nothing could survive.
    """
    so_far = Experience()
    unchanged = _trial(so_far, "", lambda plugin: _collected_anew(module, UNCHANGED, tests, plugin))
    if unchanged.by:
        raise UntrustworthyError(f"{module}: its tests fail without any change: {unchanged.by}")
    if not _trial(so_far, "", lambda plugin: _collected_anew(module, CONTROL, tests, plugin)).by:
        raise UntrustworthyError(f"{module}: its tests pass although every function raises")
    so_far.limit = ALLOWANCE * (1.0 + unchanged.processor_time)
    so_far.durations = unchanged.durations
    mutants = mutants_of(module)
    collected = _Collected(module, mutants, so_far, tell)
    with collected.watching_calls():
        _pytest(tests, collected)
    if collected.failed:
        raise UntrustworthyError(f"{module}: its tests fail without any change: {collected.failed}")
    forget_our_modules()

    def judge(mutant: Mutant) -> str:
        return _noticed(so_far, mutant, lambda plugin: _collected_anew(module, mutant.number, tests, plugin))

    _in_workers(judge, [mutant for mutant in mutants if mutant not in collected.judged], tell)


def import_libraries(tests: Sequence[str]) -> None:
    """Import all that the tests import, and forget our own modules again."""
    os.environ["NUMBA_DISABLE_JIT"] = "1"  # a compiled function kept on disk is an unchanged one
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in sorted(set(tests)):
        importlib.import_module(".".join(Path(name).with_suffix("").parts))
    forget_our_modules()
    gc.collect()
    gc.freeze()
    gc.disable()  # in the trials too: they are short
    hypothesis.settings.register_profile(
        "mutation",
        derandomize=True,
        max_examples=50,
        database=None,
        deadline=None,
        phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),  # no search for a smaller example
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    hypothesis.settings.load_profile("mutation")


def forget_our_modules() -> None:
    """So that the next import is a new one."""
    for name in list(sys.modules):
        if name.startswith(("emb_", "tests.")) and not name.startswith("tests.mutation"):
            del sys.modules[name]


class _Changed(importlib.machinery.SourceFileLoader):
    """Finds one module of the runtime, and loads it with one change."""

    def __init__(self, module: str, number: int) -> None:
        super().__init__(f"emb_runtime.{module}", str(path_of(module)))
        self.number = number

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def get_code(self, fullname: str) -> CodeType:
        """Always from the source: nothing is kept in ``__pycache__``."""
        tree = ast.parse(Path(self.path).read_bytes())
        if self.number == CONTROL:
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef):
                    node.body = ast.parse("raise AssertionError").body
        elif self.number != UNCHANGED:
            next(itertools.islice(changes(tree), self.number, None)).make()
        return compile(tree, self.path, "exec", dont_inherit=True)


class _UntilFailure:
    """Runs first what has killed most nearby and takes least; ends the process at the first failure."""

    def __init__(self, so_far: Experience, where: str, writer: int) -> None:
        self.so_far = so_far
        self.where = where
        self.writer = writer
        self.durations: dict[str, float] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        here = self.so_far.kills.get(self.where, Counter())
        items.sort(key=lambda item: (-here[item.nodeid], self.so_far.durations.get(item.nodeid, 0.0)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.durations[report.nodeid] = self.durations.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.tell(report.nodeid)
            _exit(1)  # what pytest and the interpreter do at their end takes longer than many a test

    def tell(self, failed: str) -> None:
        with os.fdopen(self.writer, "w") as pipe:
            json.dump([failed, self.durations], pipe)


class _Collected:
    """Judges, in place of running the collected tests once, all mutants whose function nothing has called so far."""

    def __init__(self, module: str, mutants: list[Mutant], so_far: Experience, tell: Tell) -> None:
        self.module = module
        self.mutants = mutants
        self.so_far = so_far
        self.tell = tell
        self.called: set[str] = set()
        self.failed = ""
        self.judged: list[Mutant] = []

    @contextlib.contextmanager
    def watching_calls(self) -> Iterator[None]:
        """Remember the functions that are called, of the module that is imported meanwhile."""
        hook = _Changed(self.module, UNCHANGED)

        def called(frame: FrameType, _event: str, _argument: object) -> None:
            if frame.f_code.co_filename == hook.path:
                self.called.add(frame.f_code.co_qualname)

        sys.meta_path.insert(0, hook)
        sys.setprofile(called)
        try:
            yield
        finally:
            sys.setprofile(None)
            sys.meta_path.remove(hook)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        sys.setprofile(None)
        functions = _functions(sys.modules[f"emb_runtime.{self.module}"])

        def run(mutant: Mutant | None) -> Callable[[_UntilFailure], int]:
            def with_change(plugin: _UntilFailure) -> int:
                if mutant is not None:
                    code = _Changed(self.module, mutant.number).get_code("")
                    functions[mutant.where].__code__ = _inside(code, mutant.where)
                return _run_collected(session, plugin)

            return with_change

        self.failed = _trial(self.so_far, "", run(None)).by
        if not self.failed:
            untouched = functions.keys() - self.called
            self.judged = [m for m in self.mutants if m.in_body and m.where in untouched]
            _in_workers(lambda mutant: _noticed(self.so_far, mutant, run(mutant)), self.judged, self.tell)
        return True


def _collected_anew(module: str, number: int, tests: Sequence[str], plugin: _UntilFailure) -> int:
    sys.meta_path.insert(0, _Changed(module, number))
    return _pytest(tests, plugin)


def _run_collected(session: pytest.Session, plugin: _UntilFailure) -> int:
    session.config.pluginmanager.register(plugin)
    items = list(session.items)
    plugin.pytest_collection_modifyitems(items)
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
    return 0


def _pytest(tests: Sequence[str], plugin: object) -> int:
    with contextlib.redirect_stdout(io.StringIO()):
        return int(pytest.main(["-s", "--tb=no", "--assert=plain", "-p", "no:cacheprovider", *tests], [plugin]))


def _functions(module: ModuleType) -> dict[str, FunctionType]:
    """A module's functions and its classes' methods whose code is their own, by qualified name."""
    values: list[object] = list(vars(module).values())
    for cls in [value for value in values if isinstance(value, type) and value.__module__ == module.__name__]:
        values += vars(cls).values()
    found = (
        value.fget if isinstance(value, property) else getattr(value, "__func__", value)  # class and static methods
        for value in values
    )
    return {
        f.__code__.co_qualname: f
        for f in found
        if isinstance(f, FunctionType) and f.__code__.co_filename == module.__file__
    }


def _inside(code: CodeType, where: str) -> CodeType:
    """The code of one function of a module."""
    inner = [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    for each in inner:
        if each.co_qualname == where:
            return each
    return next(_inside(each, where) for each in inner if where.startswith(f"{each.co_qualname}."))


_judge: Callable[[Mutant], str]


def _in_workers(judge: Callable[[Mutant], str], mutants: Sequence[Mutant], tell: Tell) -> None:
    with multiprocessing.get_context("fork").Pool(WORKERS, _remember, [judge]) as pool:
        for mutant, by in zip(mutants, pool.imap(_judge_in_worker, mutants), strict=True):
            tell(mutant, by)


def _remember(judge: Callable[[Mutant], str]) -> None:
    global _judge
    _judge = judge


def _judge_in_worker(mutant: Mutant) -> str:
    return _judge(mutant)


def _noticed(so_far: Experience, mutant: Mutant, run: Callable[[_UntilFailure], int]) -> str:
    by = _trial(so_far, mutant.where, run).by
    so_far.kills.setdefault(mutant.where, Counter())[by] += 1
    return by


def _trial(so_far: Experience, where: str, run: Callable[[_UntilFailure], int]) -> Trial:
    """Run tests in a process of its own, and wait for what it says."""
    reader, writer = os.pipe()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    child = os.fork()
    if child == 0:
        _child(so_far, where, run, writer)
    os.close(writer)
    # Processor time is limited in the child; this is for one that waits for ever.
    if not select.select([reader], [], [], 60.0 + 20.0 * so_far.limit)[0]:
        os.kill(child, signal.SIGKILL)
    with os.fdopen(reader) as pipe:
        told = pipe.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    by, durations = json.loads(told or '["", {}]')
    return Trial(by or (f"its process ended with {code}" if code else ""), durations, spent)


def _child(so_far: Experience, where: str, run: Callable[[_UntilFailure], int], writer: int) -> None:
    """Run tests and leave; never comes back."""
    code = 1
    try:
        seconds = math.ceil(so_far.limit)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        plugin = _UntilFailure(so_far, where, writer)
        code = run(plugin)
        plugin.tell("")
    finally:
        _exit(code)


def path_of(module: str) -> Path:
    """The file of a module of emb_runtime."""
    return ROOT / "runtime" / "emb_runtime" / f"{module.replace('.', '/')}.py"
