"""Parts of a campaign: logs that are found, numbers that are constant or not, refusals, and its processes."""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
from os import _exit
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC
from pyarrow import parquet

from emb_bench import ONE_THREAD
from emb_bench.analysis.several_runs import constancy
from emb_bench.batch.campaign import find, in_order
from emb_bench.batch.row import CampaignOptions, Row, Source, failed, write_rows
from emb_bench.batch.summary import campaign_text, mark_copies, summarise
from emb_bench.output import replacing
from emb_bench.parallel import Lost, processors, shared_out
from emb_runtime.errors import UsageError
from tests.bench.conftest import Replay
from tests.bench.processes import WAIT, emb_replay, left_of, press_ctrl_c, processes, started
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate

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


def source(name: str) -> Source:
    return Source(f"/logs/{name}", "/logs", name, ".")


def dying(log: Source) -> Row:
    """Evaluates nothing; its logs are named after what they do to the process."""
    if log.log.startswith("SIG"):
        os.kill(os.getpid(), signal.Signals[log.log.partition("-")[0]])
    if log.log.startswith("exit"):
        _exit(int(log.log[4:]))
    if log.log == "hang":
        signal.pause()
    return {"log": log.log, "error": None, "exit_reason": " ".join(os.environ[name] for name in sorted(ONE_THREAD))}


def test_a_log_that_ends_its_process_costs_no_other_log() -> None:
    names = ["a", "SIGKILL", "b", "SIGSEGV-1", "exit3", "hang", "c"]
    sources = [source(name) for name in names]
    found = in_order(sources, shared_out(dying, sources, jobs=2, time_limit=3.0))
    errors = {row["log"]: row["error"] for row in found if row["error"] is not None}
    assert errors == {
        "SIGKILL": "/logs/SIGKILL: the process that evaluated it was ended by SIGKILL",
        "SIGSEGV-1": "/logs/SIGSEGV-1: the process that evaluated it was ended by SIGSEGV",
        "exit3": "/logs/exit3: the process that evaluated it ended with exit code 3",
        "hang": "/logs/hang: not evaluated within 3 s",
    }
    assert [row["log"] for row in found] == names
    assert found[0]["exit_reason"] == "1 1 1 1 1"


def test_the_environment_is_as_it_was_and_no_process_stays() -> None:
    before, children = dict(os.environ), multiprocessing.active_children()
    rows = shared_out(dying, [source(name) for name in "abc"], jobs=2, time_limit=WAIT)
    next(rows)
    rows.close()
    assert dict(os.environ) == before
    assert multiprocessing.active_children() == children


def squared(number: int) -> int:
    """A piece of work."""
    return number**2


class Fatal:
    """Ends the process that receives it with this exit code, before any work can begin."""

    def __init__(self, code: int) -> None:
        self.code = code

    def __reduce__(self) -> tuple[object, ...]:
        return _exit, (self.code,)

    def __call__(self, _: object) -> None:
        """Work."""


def ended_with(code: int) -> Lost:
    return Lost(f"the process that evaluated it ended with exit code {code}")


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_process_that_dies_before_its_work_begins_costs_no_other_piece(jobs: int) -> None:
    pieces: list[Any] = [-1, Fatal(3), -2, Fatal(4), Fatal(5), -3]
    found = dict(shared_out(abs, pieces, jobs, math.inf))
    assert found == {0: 1, 1: ended_with(3), 2: 2, 3: ended_with(4), 4: ended_with(5), 5: 3}


def test_work_that_no_process_can_receive_ends_with_every_piece_lost() -> None:
    assert dict(shared_out(Fatal(3), "abc", jobs=2, time_limit=math.inf)) == dict.fromkeys(range(3), ended_with(3))


def test_elsewhere_than_in_the_main_thread_work_is_shared_out_too() -> None:
    found: list[tuple[int, int | Lost]] = []
    thread = threading.Thread(target=lambda: found.extend(shared_out(squared, [2], jobs=1, time_limit=WAIT)))
    thread.start()
    thread.join()
    assert found == [(0, 4)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    root = tmp_path_factory.mktemp("campaign")
    write_log(root / "1.mcap", simulate(square, options="plant=exact,seed=1"))
    write_log(root / "2.mcap", simulate(square, options="plant=exact,seed=2"))
    (root / "0.mcap").touch()
    return root


def test_ctrl_c_ends_every_process_leaves_no_half_result_and_exits_with_130(folder: Path, tmp_path: Path) -> None:
    many, results = tmp_path / "many", tmp_path / "results"
    many.mkdir()
    results.mkdir()
    (many / "0.mcap").touch()
    for number in range(1, 400):
        os.link(folder / "1.mcap", many / f"{number:03}.mcap")
    result = results / "r.parquet"
    result.write_text("the last one")
    running = started(emb_replay("campaign", str(many), "-o", str(result), "--jobs", "2"))
    assert running.stderr is not None
    assert running.stderr.readline() == f"FAILED {many}/0.mcap: the file is empty\n"
    assert sum("spawn_main" in name for name in processes(running.pid).values()) >= 1
    code, out, err = press_ctrl_c(running)
    assert (code, out) == (130, "")
    assert "Traceback" not in err
    assert [path.name for path in results.iterdir()] == ["r.parquet"]
    assert result.read_text() == "the last one"
    assert left_of(running.pid) == {}


POOL = """
import os, time
from emb_bench.parallel import processes
if __name__ == "__main__":
    with processes() as pool:
        print("at work", flush=True)
        list(pool.map(time.sleep, [1, 1, 1000]))
"""


def test_a_killed_command_leaves_no_process_of_a_pool(tmp_path: Path) -> None:
    (tmp_path / "pool.py").write_text(POOL)
    running = started([sys.executable, str(tmp_path / "pool.py")])
    assert running.stdout is not None
    assert running.stdout.readline() == "at work\n"
    assert sum("spawn_main" in name for name in processes(running.pid).values()) == processors()
    running.kill()
    running.communicate(timeout=WAIT)
    assert left_of(running.pid) == {}


@pytest.mark.slow
def test_ray_gives_the_same_bytes_and_the_same_words(folder: Path, tmp_path: Path) -> None:
    said, files = [], []
    for name, chosen in (("here", ("--jobs", "1")), ("ray", ("--jobs", "2", "--ray", "local"))):
        result = tmp_path / name / "r.parquet"
        result.parent.mkdir()
        done = subprocess.run(
            emb_replay("campaign", str(folder), "-o", "r.parquet", "--starts", "2", *chosen),
            cwd=result.parent,
            capture_output=True,
            text=True,
            timeout=WAIT,
            check=False,
        )
        failures = [line for line in done.stderr.splitlines() if line.startswith("FAILED")]
        assert done.returncode == 1, done.stderr
        assert failures == [f"FAILED {folder}/0.mcap: the file is empty"]
        assert "Traceback" not in done.stderr
        said.append(done.stdout)
        files.append(result.read_bytes())
    assert said[0] == said[1]
    assert files[0] == files[1]


def test_what_takes_longer_than_the_limit_has_failed(folder: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        emb_replay("campaign", str(folder / "1.mcap"), "-o", str(tmp_path / "r.parquet"), "--time-limit", "0.001"),
        capture_output=True,
        text=True,
        timeout=WAIT,
        check=False,
    )
    assert done.returncode == 6
    assert done.stderr == f"FAILED {folder}/1.mcap: not evaluated within 0.001 s\n"
