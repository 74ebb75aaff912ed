"""Outliers are counted, said, and move no parameter by more than its interval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emb_bench.config.bench import Bench
from emb_bench.estimate.output_error import few, outliers
from emb_bench.experiment.experiment import Experiment
from emb_bench.report.caveats import caveats

from tests.bench.measurements import currents_of, fit, record  # isort: skip


def with_jumps(data: Experiment, *jumps: tuple[int, int, float]) -> Experiment:
    """The record whose samples show some more at some places: sample, output, and by how much."""
    samples = data.samples.copy()
    for k, output, by in jumps:
        samples[k, output] += by
    return replace(data, samples=samples)


@pytest.mark.parametrize("jump", [(250, 0, 5.0), (3, 0, -5.0), (400, 1, 100.0), (499, 0, 0.05)])
def test_a_jump_of_one_sample_moves_no_parameter_by_more_than_its_interval(
    bench: Bench, jump: tuple[int, int, float]
) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=2)
    clean, found = fit(bench, plant, [data]), fit(bench, plant, [with_jumps(data, jump)])
    assert found.validation.fits
    assert found.experiments[0].outliers == 1
    assert len(caveats(found)) == 1
    low, high = clean.intervals().T
    assert ((low < found.values) & (found.values < high)).all()
    assert caveats(clean) == []


def test_many_samples_apart_are_no_outliers_but_a_record_that_does_not_fit(bench: Bench) -> None:
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp"), seed=2)
    found = fit(bench, plant, [with_jumps(data, *((k, 0, 0.1) for k in range(50, 450, 40)))])
    assert found.experiments[0].outliers == 0
    assert not found.validation.fits


def test_noise_that_is_larger_than_the_bench_says_is_not_outlying() -> None:
    errors = 3.0 * np.random.default_rng(0).standard_normal((500, 2))
    assert not outliers(errors, np.ones((500, 2), np.bool_)).any()


def test_what_does_not_count_is_no_outlier_and_a_short_record_has_none() -> None:
    errors, counts = np.zeros((100, 2)), np.ones((100, 2), np.bool_)
    errors[50], counts[50] = 1e6, False
    errors[70, 1] = -9.0
    assert np.flatnonzero(outliers(errors, counts)).tolist() == [70]
    assert not outliers(1e6 * np.eye(8, 2), np.ones((8, 2), np.bool_)).any()
    assert not few([np.zeros(500, np.bool_)])
    assert few([np.arange(500) < 5])
    assert not few([np.arange(500) < 6])
