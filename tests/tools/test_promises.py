"""A promise without a test is found, and a row that holds no more."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.promises import TABLES, problems

PAGE = (
    "## A page\n\nIt stops. A late [command](x.md) **never** acts,\nand so on. Nothing else.\n\n| never | a table |\n"
)
ROW = "| A late command never acts, and so on. | `tests/test_a.py::test_a`, `tests/searches/b.py` |\n"
README = "\n## README.md\n\n| Each run first stops. | `tests/test_a.py::test_a` |\n"
SECURITY = "Under [it](docs/explanation/shield.md):\n\n| a |\n## Files from outside\nA policy from\n## Viewers\n\n## "


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in {
        TABLES: "# Promises\n\n## docs/explanation/a.md\n\n| promise | test |\n|---|---|\n" + ROW + README,
        "docs/explanation/a.md": PAGE,
        "docs/howto/b.md": "Nothing else.\n",
        "SECURITY.md": SECURITY,
        "README.md": "## Safety\n\n[One run, state by state]\n\nEach run first stops.\n\n[Some sensor",
        "Makefile": "night:\n\tpython -m tests.searches.b\n",
        "tests/test_a.py": "def test_a(): ...\n",
        "tests/searches/b.py": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("docs/explanation/a.md", "Nothing else.", "It always stops.", "a promise without a test"),
        ("docs/howto/b.md", "Nothing else.", "It always stops.", "a promise without a test"),
        ("docs/explanation/a.md", "and so on", "or so", "does not say"),
        ("SECURITY.md", ":\n\n|", ":\n\n- It stops.\n\n|", "a promise without a test"),
        ("tests/test_a.py", "test_a", "test_b", "neither pytest nor make night runs"),
        ("Makefile", "searches.b", "searches.c", "neither pytest nor make night runs"),
        (TABLES, "`tests/test_a.py::test_a`, `tests/searches/b.py`", "see above", "expected `tests/FILE.py"),
    ],
)
def test_what_does_not_hold_is_found(tree: Path, name: str, old: str, new: str, said: str) -> None:
    assert not list(problems(tree))
    text = (tree / name).read_text(encoding="utf-8")
    (tree / name).write_text(text.replace(old, new), encoding="utf-8")
    assert said in " ".join(problems(tree))
