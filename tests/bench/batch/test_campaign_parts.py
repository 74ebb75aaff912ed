"""Finding logs, telling how far one is, whether a number is constant, and what a campaign refuses."""

from __future__ import annotations

import csv
import os
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC
from pyarrow import parquet

from emb_bench.analysis.several_runs import constancy
from emb_bench.batch.campaign import find
from emb_bench.batch.row import CampaignOptions, Row, Source, failed, write_rows
from emb_bench.batch.summary import Campaign, campaign_text, mark_copies, summarise
from emb_bench.output import replacing
from emb_runtime.errors import UsageError

from tests.bench.conftest import Replay  # isort: skip

NUMBERS = st.floats(-1e3, 1e3).map(lambda value: value if abs(value) > 1e-300 else 0.0)
"""Without those so small that they have lost digits."""
DEVIATIONS = st.floats(1e-3, 1e3)


@settings(deadline=None)
@given(st.lists(st.tuples(NUMBERS, DEVIATIONS), min_size=2, max_size=20), st.floats(-1e3, 1e3), st.floats(0.1, 10.0))
def test_the_mean_is_the_weighted_least_squares_constant_whatever_origin_and_unit(
    runs: list[tuple[float, float]], shift: float, scale: float
) -> None:
    values, deviations = (np.array(column) for column in zip(*runs, strict=True))
    found = constancy(values.tolist(), deviations.tolist())
    column = (1.0 / deviations)[:, None]
    (mean,), rest, *_ = np.linalg.lstsq(column, values / deviations, rcond=None)
    size = float(np.abs(values).max())
    assert found.mean == pytest.approx(mean, rel=1e-9, abs=1e-9 * size)
    assert found.deviation == pytest.approx(float(np.linalg.inv(column.T @ column)[0, 0]) ** 0.5)
    assert found.chi2 == pytest.approx(
        float(rest[0]), rel=1e-6, abs=1e-9 * float((values / deviations) @ (values / deviations)) + 1e-12
    )
    moved = constancy((scale * values + shift).tolist(), (scale * deviations).tolist())
    assert moved.mean == pytest.approx(scale * found.mean + shift, rel=1e-9, abs=1e-9 * (size * scale + abs(shift)))
    assert moved.deviation == pytest.approx(scale * found.deviation)


def test_runs_of_one_number_are_called_different_as_seldom_as_they_may() -> None:
    rng = np.random.default_rng(3)
    deviations = rng.uniform(0.5, 2.0, 12).tolist()
    drawn = [constancy((7.0 + rng.normal(size=12) * deviations).tolist(), deviations) for _ in range(2000)]
    assert 0.004 < np.mean([not one.constant for one in drawn]) < 0.018
    assert np.mean([one.scatter**2 for one in drawn]) == pytest.approx(1.0, abs=0.05)
    assert np.std([one.mean for one in drawn]) == pytest.approx(drawn[0].deviation, rel=0.06)


def test_logs_are_found_sorted_and_once_whatever_leads_to_them(tmp_path: Path) -> None:
    for name in ("b/2.mcap", "b/1.MCAP", "a/3.mcap", "a/notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "c").symlink_to("b")
    (tmp_path / "b/loop").symlink_to("..")
    (tmp_path / "a/again.mcap").symlink_to("3.mcap")
    (tmp_path / "folder.mcap").mkdir()
    found = find([tmp_path, tmp_path / "b" / "2.mcap", tmp_path])
    assert [log.log for log in found] == ["a/3.mcap", "b/1.MCAP", "b/2.mcap"]
    assert [log.campaign for log in found] == ["a", "b", "b"]
    assert {log.root for log in found} == {str(tmp_path)}
    assert [Path(log.path).is_file() for log in found] == [True] * 3


def test_a_name_that_is_no_text_can_still_be_written(tmp_path: Path) -> None:
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/run\xff.mcap")).touch()
    (log,) = find([tmp_path])
    row = failed(log, f"{log.path}:\nempty")
    assert row["log"] == "run\\udcff.mcap"
    assert row["error"] == f"{tmp_path}/run\\udcff.mcap: empty"


def test_a_folder_that_cannot_be_listed_is_in_the_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    (tmp_path / "b/1.mcap").touch()
    scandir = os.scandir

    def refusing(path: str) -> object:
        if str(path).endswith("/a"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)  # root may list everything
    first, second = find([tmp_path])
    assert (first.log, first.trouble) == ("a", "the folder cannot be listed: Permission denied")
    assert (second.log, second.trouble) == ("b/1.mcap", "")


def test_a_result_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "r.parquet"
    path.write_text("old")

    def interrupted() -> None:
        with replacing(path) as beside:
            beside.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    with replacing(path) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    with pytest.raises(UsageError, match="the result cannot be written: No space left"), replacing(path):
        raise OSError(28, "No space left on device")
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.parquet"]


def test_a_log_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"  # whatever it is called
    path.write_bytes(MCAP0_MAGIC + b"the rest")
    with pytest.raises(UsageError, match="logs are never overwritten"), replacing(path):
        pass
    assert path.read_bytes() == MCAP0_MAGIC + b"the rest"


def test_a_ray_that_is_not_there_is_refused_at_once(tmp_path: Path, replay: Replay) -> None:
    (tmp_path / "1.mcap").touch()
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # taken, and nobody listens
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        said = replay.refused("campaign", tmp_path, "-o", tmp_path / "r.parquet", "--ray", address)
    assert address in said
    assert [entry.name for entry in tmp_path.iterdir()] == ["1.mcap"]


def test_a_missing_library_is_named_with_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replay: Replay
) -> None:
    (tmp_path / "1.mcap").touch()
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "'.[ray]'" in replay.refused("campaign", tmp_path, "-o", tmp_path / "r.parquet", "--ray", "local")
    for name in ("scipy", "numba", "pyarrow"):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, name, None)
            said = replay.refused("campaign", tmp_path, "-o", tmp_path / "r.parquet")
        assert f"a campaign needs {name}: " in said
        assert "'.[bench]'" in said


def test_a_run_counts_once_and_the_whole_log_or_the_one_that_holds_most_of_it_is_the_one() -> None:
    def row(log: str, beginning: str | None, measured: int, error: str | None = None, complete: bool = True) -> Row:
        return {"log": log, "error": error, "beginning": beginning, "measured": measured, "complete": complete}

    rows = [row("a", "x", 60), row("b", "x", 500), row("c", "x", 500), row("d", "y", 9), row("e", None, 3)]
    rows += [row("f", None, 3), row("g", "x", 900, "it failed"), row("damaged", "x", 600, complete=False)]
    assert [r["copy_of"] for r in mark_copies(rows)] == ["b", None, "b", None, None, None, None, "b"]


def test_the_rows_are_a_csv_file_where_the_name_says_so(tmp_path: Path) -> None:
    cut = failed(Source("logs/a.mcap", "logs", "a.mcap", "."), "cut")
    rows = [cut, {"log": "b.mcap", "error": None, "warnings": ("one", "two")}]
    path = tmp_path / "rows"
    write_rows(path, ".csv", rows, CampaignOptions())
    with path.open(newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert [row["log"] for row in found] == ["a.mcap", "b.mcap"]
    assert [row["error"] for row in found] == ["cut", ""]
    assert [row["warnings"] for row in found] == ["", "one; two"]
    write_rows(path, ".parquet", rows, CampaignOptions())
    table = parquet.read_table(path)
    assert table.column_names == list(found[0])
    assert table["warnings"].to_pylist() == [None, ["one", "two"]]


HOUR = 3600 * 10**9
FIRST = 1_700_000_000 * 10**9
DEVIATION = 1e-5  # Relative standard deviation of an estimate of k_m
OPTIONS = CampaignOptions(params=("k_m",))


def row(number: int, value: float, *, fits: bool = True, half: float = 0.0) -> Row:
    of_k_m = {
        "identified": True,
        "cramer_rao": DEVIATION,
        "estimate": value,
        "low": value * (1.0 - half),
        "high": value * (1.0 + half),
        "deviation": DEVIATION,
        "between_runs": DEVIATION,
    }
    return {
        "log": f"{number}.mcap",
        "error": None,
        "start_time": FIRST + number * HOUR,
        "exit_reason": "DONE",
        "complete": True,
        "fits": fits,
        "model": "exact",
        **{f"k_m_{key}": entry for key, entry in of_k_m.items()},
    }


def campaign(values: list[float], wrong: int | None = None) -> Campaign:
    rows = [row(n, value, fits=n != wrong) for n, value in enumerate(values)]
    return summarise([*rows[1:], rows[0]], OPTIONS, "result.parquet")


def test_a_misfit_is_named_and_has_no_part_in_the_mean() -> None:
    values = [2.98e-2, 2.99e-2, 3.1e-2, 5e-2]
    found = summarise([row(n, value, fits=n < 3, half=0.1) for n, value in enumerate(values)], OPTIONS, "r.parquet")
    assert [row["log"] for row in found.misfit] == ["3.mcap"]
    estimate = found.parameters["k_m"].estimate
    assert estimate is not None
    assert (estimate.runs, estimate.constancy.constant) == (3, False)
    assert estimate.constancy.mean == pytest.approx(3.02e-2, rel=0.01)
    assert estimate.total == pytest.approx(0.1 * 2.99e-2)
    assert "3.mcap" in campaign_text(found, verbose=True)
