"""Limits of an estimate: sentences from its method, its experiments and its bench."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emb_bench.brake.parameters import quantity
from emb_bench.config.machine import LOADS
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import OUTLIER

ON_THE_GRID = 0.01  # Largest distance of samples from the grid without a caveat, over the period


def caveats(e: Estimate) -> list[str]:
    """Limitations of an estimate's method on its experiments."""
    of_method = {"oem": _of_losses, "pem": _of_innovations, "rls": _of_least_squares, "windows": _of_windows}[e.method]
    return [*of_method(e), *_of_scale(e), *_of_ideal_sensors(e)]


def _of_losses(e: Estimate) -> Iterator[str]:
    """Outliers, and unknowns of lost reports."""
    if apart := sum(experiment.outliers for experiment in e.experiments):
        yield (
            f"{apart} samples differ from their neighbours by more than {OUTLIER:g} standard deviations: they are "
            "removed as outliers"
        )
    pulses, breaks = (sum(len(experiment.gaps[kind]) for experiment in e.experiments) for kind in (0, 1))
    if pulses:
        yield (
            f"the current of {pulses} single periods was not reported: each is an unknown, around the command or the "
            f"node's braking with a standard deviation of {e.bench.limits.current:g} A"
        )
    if breaks:
        yield f"{breaks} gaps of several periods have no reports: angle and velocity after them are unknowns"


def _of_innovations(e: Estimate) -> Iterator[str]:
    yield from _of_losses(e)
    if e.plant.mechanics.hysteresis + e.plant.mechanics.play > 0.0 and e.process_noise + e.load_noise > 0.0:
        yield ("the filter takes the state of hysteresis or play from the model, and does not correct it by samples")


def _of_least_squares(e: Estimate) -> Iterator[str]:
    instruments, t_s = e.plant.instruments, e.bench.timing.sample_time
    periods = sum(experiment.periods - instruments.measurement_delay - 1 for experiment in e.experiments)
    yield "the regressors are measured with noise: the values are biased, and the deviations do not include the bias"
    yield (
        f"{e.ends[0].evaluations} of {periods} periods count: in the others the direction of motion is uncertain, or a "
        "sample was lost"
    )
    if any(r.late is not None and bool(np.any(np.abs(r.late) > ON_THE_GRID * t_s)) for r in e.experiments):
        yield "all samples count at the instants of the grid, but the stamps of some differ"
    if instruments.observer_bandwidth > 0.0:
        yield "the velocity is an observer's: it lags, and its errors are correlated in time"


def _of_windows(e: Estimate) -> Iterator[str]:
    yield f"each of the {e.windows} windows of {e.problem.window:g} s has its start as an unknown"


def _of_ideal_sensors(e: Estimate) -> Iterator[str]:
    if e.ideal_sensors:
        yield (
            "this method does not estimate the bench's systematic errors ([systematic]), and its intervals do not "
            "include them; --method oem does both"
        )


def _of_scale(e: Estimate) -> Iterator[str]:
    """The scale that all parameters of a machine that is no brake share."""
    machine, names = e.bench.machine, [u.name for u in e.unknowns]
    if machine is None:
        return
    others = ", ".join(quantity(machine, name).name for name in ("J", "T_c", "f_v", "k_1") if name in names)
    commanded = quantity(machine, "current").name
    if "k_m" in names:
        fixed = [name for name in ("J", "T_c", "f_v", "k_1") if name not in names and getattr(e.bench.brake, name)]
        given = ", ".join(quantity(machine, name).name for name in fixed)
        if given:
            yield f"k_m{f', {others}' if others else ''} are as exact as the given {given}"
        else:
            yield f"k_m, {others} scale together: without a given load the recording determines only their ratios"
    elif machine.command not in LOADS:
        yield f"{others}: the recording determines only their ratios to k_m, which was given"
    else:
        yield f"{others} are as exact as the scale of the commanded {commanded}, which their ratios do not need"
