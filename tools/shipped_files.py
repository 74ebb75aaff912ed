"""Writes the shipped files that are made from the code: JSON schemas of users' files, and shell completion.

    python -m tools.shipped_files

It needs shtab. ``tests/tools/test_shipped_files.py`` fails while a file is not current.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import inspect
import json
import math
import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import shtab

import emb_bench.config.bench as analysis
from emb_bench.config import plants
from emb_bench.config.machine import Machine
from emb_bench.recordings.map_file import RecordingMap
from emb_bench.report import acceptance
from emb_runtime.config import bench
from emb_runtime.config.schemas import SCHEMAS, schema_file
from emb_runtime.drives import mapping_file

ROOT = Path(__file__).parents[1]
DRAFT = "http://json-schema.org/draft-07/schema#"  # What editors know best
COMMANDS = {
    "emb-run": "emb_runtime.cli.main",
    "emb-gateway": "emb_runtime.cli.gateway",
    "emb-node": "emb_bench.cli.node",
    "emb-replay": "emb_bench.cli.replay",
    "emb-design": "emb_bench.cli.design",
    "emb-commission": "emb_bench.cli.commission",
    "emb-train": "emb_train.cli",
    "emb-export": "emb_export.export",
    "emb-hil": "emb_bench.hil.cli",
}
"""Module with the ``main`` and the ``parser`` of each command."""
SHELLS = {"bash": "completions/bash/{}", "zsh": "completions/zsh/_{}"}
MAPPING: Any = dict  # A type whose parts are found here
LIST: Any = list
_OF_A_FILE = re.compile("FILE|DIR|CSV|POLICY|THETA")  # Names of arguments that may be a file, and something else, too
_FIELD = re.compile(r'^    (\w+): (?:.*?  # (.+)|.*\n    """((?:.|\n)+?)""")$', re.MULTILINE)


# --- schemas --------------------------------------------------------------------------------------------------------


def schema(kind: str) -> dict[str, Any]:
    """The schema of a kind of files, from the record that reads them."""
    plant = _fields(plants.Mechanics) | _fields(plants.Instruments)
    plant["solver"] = (Literal[plants.SOLVERS], "exact")
    of_analysis = {
        "budgets": (_table(analysis.Budgets), None),
        "plants": (MAPPING[str, _struct("Plant", "A brake that can be simulated.", plant)], None),
        "machine": (_table(Machine), None),
    }
    root = {
        "bench": lambda: _struct("Bench", "A bench file.", _fields(bench._Document) | of_analysis),
        "mapping": lambda: _struct("Mapping", "A mapping file.", _fields(mapping_file._File)),
        "map": lambda: _table(RecordingMap),
        "acceptance": lambda: _struct("Acceptance", "An acceptance file.", _fields(acceptance._File)),
    }[kind]()
    found = msgspec.json.schema(root)
    if kind == "bench":  # what a machine does not have, every other bench needs
        top = found["$defs"][root.__name__]
        always = [key for key in top["required"] if key not in analysis.DRIVEN]
        driven = {"required": [key for key in top["required"] if key in analysis.DRIVEN]}
        top |= {"required": always, "if": {"required": ["machine"]}, "else": driven}
    return {"$schema": DRAFT, "title": f"{kind} file of emb-excite", **found}


@functools.cache
def _table(kind: type) -> Any:
    """A record as a table of a file, in which a named tuple has keys, too."""
    doc = re.split(r"\n|(?<=[a-z)])[.] (?=[A-Z])", kind.__doc__ or "")[0]
    return _struct(kind.__name__.lstrip("_"), doc, _fields(kind))


@functools.cache
def _named(names: tuple[str, ...], hint: Any) -> Any:
    """A table whose keys are some of these names."""
    return _struct("_".join(names), "", dict.fromkeys(names, (hint, None)))


def _struct(name: str, doc: str, fields: Mapping[str, tuple[Any, ...]]) -> Any:
    """A table whose keys have a type, and a default if they may be left out."""
    rows = []
    for key, (hint, *default) in fields.items():
        shown = [
            one for one in default if one and isinstance(one, str | int | float) and one not in (math.inf, -math.inf)
        ]
        left_out = {"default": shown[0]} if shown else {"default_factory": lambda: None} if default else {}
        rows.append((re.sub(r"\W", "_", key), hint, msgspec.field(name=key, **left_out)))
    return msgspec.defstruct(name, rows, kw_only=True, forbid_unknown_fields=True, namespace={"__doc__": doc})


def _fields(kind: type) -> dict[str, tuple[Any, ...]]:
    """Type of each field of a record, with its comment, and its default if it has one."""
    hints, found = get_type_hints(kind, include_extras=True), dict[str, tuple[Any, ...]]()
    ours = [base for base in reversed(kind.__mro__) if base.__module__.startswith("emb_")]
    comments = {name: line or text for base in ours for name, line, text in _FIELD.findall(inspect.getsource(base))}
    info: Any = msgspec.inspect.type_info(kind)
    for one in info.fields:
        hint = _converted(hints[one.name])
        if one.name in comments:
            hint = Annotated[hint, msgspec.Meta(description=" ".join(comments[one.name].split()))]
        found[one.name] = (hint,) if one.required else (hint, one.default)
    return found


def _converted(hint: Any) -> Any:
    """A type with tables in place of records; without None, which no TOML has; a tuple as a list of so many."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return Annotated[_converted(parts[0]), *parts[1:]]
    if kind in (Union, UnionType):
        return functools.reduce(operator.or_, (_converted(part) for part in parts if part is not NoneType))
    if kind in (dict, Mapping):
        value = _converted(parts[1])
        return _named(get_args(parts[0]), value) if get_origin(parts[0]) is Literal else MAPPING[str, value]
    if kind is tuple:
        count = None if parts[-1] is ... else len(parts)
        return Annotated[LIST[_converted(parts[0])], msgspec.Meta(min_length=count, max_length=count)]
    is_record = isinstance(hint, type) and (
        is_dataclass(hint) or issubclass(hint, msgspec.Struct) or hasattr(hint, "_fields")
    )
    return _table(hint) if is_record else hint


# --- completion -----------------------------------------------------------------------------------------------------


def completed(command: str) -> argparse.ArgumentParser:
    """The command line of a command, whose paths are completed with names of files."""
    parser: argparse.ArgumentParser = importlib.import_module(COMMANDS[command]).parser()
    parsers = [parser]
    for one in parsers:
        for action in one._actions:
            if action.type is Path or _OF_A_FILE.search(str(action.metavar)):
                action.complete = shtab.FILE  # type: ignore[attr-defined]  # which shtab looks for
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
    return parser


def shipped_files() -> Iterator[tuple[Path, str]]:
    """Each file, and its text."""
    for kind in SCHEMAS:
        path = ROOT / "runtime" / "emb_runtime" / "config" / schema_file(kind)
        text = json.dumps(schema(kind), indent=1, ensure_ascii=False) + "\n"
        # typing keeps one of two equal bounds, 1 or 1.0: whichever module was imported first.
        yield path, re.sub(r'(imum": -?\d+)\.0\b', r"\1", text)
    for command in COMMANDS:
        for shell, place in SHELLS.items():
            yield ROOT / place.format(command), shtab.complete(completed(command), shell) + "\n"


if __name__ == "__main__":
    for path, text in shipped_files():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
