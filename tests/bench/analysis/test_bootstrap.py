from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from emb_bench.analysis import bootstrap as module
from emb_bench.analysis.bootstrap import bootstrap
from emb_bench.config.bench import Bench
from emb_bench.estimate.methods import method_of, refit
from emb_bench.estimate.records import Estimate, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_runtime.errors import UsageError

from tests.bench.flows import square  # isort: skip
from tests.bench.measurements import fit, record  # isort: skip

CURRENTS = square(15, 3.0)[:90]


def runs(bench: Bench, spread: float = 0.0, count: int = 4) -> list[Experiment]:
    """Runs of brakes whose k_m differs by ``spread`` from one to the next, symmetrically around nominal."""
    shares = 1.0 + spread * (np.arange(count) - 0.5 * (count - 1))
    brakes = [bench.brake._replace(k_m=bench.brake.k_m * share) for share in shares.tolist()]
    return [record(bench, bench.plant("exact"), CURRENTS, brake=p, seed=n) for n, p in enumerate(brakes)]


def estimated(bench: Bench, records: Sequence[Experiment], params: tuple[str, ...], *nuisances: str) -> Estimate:
    return fit(bench, "exact", records, EstimationProblem(params, nuisances))


def test_of_runs_that_differ_by_noise_only_it_says_what_the_fisher_information_says(bench: Bench) -> None:
    e = estimated(bench, runs(bench), ("k_m", "f_v"))
    found = bootstrap(e, draws=300, seed=0)
    assert found.labels == ("k_m", "f_v")
    assert found.values.shape == (300, 2)
    assert found.failed == 0
    ratios = found.deviations / (e.cramer_rao() * e.values)
    assert (ratios > 0.2).all()
    assert (ratios < 1.6).all()
    assert (found.intervals[:, 0] < e.values).all()
    assert (e.values < found.intervals[:, 1]).all()


def test_of_runs_that_differ_by_more_it_says_how_much(bench: Bench) -> None:
    """Four equally informative runs: the estimate is their mean, whose bootstrap deviation is known."""
    spread, count = 1e-3, 4
    e = estimated(bench, runs(bench, spread, count), ("k_m",))
    found = bootstrap(e, draws=1000, seed=1)
    expected = spread * np.std(np.arange(count)) / count**0.5 * bench.brake.k_m
    assert found.deviations[0] == pytest.approx(expected, rel=0.1)
    assert found.deviations[0] > 20.0 * e.cramer_rao()[0] * e.values[0]
    low, high = found.intervals[0]
    assert high - low == pytest.approx(2.0 * 1.96 * expected, rel=0.2)


def test_only_what_the_runs_share_is_drawn(bench: Bench) -> None:
    e = estimated(bench, runs(bench, count=3), ("x1_0", "k_m"), "offset")
    found = bootstrap(e, draws=20, seed=0)
    assert found.labels == ("k_m",)
    assert found.values.mean() == pytest.approx(bench.brake.k_m, rel=1e-3)


def test_every_draw_is_estimated_by_the_same_method(bench: Bench) -> None:
    plant, records = bench.plant("exact"), runs(bench, count=3)
    e = method_of("rls")(bench, plant, EstimationProblem(("k_m", "f_v"))).fit(records)
    found = bootstrap(e, draws=60, seed=0)
    alone = [method_of("rls")(bench, plant, EstimationProblem(("k_m", "f_v"))).fit([r] * 3).values for r in records]
    for values in alone:  # three times the same run is one draw in 27
        assert np.isclose(found.values, values, rtol=1e-9).all(axis=1).any()


def test_draws_that_end_in_no_minimum_are_counted_and_left_out(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    e = estimated(bench, runs(bench, count=3), ("k_m",))
    draws = np.sort(np.random.default_rng(0).integers(0, 3, (50, 3)), axis=1)
    lost = int((draws == [0, 0, 0]).all(axis=1).sum() + (draws == [0, 0, 1]).all(axis=1).sum())

    def fails_of_mostly_the_first(e: Estimate, chosen: Sequence[int]) -> Estimate:
        again = refit(e, chosen)
        failed = list(chosen).count(0) > 1 and 2 not in chosen
        return replace(again, ends=tuple(replace(end, converged=not failed) for end in again.ends))

    monkeypatch.setattr(module, "refit", fails_of_mostly_the_first)
    found = bootstrap(e, draws=50, seed=0)
    assert found.failed == lost > 0
    assert len(found.values) == 50 - lost


def test_too_few_runs_or_draws_are_refused(bench: Bench) -> None:
    for count, params, draws in ((2, ("k_m",), 10), (3, ("k_m",), 1), (3, ("x1_0",), 10)):
        with pytest.raises(UsageError):
            bootstrap(estimated(bench, runs(bench, count=count), params), draws=draws, seed=0)
