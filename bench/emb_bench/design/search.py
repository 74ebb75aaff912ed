"""Many coarse designs, the best of each search polished: multi-start, because this problem is full of local optima."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import differential_evolution

from emb_bench.design.polish import Settings, merit, polish
from emb_bench.design.problem import MARGIN, Design, Problem
from emb_bench.information.symmetric import Floats
from emb_runtime.errors import UsageError

PIECES = (3, 5, 7, 4, 6, 8)
"""Pieces of the speed reference; the searches take turns."""
POPULATION = 80
FIRST_GENERATIONS = 20
CONTINUED = 4
"""One search in so many goes on, the best ones, for"""
GENERATIONS = 100
"""more generations."""
POLISHED = 8
"""Best coarse designs that are polished, and of these"""
FINALISTS = 2
"""to the end."""
SCREENED = 400
"""Drawn at random, of which the best are the first population."""
SOFT = 0.05
"""Share of the price of leaving the box that a coarse design pays: the polish brings it back in."""
SHORT = Settings(steps=20, tolerance=1e-3, cuts=1)
LONG = Settings(steps=80, tolerance=5e-5, cuts=4)
REPAIRS = 3
"""Times that limits are drawn tighter because a brake left them between samples."""


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search."""

    best: Design
    designs: tuple[Design, ...]
    """The polished ones within the limits, best first: local optima, or near one."""
    coarse: tuple[float, ...]
    """φ less a price, that each coarse search ended with: first those that went on, best first."""


class Evolution(NamedTuple):
    """A coarse search on its way."""

    genes: Floats
    """The population, best first, shape (POPULATION, 2 pieces)."""
    value: float
    """φ of the best less its price."""
    rng: np.random.Generator


def search(problem: Problem, *, starts: int, seed: int, workers: int = 0, warm: Sequence[Floats] = ()) -> Found:
    """The best design of many searches; the same seed finds the same design, whatever the number of workers.

    Args:
        problem: what is designed.
        starts: number of coarse searches.
        seed: of their random numbers.
        workers: threads; 0 for one per processor.
        warm: currents to start from besides, each of shape (n,).

    Raises:
        UsageError: nothing that was found keeps the limits.
    """
    seeds = np.random.SeedSequence(seed).spawn(starts)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        first = list(pool.map(lambda i: coarse(problem, PIECES[i % len(PIECES)], seeds[i]), range(starts)))
        promising, left = _promising(first)
        going = list(pool.map(lambda state: evolve(problem, state, GENERATIONS), promising))
        going.sort(key=lambda state: -state.value)
        ends = [problem.explore(state.genes[:1])[0][0] for state in going[:POLISHED]]
        begun = [problem.design(u) for u in [*ends, *warm]]
        short = pool.map(lambda d: _better(d, polish(problem, d.currents, SHORT)), begun)
        polished = sorted(short, key=_rank, reverse=True)
        ended = pool.map(lambda d: _better(d, polish(problem, d.currents, LONG)), polished[:FINALISTS])
        polished = sorted([*ended, *polished[FINALISTS:]], key=_rank, reverse=True)
    best = next((d for d in (_between_samples(problem, d) for d in polished) if d is not None), None)
    if best is None:
        nearest = min(d.outside for d in polished)
        raise UsageError(
            f"no design keeps the limits: {starts} starts leave them by {nearest:.3g} rad or rad/s at best; "
            "try more starts, or check whether the brake can come home in time"
        )
    others = sorted((d for d in polished if d.feasible and d.phi < best.phi), key=_rank, reverse=True)
    return Found(best, (best, *others), tuple(state.value for state in [*going, *left]))


def _promising(states: Sequence[Evolution]) -> tuple[list[Evolution], list[Evolution]]:
    """Starts that go on, and the others: by numbers of pieces, for a reference of many takes longer to become good."""
    going, left = [], []
    for first in range(len(PIECES)):
        group = sorted(states[first :: len(PIECES)], key=lambda state: -state.value)
        count = -(-len(group) // CONTINUED)
        going += group[:count]
        left += group[count:]
    return going, left


def _rank(design: Design) -> float:
    """Sort key: feasible designs come first."""
    return design.phi if design.feasible else merit(design) - 1e3


def _better(a: Design, b: Design) -> Design:
    return max(a, b, key=_rank)


def _between_samples(problem: Problem, design: Design) -> Design | None:
    """The design again, inside limits drawn tighter by what it left them by between samples; None if that fails."""
    angle, speed = 0.0, 0.0
    for _ in range(REPAIRS):
        beyond = problem.beyond(design)
        if design.feasible and max(beyond) <= MARGIN:
            return design
        angle, speed = angle + beyond[0], speed + beyond[1]
        design = problem.design(polish(problem.narrowed(angle, speed), design.currents, SHORT).currents)
    return None


def coarse(problem: Problem, pieces: int, seed: np.random.SeedSequence) -> Evolution:
    """Speed references after a first stretch of differential evolution (Storn and Price 1997) from a random population.

    Args:
        problem: what is designed.
        pieces: of the reference.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    low, high = _borders(pieces)
    drawn = low + rng.random((SCREENED, 2 * pieces)) * (high - low)
    levels, kind = drawn[:, :pieces], rng.random((SCREENED, pieces))
    levels[kind < 0.5] = np.sign(levels[kind < 0.5])  # optima run at full speed most of the time,
    levels[kind > 0.75] *= 0.2  # and creep
    best = np.argsort(_cost(problem, drawn), kind="stable")[:POPULATION]
    return evolve(problem, Evolution(drawn[best], -np.inf, rng), FIRST_GENERATIONS)


def evolve(problem: Problem, state: Evolution, generations: int) -> Evolution:
    """Some more generations."""
    low, high = _borders(state.genes.shape[1] // 2)
    found = differential_evolution(
        lambda columns: _cost(problem, columns.T),
        list(zip(low, high, strict=True)),
        init=state.genes,
        maxiter=generations,
        rng=state.rng,
        vectorized=True,
        updating="deferred",
        polish=False,
        mutation=(0.4, 0.9),
        recombination=0.8,
        tol=1e-6,
    )
    order = np.argsort(found.population_energies, kind="stable")
    return Evolution(found.population[order], -float(found.fun), state.rng)


def _borders(pieces: int) -> tuple[Floats, Floats]:
    return np.repeat([-1.0, 0.005], pieces), np.ones(2 * pieces)


def _cost(problem: Problem, genes: Floats) -> Floats:
    _, phi, price = problem.explore(np.ascontiguousarray(genes))
    return np.nan_to_num(SOFT * price - phi, nan=1e9, posinf=1e9)
