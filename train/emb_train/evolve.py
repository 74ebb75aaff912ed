"""Contextual evolution: levels and switches of a reference learn on which estimates they should depend.

Simulator, shield and estimator are black boxes here. Each brake of a batch has its own random change of all levels and
switches, and meets it twice, with both signs and the same noise. Half the difference of the two scores, times the
change, estimates without bias how the score of *this* brake depends on each number (an antithetic evolution strategy:
Salimans et al., Evolution strategies as a scalable alternative to reinforcement learning, arXiv:1703.03864). Levels and
switches are linear in features of the running estimate, so that this slope, times the features at the moment when the
number was used, is the slope by the coefficients: what would be one number for all brakes becomes a regression over
them. Adam (Kingma and Ba, arXiv:1412.6980) climbs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.estimator.speed_loop import Scale
from emb_train.play import begin_all, mean_score
from emb_train.trial import Task

TUNING_SEED = 1_000_000  # Brakes to tune on have seeds from here on; those of evaluations are smaller
SLOW = 0.1  # Of full speed: a level below it is changed by that much less
BATCH = 256  # Brakes of one step; each plays two experiments
LEVEL_SPREAD = 0.03
"""Standard deviation of a level's change at first, for one of at least ``SLOW``."""
SWITCH_SPREAD = 0.006  # Of a switch's: three samples of five hundred
NARROWED = 0.3  # Share of these standard deviations at the end
RATE = 0.12  # Step of a coefficient at first, as a share of its row's standard deviation; falls to zero as a cosine
MOMENTS = 0.9, 0.98  # Memories of Adam
OUTLIER = 3.0  # Largest share of a difference of scores in their standard deviation that counts
AVERAGED = 0.25  # Last share of the steps whose references are averaged
JUDGED = 1024  # Brakes on which the result is compared with what it began with


@dataclass(frozen=True, eq=False)
class Tuned:
    """Result of a search."""

    table: Floats  # See :func:`emb_train.reference.set_reference`
    score: float  # Mean over the brakes that it was judged on
    steps: int  # Steps that were made, fewer than asked for after a Ctrl-C


class Progress(NamedTuple):
    """One step of the search."""

    steps: int  # Done so far
    score: float  # Mean over the experiments of this step, which are those of a reference that is changed at random
    home: int  # Experiments that ended at home; those that end when a precision is reached are not asked
    left: int  # Experiments that left the limits
    played: int  # Experiments


def evolve(
    task: Task,
    bench: Bench,
    scale: Scale,
    begin: Floats,
    *,
    steps: int,
    seed: int,
    blind: bool = False,
    batch: int = BATCH,
    show: Callable[[Progress], object] = lambda progress: None,
) -> Tuned:
    """Improve a reference; each step has new brakes.

    Args:
        task: what counts, on which brakes, behind which shield.
        bench: limits, noise, timing.
        scale: of the reference.
        begin: table to begin with, shape [2 n − 1, TERMS].
        steps: number of them.
        seed: of the changes and of the brakes.
        blind: leave the reference without a dependence on the estimate: only constants are changed.
        batch: brakes of a step.
        show: called after each step.

    Returns:
        The better one of the mean of the last references and what it began with, on brakes that no step had. After a
        Ctrl-C, the last reference where there is no mean yet.
    """
    rng = np.random.default_rng(seed)
    first = TUNING_SEED + seed * steps
    trials = task.trials(bench, task.draws(bench, first, batch))
    levels = (len(begin) + 1) // 2
    spread = np.full(len(begin), SWITCH_SPREAD)
    spread[:levels] = np.where(np.abs(begin[:levels, 0]) < SLOW, SLOW, 1.0) * LEVEL_SPREAD
    table, mean, square, summed, parts = begin.copy(), np.zeros_like(begin), np.zeros_like(begin), 0.0 * begin, 0
    made = 0
    with contextlib.suppress(KeyboardInterrupt):  # what was found by then is judged and kept
        for k in range(steps):
            begin_all(trials, task.draws(bench, first + k, batch))
            done = k / steps
            reach = spread * (1.0 - (1.0 - NARROWED) * done)
            change = rng.standard_normal((batch, len(table)))
            moved = np.zeros((batch, *table.shape))
            moved[:, :, 0] = change * reach
            up, down = trials.play(scale, [table + moved, table - moved])
            scores = task.score(up), task.score(down)
            gain = 0.5 * (scores[0] - scores[1])
            gain = np.clip(gain / max(float(gain.std()), 1e-12), -OUTLIER, OUTLIER)
            slope = np.einsum("n,nr,nrc->rc", gain, change, 0.5 * (up.used + down.used)) / batch
            if blind:
                slope[:, 1:] = 0.0
            mean += (1.0 - MOMENTS[0]) * (slope - mean)
            square += (1.0 - MOMENTS[1]) * (slope * slope - square)
            unbiased = mean / (1.0 - MOMENTS[0] ** (k + 1)), square / (1.0 - MOMENTS[1] ** (k + 1))
            rate = RATE * 0.5 * (1.0 + np.cos(np.pi * done))
            table = table + rate * spread[:, None] * unbiased[0] / (np.sqrt(unbiased[1]) + 1e-9)
            if done >= 1.0 - AVERAGED:
                summed, parts = summed + table, parts + 1
            both = np.concatenate(scores)
            made = k + 1
            show(
                Progress(made, float(both.mean()), int(up.home.sum() + down.home.sum()), int(up.left.sum()), 2 * batch)
            )
    fresh = task.trials(bench, task.draws(bench, first - 1, JUDGED))
    found = summed / parts if parts else table
    values = [task.score(outcome) for outcome in fresh.play(scale, [found, begin])]
    better = float(mean_score(values[0]).value) > float(mean_score(values[1]).value)
    best, scored = (found, values[0]) if better else (begin, values[1])
    return Tuned(best, float(scored.mean()), made)
