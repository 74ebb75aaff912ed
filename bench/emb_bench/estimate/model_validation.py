"""Model validation: residual tests of the model, before any number is used.

With the noise of the bench file three statistics have a known distribution under the right model:

- *Size*: the sum of squares of the residuals is χ² with as many degrees of freedom as samples less unknowns.
- *Independence of the input*: an F test of the residuals' regression on the currents of the last periods, projected
  orthogonally to the model's sensitivities, which the fit has used up. Only currents before a sample count: under
  feedback later currents depend on the sample. The test stays valid if the noise is larger than in the bench file.
- *Whiteness*: Ljung and Box, On a measure of lack of fit in time series models, Biometrika 65, 1978.

An output-error estimator is consistent under coloured measurement noise: for it the whiteness test is a note, and the
first two raise an alarm (Ljung, System Identification, 2nd ed., section 16.6). For an estimator that whitens the
residuals, all three raise an alarm. The disturbance that it estimates for this is a note: it is part of its model.

Rao's score test finds effects that the model lacks: it projects the residuals on the sensitivity to an effect,
orthogonal to the sensitivities of the unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from emb_bench.brake.motion import Floats
from emb_bench.estimate.effects import Prediction, Simulation
from emb_bench.estimate.prediction import Problem, by_experiment
from emb_bench.estimate.records import OUTPUTS, Disturbance, Independence, ModelValidation, Whiteness
from emb_bench.estimate.suspects import DEPENDENT, cause, score

Bools = NDArray[np.bool_]


LEVEL = 0.01  # False-alarm probability of all tests together
LAGS = 10  # Lagged currents of the independence test
NEIGHBOURS = 20  # Lags of the whiteness test


def validate(
    problem: Problem,
    z: Floats,
    weights: Sequence[Floats],
    found: tuple[Floats, Floats],
    disturbance: Disturbance | None = None,
    prediction: Prediction | None = None,
) -> ModelValidation:
    """Residual tests at an estimate ``z``, where residuals and their derivatives to z are ``found``.

    The ``disturbance`` is that of an estimator that whitens the residuals; ``prediction`` is the simulation by default.
    """
    counts = np.concatenate([root.ravel() for root in weights]) > 0.0
    every, jacobian = found
    residuals = by_experiment(every, weights)
    e = every[: len(counts)]
    model, squares = _basis(jacobian), float(every @ every)
    freedom = int(counts.sum()) - model.shape[1]
    count = sum(experiment.gap_unknowns for experiment in problem.experiments)
    if count and prediction is None:  # a filter has no unknowns in gaps
        gaps = problem.gap_basis(z, weights)
        freedom -= taken(gaps, len(e))
        model = np.concatenate([model, gaps], axis=1)
        squares -= float(np.sum(every[len(every) - count :] ** 2))
    freedom = max(freedom, 1)
    chi2 = float(e @ e)
    share = _share(disturbance)
    expected = special.chdtri(freedom, [1 - share, share]) / freedom
    outputs = [n for n, name in enumerate(OUTPUTS) if counts.reshape(-1, 2)[:, n].any()]
    whiteness = {
        OUTPUTS[n]: _whiteness([r[:, n] for r in residuals], [w[:, n] > 0.0 for w in weights]) for n in outputs
    }
    independence = {OUTPUTS[n]: _independence(problem, n, every, squares, counts, model, freedom) for n in outputs}
    at = prediction or Simulation(problem, z, weights)
    disturbed = disturbance is not None and disturbance.p_value < share
    low, high = expected.tolist()
    tested = ModelValidation(
        chi2,
        freedom,
        (low, high),
        float(special.chdtrc(freedom, chi2)),
        whiteness,
        independence,
        *score(problem, z, found, model, at, chi2 / freedom, disturbed=disturbed),
    )
    decided = _with_alarms(tested, disturbance)
    return replace(decided, cause=cause(decided, problem.bench.machine))


def _share(disturbance: Disturbance | None) -> float:
    """False-alarm probability of one test."""
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


def _with_alarms(m: ModelValidation, disturbance: Disturbance | None) -> ModelValidation:
    """The validation with the tests that reject the model."""
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
    """Degrees of freedom of the gap unknowns: of each the part that the samples, and not the prior, determine.

    ``gaps`` is an orthonormal basis of their columns, shape (m, gaps); its first rows are the samples.
    """
    return round(float(np.sum(gaps[:samples] ** 2)))


def _basis(columns: Floats) -> Floats:
    """Orthonormal basis of a column space, to the numerical rank."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns[:, lengths > 0.0] / lengths[lengths > 0.0]
    if not scaled.shape[1]:
        return np.zeros((len(columns), 0))
    vectors, values, _ = np.linalg.svd(scaled, full_matrices=False)
    result: Floats = vectors[:, values > 1e-9 * values[0]]
    return result


def _whiteness(series: Sequence[Floats], counts: Sequence[Bools]) -> Whiteness:
    """Ljung-Box test of several experiments; pairs with a lost sample do not count."""
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
    """F test of an output; ``squares`` is the residual sum of squares without those of the gap unknowns."""
    past = np.concatenate([lagged(experiment.currents, LAGS) for experiment in problem.experiments])
    columns = np.zeros((len(past), 2, LAGS))
    columns[:, output] = past
    regressors = np.zeros((len(e), LAGS))
    regressors[: len(counts)] = columns.reshape(-1, LAGS) * counts[:, None]
    lengths = np.linalg.norm(regressors, axis=0)
    scaled = regressors / np.where(lengths > 0.0, lengths, 1.0)
    beside = scaled - model @ (model.T @ scaled)
    vectors, values, _ = np.linalg.svd(beside, full_matrices=False)
    basis = vectors[:, values > DEPENDENT]
    seen = counts.reshape(-1, 2)[:, output]
    correlations = [_correlation(e[: len(counts)].reshape(-1, 2)[seen, output], past[seen, lag]) for lag in range(LAGS)]
    lag = int(np.argmax(np.abs(correlations)))
    explained, rank = float(np.sum((basis.T @ e) ** 2)), basis.shape[1]
    rest = freedom - rank
    if rank == 0 or rest <= 0:
        return Independence(0.0, 1.0, correlations[lag], lag)
    statistic = (explained / rank) / max((squares - explained) / rest, 1e-300)
    return Independence(statistic, float(special.fdtrc(rank, rest, statistic)), correlations[lag], lag)


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0
