"""``emb-run --commission`` on the command line: what does not go with it, and what it needs, in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import pytest

from emb_runtime.cli import commissioning
from emb_runtime.cli.commissioning import ExaminerProcess
from emb_runtime.cli.main import main
from emb_runtime.cli.options import parser
from emb_runtime.cli.preflight import RefusedError
from emb_runtime.errors import UsageError


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--zero"], "--zero"),
        (["--limit", "1"], "--limit"),
        (["--repeat", "3"], "--repeat"),
        (["--policy", "x.onnx", "--home"], "--policy, --home"),
        (["--log", "runs/x.mcap"], "--log"),
        (["--duration", "0.1"], "--duration"),
    ],
)
def test_what_it_chooses_by_itself_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], named: str
) -> None:
    folder = tmp_path / "brake"
    assert main(["--iface", "sim", "--commission", str(folder), *more]) == 2
    assert capsys.readouterr().err == f"emb-run: --commission: chooses {named} by itself, step by step\n"
    assert not folder.exists()


def test_without_an_estimator_it_says_so_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "entry_points", lambda **_: [])
    assert main(["--iface", "sim", "--commission", str(tmp_path / "brake")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "emb_bench" in err


def test_the_examiner_of_this_package_is_registered() -> None:
    (entry,) = metadata.entry_points(group=commissioning.ENTRY_POINTS, name="logs")
    assert {"ended", "rest", "current", "first_move", "identify"} <= set(dir(entry.load()))


@pytest.mark.parametrize("folder", ["file", "file/below"])
def test_a_folder_that_cannot_be_made_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: str
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["--iface", "sim", "--commission", str(tmp_path / folder)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_on_a_real_bus_every_step_is_confirmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--iface", "can0", "--commission", str(tmp_path / "brake"), "--no-rt"]) == 2
    assert "--confirm: there is nobody to ask" in capsys.readouterr().err
    assert not list((tmp_path / "brake").glob("*.mcap"))


@pytest.mark.parametrize(
    ("iface", "asks"),
    [
        ("can0", True), ("virtual", True), ("sim0", True), ("pcan:PCAN_USBBUS1", True), ("map:d@x.toml@can0", True),
        ("map:drive.toml@virtual", True), ("can0@sim", True),
        ("sim", False), ("sim:seed=3", False), ("virtual:x", False), ("map:d@x.toml@sim-drive:vesc", False),
    ],
)  # fmt: skip
@pytest.mark.parametrize("more", [[], ["--yes"], ["--confirm"]])
def test_every_step_is_confirmed_unless_told_otherwise_or_nobody_else_is_on_the_bus(
    iface: str, asks: bool, more: list[str]
) -> None:
    options = commissioning._options(parser().parse_args(["--iface", iface, "--commission", "brake", *more]))
    assert ("--confirm" in options) is (more != ["--yes"] and (asks or more == ["--confirm"]))
    assert ("--yes" in options) is (more == ["--yes"])


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> metadata.EntryPoint:
    """An examiner that can be asked to wait."""
    entry = metadata.EntryPoint("logs", "threading:Event", commissioning.ENTRY_POINTS)
    monkeypatch.setattr(metadata, "entry_points", lambda **_: [entry])
    return entry


@pytest.mark.usefixtures("waits")
def test_who_wants_an_end_need_not_wait_for_an_estimate() -> None:
    examiner = ExaminerProcess(lambda: True)
    with pytest.raises(RefusedError, match="stopped by the operator while logs were examined") as ended:
        examiner._ask("wait", 1e6)
    examiner.close()
    assert ended.value.exit_code == 3


@pytest.mark.usefixtures("waits")
def test_an_examiner_that_died_is_one_line() -> None:
    examiner = ExaminerProcess(lambda: False)
    os.kill(examiner._process.result(), signal.SIGKILL)
    with pytest.raises(UsageError, match="the process that estimates has ended"):
        examiner._ask("wait", 1e6)
    examiner.close()


def test_the_examiner_ends_with_the_run_even_if_that_is_killed() -> None:
    program = (
        "from emb_runtime.cli.commissioning import ExaminerProcess; import time\n"
        "if __name__ == '__main__':\n"
        "    print(ExaminerProcess(lambda: False)._process.result(), flush=True); time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = Path("/proc") / parent.stdout.readline().strip()
    assert child.exists()
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 120.0
    while child.exists() and "\nState:\tZ" not in (child / "status").read_text():
        assert time.monotonic() < deadline, "it is still there"
        time.sleep(0.05)
