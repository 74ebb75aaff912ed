"""The documentation builds without a warning, is complete, and needs no network to be read."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tools.docs_pages import command_parsers, helps, plain_references

pytestmark = pytest.mark.slow  # the build takes half a minute

ROOT = Path(__file__).parents[2]
PACKAGES = ("runtime/emb_runtime", "bench/emb_bench", "train/emb_train", "export/emb_export")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built; a warning ends the build."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


def test_every_room_has_a_page(site: Path) -> None:
    for package in PACKAGES:
        pages = {path.stem for path in (site / "reference/modules" / Path(package).name).glob("*.html")}
        modules = {path.stem for path in (ROOT / package).glob("*.py")} - {"__init__"}
        rooms = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
        assert pages == modules | rooms


def test_every_command_has_its_help_with_its_exit_codes(site: Path) -> None:
    page = (site / "reference/commands.html").read_text(encoding="utf-8")
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    for command in (*scripts, "emb-replay estimate", "emb-train evaluate"):
        assert f">{command}<" in page
        assert f"usage: {command}" in page
    for command, parser in command_parsers().items():
        for title, text in helps(command, parser):
            assert re.search("exit (codes|status)", text), title


@pytest.mark.parametrize(
    ("page", "rows"), [("dbc", ("CommandCounter", "BenchIdentity")), ("log-topics", ("policy_current", "monotonic_ns"))]
)
def test_tables_made_from_the_code_are_in_their_pages(site: Path, page: str, rows: tuple[str, ...]) -> None:
    text = (site / f"reference/{page}.html").read_text(encoding="utf-8")
    for row in rows:
        assert f"<td><code>{row}</code></td>" in text


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    loading = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
    for path in site.rglob("*.html"):
        assert not loading.search(path.read_text(encoding="utf-8")), path


def test_a_reference_in_a_docstring_is_shown_as_code() -> None:
    assert plain_references("of :class:`~a.b.C`, :func:`f`; shape [N] [A]") == "of `C`, `f`; shape [N]\u2060 [A]"
