from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from emb_bench.batch.campaign import draw
from emb_bench.batch.row import Options, Parameter, Row
from emb_bench.batch.summary import Campaign, document, summarise, text
from emb_runtime.errors import UsageError

HOUR = 3600 * 10**9
FIRST = 1_700_000_000 * 10**9
TRUE, DEVIATION = 0.0217, 1e-5  # k_m at the begin, and the standard deviation of an estimate, relative
OPTIONS = Options(params=("k_m",))


def row(number: int, value: float, *, fits: bool = True) -> Row:
    estimate = Parameter("k_m", True, DEVIATION, value, value, value, DEVIATION, DEVIATION)
    return Row(
        "root",
        "day",
        f"{number}.mcap",
        start_time=FIRST + number * HOUR,
        exit_reason="DONE",
        complete=True,
        fits=fits,
        model="exact",
        log_det=70.0,
        weighted_log_det=40.0,
        parameters=(estimate,),
    )


def campaign(values: list[float], wrong: int | None = None) -> Campaign:
    rows = [row(n, value, fits=n != wrong) for n, value in enumerate(values)]
    return summarise([*rows[1:], rows[0]], OPTIONS, "result.parquet")


def drifting(walk: float, runs: int = 40) -> tuple[list[float], list[float]]:
    """True and estimated k_m of runs an hour apart; the walk is relative, per root of an hour."""
    rng = np.random.default_rng(4)
    true = TRUE * (1.0 + np.cumsum(walk * rng.standard_normal(runs)))
    return true.tolist(), (true * (1.0 + DEVIATION * rng.standard_normal(runs))).tolist()


def test_the_trend_follows_a_parameter_that_drifts_from_run_to_run() -> None:
    true, seen = drifting(2e-5)
    trend = campaign(seen).parameters["k_m"].trend
    assert trend is not None
    assert trend.start_times == tuple(FIRST + n * HOUR for n in range(40))
    assert trend.walk.walk == pytest.approx(2e-5 * TRUE, rel=0.4)
    low, high = trend.walk.ends.T
    assert np.mean((low <= true) & (true <= high)) > 0.85
    assert (trend.walk.deviations < DEVIATION * TRUE).all()


def test_runs_that_do_not_fit_and_few_runs_have_no_part_in_it() -> None:
    _, seen = drifting(2e-5)
    seen[7] = 2.0 * TRUE
    found = campaign(seen, wrong=7).parameters["k_m"].trend
    assert found is not None
    assert len(found.values) == 39
    assert campaign(seen[:3]).parameters["k_m"].trend is None


def test_it_is_in_the_text_the_document_and_the_figure(tmp_path: Path) -> None:
    _, seen = drifting(2e-5)
    found = campaign(seen)
    assert "walk of" in text(found, verbose=True)
    trend = document(found)["parameters"]["k_m"]["trend"]
    assert trend["start_times"] == [FIRST + n * HOUR for n in range(40)]
    assert len(trend["walk"]["values"]) == 40
    assert document(campaign(seen[:3]))["parameters"]["k_m"]["trend"] is None
    draw(found, tmp_path / "trend.svg")
    assert "random walk through all runs" in (tmp_path / "trend.svg").read_text()
    draw(campaign(seen[:3]), tmp_path / "none.svg")
    assert "enough runs" in (tmp_path / "none.svg").read_text()
    with pytest.raises(UsageError, match="cannot write the figure"):
        draw(found, tmp_path / "gone" / "trend.svg")
