"""Dispatch to the method of estimation of a given name."""

from __future__ import annotations

from collections.abc import Sequence

from emb_bench.estimate.records import METHODS, STARTS, Estimate, EstimationProblem, Record
from emb_runtime.config.bench import Bench
from emb_runtime.config.plants import Plant
from emb_runtime.errors import UsageError


def run_method(
    name: str,
    bench: Bench,
    plant: Plant,
    records: Sequence[Record],
    asked: EstimationProblem,
    *,
    starts: int = STARTS,
    seed: int = 0,
) -> Estimate:
    """Estimates parameters by the method of a name; imports a method when it is used.

    Args:
        name: key of ``METHODS``.
        bench: noise, sample time and nominal brake.
        plant: the model.
        records: what was done and measured.
        asked: the parameters to estimate.
        starts: local searches; recursive least squares needs none and ignores them.
        seed: of the random numbers.

    Raises:
        UsageError: there is no such method, a library that it needs is missing, or it cannot estimate the parameters.
        ImportError: scipy or numba is missing.
    """
    match name:
        case "oem":
            from emb_bench.estimate import output_error

            return output_error.estimate(bench, plant, records, asked, starts=starts, seed=seed)
        case "pem":
            from emb_bench.estimate import prediction_error

            return prediction_error.estimate(bench, plant, records, asked, starts=starts, seed=seed)
        case "rls":
            from emb_bench.estimate import least_squares

            return least_squares.estimate(bench, plant, records, asked)
        case "ensemble":
            from emb_bench.estimate import ensemble

            return ensemble.estimate(bench, plant, records, asked, starts=starts, seed=seed)
    raise UsageError(f"no method is called '{name}'; expected one of {', '.join(METHODS)}")
