"""Rules of style that ruff and mypy have not; part of ``make lint``: ``python -m tools.style``.

A docstring begins with a noun or a verb, not as a question. Links of the pages at the root lead to files, promises have
tests. Pages and pictures stay small. The modules that mypyc compiles avoid what it makes something else of: a cached
property, which would be computed anew each time, and two exceptions caught under one name, which would share the first
one's type.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tools import promises
from tools.compile_core import MODULES

ROOT = Path(__file__).parents[1]
FOLDERS = ("runtime", "bench", "train", "export", "proof", "studies", "tools", "examples", "benchmarks")
QUESTIONS = ("What ", "How ", "Whether ", "Who ", "Which ", "Where ", "When ", "Why ", "The same ")
SIZES = {"README.md": 12_000, "docs/images/*": 150 * 1024, "examples/*.ipynb": 400 * 1024}  # [bytes] at most


def docstring_problems(path: Path) -> Iterator[str]:
    """Docstrings of a file that begin as a question; those of attributes are among them."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for child in node.body:
                if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                    text = str(child.value.value).strip()
                    if text.startswith(QUESTIONS):
                        yield f"{path}:{child.lineno}: a docstring begins as a question: {text.splitlines()[0]}"


def link_problems(page: Path) -> Iterator[str]:
    """Links of a page that lead to no file."""
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http") and not (page.parent / target).is_file():
            yield f"{page}: there is no file {target}"


def size_problems(root: Path) -> Iterator[str]:
    """Files that are larger than they may be."""
    for pattern, most in SIZES.items():
        for path in root.glob(pattern):
            if path.stat().st_size > most:
                yield f"{path}: expected at most {most} bytes, got {path.stat().st_size}"


def compiled_problems(path: Path) -> Iterator[str]:
    """Places of a file that mypyc would make something else of."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Name) and node.id == "cached_property":
            yield f"{path}:{node.lineno}: a cached property in a compiled module"
        if isinstance(node, ast.FunctionDef):
            names = [one.name for one in ast.walk(node) if isinstance(one, ast.ExceptHandler) and one.name]
            if len(names) > len(set(names)):
                yield f"{path}:{node.lineno}: two exceptions are caught under one name in {node.name}"


def problems(root: Path) -> Iterator[str]:
    """All that is found in a tree."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            yield from docstring_problems(path)
    for page in sorted(root.glob("*.md")):
        yield from link_problems(page)
    yield from size_problems(root)
    yield from promises.problems(root)
    for module in MODULES:
        yield from compiled_problems(root.joinpath("runtime", "emb_runtime", *module.split(".")).with_suffix(".py"))


def main() -> int:
    """Print the problems; 1 if there is one."""
    found = [line.replace(f"{ROOT}/", "") for line in problems(ROOT)]
    sys.stdout.writelines(f"{line}\n" for line in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
