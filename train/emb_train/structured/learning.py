"""The runtime's learning shield in whole experiments: the same functions, compiled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import EULER, Plant
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters, LearntModel
from emb_runtime.errors import UsageError
from emb_runtime.learning.assumptions import Assumptions, assumptions_of, make_assumptions
from emb_runtime.learning.bounded import hear, lose, start
from emb_runtime.learning.known import Known
from emb_runtime.safety.shield_design import DesignInputs, design_inputs

Shield = Literal["worst case", "bounded"]  # A law for the whole set, or for what has been learnt


class Learning(NamedTuple):
    """Prior knowledge of a learning shield; numbers only."""

    learns: bool
    inputs: DesignInputs  # Of the bench
    nominal: BrakeParameters  # Brake that the parameters are relative to
    assumptions: Assumptions


def make_learning(bench: Bench, shield: Shield, plant: Plant, delay: int) -> Learning:
    """Prior knowledge of the shield, which takes the brakes for what they are: Euler's, or ones that stick.

    Raises:
        BenchFileError: an assumption does not hold on this bench.
        UsageError: one does not hold for the brakes.
    """
    learns = shield == "bounded"
    if learns and not can_learn(bench, plant, delay):
        raise UsageError(
            "a shield that learns needs fresh frames, no lag, an encoder without an offset, a velocity that is "
            "measured and the braking envelope"
        )
    model: LearntModel = "euler" if plant.mechanics.solver == EULER else "flow"
    declared = bench.shield._replace(learn=learns, model=model)
    bench = replace(bench, shield=declared)
    assumptions = make_assumptions(bench) if learns else assumptions_of(bench)
    return Learning(learns, design_inputs(bench), bench.brake, assumptions)


def can_learn(bench: Bench, plant: Plant, delay: int) -> bool:
    """Returns True if a shield can learn: its model has no delay, lag, offset or observer, and the drive has to brake.

    It matters whether the shield covers one, the plant has it or it is drawn.
    """
    shield, between = bench.shield, plant.instruments
    late = max(shield.frame_age[1], between.command_delay, between.measurement_delay, delay) > 0
    lagging = max(shield.current_lag, plant.mechanics.current_lag) > 0.0
    off = between.encoder_offset != 0.0
    return not (late or lagging or off or between.observer_bandwidth > 0.0 or shield.envelope == "coasting")


def begin(learning: Learning) -> Floats:
    """The state before the first sample."""
    return np.array(start(learning.assumptions))


def listen(learning: Learning, state: Any, angle: float, velocity: float, applied: float) -> None:
    """Take in a sample, in place; arguments as of :func:`emb_runtime.learning.bounded.hear`."""
    hear(learning.assumptions, state, angle, velocity, applied)


def miss(learning: Learning, state: Any) -> None:
    """Go on by a period of which nothing is known, in place."""
    lose(learning.assumptions, state)


def holds(nominal: BrakeParameters, possible: Known, brake: Any, angle: float, velocity: float) -> bool:
    """Returns True if the true parameters, angle and velocity are among what is known to be possible.

    Args:
        nominal: brake that the parameters are relative to.
        possible: what is known.
        brake: true parameters, a row of :class:`emb_runtime.config.bench.BrakeParameters`, shape [6].
        angle: true [rad].
        velocity: true [rad/s].
    """
    k_m, k_1, t_c, f_v = brake[2] / nominal.k_m, brake[3] / nominal.k_1, brake[4] / nominal.T_c, brake[5] / nominal.f_v
    return bool(
        possible.k_m_low <= k_m <= possible.k_m_high
        and possible.k_1_low <= k_1 <= possible.k_1_high
        and possible.t_c_low <= t_c <= possible.t_c_high
        and possible.f_v_low <= f_v <= possible.f_v_high
        and possible.angle_low <= angle <= possible.angle_high
        and possible.velocity_low <= velocity <= possible.velocity_high
    )
