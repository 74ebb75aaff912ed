"""Modules, names and files that the pages speak of exist."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [f"/{path.relative_to(ROOT)}" for kind in ("py", "dbc") for path in ROOT.glob(f"[a-z]*/**/*.{kind}")]
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
