"""EMPS, a real servo: parameters beside the published ones, and the prediction of windows that were held back.

The data are those of A. Janot, M. Gautier and M. Brunot, Data Set and Reference Models of EMPS, Workshop on Nonlinear
System Identification Benchmarks, 2019: position and commanded force of a ball screw in closed loop, 24.8 s at 1 kHz.
They state no licence and are not part of this project: ``python benchmarks/emps.py DATA_EMPS.mat``.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import make_problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.estimate.windows import predict_windows
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import Recording
from emb_bench.recordings.recording import open_recording
from emb_bench.report.caveats import caveats

Floats = NDArray[np.float64]

T_S = 1e-3
MAP = f"""\
schema = 1
name = "EMPS"

[timing]
column = "t"
unit = "s"
sample_time = {T_S}

[signals.angle]
column = "qm"
unit = "m"
noise = 1.44e-8     # a step of the encoder over the root of 12

[signals.command]
column = "vir"
unit = "N"
scale = 35.1506519  # N per volt of the controller's output
between = "linear"

[machine]
window = 0.08       # of 0.02, 0.04, 0.08 and 0.16 s the one with the smallest intervals
nuisances = ["current_offset"]

[machine.guess]
mass = 80.0
F_c = 15.0
F_v = 150.0
"""
ASKED = EstimationProblem(("J", "f_v", "T_c"), ("current_offset",))
DIRECTED = replace(ASKED, nuisances=(*ASKED.nuisances, "viscous_asymmetry"))
PUBLISHED = {"M": 95.1089, "F_v": 203.5034, "F_c": 20.3935, "offset": -3.1648}
PUBLISHED_BY_DIRECTION = {"M": 95.1540, "F_v+": 166.7061, "F_v-": 240.4236, "F_c+": 20.1440, "F_c-": 20.6277}


def of_machine(e: Estimate) -> dict[str, tuple[float, float]]:
    """Values and halves of the 95 % intervals in SI units of the linear machine."""
    low, high = e.intervals().T
    pairs = zip(e.values.tolist(), (0.5 * (high - low)).tolist(), strict=True)
    values = dict(zip((u.name for u in e.unknowns), pairs, strict=True))
    value, half = values["current_offset"]  # ours drives the machine, the published one opposes the command
    return {"M": values["J"], "F_v": values["f_v"], "F_c": values["T_c"], "offset": (-value, half)}


def least_squares(position: Floats, force: Floats) -> Floats:
    """M, F_v, F_c and offset by scipy alone: filtered derivatives, and linear least squares."""
    smooth = signal.filtfilt(*signal.butter(4, 0.2), position)
    velocity = np.gradient(smooth, T_S)
    columns = np.stack([np.gradient(velocity, T_S), velocity, np.sign(velocity), np.ones(len(velocity))], axis=1)
    rows = np.stack([signal.decimate(column, 25, zero_phase=True) for column in columns.T], axis=1)[5:-5]
    found: Floats = np.linalg.lstsq(rows, signal.decimate(force, 25, zero_phase=True)[5:-5])[0]
    return found


def main() -> None:
    """Prints all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path, nargs="?", help="DATA_EMPS.mat")
    parser.add_argument(
        "--other", type=Path, help="another recording of the machine, in the same form, to be predicted"
    )
    arguments = parser.parse_args()
    if arguments.recording is None:
        print("not measured: the recording is no part of the project, give its path")
        return
    with tempfile.TemporaryDirectory() as folder:
        opened = _opened(arguments.recording, Path(folder))
        others = None if arguments.other is None else _opened(arguments.other, Path(folder))
    bench = opened.bench
    plant = bench.plant("recorded")
    experiment = opened.experiment.seen_by(plant)
    other = None if others is None else others.experiment.seen_by(plant)
    begun = time.process_time()
    e = method_of("windows")(bench, plant, ASKED, starts=2).fit([experiment])
    fits = "fits" if e.validation.fits else "DOES NOT FIT"
    print(f"the model {fits}; {time.process_time() - begun:.1f} s of the processor")
    print("".join(f"  - {caveat}\n" for caveat in caveats(e)), end="")
    for name, (value, half) in of_machine(e).items():
        covers = "covers" if abs(value - PUBLISHED[name]) <= half else "does NOT cover"
        print(f"  {name:7} {value:9.3f} ± {half:6.3f}, {covers} the published {PUBLISHED[name]:.3f}")
    if other is None:
        middle = len(experiment.currents) // 2
        first, held_out = _part(experiment, 0, middle), _part(experiment, middle, len(experiment.currents))
        print("held back: the second half, predicted in windows of 0.5 s from the first")
    else:
        first, held_out = experiment, other
        print("held back: the other recording, predicted in windows of 0.5 s from the first")
    position = np.concatenate([[first.angle], first.samples[:, 0]])
    scipy = least_squares(position, np.append(first.currents, first.currents[-1]))
    plain, directed = (method_of("windows")(bench, plant, asked, starts=2).fit([first]) for asked in (ASKED, DIRECTED))
    mass, *by_direction = PUBLISHED_BY_DIRECTION.values()
    (viscous, share), (coulomb, offset) = _halves(*by_direction[:2]), _halves(*by_direction[2:])
    for name, asked, values in (
        ("ours", ASKED, plain.values),
        ("ours, by direction", DIRECTED, directed.values),
        ("scipy alone", ASKED, _ours(*scipy.tolist())),
        ("published", ASKED, _ours(*PUBLISHED.values())),
        ("published, by direction", DIRECTED, np.append(_ours(mass, viscous, coulomb, offset), share / viscous)),
    ):
        problem = make_problem(bench, plant, [held_out], replace(asked, window=0.5))
        print(f"  {name:23} root mean square {1e6 * predict_windows(problem, values)[0]:.1f} um")


def _ours(mass: float, viscous: float, coulomb: float, offset: float) -> Floats:
    """Unknowns in our order; the published offset opposes the command, ours adds to it."""
    return np.array([mass, viscous, coulomb, -offset])


def _halves(forward: float, backward: float) -> tuple[float, float]:
    """Mean of a friction by direction, and half of its difference."""
    return 0.5 * (forward + backward), 0.5 * (forward - backward)


def _opened(path: Path, folder: Path) -> Recording:
    (folder / "map.toml").write_text(MAP)
    return open_recording(path, folder / "map.toml")


def _part(record: Experiment, begin: int, end: int) -> Experiment:
    return replace(record.part(begin, end), name=f"{record.name}-{begin}")


if __name__ == "__main__":
    main()
