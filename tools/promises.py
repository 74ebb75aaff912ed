"""Promises of the pages beside the tests that would fail if they did not hold; part of ``make lint``.

docs/reference/promises.md has a table for each page: a sentence of it, word for word, and its tests or searches. A
promise is every sentence of SECTIONS, and every sentence of PAGES with one of WORDS. Found are promises without a row,
rows whose sentence is not on its page, and rows without a test of that name in its file or a search of ``make night``.
Whether the test would fail is not checked, nor what runs it: slow ones ``make night``, those of tests/hil ``make hil``.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TABLES = "docs/reference/promises.md"
PAGES = ("README.md", "SECURITY.md", "docs/explanation/*.md", "docs/howto/*.md", "docs/reference/*.md")
SECTIONS = {
    "README.md": [("## Safety\n", "[One run,"), ("Each run first", "[Some sensor")],
    "SECURITY.md": [
        ("shield.md):\n", "\n| "),
        ("## Files from outside\n", "A policy from"),
        ("## Viewers\n", "\n## "),
    ],
    "docs/howto/first-contact.md": [("If a check fails", "\n\n")],
    "docs/howto/map-a-drive.md": [("It waits for samples", "**From then")],
    "docs/howto/read-a-log.md": [("Every command that prints", "\n\n")],
    "docs/reference/bench-toml.md": [("An unknown key", "\n\n"), ("A bench file can narrow", "The\nlongest values")],
    "docs/reference/contract.md": [("If a policy does not fit", "\n\n"), ("An output that is not finite", "\n\n")],
    "docs/reference/fault-codes.md": [("A latched fault", "The codes")],
    "docs/reference/log-topics.md": [("A log that was cut", "\n\n"), ("A log that does not hold", "Texts that")],
}
"""Parts of a page, from one text to another, of which every sentence is a promise."""
WORDS = re.compile(
    r"(?<!\")\b([Nn]ever|[Aa]lways|[Ww]hatever|[Ww]hichever|in any case|nothing is sent|only code|limits hold for"
    r"|[Ee]very (exit path|decision|command has))\b"
)
SENTENCE = re.compile(r"(?<=[.!?])\s+(?=[A-Z`0-9])")
LINK = re.compile(r"\[(`[^`]+`|[^\]]+)\]\([^)]*\)")
TEST = re.compile(r"`(tests/[\w/]+\.py)(?:::(test_\w+))?`")


def sentences(page: str) -> list[str]:
    """The sentences of a page as they are read: without tables, headings, code, links and emphasis."""
    text = LINK.sub(r"\1", re.sub(r"```.*?```", "", page, flags=re.DOTALL)).replace("**", "")
    blocks = (" ".join(block.split()) for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-|#]|\d+\.) )", text))
    plain = (re.sub(r"^(-|\d+\.) ", "", block) for block in blocks if not block.startswith(("|", "#", "![")))
    return [sentence for block in plain for sentence in SENTENCE.split(block) if sentence]


def promises(name: str, page: str) -> Iterator[str]:
    """The sentences of a page that are promises by the rule above."""
    for begin, end in SECTIONS.get(name, []):
        found = page[page.index(begin) :].partition(end)[0]
        yield from sentences(found.removeprefix(begin if begin.endswith("\n") else ""))
    yield from (sentence for sentence in sentences(page) if WORDS.search(sentence))


def rows(tables: str) -> Iterator[tuple[str, str, str]]:
    """Page, sentence and tests of each row of the tables; each stands under a heading that names its page."""
    page = ""
    for line in tables.splitlines():
        if line.startswith("## "):
            page = line.removeprefix("## ")
        elif page and line.startswith("| ") and not line.startswith("| promise"):
            sentence, _, tests = line.strip("| ").rpartition(" | ")
            yield page, sentence, tests


def problems(root: Path) -> Iterator[str]:
    """Faults of the tables of a tree, and promises that they lack."""
    paths = [path for pattern in PAGES for path in sorted(root.glob(pattern)) if path != root / TABLES]
    pages = {str(path.relative_to(root)): path.read_text(encoding="utf-8") for path in paths}
    night = (root / "Makefile").read_text(encoding="utf-8")
    listed = list(rows((root / TABLES).read_text(encoding="utf-8")))
    for page, sentence, tests in listed:
        if sentence not in sentences(pages.get(page, "")):
            yield f"{TABLES}: {page} does not say: {sentence}"
        named = TEST.findall(tests)
        if not named or TEST.sub("", tests).strip(", "):
            yield f"{TABLES}: expected `tests/FILE.py::test_NAME` or `tests/searches/FILE.py`, got {tests}"
        for file, test in named:
            if not _is_run(root / file, test, night):
                yield f"{TABLES}: neither pytest nor make night runs {file}{test and '::'}{test}"
    with_test = {(page, sentence) for page, sentence, _ in listed}
    for name, page in pages.items():
        for sentence in dict.fromkeys(promises(name, page)):
            if (name, sentence) not in with_test:
                yield f"{name}: a promise without a test in {TABLES}: {sentence}"


def _is_run(path: Path, test: str, night: str) -> bool:
    """True where pytest collects a test, or ``make night`` runs a search."""
    if not path.is_file() or not test:
        return path.is_file() and f"tests.searches.{path.stem}\n" in night.replace(" --", "\n")
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return path.name.startswith("test_") and any(isinstance(n, ast.FunctionDef) and n.name == test for n in body)
