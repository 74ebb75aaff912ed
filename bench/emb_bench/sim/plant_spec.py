"""Simulated brake as a command line gives it: plant, parameters and seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emb_bench.sim.simulated_brake import Noise
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.errors import UsageError

NOISES = ("angle_noise", "velocity_noise")
"""Options for sensors that are not as the bench file says: standard deviations [rad, rad/s]."""
FARTHEST = 100.0  # A brake that is farther from nominal, by this factor, is a typing error


def parse_assignments(text: str, option: str = "") -> dict[str, str]:
    """``name=value,name=value`` as a dictionary.

    Args:
        text: to be parsed.
        option: begin of a message, which names what was given.

    Raises:
        UsageError: something is not of that form, or a name comes twice.
    """
    pairs: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not name or not value:
            raise UsageError(f"{option}expected name=value,name=value, got '{item}'")
        if name in pairs:
            raise UsageError(f"{option}'{name}' is given twice")
        pairs[name] = value
    return pairs


def true_parameters(
    bench: Bench, assignments: dict[str, str], besides: Sequence[str] = (), option: str = ""
) -> BrakeParameters:
    """The bench's nominal brake with some parameters replaced.

    Args:
        bench: knows the nominal brake.
        assignments: text by parameter.
        besides: what else could have been given, for the message.
        option: begin of a message, which names what was given.

    Raises:
        UsageError: an unknown parameter, or a value that is not a positive number.
    """
    theta = bench.brake
    for name, text in assignments.items():
        if name not in PARAMETER_NAMES:
            known = ", ".join((*PARAMETER_NAMES, *besides))
            raise UsageError(f"{option}'{name}' is not a parameter; expected one of {known}")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        check_near_nominal(bench, name, value, option, got=f"'{text}'")
        theta = theta._replace(**{name: value})
    return theta


def check_near_nominal(bench: Bench, name: str, value: float, where: str = "", got: str = "") -> None:
    """Refuse a parameter that must be a typing error: a brake that fast would take for ever to simulate.

    Raises:
        UsageError: it is farther from nominal than by the factor FARTHEST, or not a number; the message begins with
            ``where`` and ends with ``got``, or with the value.
    """
    nominal = getattr(bench.brake, name)
    low, high = nominal / FARTHEST, nominal * FARTHEST
    if not low <= value <= high:  # this way round, NaN is refused
        raise UsageError(f"{where}{name}: expected a number from {low:g} to {high:g}, got {got or repr(value)}")


def with_sensors(bench: Bench, assignments: dict[str, str], option: str = "") -> Bench:
    """The bench with the noise of other sensors, where that is given.

    Args:
        bench: its own noise counts for what is not given.
        assignments: text by name, from which ``NOISES`` are taken out.
        option: begin of a message, which names what was given.

    Raises:
        UsageError: a standard deviation is no number from 0 on.
    """
    values = []
    for name, own in zip(NOISES, (bench.noise.angle, bench.noise.velocity), strict=True):
        text = assignments.pop(name, repr(own))
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0.0 <= value < math.inf:
            raise UsageError(f"{option}{name}: expected a standard deviation from 0 on, got '{text}'")
        values.append(value)
    return replace(bench, noise=replace(bench.noise, angle=values[0], velocity=values[1]))


def gaussian_noise(bench: Bench, seed: int, clock_jitter: float = 0.0) -> Noise:
    """White Gaussian errors of the bench's sensors and clock; the same seed gives the same errors.

    Args:
        bench: standard deviations of the sensors.
        seed: of the generator.
        clock_jitter: standard deviation of the instant of sampling [s].
    """
    generator = np.random.default_rng(seed)
    angle_std, velocity_std = bench.noise.angle, bench.noise.velocity

    def draw() -> tuple[float, float, float]:
        first, second = generator.standard_normal(2)
        late = generator.normal(0.0, clock_jitter) if clock_jitter > 0.0 else 0.0
        return float(first) * angle_std, float(second) * velocity_std, float(late)

    return draw
