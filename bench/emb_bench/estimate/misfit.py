"""Does the model explain the record? To be answered before any number is believed.

With the bench's noise known, three questions have a distribution under the right model:

- *How large* are the residuals: their sum of squares is χ² with as many degrees of freedom as samples less unknowns.
- *Do they follow from the input*: the currents of the last periods explain no more of them than chance lets them, an F
  test on the residuals and on what is left of the lagged currents beside the model's own sensitivities, whose part the
  fit has already taken out. Only currents that acted before a sample count: under feedback later ones depend on it. It
  is a question of shape and holds if the noise is larger than the bench says.
- *Do they follow from each other*: Ljung and Box, On a measure of lack of fit in time series models, Biometrika 65,
  1978.

An output-error estimator is consistent under coloured measurement noise, so that for it the third is a note, and the
first two raise an alarm (Ljung, System Identification, 2nd ed., section 16.6). One that whitens the residuals would
have to be alarmed by the third as well.

What the model may lack is looked for with Rao's score test: the residuals along the sensitivity to an effect that was
not estimated, beside those that were.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from emb_bench.brake.motion import Floats
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Independence, Misfit, Suspect, Whiteness
from emb_runtime.plants import EXACT

Bools = NDArray[np.bool_]

OUTPUTS = ("angle", "velocity")
LEVEL = 0.01
"""Chance of a false alarm of all tests together: half of it for χ², the rest shared by the outputs."""
LAGS = 10
"""Periods back in which a current may still show in a residual."""
NEIGHBOURS = 20
"""Lags at which residuals are compared with each other."""
SUSPECTS = ("delay", "x1_0", "x2_0", "offset", "contact")

_DEPENDENT = 1e-6  # share of a regressor beside the others below which it is one of them


def examine(
    problem: Problem, z: Floats, weights: Sequence[Floats], residuals: Sequence[Floats], jacobian: Floats
) -> Misfit:
    """Compare the residuals at an estimate with what the right model would leave.

    Args:
        problem: records and model.
        z: the estimate.
        weights: inverse standard deviations of the samples of each record, zero where one does not count.
        residuals: of each record, in standard deviations, zero where a sample does not count, shape (n, 2).
        jacobian: derivatives of all residuals, samples first, shape (m, len(z)).
    """
    counts = np.concatenate([root.ravel() for root in weights]) > 0.0
    e = np.concatenate([r.ravel() for r in residuals])
    model = _basis(jacobian[: len(e)])
    freedom = max(int(counts.sum()) - model.shape[1], 1)
    chi2 = float(e @ e)
    expected = stats.chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], freedom) / freedom
    outputs = [n for n, name in enumerate(OUTPUTS) if counts.reshape(-1, 2)[:, n].any()]
    whiteness = {
        OUTPUTS[n]: _whiteness([r[:, n] for r in residuals], [w[:, n] > 0.0 for w in weights]) for n in outputs
    }
    independence = {OUTPUTS[n]: _independence(problem, n, e, counts, model, freedom) for n in outputs}
    suspects = _suspects(problem, z, weights, e, model, chi2 / freedom)
    chi2_p = float(stats.chi2.sf(chi2, freedom))
    alarms, notes = _words(chi2 / freedom, chi2_p, expected, whiteness, independence)
    low, high = expected.tolist()
    return Misfit(chi2, freedom, (low, high), chi2_p, whiteness, independence, suspects, alarms, notes)


def _words(
    ratio: float,
    chi2_p: float,
    expected: Floats,
    whiteness: dict[str, Whiteness],
    independence: dict[str, Independence],
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    alarms, notes = [], []
    large = chi2_p < LEVEL / 2
    depends = [n for n, test in independence.items() if test.p_value < LEVEL / 2 / len(independence)]
    coloured = [n for n, test in whiteness.items() if test.p_value < LEVEL / 2 / len(whiteness)]
    if large:
        why = "" if depends or coloured else ", without any pattern: the noise may be larger than the bench says"
        alarms.append(f"the residuals are too large: chi2/n {ratio:.4g}, at most {expected[1]:.3f} expected{why}")
    for name in depends:
        test = independence[name]
        alarms.append(
            f"the residuals of the {name} follow from the current: F = {test.statistic:.3g}, p = {test.p_value:.1g}, "
            f"largest correlation {test.correlation:+.2f} with the current of {test.lag} periods before"
        )
    if ratio < expected[0]:
        notes.append(
            f"the residuals are smaller than the bench's noise: chi2/n {ratio:.4g}, at least {expected[0]:.3f} "
            "expected: the noise in the bench file, and all uncertainties, are too large"
        )
    for name in coloured:
        white = whiteness[name]
        notes.append(
            f"the residuals of the {name} follow from each other (Ljung-Box {white.statistic:.4g} at {white.lags} "
            f"lags, p = {white.p_value:.1g}): no fault by itself where only the output is disturbed, but "
            "then the deviations from the Fisher information do not hold"
        )
    return tuple(alarms), tuple(notes)


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
    """Ljung-Box of several records; a pair of which one sample was lost does not count."""
    lags = min(NEIGHBOURS, max(1, min(len(s) for s in series) // 5))
    total = float(sum(np.sum(s**2) for s in series))
    n = int(sum(np.sum(c) for c in counts))
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = int(sum(np.sum(c[lag:] & c[:-lag]) for c in counts))
        product = float(sum(np.sum(s[lag:] * s[:-lag]) for s in series))
        if pairs and total > 0.0:
            statistic += n * (n + 2) * (product / total) ** 2 / pairs
    return Whiteness(statistic, lags, float(stats.chi2.sf(statistic, lags)))


def lagged(currents: Floats, lags: int) -> Floats:
    """The current of each period and of those before it, zero before the first one, shape (n, lags)."""
    result = np.zeros((len(currents), lags))
    for lag in range(min(lags, len(currents))):
        result[lag:, lag] = currents[: len(currents) - lag]
    return result


def _independence(problem: Problem, output: int, e: Floats, counts: Bools, model: Floats, freedom: int) -> Independence:
    past = np.concatenate([lagged(record.currents, LAGS) for record in problem.records])
    own = np.zeros((len(past), 2, LAGS))
    own[:, output] = past
    regressors = own.reshape(-1, LAGS) * counts[:, None]
    lengths = np.linalg.norm(regressors, axis=0)
    scaled = regressors / np.where(lengths > 0.0, lengths, 1.0)
    beside = scaled - model @ (model.T @ scaled)
    left, values, _ = np.linalg.svd(beside, full_matrices=False)
    kept = left[:, values > _DEPENDENT]
    seen = counts.reshape(-1, 2)[:, output]
    correlations = [_correlation(e.reshape(-1, 2)[seen, output], past[seen, lag]) for lag in range(LAGS)]
    lag = int(np.argmax(np.abs(correlations)))
    explained, rank = float(np.sum((kept.T @ e) ** 2)), kept.shape[1]
    rest = freedom - rank
    if rank == 0 or rest <= 0:
        return Independence(0.0, 1.0, correlations[lag], lag)
    statistic = (explained / rank) / max((float(e @ e) - explained) / rest, 1e-300)
    return Independence(statistic, float(stats.f.sf(statistic, rank, rest)), correlations[lag], lag)


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0


def _suspects(
    problem: Problem, z: Floats, weights: Sequence[Floats], e: Floats, model: Floats, ratio: float
) -> tuple[Suspect, ...]:
    mechanics = problem.plant.mechanics
    timed = mechanics.solver == EXACT and mechanics.current_lag == 0.0
    names = tuple(n for n in SUSPECTS if n not in problem.asked.names and (n != "delay" or timed))
    columns = []
    for i, root in enumerate(weights):
        s = problem.predict(z, i, names).sensitivities[:, -len(names) :] if names else np.zeros((len(root), 0, 2))
        columns.append((s.transpose(0, 2, 1) * root[:, :, None]).reshape(-1, len(names)))
    found = []
    for name, column in zip(names, np.concatenate(columns).T, strict=True):
        beside = column - model @ (model.T @ column)
        length = float(np.linalg.norm(beside))
        if length > _DEPENDENT * float(np.linalg.norm(column)):
            score = float(beside @ e)
            found.append(Suspect(name, score / length**2, score / length / max(ratio, 1e-300) ** 0.5))
    return tuple(sorted(found, key=lambda suspect: -abs(suspect.sigmas)))
