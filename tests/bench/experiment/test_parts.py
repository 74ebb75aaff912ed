"""An experiment in parts: nothing is lost or counted twice, and each part starts where the one before ended."""

from __future__ import annotations

import numpy as np

from emb_bench.experiment.experiment import Experiment

N = 23
ASSUMED = np.where(np.isin(np.arange(N), [3, 7, 8, 9, 22]), 0.5, np.nan)


def whole() -> Experiment:
    samples = np.stack([np.arange(1.0, N + 1), np.arange(N) / 7.0], axis=1)
    currents, late = np.sin(np.arange(N)), 1e-6 * np.arange(N, dtype=np.float64)
    return Experiment("x", currents, samples, 0.25, 0.5, 1e-3, False, late, ASSUMED, before=2.0, first=(0.3, 0.6))


def test_parts_follow_each_other() -> None:
    x = whole()
    parts = [*x.split(8)]
    assert [part.periods for part in parts] == [8, 8, 7]
    for name in ("currents", "samples", "late", "assumed"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(x, name))
    assert [(p.before, p.angle, p.velocity, p.first) for p in parts] == [
        (2.0, 0.25, 0.5, (0.3, 0.6)),
        *((float(x.currents[k - 1]), *x.samples[k - 1], tuple(x.samples[k - 1])) for k in (8, 16)),
    ]
    assert [p.slack for p in parts] == [1e-3, 0.0, 0.0]
    np.testing.assert_array_equal(x.until(9).samples, x.samples[:9])


def test_gaps_of_one_period_and_of_several() -> None:
    x = whole()
    assert [gap.tolist() for gap in x.gaps] == [[3, 22], [9]]
    assert np.flatnonzero(x.inside).tolist() == [7, 8]
    assert x.gap_unknowns == 4
    assert np.flatnonzero(~x.reported).tolist() == [3, 7, 8, 9, 22]
    assert x.until(9).gap_unknowns == 3  # a gap that the end cuts to two periods is one of several all the same


def test_a_lost_sample_is_no_measurement_and_its_period_stays_known() -> None:
    x = whole()
    mask = np.zeros(N, np.bool_)
    mask[[4, 5]] = True
    lost = x.lose(mask)
    assert np.flatnonzero(~lost.measured).tolist() == [4, 5]
    assert lost.outliers == 2
    np.testing.assert_array_equal(lost.currents, x.currents)
    np.testing.assert_array_equal(lost.reported, x.reported)
    assert len(lost.all_samples) == N + 1


def test_a_start_that_may_be_the_origin_is_taken_as_the_origin() -> None:
    x = Experiment("x", np.zeros(2), np.zeros((2, 2)), 0.203, 0.0, 1e-3, False)
    assert x.x0() == (0.203, 0.0)
    assert x.x0(0.2) == (0.0, 0.0)  # within four standard deviations of what the encoder shows there
    assert x.start(0.2)[0] == 0.203 - 0.2
