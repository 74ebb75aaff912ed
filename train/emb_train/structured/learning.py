"""The runtime's learning shield in whole experiments: the same functions, compiled, in either currency."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import CURRENCIES, Bench, BrakeParameters
from emb_runtime.config.plants import EULER, Plant
from emb_runtime.config.shield_config import ShieldConfig, shield_config
from emb_runtime.errors import UsageError
from emb_runtime.learning.assumptions import Assumptions, assumptions_of, make_assumptions
from emb_runtime.learning.bounded import hear as hear_bounded
from emb_runtime.learning.bounded import lose as lose_bounded
from emb_runtime.learning.bounded import start as start_bounded
from emb_runtime.learning.gaussian import hear as hear_gaussian
from emb_runtime.learning.gaussian import lose as lose_gaussian
from emb_runtime.learning.gaussian import start as start_gaussian
from emb_runtime.learning.known import Known
from emb_train.envs.conditions import Randomisation
from emb_train.structured.adaptive_shield import Shield, can_follow

OFF, BOUNDED, GAUSSIAN = range(len(CURRENCIES))  # Indices in ``CURRENCIES``


class Learning(NamedTuple):
    """Prior knowledge of a learning shield; numbers only."""

    currency: int  # Index in ``CURRENCIES``
    setting: ShieldConfig  # The bench's
    nominal: BrakeParameters  # Brake that the parameters are relative to
    assumptions: Assumptions


def make_learning(bench: Bench, nearer: Bench, shield: Shield, plant: Plant, randomised: Randomisation) -> Learning:
    """Prior knowledge of the shield, which takes the brakes for what they are: Euler's, or ones that stick.

    What is learnt may be held farther than the whole set can be: up to the bench's limit of the angle.

    Args:
        bench: with what its shield covers, see :meth:`emb_train.envs.conditions.Conditions.applied`.
        nearer: the same up to where its shield can hold the whole set, see
            :func:`emb_train.structured.adaptive_shield.narrowest`.
        shield: in which currency it learns, if at all.
        plant: what the brakes are.
        randomised: what each experiment has of its own.

    Raises:
        BenchFileError: an assumption does not hold on this bench.
        UsageError: one does not hold for the brakes.
    """
    currency = CURRENCIES.index(shield) if shield in CURRENCIES else OFF
    if currency and not can_follow(bench, plant, randomised):
        raise UsageError(
            "a shield that learns needs fresh frames, no lag, an encoder without an offset, a velocity that is "
            "measured and the braking envelope"
        )
    model = "euler" if plant.mechanics.solver == EULER else "flow"
    declared = replace(bench.shield, learn=CURRENCIES[currency], model=model)
    nearer = replace(nearer, shield=declared)
    assumptions = make_assumptions(nearer) if currency else assumptions_of(nearer)
    return Learning(currency, shield_config(replace(bench, shield=declared)), bench.brake, assumptions)


def begin(learning: Learning) -> Floats:
    """The state of the currency before the first sample."""
    begun = start_gaussian if learning.currency == GAUSSIAN else start_bounded
    return np.array(begun(learning.assumptions))


def listen(learning: Learning, state: Any, angle: float, velocity: float, applied: float) -> None:
    """Take in a sample, in place; arguments as in :mod:`emb_runtime.learning.known`."""
    if learning.currency == BOUNDED:
        hear_bounded(learning.assumptions, state, angle, velocity, applied)
    elif learning.currency == GAUSSIAN:
        hear_gaussian(learning.assumptions, state, angle, velocity, applied)


def miss(learning: Learning, state: Any) -> None:
    """Go on by a period of which nothing is known, in place."""
    if learning.currency == BOUNDED:
        lose_bounded(learning.assumptions, state)
    elif learning.currency == GAUSSIAN:
        lose_gaussian(learning.assumptions, state)


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
