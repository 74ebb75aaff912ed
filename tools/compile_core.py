"""Compiles the modules of the control cycle ahead of time, with mypyc, from the sources as they are.

    python -m tools.compile_core           # for this interpreter, beside the sources: EMB_CORE=compiled takes them

In the build of a wheel this is a hook of hatchling, left out unless it is asked for:

    HATCH_BUILD_HOOK_ENABLE_CUSTOM=true python -m build --wheel

It needs a C compiler, and mypy. What takes the result, and when, is in ``emb_runtime/system/compiled_core.py``.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parents[1]
PACKAGE = "emb_runtime"
FOLDER = ROOT / "runtime" / PACKAGE / "native"
LEFT_OUT = {
    "can.interfaces": "opens a bus, once",
    "control.actor": "an interface, and an actor that wants nothing",
    "control.stop_condition": "four comparisons, which a test's double may answer as well",
    "estimator.estimate": "formats the estimate, once",
    "safety.heartbeat": "memory words; compiled they cost the same",
    "safety.watchdog": "starts a process, once",
    "safety.watchdog_process": "runs in another process",
}
"""Modules of the cycle's rooms that are not compiled, and why."""
MODULES = (
    *(
        f"{room}.{path.stem}"
        for room in ("can", "estimator", "safety", "control")
        for path in sorted((ROOT / "runtime" / PACKAGE / room).glob("*.py"))
        if path.stem != "__init__" and f"{room}.{path.stem}" not in LEFT_OUT
    ),
    *("log.recorder", "policy.policy"),
)
"""Modules that are compiled: those whose functions run once per cycle, and their neighbours."""
LIBRARY = "emb_core"
OPTIONS = ["-ffp-contract=off", "-g0"]
"""A product and a sum in one instruction would round once where Python rounds twice."""


class CompiledCore(BuildHookInterface):  # type: ignore[type-arg]  # the parameter is the builder's configuration
    """Puts the compiled core into a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and have the result included: the wheel is for this interpreter and this kind of processor."""
        folder = Path(self.directory) / "native"
        folder.parent.mkdir(exist_ok=True)
        compile_core(folder)
        build_data["force_include"][str(folder)] = f"{PACKAGE}/native"
        build_data["pure_python"] = False
        build_data["infer_tag"] = True

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what the wheel now holds."""
        shutil.rmtree(Path(self.directory) / "native")


def compile_core(folder: Path) -> None:
    """Compile the core into a folder, which is made anew.

    Raises:
        SystemExit: a module cannot be compiled; what mypyc says of it is printed.
    """
    from mypyc.build import mypycify
    from setuptools import Distribution
    from setuptools.command.build_ext import build_ext

    names = [f"{PACKAGE}.{module}" for module in MODULES]
    sources = [str(Path(*name.split(".")).with_suffix(".py")) for name in names]
    with tempfile.TemporaryDirectory(prefix="emb-core-") as temporary, _working_in(ROOT / "runtime"):
        arguments = ["--strict", "--explicit-package-bases", "--ignore-missing-imports", *sources]
        extensions = mypycify(arguments, opt_level="3", group_name=LIBRARY, target_dir=temporary)
        for extension in extensions:
            extension.extra_compile_args += OPTIONS
        command = build_ext(Distribution({"name": LIBRARY, "ext_modules": extensions}))
        command.build_lib, command.build_temp = f"{temporary}/lib", f"{temporary}/objects"
        command.ensure_finalized()
        command.run()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        files = {}
        suffix = sysconfig.get_config_var("EXT_SUFFIX")
        for built in Path(temporary, "lib").rglob(f"*{suffix}"):
            name = ".".join(built.relative_to(Path(temporary, "lib")).parts).removesuffix(suffix)
            files[name] = f"{name}{suffix}"
            shutil.copyfile(built, folder / files[name])
        _write_manifest(folder, files)


def _write_manifest(folder: Path, files: dict[str, str]) -> None:
    sys.path.insert(0, str(ROOT / "runtime"))
    from emb_runtime.system.compiled_core import MANIFEST, identity

    manifest = {"identity": identity(name for name in files if "." in name), "files": files}
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


if __name__ == "__main__":
    compile_core(FOLDER)
