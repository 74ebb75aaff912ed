"""Size and shape of the source tree: files and lines, modules side by side, import levels, circles, presentation.

    python benchmarks/tree.py [TREE]

TREE is a checkout, by default this one; one from before the packages had sub-packages is measured as well. Lines are
those of Python files, blank ones and comments included. An import level is the longest chain of imports below a module,
imports inside functions and for type checking included.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

PACKAGES = ("runtime/emb_runtime", "bench/emb_bench", "train/emb_train", "export/emb_export")
OUTSIDE = ("studies", "tools", "tests", "benchmarks")
PRESENTATION = (
    # command lines and entry points
    r"runtime/emb_runtime/cli/(main|options|summary)\.py",
    r"runtime/emb_runtime/(run|options|summary|entry|terminal)\.py",
    r"runtime/emb_runtime/system/(entry|terminal)\.py",
    r"(bench/emb_bench|train/emb_train|export/emb_export)/(.*/)?(\w+_)?(cli|entry|replay|fim)\.py",
    r"(bench/emb_bench|train/emb_train)/cli/.*\.py",
    r"bench/emb_bench/(logs/)?info\.py",
    r"export/emb_export/export\.py",
    r"train/emb_train/(train|sweep|names|progress|structured/tune)\.py",
    r"(bench/emb_bench|train/emb_train)/.*/progress\.py",
    # text, JSON, HTML and figures
    r"bench/emb_bench/(figures|numbers|output)\.py",
    r"bench/emb_bench/report/.*\.(py|css|html|txt|j2)",
    r".*/templates/.*",
    r"(bench|train|export)/.*/(report|summary|markup|page|picture|figure|plots|facts|output)\.py",
    r"bench/emb_bench/(estimate|analysis|compare)/(conclusion|advice|recommendation|terms)\.py",
)
"""Patterns of files that only take words in or put results out, in either layout."""


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", nargs="?", type=Path, default=Path(__file__).parents[1])
    tree = parser.parse_args().tree
    print(f"{'':24}{'files':>8}{'lines':>8}")
    product = 0, 0
    for folder in (*PACKAGES, *OUTSIDE):
        files = list((tree / folder).rglob("*.py"))
        count = len(files), lines(files)
        if folder in PACKAGES:
            product = product[0] + count[0], product[1] + count[1]
        if folder == PACKAGES[-1]:
            print(f"{folder:24}{count[0]:8}{count[1]:8}\n{'product':24}{product[0]:8}{product[1]:8}")
        else:
            print(f"{folder:24}{count[0]:8}{count[1]:8}")
    largest = max((len(modules), folder) for folder, modules in rooms(tree))
    print(f"\nmost modules side by side: {largest[0]}, in {largest[1]}")
    for package in PACKAGES:
        graph = imports(tree / package)
        of_rooms = between_rooms(graph)
        circles = sorted({tuple(circle) for circle in (*cycles(graph), *cycles(of_rooms))})
        print(
            f"{package}: {levels(graph)} import levels of modules, {levels(of_rooms)} of sub-packages, "
            f"{len(circles)} circles{''.join(': ' + ', '.join(circle) for circle in circles)}"
        )
    shown = lines(presentation(tree))
    print(f"presentation: {shown} lines, {100 * shown / product[1]:.1f} % of the product's")


def lines(files: Iterable[Path]) -> int:
    """Returns the number of lines of all files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def rooms(tree: Path) -> Iterator[tuple[str, list[Path]]]:
    """Yields each folder of the product with its modules."""
    for package in PACKAGES:
        for folder in sorted({path.parent for path in (tree / package).rglob("*.py")}):
            yield str(folder.relative_to(tree)), [p for p in folder.glob("*.py") if p.name != "__init__.py"]


def presentation(tree: Path) -> list[Path]:
    """Returns the files of the product that match :data:`PRESENTATION`."""
    pattern = re.compile("|".join(f"({one})" for one in PRESENTATION))
    every = (path for package in PACKAGES for path in (tree / package).rglob("*") if path.is_file())
    return [path for path in every if pattern.fullmatch(path.relative_to(tree).as_posix())]


def imports(package: Path) -> dict[str, set[str]]:
    """Returns the modules of a package, each with those of the same package that it imports; names below the package.

    A package's ``__init__`` counts as the module of its name.
    """
    files = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    graph = {}
    for module, path in files.items():
        names = {name.removeprefix(f"{package.name}.") for name in imported(path, package.name)}
        graph[module] = {found for name in names if (found := longest(name, files)) not in ("", module)}
    return graph


def longest(name: str, files: Mapping[str, Path]) -> str:
    """Returns the module that a dotted name is in; empty if it is the package itself."""
    while name and name not in files:
        name = name.rpartition(".")[0]
    return name


def imported(path: Path, package: str) -> Iterator[str]:
    """Yields ``package.module.name`` for every import of a file from its own package."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith(f"{package}."))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == package:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def between_rooms(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Returns the imports between sub-packages; a single module of the package counts as one."""
    found: dict[str, set[str]] = {}
    for module, others in graph.items():
        room = module.partition(".")[0]
        found.setdefault(room, set()).update({other.partition(".")[0] for other in others} - {room})
    return found


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Returns the groups of nodes that reach one another, each sorted."""
    groups = {tuple(sorted(n for n in reach(graph, node) if node in reach(graph, n))) for node in graph}
    return [list(group) for group in sorted(groups) if len(group) > 1]


def reach(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """Returns the nodes that can be reached from one."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = graph.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found


def levels(graph: Mapping[str, set[str]]) -> int:
    """Returns the number of nodes on the longest chain of imports; the nodes of a circle count as one."""
    circle = {node: group[0] for group in cycles(graph) for node in group}
    height: dict[str, int] = {}

    def of(node: str) -> int:
        if node not in height:
            members = [n for n in graph if circle.get(n, n) == node]
            below = {circle.get(other, other) for n in members for other in graph[n]} - {node}
            height[node] = 1 + max((of(other) for other in below), default=0)
        return height[node]

    return max(of(circle.get(node, node)) for node in graph)


if __name__ == "__main__":
    main()
