"""Scenarios of :mod:`tests.scenarios.table` against emb-run and emb-node, in one boot of a kernel with buses.

Played inside the kernel by :mod:`tests.hil.stage`, judged outside by :mod:`tests.hil.judge`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from emb_runtime.config.bench import load_bench, parse_bench
from tests.actors import constant_actor
from tests.drives import EXAMPLES, late_bench
from tests.scenarios.table import Scenario

ROOT = Path(__file__).parents[2]
SLOWLY = ("--uml", "--slow", "1000", "--root")
"""Two milliseconds of such a kernel are two seconds of a computer that stands still: no load of the host is seen."""
TOLD = ("name", "node_bus", "run_bus", "drive", "policy", "before", "actions", "linger")


def plan(play: Scenario, folder: Path) -> dict[str, Any]:
    """What the stage is told; benches and actors are in the folder."""
    log = play.log or f"/dev/shm/{play.name}.mcap"
    run = ["--iface", play.run_bus, "--json", "--yes", "--log", log, *play.options]
    node = ["--iface", play.node_bus]
    gateway: list[str] = []
    if play.drive:
        kind, mapping = "polled" if play.drive == "mit" else "late", f"{EXAMPLES / play.drive}.toml"
        bench = ["--bench", str(folder / f"{kind}.toml")]
        run += ["--drive", f"{mapping}@{play.node_bus}", *bench, "--policy", str(folder / f"{kind}.onnx")]
        node += ["--drive", play.drive]
        gateway = [mapping, "--drive", play.node_bus, "--node", play.run_bus, "--serial", "simulated", *bench]
        gateway += ["--yes", "--json"]
    else:
        node.append("--json")
    if play.policy:
        run += ["--policy", str(folder / ("giant.onnx" if play.policy == "giant" else "constant.onnx"))]
    return {**{name: getattr(play, name) for name in TOLD}, "node": node, "gateway": gateway, "run": run, "log": log}


def perform(plays: Iterable[Scenario], folder: Path, kernel: Sequence[str] = SLOWLY) -> None:
    """Play them in one boot of a kernel; the reports come into ``folder``, which is made here.

    Raises:
        RuntimeError: they were not played; the message says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("late", "polled"):
        text = late_bench(polled=kind == "polled")
        (folder / f"{kind}.toml").write_text(text)
        (folder / f"{kind}.onnx").write_bytes(constant_actor(parse_bench(text, kind), 6.0))
    (folder / "constant.onnx").write_bytes(constant_actor(load_bench(), 2.0))
    (folder / "giant.onnx").write_bytes(constant_actor(load_bench(), 3.0, 1e9))
    path = folder / "plan.json"
    path.write_text(json.dumps([plan(play, folder) for play in plays]))
    hil = ["timeout", "3000", sys.executable, "-m", "emb_bench.hil.cli", *kernel, "--"]
    command = [*hil, sys.executable, "-m", "tests.hil.stage", str(path), str(folder)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(EXAMPLES), "EMB_CORE": "python"},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise RuntimeError(f"the plays were not played (exit {done.returncode}):\n{done.stdout}\n{done.stderr[-4000:]}")
