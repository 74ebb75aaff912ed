"""The compiled core: the modules of the cycle as machine code, in place of their sources.

A wheel for one kind of processor has them beside the sources, from which mypyc compiled them
(``tools/compile_core.py``). Nothing imports them by itself: :func:`choose`, which ``emb-run`` calls before it imports
anything else, puts a finder in front of Python's own. Every other command works with the sources.

``EMB_CORE`` decides otherwise: ``python`` takes the sources, ``compiled`` the compiled core in every process of this
environment, whether it agrees with the sources or not: that is for tests and measurements, and the pre-flight warns.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import complain, one_line

CHOICE = "EMB_CORE"  # Name in the environment
FOLDER = Path(__file__).parents[1] / "native"  # Folder of the compiled modules and their manifest
MANIFEST = "manifest.json"

_PACKAGE = __name__.partition(".")[0]
_ROOT = Path(__file__).parents[2]


class Core(NamedTuple):
    """The core that this process runs."""

    compiled: bool
    text: str  # Its name, for people and for the log
    warning: str = ""  # Reason for which a compiled core that is there is not taken, or not compared; empty otherwise


class CoreError(Exception):
    """There is no compiled core for this interpreter and these sources."""


class _Finder:
    """Finds compiled modules by name, before Python's own finders find their sources."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files

    def find_spec(self, name: str, _path: Sequence[str] | None = None, _target: object = None) -> ModuleSpec | None:
        """The module's place; None if it is not one of the core."""
        file = self.files.get(name)
        return None if file is None else spec_from_file_location(name, file)


_running = Core(False, "Python")
_finder: _Finder | None = None
_loaded: dict[str, ModuleType] = {}  # Modules that :func:`sources` has loaded


def running() -> Core:
    """The core that this process runs."""
    return _running


def is_there() -> bool:
    """Returns True if a compiled core is installed, for this interpreter or for another."""
    return (FOLDER / MANIFEST).exists()


def choose(agrees: Callable[[], str]) -> Core:
    """Take the compiled core, if there is one, if it is asked for, and if it agrees with the sources.

    Args:
        agrees: compares the two; returns what differs, empty if nothing does.

    Raises:
        UsageError: ``EMB_CORE`` is neither ``python`` nor ``compiled``.
    """
    global _running
    wanted = os.environ.get(CHOICE, "")
    if wanted not in ("", "python", "compiled"):
        raise UsageError(f"{CHOICE}: expected python or compiled, got '{wanted}'")
    if wanted == "python":
        _running = Core(False, f"Python, as {CHOICE} asks")
    elif is_there() and not _running.compiled:
        before = set(sys.modules)
        try:
            for name in take():  # those that are not compared too: one that cannot be loaded shows now
                importlib.import_module(name)
            difference = agrees()
        except Exception as err:  # whatever is wrong with it: the sources are there
            difference = _named(err)
        if difference:
            _give_back(before)
            _running = Core(False, "Python", f"the compiled core is not taken: {difference}")
    return _running


def take_unchecked() -> None:
    """Take the core without a comparison, as ``EMB_CORE=compiled`` asks; without one the process ends here.

    Raises:
        SystemExit: there is none to take; standard error says why.
    """
    global _running
    try:
        take()
    except Exception as err:  # whatever is wrong with it: it was asked for
        raise SystemExit(complain(f"{CHOICE}=compiled", UsageError(_named(err)))) from err
    _running = Core(True, f"{_running.text}, not compared", f"as {CHOICE} asks")


def take() -> tuple[str, ...]:
    """Have the modules of the core imported compiled from now on, in this process.

    Returns:
        Their names.

    Raises:
        CoreError: there is none for this interpreter and these sources, or a module of it is imported already.
    """
    global _running, _finder
    files = _files()
    if imported := sorted(set(files) & set(sys.modules)):
        raise CoreError(f"{imported[0]} is imported already")
    _finder = _Finder(files)
    sys.meta_path.insert(0, _finder)
    _running = Core(True, f"compiled (mypyc, {platform.machine().replace('_', '-')})")
    return tuple(files)


def sources(*names: str) -> list[ModuleType]:
    """Modules of the core from their sources, in a process that runs the compiled ones: for comparison.

    They see each other, and not the compiled ones; the same module is the same object each time.
    """
    finder = _finder
    if finder is None:
        return [importlib.import_module(name) for name in names]
    before = dict(sys.modules)
    ours = {name for name in finder.files if name.startswith(_PACKAGE)}  # the library has no source
    for name in ours:
        sys.modules.pop(name, None)
    sys.modules.update(_loaded)
    sys.meta_path.remove(finder)
    try:
        return [importlib.import_module(name) for name in names]
    finally:
        sys.meta_path.insert(0, finder)
        _loaded.update({name: sys.modules[name] for name in ours & set(sys.modules)})
        _forget(set(before) - ours)
        for name in ours & set(before):
            _bind(name, before[name])


def _give_back(before: set[str]) -> None:
    """Undo :func:`take`: what has been imported since is imported anew, from its source."""
    global _finder
    if _finder is not None:
        sys.meta_path.remove(_finder)
        _finder = None
    _forget(before)


def _forget(kept: set[str]) -> None:
    for name in set(sys.modules) - kept:
        if name.startswith(f"{_PACKAGE}."):
            del sys.modules[name]


def _bind(name: str, module: ModuleType) -> None:
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    setattr(sys.modules[parent], child, module)


def _files() -> dict[str, str]:
    """Files of the compiled modules by name, the library that holds their code among them.

    Raises:
        CoreError: they are of another interpreter, or of other sources, or not what was compiled.
    """
    manifest = _manifest()
    if (manifest.interpreter, manifest.machine) != (sys.implementation.cache_tag, platform.machine()):
        raise CoreError(f"it is for {manifest.interpreter} on {manifest.machine}")
    if not manifest.sources or not set(manifest.sources) <= set(manifest.files) == set(manifest.digests):
        raise CoreError("its manifest does not name a file and its hash for every source")
    for name, digest in manifest.sources.items():
        if fingerprint(_ROOT.joinpath(*name.split(".")).with_suffix(".py")) != digest:
            raise CoreError(f"it was compiled from another {name}")
    for name, file in manifest.files.items():  # before it is loaded: that can end the process
        if fingerprint(FOLDER / file) != manifest.digests[name]:
            raise CoreError(f"{file} is not what was compiled")
    return {name: str(FOLDER / file) for name, file in manifest.files.items()}


class _Manifest(NamedTuple):
    interpreter: str
    machine: str
    sources: dict[str, str]  # Fingerprint of each source, by module
    files: dict[str, str]  # File of each compiled module, and of the library that holds their code
    digests: dict[str, str]  # Fingerprint of each of these files


def _manifest() -> _Manifest:
    try:
        return _Manifest(**json.loads((FOLDER / MANIFEST).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as err:
        raise CoreError(f"its manifest cannot be read: {err}") from err


def fingerprint(file: Path) -> str:
    """Hash of a source or of a compiled module.

    Raises:
        CoreError: it cannot be read.
    """
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as err:
        raise CoreError(f"{file.name} cannot be read: {err.strerror}") from err


def _named(err: Exception) -> str:
    return str(err) if isinstance(err, CoreError) else one_line(f"{type(err).__name__}: {err}")
