"""The page from equation to function: a row for each number of the thesis, and names that exist."""

from __future__ import annotations

import importlib
import re
from functools import reduce
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs/studies/equations.md"
LAST = {3: 15, 4: 48, 5: 16, 6: 6}
"""Number of the last equation of each chapter of the thesis: 85 in all."""


def rows() -> list[tuple[str, str, str]]:
    return re.findall(r"^\| (\d\.\d+) \| (.+) \| (.+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


def test_each_of_the_85_equations_has_one_row() -> None:
    wanted = [f"{chapter}.{number}" for chapter, last in LAST.items() for number in range(1, last + 1)]
    assert [number for number, *_ in rows()] == wanted
    assert len(wanted) == 85


def test_each_name_that_a_row_gives_exists() -> None:
    for number, _, where in rows():
        (name,) = re.findall(r"^`([\w.]+)`$", where)
        parts = name.split(".")
        for depth in range(len(parts) - 1, 0, -1):
            try:
                module = importlib.import_module(".".join(parts[:depth]))
            except ModuleNotFoundError:
                continue
            assert reduce(getattr, parts[depth:], module) is not None, number
            break
        else:
            raise AssertionError(f"{number}: there is no {name}")
