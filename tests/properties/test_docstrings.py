"""A docstring begins with what a thing is or does, not with a question that the reader has to answer."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("runtime", "bench", "train", "export", "studies", "tools", "examples", "benchmarks")
RIDDLES = ("What", "How", "Whether", "Who", "Which", "Where", "When", "Why", "The same")


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each string that documents a module, class, function or attribute."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for child in node.body:
                if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                    yield child.lineno, str(child.value.value).strip()


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_docstring_begins_as_a_question(folder: str) -> None:
    files = list((ROOT / folder).rglob("*.py"))
    assert files
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in files
        for line, text in docstrings(path)
        if text.startswith(tuple(f"{word} " for word in RIDDLES))
    ]
    assert not found, "\n".join(found)
