"""Intervals that estimates from played experiments will have, on all processors."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.expected import Interval, of_experiment, sampled
from emb_bench.information.evaluation import Question
from emb_bench.information.symmetric import Floats
from emb_bench.parallel import Lost, shared_out
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError

FEW = 12  # Experiments that take less time than a process does to begin


class Case(NamedTuple):
    """Experiments with brakes of one plant."""

    bench: Bench
    plant: Plant  # As a record of the bench is evaluated
    parameters: tuple[str, ...]
    brakes: tuple[BrakeParameters, ...]
    currents: Floats  # That acted [A], shape [N, horizon]


def intervals(
    bench: Bench, plant: str, parameters: Sequence[str], brakes: Sequence[BrakeParameters], currents: Floats
) -> list[Interval]:
    """The interval that each experiment will lead to, from its brake and the currents that acted [A].

    Raises:
        UsageError: a process was lost.
    """
    case = Case(bench, bench.model(plant), tuple(parameters), tuple(brakes), currents)
    jobs = 1 if len(brakes) <= FEW else os.cpu_count() or 1
    if jobs == 1:
        return _intervals(case, range(len(brakes)))
    parts = [range(i, len(brakes), jobs) for i in range(jobs)]
    found: dict[int, Interval] = {}
    for number, those in shared_out(partial(_intervals, case), parts, jobs, math.inf):
        if isinstance(those, Lost):
            raise UsageError(f"the intervals of {len(brakes)} experiments: {those.why}")
        found |= dict(zip(parts[number], those, strict=True))
    return [found[i] for i in range(len(brakes))]


def _intervals(case: Case, which: Sequence[int]) -> list[Interval]:
    asked = Question(case.parameters)
    return [
        of_experiment(case.bench, case.plant, case.brakes[i], sampled(case.bench, case.plant, case.currents[i]), asked)
        for i in which
    ]


def finite(values: Sequence[float]) -> Floats:
    """Values of a criterion; one that is not finite, of an experiment that says nothing, counts as 0 nat."""
    found: Floats = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return found
