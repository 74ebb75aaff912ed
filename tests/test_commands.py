"""What holds of every command: its version, a help of 80 columns with examples that work, JSON that names its form."""

from __future__ import annotations

import argparse
import importlib
import io
import itertools
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from emb_bench.commission.commissioning import Commissioning
from emb_runtime.system.clock import MonotonicClock
from emb_runtime.system.terminal import DOCUMENT_SCHEMA
from tests.drives import late_bench
from tests.test_cases import called
from tools.shipped_files import COMMANDS

VERSION = metadata.version("emb-excite")


PARSERS: dict[str, argparse.ArgumentParser] = {
    command: importlib.import_module(module).parser() for command, module in COMMANDS.items()
}


def help_of(name: str) -> str:
    """The help of a command or sub-command."""
    command, *words = name.split()
    with redirect_stdout(io.StringIO()) as printed, suppress(SystemExit):
        PARSERS[command].parse_args([*words, "--help"])
    return printed.getvalue()


def names() -> Iterator[str]:
    """Each command, and its sub-commands as its help lists them."""
    for command in PARSERS:
        yield command
        listed = help_of(command).partition("\n  COMMAND\n")[2].partition("\n\n")[0]
        yield from (f"{command} {name}" for name in re.findall(r"^    (\w+)", listed, re.MULTILINE))


NAMES = [*names()]
EXAMPLES = {
    name: re.findall(r"^  (emb-.*)$", re.split("\nexamples?:\n", help_of(name))[-1], re.MULTILINE) for name in NAMES
}
DOCUMENTS = {
    "emb-run": "--log j.mcap --duration 0.1 --json",
    "emb-gateway": "drive.toml --bench late.toml --drive can0 --node vcan0 --serial 7 --yes --no-rt --json",
    "emb-node": "--iface can0 --duration 0.02 --no-rt --json",
    "emb-replay info": "run.mcap --json",
    "emb-replay estimate": "run.mcap --starts 1 --json",
    "emb-replay fim": "run.mcap --json",
    "emb-replay timing": "run.mcap --json",
    "emb-replay rerun": "run.mcap --json",
    "emb-replay export": "run.mcap -o j.csv --json",
    "emb-replay campaign": "run.mcap --jobs 1 -o j.parquet --json",
    "emb-design": "--bench short.toml --criterion D --starts 1 --params k_m,T_c --model euler -o j.csv --json",
    "emb-commission": "new --yes --json",
    "emb-train evaluate": "actor --draws 2 --plant euler --json",
}
"""Arguments with which each command that has ``--json`` prints its document."""
FILES = {"emb-replay report": "run.mcap --starts 1 -o j.html"}  # And those that write one


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command lines name."""
    here: Path = tmp_path_factory.mktemp("commands")
    (here / "runs").mkdir()
    assert called("emb-run", ["--iface", "sim", "--log", str(here / "run.mcap")]) == 0
    (here / "runs" / "run.mcap").write_bytes((here / "run.mcap").read_bytes())
    (here / "acceptance.toml").write_text("[acceptance.parameters.f_v]\nrelative = 0.5\n")
    assert called("emb-run", ["--write-bench", str(here / "short.toml")]) == 0
    (here / "late.toml").write_text(late_bench())
    text = (here / "short.toml").read_text().replace("horizon     = 500", "horizon     = 50")
    (here / "short.toml").write_text(re.sub(r"\[sensors\]\n(.+\n)+", "", text))
    return here


def test_a_help_is_80_columns_wide_and_ends_with_an_example(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, columns in itertools.product(NAMES, ("80", "200")):
        monkeypatch.setenv("COLUMNS", columns)
        assert [line for line in help_of(name).splitlines() if len(line) > 80] == [], name
        assert EXAMPLES[name], name


def test_an_example_is_a_command_line() -> None:
    for line in itertools.chain(*EXAMPLES.values()):
        words = shlex.split(line)
        asked = [words[: words.index("--")], *map(shlex.split, words[-1].split("&"))] if "--" in words else []
        for part in asked or [shlex.split(one) for one in line.partition(" > ")[0].split("&&")]:
            PARSERS[part[0]].parse_args(part[1:])


SIMULATED = re.compile(r"emb-(run (--iface sim|--quick)|replay (?!live)|export chirp)")


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines if SIMULATED.match(line)])
def test_an_example_of_a_simulated_brake_runs(line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process alone, as far as the first ``&&`` or ``>``; a simulation has no timing to judge."""
    monkeypatch.chdir(folder)
    line = re.sub(r"--jobs \d", "--jobs 1", re.split(" &&| >", line)[0].replace("runs/*.mcap", "runs/run.mcap"))
    command, *arguments = shlex.split(line)
    assert called(command, arguments) == (2 if arguments[0] == "timing" else 0)


def test_it_tells_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    for name in NAMES:
        command, *words = name.split()
        assert called(command, [*words, "--version"]) == 0
        assert capsys.readouterr().out == f"{command} {VERSION}\n"


@pytest.mark.parametrize("package", ["emb_runtime", "emb_bench", "emb_train", "emb_export"])
def test_a_package_that_is_run_says_which_commands_there_are(package: str) -> None:
    def said(*arguments: str) -> str:
        return subprocess.run(
            [sys.executable, "-m", package, *arguments], capture_output=True, text=True, check=True
        ).stdout

    assert said("--version") == f"{package} {VERSION}\n"
    assert set(re.findall(r"^  (emb-\w+)  +\w", said(), re.MULTILINE)) == {*COMMANDS}


def test_every_command_with_documents_is_in_the_table() -> None:
    has = {name for name in NAMES if re.search("^  --json ", help_of(name), re.MULTILINE)}
    assert has == {*DOCUMENTS}


@pytest.mark.parametrize("name", [*DOCUMENTS, *FILES])
def test_a_document_names_its_form(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    _without_a_bus(monkeypatch)
    command, *words = name.split()
    assert called(command, [*words, *(DOCUMENTS | FILES)[name].split()]) == (2 if "timing" in words else 0)
    printed = capsys.readouterr().out
    document = json.loads((folder / "j.json").read_text() if name in FILES else printed)
    assert next(iter(document.items())) == ("schema", DOCUMENT_SCHEMA)
    if name == "emb-design":
        assert json.loads((folder / "j.csv").read_text().partition("\n")[0].removeprefix("# ")) == document


def _without_a_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a bus, a drive and nine runs would take: the commands print all the same."""
    bus: Any = SimpleNamespace(name="can0", send=lambda _: None, receive=lambda _: None, close=lambda: None)
    monkeypatch.setattr("emb_bench.cli.node.open_transport", lambda *_: (bus, MonotonicClock()))
    monkeypatch.setattr("emb_runtime.cli.gateway.open_transport", lambda *_: (bus, MonotonicClock()))
    node = SimpleNamespace(times=SimpleNamespace(too_late=""))
    monkeypatch.setattr(
        "emb_runtime.cli.gateway.Gateway", lambda *_: SimpleNamespace(run=lambda *_, **__: None, node=node)
    )
    monkeypatch.setattr("emb_runtime.cli.gateway.report", lambda _: {"samples": 0})
    drives = Path(__file__).parents[1] / "examples" / "drives"
    for source, target in (("odrive.toml", "drive.toml"), ("odrive.dbc", "odrive.dbc")):
        Path(target).write_bytes((drives / source).read_bytes())
    monkeypatch.setattr(Commissioning, "run", lambda _: SimpleNamespace(bench=Path("new/bench.toml")))
