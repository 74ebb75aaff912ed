"""Choice between the compiled core and its sources. A source that was changed stands in for a compiled module."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

import emb_runtime
from emb_runtime.system.compiled_core import MANIFEST, fingerprint

SOURCES = Path(emb_runtime.__file__).parent
NAME = "emb_runtime.safety.command_limits"
SOURCE = SOURCES / "safety" / "command_limits.py"

PROGRAM = f"""
import json, pathlib, sys
from emb_runtime.system import compiled_core
compiled_core.FOLDER = pathlib.Path(sys.argv[1])
if len(sys.argv) > 2:
    import {NAME}
from emb_runtime.system.entry import choose_core
choose_core()
core = compiled_core.running()
from {NAME} import __file__ as file
from emb_runtime.control.loop import decide
print(json.dumps([core.compiled, core.text, core.warning, file, decide.__code__.co_filename]))
"""


def folder_of(directory: Path, text: str, **changed: object) -> Path:
    """A compiled core of one module."""
    folder = directory / "native"
    folder.mkdir()
    (folder / f"{NAME}.py").write_text(text)
    manifest = {
        "interpreter": sys.implementation.cache_tag,
        "machine": platform.machine(),
        "sources": {NAME: fingerprint(SOURCE)},
        "files": {NAME: f"{NAME}.py"},
    }
    (folder / MANIFEST).write_text(json.dumps(manifest | changed))
    return folder


def chosen(folder: Path, *arguments: str, wanted: str = "") -> tuple[bool, str, str, list[Path]]:
    """Returns True if the compiled core is taken, its name, why it is not, and the files of the module in use."""
    environment = {name: value for name, value in os.environ.items() if name != "EMB_CORE"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder), *arguments],
        env=environment | ({"EMB_CORE": wanted} if wanted else {}),
        check=True,
        capture_output=True,
        text=True,
    )
    compiled, text, warning, *files = json.loads(done.stdout)
    return compiled, text, warning, [Path(file) for file in files]


def test_a_core_that_agrees_with_its_sources_is_taken(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, SOURCE.read_text())
    compiled, text, warning, files = chosen(folder)
    assert (compiled, warning) == (True, "")
    assert text.startswith("compiled (mypyc, ")
    assert files == [folder / f"{NAME}.py"] * 2


def test_a_core_that_differs_in_one_bit_is_not_taken_and_nothing_of_it_stays(tmp_path: Path) -> None:
    text = SOURCE.read_text()
    changed = text.replace("max(wanted, -reach.limit)", "max(wanted, -reach.limit * (1.0 + 2.0**-52))")
    assert changed != text
    compiled, said, warning, files = chosen(folder_of(tmp_path, changed))
    assert (compiled, said) == (False, "Python")
    assert warning.startswith("the compiled core is not taken: command limits: input ")
    assert files == [SOURCE] * 2


@pytest.mark.parametrize(
    ("text", "why"),
    [("raise OSError('cannot be loaded')", "OSError: cannot be loaded"), ("", "AttributeError")],
    ids=["it cannot be loaded", "it is empty"],
)
def test_a_core_that_fails_is_not_taken(text: str, why: str, tmp_path: Path) -> None:
    compiled, _, warning, files = chosen(folder_of(tmp_path, text))
    assert not compiled
    assert why in warning or "ImportError" in warning
    assert files == [SOURCE] * 2


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"interpreter": "cpython-27"}, "it is for cpython-27 on "),
        ({"machine": "vax"}, " on vax"),
        ({"sources": {NAME: "0" * 64}}, f"it was compiled from another {NAME}"),
        ({"more": 1}, "its manifest cannot be read"),
    ],
    ids=["another interpreter", "another processor", "another source", "another manifest"],
)
def test_a_core_that_is_for_something_else_is_not_taken(changed: dict[str, object], why: str, tmp_path: Path) -> None:
    compiled, _, warning, files = chosen(folder_of(tmp_path, SOURCE.read_text(), **changed))
    assert not compiled
    assert why in warning
    assert files == [SOURCE] * 2


def test_where_none_is_installed_the_sources_are_taken_without_a_warning(tmp_path: Path) -> None:
    assert chosen(tmp_path / "native") == (False, "Python", "", [SOURCE] * 2)


def test_a_core_that_comes_too_late_is_not_taken(tmp_path: Path) -> None:
    compiled, _, warning, files = chosen(folder_of(tmp_path, SOURCE.read_text()), "imported before")
    assert not compiled
    assert f"{NAME} is imported already" in warning
    assert files == [SOURCE] * 2


def test_who_asks_for_python_gets_python(tmp_path: Path) -> None:
    compiled, text, warning, files = chosen(folder_of(tmp_path, SOURCE.read_text()), wanted="python")
    assert (compiled, text, warning) == (False, "Python, as EMB_CORE asks", "")
    assert files == [SOURCE] * 2


def test_emb_run_refuses_another_wish_in_one_line() -> None:
    code = "import sys; from emb_runtime.system.entry import emb_run; sys.exit(emb_run())"
    done = subprocess.run(
        [sys.executable, "-c", code, "--help"],
        env=os.environ | {"EMB_CORE": "fast"}, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "emb-run: EMB_CORE: expected python or compiled, got 'fast'\n"
