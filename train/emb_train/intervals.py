"""Intervals that estimates from played experiments will have."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.expected import Interval, of_experiment, sampled
from emb_bench.information.evaluation import Question
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters

PIECE = 8  # Experiments that a process takes at a time


def intervals(
    bench: Bench,
    plant: str,
    parameters: Sequence[str],
    brakes: Sequence[BrakeParameters],
    currents: Sequence[Floats] | Floats,
    pool: Executor | None = None,
) -> list[Interval]:
    """The interval that each of N experiments will lead to, from its brake and the currents that acted [A].

    Shape (N, horizon), or N rows of any lengths. The ``pool`` has processes that share the work.
    """
    work = partial(_interval, bench, bench.model(plant), Question(tuple(parameters)))
    return list(map(work, brakes, currents) if pool is None else pool.map(work, brakes, currents, chunksize=PIECE))


def _interval(bench: Bench, plant: Plant, question: Question, brake: BrakeParameters, currents: Floats) -> Interval:
    return of_experiment(bench, plant, brake, sampled(bench, plant, currents), question)


def finite(values: Sequence[float]) -> Floats:
    """Values of a criterion; one that is not finite, of an experiment that says nothing, counts as 0 nat."""
    found: Floats = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return found
