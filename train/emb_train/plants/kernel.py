"""One sample period of many experiments on any plant: state, sensitivities, Fisher information, measurement."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.errors import NumbaError
from numpy.typing import NDArray

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
        :func:`advance` of this plant: without its first three arguments.

    Raises:
        UsageError: numba does not understand one of the functions.
    """
    step, observe = jitted(plant.step), jitted(plant.observe)
    derive = differences(step) if plant.sensitivity is None else jitted(plant.sensitivity)
    compiled = partial(advance, step, observe, derive)
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
    """Central differences of a compiled step, along the direction in which parameter j moves everything."""

    @jitted
    def derive(p: Floats, x: Floats, u: float, t_s: float, j: int, s: Floats, out: Floats) -> None:
        behind, moved, from_here = np.empty_like(x), p.copy(), np.empty_like(x)
        moved[j] = p[j] * (1.0 + NUDGE)
        for i in range(len(x)):
            from_here[i] = x[i] + NUDGE * s[i]
        step(moved, from_here, u, t_s, out)
        moved[j] = p[j] * (1.0 - NUDGE)
        for i in range(len(x)):
            from_here[i] = x[i] - NUDGE * s[i]
        step(moved, from_here, u, t_s, behind)
        for i in range(len(x)):
            out[i] = (out[i] - behind[i]) / (2.0 * NUDGE)

    return derive


@jitted
def measured(observe: Observe, p: Floats, x: Floats, j: int, s: Floats, out: Floats) -> None:
    """Sensitivity of the outputs to relative parameter ``j``, to ``out``, by central differences."""
    behind, moved, from_here = np.empty_like(out), p.copy(), np.empty_like(x)
    moved[j] = p[j] * (1.0 + NUDGE)
    for i in range(len(x)):
        from_here[i] = x[i] + NUDGE * s[i]
    observe(moved, from_here, out)
    moved[j] = p[j] * (1.0 - NUDGE)
    for i in range(len(x)):
        from_here[i] = x[i] - NUDGE * s[i]
    observe(moved, from_here, behind)
    for o in range(len(out)):
        out[o] = (out[o] - behind[o]) / (2.0 * NUDGE)


@jitted
def advance(
    step: Step,
    observe: Observe,
    derive: Sensitivity,
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
        step: the plant's, compiled, as the next two.
        observe: what is measured.
        derive: how sensitivities go on.
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
            measured(observe, p[i], x[i], unknown[a], s[i, a], slopes[a])
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
