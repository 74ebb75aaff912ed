"""Runs logged on the simulated bus, evaluated with each brake of the bench file side by side.

    python benchmarks/plants.py [--brakes 3]

First table: the shipped actor drives every plant through ``emb-run``, and how each run ended. Whoever sees a limit of
the bench passed ends the run, the node (NODE_STOPPED) or the loop (OUT_OF_LIMITS): to be expected only where a plant is
outside of what the shield assumes. Angles and speeds are as measured.

Then a run on the exact brake and one on a rough one (friction, stiffness, lag and a clock that are not the model's;
driven gently, for its lag takes it over the speed limit otherwise) are logged and evaluated with every model at the
true parameters: how well it fits, what it believes the run to be worth, and how far its sensitivities are from central
finite differences, of its own motion and of that of the brake that was there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the actor lives with the tests

from emb_bench.experiment.evaluation import Evaluation, Question, evaluate
from emb_bench.experiment.experiment import read_experiment
from emb_bench.experiment.theta import read_theta
from emb_bench.information.symmetric import Floats
from emb_bench.logs.log import read_log
from emb_bench.report.fim import models_text
from emb_bench.sim.open_loop import simulate
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, load_bench
from emb_runtime.config.plants import Plant
from tests.actors import constant_actor

GENTLE = 1.5  # Current of the gentle actor [A]: this, and its negative from step 100 on
STEP = 1e-5  # Relative step of the finite differences


def run(options: str, log: Path, policy: Path | None = None) -> dict[str, Any]:
    """One experiment through ``emb-run``; its summary."""
    out = io.StringIO()
    arguments = ["--iface", f"sim:{options}", "--log", str(log), "--json"]
    with contextlib.redirect_stdout(out):
        emb_run(arguments if policy is None else [*arguments, "--policy", str(policy)])
    summary: dict[str, Any] = json.loads(out.getvalue())
    return summary


def drive_all(bench: Bench, brakes: int, folder: Path) -> None:
    """The shipped actor on every plant, with a few brakes of the range that it was trained on."""
    low, high = (side.f_v for side in (bench.range_set("viscous").low, bench.range_set("viscous").high))
    print(f"{'plant':12}{'f_v':>10}  {'end':16}{'samples':>8}{'angle [rad]':>20}{'speed [rad/s]':>15}{'home':>6}")
    for plant in bench.plants:
        for n, f_v in enumerate(np.linspace(low, high, brakes)):
            s = run(f"plant={plant},f_v={f_v:.3g},seed={n}", folder / "drive.mcap")
            angles = f"{s['angle_min']:.2f} to {s['angle_max']:.2f}"
            home = "yes" if s["home"] else "no"
            print(
                f"{plant:12}{f_v:10.1e}  {s['result']:16}{s['answered']:8}{angles:>20}{s['top_speed']:15.1f}{home:>6}"
            )
            (folder / "drive.mcap").unlink()


def finite_differences(e: Evaluation, plant: Plant) -> Floats:
    """Relative sensitivities of what a plant does under the recorded currents, shape (n, 4, 2)."""
    x0 = e.experiment.x0(plant.instruments.encoder_offset)

    currents = np.concatenate([piece.currents for piece in e.experiment.pieces()])

    def states(theta: BrakeParameters) -> Floats:
        run = simulate(plant.mechanics, theta, currents, e.bench.timing.sample_time, (), x0)
        return run.states[1:]

    columns = []
    for name in PARAMETER_NAMES:
        value = getattr(e.theta, name)
        above, below = (states(e.theta._replace(**{name: value * (1.0 + h)})) for h in (STEP, -STEP))
        columns.append((above - below) / (2.0 * STEP))
    return np.stack(columns, axis=1)


def disagreement(e: Evaluation, plant: Plant) -> float:
    """Largest difference of a sensitivity from a plant's finite differences, as a part of the largest of its kind."""
    x0 = e.experiment.x0(e.plant.instruments.encoder_offset)
    currents = np.concatenate([piece.currents for piece in e.experiment.pieces()])
    t_s = e.bench.timing.sample_time
    own = simulate(e.plant.mechanics, e.theta, currents, t_s, PARAMETER_NAMES, x0).sensitivities
    expected = finite_differences(e, plant)
    return float((np.abs(own - expected).max(axis=0) / np.abs(expected).max(axis=0)).max())


def judge(bench: Bench, plant: str, folder: Path, policy: Path | None, what: str) -> None:
    """Log one run and print what every brake makes of it."""
    path = folder / f"{plant}.mcap"
    summary = run(f"plant={plant}", path, policy)
    log = read_log(path)
    experiment = read_experiment(log)
    theta_name, theta, _ = read_theta("true", log, bench)
    asked = Question(PARAMETER_NAMES)
    evaluations = [evaluate(log, experiment, bench, p, asked, theta_name, theta) for p in bench.plants.values()]
    print(f"\n{what} on the plant '{plant}': {summary['result']}, {summary['answered']} samples")
    print(models_text(evaluations))
    print(f"sensitivities beside finite differences\n{'model':12}{'of itself':>16}{f'of {plant}':>16}")
    for e in evaluations:
        own, true = (100.0 * disagreement(e, p) for p in (e.plant, bench.plant(plant)))
        print(f"{e.plant.name:12}{own:14.2g} %{true:14.2g} %")


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=3, help="values of f_v for every plant (default: 3)")
    brakes = p.parse_args().brakes
    bench = load_bench()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gentle = folder / "gentle.onnx"
        gentle.write_bytes(constant_actor(bench, GENTLE, -GENTLE))
        drive_all(bench, brakes, folder)
        judge(bench, "exact", folder, None, "the shipped actor")
        judge(bench, "rough", folder, gentle, "a gentle actor")


if __name__ == "__main__":
    main()
