"""Estimation methods by their names, and once more from other records.

    OutputError(bench, plant, EstimationProblem(("k_m", "T_c"))).fit(experiments)

Each class is in a module of its own, which imports scipy and numba; :func:`method_of` imports one by its name.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.method import Method
from emb_bench.estimate.records import METHODS
from emb_runtime.errors import UsageError


def method_of(name: str) -> type[Method]:
    """The method of a name, a key of ``METHODS``."""
    match name:
        case "oem":
            from emb_bench.estimate.output_error import OutputError

            return OutputError
        case "pem":
            from emb_bench.estimate.prediction_error import PredictionError

            return PredictionError
        case "rls":
            from emb_bench.estimate.least_squares import RecursiveLeastSquares

            return RecursiveLeastSquares
        case "windows":
            from emb_bench.estimate.windows import Windows

            return Windows
    raise UsageError(f"no method is called '{name}'; expected one of {', '.join(METHODS)}")


def refit(e: Estimate, chosen: Sequence[int]) -> Estimate:
    """Estimates again from some of the records, any of them as often as it is to count, by the same method.

    Output error begins where the estimate is. The model validation is not repeated: it is that of the first estimate.
    """
    from emb_bench.estimate.output_error import finished, search, settled

    problem, own = e.problem.part(chosen)
    if e.method != "oem":
        return method_of(e.method)(e.bench, e.plant, e.asked, starts=1).fit(problem.records)
    start = np.clip(e.z[own], *problem.bounds)
    weights = problem.weights(start)
    problem, end = settled(problem, search(problem, start, weights), weights)
    return finished(problem, end.z, weights, (end,), validation=e.validation)
