"""Mutation run: changes one place of a module at a time and sees whether the module's tests notice.

    python -m tests.mutation [MODULE ...] [--list | --coverage | --changed]

Prints a score per module, and each mutant that survived. Exits with 1 if one survived that ``equivalent.toml`` does not
list, or if that file lists one that does not exist or that the tests do notice.

Why our own: mutmut 3 changes the bodies of functions only and leaves out properties, so it would miss the transition
table, the fault table and the constants; cosmic-ray writes each mutant into the working tree and starts a new Python
for it, seconds of imports each; mutatest has had no release since 2022.

Killed: a test fails, the module cannot be imported, the process dies, or it uses up its processor time. Before anything
is believed, the tests must pass with the module unchanged and fail with every function of it raising.

``--changed`` judges the modules whose verdict may differ from that at a commit (``main``): their tests have changed, or
what all tests share and any of the modules, docstrings and comments apart. Where git does not know the commit all are
judged.
"""

from __future__ import annotations

import argparse
import ast
import functools
import os
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path

from tests.mutation.trials import ROOT, Mutant, UntrustworthyError, import_libraries, judge_all, path_of

RUNTIME = "tests/runtime/"
TESTS = {
    "can.e2e": ("test_e2e.py", "test_messages.py"),
    "can.codec": ("test_messages.py", "test_codec.py"),
    "can.generated": ("test_messages.py", "test_codec.py"),
    "can.messages": ("test_messages.py",),
    "safety.state_machine": ("test_state_machine.py",),
    "safety.guard": ("test_guard.py",),
    "safety.device_clock": ("test_device_clock.py",),
    "safety.drive_monitor": ("test_drive_monitor.py",),
    "safety.command_limits": ("test_command_limits.py",),
    "safety.shield_design": ("test_shield_design_reference.py",),
    "safety.shield": ("test_shield_reference.py",),
    "safety.sensor_thresholds": ("test_sensor_monitor_reference.py",),
    "safety.sensor_monitor": ("test_sensor_monitor.py", "test_sensor_monitor_reference.py"),
    "safety.motion_balance": ("test_motion_balance.py",),
    "safety.response": ("test_response_reference.py", "test_response.py"),
    "estimator.kalman": ("test_frozen.py", "test_kalman.py"),
    "estimator.stick_slip": ("test_frozen.py", "test_stick_slip.py"),
    "estimator.speed_loop": ("test_frozen.py", "test_speed_loop.py"),
    "estimator.estimator": ("test_estimator.py",),
    "drives.wire_guard": ("test_wire_guard.py",),
    "drives.gateway": ("test_gateway.py",),
    "drives.time_out_proof": ("test_time_out_proof.py",),
}
"""The tests of each module of emb_runtime: the fast ones, and none that runs compiled code."""
EQUIVALENT = Path(__file__).parent / "equivalent.toml"


def main() -> int:
    """Run; see the module."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=f"of {', '.join(TESTS)}; all without")
    parser.add_argument("--list", action="store_true", help="print every mutant, and what killed it")
    parser.add_argument("--coverage", action="store_true", help="run these tests once instead, under branch coverage")
    parser.add_argument(
        "--changed", nargs="?", const="main", metavar="COMMIT", help="only modules that differ from it (default: main)"
    )
    options = parser.parse_args()
    if unknown := set(options.modules) - set(TESTS):
        parser.error(f"expected modules of {', '.join(TESTS)}, got {', '.join(sorted(unknown))}")
    os.chdir(ROOT)
    modules = options.modules or list(TESTS)
    if options.changed is not None:
        modules = [module for module in modules if differs(module, options.changed)]
        print(f"changed since {options.changed}: {', '.join(modules) or 'none'}", flush=True)
        if not modules:
            return 0
    tests = sorted({test for module in modules for test in tests_of(module)})
    if options.coverage:
        measured = [f"--cov=emb_runtime.{module}" for module in modules]
        how = ["--cov-branch", "--cov-report=term-missing", "--cov-fail-under=100"]
        os.execv(sys.executable, [sys.executable, "-m", "pytest", *measured, *how, *tests])
    import_libraries(tests)
    return max([run(module, options.list) for module in modules])


def run(module: str, listed: bool) -> int:
    """Judge every mutant of a module and print its score; 1 if something is not as it should be."""
    begin = time.monotonic()
    out = sys.stdout  # pytest's own is turned off meanwhile
    equivalent = equivalents(module)
    counted: Counter[str] = Counter()
    missing = set(equivalent)
    alike: Counter[tuple[str, str, str]] = Counter()

    def tell(mutant: Mutant, by: str) -> None:
        text = (mutant.where, mutant.was, mutant.becomes)
        alike[text] += 1
        entries = equivalent & {(*text, 0), (*text, alike[text])}
        missing.difference_update(entries)
        verdict = ("listed but killed" if by else "equivalent") if entries else "killed" if by else "survived"
        counted[verdict] += 1
        if listed or verdict in ("survived", "listed but killed"):
            print(f"{verdict}: {mutant}", *([f"    by {by}"] if by else []), sep="\n", file=out, flush=True)

    try:
        judge_all(module, tests_of(module), tell)
    except UntrustworthyError as err:
        print(err)
        return 1
    for entry in sorted(missing):
        print(f"{module}: equivalent.toml lists what is no mutant: " + " | ".join(map(str, entry)))
    score = ", ".join(f"{n} {verdict}" for verdict, n in sorted(counted.items()))
    print(f"{module}: {counted.total()} mutants: {score}; {time.monotonic() - begin:.0f} s", flush=True)
    if missing or counted["survived"] or counted["listed but killed"]:
        return 1
    return 0


def differs(module: str, commit: str) -> bool:
    """Whether a module's verdict may be another one than at a commit.

    It rests on the module, its tests and its entries in the list; on mutation itself, on the other modules, which its
    tests call, and on what tests share: the bench, the drives, the scenarios and the stream of frames.
    """
    files = [*map(path_of, TESTS), *(ROOT / name for name in tests_of(module)), *Path(__file__).parent.glob("*.py")]
    files += [ROOT / f"tests/{name}.py" for name in ("benches", "conftest", "drives", "independent", "laws")]
    files += [ROOT / "tests/fuzz/stream.py", *(ROOT / "tests/scenarios").glob("*.py")]
    files += [path for path in (ROOT / "examples/drives").iterdir() if path.is_file()]
    files += [ROOT / RUNTIME / "conftest.py", path_of("config.bench"), path_of("config.bench").with_suffix(".toml")]
    if any(_now(path) != _at(commit, path) for path in files):
        return True
    before = _at(commit, EQUIVALENT)
    return before is None or equivalents(module) != equivalents(module, before)


@functools.cache
def _now(path: Path) -> str:
    """A file as it is, like :func:`_at`: most modules rest on the same ones."""
    return _without_words(path, path.read_text(encoding="utf-8"))


@functools.cache
def _at(commit: str, path: Path) -> str | None:
    """A file as it was where a branch left a commit; None where it was not, or git knows neither."""
    base = subprocess.run(["git", "merge-base", commit, "HEAD"], capture_output=True, text=True, check=False).stdout
    name = f"{base.strip()}:{path.relative_to(ROOT)}"
    shown = subprocess.run(["git", "show", name], capture_output=True, text=True, check=False)
    return _without_words(path, shown.stdout) if base and shown.returncode == 0 else None


def _without_words(path: Path, text: str) -> str:
    """A file's text; of a Python file the syntax tree without docstrings."""
    if path.suffix != ".py":
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree)


def tests_of(module: str) -> list[str]:
    """The files of a module's tests, which lie in the folder of its room."""
    room = module.partition(".")[0]
    return [f"{RUNTIME}{room}/{name}" for name in TESTS[module]]


def equivalents(module: str, text: str | None = None) -> set[tuple[str, str, str, int]]:
    """The mutants of a module that ``equivalent.toml`` lists: where, what was, what it becomes, which of those alike.

    The last counts from 1, in the order of the source; 0 for all.
    """
    text = EQUIVALENT.read_text(encoding="utf-8") if text is None else text
    entries = tomllib.loads(text).get(module, [])
    return {
        (entry["where"], entry["was"], becomes, entry.get("nth", 0))
        for entry in entries
        for becomes in entry["becomes"]
    }


if __name__ == "__main__":
    sys.exit(main())
