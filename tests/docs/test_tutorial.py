"""The tutorial's commands run as they stand there, and its estimate is right."""

from __future__ import annotations

from pathlib import Path

import pytest

from emb_bench import api
from tools import tutorial


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tutorial was followed; a command that fails ends it."""
    path = tmp_path_factory.mktemp("first")
    found = tutorial.outputs(tutorial.TUTORIAL.read_text(encoding="utf-8"), path)
    assert len(found) > 5
    return path


@pytest.mark.slow
def test_following_it_leaves_what_it_speaks_of(folder: Path) -> None:
    assert (folder / "first.png").read_bytes().startswith(b"\x89PNG")
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_its_estimates_are_as_it_says(folder: Path) -> None:
    first, stribeck = (api.open_run(folder / f"{name}.mcap") for name in ("first", "stribeck"))
    for run, model, fits in ((first, "exact", True), (stribeck, "exact", False), (stribeck, "stribeck", True)):
        study = api.estimate(run, params=("f_v",), model=model, starts=1)
        (concluded,) = study.conclusions
        low, high = concluded.interval
        assert study.model_fits == fits
        assert low <= 3e-5 <= high  # of the wrong model too, whose interval allows for what it lacks
        ideal = api.estimate(run, params=("f_v",), model=model, starts=1, systematic="none").conclusions[0].interval
        assert (ideal[0] <= 3e-5 <= ideal[1]) == fits


def test_output_is_written_below_its_command() -> None:
    page = "a\n```console\n$ one\nold\n$ two\n```\n```text\n$ no\n```\n"
    assert tutorial.commands(page) == ["one", "two"]
    written = tutorial.written_anew(page, {"one": "new\n", "two": ""})
    assert written == "a\n```console\n$ one\nnew\n$ two\n```\n```text\n$ no\n```\n"
