"""A campaign's processes: one that dies, one that takes too long, Ctrl-C, and Ray."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from os import _exit
from pathlib import Path
from typing import Any

import pytest

from emb_bench import ONE_THREAD
from emb_bench.batch.campaign import in_order
from emb_bench.batch.row import Row, Source
from emb_bench.parallel import Lost, processors, shared_out

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.bench.processes import WAIT, emb_replay, left_of, press_ctrl_c, processes, started  # isort: skip
from tests.conftest import Simulate  # isort: skip


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
