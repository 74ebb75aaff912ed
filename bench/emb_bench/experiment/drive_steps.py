"""Steps of a mapped drive's signals: it may report its current in steps of 0.1 A, and obey a command to 1 mA.

The node reports the command where the two agree to a step, but does not know how late commands act: then it reports
another one. Half a step for some milliseconds, integrated twice, moves the brake by more than the noise of its angle.
"""

from __future__ import annotations

import numpy as np

from emb_bench.experiment.experiment import Floats
from emb_runtime.can.messages import Layout
from emb_runtime.drives.mapping import Mapping, Measured


def step_of(measured: Measured) -> float:
    """Step of a measured signal [SI]; next to nothing for a floating-point number."""
    return measured.field.step(0.0) * abs(measured.factor)


def quantised(currents: Floats, drive: Mapping | None) -> Floats:
    """Currents of commands as the drive's own message carries them; of our own node, as they are [A]."""
    if drive is None or drive.command.field.is_float:
        return currents
    field, factor = drive.command.field, drive.command.factor
    with np.errstate(over="ignore"):  # a damaged log may say anything
        steps: Floats = np.round((currents * factor - field.offset) / field.scale)
        return (steps * field.scale + field.offset) / factor


def match_tolerance(drive: Mapping | None, layout: Layout) -> float:
    """Distance from the report within which a command acted; 0 for our own node, which reports exactly [A].

    Two quantisation steps: one between node and drive, one between drive and actuator.
    """
    if drive is None:
        return 0.0
    step = 0.0 if drive.current is None else step_of(drive.current)
    return 2.0 * step + layout.velocity.signal("AppliedCurrent").factor
