"""Imports only point down: runtime ← bench ← train ← export; and the base install needs no heavy package."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAY_IMPORT = {
    "runtime/emb_runtime": {"emb_runtime"},
    "bench/emb_bench": {"emb_runtime", "emb_bench"},
    "train/emb_train": {"emb_runtime", "emb_bench", "emb_train"},
    "export/emb_export": {"emb_runtime", "emb_bench", "emb_train", "emb_export"},
}
OURS = set.union(*MAY_IMPORT.values())


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield (node.module or "").partition(".")[0]


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_from_the_rooms_below_it(room: str) -> None:
    files = list((ROOT / room).rglob("*.py"))
    assert len(files) > 1
    for path in files:
        assert set(imported(path)) & OURS <= MAY_IMPORT[room], path


@pytest.mark.parametrize(
    "module", ["emb_runtime.run", "emb_bench.node_cli", "emb_bench.sim", "emb_bench.replay", "emb_bench.hil.cli"]
)
def test_the_bench_computer_s_commands_load_no_heavy_package(module: str) -> None:
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    loaded = {name.partition(".")[0] for name in out.split()}
    heavy = {"torch", "scipy", "numba", "matplotlib", "gymnasium", "onnx", "onnxscript", "rich"}
    assert not loaded & (heavy | {"emcee", "pyarrow", "pandas", "ray", "asammdf"})


def test_every_third_party_import_is_declared_in_the_extra_where_it_belongs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    base = names(project["dependencies"])
    bench = base.union(*(names(extras[extra]) for extra in ("bench", "mdf", "ray")))
    train = bench.union(*(names(extras[extra]) for extra in ("train", "tensorboard")))
    allowed = {
        "runtime/emb_runtime": base,
        "bench/emb_bench": bench,
        "train/emb_train": train,
        "export/emb_export": train,
    }
    by_module = importlib.metadata.packages_distributions()
    for room, declared in allowed.items():
        for path in (ROOT / room).rglob("*.py"):
            for module in set(imported(path)) - OURS - set(sys.stdlib_module_names):
                # A namespace such as google.protobuf belongs to several distributions: one declared is enough.
                providers = {p.lower().replace("_", "-") for p in by_module[module]}
                assert providers & declared, f"{path} imports {module} ({providers})"


def names(requirements: list[str]) -> set[str]:
    return {r.split(";")[0].split("[")[0].split(">")[0].split("=")[0].strip().lower() for r in requirements}
