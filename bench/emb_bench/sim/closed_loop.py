"""One sample period of the closed loop: a measurement is answered, the brake moves, the next sample is measured.

The node and every experiment of a training go through these functions. They are plain scalar
Python; compiled by :func:`emb_bench.compiled.compiled` they are what the batch runs, bit for bit.
"""

from __future__ import annotations

import math
from typing import Any

from emb_bench.brake.motion import Floats, Integers, advance
from emb_bench.config.plants import Instruments, Mechanics
from emb_bench.sim.instruments import measure
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.safety.command_limits import shielded
from emb_runtime.safety.shield import Past
from emb_runtime.safety.shield_design import ShieldLaw


def clipped(wanted: float, limit: float) -> float:
    """A current within ±limit [A]; one that is not finite counts as 0 A, as it does for the shield."""
    return min(max(wanted, -limit), limit) if math.isfinite(wanted) else 0.0


def sent_current(
    law: ShieldLaw, shield: bool, angle: float, velocity: float, wanted: float, past: Past, step: int, limit: float
) -> tuple[float, int]:
    """Current for a measurement [A], NaN for none, and the :class:`~emb_runtime.records.Reason` bits.

    As :func:`emb_runtime.safety.command_limits.decide` without a limit of the slope.

    Args:
        law: this and what follows as for :func:`emb_runtime.safety.shield.shield`.
        shield: without it a current is clipped to the law's limit, no more.
        angle: measured [rad].
        velocity: measured [rad/s].
        wanted: requested [A].
        past: the last own commands, newest first [A].
        step: of the sample.
        limit: largest current that may be sent now, at most the law's [A].
    """
    if not shield:
        return clipped(wanted, law.current), 0
    return shielded(law, angle, velocity, clipped(wanted, limit), past, step, -limit, limit)


def pass_period(
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    t_s: float,
    current: float,
    errors: tuple[float, float, float],
    x: Floats,
    chosen: Integers,
    s: Floats,
    memory: Any,
) -> tuple[float, float]:
    """Let one sample period pass, in place, and measure at its end.

    Args:
        mechanics: how the brake moves.
        instruments: what lies between it and the bus.
        p: the brake.
        t_s: the period [s].
        current: what acts [A].
        errors: of the angle [rad], of the velocity [rad/s] and of the instant of the sample [s].
        x: state, shape [4], see :mod:`emb_bench.brake.motion`.
        chosen: indices of the n unknowns, shape [n].
        s: sensitivities to them, shape [n, 4].
        memory: of the instruments, shape [MEMORY].

    Returns:
        Measured angle [rad] and velocity [rad/s].
    """
    before = float(x[1])
    advance(mechanics, p, x, current, t_s, chosen, s)
    x1, x2 = float(x[0]), float(x[1])
    return measure(instruments, memory, t_s, x1, x2, (x2 - before) / t_s, errors[2], errors[0], errors[1])
