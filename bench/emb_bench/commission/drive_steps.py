"""Steps of a mapped drive's signals: which current acted although it is told coarsely, and noise below a step.

A drive may tell its current in steps of 0.1 A and obey a command to 1 mA. The node tells the command where the two
agree to a step, but does not know how late commands act: then it tells another one. Integrated twice, half a step for
some milliseconds moves the brake by far more than the noise of its angle.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, stats

from emb_bench.experiment.experiment import open_experiment
from emb_bench.experiment.info import Experiment, Floats
from emb_bench.logs.log import RunLog
from emb_runtime.config.bench import Noise
from emb_runtime.drives.mapping import Commanded, Mapping, Measured
from emb_runtime.drives.mapping_file import parse_mapping

UNIFORM = math.sqrt(1.0 / 12.0)
"""Standard deviation of an error that may be anything within a step, in steps."""


def mapping_of(log: RunLog) -> Mapping | None:
    """The mapping in the log of a mapped drive; None for another log.

    Raises:
        MappingError: it is none.
    """
    return None if log.drive_files is None else parse_mapping(*log.drive_files, f"{log.path}: drive.toml")


def noise_at_rest(angle: Floats, velocity: Floats, mapping: Mapping | None) -> Noise:
    """Noise of a resting brake's samples, below the steps of a mapped drive."""
    steps = (0.0, 0.0) if mapping is None else (_step(mapping.angle), _step(mapping.velocity))
    return Noise(scatter(angle, steps[0]), scatter(velocity, steps[1]))


def noise_in_motion(at_rest: Noise, mapping: Mapping | None) -> Noise:
    """Noise of a moving brake's samples: a mapped drive's steps add to it."""
    if mapping is None:
        return at_rest
    added = UNIFORM * _step(mapping.angle), UNIFORM * _step(mapping.velocity)
    return Noise(math.hypot(at_rest.angle, added[0]), math.hypot(at_rest.velocity, added[1]))


def scatter(values: Floats, step: float) -> float:
    """Standard deviation of a normal noise before it was rounded to steps, about a constant: most likely one.

    Args:
        values: as they came.
        step: of their signal.
    """
    found = float(np.std(values, ddof=1))
    if found >= step:
        return math.sqrt(found**2 - (UNIFORM * step) ** 2)
    places, counts = np.unique(np.round((values - values[0]) / step), return_counts=True)

    def unlikelihood(at: Floats) -> float:
        below, above = (places - at[0] - 0.5) / math.exp(at[1]), (places - at[0] + 0.5) / math.exp(at[1])
        share = np.maximum(stats.norm.cdf(above) - stats.norm.cdf(below), 1e-300)
        return -float(counts @ np.log(share))

    begin = [float(np.mean(values - values[0])) / step, math.log(0.25)]
    return step * math.exp(float(optimize.minimize(unlikelihood, begin, method="Nelder-Mead").x[1]))


def acted(log: RunLog, mapping: Mapping, experiment: Experiment, late: int) -> Floats:
    """Current that acted in each period [A]: the command as the bus carried it, where what was told agrees.

    It does within two steps: what the node tells may be one from what the drive tells, and that one from what acts.

    Args:
        log: of a mapped drive.
        mapping: of it.
        experiment: in the log.
        late: samples by which commands act late.
    """
    sent = np.concatenate([samples.sent for samples in open_experiment(log).on_grid()])
    commanded = np.concatenate([np.full(late, np.nan), _carried(mapping.command, sent)])[: experiment.periods]
    step = 0.0 if mapping.current is None else _step(mapping.current)
    apart = 2.0 * step + log.layout.velocity.signal("AppliedCurrent").factor
    told = experiment.currents
    return np.where(np.abs(commanded - told) <= apart, commanded, told)


def _step(measured: Measured) -> float:
    """Step of a measured signal [SI]; next to nothing for a floating-point number."""
    return measured.field.step(0.0) * abs(measured.factor)


def _carried(command: Commanded, currents: Floats) -> Floats:
    """Currents as the drive's own message carries them [A]."""
    field, values = command.field, currents * command.factor
    if field.is_float:
        return currents
    carried: Floats = np.round((values - field.offset) / field.scale) * field.scale + field.offset
    return carried / command.factor
