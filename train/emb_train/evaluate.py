"""What an excitation is worth on a fixed grid of brakes, beside excitations that need no learning.

All of them go through the same environment and shield, so the shield's share of the result is visible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from emb_bench.compiled import compiled
from emb_bench.plant import DEFAULT_PLANT
from emb_runtime.bench import Bench, BrakeParameters, Ranges
from emb_train.episodes import Batch
from emb_train.networks import DeployedActor

GRID = 40
"""Brakes on the grid, as in the thesis (5.2.3)."""

Excitation = Callable[[NDArray[np.float32]], NDArray[np.float64]]
"""From actor observations, shape [N, 3], to wanted currents [A], shape [N]."""


@dataclass(frozen=True)
class GridResult:
    """What an excitation reached on the grid."""

    name: str
    fim: NDArray[np.float64]
    """Weighted Fisher information at the end, normalised by the true value, shape [GRID]."""
    violations: int
    """Experiments that left the limits."""
    home: int
    """Experiments that ended at home."""

    @property
    def mean(self) -> float:
        """Mean weighted Fisher information over the grid."""
        return float(self.fim.mean())


def grid_of(ranges: Ranges, parameter: str) -> list[BrakeParameters]:
    """Brakes with ``parameter`` equally spaced over its range, both ends included; the others at mid-range."""
    values = np.linspace(getattr(ranges.low, parameter), getattr(ranges.high, parameter), GRID)
    middle = BrakeParameters(*(0.5 * (a + b) for a, b in zip(ranges.low, ranges.high, strict=True)))
    return [middle._replace(**{parameter: float(v)}) for v in values]


def run_grid(
    bench: Bench,
    ranges: Ranges,
    parameter: str,
    excitations: Sequence[Excitation],
    seed: int,
    plant: str = DEFAULT_PLANT,
) -> list[GridResult]:
    """Run excitations on the grid, all with the same noise.

    Args:
        bench: limits, noise, timing, shield.
        ranges: where the grid lies.
        parameter: the one parameter that varies and whose information counts.
        excitations: what asks for current.
        seed: of the sensor noise of the first brake; brake i has ``seed + i``, as in the vector environment.
        plant: which of the bench's plants the brakes are.

    Returns:
        One result for each excitation, without a name. An experiment that leaves the limits keeps the information that
        it had then.
    """
    brakes = grid_of(ranges, parameter)
    batch = Batch(bench, ranges, (parameter,), len(brakes) * len(excitations), compiled, plant)
    for i in range(len(batch.k)):
        batch.begin(i, np.random.default_rng(seed + i % GRID), brakes[i % GRID])
    fim, left = np.zeros(len(batch.k)), np.zeros(len(batch.k), np.bool_)
    for _ in range(bench.timing.horizon):
        seen = batch.actor_observation().reshape(len(excitations), GRID, 3)
        batch.advance(np.concatenate([e(o) for e, o in zip(excitations, seen, strict=True)]))
        left |= batch.violated
        fim = np.where(left, fim, batch.m[:, 0])
    home = batch.home & ~left
    rows = (a.reshape(len(excitations), GRID) for a in (fim, left, home))
    return [GridResult("", f, int(v.sum()), int(h.sum())) for f, v, h in zip(*rows, strict=True)]


def actor_excitation(actor: DeployedActor) -> Excitation:
    """What a trained actor asks for, without exploration."""

    def excite(seen: NDArray[np.float32]) -> NDArray[np.float64]:
        with torch.no_grad():
            current: Tensor = actor(torch.from_numpy(seen))
        return current[:, 0].numpy().astype(np.float64)

    return excite


def constant(current: float) -> Excitation:
    """The same current for ever [A]."""
    return lambda seen: np.full(len(seen), current)


def switch(current: float, step: int) -> Excitation:
    """``current`` until ``step``, then its negative [A]."""
    return lambda seen: np.where(seen[:, 2] < step, current, -current)


def reference_ladder(
    bench: Bench, ranges: Ranges, parameter: str, seed: int, plant: str = DEFAULT_PLANT
) -> list[GridResult]:
    """What needs no learning: constant current of either sign, and the best single switch found on this very grid."""
    limit, horizon = bench.limits.current, bench.timing.horizon
    times = range(max(1, horizon // 100), horizon, max(1, horizon // 100))
    ladder = [(f"constant {u:+g} A", constant(u)) for u in (limit, -limit)]
    switches = [(f"{u:+g} A, from step {t} {-u:+g} A", switch(u, t)) for u in (limit, -limit) for t in times]
    results = run_grid(bench, ranges, parameter, [e for _, e in ladder + switches], seed, plant)
    named = [GridResult(n, r.fim, r.violations, r.home) for (n, _), r in zip(ladder + switches, results, strict=True)]
    best = max(named[len(ladder) :], key=lambda r: r.mean)
    return [*named[: len(ladder)], GridResult(f"best blind switch: {best.name}", best.fim, best.violations, best.home)]
