"""A report in a real browser, without a screen: nothing is blocked, nothing is missing, on the screen and on paper.

Needs Chromium and pdftotext; on Debian they are in the packages chromium and poppler-utils.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.bench.report_pages import Report, make, read  # isort: skip
from tests.conftest import Simulate  # isort: skip

pytestmark = pytest.mark.browser  # what it needs is not of Python

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.fail(f"none of {', '.join(BROWSERS)} is there: apt-get install chromium")
    return found


def look(browser: str, file: Path, profile: Path, *arguments: str) -> tuple[str, list[str]]:
    """Open a page; what it prints, and what it complains of on its console."""
    command = [
        *(browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"),
        *("--enable-logging=stderr", "--log-level=0", "--host-resolver-rules=MAP * ~NOTFOUND"),
        *(f"--user-data-dir={profile}", *arguments, file.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    complaints = [line for line in done.stderr.decode(errors="replace").splitlines() if ":CONSOLE" in line]
    return done.stdout.decode("utf-8"), complaints


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Report:
    folder = tmp_path_factory.mktemp("browser")
    log = write_log(folder / "run.mcap", simulate(square, options="plant=stribeck,seed=4"))
    return make(folder / "run.html", log, "--model", "exact", "--starts", "2")


def test_the_browser_reads_every_section_and_complains_of_nothing(browser: str, report: Report, tmp_path: Path) -> None:
    seen, complaints = look(browser, report.path, tmp_path, "--dump-dom")
    assert complaints == []
    reader = read(seen.strip().removeprefix("<!DOCTYPE html>"))
    assert reader.headings == report.reader.headings
    assert reader.text == report.reader.text
    assert reader.tags.count("img") == report.reader.tags.count("img") > 3


def test_what_the_page_must_not_do_the_browser_refuses_and_tells(browser: str, report: Report, tmp_path: Path) -> None:
    """Else the silence above would mean nothing."""
    bad = "<img src='http://example.invalid/x.png'><script>document.title = 'ran'</script>"
    file = tmp_path / "bad.html"
    file.write_text(report.html.replace("<main>", f"<main>{bad}"), encoding="utf-8")
    seen, complaints = look(browser, file, tmp_path / "profile", "--dump-dom")
    assert "<title>ran</title>" not in seen
    assert sum("Content Security Policy" in line for line in complaints) >= 2


@pytest.mark.parametrize("width", [390, 900])
def test_it_is_drawn_with_its_figures_on_a_wide_and_on_a_narrow_screen(
    browser: str, report: Report, tmp_path: Path, width: int
) -> None:
    from matplotlib import image

    shot = tmp_path / "shot.png"
    _, complaints = look(
        browser, report.path, tmp_path / "profile", f"--screenshot={shot}", f"--window-size={width},12000"
    )
    assert complaints == []
    pixels = np.rint(255.0 * image.imread(shot)[:, :, :3]).astype(int)
    assert pixels.shape[:2] == (12000, width)
    near = {
        name: int((np.abs(pixels - colour).max(axis=2) < 12).sum())
        for name, colour in {"banner": (253, 238, 234), "blue": (0, 114, 178), "orange": (213, 94, 0)}.items()
    }
    assert near["banner"] > 50 * width  # the warning, across the page
    assert near["blue"] > 1000  # figures,
    assert near["orange"] > 100  # whose lines are thin on a narrow screen
    top = pixels[: 400 if width == 390 else 200]
    assert (np.abs(top - (253, 238, 234)).max(axis=2) < 12).sum() > 0.5 * near["banner"]  # and at its top


def test_it_is_printed_with_its_verdict_on_the_first_of_several_pages(
    browser: str, report: Report, tmp_path: Path
) -> None:
    if shutil.which("pdftotext") is None:
        pytest.fail("pdftotext is not there: apt-get install poppler-utils")
    paper = tmp_path / "report.pdf"
    look(browser, report.path, tmp_path / "profile", "--no-pdf-header-footer", f"--print-to-pdf={paper}")
    text = subprocess.run(["pdftotext", "-layout", paper, "-"], capture_output=True, timeout=60, check=True).stdout
    sheets = text.decode("utf-8").rstrip("\f").split("\f")
    assert len(sheets) <= 4
    header, _, first = " ".join(sheets[0].split()).partition(" emb-excite ")
    assert header == f"SIMULATED: Report {report.numbers['number']}"
    simulated = "SIMULATED: the values are of a simulated brake, not of a real machine."
    assert first.startswith(f"{simulated} THE MODEL 'exact' DOES NOT FIT")
    whole = " ".join(text.decode("utf-8").split())
    headings = report.reader.headings
    for heading in headings[: headings.index("Evidence")]:
        assert heading in whole
    assert "Correlation of the estimates" not in whole  # it is folded
    for label in ("angle [rad]", "sent after the shield", "residual [sigma]"):
        assert label in whole  # text of the figures, which is text on paper too
