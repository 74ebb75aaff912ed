"""Modules, names and files that the pages speak of exist, and each equation of the thesis has its function."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [f"/{path.relative_to(ROOT)}" for kind in ("py", "dbc") for path in ROOT.glob(f"[a-z]*/**/*.{kind}")]
EQUATIONS = ROOT / "docs/studies/equations.md"
LAST = {3: 15, 4: 48, 5: 16, 6: 6}
"""Number of the last equation of each chapter of the thesis: 85 in all."""
PAGES = [path for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")) if path.name != "CHANGELOG.md"]


def exists(name: str) -> bool:
    """Whether a dotted name can be imported, or is an attribute of what can be."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def test_what_a_page_names_exists() -> None:
    missing = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        names = re.findall(r"`(emb_(?:runtime|bench|train|export)(?:\.\w+)+)(?:\(\w*\))?`", text)
        files = re.findall(r"`((?:\w+/)*\w+\.(?:py|dbc))`", text) + re.findall(r"python (benchmarks/\w+\.py)", text)
        missing += [(page, name) for name in names if not exists(name)]
        missing += [(page, name) for name in files if not any(path.endswith(f"/{name}") for path in FILES)]
    assert missing == []


def test_the_first_page_lists_every_other_one() -> None:
    docs = ROOT / "docs"
    listed = re.findall(r"\]\(([\w/.-]+\.md)\)", (docs / "index.md").read_text(encoding="utf-8"))
    assert {str(page.relative_to(docs)) for page in docs.rglob("*.md")} - {"index.md", *listed} == set()


def test_each_of_the_85_equations_has_one_row_and_the_name_that_it_gives_exists() -> None:
    text = EQUATIONS.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d\.\d+) \| .+ \| (.+) \|$", text, re.MULTILINE)
    wanted = [f"{chapter}.{number}" for chapter, last in LAST.items() for number in range(1, last + 1)]
    assert [number for number, _ in rows] == wanted
    assert len(wanted) == 85
    for number, where in rows:
        (name,) = re.findall(r"^`([\w.]+)`$", where)
        assert exists(name), number
