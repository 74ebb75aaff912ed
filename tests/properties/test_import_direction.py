"""Imports point down only, between packages and between rooms; and the base install needs no heavy package."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib.metadata
import re
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
    "export/emb_export": {"emb_runtime", "emb_bench", "emb_export"},
}
OWN = Path(__file__).relative_to(ROOT)
OURS = set.union(*MAY_IMPORT.values())
ROOMS = {
    "runtime/emb_runtime": "errors records numbers system config can estimator policy log safety drives control cli "
    "__main__",
    "bench/emb_bench": "config documents numbers options compiled output figures parallel brake sim logs experiment "
    "information excitation recordings hil rerun estimate design analysis export report commission live batch "
    "api cli",
    "train/emb_train": "presets closed_loop intervals lies rewards env play ppo plan training network optimum evaluate "
    "cli",
    "export/emb_export": "export",
}
"""Sub-packages and single modules of each package, lowest first: each imports from those before it only."""


distributions = functools.cache(importlib.metadata.packages_distributions)


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imported_modules(path: Path) -> tuple[str, ...]:
    """Every module that a file imports, at its top or in a function; ``a.b.name`` for ``from a.b import name``."""
    return tuple(modules_in(tree_of(path)))


def modules_in(tree: ast.AST) -> Iterator[str]:
    """Every module that a part of a file imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported(path: Path) -> Iterator[str]:
    return (module.partition(".")[0] for module in imported_modules(path))


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_package_imports_only_from_the_packages_below_it(room: str) -> None:
    files = list((ROOT / room).rglob("*.py"))
    assert len(files) > 1
    for path in files:
        assert set(imported(path)) & OURS <= MAY_IMPORT[room], path


@pytest.mark.parametrize("package", ROOMS)
def test_a_room_imports_only_from_the_rooms_before_it(package: str) -> None:
    order = ROOMS[package].split()
    name = package.partition("/")[2]
    for path in (ROOT / package).rglob("*.py"):
        room = path.relative_to(ROOT / package).parts[0].removesuffix(".py")
        if room == "__init__":
            continue
        for module in imported_modules(path):
            if module.startswith(f"{name}."):
                other = module.split(".")[1]
                if other == room or not list((ROOT / package).glob(f"{other}*")):  # a name of the package itself
                    continue
                assert other in order[: order.index(room)], f"{path} imports {module}"


@pytest.mark.parametrize("package", ROOMS)
def test_modules_import_each_other_without_a_circle(package: str) -> None:
    files = {_module_of(path): path for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py"}
    graph = {
        module: {found for name in imported_modules(path) for found in (name, name.rpartition(".")[0])} & set(files)
        for module, path in files.items()
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the modules


def _module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts[1:])


LIGHT = "emb_runtime.cli.main emb_bench.cli.node emb_bench.sim.transport emb_bench.cli.replay emb_bench.hil.cli"


def test_the_bench_computer_s_commands_load_no_heavy_package() -> None:
    code = f"import sys, {', '.join(LIGHT.split())}; emb_bench.cli.replay.parser(); print(*sorted(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    loaded = {name.partition(".")[0] for name in out.split()}
    heavy = {"torch", "scipy", "numba", "matplotlib", "gymnasium", "onnx", "onnxscript", "rich", "jinja2"}
    assert not loaded & (heavy | {"pyarrow", "pandas", "ray", "asammdf"})


def test_an_estimate_loads_no_package_that_takes_longer_than_itself() -> None:
    code = "import sys, emb_bench.analysis.stages, emb_bench.report.estimate; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    slow = {"scipy.stats", "matplotlib", "pyarrow", "pandas", "cantools", "polars", "ray", "torch"}
    assert not slow & set(done.stdout.split())


def test_every_third_party_import_is_declared_in_the_extra_where_it_belongs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    base = names(project["dependencies"])
    bench = base.union(*(names(extras[extra]) for extra in ("bench", "mdf", "live", "ray", "notebook")))
    train = bench.union(*(names(extras[extra]) for extra in ("train",)))
    allowed = {
        "runtime/emb_runtime": base,
        "bench/emb_bench": bench | {"torch"},  # a network that somebody hands over, who has it
        "train/emb_train": train,
        "export/emb_export": bench,
    }
    for room, declared in allowed.items():
        for path in (ROOT / room).rglob("*.py"):
            for module in set(imported(path)) - OURS - set(sys.stdlib_module_names):
                # A namespace such as google.protobuf belongs to several distributions: one declared is enough.
                providers = {p.lower().replace("_", "-") for p in distributions()[module]}
                assert providers & declared, f"{path} imports {module} ({providers})"


def test_an_extra_that_a_message_names_has_every_library_whose_lack_it_explains() -> None:
    guards = 0
    for path in (file for room in (*MAY_IMPORT, "proof", "studies", "tools") for file in (ROOT / room).rglob("*.py")):
        for guard in (node for node in ast.walk(tree_of(path)) if isinstance(node, ast.With)):
            call = guard.items[0].context_expr
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "needs":
                guards += 1
                extra = ast.literal_eval(call.args[1])
                for module in loaded_by(guard, path):
                    providers = {p.lower().replace("_", "-") for p in distributions()[module]}
                    assert providers & everything_in(extra), f"{path}: [{extra}] has no {module} ({providers})"
    assert guards > 15


def loaded_by(guard: ast.With, path: Path) -> set[str]:
    """Third-party packages that the imports below a guard load; where it has calls only, those of its file."""
    inside = list(modules_in(guard)) or list(imported_modules(path))
    ours, found = set[str](), set[str]()
    while inside:
        module = inside.pop()
        package, *rest = module.split(".")
        if package not in OURS:
            found |= {package} - set(sys.stdlib_module_names) - {"proof", "studies", "tools", "tests"}
        elif module not in ours:
            ours.add(module)
            file = next(iter(ROOT.glob(f"*/{package}"))).joinpath(*rest).with_suffix(".py")
            if file.exists():  # else a name in one, whose own module is found without it
                inside += at_top(file)
            inside += [module.rpartition(".")[0]] if rest else []
    return found


@functools.cache
def at_top(file: Path) -> list[str]:
    """Every module that a file imports at its top."""
    top = [node for node in tree_of(file).body if isinstance(node, ast.Import | ast.ImportFrom)]
    return [name for node in top for name in modules_in(node)]


@functools.cache
def everything_in(extra: str) -> set[str]:
    """Distributions that an extra brings."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = set(project["dependencies"])
    waiting = [extra]
    while waiting:
        for each in project["optional-dependencies"][waiting.pop()]:
            if each.startswith("emb-excite["):
                waiting += each.removeprefix("emb-excite[").rstrip("]").split(",")
            else:
                found.add(each)
    return names([*found])


def test_every_line_that_installs_the_project_works_in_a_clone_or_beside_its_wheels() -> None:
    """It is in no index, and without the constraints a training gets another torch."""
    tracked = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    lines = 0
    for name in tracked:
        if not name.endswith((".py", ".md", ".ipynb", ".yml")) or name == "CHANGELOG.md" or Path(name) == OWN:
            continue
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(r"pip install(?! --find-links /?dist ')[^`\n]*emb[-_]excite\[", text), name
        for options, extra in re.findall(r"pip install ([^`\n]*?)['\"]\.\[([^]]*)\]", text):
            lines += 1
            assert "-c constraints.txt" in options, name
            assert extra in {*extras, "{extra}"}, name
    assert lines > 8


def names(requirements: list[str]) -> set[str]:
    return {r.split(";")[0].split("[")[0].split(">")[0].split("=")[0].strip().lower() for r in requirements}
