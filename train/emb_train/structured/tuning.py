"""Blind references by CMA-ES (Hansen, The CMA evolution strategy: a tutorial, arXiv:1604.00772).

What is searched for is tuned on brakes and noise that no evaluation meets; on a grid, the brakes are the same and the
noise is another.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.information.symmetric import Floats
from emb_train.structured.law import TERMS, Loop
from emb_train.structured.task import Task
from emb_train.structured.trial import Trials

TUNING_SEED = 1_000_000  # Brakes to tune on have seeds from here on; those of evaluations are smaller
SPREAD = 0.1  # Initial standard deviation of levels and switches
FINE = 0.02  # Initial standard deviation near an optimum
CREEP = 0.01  # Standard deviation of a level that creeps: 5 rad/s
SLOW = 0.1  # Of full speed: a level below this is searched for that much more finely
COARSE = 16  # Brakes of the first searches
DRAWN = 600  # Blind references drawn at random. The best, each of another pattern of levels, start as many searches as
STARTS = 10  # on few brakes, of this many
FIRST_GENERATIONS = 20  # generations each. The best of these goes on.


@dataclass(frozen=True, eq=False)
class Tuned:
    """Result of a search."""

    table: Floats  # See :func:`emb_train.structured.law.share_after`
    score: float  # Mean over the brakes that it was tuned on


def random_tables(rng: np.random.Generator, levels: int, count: int) -> tuple[Floats, NDArray[np.int64]]:
    """Blind references: levels at full speed of either sign, creeping, or anything; switches anywhere, in order.

    Args:
        rng: draws.
        levels: n.
        count: how many.

    Returns:
        Shape [count, 2 n − 1, TERMS], and which of these kinds each level is, shape [count, n].
    """
    kind = rng.integers(0, 4, (count, levels))
    creep, anything = CREEP * rng.standard_normal((count, levels)), rng.uniform(-1.0, 1.0, (count, levels))
    level = np.choose(kind, [np.ones_like(creep), -np.ones_like(creep), creep, anything])
    tables = np.zeros((count, 2 * levels - 1, TERMS))
    tables[:, :levels, 0] = level
    tables[:, levels:, 0] = np.sort(rng.random((count, levels - 1)), axis=1)
    return tables, kind


def blind(
    task: Task,
    coarse: Trials,
    trials: Trials,
    loop: Loop,
    *,
    levels: int,
    generations: int,
    seed: int,
    spread: float = FINE,
    tell: Callable[[str], object] = lambda line: None,
) -> Tuned:
    """Search for a blind reference, from many places: this problem is full of local optima.

    Args:
        task: gives the measure of an experiment.
        coarse: few brakes, for the first searches.
        trials: brakes to tune on.
        loop: how the reference is followed.
        levels: n.
        generations: of CMA-ES in the last search.
        seed: of the search.
        spread: initial standard deviation in the last search.
        tell: called with a line on the end of each search.
    """
    drawn, kinds = random_tables(np.random.default_rng(seed), levels, DRAWN)
    order = np.argsort(-means(task, coarse, loop, drawn), kind="stable")
    _, first_of_kind = np.unique(kinds[order], axis=0, return_index=True)
    found = []
    for i, start in enumerate(drawn[order[np.sort(first_of_kind)[:STARTS]]]):
        first = climb(task, coarse, loop, start, generations=FIRST_GENERATIONS, seed=seed + i)
        tell(f"start {i}: {first.score:.6g} {np.round(first.table[:, 0], 3).tolist()}")
        found.append(first)
    best = max(found, key=lambda tuned: tuned.score)
    result = climb(task, trials, loop, best.table, generations=generations, seed=seed, spread=spread)
    tell(f"blind: {result.score:.6g}")
    return result


def means(task: Task, trials: Trials, loop: Loop, tables: Floats) -> Floats:
    """Mean score of each reference, shape [C]."""
    return np.array([task.score(outcome).mean() for outcome in trials.play(loop, tables)])


def climb(
    task: Task,
    trials: Trials,
    loop: Loop,
    begin: Floats,
    *,
    generations: int,
    seed: int,
    spread: float = SPREAD,
) -> Tuned:
    """Improve the constants of a reference by CMA-ES.

    Args:
        task: gives the measure of an experiment.
        trials: brakes to tune on.
        loop: how the reference is followed.
        begin: table to begin with, shape [2 n − 1, TERMS].
        generations: of CMA-ES.
        seed: of the search.
        spread: initial standard deviation.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it would like to have for plots
        import cma

    def table(genes: Floats) -> Floats:
        built = begin.copy()
        built[:, 0] += genes
        return built

    score = float(means(task, trials, loop, begin[None])[0])
    best = Tuned(begin, score)
    unit = score if task.measure.against == "ratio" else 1.0
    reach = np.where(np.abs(begin[:, 0]) < SLOW, SLOW, 1.0)  # what creeps matters to a thousandth of full speed
    options = {"seed": seed + 1, "verbose": -9, "maxiter": generations, "CMA_stds": reach}
    search = cma.CMAEvolutionStrategy(np.zeros(len(begin)), spread, options)
    while not search.stop():
        genes = search.ask()
        tables = np.array([table(g) for g in genes])
        scores = means(task, trials, loop, tables)
        search.tell(genes, (-scores / unit).tolist())
        top = int(np.argmax(scores))
        if scores[top] > best.score:
            best = Tuned(tables[top], float(scores[top]))
    return best
