"""Which brake is simulated: parameters and seed as a command line gives them."""

from __future__ import annotations

import math

import numpy as np

from emb_bench.node import Noise
from emb_runtime.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.errors import UsageError

DEFAULT_PLANT = "euler"
"""The thesis's own: what the shipped actor was trained on and what the shield is proved for."""

FARTHEST = 100.0
"""A brake that is farther from nominal, by this factor, is a typing error."""


def parse_assignments(text: str) -> dict[str, str]:
    """``name=value,name=value`` as a dictionary.

    Raises:
        UsageError: something is not of that form, or a name comes twice.
    """
    pairs: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not name or not value:
            raise UsageError(f"expected name=value,name=value, got '{item}'")
        if name in pairs:
            raise UsageError(f"'{name}' is given twice")
        pairs[name] = value
    return pairs


def true_parameters(bench: Bench, assignments: dict[str, str]) -> BrakeParameters:
    """The bench's nominal brake with some parameters replaced.

    Raises:
        UsageError: an unknown parameter, or a value that is not a positive number.
    """
    theta = bench.brake
    for name, text in assignments.items():
        if name not in PARAMETER_NAMES:
            raise UsageError(f"'{name}' is not a parameter; expected one of {', '.join(PARAMETER_NAMES)}")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        nominal = getattr(bench.brake, name)
        if not nominal / FARTHEST <= value <= nominal * FARTHEST:  # this way round, NaN is refused
            raise UsageError(
                f"{name}: expected a number from {nominal / FARTHEST:g} to {nominal * FARTHEST:g}, got '{text}'"
            )
        theta = theta._replace(**{name: value})
    return theta


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
