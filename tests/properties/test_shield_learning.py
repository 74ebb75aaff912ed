"""The learning shield holds the limits, and what it knows holds the truth: by a slice of the search that tries both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emb_bench.config.bench import load_bench
from tests.properties.learning_mutants import MUTANTS, broken
from tests.properties.learning_search import episodes, search, setting_for

BENCH = load_bench()


@pytest.mark.parametrize("flow", [True, False], ids=["flow", "euler"])
def test_the_truth_is_always_among_what_is_known_and_every_limit_is_held(flow: bool) -> None:
    found = search(setting_for(BENCH, flow), BENCH, 500, seed=11)
    wrong = found.outside | found.falsified | found.violated | found.away
    assert not wrong.any(), found.describe(int(np.flatnonzero(wrong)[0]))
    assert np.median(found.known) < -2.0  # nats that the box of parameters has lost


def test_noise_beyond_its_bound_is_found_out_or_leaves_the_truth_outside() -> None:
    found = search(setting_for(BENCH, True, excess=1.05), BENCH, 500, seed=11)
    assert (found.outside | found.falsified).sum() > 50


# Each is compiled anew: one with each change of code, the others at night.
@pytest.mark.parametrize(
    "name", ["bend", *(pytest.param(n, marks=pytest.mark.slow) for n in ("spring", "lost", "velocity"))]
)
def test_a_learner_with_a_pad_left_out_is_found_to_be_unsound(name: str) -> None:
    mutant = MUTANTS[name]
    setting = setting_for(BENCH, mutant.flow)
    found = search(setting, BENCH, 500, seed=11, run=broken(mutant, episodes))
    assert (found.outside | found.falsified).any()


def test_an_error_of_the_model_that_is_declared_is_one_that_the_brake_may_have() -> None:
    declared = replace(BENCH, shield=BENCH.shield._replace(model_error=200.0, current_error=0.1))
    found = search(setting_for(declared, flow=True), declared, 500, seed=11)
    assert not (found.outside | found.falsified | found.violated).any()
