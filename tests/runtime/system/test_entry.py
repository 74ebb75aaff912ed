"""A Ctrl-C at any moment of a command, from its first line on, is a line or nothing, and never a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate

STEP = 50  # Imports from one Ctrl-C to the next; with torch, which ends slowly, 12 times as many
PRESSED = """
import importlib, os, re, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
module, name, step, codes, *sys.argv = sys.argv[1:]
class Pressed:
    imports = 0
    def find_spec(self, what, *_):
        Pressed.imports += 1
        if Pressed.imports % int(step) or threading.active_count() > 1:  # a thread would be missing in the copy
            return
        if copy := os.fork():
            with open(codes, "a") as file:
                print(os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1]), file=file)
        else:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
entry = getattr(importlib.import_module(module), name)
sys.meta_path.insert(0, Pressed())
sys.exit(entry())
"""
"""A command, of which a copy gets a Ctrl-C at each of its imports, or some of them."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    """A folder with a log."""
    folder = tmp_path_factory.mktemp("entry")
    write_log(folder / "run.mcap", simulate(square, options="plant=exact"))
    return folder


@pytest.mark.parametrize(
    ("command", "words", "ends"),
    [
        ("emb_runtime.system.entry:emb-run", "--no-rt --log new.mcap", (-2, 3)),
        ("emb_runtime.system.entry:emb-gateway", "run.mcap --drive a --node b", (-2,)),
        ("emb_bench.cli.entry:emb-node", "--iface no0", (-2, 0, 4)),
        ("emb_bench.cli.entry:emb-replay", "info run.mcap", (-2, 130)),
        pytest.param("emb_bench.cli.entry:emb-replay", "fim run.mcap", (-2, 130), marks=pytest.mark.slow),
        ("emb_bench.cli.entry:emb-replay", "estimate run.mcap --starts 1", (-2, 130)),
        ("emb_bench.cli.entry:emb-replay", "export run.mcap -o run.png", (-2, 130)),
        pytest.param("emb_bench.cli.entry:emb-replay", "rerun run.mcap", (-2, 130), marks=pytest.mark.slow),
        ("emb_bench.cli.entry:emb-design", "--starts 0", (-2, 130)),
        ("emb_bench.cli.entry:emb-commission", "--iface sim:seed=x new", (-2, 130)),
        ("emb_bench.cli.entry:emb-hil", "--host -- true", (-2, 130)),
        ("emb_train:emb-train", "evaluate none", (-2, 130)),
        ("emb_export:emb-export", "step -o step.onnx", (-2, 130)),
    ],
)
def test_ctrl_c_at_any_import_is_no_traceback(folder: Path, command: str, words: str, ends: tuple[int, ...]) -> None:
    module, name = command.split(":")
    codes, step = folder / f"codes-{os.urandom(4).hex()}", STEP if name != "emb-train" else 12 * STEP
    words_of_it = [module, name.replace("-", "_"), str(step), str(codes), name, *words.split()]
    done = subprocess.run(
        [sys.executable, "-c", PRESSED, *words_of_it], cwd=folder, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert set(map(int, codes.read_text().split())) <= set(ends)


LOST = """
import os, signal, time

class Deaf:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)

def main():
    Deaf()
    while True:
        time.sleep(0.001)
"""
MISTAKEN = """
import os, signal

def main():
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt as err:
        raise SystemError("a library returned a result with an exception set") from err
"""


@pytest.mark.parametrize("command", [LOST, MISTAKEN], ids=["dropped in a destructor", "made another error"])
def test_a_ctrl_c_that_a_library_takes_ends_the_command_all_the_same(tmp_path: Path, command: str) -> None:
    (tmp_path / "command.py").write_text(command)
    code = "import sys; from emb_runtime.system import entry; sys.exit(entry.run_command('command', 'interrupted'))"
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background ignores it
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    signal.signal(signal.SIGINT, before)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
