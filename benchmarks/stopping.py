"""Reliability of ``emb-run --stop-when``: what an actor states when it stops, against the brake's truth.

`python benchmarks/stopping.py [--brakes N]` exports two structured actors, one tuned on the exact brake and one on the
forward-Euler one, and lets each drive N random brakes of ±50 % of either kind, as `emb-run --iface sim` does it, until
k_1 is known to 1 % and f_v to 5 %. For each pair it prints how often the run ended early, after how long, how far the
estimates were from the truth in the stated deviations (root mean square; the share beyond two of them, which is 4.6 %
if they are right), and the worst error of the runs that ended early.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from emb_export.export import export_structured
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench

ACTORS = ("four-d-exact-affine", "four-d-affine")
PLANTS = ("exact", "euler")
GOAL = {"k_1": 0.01, "f_v": 0.05}
SEED = 11


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=30, help="of each kind (default: %(default)s)")
    count = p.parse_args().brakes
    bench = load_bench()
    ranges = bench.range_set("pm50")
    low, high = (np.array([getattr(end, name) for name in PARAMETER_NAMES]) for end in (ranges.low, ranges.high))
    brakes = np.random.default_rng(SEED).uniform(low, high, (count, len(PARAMETER_NAMES)))
    goal = ",".join(f"{name}={share:.0%}" for name, share in GOAL.items())
    print(f"--stop-when {goal}, {count} brakes each")
    print(
        f"{'actor':22}{'brake':8}{'early':>8}{'mean s':>8}{'rms z':>8}{'beyond 2':>10}{'worst k_1, f_v if early':>26}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name in ACTORS:
            path = Path(folder) / f"{name}.onnx"
            path.write_bytes(export_structured(name, bench).data)
            for plant in PLANTS:
                early, seconds, z, worst = 0, [], [], np.zeros(len(GOAL))
                for i, brake in enumerate(brakes):
                    truth = dict(zip(PARAMETER_NAMES, brake.tolist(), strict=True))
                    listed = ",".join(f"{key}={value!r}" for key, value in truth.items())
                    arguments = ["--iface", f"sim:plant={plant},seed={i},{listed}", "--policy", str(path)]
                    said = io.StringIO()
                    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
                        code = emb_run([*arguments, "--stop-when", goal, "--log", folder, "--json"])
                    summary = json.loads(said.getvalue())
                    if code:
                        raise SystemExit(f"{name} on {plant}, brake {i}: {summary['result']}")
                    found = summary["estimate"]
                    errors = {n: found[n]["value"] - truth[n] for n in PARAMETER_NAMES}
                    z += [errors[n] / found[n]["deviation"] for n in PARAMETER_NAMES]
                    seconds.append(summary["duration_s"])
                    if summary["goal_reached"]:
                        early += 1
                        worst = np.maximum(worst, [abs(errors[n]) / truth[n] for n in GOAL])
                beyond = float((np.abs(z) > 2.0).mean())
                told = ", ".join(f"{share:.2%}" for share in worst) if early else "-"
                rms = float(np.sqrt(np.mean(np.square(z))))
                print(
                    f"{name:22}{plant:8}{f'{early}/{count}':>8}{np.mean(seconds):8.3f}{rms:8.2f}{beyond:10.1%}{told:>26}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
