"""What a user can get wrong is one line on the error stream and an exit code, and changes no file: ``cases.toml``."""

from __future__ import annotations

import importlib
import os
import shlex
import signal
import sys
import tomllib
from pathlib import Path

import pytest

from emb_runtime.config.bench import load_bench, shipped_bench_text
from tests.actors import constant_actor
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate
from tests.drives import EXAMPLES
from tools.shipped_files import COMMANDS

PROGRAMS = COMMANDS  # The module whose ``main`` each command calls
CASES = tomllib.loads((Path(__file__).parent / "cases.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    """What the command lines name: logs, a policy, and the files of the table."""
    here = tmp_path_factory.mktemp("cases")
    write_log(here / "run.mcap", simulate(square, options="plant=exact"))
    write_log(here / "stribeck.mcap", simulate(square, options="plant=stribeck"))
    (here / "cut.mcap").write_bytes((here / "run.mcap").read_bytes()[:-5])
    (here / "weak.onnx").write_bytes(constant_actor(load_bench(), 2.0, sample_time=2e-3))
    (here / "cut.onnx").write_bytes(constant_actor(load_bench())[:200])
    (here / "link.mcap").symlink_to("run.mcap")
    for name in ("odrive.toml", "odrive.dbc", "mit.toml", "mit.dbc"):
        (here / name).symlink_to(EXAMPLES / name)
    for name in ("folder", *(f"folder.{ending}" for ending in ("csv", "html", "onnx", "png", "xml"))):
        (here / name).mkdir()
    for name, content in CASES["files"].items():
        (here / name).write_text(content, encoding="utf-8")
    for name, (old, new) in CASES["benches"].items():
        assert old in shipped_bench_text(), name
        (here / name).write_text(shipped_bench_text().replace(old, new), encoding="utf-8")
    return here


def called(program: str, arguments: list[str]) -> int:
    """The exit code of a command, called in this process."""
    try:
        code: int = importlib.import_module(PROGRAMS[program]).main(arguments)
    except SystemExit as ended:  # of argparse
        return int(ended.code or 0)
    return code


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_wrong_use_is_one_line_that_names_it_an_exit_code_and_no_file(
    program: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    before = {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}
    faults = []
    with Path(os.devnull).open() as nobody:
        monkeypatch.setattr(sys, "stdin", nobody)
        for line, code, named in CASES[program]:
            capsys.readouterr()
            found = called(program, shlex.split(line))
            out, err = capsys.readouterr()
            short = err.startswith(program) and err.count("\n") == 1 and err[:-1].isprintable()
            if found != code or out or not short or named not in err:
                faults.append(f"{program} {line}: {found}, expected {code} and {named!r}\n{out}{err}")
            if before != {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}:
                pytest.fail(f"{program} {line}: left or changed a file")
    for number, handler in kept.items():
        signal.signal(number, handler)
    assert not faults, "\n".join(faults)
