"""Uncertainty has two names, repeatability and total, and one format, in every command and on every page."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emb_bench import api
from emb_bench.commission.records import Identification
from emb_bench.live.follow import chunks
from emb_bench.live.page import Page, html
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, Noise, load_bench

from tests.bench.conftest import Replay  # isort: skip

ROOT = Path(__file__).parents[2]
NAMES = re.compile(r"repeatabilit|total", re.IGNORECASE)
TOTAL = "total about 2 %, as J is known to 1 %"
Texts = dict[str, str]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("uncertainty") / "run.mcap"
    assert emb_run(["--iface", "sim:f_v=3e-5,seed=2", "--log", str(made), "--json"]) == 0
    return made


def shown_live(path: Path) -> dict[str, Any]:
    """The last message of the page on an estimate."""
    page = Page()
    told = [json.loads(page.add(chunk)) for chunk in chunks(path, lambda: False, page.know)]
    return [one for one in told if one["table"]][-1]  # type: ignore[no-any-return]


@pytest.fixture
def texts(path: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Texts:
    """What each command prints of one brake for a person."""
    replay = Replay(capsys)
    assert emb_run(["--iface", "sim:f_v=3e-5,seed=2", "--log", str(tmp_path / "again.mcap")]) == 0
    ran = capsys.readouterr().out
    live, known = shown_live(path), {name: getattr(load_bench().brake, name) for name in PARAMETER_NAMES}
    halves = dict.fromkeys(known, (1.4, 2.1))
    commissioned = Identification(
        known, {}, halves, "exact", True, 1.0, 0, 0, (0.0, 0.0), {}, Noise(1e-3, 1.0)
    )  # fmt: skip
    return {
        "emb-run": ran,
        "info": replay.text("info", path),
        "fim": replay.text("fim", path),
        "estimate": replay.text("estimate", path, "--starts", "2"),
        "estimate of another model": replay.text("estimate", path, "--starts", "2", "--method", "rls"),
        "live": "\n".join([html(), *map(" ".join, live["table"]), live["total"]]),
        "emb-commission": str(commissioned),
        "repr": f"{api.fisher_information(path)!r}\n{api.estimate(path, starts=1)!r}",
    }


def test_one_log_has_one_repeatability_and_one_total(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    replay = Replay(capsys)
    info = replay.document("info", path)
    estimate = replay.document("estimate", path, "--starts", "2")["parameters"]
    bound = replay.document("fim", path)["physical"]["cramer_rao"]
    live = {name: share for name, _, share in shown_live(path)["table"]}
    assert (info["total"], shown_live(path)["total"]) == (TOTAL, TOTAL)
    for name, one in info["estimate"].items():
        own, value = one["repeatability"] / one["value"], estimate[name]["value"]
        assert live[name] == f"repeatability ± {100 * own:.2g} %", "the page shows the running estimate"
        assert 1.96 * bound[name] < 1.01 * own, "that of fim is the smallest possible one"
        assert 1.96 * bound[name] < 1.01 * estimate[name]["repeatability"] / value, "sensor errors are unknown to it"
        total = 0.5 * (estimate[name]["interval_95"][1] - estimate[name]["interval_95"][0]) / value
        assert one["total"] / one["value"] == pytest.approx(total, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_the_total_that_is_known_before_a_run_is_that_of_the_estimate(seed: int, tmp_path: Path) -> None:
    drawn = random.Random(seed)
    brake = {name: drawn.uniform(0.5, 1.5) * getattr(load_bench().brake, name) for name in PARAMETER_NAMES}
    log = api.simulate(tmp_path / "run.mcap", parameters=brake, seed=seed)
    study = api.estimate(log, starts=1)
    for name in PARAMETER_NAMES:
        low, high = study[name].interval
        s_J, s_scale = 0.01, 0.003 if name in ("k_m", "T_c") else 0.0
        assert 0.5 * (high - low) / study[name].value == pytest.approx(1.96 * math.hypot(s_J, s_scale), rel=0.1)


def test_a_percentage_stands_beside_the_name_of_its_uncertainty(texts: Texts) -> None:
    for command, text in texts.items():
        assert NAMES.search(text) or not text, command
        for block in text.split("\n\n"):
            head = ""
            for line in block.splitlines():
                head = line if NAMES.search(line) else head
                said = re.sub(r"95 %|known to [\d.]+ %", "", line)
                assert head or not re.search(r"\d %", said), f"{command}: {line}"


SOURCES: dict[str, Callable[[str], bool]] = {
    "runtime": lambda name: name.endswith((".py", ".toml")),
    "bench": lambda name: name.endswith((".py", ".html", ".j2")),
    "docs": lambda name: name.endswith(".md"),
}


def test_a_half_of_an_interval_never_stands_without_its_name() -> None:
    pages = [p for folder, wanted in SOURCES.items() for p in (ROOT / folder).rglob("*") if wanted(p.name)]
    assert len(pages) > 200
    for page in [*pages, ROOT / "README.md"]:
        lines = page.read_text(encoding="utf-8").splitlines()
        for i, line in enumerate(lines):
            if re.search(r"± 95 %|k ?= ?2\b(?!\.)", line) and "studies" not in page.parts:
                assert NAMES.search(" ".join(lines[max(0, i - 1) : i + 2])), f"{page.name}:{i + 1}: {line}"


def test_a_number_has_no_power_of_ten_of_a_programmer(texts: Texts) -> None:
    for command, text in texts.items():
        text = text if command != "live" else text.partition("</html>")[2]
        assert not re.search(r"\d[eE][-+]\d", text), command
        assert not re.search(r"0\.0000000", text), command
