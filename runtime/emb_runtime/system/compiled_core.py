"""The compiled core: the modules of the cycle as machine code, in place of their sources.

A wheel for one kind of processor has them beside the sources, from which mypyc compiled them
(``tools/compile_core.py``); whoever builds it compares both, bit for bit (``tests/compiled``). Nothing
imports them by itself: :func:`choose`, which ``emb-run`` calls before it imports anything else, puts a finder in front
of Python's. Every other command works with the sources.

``EMB_CORE`` decides otherwise: ``python`` takes the sources, ``compiled`` the compiled core in every command of this
environment. The processes that a command starts take the sources.

Idioms that only speed or the compiler asks for, in the modules that are compiled:

* ``tuple.__new__(Frame, (...))``, all fields in their order: the constructor of a named tuple is interpreted, also
  where compiled code calls it, and takes twice as long.
* ``IDLE: Final = NodeState.IDLE``, ``MISSED: Final = int(Reason.MISSED)``: in Python 3.11 a member of an enumeration
  takes as long as a call, and an ``IntFlag`` combines its members in Python.
* Another name in each ``except … as name``: mypyc gives a name the type of the function's first clause, and
  another exception becomes a TypeError.
* ``Number`` (``can/codec.py``) for what may be an int or a float: the annotation ``float`` converts ints.
* No ``cached_property``, which is computed at each access; no subclass of a compiled class and no replaced method:
  functions and protocols are handed in.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import NamedTuple

from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import complain, one_line

CHOICE = "EMB_CORE"  # Name in the environment
FOLDER = Path(__file__).parents[1] / "native"  # Folder of the compiled modules and their manifest
MANIFEST = "manifest.json"

_ROOT = Path(__file__).parents[2]


class Core(NamedTuple):
    """The core that this process runs."""

    compiled: bool
    text: str  # Its name, for people and for the log
    warning: str = ""  # Reason for which a compiled core that is installed is not taken


class CoreError(Exception):
    """There is no compiled core for this interpreter and these sources."""


class _Finder:
    """Finds compiled modules by name, before Python's finders find their sources."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files

    def find_spec(self, name: str, _path: Sequence[str] | None = None, _target: object = None) -> ModuleSpec | None:
        """The module's place; None if it is not one of the core."""
        file = self.files.get(name)
        return None if file is None else spec_from_file_location(name, FOLDER / file)


_running = Core(False, "Python")


def running() -> Core:
    """The core that this process runs."""
    return _running


def choose() -> None:
    """Take the compiled core if one is installed for these sources, unless ``EMB_CORE`` forbids."""
    global _running
    choice = os.environ.get(CHOICE, "")
    if choice not in ("", "python", "compiled"):
        raise UsageError(f"{CHOICE}: expected python or compiled, got '{choice}'")
    if choice == "python":
        _running = Core(False, f"Python, as {CHOICE} asks")
    elif not choice and (FOLDER / MANIFEST).exists():  # else this package has taken it already
        try:
            take_compiled()
        except CoreError as err:
            _running = Core(False, "Python", f"the compiled core is not taken: {err}")


def take_or_end() -> None:
    """Take the compiled core, as ``EMB_CORE=compiled`` asks, or end this process."""
    try:
        take_compiled()
    except CoreError as err:
        raise SystemExit(complain(f"{CHOICE}=compiled", UsageError(str(err)))) from err


def take_compiled() -> None:
    """Have the modules of the core imported compiled from now on; raises CoreError if there is none."""
    global _running
    finder = _Finder(_files())
    sys.meta_path.insert(0, finder)
    try:
        for name in finder.files:
            if "." not in name:  # the library that holds their code
                importlib.import_module(name)
    except Exception as err:  # whatever is wrong with it: the sources are there
        sys.meta_path.remove(finder)
        raise CoreError(one_line(f"{type(err).__name__}: {err}")) from err
    _running = Core(True, f"compiled (mypyc, {platform.machine().replace('_', '-')})")


def _files() -> dict[str, str]:
    """Files of the compiled modules by name, the library that holds their code among them."""
    try:
        found = json.loads((FOLDER / MANIFEST).read_text(encoding="utf-8"))
        files: dict[str, str] = found["files"]
        current = identity(name for name in files if "." in name)
    except (OSError, ValueError, TypeError, KeyError) as err:
        raise CoreError(f"its manifest or a source cannot be read: {one_line(str(err))}") from err
    if found["identity"] != current:
        raise CoreError("it was compiled from other sources, or for another interpreter or processor")
    return files


def identity(modules: Iterable[str]) -> list[str]:
    """Interpreter, processor, and hash of the sources of modules."""
    digest = hashlib.sha256()
    for name in sorted(modules):
        digest.update(name.encode() + b"\0")
        digest.update(_ROOT.joinpath(*name.split(".")).with_suffix(".py").read_bytes() + b"\0")
    return [str(sys.implementation.cache_tag), platform.machine(), digest.hexdigest()]
