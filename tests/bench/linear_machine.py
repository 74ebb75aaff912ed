"""A linear servo in closed loop, simulated by fine steps of its own: what a recording of another machine is like."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

T_S = 1e-3
STEP = 5e-8  # Of the encoder [m]


class Machine(NamedTuple):
    """M a = F + offset − (friction against the motion), in SI units of a linear machine."""

    mass: float = 95.0
    coulomb: float = 20.0
    forward: float = 200.0  # Viscous friction in the positive direction [N·s/m]
    backward: float = 200.0
    offset: float = -3.0
    disturbance: float = 0.0  # Standard deviation of a force that no parameter stands for, correlated over 0.1 s [N]


class Recording(NamedTuple):
    """Columns of a recording."""

    time: NDArray[np.float64]
    position: NDArray[np.float64]  # [m], in steps of the encoder
    force: NDArray[np.float64]  # Commanded at each sample [N]


def record(
    machine: Machine,
    seconds: float = 8.0,
    substeps: int = 10,
    phase: float = 0.0,
    seed: int = 0,
    straight: bool = False,
) -> Recording:
    """A recording of the machine under a controller that follows a reference back and forth.

    With ``straight`` what it decides at a sample is the command at the next one, and goes there in a straight line.
    """
    count = round(seconds / T_S)
    x = v = 0.0
    position, force = np.empty(count + 1), np.zeros(count + 2)
    h = T_S / substeps
    keeps, other = math.exp(-T_S / 0.1), 0.0
    draws = np.random.default_rng(seed).normal(size=count + 1) * machine.disturbance * math.sqrt(1.0 - keeps**2)
    for k in range(count + 1):
        t = k * T_S
        wanted = 0.1 * (1.0 - math.cos(2.0 * t + phase)) + 0.02 * math.sin(9.0 * t) ** 2
        position[k] = round(x / STEP) * STEP
        decided = max(-150.0, min(150.0, 6000.0 * (wanted - position[k]) - 1200.0 * v))
        force[k + straight] = decided
        other = keeps * other + draws[k]
        for i in range(substeps):
            share = (i + 0.5) / substeps if straight else 0.0
            pull = (1.0 - share) * force[k] + share * force[k + 1] + machine.offset + other
            if v == 0.0 and abs(pull) <= machine.coulomb:
                continue
            direction = math.copysign(1.0, v if v != 0.0 else pull)
            viscous = machine.forward if direction > 0.0 else machine.backward
            a = (pull - direction * machine.coulomb - viscous * v) / machine.mass
            after = v + h * a
            if v * after < 0.0:
                after = 0.0
            x += 0.5 * h * (v + after)
            v = after
    return Recording(np.arange(count + 1, dtype=np.float64) * np.float64(T_S), position, force[:-1])


MAP = f"""\
schema = 1
name = "a linear servo"

[timing]
column = "t"
unit = "s"
sample_time = {T_S}

[signals.angle]
column = "x"
unit = "m"
noise = {STEP / math.sqrt(12.0)}

[signals.command]
column = "F"
unit = "N"

[machine]
window = 0.5
nuisances = ["current_offset"]

[machine.guess]
mass = 70.0
F_c = 14.0
F_v = 300.0
"""
