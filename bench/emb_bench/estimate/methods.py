"""Estimation methods by their names.

    OutputError(bench, plant, EstimationProblem(("k_m", "T_c"))).fit(experiments)

Each class has its module, which imports scipy and numba; :func:`method_of` imports it.
"""

from __future__ import annotations

from emb_bench.estimate.method import Method


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
    raise AssertionError(name)
