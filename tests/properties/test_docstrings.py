"""``tools.style`` finds what it is for, and nothing in this tree."""

from __future__ import annotations

from pathlib import Path

from tools import style

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
