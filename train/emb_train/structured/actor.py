"""The structured excitation as one torch module with its state as input and output, to be one ONNX graph.

The same as :func:`emb_train.structured.law.act`, for N experiments side by side and without a branch: what depends on
the data is chosen by ``torch.where``, so that tracing it once is enough. The state is in double precision, because the
information in it spans ten decades. So are all constants, as buffers: the ONNX exporter rounds a Python number to
single precision before it multiplies.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from emb_bench.information.symmetric import Floats, packed_index, packed_size, upper
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges
from emb_train.structured.estimator import (
    COHERENCE,
    CONTACT_VARIANCE,
    LEAST_VARIANCE,
    MEMORY,
    MISFIT,
    MOTION,
    SLOPE,
    STOP_VARIANCE,
    UNKNOWNS,
    make_model,
    start,
)
from emb_train.structured.law import Loop
from emb_train.structured.sides import Sides
from emb_train.structured.stored import Stored

JOINED = UNKNOWNS + 1
"""Rows of the matrix that mean and covariance are corrected in."""
_CONSTANTS = {
    "slope": SLOPE,
    "least_variance": LEAST_VARIANCE,
    "coherence": COHERENCE,
    "stop_variance": STOP_VARIANCE,
    "contact_variance": CONTACT_VARIANCE,
    "forget": 1.0 / MEMORY,
    "misfit": MISFIT,
    "third": 1.0 / 3.0,
}


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
        table: of the reference, see :func:`emb_train.structured.law.reference`, shape [2 n − 1, TERMS]; a parameter.
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
        self.loop = loop
        model = make_model(bench, ranges, plant)
        self.sides = Sides() if model.sticks else None
        self.table = nn.Parameter(torch.tensor(table, dtype=torch.float64))
        low, high = np.array(model.low), np.array(model.high)
        nominal = np.array([getattr(bench.brake, n) for n in PARAMETER_NAMES])
        unit = np.eye(UNKNOWNS)
        pull = [-model.spring, -model.viscous, model.motor, -model.spring, -model.coulomb, -model.viscous]
        unknown = [PARAMETER_NAMES.index(n) for n in self.estimates]
        known = {name: value for name, value in model._asdict().items() if isinstance(value, float)}
        constants: dict[str, Any] = {
            **known,
            **loop._asdict(),
            **_CONSTANTS,
            **_places(),
            "viscous_squared": model.viscous**2,
            "initial_state": start(model),
            "low": low,
            "high": high,
            "middle": 0.5 * (low + high),
            "half_width": np.where(high > low, 0.5 * (high - low), 1.0),
            "prior": (high - low) / math.sqrt(12.0),
            "pull": pull,
            "pull_alone": np.where(np.arange(UNKNOWNS) == MOTION + PARAMETER_NAMES.index("T_c"), 0.0, pull),
            "friction": model.coulomb * unit[MOTION + PARAMETER_NAMES.index("T_c")],
            "angle_row": unit[0],
            "velocity_row": unit[1],
            "told": np.concatenate([nominal, nominal])[:, None]
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
        slid = self._slid if self.sides is None else self._stuck
        mean, rows, noise = slid(unknowns, packed, periods, lost, applied)
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
        features = (parameters - self._known("middle")) / self._known("half_width")
        current = self._reference(features, step / self._known("horizon")) * self._known("scale")
        if self.loop.gain > 0.0:
            current = self._current_for(mean, packed, parameters, current)
        deviations = torch.sqrt(torch.relu(packed @ self._known("variances")))
        # At the edge of its range a parameter is not known better than by how far the filter would have it beyond.
        deviations = torch.maximum(deviations, torch.abs(free - parameters))
        # Of a model that does not fit nothing is known that was not known before.
        prior = torch.where(worst > self._known("misfit"), self._known("prior"), 0.0)
        estimate = torch.cat([parameters, torch.maximum(deviations, prior)], 1) @ self._known("told")
        return current.float(), torch.cat([step, mean, packed, innovation, worst], 1), estimate.float()

    def _known(self, name: str) -> Tensor:
        """A constant: what is known beforehand, see ``Model`` and ``Loop``, or where something has its place."""
        return self.get_buffer(name)

    def _direction(self, v: Tensor, variance: Tensor) -> Tensor:
        """See :func:`emb_train.structured.estimator.direction`."""
        return torch.tanh(self._known("slope") * v / torch.sqrt(torch.maximum(variance, self._known("least_variance"))))

    def _slid(
        self, unknowns: Tensor, packed: Tensor, periods: Tensor, lost: Tensor, applied: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Prediction as :func:`emb_train.structured.estimator.predict` does it for the Euler brake.

        Returns:
            Mean of the unknowns, shape [N, 6]; derivatives of angle and velocity to what they were, one after the
            other, shape [N, 12]; what is added to the variance of the angle, its covariance with the velocity and the
            variance of that, shape [N, 3].
        """
        t = periods * self._known("sample_time")
        x, v, _, k1, tc, fv = torch.split(unknowns, 1, 1)
        s = self._direction(v, packed[:, _VARIANCE : _VARIANCE + 1])
        touching = torch.where(x >= 0.0, k1, 0.0)
        slopes = torch.cat([touching, fv, applied, torch.relu(x), s, v], 1) * self._known("pull")
        a = (slopes * unknowns) @ self._known("of_parameters")
        mean = unknowns + t * (torch.cat([v, a], 1) @ self._known("motion"))
        angle, velocity = self._known("angle_row"), self._known("velocity_row")
        turning = t * tc * self._known("coulomb")
        turning = turning * turning * (1.0 - s * s) + lost * lost
        missed = t * lost
        rows = torch.cat([angle + t * velocity, velocity + t * slopes], 1)
        return mean, rows, torch.cat([missed * missed, torch.zeros_like(t), turning], 1)

    def _stuck(
        self, unknowns: Tensor, packed: Tensor, periods: Tensor, lost: Tensor, applied: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same as :func:`emb_train.structured.estimator.predict_sticking` does it."""
        assert self.sides is not None
        t = periods * self._known("sample_time")
        x, v, km, k1, tc, fv = torch.split(unknowns, 1, 1)
        spring, damping = self._known("spring") * k1, self._known("viscous") * fv
        coulomb = self._known("coulomb") * tc
        squeezed, alone = torch.relu(x), self._known("pull_alone")
        pull = self._known("motor") * applied * km - spring * squeezed
        angle, velocity, friction = self._known("angle_row"), self._known("velocity_row"), self._known("friction")
        begun = torch.cat([torch.where(x >= 0.0, k1, 0.0), fv, applied, squeezed, applied, v], 1) * alone
        both = torch.cat([velocity + t * begun, t * friction], 1).reshape(-1, 2, UNKNOWNS)
        covariance = (packed @ self._known("spread")).reshape(-1, UNKNOWNS, UNKNOWNS)
        products = (both @ covariance @ both.transpose(1, 2)).flatten(1)
        sliding, common = products[:, :1] + products[:, 3:], 2.0 * products[:, 1:2]
        common = torch.where(pull >= 0.0, common, -common)
        p00, p11, p03, p33, p15, p55 = torch.split(packed @ self._known("picked"), 1, 1)
        least = self._known("least_variance")
        spreads = torch.sqrt(torch.maximum(torch.cat([p11, sliding + common, sliding - common], 1), least))
        now = (pull, coulomb, damping, spring)
        ways = self.sides(now, x, v, t, spreads[:, :1], spreads[:, 1:2], spreads[:, 2:])
        share, to_velocity, to_angle = self.sides.contact(x, ways.angle, t, v, ways.velocity)
        drifting = self._known("viscous") * p15
        stiff = self._known("spring") * share
        softening = stiff * p03
        doubtful = drifting * drifting + softening * softening
        doubtful = doubtful + self._known("viscous_squared") * p11 * p55
        doubtful = doubtful + stiff * stiff * p00 * p33
        unsure = self._known("coherence") * t * t * doubtful + ways.kinked
        crossed = torch.where((share > 0.0) & (share < 1.0), self._known("contact_variance"), 0.0)
        bias, missed, touched = drifting + softening, t * lost, share * k1
        sums = v + ways.velocity
        to_angles = torch.cat([touched, fv, applied, to_angle, applied, (v + sums) * self._known("third")], 1) * alone
        to_velocities = torch.cat([touched, fv, applied, to_velocity, applied, 0.5 * sums], 1) * alone
        slower = ways.by_velocity[1] * (1.0 - 0.5 * t * t * spring * share)
        rows = torch.cat(
            [
                angle + ways.by_velocity[0] * velocity + ways.by_pull[0] * to_angles + ways.by_friction[0] * friction,
                slower * velocity + ways.by_pull[1] * to_velocities + ways.by_friction[1] * friction,
            ],
            1,
        )
        wider = 0.5 * t * unsure
        noise = torch.cat(
            [
                0.5 * t * wider + missed * missed + ways.stopped * self._known("stop_variance"),
                wider,
                unsure + lost * lost + crossed,
            ],
            1,
        )
        there = torch.cat([ways.angle - 0.5 * t * t * bias, ways.velocity - t * bias, unknowns[:, MOTION:]], 1)
        goes_on = periods > 0.0
        return (
            torch.where(goes_on, there, unknowns),
            torch.where(goes_on, rows, torch.cat([angle, velocity])),
            torch.where(goes_on, noise, 0.0),
        )

    def _corrected(self, joined: Tensor, i: int, variance: str) -> Tensor:
        """See :func:`emb_train.structured.estimator.correct`."""
        row = joined[:, i : i + 1]
        return joined - (row / (row[:, :, i : i + 1] + self._known(variance))).transpose(1, 2) @ row

    def _reference(self, features: Tensor, time: Tensor) -> Tensor:
        """The level that holds now, shape [N, 1]."""
        values = self.table[:, 0] + features @ self.table[:, 1:].T
        count = (self.table.shape[0] + 1) // 2
        levels = torch.clamp(values[:, :count], -1.0, 1.0)
        steps = torch.where(time >= values[:, count:], levels[:, 1:] - levels[:, :-1], 0.0)
        return levels[:, :1] + steps.sum(1, keepdim=True)

    def _current_for(self, mean: Tensor, packed: Tensor, parameters: Tensor, speed: Tensor) -> Tensor:
        """See :func:`emb_train.structured.law.current_for`."""
        x, v = mean[:, :1], mean[:, 1:MOTION]
        change = self._known("gain") * (speed - v)
        sticks = self.sides is not None
        toward = torch.sign(v + change) if sticks else self._direction(v, packed[:, _VARIANCE : _VARIANCE + 1])
        against = torch.cat([torch.relu(x), toward, v], 1) * parameters[:, 1:] * self._known("pull")[3:]
        drive = change / self._known("sample_time") - against.sum(1, keepdim=True)
        limit = self._known("current")
        return torch.minimum(torch.maximum(drive / (self._known("motor") * parameters[:, :1]), -limit), limit)


def _square(flat: Tensor) -> Tensor:
    return flat.reshape(-1, JOINED, JOINED)


_PARTS = [1, UNKNOWNS, packed_size(UNKNOWNS), 1, 1]
"""Lengths of what a state has, in this order: step, unknowns, covariance, innovations, the worst of them."""
_VARIANCE = packed_index(UNKNOWNS, 1, 1)
_PICKED = ((0, 0), (1, 1), (0, 3), (3, 3), (1, 5), (5, 5))
"""Elements of the covariance that the prediction of a brake that sticks looks at by themselves."""


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
        "of_parameters": (np.arange(UNKNOWNS) >= MOTION).astype(np.float64)[:, None],
        "unfolded": unfolded.reshape(size, -1),
        "spread": spread.reshape(size, -1),
        "rows": moved.reshape(2 * UNKNOWNS, -1),
        "kept": kept.reshape(-1),
        "bordered": bordered.reshape(3 + UNKNOWNS, -1),
        "folded": folded.reshape(JOINED * JOINED, -1),
        "variances": variances,
        "measured": np.eye(4, UNKNOWNS) * (np.arange(4) < MOTION)[:, None],
        "motion": np.eye(MOTION, UNKNOWNS),
    }


def actor_of(kept: Stored, bench: Bench) -> StructuredActor:
    """A stored reference with its estimator and its loop, for the brakes that it was tuned on.

    Raises:
        BenchFileError: the bench lacks the set of ranges or the plant.
    """
    task = kept.asked()
    return StructuredActor(bench, bench.range_set(task.ranges), task.plant, kept.loop(bench), kept.array())
