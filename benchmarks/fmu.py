"""The exported brake against ``simulate``: largest difference over random currents with sticking, and time of a step.

    python benchmarks/fmu.py [--profiles 1000]

Each plant is exported as an FMU and loaded by FMPy. A loop in C calls its functions as an importer does: it sets the
current, does a step of a sample time, and gets angle and velocity. Beside its time is that of the same motion by the
compiled loop of ``simulate`` in the same run. Absolute times belong to the machine and its load.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import fmpy
import numpy as np
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from emb_bench.brake.motion import Floats
from emb_bench.compiled import compiled
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import EULER, Mechanics
from emb_bench.experiment.simulate import Theta
from emb_bench.export.export import write_model
from emb_bench.export.identified import Identified
from emb_bench.sim.open_loop import march, trajectory, zero_order_hold

PERIODS = 500
IMPORTER = """
#include <stddef.h>
typedef int set(void *, const unsigned *, size_t, const double *, size_t);
typedef int get(void *, const unsigned *, size_t, double *, size_t);
typedef int step(void *, double, double, _Bool, _Bool *, _Bool *, _Bool *, double *);
int drive(void *c, set *put, step *go, get *take, const unsigned v[3], const double u[], size_t n, double dt,
          double x[]) {
  int found = 0;
  _Bool a, b, d;
  double t;
  for (size_t k = 0; k < n; k++)
    found |= put(c, v, 1, u + k, 1) | go(c, k * dt, dt, 0, &a, &b, &d, &t) | take(c, v + 1, 2, x + 2 * k, 2);
  return found;
}
"""


def profile(rng: np.random.Generator) -> Floats:
    """Currents [A] that are held for 1 to 60 periods; half of them are too small to move a brake at rest."""
    levels = rng.uniform(-4.0, 4.0, PERIODS) * rng.choice([0.1, 1.0], PERIODS)
    return np.repeat(levels, rng.integers(1, 60, PERIODS))[:PERIODS]


def main() -> None:
    """Print a row for each plant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profiles", type=int, default=1000, help="random currents of half a second (default: 1000)")
    count = parser.parse_args().profiles
    bench = load_bench()
    plants: dict[Mechanics, str] = {}
    for name, plant in bench.plants.items():
        if plant.mechanics.solver != EULER:
            plants.setdefault(plant.mechanics, name)
    plants[Mechanics(viscous_asymmetry=0.2)] = "viscous_asymmetry"
    rows: list[tuple[str, int, float, float, float]] = []
    t_s, loop, origin = bench.timing.sample_time, compiled(march), Theta(bench.brake).begin(0.0, ())
    print(
        f"{count} profiles of {PERIODS} steps | problems | largest difference / range | at rest | FMU [us/step] | "
        "simulate [us/step]"
    )
    with TemporaryDirectory() as folder:
        source, library, path = (Path(folder, name) for name in ("importer.c", "importer.so", "brake.fmu"))
        source.write_text(IMPORTER)
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, source], check=True)
        drive = ctypes.CDLL(str(library)).drive
        for mechanics, name in plants.items():
            write_model(Identified(name, bench, bench.brake, mechanics), path)
            model = fmpy.read_model_description(path)
            keys = {variable.name: variable.valueReference for variable in model.modelVariables}
            unpacked = fmpy.extract(path, str(Path(folder, name)))
            fmu = FMU3Slave(guid=model.guid, unzipDirectory=unpacked, modelIdentifier="brake", instanceName=name)
            fmu.instantiate()
            calls = [
                ctypes.cast(getattr(fmu.dll, f"fmi3{one}"), ctypes.c_void_p)
                for one in ("SetFloat64", "DoStep", "GetFloat64")
            ]
            references = (ctypes.c_uint * 3)(*(keys[one] for one in ("current", "angle", "velocity")))
            simulated = partial(trajectory, loop, mechanics, bench.brake)
            simulated(zero_order_hold(np.zeros(2), t_s), origin[1], origin[0], origin[2])  # compiles
            rng, worst, rest, ours, peer = np.random.default_rng(1), 0.0, 0, 0.0, 0.0
            for _ in range(count):
                u, x = profile(rng), np.zeros((PERIODS, 2))
                fmu.reset()
                fmu.enterInitializationMode()
                fmu.exitInitializationMode()
                pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (u, x)]
                begin = time.perf_counter()
                failed = drive(
                    ctypes.c_void_p(fmu.component), *calls, references, pointers[0], ctypes.c_size_t(PERIODS),
                    ctypes.c_double(t_s), pointers[1],
                )  # fmt: skip
                ours += time.perf_counter() - begin
                begin = time.perf_counter()
                states, _ = simulated(zero_order_hold(u, t_s), origin[1], origin[0], origin[2])
                peer += time.perf_counter() - begin
                assert not failed
                worst = max(worst, float((np.abs(x - states[1:, :2]) / np.ptp(states[:, :2], axis=0)).max()))
                rest += int((x[:, 1] == 0.0).sum())
            steps, problems = count * PERIODS, len(validate_fmu(str(path)))
            share = f"{100 * rest / steps:.0f} %"
            rows.append((name, problems, worst, 1e6 * ours / steps, 1e6 * peer / steps))
            print("{} | {} | {:.1e} | {share} | {:.2f} | {:.2f}".format(*rows[-1], share=share))
            fmu.terminate()
            fmu.freeInstance()
    problems, worst = sum(row[1] for row in rows), max(row[2] for row in rows)
    slowest = max(rows, key=lambda row: row[3])
    about = f"exported FMU, {len(rows)} plants, {count:,} profiles each with sticking"
    limit, value = "0; 1e-6 of the range", f"{problems}; {worst:.1e}"
    print(f"| {about}: problems by FMPy; largest difference from `simulate` | {limit} | {value} |")
    limit, value = "5 µs; –", f"{slowest[3]:.2f}; {slowest[4]:.2f} µs"
    print(f"| the same: a step of the slowest plant, {slowest[0]}; compiled `simulate` | {limit} | {value} |")


if __name__ == "__main__":
    main()
