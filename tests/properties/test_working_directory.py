"""No command runs a module that lies in the working directory, in any of the processes that it starts."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from emb_runtime.cli.main import main as emb_run

ROOT = Path(__file__).parents[2]
PLANTED = (
    *("json", "struct", "socket", "pickle", "selectors", "signal", "runpy", "random", "csv", "logging", "platform"),
    *("multiprocessing", "sitecustomize", "usercustomize", "numpy", "scipy", "numba", "mcap", "msgspec", "cantools"),
    *("onnxruntime", "pyarrow", "ray", "emb_runtime", "emb_bench", "emb_export", "emb_train"),
)
STARTING = {
    "emb-run --iface sim --log run.mcap --policy actor.onnx --report run.html": 0,
    "emb-run --iface sim --log live.mcap --live 0": 0,
    "emb-run --iface nope0 --home": 4,
    "emb-gateway --iface nope0 --drive map.toml": 2,
    "emb-commission brake --bench bench.toml --iface nope0 --yes": 4,
    "emb-replay campaign made.mcap -o rows.parquet --jobs 2": 0,
    "emb-replay campaign made.mcap -o ray.parquet --jobs 2 --ray local": 0,
}
"""Commands that start processes, and their exit codes."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found: Path = tmp_path_factory.mktemp("here")
    assert emb_run(["--iface", "sim", "--log", str(found / "made.mcap")]) == 0
    for name in PLANTED:
        (found / f"{name}.py").write_text(f"open({str(found / 'ran')!r}, 'a').write('{name} ')\nraise SystemExit(77)\n")
    (found / "actor.onnx").write_bytes((ROOT / "runtime/emb_runtime/policy/quick.onnx").read_bytes())
    (found / "bench.toml").write_text((ROOT / "runtime/emb_runtime/config/bench.toml").read_text())
    return found


SLOW = [pytest.param(command, marks=pytest.mark.slow) for command in STARTING if "--ray" in command]


@pytest.mark.parametrize("command", [*(command for command in STARTING if "--ray" not in command), *SLOW])
def test_no_process_runs_a_module_of_the_working_directory(command: str, folder: Path) -> None:
    name, *arguments = command.split()
    (folder / "ran").unlink(missing_ok=True)
    line = [str(Path(sys.executable).with_name(name)), *arguments]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)
    ran = folder / "ran"
    assert not ran.exists(), ran.read_text()
    assert done.returncode == STARTING[command], done.stderr


def test_no_interpreter_is_started_with_the_working_directory_in_its_path() -> None:
    found = 0
    for path in ROOT.glob("*/emb_*/**/*.py"):
        for line in path.read_text(encoding="utf-8").splitlines():
            started = re.search(r"sys\.executable, (.*)|exec \{python\} (.*)", line)
            if started:
                found += 1
                assert re.match(r'"?-P\b', started[1] or started[2]), f"{path}: {line.strip()}"
    assert found >= 3
