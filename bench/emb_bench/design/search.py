"""Many coarse designs, the best of them polished, varied and polished again: multi-start, for there are many optima.

A coarse design is a table of few journeys (:func:`emb_bench.design.kernel.explore`), optimised by CMA-ES (Hansen, The
CMA evolution strategy: a tutorial, arXiv:1604.00772). Most searches end at the same optimum, and the value of a table
predicts little of its value after a polish. So a search has a price for nearness to earlier results, and the selected
tables differ; two designs are near if their informations on each combination of parameters are. Then rounds of
annealing (:mod:`emb_bench.design.anneal`) and a short polish follow, with fewer designs in each round, until the best
one gains no more. It is then polished to convergence.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from emb_bench.design.anneal import annealed
from emb_bench.design.polish import Settings, merit, polish
from emb_bench.design.problem import MARGIN, Design, Problem
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.criteria import Criterion, distances
from emb_bench.information.symmetric import Floats
from emb_bench.parallel import Lost, processors, shared_out
from emb_runtime.errors import UsageError

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # about optional plots
    import cma

JOURNEYS = (3, 4, 5)  # Journeys of a coarse design; the searches take turns
SHORTEST = 0.003  # Shortest journey, as a share of the longest one
DRAWN = 400  # Tables drawn at random, of which the best one starts a search
FIRST = 4000  # Coarse designs that one search simulates
FEW = 600  # The same for a criterion of the interval, which takes a hundred times as long; a fifth is drawn besides
WIDE = 0.2  # Initial standard deviation of the genes, −1..1
CLOSE = 0.05  # The same of a search that begins with the table of another brake
POPULATION = 24  # Population of CMA-ES
WAVES = 3  # Batches of coarse searches; each has a price for nearness to earlier results
NEAR = 0.3  # Distance (:func:`distances`) below which two tables count as near; those that go on are half of it apart
NEARNESS = 0.1  # Largest price of being near to an earlier table, in the unit of φ
LINES = 4  # Designs that are annealed; one fewer in each round, down to one
LAST = 2  # Annealings of the last design in each round, so that two processors have work
ROUNDS = 20  # Most rounds of annealing
PATIENCE = 4  # Rounds over which the gain is judged
GAIN = 3e-4  # Gain of φ over these rounds below which the search ends
SOFT = 0.05  # Share of the price of leaving the box that a coarse design pays; the polish moves it back inside
FIRM = 20.0  # The same where no polish follows
WORST = -1e3  # Worth of a table without information
LONG = Settings(steps=80, tolerance=5e-5, cuts=4)  # Polish of every design at first, and of the best one at the end
AGAIN = Settings(steps=6, tolerance=0.0, cuts=2)  # Polish after each annealing
SHORT = Settings(steps=20, tolerance=1e-3, cuts=1)  # Polish of a finished design inside tighter limits
REPAIRS = 3  # Most times that limits are tightened because a brake exceeded them between samples


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search."""

    best: Design
    designs: tuple[Design, ...]  # The polished ones within the limits, best first: local optima, or near one
    interrupted: bool = False  # By Ctrl-C: the best of what was found by then
    genes: Floats | None = None  # Of the best one, if no polish followed, for the search on another brake


class Table(NamedTuple):
    """A coarse design."""

    genes: Floats  # Of its journeys, shape (3 journeys,)
    value: float  # φ less its price
    currents: Floats  # [A], shape (n,)
    matrix: Floats  # Fisher information, shape (p, p)


def search(
    problem: Problem,
    *,
    starts: int,
    seed: int,
    workers: int = 0,
    warm: Sequence[Floats] = (),
    told: Callable[[str], object] = str,
) -> Found:
    """The best design of many searches; the same seed finds the same design, whatever the number of workers.

    ``starts`` is the number of coarse searches, ``workers`` that of threads, 0 for one per processor. ``warm`` are
    further initial currents, for a criterion of the interval the genes of tables. ``told`` is called after each of at
    most :func:`steps_of` steps, with a description. Ctrl-C ends the search with the best design so far, if there is
    one.
    """
    if not isinstance(problem.goal, Criterion):
        return _best_table(problem, starts, seed, workers, warm, told)
    seeds = np.random.SeedSequence(seed).spawn(starts + LINES)
    draws = [np.random.default_rng(s) for s in seeds[starts:]]
    tables: list[Table] = []
    lines: list[Design] = []
    ended: list[Design] = []
    history: list[float] = []
    with ThreadPoolExecutor(workers or processors()) as pool:
        try:
            for wave in np.array_split(np.arange(starts), WAVES):
                found = list(tables)
                for table in pool.map(
                    lambda i, f=found: coarse(problem, JOURNEYS[i % len(JOURNEYS)], seeds[i], f), wave
                ):
                    tables.append(table)
                    told(f"start {len(tables)} of {starts} done")
            begun = [problem.design(table.currents) for table in _diverse(tables, LINES)]
            begun += [problem.design(u) for u in warm]
            lines = sorted(pool.map(lambda d: _better(d, polish(problem, d.currents, LONG)), begun), key=_rank)[::-1]
            told("the best starts polished")
            while not _settled(history):
                count = max(1, LINES - len(history))
                ended += lines[count:]
                lines = lines[:count]
                varied = pool.map(lambda d, rng: _varied(problem, d, rng), lines if count > 1 else lines * LAST, draws)
                lines = sorted(varied, key=_rank, reverse=True)[:count]
                history.append(_rank(lines[0]))
                told(f"round {len(history)} of at most {ROUNDS} of improvement done")
            interrupted = False
        except KeyboardInterrupt:
            if not lines:
                raise
            interrupted = True
    ended += [_better(lines[0], polish(problem, lines[0].currents, LONG)), *lines[1:]]
    polished = sorted(ended, key=_rank, reverse=True)
    best = next((d for d in (_between_samples(problem, d) for d in polished) if d is not None), None)
    if best is None:
        nearest = min(d.outside for d in polished)
        raise UsageError(
            f"no design keeps the limits: {starts} starts leave them by {nearest:.3g} rad or rad/s at best; "
            "try more starts, or check whether the brake can come home in time"
        )
    others = sorted((d for d in polished if d.feasible and d.phi < best.phi), key=_rank, reverse=True)
    return Found(best, (best, *others), interrupted)


def _best_table(
    problem: Problem, starts: int, seed: int, workers: int, warm: Sequence[Floats], told: Callable[[str], object]
) -> Found:
    """The best coarse design for a criterion without a gradient, within the limits also between samples."""
    seeds = np.random.SeedSequence(seed).spawn(starts + len(warm))
    begins: list[Floats | None] = [*[None] * starts, *warm]
    pieces = list(zip(range(len(seeds)), seeds, begins, strict=True))
    designs: list[tuple[Design, Floats]] = []
    interrupted, done = False, 0
    try:
        for number, found in shared_out(partial(_table, problem), pieces, workers or processors(), math.inf):
            if isinstance(found, Lost):
                raise UsageError(f"start {number + 1} of the search: {found.why}")
            design = problem.design(found.currents)
            if design.feasible and max(problem.beyond(design)) <= MARGIN:
                designs.append((design, found.genes))
            done += 1
            told(f"start {done} of {len(pieces)} done")
    except KeyboardInterrupt:
        if not designs:
            raise
        interrupted = True
    if not designs:
        raise UsageError(f"no design of {starts} starts keeps the limits: try more starts")
    designs.sort(key=lambda found: _rank(found[0]), reverse=True)
    return Found(designs[0][0], tuple(design for design, _ in designs), interrupted, designs[0][1])


def _table(problem: Problem, piece: tuple[int, np.random.SeedSequence, Floats | None]) -> Table:
    """The table of one coarse search, from ``warm`` genes if there are some."""
    number, seed, warm = piece
    if warm is None:
        return coarse(problem, JOURNEYS[number % len(JOURNEYS)], seed)
    return evolved(problem, warm, CLOSE, FEW, np.random.default_rng(seed))


def steps_of(goal: Criterion | IntervalCriterion, starts: int) -> int:
    """Most steps of a search, which take similar times: its starts, and for some goals their polish and the rounds."""
    return starts + 1 + ROUNDS if isinstance(goal, Criterion) else starts


def _diverse(tables: Sequence[Table], count: int) -> list[Table]:
    """The best tables that are not near a better one; if they are too few, the best of the others as well."""
    apart: list[Table] = []
    others: list[Table] = []
    for table in sorted(tables, key=lambda table: -table.value):
        near = any(distances(table.matrix[None], better.matrix)[0] < NEAR / 2.0 for better in apart)
        (others if near else apart).append(table)
    return [*apart, *others][:count]


def _settled(history: Sequence[float]) -> bool:
    """True if the best design has not gained for some rounds."""
    return len(history) == ROUNDS or (len(history) > PATIENCE and history[-1] - history[-1 - PATIENCE] < GAIN)


def _varied(problem: Problem, design: Design, rng: np.random.Generator) -> Design:
    """The design, or a better one that was annealed and polished."""
    currents = annealed(problem, design.states[1:, 1], rng)
    return _better(design, polish(problem, currents, AGAIN))


def _rank(design: Design) -> float:
    """Sort key: feasible designs come first."""
    return design.phi if design.feasible else merit(design) - 1e3


def _better(a: Design, b: Design) -> Design:
    return max(a, b, key=_rank)


def _between_samples(problem: Problem, design: Design) -> Design | None:
    """The design again, inside limits that are tighter by its excess between samples; None if that fails."""
    angle, speed = 0.0, 0.0
    for _ in range(REPAIRS):
        beyond = problem.beyond(design)
        if design.feasible and max(beyond) <= MARGIN:
            return design
        angle, speed = angle + beyond[0], speed + beyond[1]
        design = problem.design(polish(problem.narrowed(angle, speed), design.currents, SHORT).currents)
    return None


def coarse(problem: Problem, journeys: int, seed: np.random.SeedSequence, far: Sequence[Table] = ()) -> Table:
    """A table of some journeys, optimised from random ones; nearness to the tables ``far`` has a price."""
    rng = np.random.default_rng(seed)
    low, high = _borders(journeys)
    first, count = (DRAWN, FIRST) if isinstance(problem.goal, Criterion) else (FEW // 5, FEW)
    drawn = low + rng.random((first, 3 * journeys)) * (high - low)
    near = rng.random((first, 2 * journeys)) < 0.5  # optima wait near contact, and creep
    drawn[:, : 2 * journeys] *= np.where(near, 0.4, 1.0)
    return evolved(problem, drawn[np.argmin(_cost(problem, drawn, far))], WIDE, count, rng, far=far)


def evolved(
    problem: Problem,
    begin: Floats,
    spread: float,
    count: int,
    rng: np.random.Generator,
    *,
    population: int = POPULATION,
    far: Sequence[Table] = (),
) -> Table:
    """The best table of a search by CMA-ES from genes with a deviation ``spread``; it simulates ``count`` designs."""
    low, high = _borders(len(begin) // 3)
    options: dict[str, Any] = {
        "bounds": [low, high],
        "popsize": population,
        "maxfevals": count,
        "tolfun": 1e-5,
        "tolflatfitness": 20,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # random numbers are handed in
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(begin, spread, options)
    best, least = begin, float(_cost(problem, begin[None], far)[0])
    while not strategy.stop():
        candidates = strategy.ask()
        genes = np.array(candidates)
        cost = _cost(problem, genes, far)
        strategy.tell(candidates, cost.tolist())
        top = int(np.argmin(cost))
        if cost[top] < least:
            best, least = genes[top], float(cost[top])
    currents, matrices, _, _ = problem.explore(best[None])
    return Table(best, -float(_cost(problem, best[None])[0]), currents[0], matrices[0])


def _borders(journeys: int) -> tuple[Floats, Floats]:
    return np.repeat([-1.0, -1.0, SHORTEST], journeys), np.ones(3 * journeys)


def _cost(problem: Problem, genes: Floats, far: Sequence[Table] = ()) -> Floats:
    _, matrices, phi, price = problem.explore(np.ascontiguousarray(genes))
    nearest = np.min([distances(matrices, table.matrix) for table in far], axis=0, initial=NEAR)
    soft, phi = (SOFT, phi) if isinstance(problem.goal, Criterion) else (FIRM, np.maximum(phi, WORST))
    cost = soft * price - phi + NEARNESS * (1.0 - nearest / NEAR)
    return np.asarray(np.nan_to_num(cost, nan=1e9, posinf=1e9))
