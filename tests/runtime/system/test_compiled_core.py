"""Choice between the compiled core and its sources. A source that was changed stands in for a compiled module."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import emb_runtime
from emb_runtime.system.compiled_core import MANIFEST, identity

ROOT = Path(__file__).parents[3]
SOURCES = Path(emb_runtime.__file__).parent
NAME = "emb_runtime.safety.command_limits"
SOURCE = SOURCES / "safety" / "command_limits.py"

PROGRAM = f"""
import json
from emb_runtime.system import compiled_core
compiled_core.choose()
core = compiled_core.running()
from {NAME} import __file__ as file
from emb_runtime.control.phases import decide
print(json.dumps([core.compiled, core.text, core.warning, file, decide.__code__.co_filename]))
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the package as it is installed, but for its compiled core."""
    package = tmp_path / "emb_runtime"
    package.mkdir()
    for path in SOURCES.iterdir():
        if path.name != "native":
            (package / path.name).symlink_to(path)
    return tmp_path


def add_core(installed: Path, text: str, library: str = "", **changed: object) -> Path:
    """Add a compiled core of one module and a library; returns the module's file."""
    folder = installed / "emb_runtime" / "native"
    folder.mkdir()
    module = folder / f"{NAME}.py"
    module.write_text(text)
    (folder / "emb_core_library.py").write_text(library)
    files = {NAME: module.name, "emb_core_library": "emb_core_library.py"}
    (folder / MANIFEST).write_text(json.dumps({"identity": identity([NAME]), "files": files} | changed))
    return module


def run(installed: Path, *arguments: str, wanted: str = "") -> subprocess.CompletedProcess[str]:
    """Python with these arguments, a package that is installed, and a wish for a core."""
    environment = {name: value for name, value in os.environ.items() if name != "EMB_CORE"}
    environment |= {"PYTHONPATH": str(installed)} | ({"EMB_CORE": wanted} if wanted else {})
    return subprocess.run(
        [sys.executable, *arguments], env=environment, check=False, capture_output=True, text=True, cwd=ROOT
    )


def chosen(installed: Path, wanted: str = "") -> tuple[bool, str, str, list[str]]:
    """Returns True if the compiled core is taken, its name, why it is not, and the files of the module in use."""
    done = run(installed, "-c", PROGRAM, wanted=wanted)
    assert done.returncode == 0, done.stderr
    compiled, text, warning, *files = json.loads(done.stdout)
    return compiled, text, warning, files


def test_a_core_of_these_sources_is_taken_unless_python_is_asked_for(installed: Path) -> None:
    source = [str(installed / "emb_runtime" / "safety" / "command_limits.py")] * 2
    assert chosen(installed) == (False, "Python", "", source)
    module = add_core(installed, SOURCE.read_text())
    name = f"compiled (mypyc, {platform.machine().replace('_', '-')})"
    for wanted in ("", "compiled"):
        assert chosen(installed, wanted) == (True, name, "", [str(module)] * 2)
    assert chosen(installed, "python") == (False, "Python, as EMB_CORE asks", "", source)


def test_a_core_that_does_not_fit_is_a_warning_and_an_error_where_it_is_asked_for(installed: Path) -> None:
    cache, machine, sources = identity([NAME])
    rows: list[tuple[str, dict[str, object]]] = [
        ("", {"identity": [cache, machine, "0" * 64]}),
        ("", {"identity": ["cpython-27", machine, sources]}),
        ("", {"identity": [cache, "vax", sources]}),
        ("", {"files": 1}),
        ("", {"files": {"emb_runtime.gone": "gone.py"}}),
        ("raise ImportError('of another\\nkind')", {}),
    ]
    for library, changed in rows:
        folder = add_core(installed, SOURCE.read_text(), library, **changed).parent
        compiled, text, warning, files = chosen(installed)
        assert (compiled, text) == (False, "Python")
        assert warning.startswith("the compiled core is not taken: ")
        assert "\n" not in warning
        assert files[0] == str(installed / "emb_runtime" / "safety" / "command_limits.py")
        done = run(installed, "-m", "emb_runtime.cli.main", "--version", wanted="compiled")
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        shutil.rmtree(folder)


def test_emb_run_refuses_another_wish_in_one_line(installed: Path) -> None:
    code = "import sys; from emb_runtime.system.entry import emb_run; sys.exit(emb_run())"
    done = run(installed, "-c", code, "--help", wanted="fast")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_a_core_that_differs_in_one_bit_is_found_by_the_comparison(installed: Path) -> None:
    """That one that does not differ passes is what ``make compiled`` runs."""
    text = SOURCE.read_text()
    changed = text.replace("max(requested, -limits.current)", "max(requested, -limits.current * (1.0 + 2.0**-52))")
    assert changed != text
    add_core(installed, changed)
    options = ("-p", "no:cacheprovider", "--inputs", "1000", "-k", "limits")
    done = run(installed, "-m", "pytest", "tests/compiled", *options)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "of 1000 differ" in done.stdout
