"""Search for a plan: levels of speed and switches between them that are best for the interval of an estimate.

A plan is a blind reference (:mod:`emb_train.reference`). The interval has no slope that one experiment would tell, and
many local optima: plans are drawn at random and screened on a few brakes, the best of them are compared on more, and
CMA-ES (Hansen, arXiv:1604.00772) goes on from there. Levels are squares of its numbers with their signs, so that it
finds a creep, and times are shares by their logarithms. All plans meet the same brakes with the same noise.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_bench.parallel import processes
from emb_runtime.estimator.speed_loop import Scale
from emb_train.evolve import TUNING_SEED, Progress, Tuned
from emb_train.reference import TERMS
from emb_train.trial import ReportedOutcome, Task, Trials

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of what it would like to have for plots
    import cma

LEVELS = 9  # Levels of a plan that begins at random
DRAWN = 800  # Plans drawn at random
SCREENED = 4  # Brakes on which they are compared
SCREENINGS = 40  # Parts in which this is done
KEPT = 20  # Plans that are compared on all brakes
BRAKES = 16  # Brakes of the search
JUDGED = 64  # Brakes on which its results are compared, and which it did not have
POPULATION = 16  # Plans of one step of CMA-ES
SPREAD = 0.15  # First standard deviation of its numbers, -1 to 1
BOUND = 1.05  # Beyond the ends of the numbers, so that full speed is inside
NEAR = 0.3  # Half the levels drawn are this much smaller, for a creep
WIDTHS = 3.0  # Logarithm of the longest time over the mean
PRICE = 20.0  # Of an experiment that leaves the limits or does not end at home [nat]


def table_of(numbers: Floats) -> Floats:
    """The table of a plan's 2 n numbers: of its levels, then of its times."""
    of_levels, of_times = np.split(np.clip(numbers, -1.0, 1.0), 2)
    times = np.cumsum(np.exp(WIDTHS * of_times))
    table = np.zeros((2 * len(of_levels) - 1, TERMS))
    table[:, 0] = np.concatenate([np.sign(of_levels) * of_levels**2, times[:-1] / times[-1]])
    return table


def numbers_of(table: Floats) -> Floats:
    """The numbers of a table, as near as their ends allow."""
    levels, switches = np.split(table[:, 0], [(len(table) + 1) // 2])
    times = np.log(np.maximum(np.diff(switches, prepend=0.0, append=1.0), 1e-6))
    numbers = np.concatenate([np.sign(levels) * np.sqrt(np.abs(levels)), (times - times.mean()) / WIDTHS])
    result: Floats = np.clip(numbers, -1.0, 1.0)
    return result


class Compared:
    """Brakes on which plans are compared."""

    def __init__(self, task: Task, bench: Bench, scale: Scale, pool: Executor | None, seed: int, count: int) -> None:
        self._task, self._bench, self._scale, self._pool = task, bench, scale, pool
        draws = task.draws(bench, seed, count)
        self._brakes = [draw.brake for draw in draws]
        self._trials: Trials = task.trials(bench, draws)

    def scores(self, plans: Floats) -> tuple[Floats, list[ReportedOutcome]]:
        """Mean score of each of some plans, shape (plans, numbers), and their experiments."""
        outcomes = self._trials.play(self._scale, [table_of(plan) for plan in plans])
        task = self._task
        values = task.measure.of_outcomes(self._bench, task.plant, task.parameters, self._brakes, outcomes, self._pool)
        scored = [float(np.mean(v - PRICE * ~o.home)) for v, o in zip(values, outcomes, strict=True)]
        return np.array(scored), outcomes


def search(
    task: Task,
    bench: Bench,
    scale: Scale,
    begin: Floats | None,
    *,
    steps: int,
    seed: int,
    show: Callable[[Progress], object] = lambda progress: None,
) -> Tuned:
    """Finds a plan.

    Args:
        task: what counts, on which brakes, behind which shield.
        bench: limits, noise, timing, and what an estimate does not know.
        scale: of the plan.
        begin: table to begin with; None for plans at random.
        steps: of CMA-ES.
        seed: of the plans and of the brakes.
        show: called after each part of the plans at random, with 0 steps, and after each step.

    Returns:
        The better one of the best plan and the mean of the last step, on brakes that no step had; after a Ctrl-C, of
        those so far.
    """
    rng, first, made = np.random.default_rng(seed), TUNING_SEED + 4 * seed, 0
    with processes(os.cpu_count() or 1) as pool:
        few, many, fresh = (
            Compared(task, bench, scale, pool, first + i, count) for i, count in enumerate((SCREENED, BRAKES, JUDGED))
        )
        best = drawn(rng, few, many, show) if begin is None else numbers_of(begin)
        (least,), _ = many.scores(best[None])
        mean = best
        options: dict[str, Any] = {
            "popsize": POPULATION, "bounds": [-BOUND, BOUND], "verbose": -9, "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
        }  # fmt: skip
        strategy = cma.CMAEvolutionStrategy(best, SPREAD, options)
        with contextlib.suppress(KeyboardInterrupt):  # what was found by then is judged and kept
            while made < steps and not strategy.stop():
                asked = strategy.ask()
                scores, outcomes = many.scores(np.array(asked))
                strategy.tell(asked, (-scores).tolist())
                made, mean = made + 1, np.array(strategy.mean)
                if scores.max() > least:
                    best, least = np.array(asked[int(np.argmax(scores))]), float(scores.max())
                show(progress(made, scores, outcomes))
            made = steps  # or it converged
        judged, _ = fresh.scores(np.array([best, mean]))
    chosen = int(np.argmax(judged))
    return Tuned(table_of((best, mean)[chosen]), float(judged[chosen]), made)


def progress(steps: int, scores: Floats, outcomes: list[ReportedOutcome]) -> Progress:
    """Progress of plans that were played after some steps."""
    home, left = (sum(int(getattr(o, name).sum()) for o in outcomes) for name in ("home", "left"))
    return Progress(steps, float(scores.mean()), home, left, sum(len(o.home) for o in outcomes))


def drawn(rng: np.random.Generator, few: Compared, many: Compared, show: Callable[[Progress], object]) -> Floats:
    """The best of plans at random; ``show`` is called ``SCREENINGS`` times."""
    plans = rng.uniform(-1.0, 1.0, (DRAWN, 2 * LEVELS))
    plans[:, :LEVELS] *= np.where(rng.random((DRAWN, LEVELS)) < 0.5, NEAR, 1.0)
    found = []
    for part in np.array_split(plans, SCREENINGS):
        scores, outcomes = few.scores(part)
        found.append(scores)
        show(progress(0, scores, outcomes))
    kept = plans[np.argsort(-np.concatenate(found))[:KEPT]]
    best: Floats = kept[int(np.argmax(many.scores(kept)[0]))]
    return best
