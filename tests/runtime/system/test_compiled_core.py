"""Choice between the compiled core and its sources. A source that was changed stands in for a compiled module."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

import emb_runtime
from emb_runtime.cli import core_check
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system.compiled_core import MANIFEST, fingerprint

SOURCES = Path(emb_runtime.__file__).parent
NAME = "emb_runtime.safety.command_limits"
SOURCE = SOURCES / "safety" / "command_limits.py"
NOT_COMPARED = "emb_runtime.log.ring_buffer"  # A module of the core in which the comparison at the start calls nothing

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


def folder_of(
    directory: Path, text: str, others: Mapping[str, str] = MappingProxyType({}), /, **changed: object
) -> Path:
    """A compiled core of one module, and of others, by name."""
    folder = directory / "native"
    folder.mkdir()
    modules = {NAME: text, **others}
    for name, content in modules.items():
        (folder / f"{name}.py").write_text(content)
    sources = {name: SOURCES.parent.joinpath(*name.split(".")).with_suffix(".py") for name in modules}
    manifest = {
        "interpreter": sys.implementation.cache_tag,
        "machine": platform.machine(),
        "sources": {name: fingerprint(source) for name, source in sources.items()},
        "files": {name: f"{name}.py" for name in modules},
        "digests": {name: hashlib.sha256(content.encode()).hexdigest() for name, content in modules.items()},
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
        ({"sources": {}, "files": {}, "digests": {}}, "its manifest does not name"),
        ({"sources": {}}, "its manifest does not name"),
        ({"files": {}}, "its manifest does not name"),
        ({"digests": {}}, "its manifest does not name"),
        ({"sources": {NAME: fingerprint(SOURCE), NOT_COMPARED: ""}}, "its manifest does not name"),
        ({"files": 1}, "TypeError"),
    ],
    ids=[
        *("another interpreter", "another processor", "another source", "another manifest"),
        *("names nothing", "no source", "no file", "no hash", "a source without a file", "a manifest of other types"),
    ],
)
def test_a_core_that_is_for_something_else_is_not_taken(changed: dict[str, object], why: str, tmp_path: Path) -> None:
    compiled, _, warning, files = chosen(folder_of(tmp_path, SOURCE.read_text(), **changed))
    assert not compiled
    assert why in warning
    assert files == [SOURCE] * 2


@pytest.mark.parametrize(
    "damage",
    [Path.unlink, lambda file: file.write_bytes(file.read_bytes()[:-1]), lambda file: file.write_bytes(b"")],
    ids=["missing", "cut", "empty"],
)
@pytest.mark.parametrize("name", [NAME, NOT_COMPARED])
def test_a_core_with_a_damaged_file_is_not_taken(name: str, damage: Callable[[Path], object], tmp_path: Path) -> None:
    other = SOURCES / "log" / "ring_buffer.py"
    folder = folder_of(tmp_path, SOURCE.read_text(), {NOT_COMPARED: other.read_text()})
    assert chosen(folder)[0]
    damage(folder / f"{name}.py")
    compiled, said, warning, files = chosen(folder)
    assert (compiled, said) == (False, "Python")
    assert warning.startswith(f"the compiled core is not taken: {name}.py ")
    assert "\n" not in warning
    assert files == [SOURCE] * 2


def test_a_core_of_which_files_are_exchanged_is_not_taken(tmp_path: Path) -> None:
    other = SOURCES / "log" / "ring_buffer.py"
    folder = folder_of(tmp_path, SOURCE.read_text(), {NOT_COMPARED: other.read_text()})
    one, two = folder / f"{NAME}.py", folder / f"{NOT_COMPARED}.py"
    one.write_text(other.read_text())
    two.write_text(SOURCE.read_text())
    compiled, _, warning, files = chosen(folder)
    assert not compiled
    assert warning == f"the compiled core is not taken: {NAME}.py is not what was compiled"
    assert files == [SOURCE] * 2


def test_a_core_that_cannot_be_loaded_where_nothing_is_compared_is_not_taken(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, SOURCE.read_text(), {NOT_COMPARED: "raise ImportError('of another\\nkind')"})
    compiled, _, warning, files = chosen(folder)
    assert not compiled
    assert warning == r"the compiled core is not taken: ImportError: of another\nkind"
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


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the package as it is installed, but for its compiled core."""
    package = tmp_path / "emb_runtime"
    package.mkdir()
    for path in SOURCES.iterdir():
        if path.name != "native":
            (package / path.name).symlink_to(path)
    return tmp_path


def with_compiled(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python with these arguments where the compiled core is asked for."""
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | {"EMB_CORE": "compiled", "PYTHONPATH": str(installed)},
        check=False, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("module", ["emb_runtime.cli.main", "emb_bench.cli.replay"])
def test_who_asks_for_compiled_where_there_is_none_is_told_in_one_line(module: str, installed: Path) -> None:
    done = with_compiled(installed, "-m", module, "--version")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("EMB_CORE=compiled: ")
    assert "manifest" in done.stderr
    assert done.stderr.count("\n") == 1


def test_who_asks_for_compiled_gets_it_without_a_comparison_and_with_a_warning(installed: Path) -> None:
    other = SOURCE.read_text() + "\nOTHER = True\n"
    folder_of(installed / "emb_runtime", other)
    program = (
        "from emb_runtime.system.entry import choose_core; choose_core()\n"
        f"from emb_runtime.system import compiled_core; from {NAME} import OTHER\n"
        "core = compiled_core.running(); print(core.compiled, core.text, core.warning, sep='; ')"
    )
    done = with_compiled(installed, "-c", program)
    assert (done.returncode, done.stderr) == (0, "")
    processor = platform.machine().replace("_", "-")
    assert done.stdout == f"True; compiled (mypyc, {processor}), not compared; as EMB_CORE asks\n"


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (math.nan, -math.nan, True),
        ((1.0, [math.nan]), (1.0, [-math.nan]), True),
        (0.0, -0.0, False),
        (0.1 + 0.2, 0.3, False),
        (1, 1.0, False),
        (True, 1, False),
        ((1.0,), (1.0, 2.0), False),
        (Fault.NOT_HOME, int(Fault.NOT_HOME), True),
    ],
)
def test_answers_are_the_same_to_the_bit_but_for_the_sign_of_nan(one: object, other: object, same: bool) -> None:
    assert (core_check.bits(one) == core_check.bits(other)) is same
