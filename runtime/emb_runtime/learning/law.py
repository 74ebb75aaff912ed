"""The shield's law for a part of its set of brakes and for states that are known better than measured.

Any part that holds the true brake will do, in any sequence: see ``docs/explanation/learning-shield.md``.
"""

from __future__ import annotations

from emb_runtime.config.bench import BrakeParameters
from emb_runtime.learning.known import Known
from emb_runtime.safety.shield_design import VELOCITY_PAD, DesignInputs, Part, ShieldLaw, law_of, stoppable

COVERED = 0.97
"""Share of the velocity pad that viscous friction may use; the rest is for a state a little beyond its limits."""
ROOM = 1.1  # Half widths of the possible velocities that a law is made for, which is to fit for some samples
ROUNDING = 1e-6  # Relative: a box of states as wide as the measurement's noise is to fit in it in spite of rounding
HELD = 0.95
"""Share of the angle at which the weakest motor just holds the stiffest spring, up to which a shield is made."""
PLANNED = 0.8
"""Share of the speed that the weakest motor reaches against the greatest friction, for the plan of the way home."""


def law_for(inputs: DesignInputs, nominal: BrakeParameters, known: Known) -> ShieldLaw:
    """The law for what is known, to be asked with the middle of the box of states as the measurement.

    The parameters in ``known`` are relative to the ``nominal`` brake.
    """
    angle, velocity = middle(known)
    return law_between(
        inputs,
        relative_brake(nominal, known.k_m_low, known.k_1_low, known.t_c_low, known.f_v_low),
        relative_brake(nominal, known.k_m_high, known.k_1_high, known.t_c_high, known.f_v_high),
        max(known.angle_high - angle, angle - known.angle_low),
        max(known.velocity_high - velocity, velocity - known.velocity_low),
    )


def fits(law: ShieldLaw, known: Known) -> bool:
    """Returns True if a law for an earlier, wider set serves for this one: its noise holds the possible states."""
    angle, velocity = middle(known)
    return (
        max(known.angle_high - angle, angle - known.angle_low) <= law.angle_noise
        and max(known.velocity_high - velocity, velocity - known.velocity_low) <= law.velocity_noise
    )


def with_room(inputs: DesignInputs, known: Known) -> Known:
    """Known brakes with some more states around the same middle, so that a law for them fits for some samples."""
    angle, velocity = middle(known)
    angle_half = (1.0 + ROUNDING) * inputs.angle_noise
    half = min(ROOM * 0.5 * (known.velocity_high - known.velocity_low), (1.0 + ROUNDING) * inputs.velocity_noise)
    return known._replace(
        angle_low=min(known.angle_low, angle - angle_half),
        angle_high=max(known.angle_high, angle + angle_half),
        velocity_low=min(known.velocity_low, velocity - half),
        velocity_high=max(known.velocity_high, velocity + half),
    )


def middle(known: Known) -> tuple[float, float]:
    """Angle [rad] and velocity [rad/s] in the middle of the possible ones."""
    return 0.5 * (known.angle_low + known.angle_high), 0.5 * (known.velocity_low + known.velocity_high)


def relative_brake(nominal: BrakeParameters, k_m: float, k_1: float, t_c: float, f_v: float) -> BrakeParameters:
    """These shares of a nominal brake."""
    return BrakeParameters(
        J=nominal.J,
        gamma=nominal.gamma,
        k_m=k_m * nominal.k_m,
        k_1=k_1 * nominal.k_1,
        T_c=t_c * nominal.T_c,
        f_v=f_v * nominal.f_v,
    )


def covered_viscous(inputs: DesignInputs, low: BrakeParameters, high: BrakeParameters) -> float:
    """Lower bound on f_v, capped so that its change within a sample of full braking stays inside VELOCITY_PAD (L1).

    A part of the set may have a stronger motor and a stiffer spring than the set guarantees, and then brakes harder.
    """
    slowed = inputs.current * low.k_m / high.J + low.T_c / high.J + low.gamma * low.k_1 / high.J * inputs.highest_angle
    slowed += low.f_v / high.J * inputs.speed
    return min(low.f_v, COVERED * 2.0 * VELOCITY_PAD * high.J / (inputs.sample_time * inputs.sample_time * slowed))


def farthest(inputs: DesignInputs, low: BrakeParameters, high: BrakeParameters) -> float:
    """Greatest angle at which every brake between these two can be held, at most the limit [rad] (L5 d)."""
    motor, friction = inputs.current * low.k_m / high.J, low.T_c / high.J - inputs.model_error
    room = -inputs.lowest_angle - inputs.shield.angle_margin
    homeward = min(inputs.speed - VELOCITY_PAD, stoppable(room, 0.0, motor + friction, inputs.sample_time))
    braking = motor * min(1.0, homeward / inputs.damping_velocity) + friction + low.f_v / high.J * homeward
    return min(inputs.highest_angle, HELD * braking * low.J / (high.gamma * high.k_1))


def law_between(
    inputs: DesignInputs, low: BrakeParameters, high: BrakeParameters, angle_noise: float, velocity_noise: float
) -> ShieldLaw:
    """The law for every brake between these two, up to the angle at which they can all be held.

    Angle and velocity are known to within ``angle_noise`` [rad] and ``velocity_noise`` [rad/s].
    """
    driving = inputs.current * low.k_m / high.J - inputs.shield.break_away * high.T_c / low.J - inputs.model_error
    part = Part(
        highest_angle=farthest(inputs, low, high),
        planned_speed=min(inputs.speed, PLANNED * driving * low.J / high.f_v),
        angle_noise=angle_noise,
        velocity_noise=velocity_noise,
    )
    least = BrakeParameters(
        J=low.J,
        gamma=low.gamma,
        k_m=low.k_m,
        k_1=low.k_1,
        T_c=low.T_c,
        f_v=covered_viscous(inputs, low, high),
    )
    return law_of(inputs, least, high, part)
