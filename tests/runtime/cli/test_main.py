"""emb-run as its user meets it: exit codes, one-line errors, a log that is whole."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from emb_bench.logs.log import read_log
from emb_runtime.cli.options import parser
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench, shipped_bench_text
from emb_runtime.errors import EXIT_LOG
from tests.actors import constant_actor
from tests.bench.processes import left_of
from tests.runtime.operating import Edited, EmbRun, Sim

pytestmark = pytest.mark.usefixtures("handlers")


@pytest.fixture
def processes(tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]) -> EmbRun:
    """emb-run with recorder and trial in processes of their own."""
    return EmbRun(("--policy", str(actor)), capsys, tmp_path / "run.mcap")


def test_quiet_prints_the_verdict_alone(emb_run: EmbRun) -> None:
    assert emb_run.streams("-q") == ("done: 500 of 500 samples answered, home\n", "")


def test_a_run_whose_log_is_removed_meanwhile_is_not_done(emb_run: EmbRun, tmp_path: Path, sim: Sim) -> None:
    sim.when(lambda node: node.obeyed == 100, lambda _node: (tmp_path / "run.mcap").unlink())
    summary = emb_run.document(code=EXIT_LOG)
    assert (summary["result"], summary["answered"], summary["log_complete"]) == ("LOG_INCOMPLETE", 500, False)
    (tmp_path / "run.mcap").unlink(missing_ok=True)
    sim.when(lambda node: node.obeyed == 100, lambda _node: (tmp_path / "run.mcap").unlink())
    first, advice, *_ = emb_run.text(code=EXIT_LOG).splitlines()
    assert "LOG_INCOMPLETE" in first
    assert "repeat the run" in advice


def test_a_folder_for_logs_that_was_made_for_nothing_is_not_left(emb_run: EmbRun, tmp_path: Path, actor: Path) -> None:
    emb_run.text("--log", str(tmp_path / "a" / "b"), "--iface", "nocan99", code=4)
    assert list(tmp_path.iterdir()) == [actor]
    (tmp_path / "mine").mkdir()
    emb_run.text("--log", str(tmp_path / "mine" / "b"), "--iface", "nocan99", code=4)
    assert list((tmp_path / "mine").iterdir()) == []
    emb_run.text("--log", str(tmp_path / "a" / "b"), "--duration", "0.1")
    assert len(list((tmp_path / "a" / "b").iterdir())) == 1


def test_a_simulation_longer_than_the_ring_is_logged_whole(processes: EmbRun, actor: Path, edited: Edited) -> None:
    bench = edited("horizon     = 500", "horizon     = 4000")
    actor.write_bytes(constant_actor(load_bench(Path(bench))))
    summary = processes.document("--bench", bench)
    assert (summary["result"], summary["answered"], summary["home"]) == ("done", 4000, True)
    log = processes.log()
    assert log.complete
    assert summary["log_complete"]
    assert log.metadata["emb.end"]["exit_reason"] == "DONE"
    assert log.attachments["policy.onnx"] == actor.read_bytes()
    assert log.attachments["bench.toml"].decode() == Path(bench).read_text()
    assert len(log.cycles["step"]) == 4001
    assert sum(log.counts.values()) > 1 << 14  # slots of the ring


def test_the_help_documents_every_exit_code_and_every_key_of_the_simulated_bus() -> None:
    out = parser().format_help()
    assert all(f"\n  {code}  " in out for code in range(7))
    said = out.partition("the simulated bus:")[2].partition("exit codes:")[0]
    assert all(key in said for key in ("sim:KEY=VALUE", "seed", "plant", *PARAMETER_NAMES))


def test_a_run_ends_with_its_page_where_that_is_asked_for_and_possible(
    emb_run: EmbRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "page.html"
    ran: list[list[str]] = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        ran.append(command)
        return subprocess.CompletedProcess(command, 7)

    monkeypatch.setattr("emb_runtime.cli.main.subprocess.run", run)
    emb_run.document("--report", str(page), code=7)
    (command,) = ran
    assert command[2:] == ["-m", "emb_bench.cli.replay", "report", str(tmp_path / "run.mcap"), "--output", str(page)]
    (tmp_path / "run.mcap").unlink()
    monkeypatch.setattr("emb_runtime.cli.main.metadata.entry_points", lambda **_: [])
    emb_run.refused("no module is installed that writes a page", "--report", str(page))
    assert not (tmp_path / "run.mcap").exists()


def test_the_shipped_bench_is_written_for_editing(emb_run: EmbRun, tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    emb_run.text("--write-bench", str(path))
    assert path.read_text() == shipped_bench_text()


def test_no_node_is_a_bus_error_with_the_table_and_a_document(
    emb_run: EmbRun, edited: Edited, sim: Sim, tmp_path: Path
) -> None:
    hasty = edited("start_timeout = 5.0", "start_timeout = 0.1")
    sim.change = lambda _frame: None
    arguments = ["--bench", hasty]
    out, err = emb_run.streams(*arguments, "--json", code=4)
    summary = json.loads(out)
    assert (summary["result"], summary["exit_code"], summary["log"]) == ("NO_NODE", 4, None)
    assert {line["what"]: line["verdict"] for line in summary["preflight"]}["node"] == "refused"
    assert err.count("\n") == 1
    out, err = emb_run.streams(*arguments, code=4)
    assert out == ""
    assert "PRE-FLIGHT" in err
    assert not list(tmp_path.glob("*.mcap"))


def press(number: signal.Signals, _node: object) -> None:
    signal.raise_signal(number)


def test_a_signal_in_the_middle_ends_the_run_with_stop_frames_and_a_whole_log(emb_run: EmbRun, sim: Sim) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        sim.when(lambda node: node.obeyed == 100, partial(press, number))
        summary = emb_run.document(code=3)
        assert summary["result"] == "INTERRUPTED"
        log = emb_run.log()
        assert log.attachments["bench.toml"].decode() == shipped_bench_text()
        assert log.complete
        assert log.end["exit_reason"] == "INTERRUPTED"
        assert list(log.signals("EMB_Command")["Enable"][-4:]) == [1, 0, 0, 0]
        Path(summary["log"]).unlink()


PRESSED = """
import importlib, os, sys
from emb_runtime.system import child_process, entry
place, number = sys.argv.pop(1), int(sys.argv.pop(1))
def press(): os.kill(os.getpid(), number)
find, answer = importlib.import_module, child_process.Child.read_answer
def imported(name):
    if place == "import" and name == "emb_runtime.cli.main":
        press()
    return find(name)
def answered(child, timeout):
    if place == child._name:
        press()
    return answer(child, timeout)
importlib.import_module, child_process.Child.read_answer = imported, answered
sys.exit(entry.emb_run())
"""
"""``emb-run`` that gets a signal in an import, while a policy is tried, or while the recorder starts."""


def test_a_signal_before_the_run_just_ends_it_and_one_from_then_on_is_a_safety_stop(
    tmp_path: Path, actor: Path
) -> None:
    for place, number in (("import", signal.SIGTERM), ("trial", signal.SIGINT), ("recorder", signal.SIGTERM)):
        log = tmp_path / f"{place}.mcap"
        command = [sys.executable, "-c", PRESSED, place, str(int(number)), "--policy", str(actor), "--json"]
        process = subprocess.Popen(
            [*command, "--log", str(log)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        out, err = process.communicate(timeout=60)
        assert b"Traceback" not in err, err
        if place == "recorder":
            assert (process.returncode, json.loads(out)["result"]) == (3, "INTERRUPTED")
            assert read_log(log).complete
        else:
            assert (process.returncode, out, err, log.exists()) == (-number, b"", b"", False)
        assert left_of(process.pid) == {}
