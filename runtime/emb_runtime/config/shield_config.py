"""Inputs of the shield design beside the brakes: limits, noise and timing of a bench in plain numbers."""

from __future__ import annotations

from typing import NamedTuple

from emb_runtime.config.bench import Bench


class ShieldConfig(NamedTuple):
    """A bench without its set of brakes; floats and integers only, so that what uses it compiles."""

    sample_time: float  # [s]
    steps: int  # Commands in one experiment
    age_low: int  # Least samples between a measurement and the period in which its answer acts
    age_high: int  # Most samples of the same
    current: float  # Limit, both signs [A]
    lowest_angle: float  # Limit [rad]
    highest_angle: float  # Limit [rad]
    speed: float  # Limit, both signs [rad/s]
    planned_speed: float  # The way home is planned with at most this [rad/s]
    angle_noise: float  # An angle is known to within this [rad]
    velocity_noise: float  # A velocity is known to within this [rad/s]
    measured_noise: float
    """A measured velocity lies within this of the truth: as well it is known again at once after any motion [rad/s]."""
    angle_margin: float  # Kept from the limits [rad]
    damping_velocity: float  # Of the node's damped stop [rad/s]
    lag: float  # Largest time constant of the current loop [s]
    coasting: bool  # True if 0 A for ever must keep the limits
    break_away: float  # Static friction, at most, as a multiple of T_c
    f_l: float  # Load-dependent static friction, at most [m]
    home_angle: float  # Largest angle that counts as home [rad]
    home_velocity: float  # [rad/s]
    model_error: float = 0.0
    """An acceleration beside those of model and reported current, at most; 0 where nothing is learnt [rad/s²]."""


def shield_config(bench: Bench) -> ShieldConfig:
    """Of this bench."""
    shield, timing, limits = bench.shield, bench.timing, bench.limits
    brakes = bench.range_set(shield.ranges)
    model_error = shield.model_error + shield.current_error * brakes.high.k_m / brakes.low.J
    return ShieldConfig(
        sample_time=timing.sample_time,
        steps=timing.horizon,
        age_low=shield.frame_age[0],
        age_high=shield.frame_age[1],
        current=limits.current,
        lowest_angle=limits.angle[0],
        highest_angle=limits.angle[1],
        speed=limits.velocity,
        planned_speed=limits.velocity,
        angle_noise=shield.noise_sigmas * bench.noise.angle,
        velocity_noise=shield.noise_sigmas * bench.noise.velocity,
        measured_noise=shield.noise_sigmas * bench.noise.velocity,
        angle_margin=shield.angle_margin,
        damping_velocity=bench.node.damping_velocity,
        lag=shield.current_lag,
        coasting=shield.envelope == "coasting",
        break_away=shield.break_away,
        f_l=shield.f_l,
        home_angle=shield.home_angle,
        home_velocity=shield.home_velocity,
        model_error=model_error if shield.learn else 0.0,
    )
