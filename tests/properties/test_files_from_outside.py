"""Whatever a path that is typed leads to: one line on the error stream, the documented exit code, no waiting.

No code either: nothing that is read is executed.
"""

from __future__ import annotations

import ast
import errno
import inspect
import os
from pathlib import Path

import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.system.entry import run_command
from emb_runtime.system.input_file import _Regular
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate
from tests.test_cases import PROGRAMS

ROOT = Path(__file__).parents[2]
PACKAGES = ("runtime/emb_runtime", "bench/emb_bench", "train/emb_train", "export/emb_export")
COMMANDS = {
    "emb-run --iface sim --log new.mcap --policy {}": {2, 5},
    "emb-run --iface sim --log new.mcap --bench {}": {2},
    "emb-run --iface map:{}@sim --log new.mcap": {2},
    "emb-run --write-bench {}": {2},
    "emb-gateway --iface vcan0 --bench {} --drive x.toml@vcan1": {2},
    "emb-gateway --iface vcan0 --drive {}@vcan1": {2},
    "emb-node --iface vcan0 --bench {}": {2},
    "emb-commission brake --iface sim --yes --bench {}": {2},
    "emb-replay info {}": {2, 6},
    "emb-replay timing {}": {2, 6},
    "emb-replay rerun {}": {2, 6},
    "emb-replay estimate {}": {2, 6},
    "emb-replay estimate {}.csv --map map.toml": {2},
    "emb-replay estimate run.mcap --map {}": {2},
    "emb-replay estimate run.mcap --bench {}": {2},
    "emb-replay estimate run.mcap --last {}": {2, 6},
    "emb-replay report run.mcap -o new.html --acceptance {}": {2},
    "emb-replay report run.mcap -o {}/new.html": {2},
    "emb-replay export run.mcap -o {}/new.csv": {2},
    "emb-replay fim run.mcap --theta {}": {2, 6},
    "emb-replay campaign run.mcap --jobs 1 -o new.parquet --bench {}": {2},
    "emb-design --starts 1 -o new.csv --bench {}": {2},
    "emb-export {} -o new.onnx": {2},
    "emb-export design:file={} -o new.onnx": {2},
    "emb-export chirp -o new.onnx --bench {}": {2},
}
"""Command lines, and the exit codes that they may have."""
KINDS = ("pipe", "/proc/self/mem", "fails", "n" * 300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    here = tmp_path_factory.mktemp("outside")
    write_log(here / "run.mcap", simulate(square, options="plant=exact"))
    os.mkfifo(here / "pipe")
    (here / "map.toml").write_text("[columns]\n")
    (here / "fails").write_bytes(b"some content")
    return here


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind[:9])
def test_whatever_the_path_leads_to_one_line_says_so(
    kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def readinto(file: _Regular, buffer: memoryview) -> int:
        if kind == "fails" and str(file.name) == kind:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return plain(file, buffer)

    plain = _Regular.readinto  # of a disk that is broken
    monkeypatch.setattr(_Regular, "readinto", readinto)
    monkeypatch.chdir(folder)
    before = sorted(Path().iterdir())
    for command, codes in COMMANDS.items():
        program, *arguments = (word.replace("{}", kind) for word in command.split())
        monkeypatch.setattr("sys.argv", [program, *arguments])
        try:
            code = run_command(PROGRAMS[program], "")
        except SystemExit as ended:
            code = int(ended.code or 0)
        said = capsys.readouterr().err
        assert code in codes, (command, said)
        assert said.splitlines()[-1].startswith(program), (command, said)
        assert "Traceback" not in said, command
        assert sorted(Path().iterdir()) == before, command


RUNS = {"eval", "exec", "__import__", "run_path", "run_module", "read_pickle", "recv"}  # Last words of calls
PLAIN = {"compile", "builtins.compile", "torch.load"}  # Whole names, whose last words other things have
UNPICKLES = {"pickle", "_pickle", "marshal", "shelve", "dill", "joblib", "cloudpickle", "builtins", "runpy"}
KNOWN = {
    ("can/generated.py", "exec"),  # functions made from the package's own DBC: load_layout() takes no file
    ("policy/trial.py", "pickle"),  # the bench, from the parent, which made it
    ("emb_bench/parallel.py", "recv"),  # between a process and its own child, over a pipe that nobody else has
    ("export/torch_policy.py", "eval"),  # of a torch module: it no longer trains
    ("emb_train/network.py", "eval"),
}


def suspicious(source: str) -> set[str]:
    """What of a module could execute what it reads: the last word of a call, or a module that unpickles."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & UNPICKLES
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or ""} & UNPICKLES
            names = {alias.name for alias in node.names}
            found |= names & RUNS | {f"{node.module}.{name}" for name in names} & PLAIN
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            found |= {name.split(".")[-1]} & RUNS | {name} & PLAIN
            found |= {"allow_pickle"} & {word.arg for word in node.keywords}
    return found


def test_what_executes_or_unpickles_is_found_by_any_name() -> None:
    for source in (
        *("from pickle import loads", "import pickle as p", "import builtins", "from builtins import exec as run"),
        *("builtins.exec(text)", "torch.load(path)", "from torch import load", "pandas.read_pickle(path)"),
        *("from pandas import read_pickle", "pipe.recv()", "np.load(path, allow_pickle=True)", "compile(text, '', '')"),
    ):
        assert suspicious(source), source
    assert not suspicious("import re, json\nre.compile(text)\njson.loads(text)\nnp.load(path)")


def test_no_module_executes_or_unpickles_what_it_reads() -> None:
    found = set()
    for path in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        found |= {(f"{path.parent.name}/{path.name}", name) for name in suspicious(path.read_text(encoding="utf-8"))}
    assert found == KNOWN
    assert not inspect.signature(load_layout).parameters
