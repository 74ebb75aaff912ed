"""Limits of an estimate: sentences from its method, its experiments and its bench."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emb_bench.brake.parameters import quantity
from emb_bench.config.machine import LOADS
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import OUTLIER

ON_THE_GRID = 0.01  # Share of a period by which samples may be off the grid without a caveat


def caveats(e: Estimate) -> list[str]:
    """Limitations of an estimate's method on its experiments."""
    of_method = {"oem": _of_losses, "pem": _of_innovations, "rls": _of_least_squares, "windows": _of_windows}[e.method]
    return [*of_method(e), *_of_scale(e), *_of_ideal_sensors(e)]


def _of_losses(e: Estimate) -> Iterator[str]:
    """Outliers, and unknowns that lost reports bring."""
    if apart := sum(experiment.outliers for experiment in e.experiments):
        yield (
            f"{apart} samples lie apart from their neighbours by more than {OUTLIER:g} standard deviations: they are "
            "left out as outliers"
        )
    pulses, breaks = (sum(len(experiment.gaps[kind]) for experiment in e.experiments) for kind in (0, 1))
    if pulses:
        yield (
            f"what acted in {pulses} single periods was not reported: each of these currents is unknown, around the "
            f"command or the node's braking by ±{e.bench.limits.current:g} A (one standard deviation)"
        )
    if breaks:
        yield f"of {breaks} gaps of several periods nothing was reported: angle and velocity after them are unknown"


def _of_innovations(e: Estimate) -> Iterator[str]:
    yield from _of_losses(e)
    if e.plant.mechanics.hysteresis + e.plant.mechanics.play > 0.0 and e.process_noise + e.load_noise > 0.0:
        yield (
            "where the brake is in its hysteresis or play is taken from the model: disturbances of it are not followed "
            "there"
        )


def _of_least_squares(e: Estimate) -> Iterator[str]:
    instruments, t_s = e.plant.instruments, e.bench.timing.sample_time
    periods = sum(experiment.periods - instruments.measurement_delay - 1 for experiment in e.experiments)
    yield "the regressors are measured with noise: the values are biased, and no deviation says by how much"
    yield (
        f"{e.ends[0].evaluations} of {periods} periods count: in the others the direction of motion is not sure, or a "
        "sample was lost"
    )
    if any(r.late is not None and bool(np.any(np.abs(r.late) > ON_THE_GRID * t_s)) for r in e.experiments):
        yield "samples are taken as on the grid, and some are not by their stamps"
    if instruments.observer_bandwidth > 0.0:
        yield "the velocity is an observer's: it lags, and its errors follow from each other"


def _of_windows(e: Estimate) -> Iterator[str]:
    yield f"each of the {e.windows} windows of {e.problem.window:g} s has a start of its own"


def _of_ideal_sensors(e: Estimate) -> Iterator[str]:
    if e.ideal_sensors:
        yield (
            "the bench's systematic errors ([systematic]) are not estimated by this method, and its intervals do not "
            "allow for them; --method oem does so"
        )


def _of_scale(e: Estimate) -> Iterator[str]:
    """The scale that all parameters of a machine that is no brake share."""
    machine, names = e.bench.machine, [u.name for u in e.unknowns]
    if machine is None:
        return
    others = ", ".join(quantity(machine, name).name for name in ("J", "T_c", "f_v", "k_1") if name in names)
    commanded = quantity(machine, "current").name
    if "k_m" in names:
        held = [name for name in ("J", "T_c", "f_v", "k_1") if name not in names and getattr(e.bench.brake, name)]
        known = ", ".join(quantity(machine, name).name for name in held)
        if known:
            yield f"k_m{f', {others}' if others else ''} are as right as what was given as known: {known}"
        else:
            yield f"k_m, {others} scale together: without a known load only their ratios are in the recording"
    elif machine.command not in LOADS:
        yield f"{others}: only their ratios to k_m are in the recording, and k_m was given"
    else:
        yield f"{others} are as right as the scale of the commanded {commanded}: only ratios do without it"
