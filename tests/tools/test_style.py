"""What the tools that keep this tree are for, they find: a promise without a test, a broken rule, a row of figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import style
from tools.figures import replaced
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


FIGURES = """\
| claim | limit | value | command | commit |
|---|---|---|---|---|
| old | 1 | 2 | `python a.py` | aaa |
| other | 1 | 2 | `python b.py` | aaa |
| old, too | 1 | 2 | `python a.py` | aaa |
Text.
"""


def test_the_rows_of_a_command_are_those_that_it_prints() -> None:
    page = replaced(FIGURES, "python a.py", ["| new | – | 3 |"], "bbb")
    assert page == FIGURES.replace(
        "| old | 1 | 2 | `python a.py` | aaa |", "| new | – | 3 | `python a.py` | bbb |"
    ).replace("| old, too | 1 | 2 | `python a.py` | aaa |\n", "")


PLANTED = '''
"""Of no use."""
from functools import cached_property

class A:
    """A thing."""

    x: int
    """Whether it is so."""

    @cached_property
    def twice(self):
        """How it is done."""
        try:
            pass
        except ValueError as err:
            pass
        except KeyError as err:
            pass
'''


def test_each_rule_finds_what_breaks_it(tmp_path: Path) -> None:
    (tmp_path / "planted.py").write_text(PLANTED)
    (tmp_path / "README.md").write_text("[one](planted.py#a) [two](missing.md) [three](https://a.b/c)" + " " * 20_000)
    found = [line.removeprefix(f"{tmp_path}/").partition(": ")[0] for line in (
        *style.docstring_problems(tmp_path / "planted.py"),
        *style.compiled_problems(tmp_path / "planted.py"),
        *style.link_problems(tmp_path / "README.md"),
        *style.size_problems(tmp_path),
    )]  # fmt: skip
    assert sorted(found) == ["README.md", "README.md", *(f"planted.py:{line}" for line in (11, 12, 13, 9))]


def test_this_tree_breaks_no_rule() -> None:
    assert not list(style.problems(style.ROOT))
