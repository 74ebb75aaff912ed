"""Model validation: tests of whether the model explains the experiment, before any number is used.

With the bench's noise known, three questions have a distribution under the right model:

- *How large* are the residuals: their sum of squares is χ² with as many degrees of freedom as samples less unknowns.
- *Do they follow from the input*: the currents of the last periods explain no more of them than chance lets them, an F
  test on the residuals and on what is left of the lagged currents beside the model's own sensitivities, whose part the
  fit has already taken out. Only currents that acted before a sample count: under feedback later ones depend on it. It
  is a question of shape and holds if the noise is larger than the bench says.
- *Do they follow from each other*: Ljung and Box, On a measure of lack of fit in time series models, Biometrika 65,
  1978.

An output-error estimator is consistent under coloured measurement noise, so that for it the third is a note, and the
first two raise an alarm (Ljung, System Identification, 2nd ed., section 16.6). One that whitens the residuals is
alarmed by the third as well. The disturbance that it needs to do so is a note: it belongs to its model.

What the model may lack is looked for with Rao's score test: the residuals along the sensitivity to an effect that was
not estimated, beside those that were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from emb_bench.brake.motion import Floats
from emb_bench.estimate.effects import Shown, Simulated
from emb_bench.estimate.prediction import Problem, by_experiment
from emb_bench.estimate.records import OUTPUTS, Disturbance, Independence, ModelValidation, Whiteness
from emb_bench.estimate.suspects import DEPENDENT, cause, score

Bools = NDArray[np.bool_]


LEVEL = 0.01  # Chance of a false alarm of all tests together
LAGS = 10  # Periods back in which a current may still show in a residual
NEIGHBOURS = 20  # Lags at which residuals are compared with each other


def examine(
    problem: Problem,
    z: Floats,
    weights: Sequence[Floats],
    found: tuple[Floats, Floats],
    disturbance: Disturbance | None = None,
    shown: Shown | None = None,
) -> ModelValidation:
    """Compare residuals at an estimate, ``found`` with their derivatives to z, with what the right model would leave.

    The ``disturbance`` is that of an estimator that whitens them, ``shown`` what is shown at the estimate; without, the
    simulation.
    """
    counts = np.concatenate([root.ravel() for root in weights]) > 0.0
    every, jacobian = found
    residuals = by_experiment(every, weights)
    e = every[: len(counts)]
    model, whole = _basis(jacobian), float(every @ every)
    freedom = int(counts.sum()) - model.shape[1]
    count = sum(experiment.gap_unknowns for experiment in problem.experiments)
    if count and shown is None:  # a filter has no unknowns in gaps
        gaps = problem.gap_basis(z, weights)
        freedom -= taken(gaps, len(e))
        model = np.concatenate([model, gaps], axis=1)
        whole -= float(np.sum(every[len(every) - count :] ** 2))
    freedom = max(freedom, 1)
    chi2 = float(e @ e)
    share = _share(disturbance)
    expected = special.chdtri(freedom, [1 - share, share]) / freedom
    outputs = [n for n, name in enumerate(OUTPUTS) if counts.reshape(-1, 2)[:, n].any()]
    whiteness = {
        OUTPUTS[n]: _whiteness([r[:, n] for r in residuals], [w[:, n] > 0.0 for w in weights]) for n in outputs
    }
    independence = {OUTPUTS[n]: _independence(problem, n, every, whole, counts, model, freedom) for n in outputs}
    seen = shown or Simulated(problem, z, weights)
    disturbed = disturbance is not None and disturbance.p_value < share
    low, high = expected.tolist()
    tested = ModelValidation(
        chi2,
        freedom,
        (low, high),
        float(special.chdtrc(freedom, chi2)),
        whiteness,
        independence,
        *score(problem, z, found, model, seen, chi2 / freedom, disturbed=disturbed),
    )
    judged = _judged(tested, disturbance)
    return replace(judged, cause=cause(judged, problem.bench.machine))


def _share(disturbance: Disturbance | None) -> float:
    """Chance with which one question alone puts what the right model leaves outside of what is expected."""
    return LEVEL / (2 if disturbance is None else 4)


def significant(p_values: Mapping[str, float]) -> frozenset[str]:
    """Names of the tests that raise an alarm.

    Of m tests sorted by their p values the first k do, for the largest k with p_k <= k/m LEVEL (Simes, Biometrika 73,
    1986; Benjamini and Hochberg 1995): several small ones count together, and with the right model there is any alarm
    with a chance of LEVEL, all tests taken together.
    """
    ordered = sorted(p_values.items(), key=lambda pair: pair[1])
    count = 0
    for k, (_, p) in enumerate(ordered, start=1):
        if p <= k / len(ordered) * LEVEL:
            count = k
    return frozenset(name for name, _ in ordered[:count])


def _judged(m: ModelValidation, disturbance: Disturbance | None) -> ModelValidation:
    """Tests with those that reject the model."""
    tests = {"size": m.chi2_p} | {f"current of {name}": test.p_value for name, test in m.independence.items()}
    tests |= {f"score of {suspect.name}": suspect.p_value for suspect in m.suspects}
    if m.together is not None:
        tests["scores"] = m.together.p_value
    if disturbance is not None:
        tests |= {f"whiteness of {name}": test.p_value for name, test in m.whiteness.items()}
    alarming, share = significant(tests), _share(disturbance)
    coloured = (
        n
        for n, test in m.whiteness.items()
        if (test.p_value < share / len(m.whiteness) if disturbance is None else f"whiteness of {n}" in alarming)
    )
    return replace(
        m,
        alarming=alarming,
        coloured=tuple(coloured),
        disturbance=disturbance if disturbance is not None and disturbance.p_value < share else None,
    )


def taken(gaps: Floats, samples: int) -> int:
    """Degrees of freedom that the unknowns of gaps take: as much of each as the samples, and not an assumption, tell.

    The orthonormal basis of what the gaps explain, shape (m, gaps), begins with the numbers measured.
    """
    return round(float(np.sum(gaps[:samples] ** 2)))


def _basis(columns: Floats) -> Floats:
    """Orthonormal basis of a column space, without directions that rounding makes up."""
    lengths = np.linalg.norm(columns, axis=0)
    kept = columns[:, lengths > 0.0] / lengths[lengths > 0.0]
    if not kept.shape[1]:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(kept, full_matrices=False)
    result: Floats = left[:, values > 1e-9 * values[0]]
    return result


def _whiteness(series: Sequence[Floats], counts: Sequence[Bools]) -> Whiteness:
    """Ljung-Box of several experiments; a pair of which one sample was lost does not count."""
    lags = min(NEIGHBOURS, max(1, min(len(s) for s in series) // 5))
    total = float(sum(np.sum(s**2) for s in series))
    n = int(sum(np.sum(c) for c in counts))
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = int(sum(np.sum(c[lag:] & c[:-lag]) for c in counts))
        product = float(sum(np.sum(s[lag:] * s[:-lag]) for s in series))
        if pairs and total > 0.0:
            statistic += n * (n + 2) * (product / total) ** 2 / pairs
    return Whiteness(statistic, lags, float(special.chdtrc(lags, statistic)))


def lagged(currents: Floats, lags: int) -> Floats:
    """The current of each period and of those before it, zero before the first one, shape (n, lags)."""
    result = np.zeros((len(currents), lags))
    for lag in range(min(lags, len(currents))):
        result[lag:, lag] = currents[: len(currents) - lag]
    return result


def _independence(
    problem: Problem, output: int, e: Floats, squares: float, counts: Bools, model: Floats, freedom: int
) -> Independence:
    """F test of an output; ``squares`` is the sum of squares of the residuals but for those of unknown currents."""
    past = np.concatenate([lagged(experiment.currents, LAGS) for experiment in problem.experiments])
    own = np.zeros((len(past), 2, LAGS))
    own[:, output] = past
    regressors = np.zeros((len(e), LAGS))
    regressors[: len(counts)] = own.reshape(-1, LAGS) * counts[:, None]
    lengths = np.linalg.norm(regressors, axis=0)
    scaled = regressors / np.where(lengths > 0.0, lengths, 1.0)
    beside = scaled - model @ (model.T @ scaled)
    left, values, _ = np.linalg.svd(beside, full_matrices=False)
    kept = left[:, values > DEPENDENT]
    seen = counts.reshape(-1, 2)[:, output]
    correlations = [_correlation(e[: len(counts)].reshape(-1, 2)[seen, output], past[seen, lag]) for lag in range(LAGS)]
    lag = int(np.argmax(np.abs(correlations)))
    explained, rank = float(np.sum((kept.T @ e) ** 2)), kept.shape[1]
    rest = freedom - rank
    if rank == 0 or rest <= 0:
        return Independence(0.0, 1.0, correlations[lag], lag)
    statistic = (explained / rank) / max((squares - explained) / rest, 1e-300)
    return Independence(statistic, float(special.fdtrc(rank, rest, statistic)), correlations[lag], lag)


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0
