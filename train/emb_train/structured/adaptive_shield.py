"""A shield whose set of brakes is tightened while the experiment runs, by the running estimate.

In simulation only, as a measure of what a shield could be worth that knew as much as the filter says: the runtime's
shield learns by bounds that hold (:mod:`emb_runtime.learning`).

**What is believed.** Each parameter lies within some standard deviations of its estimate and a relative pad, and in the
set that is known beforehand; so do angle and velocity around theirs, which the shield is given in place of the
measurement. Where an estimate has left the set altogether, it is not believed: the set holds. Where the filter's model
does not fit, nothing is believed from then on.

**Why a law may change in mid-flight.** Call a state safe for one brake if that brake, were it known exactly, could
still be held (``docs/explanation/shield.md``, L5). A law for a set that contains the brake leads into its envelope,
which is safe for each brake of the set, or brakes fully, which keeps what is safe for this one. So any sequence of sets
that contain the brake keeps the limits, whether they shrink or grow. The margin is checked for the widest, which is
known first.

**What it stands on.** That the brake lies in what is believed is no theorem but a property of the filter. It is counted
in every experiment; where it fails, the limits are not proved.

**Wide sets.** Where the weakest motor cannot hold the stiffest spring at the limit of the angle, the argument holds up
to a smaller angle, and the shield is made for that one. What counts as leaving the limits are those of the bench.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

from emb_bench.information.symmetric import packed_index
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.config.plants import Plant
from emb_runtime.config.shield_config import ShieldConfig, shield_config
from emb_runtime.errors import BenchFileError, UsageError
from emb_runtime.learning.law import farthest, law_between, relative_brake
from emb_runtime.safety.shield_design import ShieldLaw, gap, make_law
from emb_train.envs.conditions import NOTHING_RANDOM, Randomisation
from emb_train.structured.estimator import ANGLE, COVARIANCE, MOTION, PARAMETERS, UNKNOWNS, VELOCITY, Four

Shield = Literal["worst case", "belief", "bounded", "gaussian"]
SHIELDS: tuple[Shield, ...] = get_args(Shield)
"""One law for the whole set, one for what is believed now, or the runtime's for what a currency has learnt."""

PAD = 0.01  # Beyond the standard deviations, as a share of an estimated parameter
ANGLE_NOISE = 1e-3  # Beyond them, of an angle [rad]
VELOCITY_NOISE = 0.2  # Beyond them, of a velocity [rad/s]


class Belief(NamedTuple):
    """Prior knowledge of a shield; numbers only."""

    running: bool  # True if the shield follows the estimate
    setting: ShieldConfig  # The bench's
    nominal: BrakeParameters  # Brake that the estimates are relative to
    low: Four  # Least relative parameters of the set
    high: Four  # Greatest
    deviations: float  # Standard deviations within which the truth is believed to be


def can_follow(bench: Bench, plant: Plant, randomised: Randomisation) -> bool:
    """Returns True if a shield can follow the estimate: the filter models how the brakes answer, and the drive brakes.

    The filter models no delay, lag, offset or observer, whether the shield covers it, the plant has it or it is
    drawn. Narrower sets are no smaller risk for a drive that can only let go.

    Args:
        bench: with what its shield covers, see :meth:`emb_train.envs.conditions.Conditions.applied`.
        plant: what the brakes are.
        randomised: what each experiment has of its own.
    """
    setting, between = shield_config(bench), plant.instruments
    late = max(setting.age_high, between.command_delay, between.measurement_delay, randomised.delay[1]) > 0
    lagging = max(setting.lag, plant.mechanics.current_lag, randomised.current_lag[1]) > 0.0
    off = between.encoder_offset != 0.0 or randomised.encoder_offset != NOTHING_RANDOM.encoder_offset
    return not (late or lagging or off or between.observer_bandwidth > 0.0 or setting.coasting)


def make_belief(bench: Bench, shield: Shield, plant: Plant, randomised: Randomisation) -> Belief:
    """Prior knowledge of the shield; arguments as for :func:`can_follow`.

    Raises:
        UsageError: it is to follow the estimate, and cannot.
    """
    setting = shield_config(bench)
    if shield == "belief" and not can_follow(bench, plant, randomised):
        raise UsageError(
            "a shield that follows the estimate needs fresh frames, no lag, an encoder without an offset, a velocity "
            "that is measured and the braking envelope"
        )
    brakes = bench.range_set(bench.shield.ranges)
    low, high = (
        tuple(getattr(end, n) / getattr(bench.brake, n) for n in PARAMETER_NAMES) for end in (brakes.low, brakes.high)
    )
    return Belief(
        shield == "belief",
        setting,
        bench.brake,
        (low[0], low[1], low[2], low[3]),
        (high[0], high[1], high[2], high[3]),
        bench.shield.noise_sigmas,
    )


def narrowest(bench: Bench) -> tuple[Bench, ShieldLaw]:
    """The bench up to the angle at which its shield's argument holds, and the law for the whole set.

    Raises:
        BenchFileError: even there the limits cannot be guaranteed.
    """
    brakes, setting = bench.range_set(bench.shield.ranges), shield_config(bench)
    top = farthest(setting, brakes.low, brakes.high)
    if top == setting.highest_angle:
        return bench, make_law(bench)
    nearer = replace(bench, limits=replace(bench.limits, angle=(setting.lowest_angle, top)))
    law = law_between(setting, brakes.low, brakes.high, setting.angle_noise, setting.velocity_noise)
    if reason := gap(law, nearer):
        raise BenchFileError(f"the shield cannot guarantee the limits up to {top:g} rad for '{brakes.name}': {reason}")
    return nearer, law


def believed_law(belief: Belief, state: Any) -> ShieldLaw:
    """The law for what is believed now.

    Args:
        belief: prior knowledge of the shield.
        state: of the estimator, see :mod:`emb_train.structured.estimator`.
    """
    k_m, k_1 = believed_range(belief, state, 0), believed_range(belief, state, 1)
    t_c, f_v = believed_range(belief, state, 2), believed_range(belief, state, 3)
    angle_noise, velocity_noise = believed_motion(belief, state)
    return law_between(
        belief.setting,
        relative_brake(belief.nominal, k_m[0], k_1[0], t_c[0], f_v[0]),
        relative_brake(belief.nominal, k_m[1], k_1[1], t_c[1], f_v[1]),
        angle_noise,
        velocity_noise,
    )


def believed_range(belief: Belief, state: Any, i: int) -> tuple[float, float]:
    """Least and greatest relative value that parameter ``i`` is believed to have."""
    value = state[PARAMETERS + i]
    reach = belief.deviations * _deviation(state, MOTION + i) + PAD * abs(value)
    low, high = max(value - reach, belief.low[i]), min(value + reach, belief.high[i])
    if low > high:
        return belief.low[i], belief.high[i]
    return low, high


def believed_motion(belief: Belief, state: Any) -> tuple[float, float]:
    """Believed bounds on the errors of the estimated angle [rad] and velocity [rad/s]."""
    angle, velocity = belief.deviations * _deviation(state, 0), belief.deviations * _deviation(state, 1)
    return angle + ANGLE_NOISE, velocity + VELOCITY_NOISE


def contains(belief: Belief, state: Any, brake: Any, angle: float, velocity: float) -> bool:
    """Returns True if the true parameters, angle and velocity are within the believed bounds.

    Args:
        belief: prior knowledge of the shield.
        state: of the estimator.
        brake: true parameters, a row of :class:`emb_runtime.config.bench.BrakeParameters`, shape [6].
        angle: true [rad].
        velocity: true [rad/s].
    """
    nominal = belief.nominal
    true = (brake[2] / nominal.k_m, brake[3] / nominal.k_1, brake[4] / nominal.T_c, brake[5] / nominal.f_v)
    angle_noise, velocity_noise = believed_motion(belief, state)
    inside = abs(state[ANGLE] - angle) <= angle_noise and abs(state[VELOCITY] - velocity) <= velocity_noise
    for i in range(len(true)):
        low, high = believed_range(belief, state, i)
        inside = inside and low <= true[i] <= high
    return bool(inside)


def _deviation(state: Any, i: int) -> float:
    """Standard deviation of an unknown of the estimator."""
    return math.sqrt(max(state[COVARIANCE + packed_index(UNKNOWNS, i, i)], 0.0))
