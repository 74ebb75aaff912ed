"""The structured excitation as one torch module with its state as input and output, to be one ONNX graph.

The same as :func:`emb_train.structured.law.act`, for N experiments side by side and without a branch: what depends on
the data is chosen by ``torch.where``, so that tracing it once is enough. The state is in double precision, because the
information in it spans ten decades. So are all constants, as buffers: the ONNX exporter rounds a Python number to
single precision before it multiplies.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from emb_bench.packed import Floats, packed_index, upper
from emb_runtime.bench import PARAMETER_NAMES, Bench, Ranges
from emb_train.structured.estimator import (
    ANGLE,
    COVARIANCE,
    LEAST_VARIANCE,
    MOTION,
    PARAMETERS,
    SLOPE,
    STATE,
    STEP,
    UNKNOWNS,
    VELOCITY,
    make_model,
    start,
)
from emb_train.structured.law import Loop
from emb_train.structured.stored import Stored


class StructuredActor(nn.Module):
    """Estimator, reference and speed loop.

    Attributes:
        initial_state: before the first sample, shape [STATE], float64.
        estimates: names of what it estimates.
        observation_size: angle [rad], velocity [rad/s], step, applied current [A].
        table: of the reference, see :func:`emb_train.structured.law.reference`, shape [2 n − 1, TERMS]; a parameter.
    """

    initial_state: Tensor
    numbers: Tensor
    nominal: Tensor
    unknown: Tensor
    low: Tensor
    high: Tensor
    half_width: Tensor
    spread: Tensor
    upper_index: Tensor

    def __init__(self, bench: Bench, ranges: Ranges, plant: str, loop: Loop, table: Floats) -> None:
        """Build it.

        Args:
            bench: nominal brake, noise, timing, limits.
            ranges: where the parameters lie.
            plant: what the brake is; one of the bench's.
            loop: how the reference is followed.
            table: of the reference, shape [2 n − 1, TERMS].

        Raises:
            BenchFileError: the bench has no such plant.
            UsageError: J or γ vary in these ranges.
        """
        super().__init__()
        self.estimates = tuple(n for n in PARAMETER_NAMES if getattr(ranges.low, n) < getattr(ranges.high, n))
        self.observation_size = 4
        self.loop = loop
        model = make_model(bench, ranges, plant)
        known = {name: value for name, value in model._asdict().items() if isinstance(value, float)}
        known |= loop._asdict() | {"slope": SLOPE, "least_variance": LEAST_VARIANCE}
        self._places = {name: i for i, name in enumerate(known)}
        self.table = nn.Parameter(torch.tensor(table, dtype=torch.float64))
        low, high = (torch.tensor(end, dtype=torch.float64) for end in (model.low, model.high))
        rows, columns = upper(UNKNOWNS)
        position = [packed_index(UNKNOWNS, min(i, j), max(i, j)) for i in range(UNKNOWNS) for j in range(UNKNOWNS)]
        self.register_buffer("initial_state", torch.from_numpy(start(model)))
        self.register_buffer("numbers", torch.tensor(list(known.values()), dtype=torch.float64))
        nominal = [getattr(bench.brake, n) for n in PARAMETER_NAMES]
        self.register_buffer("nominal", torch.tensor(nominal, dtype=torch.float64))
        self.register_buffer("unknown", torch.tensor([PARAMETER_NAMES.index(n) for n in self.estimates]))
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("half_width", torch.where(high > low, 0.5 * (high - low), torch.ones_like(low)))
        self.register_buffer("spread", torch.tensor(position))
        self.register_buffer("upper_index", torch.from_numpy(rows * UNKNOWNS + columns))

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take in one sample and answer it.

        Args:
            obs: float32, shape [N, 4].
            state: float64, shape [N, STATE].

        Returns:
            Current [A], float32, shape [N, 1]; next state; the n parameters that vary and their standard deviations in
            SI units, float32, shape [N, 2 n].
        """
        angle, velocity, step, applied = obs.double().unbind(1)
        mean, covariance = self._predicted(state, step, applied)
        mean, covariance = _corrected(mean, covariance, 0, angle, self._number("angle_variance"))
        mean, covariance = _corrected(mean, covariance, 1, velocity, self._number("velocity_variance"))
        parameters = torch.minimum(torch.maximum(mean[:, MOTION:], self.low), self.high)
        level = self._reference(
            (parameters - 0.5 * (self.low + self.high)) / self.half_width, step / self._number("horizon")
        )
        current = level * self._number("scale")
        if self.loop.gain > 0.0:
            current = self._current_for(mean, covariance, parameters, current)
        packed = covariance.flatten(1)[:, self.upper_index]
        deviations = torch.sqrt(torch.clamp(torch.diagonal(covariance, dim1=1, dim2=2)[:, MOTION:], min=0.0))
        # At the edge of its range a parameter is not known better than by how far the filter would have it beyond.
        deviations = torch.maximum(deviations, torch.abs(mean[:, MOTION:] - parameters))
        estimate = torch.cat([(v * self.nominal)[:, self.unknown] for v in (parameters, deviations)], 1)
        following = torch.cat([step[:, None], mean, packed], 1)
        return current[:, None].float(), following, estimate.float()

    def _number(self, name: str) -> Tensor:
        """One of what is known beforehand, see ``Model`` and ``Loop``."""
        return self.numbers[self._places[name]]

    def _direction(self, v: Tensor, covariance: Tensor) -> Tensor:
        """See :func:`emb_train.structured.estimator.direction`."""
        variance = torch.maximum(covariance[:, 1, 1], self._number("least_variance"))
        return torch.tanh(self._number("slope") * v / torch.sqrt(variance))

    def _predicted(self, state: Tensor, step: Tensor, applied: Tensor) -> tuple[Tensor, Tensor]:
        """Mean [N, 6] and covariance [N, 6, 6] of the unknowns at this sample, before it is looked at."""
        coulomb, within = self._number("coulomb"), self._number("within")
        periods = torch.clamp(step - state[:, STEP], min=0.0)
        t = periods * self._number("sample_time")
        h = within * t * t
        x, v = state[:, ANGLE], state[:, VELOCITY]
        _, k1, tc, fv = state[:, PARAMETERS:COVARIANCE].unbind(1)
        covariance = state[:, COVARIANCE:STATE][:, self.spread].reshape(-1, UNKNOWNS, UNKNOWNS)
        s = self._direction(v, covariance)
        squeezed = torch.clamp(x, min=0.0)
        slopes = torch.stack(
            [
                torch.where(x >= 0.0, -self._number("spring") * k1, 0.0),
                -self._number("viscous") * fv,
                self._number("motor") * applied,
                -self._number("spring") * squeezed,
                -coulomb * s,
                -self._number("viscous") * v,
            ],
            1,
        )
        a = (slopes[:, MOTION:] * state[:, PARAMETERS:COVARIANCE]).sum(1)
        mean = torch.cat([(x + t * v + h * a)[:, None], (v + t * a)[:, None], state[:, PARAMETERS:COVARIANCE]], 1)
        pushed = torch.stack([h, t] + [torch.zeros_like(t)] * len(PARAMETER_NAMES), 1)[:, :, None] * slopes[:, None, :]
        shifted = torch.zeros(UNKNOWNS, UNKNOWNS, dtype=torch.float64)
        shifted[0, 1] = 1.0
        transition = torch.eye(UNKNOWNS, dtype=torch.float64) + t[:, None, None] * shifted + pushed
        covariance = transition @ covariance @ transition.transpose(1, 2)
        lost = torch.clamp(periods - 1.0, min=0.0) * self._number("lost")
        turning = (t * coulomb * tc) ** 2 * (1.0 - s * s)
        angle = (t * lost) ** 2 + (within * t) ** 2 * turning
        unsure = torch.stack([angle, turning + lost * lost] + [torch.zeros_like(t)] * len(PARAMETER_NAMES), 1)
        return mean, covariance + torch.diag_embed(unsure)

    def _reference(self, features: Tensor, time: Tensor) -> Tensor:
        """The level that holds now, shape [N]."""
        values = self.table[:, 0] + features @ self.table[:, 1:].T
        count = (self.table.shape[0] + 1) // 2
        levels = torch.clamp(values[:, :count], -1.0, 1.0)
        steps = torch.where(
            time[:, None] >= values[:, count:], levels[:, 1:] - levels[:, :-1], torch.zeros_like(time)[:, None]
        )
        return levels[:, 0] + steps.sum(1)

    def _current_for(self, mean: Tensor, covariance: Tensor, parameters: Tensor, speed: Tensor) -> Tensor:
        """See :func:`emb_train.structured.law.current_for`."""
        x, v = mean[:, 0], mean[:, 1]
        km, k1, tc, fv = parameters.unbind(1)
        drive = self._number("gain") * (speed - v) / self._number("sample_time")
        drive = drive + self._number("spring") * k1 * torch.clamp(x, min=0.0)
        drive = drive + self._number("coulomb") * tc * self._direction(v, covariance) + self._number("viscous") * fv * v
        limit = self._number("current")
        return torch.minimum(torch.maximum(drive / (self._number("motor") * km), -limit), limit)


def actor_of(kept: Stored, bench: Bench) -> StructuredActor:
    """A stored reference with its estimator and its loop, for the brakes that it was tuned on.

    Raises:
        BenchFileError: the bench lacks the set of ranges or the plant.
    """
    task = kept.asked()
    return StructuredActor(bench, bench.range_set(task.ranges), task.plant, kept.loop(bench), kept.array())


def _corrected(mean: Tensor, covariance: Tensor, i: int, value: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """See :func:`emb_train.structured.estimator.correct`."""
    row = covariance[:, i]
    gain = row / (row[:, i : i + 1] + variance)
    surprise = (value - mean[:, i])[:, None]
    return mean + gain * surprise, covariance - gain[:, :, None] * row[:, None, :]
