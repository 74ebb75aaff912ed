"""Compilation by numba, for the batch, of the scalar functions that the node runs as plain Python.

:func:`compiled` takes a plain function and everything of ours that it calls by name, and builds the same code objects
with the compiled callees in place of the plain ones. Without ``fastmath`` the compiled arithmetic is that of Python,
bit for bit.

Compiling takes seconds, so the machine code is kept on disk. numba itself does not notice a change in the file of a
callee or a constant. So each function has a directory named after a fingerprint of the code and the constants that it
reaches, as this process has loaded them. Where no directory can be written, each process compiles anew.
"""

from __future__ import annotations

import enum
import hashlib
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import emb_runtime
from emb_runtime.errors import needs

PACKAGES = ("emb_runtime", "emb_bench", "emb_train", "emb_export")
UNUSED_LIFE = 30 * 86400.0  # [s]; each edit of a function leaves its old directory behind
LOCK_WAIT = 30.0  # [s]; then a function is compiled as if nothing were kept

P = ParamSpec("P")
R = TypeVar("R")

_done: dict[tuple[FunctionType, bool, bool], Any] = {}
_turn = threading.RLock()  # numba's setting of where machine code is kept is one for all threads, and is read twice


def compiled(fn: Callable[P, R], *, parallel: bool = False) -> Callable[P, R]:
    """Compile a plain function, and every function of ours that it calls, with numba.

    It may call functions of our packages and of its own package by their plain names, ``math`` and what numba
    supports of numpy. Module constants are frozen as they are at this moment. In one process the same function gives
    the same object again. The compiled function releases the interpreter lock.

    Args:
        fn: a module-level Python function; one that loops over numpy arrays is the usual case.
        parallel: run its own ``numba.prange`` loops on all cores (its callees stay serial).

    Raises:
        UsageError: numba is not installed.
        TypeError: ``fn`` or a callee is not a plain function, is a closure, or calls one of ours through a module.
    """
    return cast("Callable[P, R]", _built(_source_of(fn), parallel, entry=True))


def on_compiling(told: Callable[[int, bool], None]) -> None:
    """Call back after each function that this process compiles, with their number; True after the outermost one."""
    from numba.core import event

    class Listener(event.Listener):
        count = depth = 0

        def on_start(self, _: Any) -> None:
            self.depth += 1

        def on_end(self, _: Any) -> None:
            self.count, self.depth = self.count + 1, self.depth - 1
            told(self.count, self.depth == 0)

    register: Any = event.register  # numba has no types
    register("numba:compile", Listener())


def _built(fn: Any, parallel: bool, *, entry: bool) -> Any:
    """The compiled function; one that is no ``entry`` is called by compiled code only and has no Python wrapper."""
    if not isinstance(fn, FunctionType):
        raise TypeError(f"expected a plain Python function to compile, got {fn!r}")
    key = (fn, parallel, entry)
    if key not in _done:
        with _turn:
            if key not in _done:
                _done[key] = _jit(_with_compiled_callees(fn), _cache_directory(fn, parallel, entry), parallel, entry)
    return _done[key]


def _with_compiled_callees(fn: FunctionType) -> FunctionType:
    """A function with the same code object, over a copy of the globals in which our functions are compiled ones."""
    if fn.__closure__:
        raise TypeError(f"{_name(fn)} is a closure: pass what it captures as arguments")
    scope = dict(fn.__globals__)
    for name, value in _globals_of(fn):
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0] in PACKAGES:
            raise TypeError(f"{_name(fn)} uses the module {value.__name__}: import the functions that it calls by name")
        if _is_ours(value, fn):
            scope[name] = _built(value, False, entry=False)
    clone = FunctionType(fn.__code__, scope, fn.__name__, fn.__defaults__)
    clone.__module__, clone.__qualname__, clone.__doc__ = fn.__module__, fn.__qualname__, fn.__doc__
    return clone


def _source_of(value: Any) -> Any:
    """A function of the runtime's compiled core as its source has it; everything else as it is."""
    if isinstance(value, BuiltinFunctionType) and str(value.__module__).startswith("emb_runtime."):
        return getattr(source_module(value.__module__), value.__name__)
    return value


@cache
def source_module(name: str) -> ModuleType:
    """A module of the runtime from its source, whatever core this process runs; what it imports is of that core."""
    path = Path(emb_runtime.__file__).parent.joinpath(*name.split(".")[1:]).with_suffix(".py")
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _jit(fn: FunctionType, directory: str | None, parallel: bool, entry: bool) -> Any:
    with needs("the batch", "bench"):
        import numba
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = directory or before  # numba reads it once, here, for this function
    bare: dict[str, Any] = {} if entry else {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    try:
        function: Any = numba.njit(nogil=True, parallel=parallel, cache=directory is not None, **bare)(fn)
    finally:
        config.CACHE_DIR = before
    if directory is not None and not config.DISABLE_JIT:  # which leaves the function as it is
        kept = function._cache
        kept.load_overload = _one_process_at_a_time(kept.load_overload, directory)
        kept.save_overload = _one_process_at_a_time(kept.save_overload, directory)
    return function


def _one_process_at_a_time(action: Callable[..., Any], directory: str) -> Callable[..., Any]:
    """Use a function's directory alone; where that cannot be for :data:`LOCK_WAIT`, not at all.

    numba writes the number of a signature and then, to the file of that number, its machine code: a process that came
    between two such steps of another would find the code for other types. The lock is tried for, not waited for: numba
    compiles under one lock for all threads, and a holder that is stopped would hang them all.
    """
    from filelock import FileLock

    def alone(*arguments: Any) -> Any:
        lock = FileLock(Path(directory, "lock"), timeout=LOCK_WAIT)
        try:
            lock.acquire()
        except (OSError, NotImplementedError):  # held by another process, or the file system has no locks
            return None
        try:
            return action(*arguments)
        except (ImportError, AttributeError):  # a type of its signatures is elsewhere in this version
            for kept in Path(directory).glob("*.nb?"):
                kept.unlink()
            return None
        finally:
            lock.release()

    return alone


def _name(fn: FunctionType) -> str:
    return f"{fn.__module__}.{fn.__qualname__}"


def _globals_of(fn: FunctionType) -> list[tuple[str, Any]]:
    """The globals that the function names, with their names; those of its attribute names too, which does no harm."""
    names = sorted(set(_names(fn.__code__)))
    return [(name, _source_of(fn.__globals__[name])) for name in names if name in fn.__globals__]


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _is_ours(value: object, caller: FunctionType) -> bool:
    if not isinstance(value, FunctionType):
        return False
    package = _package(value)
    return package in PACKAGES or package == _package(caller)


def _package(fn: FunctionType) -> str:
    """The package of a function; of one in ``__main__``, that of the module that was started."""
    spec = sys.modules["__main__"].__spec__ if fn.__module__ == "__main__" else None
    return (spec.name if spec is not None else fn.__module__).partition(".")[0]


class _UnknownValueError(Exception):
    """A global whose value cannot be determined from outside: the function that uses it is not kept on disk."""


@cache
def _fingerprint(fn: FunctionType) -> str:
    """Hash of the code of a function, of the constants it uses, and of both of all its callees, all frozen by then."""
    parts = [_name(fn), _describe(fn.__code__), _describe(fn.__defaults__)]
    for name, value in _globals_of(fn):
        parts.append(f"{name}={_fingerprint(value) if _is_ours(value, fn) else _describe(value)}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:24]


def _describe(value: Any) -> str:
    match value:
        case CodeType():
            shape = (value.co_argcount, value.co_flags, value.co_varnames, value.co_names, value.co_code)
            return f"{shape!r} {_describe(value.co_consts)}"
        case tuple():
            return f"{type(value).__qualname__}({', '.join(_describe(v) for v in value)})"
        case frozenset():
            return f"frozenset{sorted(_describe(v) for v in value)}"
        case None | bool() | int() | float() | str() | bytes():
            return repr(value)
        case enum.EnumMeta():
            return repr(list(value))
        case type():
            return f"{value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}"
        case ModuleType():
            return value.__name__
        case FunctionType() | BuiltinFunctionType():
            return f"{value.__module__}.{value.__qualname__}"
    raise _UnknownValueError(f"{value!r}")


def _cache_directory(fn: FunctionType, parallel: bool, entry: bool) -> str | None:
    """A writable directory for just this code, or None."""
    root = _cache_root()
    if root is None:
        return None
    try:
        kind = "-parallel" if parallel else "" if entry else "-callee"
        directory = root / f"{_fingerprint(fn)}{kind}"
        directory.mkdir(exist_ok=True)
        os.utime(directory)  # in use
    except (OSError, _UnknownValueError):
        return None
    return str(directory)


@cache
def _cache_root() -> Path | None:
    """Our part of the user's cache, after removal of directories long unused; None where it cannot be written."""
    try:
        chosen = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
        root = (Path(chosen) if chosen else Path.home() / ".cache") / "emb-excite" / "numba"
        root.mkdir(parents=True, exist_ok=True)
        probe = root / f"probe-{os.getpid()}"
        probe.touch()
        probe.unlink()
        for other in root.iterdir():
            if other.is_dir() and time.time() - other.stat().st_mtime > UNUSED_LIFE:
                shutil.rmtree(other, ignore_errors=True)
    except (OSError, RuntimeError):  # no home directory is a RuntimeError
        return None
    return root
