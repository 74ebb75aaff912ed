"""emb-run as its user meets it: exit codes, one-line errors, a log that is whole."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, parse_bench, shipped_bench_text
from emb_runtime.log.recorder import Recorder, RecorderResult
from emb_runtime.system.entry import emb_run
from tests.actors import alone, constant_actor
from tests.runtime.operating import Sim, assert_one_line

pytestmark = pytest.mark.usefixtures("handlers")

EMB_RUN = [sys.executable, "-m", "emb_runtime.cli.main"]


def test_an_experiment_is_run_logged_and_summed_up(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--policy", str(actor), "--log", str(tmp_path / "run.mcap"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["result"], summary["answered"], summary["home"]) == ("done", 500, True)
    log = read_log(tmp_path / "run.mcap")
    assert log.complete
    assert summary["log_complete"]
    assert log.metadata["emb.end"]["exit_reason"] == "DONE"
    assert log.attachments["policy.onnx"] == actor.read_bytes()
    assert log.attachments["bench.toml"].decode() == shipped_bench_text()


def test_the_shipped_actor_is_the_default_and_the_summary_is_for_people(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--iface", "sim:seed=2,f_v=4e-5", "--log", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("done: 500 of 500 samples answered")
    assert "home" in out
    assert "NOT HOME" not in out
    assert len(list(tmp_path.glob("run-*.mcap"))) == 1


def test_the_same_seed_gives_the_same_decisions(tmp_path: Path, actor: Path) -> None:
    cycles = []
    for name in ("a", "b"):
        assert main(["--iface", "sim:seed=7", "--policy", str(actor), "--log", str(tmp_path / f"{name}.mcap")]) == 0
        log = read_log(tmp_path / f"{name}.mcap")
        cycles.append([list(log.cycles[column][:500]) for column in ("step", "angle", "velocity", "sent_current")])
    assert cycles[0] == cycles[1]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sample_time": 2e-3}, "sample time"),
        ({"horizon": 300}, "horizon"),
        ({"bench_hash": "0" * 64}, "bench"),
        ({"observation": (("velocity", "rad/s"), ("angle", "rad"), ("step", "1"))}, "observation"),
        ({"observation": (("angle", "deg"), ("velocity", "rad/s"), ("step", "1"))}, "observation"),
    ],
)
def test_a_policy_made_for_another_bench_is_refused(
    tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], reason: str
) -> None:
    from emb_runtime.policy.contract import Quantity

    if "observation" in changes:
        changes = {"observation": tuple(Quantity(*q) for q in changes["observation"])}
    path = tmp_path / "other.onnx"
    path.write_bytes(constant_actor(bench, **changes))
    assert main(["--policy", str(path), "--log", str(tmp_path / "run.mcap")]) == 5
    assert_one_line(capsys, reason)
    assert not (tmp_path / "run.mcap").exists()


def test_a_truncated_policy_is_refused(tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    whole = constant_actor(bench)
    path = tmp_path / "cut.onnx"
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert main(["--policy", str(path), "--log", str(tmp_path / "run.mcap")]) == 5
        assert_one_line(capsys, "")


@pytest.mark.parametrize(("later", "code"), [(float("nan"), "POLICY_NOT_FINITE"), (1e9, "POLICY_BEYOND_CONTRACT")])
def test_a_policy_that_goes_mad_in_the_middle_is_stopped_and_nothing_illegal_was_sent(
    tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str], later: float, code: str
) -> None:
    path = tmp_path / "mad.onnx"
    path.write_bytes(constant_actor(bench, 6.0, later))
    assert main(["--policy", str(path), "--log", str(tmp_path / "run.mcap"), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["result"] == code
    log = read_log(tmp_path / "run.mcap")
    assert max(abs(c) for c in log.signals("EMB_Command")["Current"]) <= 6.0
    assert list(log.signals("EMB_Command")["Enable"][-3:]) == [0, 0, 0]


@pytest.mark.parametrize("current", [float("nan"), 1e9])
def test_a_policy_whose_vectors_are_mad_is_refused_before_arming(
    tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str], current: float
) -> None:
    from emb_runtime.policy.contract import MIN_VECTORS, Vector

    path = tmp_path / "mad.onnx"
    vectors = alone(Vector((0.0, 0.0, float(n)), 1.0) for n in range(MIN_VECTORS))
    path.write_bytes(constant_actor(bench, current, sequences=vectors))
    assert main(["--policy", str(path), "--log", str(tmp_path / "run.mcap")]) == 5
    assert_one_line(capsys, "test vector 0")


@pytest.mark.parametrize(
    ("arguments", "exit_code", "reason"),
    [
        (["--iface", "nocan99"], 4, "nocan99"),
        (["--iface", "warp:1"], 2, "no backend 'warp'"),
        (["--iface", ""], 2, "--iface"),
        (["--iface", "sim:mass=3"], 2, "'mass' is not a parameter"),
        (["--policy", "missing.onnx"], 2, "missing.onnx"),
        (["--bench", "missing.toml"], 2, "missing.toml"),
        (["--log", "/proc/nowhere/run.mcap"], 2, "--log"),
        (["--duration", "7"], 2, "--duration"),
        (["--duration", "nan"], 2, "--duration"),
        (["--cpu", "999"], 2, "--cpu"),
        (["--log", "x" * 300 + ".mcap"], 2, "--log"),
        (["--iface", "sim:f_v=1e300"], 2, "f_v"),
    ],
)
def test_what_a_user_can_get_wrong_is_one_line_and_an_exit_code(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], exit_code: int, reason: str
) -> None:
    log = [] if "--log" in arguments else ["--log", str(tmp_path)]
    assert main(["--policy", str(actor), *arguments, *log]) == exit_code
    assert_one_line(capsys, reason)


@pytest.mark.parametrize("inside", ["", "below/run.mcap"])
def test_a_file_where_the_folder_for_logs_should_be_is_called_one(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str], inside: str
) -> None:
    path = tmp_path / "file"
    path.write_text("precious")
    assert main(["--policy", str(actor), "--log", str(path / inside)]) == 2
    assert_one_line(capsys, "is no folder; expected one for the logs, or a new file with a suffix")
    assert path.read_text() == "precious"


def test_a_folder_for_logs_that_was_made_for_nothing_is_not_left(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--policy", str(actor), "--log", str(tmp_path / "a" / "b"), "--iface", "nocan99"]) == 4
    assert list(tmp_path.iterdir()) == [actor]
    (tmp_path / "mine").mkdir()
    assert main(["--policy", str(actor), "--log", str(tmp_path / "mine" / "b"), "--iface", "nocan99"]) == 4
    assert list((tmp_path / "mine").iterdir()) == []
    assert main(["--policy", str(actor), "--log", str(tmp_path / "a" / "b"), "--duration", "0.1"]) == 0
    assert len(list((tmp_path / "a" / "b").iterdir())) == 1


def test_a_policy_that_is_none_is_refused_with_the_option_that_named_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "my.toml"
    bench.write_text(shipped_bench_text())
    assert main(["--policy", str(bench), "--log", str(tmp_path)]) == 5
    assert_one_line(capsys, f"--policy {bench}: the policy file is not ONNX")


def test_a_bench_that_no_shield_can_be_made_for_is_told_so_before_its_policy_is_looked_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "my.toml"
    bench.write_text(shipped_bench_text().replace('envelope      = "braking"', 'envelope      = "coasting"'))
    assert main(["--bench", str(bench), "--policy", str(bench), "--log", str(tmp_path)]) == 2
    assert_one_line(capsys, "shield.angle_margin is 0.3 rad; raise it")


def test_an_existing_log_is_never_overwritten(tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    assert main(["--policy", str(actor), "--log", str(path)]) == 2
    assert_one_line(capsys, "run.mcap")
    assert path.read_text() == "precious"


def test_a_bench_whose_bus_cannot_carry_it_or_whose_sampling_is_not_the_dbc_s_is_refused(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(shipped_bench_text().replace("sample_time = 1.0e-3", "sample_time = 9.0e-4"))
    assert main(["--bench", str(path), "--log", str(tmp_path)]) == 2
    assert_one_line(capsys, "timing.sample_time")
    path.write_text(shipped_bench_text().replace("bitrate = 1000000", "bitrate = 250000"))
    assert main(["--bench", str(path), "--policy", str(actor), "--log", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("emb-run: pre-flight, bus load: ")
    assert not list(tmp_path.glob("*.mcap"))


def test_a_log_that_is_not_whole_is_no_success(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = Recorder.finish

    def lose_one(recorder: Recorder, trailer: dict[str, str]) -> RecorderResult:
        return finish(recorder, trailer)._replace(complete=False, error="writing failed: No space left on device")

    monkeypatch.setattr(Recorder, "finish", lose_one)
    assert main(["--policy", str(actor), "--log", str(tmp_path / "run.mcap")]) == 6
    assert "INCOMPLETE: writing failed" in capsys.readouterr().out


def test_a_simulation_longer_than_the_ring_is_logged_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = shipped_bench_text().replace("horizon     = 500", "horizon     = 8000")
    (tmp_path / "bench.toml").write_text(text)
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(text, "t")))
    log = tmp_path / "run.mcap"
    arguments = ["--bench", str(tmp_path / "bench.toml"), "--policy", str(tmp_path / "actor.onnx"), "--log", str(log)]
    assert main(arguments) == 0
    assert len(read_log(log).cycles["step"]) == 8001


def test_a_reader_that_has_had_enough_is_no_error(tmp_path: Path, actor: Path) -> None:
    command = [*EMB_RUN, "--policy", str(actor), "--log", str(tmp_path / "run.mcap"), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, b"")


def test_a_full_disk_behind_standard_output_is_one_line(tmp_path: Path, actor: Path) -> None:
    command = [*EMB_RUN, "--policy", str(actor), "--log", str(tmp_path / "run.mcap"), "--json"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "standard output" in done.stderr


def test_ctrl_c_while_the_imports_take_their_time_is_a_line_and_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_module: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib, "import_module", interrupted)
    assert emb_run() == 3
    assert_one_line(capsys, "stopped by the operator while it started")


def test_ctrl_c_inside_an_import_is_taken_after_it_and_python_s_own_handler_is_put_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pressed(_module: str) -> None:
        signal.raise_signal(signal.SIGINT)  # an exception here would leave a C extension as an ImportError

    before = signal.getsignal(signal.SIGINT)
    assert before is signal.default_int_handler
    monkeypatch.setattr(importlib, "import_module", pressed)
    assert emb_run() == 3
    assert signal.getsignal(signal.SIGINT) is before
    assert_one_line(capsys, "stopped by the operator while it started")


def test_the_shipped_bench_is_written_for_editing_and_not_over_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "my.toml"
    assert main(["--write-bench", str(path)]) == 0
    assert path.read_text() == shipped_bench_text()
    assert main(["--write-bench", str(path)]) == 2
    assert_one_line(capsys, "my.toml")


def test_the_help_documents_every_exit_code() -> None:
    out = subprocess.run([*EMB_RUN, "--help"], capture_output=True, text=True, check=True).stdout
    for code in range(7):
        assert f"\n  {code}  " in out


def test_the_help_names_every_key_of_the_simulated_bus(bench: Bench) -> None:
    out = subprocess.run([*EMB_RUN, "--help"], capture_output=True, text=True, check=True).stdout
    said = out.partition("the simulated bus:")[2].partition("exit codes:")[0]
    assert all(key in said for key in ("sim:KEY=VALUE", "seed", "plant", *PARAMETER_NAMES))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_nobody_is_on_the_bus_ends_cleanly_and_nothing_is_logged(
    tmp_path: Path, actor: Path, number: signal.Signals
) -> None:
    """On python-can's virtual bus there is no node: it listens until the signal comes."""
    patient = tmp_path / "bench.toml"
    patient.write_text(shipped_bench_text().replace("start_timeout = 5.0", "start_timeout = 60.0"))
    command = [*EMB_RUN, "--iface", "virtual:t", "--policy", str(actor), "--bench", str(patient), "--json"]
    logs = tmp_path / "logs"
    process = subprocess.Popen(
        [*command, "--log", str(logs)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_for(logs.exists)  # made just before the bus is opened, long after the signals were taken
    os.kill(process.pid, number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 3, err
    assert json.loads(out)["result"] == "INTERRUPTED"
    assert err.count("\n") == 1
    assert "before anything was sent" in err
    assert not logs.exists()


def test_no_node_is_a_bus_error_with_the_table_and_a_document(
    tmp_path: Path, actor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hasty = tmp_path / "bench.toml"
    hasty.write_text(shipped_bench_text().replace("start_timeout = 5.0", "start_timeout = 0.1"))
    arguments = [
        "--iface",
        "virtual:nobody",
        "--policy",
        str(actor),
        "--bench",
        str(hasty),
        "--log",
        str(tmp_path),
        "--no-rt",
    ]
    assert main([*arguments, "--json"]) == 4
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert (summary["result"], summary["exit_code"], summary["log"]) == ("NO_NODE", 4, None)
    assert {line["what"]: line["verdict"] for line in summary["preflight"]}["node"] == "refused"
    assert err.count("\n") == 1
    assert main(arguments) == 4
    out, err = capsys.readouterr()
    assert out == ""
    assert "PRE-FLIGHT" in err
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_the_middle_ends_the_run_with_stop_frames_and_a_whole_log(
    tmp_path: Path, actor: Path, sim: Sim, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    sim.when(lambda node: node.obeyed == 100, lambda _node: signal.raise_signal(number))
    assert main(["--policy", str(actor), "--log", str(tmp_path / "run.mcap"), "--json"]) == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["result"] == "INTERRUPTED"
    log = read_log(tmp_path / "run.mcap")
    assert log.complete
    assert log.end["exit_reason"] == "INTERRUPTED"
    assert list(log.signals("EMB_Command")["Enable"][-4:]) == [1, 0, 0, 0]


def wait_for(condition: object, seconds: float = 60.0) -> None:
    assert callable(condition)
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.05)
