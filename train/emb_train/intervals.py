"""Intervals that estimates from played experiments will have."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.expected import Interval, of_experiment, sampled
from emb_bench.information.evaluation import Question
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters

PIECE = 8  # Experiments that a process takes at a time


class Conditions(NamedTuple):
    """Conditions that experiments share."""

    bench: Bench
    plant: Plant  # As a record of the bench is evaluated
    parameters: tuple[str, ...]


def intervals(
    bench: Bench,
    plant: str,
    parameters: Sequence[str],
    brakes: Sequence[BrakeParameters],
    currents: Sequence[Floats] | Floats,
    pool: Executor | None = None,
) -> list[Interval]:
    """The interval that each of N experiments will lead to, from its brake and the currents that acted [A].

    Shape (N, horizon), or N rows of their own lengths. The ``pool`` has processes that share the work.
    """
    alike = Conditions(bench, bench.model(plant), tuple(parameters))
    pieces = [slice(i, i + PIECE) for i in range(0, len(brakes), PIECE)]
    work = partial(_intervals, alike)
    arguments = [brakes[piece] for piece in pieces], [currents[piece] for piece in pieces]
    done = map(work, *arguments) if pool is None else pool.map(work, *arguments)
    return [one for those in done for one in those]


def _intervals(alike: Conditions, brakes: Sequence[BrakeParameters], currents: Sequence[Floats]) -> list[Interval]:
    bench, plant, asked = alike.bench, alike.plant, Question(alike.parameters)
    return [
        of_experiment(bench, plant, brake, sampled(bench, plant, row), asked)
        for brake, row in zip(brakes, currents, strict=True)
    ]


def finite(values: Sequence[float]) -> Floats:
    """Values of a criterion; one that is not finite, of an experiment that says nothing, counts as 0 nat."""
    found: Floats = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return found
