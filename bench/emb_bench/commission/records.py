"""Records of a commissioning: what the logs of its steps show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from emb_bench.brake.parameters import SI
from emb_runtime.config.bench import Noise, Sensors
from emb_runtime.numbers import in_percent, plain


@dataclass(frozen=True)
class CurrentCheck:
    """Reported against commanded current."""

    delay: int  # Samples by which commands act late, by the node's reports
    latest: int  # The same, at most: of a drive that does not report which command it obeyed, a sample more
    scale: float  # Reported current over commanded one
    moved: float  # Farthest from the angle at the start [rad]

    def __str__(self) -> str:
        return f"commands {self.delay} samples late, current times {self.scale:.4f}"


@dataclass(frozen=True)
class FirstMove:
    """Currents of the first move."""

    up: float  # Current at which the brake began to move in the positive direction [A]; NaN if it did not
    down: float  # Size of the current at which it began to move in the negative direction [A]; NaN if it did not
    scale: float  # Angle travelled over the integral of the velocity

    def __str__(self) -> str:
        return f"moves at {self.up:.3f} A and {-self.down:.3f} A, angle over velocity {self.scale:.3f}"


@dataclass(frozen=True)
class Velocity:
    """Origin of the velocity: a sensor, unless a loop that derives it from the angle has a bandwidth."""

    bandwidth: float = 0.0  # Of the loop that is nearest [rad/s]
    least: float = 0.0  # Bandwidth that the loop has at least: what is declared [rad/s]
    most: float = 0.0  # Bandwidth that it has at most [rad/s]

    @property
    def sensors(self) -> Sensors:
        """As a bench file declares it."""
        return Sensors("observer", self.least) if self.least else Sensors()

    def __str__(self) -> str:
        if not self.least:
            return "a sensor's"
        return f"an observer's, bandwidth {self.bandwidth:.0f} rad/s, at least {self.least:.0f} rad/s"


@dataclass(frozen=True)
class Identification:
    """Parameters from the experiments so far."""

    values: Mapping[str, float]  # [SI]
    intervals: Mapping[str, tuple[float, float]]
    """Total (95 %) without the errors of J and of the angle's scale, which the shield shares."""
    halves: Mapping[str, tuple[float, float]]  # Repeatability and total, as shares of the value
    model: str  # Plant of the best model, with what was added to it
    fits: bool  # The residuals do not contradict the model
    ratio: float  # Mean square of the residuals, in variances of the noise at rest
    command_delay: int  # [samples]
    measurement_delay: int  # [samples]
    current_lag: tuple[float, float]  # Interval of the current loop's time constant [s]; zeros where none is needed
    features: Mapping[str, float]  # Features beyond eq. 3.12-3.14 that the model needed, by name [SI]
    noise: Noise  # Standard deviations of the residuals of slow motion
    velocity: Velocity = Velocity()
    objections: tuple[str, ...] = ()  # Alarms of the tests on the residuals, and what would explain them

    def __str__(self) -> str:
        found = [
            f"{name} {plain(self.values[name], 5)} {SI[name]} ± {in_percent(own)} (± {in_percent(total)})"
            for name, (own, total) in self.halves.items()
        ]
        misfit = "" if self.fits else f", which does not fit yet{self.reasons()}"
        result = f"± repeatability (± total), 95 %, k=2: {', '.join(found)}; model {self.model}{misfit}"
        return f"{result}; the velocity is {self.velocity}"

    def reasons(self) -> str:
        """Objections in brackets; "" without any."""
        return f" ({'; '.join(self.objections)})" if self.objections else ""


@dataclass(frozen=True)
class Findings:
    """Findings of all steps, from which a bench file is made."""

    noise: Noise  # At rest, standard deviations
    current: CurrentCheck
    first_move: FirstMove
    identified: Identification  # From the last experiments with the data sheet's ranges
