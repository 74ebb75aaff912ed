from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from emb_bench.analysis.several_runs import FEWEST, random_walk, smoothed

WALKS = (0.0, 0.3, 1.0, 3.0)  # Of the simulated number, in the deviation of a measurement, per root of an hour


@pytest.mark.parametrize("walk", WALKS)
def test_it_is_the_gaussian_posterior_of_all_measurements_at_once(walk: float) -> None:
    """Covariance of a walk q² min(t, t'), and a start of which next to nothing is known."""
    rng = np.random.default_rng(1)
    t, y, variances = np.cumsum(rng.uniform(0.1, 3.0, 9)), rng.standard_normal(9), rng.uniform(0.2, 2.0, 9) ** 2
    vague = 1e6
    before = walk**2 * np.minimum.outer(t - t[0], t - t[0]) + vague
    whole = before + np.diag(variances)
    (mean, _), (variance, _), (likelihood, reference) = smoothed(t, y, variances, np.array([walk, 0.7]))
    assert mean == pytest.approx(before @ np.linalg.solve(whole, y), abs=1e-5)
    assert variance == pytest.approx(np.diag(before - before @ np.linalg.solve(whole, before)), rel=1e-4)
    expected = stats.multivariate_normal(np.zeros(9), whole).logpdf(y) + 0.5 * np.log(vague)
    other = reference - (
        stats.multivariate_normal(
            np.zeros(9), 0.7**2 * np.minimum.outer(t - t[0], t - t[0]) + vague + np.diag(variances)
        ).logpdf(y)
        + 0.5 * np.log(vague)
    )
    assert likelihood - expected == pytest.approx(other, abs=1e-4)


@pytest.mark.parametrize("walk", WALKS)
@pytest.mark.parametrize("runs", [6, 30])
def test_its_intervals_cover_what_was_simulated(walk: float, runs: int) -> None:
    rng, draws = np.random.default_rng(7), 150
    shares = []
    for _ in range(draws):
        hours = np.cumsum(rng.exponential(1.0, runs))
        deviations = rng.uniform(0.5, 1.5, runs)
        true = np.cumsum(walk * np.sqrt(np.diff(hours, prepend=hours[0])) * rng.standard_normal(runs))
        found = random_walk(
            hours.tolist(), (true + deviations * rng.standard_normal(runs)).tolist(), deviations.tolist()
        )
        assert found is not None
        low, high = found.ends.T
        shares.append(np.mean((low <= true) & (true <= high)))
    uncertain = 4.0 * float(np.std(shares)) / draws**0.5
    assert 0.94 - uncertain < np.mean(shares) < 0.975 + uncertain


def test_the_order_of_the_runs_does_not_matter_and_few_runs_have_no_trend() -> None:
    hours, values, deviations = [3.0, 0.0, 7.0, 1.0, 4.0], [2.0, 0.5, 3.0, 1.0, 2.2], [0.3, 0.2, 0.4, 0.2, 0.3]
    found = random_walk(hours, values, deviations)
    order = np.argsort(hours)
    ordered = random_walk(*([one[i] for i in order] for one in (hours, values, deviations)))
    assert found is not None
    assert ordered is not None
    assert found.values[order] == pytest.approx(ordered.values)
    assert found.hours.tolist() == [3.0, 0.0, 7.0, 1.0, 4.0]
    assert random_walk(hours[: FEWEST - 1], values[: FEWEST - 1], deviations[: FEWEST - 1]) is None
    assert random_walk([1.0] * 5, values, deviations) is None
