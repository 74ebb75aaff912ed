"""What the commands say to a person, beside pages that somebody has read: ``pytest tests/golden --update-golden``.

Words have to be the same, numbers to two percent: another processor rounds otherwise. Columns, hashes,
dates and the version are left out.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from emb_bench.cli.design import main as design
from emb_bench.cli.replay import main as replay
from emb_bench.report.text import WIDTH

from tests.bench.report_pages import read  # isort: skip

Say = Callable[..., str]
PAGES = Path(__file__).parent
NUMBER = re.compile(r"(?<![\w.])[+−-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
UNIQUE = re.compile(
    r"\b(?:[0-9a-f]{40,64}|[0-9a-f]{16}|[0-9A-F]{10})\b|\d{4}-\d\d-\d\d \d\d:\d\d(:\d\d)?(?: UTC)?|emb-excite [\d.]+"
)
"""Hashes, numbers of reports, dates and the version."""
RELATIVE = 0.02
FLAT = {"report-joint": 0.1}
"""Two runs that the model does not fit: many values are nearly as good, and another processor ends at others."""
SHORT = {
    "fim": 21,
    "estimate-good": 18,
    "estimate-misfit": 18,
    "estimate-aborted": 16,
    "info": 14,
    "timing": 14,
    "campaign": 19,
    "design": 14,
}
"""Pages without ``-v``: as wide as a terminal, and at most so many lines."""


@pytest.fixture
def say(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Say:
    monkeypatch.chdir(folder)

    def said(*arguments: str, code: int = 0) -> str:
        assert (design(list(arguments[1:])) if arguments[0] == "design" else replay(list(arguments))) == code
        return capsys.readouterr().out

    return said


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Callable[[str, str], None]:
    """Compares a text with the page of that name, or writes the page."""

    def same(name: str, text: str) -> None:
        if not name.startswith("report"):
            assert max(map(len, text.splitlines())) <= (WIDTH if name in SHORT else 110)
            assert text.count("\n") <= SHORT.get(name, 120)
        path, text = PAGES / f"{name}.txt", UNIQUE.sub("…", text).replace("… to …", "…")
        if request.config.getoption("--update-golden"):
            path.write_text(text, encoding="utf-8")
        expected = path.read_text(encoding="utf-8")
        if not alike(expected, text, FLAT.get(name, RELATIVE)):
            lines = difflib.unified_diff(expected.splitlines(), text.splitlines(), "golden", "now", lineterm="", n=1)
            pytest.fail(f"{path}:\n" + "\n".join(lines), pytrace=False)

    return same


def alike(expected: str, text: str, relative: float) -> bool:
    """The same words, and numbers that are nearly the same: by their size, or by one in the last digit."""
    if NUMBER.sub("#", " ".join(expected.split())) != NUMBER.sub("#", " ".join(text.split())):
        return False

    def near(a: str, b: str) -> bool:
        last = 10.0 ** -len(a.partition("e")[0].partition(".")[2]) if "." in a and "e" not in a else 0.0
        one, other = (float(x.replace("−", "-")) for x in (a, b))
        return math.isclose(one, other, rel_tol=relative, abs_tol=1.001 * last)

    return all(map(near, NUMBER.findall(expected), NUMBER.findall(text)))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("info", ["info", "aborted.mcap"]),
        (
            "design",
            [
                "design",
                "--criterion",
                "D",
                "--bench",
                "short.toml",
                "--starts",
                "1",
                "--params",
                "k_m,T_c",
                "--model",
                "euler",
            ],
        ),
        ("fim", ["fim", "good.mcap", "--theta", "true"]),
        ("fim-nominal", ["fim", "good.mcap", "--theta", "nominal", "--nuisance", "x1_0"]),
        ("fim-verbose", ["fim", "good.mcap", "--theta", "true", "-v"]),
        ("estimate-good", ["estimate", "good.mcap", "--starts", "2"]),
        ("estimate-verbose", ["estimate", "other.mcap", "--model", "exact", "--starts", "2", "-v"]),
        ("estimate-misfit", ["estimate", "other.mcap", "--model", "exact", "--starts", "2"]),
        ("estimate-aborted", ["estimate", "aborted.mcap", "--starts", "2"]),
        ("estimate-still", ["estimate", "still.mcap", "--starts", "1"]),
        ("estimate-rls", ["estimate", "good.mcap", "--method", "rls"]),
        ("fim-still", ["fim", "still.mcap"]),
    ],
)
def test_a_command_says(say: Say, golden: Callable[[str, str], None], name: str, arguments: list[str]) -> None:
    golden(name, say(*arguments))


@pytest.mark.parametrize(
    ("command", "more", "code"),
    [
        ("fim", [], 0),
        ("info", [], 0),
        ("rerun", [], 0),
        ("timing", [], 2),
        ("estimate", ["--starts", "1"], 0),
        ("report", ["--starts", "1", "-o", "page.html"], 0),
        ("export", ["--topic", "/cycle", "-o", "cycles.csv"], 0),
        ("export", ["-o", "run.png"], 0),
    ],
)
def test_what_a_cut_log_lacks_is_said_first(say: Say, command: str, more: list[str], code: int) -> None:
    lines = say(command, "cut.mcap", *more, code=code).splitlines()
    said = next(line for line in lines if not line.startswith("SIMULATED: "))
    assert said.startswith("WARNING: ")
    assert "the file is cut at byte" in said


def test_several_runs_are_compared_with_an_earlier_estimate_and_with_each_other(
    folder: Path, say: Say, golden: Callable[[str, str], None]
) -> None:
    (folder / "last.json").write_text(say("estimate", "good.mcap", "--starts", "1", "--json"))
    worn = ["estimate", "worn.mcap", "--last", "last.json", "--starts", "1"]
    golden("estimate-worn", say(*worn))
    wrong = ["estimate", "other.mcap", "--model", "exact", "--last", "last.json", "--starts", "1"]
    golden("estimate-misfit-since", say(*wrong))
    three = ["good.mcap", "again.mcap", "third.mcap"]
    golden("estimate-three", say("estimate", *three, "--profile", "--starts", "1", "-v"))


def test_a_timing_and_a_campaign_say(say: Say, golden: Callable[[str, str], None]) -> None:
    golden("timing", say("timing", "good.mcap", code=2))
    logs = ["good.mcap", "again.mcap", "worn.mcap", "other.mcap", "aborted.mcap", "broken.mcap"]
    golden("campaign", say("campaign", *logs, "-o", "result.parquet", "--starts", "1", "--jobs", "1", code=1))


@pytest.mark.parametrize(
    ("name", "arguments", "code"),
    [
        ("report-good", ["good.mcap", "--starts", "2"], 0),
        ("report-joint", ["other.mcap", "aborted.mcap", "broken.mcap", "--model", "exact", "--starts", "1"], 1),
    ],
)
def test_a_report_says(
    folder: Path, say: Say, golden: Callable[[str, str], None], name: str, arguments: list[str], code: int
) -> None:
    say("report", *arguments, "-o", "page.html", code=code)
    golden(name, "\n".join(read((folder / "page.html").read_text(encoding="utf-8")).texts))
