"""The brake behind a simulated device: its true motion, what its instruments measure, and how far and fast it went."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from emb_bench.brake.motion import no_sensitivity, rest
from emb_bench.sim.closed_loop import pass_period
from emb_bench.sim.instruments import MEMORY, command, settle
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Plant

Noise = Callable[[], tuple[float, float, float]]
"""Draws one error of the angle [rad], one of the velocity [rad/s] and one of the instant of sampling [s]."""


class SimulatedBrake:
    """A brake at rest in its origin, driven with one current per sampling period.

    Args:
        theta: the brake's true parameters.
        noise: draws the sensors' errors.
        plant: how the brake moves and what lies between it and the bus.
        sample_time: [s].
    """

    def __init__(self, theta: BrakeParameters, noise: Noise, plant: Plant, sample_time: float) -> None:
        self._mechanics, self._instruments = plant.mechanics, plant.instruments
        self._x = rest()
        self._unknowns, self._sensitivity = no_sensitivity(())
        self._memory = np.zeros(MEMORY)
        settle(self._instruments, self._memory, 0.0)
        self._theta = theta
        self._noise = noise
        self._t_s: Final = sample_time
        self.periods = 0
        """Sampling periods passed, those without a sample (the device was late) included."""
        self.angle_range = (0.0, 0.0)
        """Lowest and highest true angle so far [rad]."""
        self.top_speed = 0.0
        """Highest true speed so far [rad/s]."""

    @property
    def angle(self) -> float:
        """True angle [rad]; it can be set, as by a hand that turns the brake."""
        return float(self._x[0])

    @angle.setter
    def angle(self, angle: float) -> None:
        self._x[0] = angle

    @property
    def velocity(self) -> float:
        """True velocity [rad/s]."""
        return float(self._x[1])

    def _delayed(self, asked: float) -> float:
        """Current that acts in the coming period where ``asked`` is ordered [A]; NaN stands for none, in both."""
        return command(self._instruments, self._memory, asked)

    def _advance(self, current: float) -> tuple[float, float]:
        """Let one period pass; what is measured at its end, angle [rad] and velocity [rad/s]."""
        measured = pass_period(
            self._mechanics,
            self._instruments,
            self._theta,
            self._t_s,
            current,
            self._noise(),
            self._x,
            self._unknowns,
            self._sensitivity,
            self._memory,
        )
        self.periods += 1
        self.angle_range = (min(self.angle_range[0], self.angle), max(self.angle_range[1], self.angle))
        self.top_speed = max(self.top_speed, abs(self.velocity))
        return measured
