"""Compares this version's results with those of an older version, on ten logs and ten designs made by the older one.

    python benchmarks/versions.py OLD_BIN [--keep DIR]

OLD_BIN is the ``bin`` directory of an environment that the older version is installed in. It makes the logs and the
designs; then both versions evaluate the logs (``emb-replay fim`` and ``estimate``, both with ``--json``), and this
version repeats the designs. Printed is the largest relative difference of each quantity. Exit code 0 if all agree to
within ``TOLERANCE``, otherwise 1.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

NEW_BIN = Path(sys.executable).parent
TOLERANCE = 1e-9
"""Largest relative difference that counts as rounding; of an optimum that was searched for, its square root."""
LOGS: dict[str, list[str]] = {
    "actor": ["--iface", "sim:seed=1"],
    "actor-f_v": ["--iface", "sim:f_v=4e-5,seed=2"],
    "actor-exact": ["--iface", "sim:plant=exact,seed=3"],
    "actor-stribeck": ["--iface", "sim:plant=stribeck,seed=4"],
    "actor-lag": ["--iface", "sim:plant=lag,seed=5"],
    "ramp": ["--iface", "sim:plant=exact,seed=6", "--policy", "ramp.onnx"],
    "chirp": ["--iface", "sim:plant=exact,seed=7", "--policy", "chirp.onnx"],
    "step": ["--iface", "sim:plant=exact,seed=8", "--policy", "step.onnx"],
    "structured": ["--iface", "sim:plant=exact,seed=9", "--policy", "four-d-exact-affine.onnx"],
}
"""Options of ``emb-run``; a tenth log is the first one, cut."""
EXPORTED = ("ramp", "chirp", "step", "four-d-exact-affine")
DESIGNS: tuple[list[str], ...] = tuple(
    ["--criterion", criterion, "--model", model, "--theta", theta, "--starts", "2"]
    for criterion, model, theta in (
        ("D", "exact", "f_v=2e-5"),
        ("D", "exact", "k_1=30"),
        ("D", "euler", "f_v=2e-5"),
        ("E", "exact", "f_v=2e-5"),
        ("E", "exact", "k_1=30"),
        ("E", "euler", "f_v=2e-5"),
        ("A", "exact", "f_v=2e-5"),
        ("A", "exact", "T_c=0.02"),
        ("A", "euler", "f_v=2e-5"),
        ("D", "exact", "k_m=0.02"),
    )
)


def main() -> int:
    """Compares; see the module."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("old", type=Path, metavar="OLD_BIN", help="bin directory of the older version's environment")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="directory for the files (default: a temporary one)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        worst = [*logs(options.old.absolute(), folder), *designs(options.old.absolute(), folder)]
    print(f"largest difference: {max(worst):.1e}; limit {TOLERANCE:.0e}")
    return 0 if max(worst) <= TOLERANCE else 1


def logs(old: Path, folder: Path) -> Iterator[float]:
    """Differences between both versions' evaluations of each log."""
    for name in EXPORTED:
        run(old / "emb-export", name, "--out", f"{name}.onnx", cwd=folder)
    for name, options in LOGS.items():
        run(old / "emb-run", *options, "--log", f"{name}.mcap", cwd=folder, codes=(0, 3))
    whole = (folder / "actor.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    for name in (*LOGS, "cut"):
        for command in (["fim"], ["fim", "--model", "exact"], ["estimate", "--model", "exact"]):
            words = ["emb-replay", command[0], f"{name}.mcap", *command[1:], "--json"]
            before, after = (
                run(environment / words[0], *words[1:], cwd=folder, codes=(0, 2, 6)) for environment in (old, NEW_BIN)
            )
            yield report(f"{name}: {' '.join(command)}", difference(before, after))


def designs(old: Path, folder: Path) -> Iterator[float]:
    """Differences between both versions' designs."""
    for number, options in enumerate(DESIGNS):
        found = []
        for version, environment in (("old", old), ("new", NEW_BIN)):
            out = f"design-{number}-{version}.npz"
            run(environment / "emb-design", *options, "--out", out, cwd=folder)
            with np.load(folder / out) as design:
                found.append({name: design[name].tolist() for name in design.files if name != "metadata"})
        yield report(f"design {' '.join(options)}", difference(found[0], found[1]))


def run(command: Path, *words: str, cwd: Path, codes: tuple[int, ...] = (0,)) -> Any:
    """Runs a command and returns its document, or its exit code if it printed none."""
    done = subprocess.run([str(command), *words], cwd=cwd, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    if done.returncode not in codes:
        raise SystemExit(f"{command.name} {' '.join(words)} ended with {done.returncode}: {done.stderr}")
    try:
        return json.loads(done.stdout)
    except json.JSONDecodeError:
        return {"exit code": done.returncode}


def report(what: str, found: tuple[float, str]) -> float:
    """Prints a difference and where it is, and returns it."""
    print(f"{found[0]:8.1e}  {what}{f'  ({found[1]})' if found[0] > TOLERANCE else ''}", flush=True)
    return found[0]


def difference(before: Any, after: Any, where: str = "") -> tuple[float, str]:
    """Largest relative difference between two documents, and its key; infinite where anything but a number differs."""
    if isinstance(before, dict) and isinstance(after, dict):
        missing = [key for key in before if key not in after]
        if missing:
            return math.inf, f"{where}.{missing[0]} is missing"
        return max([difference(before[k], after[k], f"{where}.{k}") for k in before], default=(0.0, ""))
    if isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            return math.inf, f"{where} has another length"
        numbers = np.asarray(before, dtype=object).ravel()
        if numbers.size and all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
            a, b = np.asarray(before, float), np.asarray(after, float)
            scale = np.abs(a).max() or 1.0
            return float(np.abs(a - b).max() / scale), where
        return max(
            [difference(a, b, f"{where}[{i}]") for i, (a, b) in enumerate(zip(before, after, strict=True))],
            default=(0.0, ""),
        )
    if isinstance(before, float | int) and isinstance(after, float | int) and not isinstance(before, bool):
        return (abs(before - after) / abs(before) if before else abs(after)), where
    # Prose may be worded better; a verdict, a name or a missing number may not change.
    worded = isinstance(before, str) and isinstance(after, str) and " " in before
    return (0.0 if before == after or worded else math.inf), f"{where}: {before!r} became {after!r}"


if __name__ == "__main__":
    sys.exit(main())
