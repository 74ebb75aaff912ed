"""Bootstrap over runs: variation of the estimate with the choice of runs.

Whole records are drawn again with replacement and estimated anew (Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, chapter 6). Nothing is assumed about the noise, and what differs from run to run, a temperature or a
homing, shows, as it does not in an information matrix. Few records make it too narrow, by about the root of
(n - 1) / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.methods import refit
from emb_bench.estimate.records import Estimate
from emb_runtime.errors import UsageError

LEAST = 3  # Least number of records for a bootstrap


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Distribution of the estimate over records drawn again with replacement."""

    labels: tuple[str, ...]  # The unknowns that the records share
    values: Floats  # Estimates of the draws that succeeded, SI units, shape (draws - failed, len(labels))
    intervals: Floats  # 95 % percentile intervals, SI units, shape (len(labels), 2)
    deviations: Floats  # Standard deviations, SI units, shape (len(labels),)
    failed: int  # Draws whose search did not end in a minimum


def bootstrap(e: Estimate, *, draws: int, seed: int) -> Bootstrap:
    """Draw the records again and again, and estimate each time by the same method.

    Args:
        e: the estimate.
        draws: how often; at least 2.
        seed: of the random numbers.

    Raises:
        UsageError: fewer than ``LEAST`` records, too few draws, nothing that the records share, or all draws failed.
    """
    n = len(e.records)
    if n < LEAST:
        raise UsageError(
            f"a bootstrap over runs needs at least {LEAST} records, got {n}: give more logs, or leave it out"
        )
    if draws < 2:
        raise UsageError(f"expected at least 2 draws of a bootstrap, got {draws}")
    index = [i for i in e.shared() if i in e.wanted()]
    if not index:
        raise UsageError("a bootstrap over runs is of what the records share: nothing that is estimated is")
    rng = np.random.default_rng(seed)
    known: dict[tuple[int, ...], Floats | None] = {}  # the order of records does not matter
    found = []
    for _ in range(draws):
        chosen = tuple(sorted(rng.integers(0, n, n).tolist()))
        if chosen not in known:
            again = refit(e, chosen)
            known[chosen] = again.values[index] if again.ends[0].converged else None
        found.append(known[chosen])
    values = np.array([v for v in found if v is not None])
    if len(values) < 2:
        raise UsageError(f"{draws - len(values)} of {draws} draws of the bootstrap did not end in a minimum")
    return Bootstrap(
        labels=tuple(e.labels[i] for i in index),
        values=values,
        intervals=np.quantile(values, [0.025, 0.975], axis=0).T,
        deviations=values.std(axis=0, ddof=1),
        failed=draws - len(values),
    )
