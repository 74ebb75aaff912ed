"""Evaluation of excitations on a fixed grid of brakes, as in the thesis, beside baselines without learning.

All of them go through the same environment and shield, so the shield's share of the result is visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.sim.plant_spec import DEFAULT_PLANT
from emb_runtime.config.bench import Bench, BrakeParameters, Ranges
from emb_train.envs.excitations import Constant, Excitation, switch
from emb_train.envs.play import SIDE_BY_SIDE, Draw, Together, play

GRID = 40
"""Brakes on the grid, as in the thesis (5.2.3)."""
TOGETHER = SIDE_BY_SIDE // GRID
"""Excitations that are played at a time."""


@dataclass(frozen=True)
class GridResult:
    """Result of an excitation on the grid."""

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
    return [middle_of(ranges)._replace(**{parameter: float(v)}) for v in values]


def middle_of(ranges: Ranges) -> BrakeParameters:
    """The brake in the middle of the ranges."""
    return BrakeParameters(*(0.5 * (a + b) for a, b in zip(ranges.low, ranges.high, strict=True)))


def grid_draws(ranges: Ranges, parameter: str, seed: int) -> list[Draw]:
    """The grid with noise: brake i has ``seed + i``, as in the vector environment."""
    return [Draw(seed + i, brake) for i, brake in enumerate(grid_of(ranges, parameter))]


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
        excitations: the sources of current requests.
        seed: of the sensor noise, see :func:`grid_draws`.
        plant: which of the bench's plants the brakes are.

    Returns:
        One result for each excitation, without a name. An experiment that leaves the limits keeps the information that
        it had then.
    """
    draws, results = grid_draws(ranges, parameter, seed), []
    for i in range(0, len(excitations), TOGETHER):
        some = excitations[i : i + TOGETHER]
        played = play(bench, ranges, (parameter,), Together(some), draws * len(some), plant)
        rows = (a.reshape(len(some), GRID) for a in (played.matrices, played.left, played.home))
        results += [GridResult("", m, int(left.sum()), int(home.sum())) for m, left, home in zip(*rows, strict=True)]
    return results


def reference_ladder(
    bench: Bench, ranges: Ranges, parameter: str, seed: int, plant: str = DEFAULT_PLANT
) -> list[GridResult]:
    """Baselines without learning: constant current of either sign, and the best single switch found on this grid."""
    limit, horizon = bench.limits.current, bench.timing.horizon
    times = range(max(1, horizon // 100), horizon, max(1, horizon // 100))
    ladder: list[tuple[str, Excitation]] = [(f"constant {u:+g} A", Constant(u)) for u in (limit, -limit)]
    ladder += [(f"{u:+g} A, from step {t} {-u:+g} A", switch(u, t, horizon)) for u in (limit, -limit) for t in times]
    results = run_grid(bench, ranges, parameter, [e for _, e in ladder], seed, plant)
    named = [GridResult(n, r.fim, r.violations, r.home) for (n, _), r in zip(ladder, results, strict=True)]
    best = max(named[2:], key=lambda r: r.mean)
    return [*named[:2], GridResult(f"best blind switch: {best.name}", best.fim, best.violations, best.home)]
