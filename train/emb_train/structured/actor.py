"""The structured excitation as one torch module with its state as input and output, to be one ONNX graph.

It computes :func:`emb_train.structured.law.act` for N experiments side by side and without a branch, so that tracing
it once is enough. The transition from sample to sample is the estimator's own code on columns. The linear algebra of
the covariance is that of matrices here, for a call takes as long as the graph has nodes. The state is in double
precision, because the information in it spans ten decades. So are all constants, as buffers: the ONNX exporter rounds a
Python number to single precision before it multiplies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from emb_bench.brake.euler import sign
from emb_bench.information.symmetric import Floats, packed_index, packed_size, upper
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges
from emb_train.structured.columns import on_columns
from emb_train.structured.estimator import (
    MEMORY,
    MISFIT,
    MOTION,
    UNKNOWNS,
    Four,
    Model,
    Prediction,
    begin_slopes,
    direction,
    make_model,
    slid,
    start,
    stuck,
)
from emb_train.structured.law import PRODUCTS
from emb_train.structured.stored import Stored

JOINED = UNKNOWNS + 1  # Rows of the matrix that mean and covariance are corrected in
_CONSTANTS = {"forget": 1.0 / MEMORY, "misfit": MISFIT}


class Loop(NamedTuple):
    """Scaling of a reference, and gain of the loop that follows it; numbers only."""

    scale: float
    gain: float
    horizon: float


def current_for(
    model: Model, x: float, v: float, variance: float, parameters: Four, speed: float, gain: float
) -> float:
    """See :func:`emb_runtime.estimator.speed_loop.current_for`; without a branch."""
    km, k1, tc, fv = parameters
    change = gain * (speed - v)
    drive = change / model.sample_time + model.spring * k1 * max(x, 0.0)
    toward = sign(v + change) if model.sticks else direction(v, variance)
    drive = drive + (model.coulomb * tc * toward + model.viscous * fv * v)
    return min(max(drive / (model.motor * km), -model.current), model.current)


class StructuredActor(nn.Module):
    """Estimator, reference and speed loop.

    A sample is taken in as one symmetric matrix B of 7 × 7: the covariance, in the last column by how much the mean is
    off the measurement (0 for what is not measured), and in the corner minus the sum of the squared normalised
    innovations. To correct by the unknown i is then one step of elimination, B − b bᵀ/(B_ii + variance) with b = B e_i,
    for all three. What goes into a matrix and what comes out is placed by constant matrices of zeros and ones: a call
    takes as long as it has nodes, not as they have numbers.

    Attributes:
        initial_state: before the first sample, shape [STATE], float64.
        estimates: names of what it estimates.
        observation_size: angle [rad], velocity [rad/s], step, applied current [A].
        table: of the reference, see :func:`emb_train.structured.law.share_after`; a parameter.
    """

    initial_state: Tensor

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
        model = make_model(bench, ranges, plant)
        self._model = model
        self.table = nn.Parameter(torch.tensor(table, dtype=torch.float64))
        low, high = np.array(model.low), np.array(model.high)
        nominal = np.array([getattr(bench.brake, n) for n in PARAMETER_NAMES])
        unit = np.eye(UNKNOWNS)
        unknown = [PARAMETER_NAMES.index(n) for n in self.estimates]
        known = {name: value for name, value in model._asdict().items() if isinstance(value, float)}
        constants: dict[str, Any] = {
            **known,
            **loop._asdict(),
            **_CONSTANTS,
            **_places(),
            "initial_state": start(model),
            "low": low,
            "high": high,
            "log_middle": 0.5 * np.log(low * high),
            "log_half_width": np.where(high > low, 0.5 * np.log(high / low), 1.0),
            "first": np.eye(len(low))[:, [i for i, _ in PRODUCTS]],
            "second": np.eye(len(low))[:, [j for _, j in PRODUCTS]],
            "one": 1.0,
            "prior": (high - low) / math.sqrt(12.0),
            "velocity_row": unit[1],
            "stay": unit[:MOTION].reshape(-1),
            "friction": model.coulomb * unit[MOTION + PARAMETER_NAMES.index("T_c")],
            "reported": np.concatenate([nominal, nominal])[:, None]
            * np.eye(2 * len(nominal))[:, [*unknown, *(len(nominal) + i for i in unknown)]],
        }
        for name, value in constants.items():
            self.register_buffer(name, torch.tensor(np.array(value), dtype=torch.float64))

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take in one sample and answer it.

        Args:
            obs: float32, shape [N, 4].
            state: float64, shape [N, STATE].

        Returns:
            Current [A], float32, shape [N, 1]; next state; the n parameters that vary and their standard deviations in
            SI units, float32, shape [N, 2 n].
        """
        seen = obs.double()
        _, _, step, applied = torch.split(seen, 1, 1)
        last, unknowns, packed, innovation, worst = torch.split(state, _PARTS, 1)
        periods = torch.relu(step - last)
        lost = torch.relu(periods - 1.0) * self._known("lost")
        mean, rows, noise = self._predicted(unknowns, packed, periods, lost, applied)
        measured = seen @ self._known("measured")
        moved = _square(rows @ self._known("rows") + self._known("kept"))
        before = _square(packed @ self._known("unfolded"))
        bordered = torch.cat([noise, mean - measured], 1) @ self._known("bordered")
        joined = moved @ before @ moved.transpose(1, 2) + _square(bordered)
        joined = self._corrected(joined, 0, "angle_variance")
        joined = self._corrected(joined, 1, "velocity_variance")
        found = joined.flatten(1) @ self._known("folded")
        off, packed, squares = torch.split(found, [UNKNOWNS, packed_size(UNKNOWNS), 1], 1)
        mean = off + measured
        innovation = innovation - (innovation + 0.5 * squares) * self._known("forget")
        worst = torch.maximum(worst, innovation)
        free = mean[:, MOTION:]
        parameters = torch.minimum(torch.maximum(free, self._known("low")), self._known("high"))
        speed = self._levels(features := self._features(parameters)) * self._known("scale")
        x, v, *_ = torch.split(mean, 1, 1)
        each, gain = torch.split(parameters, 1, 1), self._known("gain")
        current = on_columns(current_for)(self._of_columns(), x, v, _variance(packed), each, speed, gain)
        current = (current * self._shares(features, step)).sum(1, keepdim=True)
        deviations = torch.sqrt(torch.relu(packed @ self._known("variances")))
        # At the edge of its range a parameter is not known better than by how far the filter would have it beyond.
        deviations = torch.maximum(deviations, torch.abs(free - parameters))
        # Of a model that does not fit nothing is known that was not known before.
        prior = torch.where(worst > self._known("misfit"), self._known("prior"), 0.0)
        estimate = torch.cat([parameters, torch.maximum(deviations, prior)], 1) @ self._known("reported")
        return current.float(), torch.cat([step, mean, packed, innovation, worst], 1), estimate.float()

    def _known(self, name: str) -> Tensor:
        """A constant: what is known beforehand, see ``Model`` and ``Loop``, or where something has its place."""
        return self.get_buffer(name)

    def _of_columns(self) -> Model:
        """The estimator's model for functions of columns."""
        constants: Any = {name: self._known(name) for name in _OF_MODEL}
        return self._model._replace(**constants)

    def _predicted(
        self, unknowns: Tensor, packed: Tensor, periods: Tensor, lost: Tensor, applied: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Prediction by the estimator's own functions.

        Returns:
            Mean of the unknowns, shape [N, 6]; derivatives of angle and velocity to what they were, one after the
            other, shape [N, 12]; what is added to the variance of the angle, its covariance with the velocity and the
            variance of that, shape [N, 3].
        """
        model = self._of_columns()
        t = periods * self._known("sample_time")
        x, v, *parameters = torch.split(unknowns, 1, 1)
        if not self._model.sticks:
            toward = on_columns(direction)(v, _variance(packed))
            return _gathered(on_columns(slid)(model, x, v, parameters, applied, toward, t, lost), unknowns)
        begun = _row(on_columns(begin_slopes)(model, x, v, parameters, applied), unknowns)
        both = torch.cat([self._known("velocity_row") + t * begun, t * self._known("friction")], 1)
        both = both.reshape(-1, 2, UNKNOWNS)
        covariance = (packed @ self._known("spread")).reshape(-1, UNKNOWNS, UNKNOWNS)
        products = (both @ covariance @ both.transpose(1, 2)).flatten(1)
        elements = torch.split(packed @ self._known("picked"), 1, 1)
        sliding = products[:, :1] + products[:, 3:]
        to = on_columns(stuck)(model, x, v, parameters, applied, t, lost, elements, sliding, products[:, 1:2])
        mean, rows, noise = _gathered(to, unknowns)
        goes_on = periods > 0.0
        return (
            torch.where(goes_on, mean, unknowns),
            torch.where(goes_on, rows, self._known("stay")),
            torch.where(goes_on, noise, 0.0),
        )

    def _corrected(self, joined: Tensor, i: int, variance: str) -> Tensor:
        """See :func:`emb_train.structured.estimator.correct`."""
        row = joined[:, i : i + 1]
        return joined - (row / (row[:, :, i : i + 1] + self._known(variance))).transpose(1, 2) @ row

    def _features(self, parameters: Tensor) -> Tensor:
        """Features that the reference depends on, shape [N, TERMS − 1]."""
        scaled = (torch.log(parameters) - self._known("log_middle")) / self._known("log_half_width")
        return torch.cat([scaled, (scaled @ self._known("first")) * (scaled @ self._known("second"))], 1)

    def _levels(self, features: Tensor) -> Tensor:
        """All levels, shape [N, n]."""
        count = (self.table.shape[0] + 1) // 2
        return torch.clamp(self.table[:count, 0] + features @ self.table[:count, 1:].T, -1.0, 1.0)

    def _shares(self, features: Tensor, step: Tensor) -> Tensor:
        """Share of the coming period in which each level holds, shape [N, n]."""
        count = (self.table.shape[0] + 1) // 2
        switches = self.table[count:, 0] + features @ self.table[count:, 1:].T
        after = torch.clamp(step + self._known("one") - self._known("horizon") * switches, 0.0, 1.0)
        from_here = [self._known("one").expand_as(step)]
        for column in torch.split(after, 1, 1):
            from_here.append(torch.minimum(from_here[-1], column))
        begun = torch.cat(from_here, 1)
        return begun - torch.cat([*from_here[1:], torch.zeros_like(step)], 1)


def _variance(packed: Tensor) -> Tensor:
    """Variance of the velocity, a column."""
    return packed[:, _VARIANCE : _VARIANCE + 1]


def _row(parts: Sequence[Tensor | float], like: Tensor) -> Tensor:
    """Columns side by side; a number is the same in each row."""
    numbers = {part: torch.full_like(like[:, :1], part) for part in parts if not isinstance(part, Tensor)}
    return torch.cat([part if isinstance(part, Tensor) else numbers[part] for part in parts], 1)


def _gathered(to: Prediction, unknowns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A prediction of columns as mean, derivatives and noise."""
    parts: Any = (
        (to.angle, to.velocity, unknowns[:, MOTION:]),
        (*to.angle_slopes, *to.velocity_slopes),
        (to.angle_noise, to.common_noise, to.velocity_noise),
    )
    mean, rows, noise = (_row(part, unknowns) for part in parts)
    return mean, rows, noise


def _square(flat: Tensor) -> Tensor:
    return flat.reshape(-1, JOINED, JOINED)


_PARTS = [1, UNKNOWNS, packed_size(UNKNOWNS), 1, 1]
"""Lengths of what a state has, in this order: step, unknowns, covariance, innovations, the worst of them."""
_VARIANCE = packed_index(UNKNOWNS, 1, 1)
_PICKED = ((0, 0), (1, 1), (0, 3), (3, 3), (1, 5), (5, 5))
"""Elements of the covariance that the prediction of a brake that sticks looks at by themselves."""


_OF_MODEL = ("sample_time", "motor", "spring", "coulomb", "viscous", "current")
"""Of the model, what the prediction and the loop look at."""


def _places() -> dict[str, Floats]:
    """Matrices of zeros and ones that put numbers into the joined matrix, and take them out."""
    rows, columns = upper(UNKNOWNS)
    size = len(rows)
    unfolded, spread = np.zeros((size, JOINED, JOINED)), np.zeros((size, UNKNOWNS, UNKNOWNS))
    for at, i, j in zip(range(size), rows, columns, strict=True):
        unfolded[at, i, j] = unfolded[at, j, i] = spread[at, i, j] = spread[at, j, i] = 1.0
    moved, kept = np.zeros((2 * UNKNOWNS, JOINED, JOINED)), np.eye(JOINED)
    kept[:MOTION] = 0.0
    for i in range(MOTION):
        for j in range(UNKNOWNS):
            moved[i * UNKNOWNS + j, i, j] = 1.0
    bordered = np.zeros((3 + UNKNOWNS, JOINED, JOINED))
    bordered[0, 0, 0] = bordered[1, 0, 1] = bordered[1, 1, 0] = bordered[2, 1, 1] = 1.0
    folded = np.zeros((JOINED, JOINED, UNKNOWNS + size + 1))
    for i in range(UNKNOWNS):
        bordered[3 + i, i, UNKNOWNS] = bordered[3 + i, UNKNOWNS, i] = folded[i, UNKNOWNS, i] = 1.0
    folded[rows, columns, UNKNOWNS + np.arange(size)] = 1.0
    folded[UNKNOWNS, UNKNOWNS, -1] = 1.0
    variances = np.zeros((size, UNKNOWNS - MOTION))
    for i in range(MOTION, UNKNOWNS):
        variances[packed_index(UNKNOWNS, i, i), i - MOTION] = 1.0
    picked = np.zeros((size, len(_PICKED)))
    for at, (i, j) in enumerate(_PICKED):
        picked[packed_index(UNKNOWNS, i, j), at] = 1.0
    return {
        "picked": picked,
        "unfolded": unfolded.reshape(size, -1),
        "spread": spread.reshape(size, -1),
        "rows": moved.reshape(2 * UNKNOWNS, -1),
        "kept": kept.reshape(-1),
        "bordered": bordered.reshape(3 + UNKNOWNS, -1),
        "folded": folded.reshape(JOINED * JOINED, -1),
        "variances": variances,
        "measured": np.eye(4, UNKNOWNS) * (np.arange(4) < MOTION)[:, None],
    }


def actor_of(kept: Stored, bench: Bench) -> StructuredActor:
    """A stored reference with its estimator and its loop, for the brakes that it was tuned on.

    Raises:
        BenchFileError: the bench lacks the set of ranges or the plant.
    """
    task = kept.asked()
    return StructuredActor(
        bench,
        bench.range_set(task.ranges),
        task.plant,
        Loop(bench.limits.velocity, kept.gain, float(bench.timing.horizon)),
        kept.array(),
    )
