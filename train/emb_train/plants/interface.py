"""The interface: the description of a plant for which an excitation is to be learned.

A step from sample to sample, what is measured, how noisy it is, what it must not leave, and what is unknown within
which range. The functions are plain Python on arrays that numba compiles. Sensitivities follow by central differences
of the step along the motion, unless the plant gives its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_runtime.errors import UsageError

Floats = NDArray[np.float64]

Step = Callable[[Floats, Floats, float, float, Floats], None]
"""(p, x, u, t_s, out): the state after one sample period into ``out``; parameters p, state x, input u held, t_s [s]."""
Observe = Callable[[Floats, Floats, Floats], None]
"""(p, x, out): the measured outputs of a state, without noise, into ``out``."""
Sensitivity = Callable[[Floats, Floats, float, float, int, Floats, Floats], None]
"""(p, x, u, t_s, j, s, out): what ``s``, the derivative of x by the relative parameter j, has become after the period
into ``out``: ∂f/∂x s + p_j ∂f/∂p_j."""


class Parameter(NamedTuple):
    """One parameter; drawn uniformly for every experiment, and unknown, if ``low`` is below ``high``."""

    name: str
    unit: str
    low: float
    high: float


class Output(NamedTuple):
    """One measured output. An experiment in which it leaves its limits, without the noise, ends there."""

    name: str
    unit: str
    deviation: float  # Of its noise, white and Gaussian
    low: float
    high: float


@dataclass(frozen=True)
class Plant:
    """A plant. It starts at rest: in the state zero."""

    name: str
    step: Step
    observe: Observe
    parameters: tuple[Parameter, ...]  # In the order of p
    outputs: tuple[Output, ...]
    states: tuple[float, ...]  # For each state how large it is, roughly: what the critic divides it by
    input: str
    input_unit: str
    input_limit: float  # Both signs
    sample_time: float  # [s]
    horizon: int  # Samples in one experiment
    sensitivity: Sensitivity | None = None  # Its own; central differences of ``step`` without

    def __post_init__(self) -> None:
        """Refuse what cannot be simulated.

        Raises:
            UsageError: a number is not positive, a range is empty, or nothing is unknown.
        """
        positive = (*self.states, *(o.deviation for o in self.outputs), self.input_limit, self.sample_time)
        if not all(0.0 < v < math.inf for v in positive) or self.horizon < 1 or not self.outputs or not self.states:
            raise UsageError(
                f"{self.name}: expected states and outputs, and positive numbers for the states' sizes, the noise, the "
                "input's limit, the sample time and the horizon"
            )
        ranges = [(p.name, p.low, p.high) for p in self.parameters] + [(o.name, o.low, o.high) for o in self.outputs]
        for name, low, high in ranges:
            if not -math.inf < low <= high < math.inf:
                raise UsageError(f"{self.name}: {name}: expected a range, got {low:g} to {high:g}")
        if not self.unknown:
            raise UsageError(f"{self.name}: expected at least one parameter that varies")

    @property
    def unknown(self) -> tuple[int, ...]:
        """Indices of the parameters that vary."""
        return tuple(j for j, p in enumerate(self.parameters) if p.low < p.high)

    @property
    def middle(self) -> Floats:
        """Parameters in the middle of their ranges, shape [p]."""
        return np.array([0.5 * (p.low + p.high) for p in self.parameters])

    @property
    def prior(self) -> Floats:
        """Information of the ranges, relative to their middle, shape [n]: 12 for ±50 %."""
        varied = [self.parameters[j] for j in self.unknown]
        return np.array([12.0 * (0.5 * (p.low + p.high) / (p.high - p.low)) ** 2 for p in varied])
