"""Everything that a learning shield takes for granted, as numbers; a bench that does not grant it is refused.

The set of brakes that the samples leave possible is right only as long as these hold. Which of them the bench cannot
notice is in ``docs/explanation/learning-shield.md``.

Parameters are k_m, k_1, T_c and f_v, in this order, relative to the nominal brake. All accelerations are torques over
the inertia [rad/s²].
"""

from __future__ import annotations

from typing import NamedTuple

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield_design import VELOCITY_PAD, design_inputs, make_law

Four = tuple[float, float, float, float]  # One number for each of k_m, k_1, T_c and f_v

EXACT = 0.996
"""Share of the velocity pad that viscous friction may use on the way home; the rest is for a command's rounding."""


class Assumptions(NamedTuple):
    """Prior knowledge of a learning shield; numbers only, so that what uses it compiles."""

    sample_time: float  # t_s [s]
    flow: bool  # True if the brake is solved within a period, and sticks; else it is stepped by forward Euler
    motor: float  # k_m/J of the nominal brake [rad/(s²·A)]
    spring: float  # γ k_1/J [1/s²]
    coulomb: float  # T_c/J [rad/s²]
    viscous: float  # f_v/J [1/s]
    low: Four  # Least relative parameters of the set that is known beforehand
    high: Four  # Greatest
    current: float  # No current beyond this flows, both signs [A]
    speed: float  # The limits hold, so no velocity is beyond this [rad/s]
    model_error: float  # An acceleration that the model lacks, at most [rad/s²]
    current_error: float  # The reported current lies within this of what acted, throughout the period [A]
    angle_noise: float  # A measured angle lies within this of the truth [rad]
    velocity_noise: float  # [rad/s]


def make_assumptions(bench: Bench) -> Assumptions:
    """Prior knowledge for a bench; BenchFileError names an assumption that does not hold."""
    if reason := unmet_assumption(bench):
        raise BenchFileError(f"shield.learn: {reason}")
    return assumptions_of(bench)


def assumptions_of(bench: Bench) -> Assumptions:
    """Prior knowledge for a bench, unchecked: :func:`make_assumptions` refuses those that it does not hold for."""
    brake, brakes, shield = bench.brake, bench.range_set(bench.shield.ranges), bench.shield
    low, high = (
        tuple(getattr(end, n) / getattr(brake, n) for n in PARAMETER_NAMES) for end in (brakes.low, brakes.high)
    )
    return Assumptions(
        sample_time=bench.timing.sample_time,
        flow=shield.model == "flow",
        motor=brake.k_m / brake.J,
        spring=brake.gamma * brake.k_1 / brake.J,
        coulomb=brake.T_c / brake.J,
        viscous=brake.f_v / brake.J,
        low=(low[0], low[1], low[2], low[3]),
        high=(high[0], high[1], high[2], high[3]),
        current=bench.limits.current,
        speed=bench.limits.velocity,
        model_error=shield.model_error,
        current_error=shield.current_error,
        angle_noise=shield.noise_sigmas * bench.noise.angle,
        velocity_noise=shield.noise_sigmas * bench.noise.velocity,
    )


def unmet_assumption(bench: Bench) -> str:
    """The first assumption of learning that does not hold on a bench; "" if all do."""
    shield = bench.shield
    if shield.envelope != "braking":
        return "expected shield.envelope = 'braking': the argument does not cover a drive that coasts"
    if shield.frame_age != (0, 0):
        return f"expected shield.frame_age = [0, 0], got {list(shield.frame_age)}: late frames are not covered"
    if shield.current_lag > 0.0:
        return f"expected shield.current_lag = 0, got {shield.current_lag:g} s: a current that lags is not covered"
    if shield.break_away > 1.0 or shield.f_l > 0.0:
        return (
            "expected shield.break_away = 1 and shield.f_l = 0: friction beyond Coulomb's does not survive learning; "
            "declare what it adds in shield.model_error"
        )
    law = make_law(bench)
    if law.friction_low > 0.5 * law.motor_low * law.current:
        return (
            f"the least friction of the set ({law.friction_low:.0f} rad/s²) is more than half of what the weakest "
            f"motor has ({law.motor_low * law.current:.0f} rad/s²), so that one margin does not serve every part of it"
        )
    # Of all parts of the set, the one with the strongest motor and the stiffest spring speeds up most towards home.
    change = law.motor_high * law.current + law.spring_high * bench.limits.angle[1] - law.friction_low
    flow = 0.5 * law.sample_time**2 * law.viscous_high * (change - 2.0 * design_inputs(bench).model_error)
    if flow > EXACT * VELOCITY_PAD:
        return (
            f"within a sample of {law.sample_time:g} s viscous friction of a part of the set changes by {flow:.3f} "
            f"rad/s and {EXACT * VELOCITY_PAD:.4g} are allowed for; shorten timing.sample_time or narrow the set"
        )
    return ""
