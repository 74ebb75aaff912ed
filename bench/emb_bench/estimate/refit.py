"""Refit of an estimate from other records, and its unknowns that all records share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.output_error import finished, search
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Estimate, Unknown
from emb_bench.information.identifiability import schur_complement


def refit(e: Estimate, chosen: Sequence[int]) -> Estimate:
    """Estimate again from some of the records, by the same method.

    Output error begins where the estimate is, and stands for the ensemble too, whose draws lie around it. The model
    validation is not repeated: it is that of the first estimate.

    Args:
        e: the estimate.
        chosen: numbers of records, any of them as often as it is to count.
    """
    records = tuple(e.records[i] for i in chosen)
    if e.method not in ("oem", "ensemble"):
        return run_method(e.method, e.bench, e.plant, records, e.asked, starts=1)
    problem = Problem(e.bench, e.plant, e.asked, records)
    known = dict(zip(e.unknowns, e.values.tolist(), strict=True))
    there = [Unknown(u.name, None if u.record is None else chosen[u.record]) for u in problem.unknowns]
    start = np.clip(np.array([known[u] for u in there]) / problem.units, *problem.bounds)
    weights = problem.weights(start)
    z, end = search(problem, start, weights)
    return finished(problem, z, weights, (end,), validation=e.validation)


def shared(e: Estimate) -> list[int]:
    """Indices of the unknowns that all records share."""
    return [i for i, unknown in enumerate(e.unknowns) if unknown.record is None]


def shared_information(e: Estimate) -> Floats:
    """FIM of the shared unknowns when those of single records are unknown too; relative parameters, prior included."""
    return schur_complement(e.information, shared(e))
