"""Pages of the documentation that are made from the code: a hook of mkdocs, and an extension of its docstring reader.

mkdocs calls :func:`on_config` and :func:`on_files` at each build. ``reference/modules/`` has a page for each
sub-package and module of the four packages, ``reference/commands.md`` the ``--help`` of every command and sub-command.
The tables of sub-packages, CAN messages and log topics and the advice for faults replace a marker in pages that are
written by hand.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PACKAGES = ("runtime/emb_runtime", "bench/emb_bench", "train/emb_train", "export/emb_export")
MODULES = "reference/modules/"
HELP_WIDTH = "80"  # Columns of the ``--help`` texts, as in a terminal


class PlainReferences(griffe.Extension):
    """Sphinx's roles in docstrings become code: ``:class:`~a.b.C``` is shown as ``C``."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = plain_references(obj.docstring.value)


def plain_references(text: str) -> str:
    """A docstring whose references to code are plain code."""
    text = re.sub(r":[a-z]+:`~(?:[\w.]*\.)?(\w+)`", r"`\1`", text)
    text = re.sub(r":[a-z]+:`([^`]+)`", r"`\1`", text)
    return text.replace("] [", "]\u2060 [")  # a shape and its unit are no link


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of the modules into the navigation."""
    for part in config.nav or []:
        for pages in part.values():
            for page in pages if isinstance(pages, list) else []:
                if page.get("Modules") == f"{MODULES}index.md":
                    page["Modules"] = [f"{MODULES}index.md"] + [
                        {package.name: [{room: path} for room, path, _ in rooms(package)]}
                        for package in map(Path, PACKAGES)
                    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are generated as a whole."""
    index = ["# Modules\n", "Imports point down only: runtime, then bench, then train, then export.\n"]
    for package in map(Path, PACKAGES):
        index += [f"## {package.name}\n", f"{first_line(package)}\n"]
        for room, path, module in rooms(package):
            text = f"# {module}\n\n::: {module}\n"
            files.append(File.generated(config, path, content=text))
            index.append(f"- [{room}]({path.removeprefix(MODULES)}): {first_line(package / room)}")
        index.append("")
    files.append(File.generated(config, f"{MODULES}index.md", content="\n".join(index)))
    files.append(File.generated(config, "reference/commands.md", content=commands_page()))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Replace each marker in a page that is written by hand by its tables."""
    for marker, tables in MARKERS.items():
        if marker in markdown:
            markdown = markdown.replace(marker, tables())
    return markdown


def rooms_table() -> str:
    """A table of the sub-packages, lowest first, each with the first paragraph of its docstring."""
    order = ast.parse((ROOT / "tests/properties/test_import_direction.py").read_text(encoding="utf-8"))
    (found,) = (n.value for n in order.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "ROOMS")
    lines = ["| sub-package | what it is for |", "|---|---|"]
    for package, names in ast.literal_eval(found).items():
        lines.append(f"| **{Path(package).name}** | {first_line(Path(package))} |")
        lines += [f"| `{name}` | {first_line(Path(package) / name)} |" for name in names.split()]
    return "\n".join(lines)


def rooms(package: Path) -> Iterator[tuple[str, str, str]]:
    """The sub-packages and modules of a package: name, path of the page, and name to import."""
    for entry in sorted((ROOT / package).iterdir()):
        if (entry / "__init__.py").exists() or (entry.suffix == ".py" and entry.stem != "__init__"):
            yield entry.stem, f"{MODULES}{package.name}/{entry.stem}.md", f"{package.name}.{entry.stem}"


def first_line(module: Path) -> str:
    """The first paragraph of the docstring of a package or module, in one line."""
    folder = ROOT / module
    source = folder / "__init__.py" if (folder / "__init__.py").exists() else folder.with_suffix(".py")
    docstring = griffe.visit(module.name, source, source.read_text(encoding="utf-8")).docstring
    text = "" if docstring is None else docstring.value.partition("\n\n")[0]
    return plain_references(" ".join(text.split()).replace("``", "`"))


def commands_page() -> str:
    """The page of all commands."""
    lines = ["# Commands\n", "The `--help` of each command, as this version prints it.\n"]
    for name, parser in command_parsers().items():
        for title, text in helps(name, parser):
            lines += [f"{'###' if ' ' in title else '##'} {title}\n", f"``` {{.text .help}}\n{text}```\n"]
    return "\n".join(lines)


class _Parsed(BaseException):
    """Carries the parser of a command out of its entry point."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


def command_parsers() -> dict[str, argparse.ArgumentParser]:
    """The argument parser of each command in ``pyproject.toml``."""

    def caught(self: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        raise _Parsed(self)

    def parser_of(start: Callable[[], Any], *argv: str) -> argparse.ArgumentParser:
        with (
            mock.patch.object(argparse.ArgumentParser, "parse_known_args", caught),
            mock.patch.object(sys, "argv", list(argv)),
        ):
            try:
                start()
            except _Parsed as parsed:
                return parsed.parser
        raise RuntimeError(f"{' '.join(argv)} parses no arguments")

    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    parsers = {}
    for name, entry in scripts.items():
        module, _, function = entry.partition(":")
        start = getattr(importlib.import_module(module), function)
        parsers[name] = parser_of(start, name)
        # Those that are commands of their own, recognised by their line in the --help, such as emb-train evaluate.
        for further in re.findall(rf"^  {name} (\w+)  ", parsers[name].format_help(), re.MULTILINE):
            parsers[f"{name} {further}"] = parser_of(start, name, further)
    return parsers


def helps(title: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """The help texts of a parser and its sub-commands, each with its title."""
    with mock.patch.dict("os.environ", COLUMNS=HELP_WIDTH, NO_COLOR="1"):
        yield title, parser.format_help()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, sub in action.choices.items():
                yield from helps(f"{title} {name}", sub)


def messages_tables() -> str:
    """A table of signals for each message of the shipped DBC."""
    import cantools

    database = cantools.database.load_file(ROOT / "runtime/emb_runtime/can/emb.dbc")
    assert isinstance(database, cantools.database.can.Database)
    lines = []
    for message in database.messages:
        lines += [f"### {message.name} (0x{message.frame_id:03X}, {message.length} bytes)\n", f"{message.comment}\n"]
        lines += ["| signal | bits | step | range | unit | meaning |", "|---|---|---|---|---|---|"]
        for s in message.signals:
            choices = ", ".join(f"{value} {name}" for value, name in (s.choices or {}).items())
            meaning = " ".join(filter(None, (s.comment, choices)))
            bits = f"{s.start}, {s.length}"
            lines.append(
                f"| `{s.name}` | {bits} | {s.scale:g} | {s.minimum:g} to {s.maximum:g} | {s.unit or ''} | {meaning} |"
            )
        lines.append("")
    return "\n".join(lines)


def topics_tables() -> str:
    """A table of fields for each topic of a log that the bench's DBC does not describe."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto

    from emb_runtime.log import topics

    lines = []
    for topic, message in topics.TOPICS.items():
        if topic.startswith("/emb/"):
            continue
        notes = topics.metadata(message)
        units = json.loads(notes.get("units", "{}"))
        lines += [f"### {topic}\n", f"Message `emb.{message}`. {notes.get('description', '')}\n"]
        lines += ["| field | type | unit | meaning |", "|---|---|---|---|"]
        for field in topics.message_class(message).DESCRIPTOR.fields:
            kind = FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
            choices = [f"{value.number} {value.name}" for value in field.enum_type.values] if field.enum_type else []
            meaning = "; ".join(filter(None, (notes.get(field.name, ""), ", ".join(choices))))
            lines.append(f"| `{field.name}` | {kind} | {units.get(field.name, '')} | {meaning} |")
        lines.append("")
    return "\n".join(lines)


def faults_tables() -> str:
    """A table of causes and advice, as the summary of a run gives them."""
    from emb_runtime.safety.state_machine import FAULTS

    lines = ["| fault | cause | advice |", "|---|---|---|"]
    lines += [f"| {fault.name} | {info.cause} | {info.advice} |" for fault, info in FAULTS.items()]
    return "\n".join(lines)


def peers_table() -> str:
    """The comparison with other programs of the README."""
    return (ROOT / "README.md").read_text(encoding="utf-8").split("<!-- peers -->\n")[1].split("\n<!-- /peers -->")[0]


MARKERS = {
    "<!-- peers -->": peers_table,
    "<!-- rooms -->": rooms_table,
    "<!-- messages -->": messages_tables,
    "<!-- topics -->": topics_tables,
    "<!-- faults -->": faults_tables,
}
