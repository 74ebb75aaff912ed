"""Experiments on any plant, N side by side: state, sensitivities, Fisher information and measurement, compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from emb_bench.information.symmetric import packed_size, unpack
from emb_runtime.errors import UsageError
from emb_train.plants.interface import Floats, Observe, Plant, Sensitivity, Step

NUDGE = 1e-6
"""Relative step of the central differences: its square is what they neglect, its inverse what they magnify rounding."""


F = TypeVar("F", bound=Callable[..., None])


def jitted(fn: F) -> F:
    """A function compiled by numba; its annotations would lose the signature."""
    compiled: F = cast(Any, numba).njit(fn)
    return compiled


@cache
def compile_plant(plant: Plant) -> Callable[..., None]:
    """Compile a plant's functions and the loop over the experiments: some seconds, once in a process.

    Returns:
        :func:`advance` of this plant: without its first four arguments.

    Raises:
        UsageError: numba does not understand one of the functions.
    """
    step, observe = jitted(plant.step), jitted(plant.observe)
    derive = differences(step) if plant.sensitivity is None else jitted(plant.sensitivity)

    @jitted
    def measured(p: Floats, x: Floats, u: float, t_s: float, out: Floats) -> None:
        observe(p, x, out)

    compiled = partial(advance, step, observe, derive, differences(measured))
    n, nothing = len(plant.unknown), np.empty((0, 0))
    index, ends, of_none = np.array(plant.unknown, np.int64), np.ones(len(plant.outputs)), np.empty(0, np.bool_)
    states = (nothing, nothing, np.empty((0, n, 0)), nothing, nothing, nothing, np.empty(0), of_none)
    try:
        compiled(index, ends, ends, ends, plant.sample_time, *states)
    except NumbaError as err:
        reason = " ".join(str(err).split())[:300]
        raise UsageError(f"{plant.name}: numba does not understand one of the plant's functions: {reason}") from err
    return compiled


def differences(step: Step) -> Sensitivity:
    """Central differences of a compiled function, along the direction in which parameter j moves everything."""

    @jitted
    def derive(p: Floats, x: Floats, u: float, t_s: float, j: int, s: Floats, out: Floats) -> None:
        behind, moved, from_here = np.empty_like(out), p.copy(), np.empty_like(x)
        moved[j] = p[j] * (1.0 + NUDGE)
        for i in range(len(x)):
            from_here[i] = x[i] + NUDGE * s[i]
        step(moved, from_here, u, t_s, out)
        moved[j] = p[j] * (1.0 - NUDGE)
        for i in range(len(x)):
            from_here[i] = x[i] - NUDGE * s[i]
        step(moved, from_here, u, t_s, behind)
        for i in range(len(out)):
            out[i] = (out[i] - behind[i]) / (2.0 * NUDGE)

    return derive


@jitted
def advance(
    step: Step,
    observe: Observe,
    derive: Sensitivity,
    slope: Sensitivity,
    unknown: NDArray[np.int64],
    weights: Floats,
    low: Floats,
    high: Floats,
    t_s: float,
    p: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
    y: Floats,
    noise: Floats,
    u: Floats,
    left: NDArray[np.bool_],
) -> None:
    """One sample period for N experiments, in place.

    Args:
        step: the plant's, compiled, as the next three.
        observe: what is measured.
        derive: how sensitivities go on.
        slope: sensitivity of what is measured after the period.
        unknown: indices of the n unknown parameters, shape [n].
        weights: 1/σ² of the outputs, shape [o].
        low: limits of the outputs, shape [o].
        high: the same.
        t_s: the period [s].
        p: parameters, shape [N, p].
        x: states, shape [N, S].
        s: sensitivities of the states to the relative unknown parameters, shape [N, n, S].
        m: packed FIM, shape [N, n (n + 1) / 2].
        y: become measurements, shape [N, o].
        noise: of these, shape [N, o].
        u: inputs, shape [N].
        left: becomes whether an output has left its limits, shape [N].
    """
    n, outputs, states = len(unknown), len(weights), x.shape[1]
    slopes, after, changed = np.empty((n, outputs)), np.empty(states), np.empty((n, states))
    for i in range(len(x)):
        for a in range(n):
            derive(p[i], x[i], u[i], t_s, unknown[a], s[i, a], changed[a])
        step(p[i], x[i], u[i], t_s, after)
        for z in range(states):
            x[i, z] = after[z]
            for a in range(n):
                s[i, a, z] = changed[a, z]
        for a in range(n):
            slope(p[i], x[i], u[i], t_s, unknown[a], s[i, a], slopes[a])
        at = 0
        for a in range(n):
            for b in range(a, n):
                for o in range(outputs):
                    m[i, at] += weights[o] * slopes[a, o] * slopes[b, o]
                at += 1
        observe(p[i], x[i], y[i])
        left[i] = False
        for o in range(outputs):
            if not low[o] <= y[i, o] <= high[o]:  # NaN has left too
                left[i] = True
            y[i, o] += noise[i, o]


class Experiments:
    """N experiments on a plant.

    Attributes:
        p: parameters, shape [N, p].
        x: states, shape [N, S].
        s: sensitivities of the states to the relative unknown parameters, shape [N, n, S].
        m: packed physical Fisher information, shape [N, n (n + 1) / 2].
        y: measured outputs, shape [N, o].
        k: steps, shape [N].
        left: whether an output has left its limits, shape [N].
    """

    def __init__(self, plant: Plant, count: int) -> None:
        """Prepare for ``count`` experiments; every row needs a :meth:`begin`."""
        n, outputs = len(plant.unknown), plant.outputs
        self.plant = plant
        self._advance = compile_plant(plant)
        self._unknown = np.array(plant.unknown, np.int64)
        self._deviations = np.array([o.deviation for o in outputs])
        self._low, self._high = np.array([o.low for o in outputs]), np.array([o.high for o in outputs])
        self._ranges = np.array([(p.low, p.high) for p in plant.parameters])
        self.p, self.x = np.zeros((count, len(plant.parameters))), np.zeros((count, len(plant.states)))
        self.s, self.m = np.zeros((count, n, len(plant.states))), np.zeros((count, packed_size(n)))
        self.y, self.k = np.zeros((count, len(outputs))), np.full(count, plant.horizon)
        self.left = np.zeros(count, np.bool_)
        self._noise = np.zeros((plant.horizon + 1, count, len(outputs)))

    def begin(self, i: int, rng: np.random.Generator, parameters: Floats | None = None) -> None:
        """Begin anew in row ``i``, at rest. ``rng`` draws parameters, also if they are given, and then the noise."""
        drawn = rng.uniform(self._ranges[:, 0], self._ranges[:, 1])
        self.p[i] = drawn if parameters is None else parameters
        self._noise[:, i] = rng.standard_normal(self._noise.shape[::2]) * self._deviations
        self.x[i], self.s[i], self.m[i], self.k[i], self.left[i] = 0.0, 0.0, 0.0, 0, False
        self.plant.observe(self.p[i], self.x[i], self.y[i])
        self.y[i] += self._noise[0, i]

    def advance(self, u: Floats) -> None:
        """One sample period with inputs, shape [N], clipped to the limit; one that is not finite counts as 0.

        Raises:
            UsageError: an experiment is over, or was not begun.
        """
        if (self.k >= self.plant.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        self.k += 1
        noise = self._noise[self.k, np.arange(len(self.k))]
        weights, limit = self._deviations**-2.0, self.plant.input_limit
        applied = np.clip(np.where(np.isfinite(u), u, 0.0), -limit, limit)
        self._advance(
            self._unknown,
            weights,
            self._low,
            self._high,
            self.plant.sample_time,
            self.p,
            self.x,
            self.s,
            self.m,
            self.y,
            noise,
            applied,
            self.left,
        )

    @property
    def information(self) -> Floats:
        """Fisher information without a prior, shape [N, n, n]."""
        return unpack(self.m, len(self._unknown))

    @property
    def growth(self) -> Floats:
        """Growth of ln det of the information with the prior, shape [N]."""
        prior = np.diag(self.plant.prior)
        grown: Floats = np.linalg.slogdet(self.information + prior)[1] - np.linalg.slogdet(prior)[1]
        return grown

    def seen(self) -> NDArray[np.float32]:
        """Observation of the actor: measured outputs and the step, raw, shape [N, o + 1]."""
        return np.column_stack((self.y, self.k)).astype(np.float32)

    def everything(self) -> NDArray[np.float32]:
        """Observation of the critic, in scales of order one: states, step, unknown parameters, FIM, sensitivities."""
        sizes = np.array(self.plant.states)
        low, high = self._ranges[self._unknown].T
        parameters = (2.0 * self.p[:, self._unknown] - low - high) / (high - low)
        fim = 0.1 * np.copysign(np.log1p(np.abs(self.m)), self.m)
        parts = (self.x / sizes, (self.k / self.plant.horizon)[:, None], parameters, fim)
        return np.column_stack((*parts, (self.s / sizes).reshape(len(self.k), -1))).astype(np.float32)
