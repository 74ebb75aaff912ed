"""The search of ``tests/searches/response.py`` in small numbers."""

from __future__ import annotations

import numpy as np
import pytest

from emb_runtime.safety.response import CONTRADICTED
from tests.benches import SENSOR_BENCH
from tests.searches.response import DISHONEST, MUST, VERDICT, beyond, honest, undeclared

BENCH = SENSOR_BENCH


@pytest.mark.parametrize("name", MUST)
def test_no_brake_passes_a_limit_under_a_response_that_is_not_declared(name: str) -> None:
    for scripted in (False, True):
        r = undeclared(BENCH, MUST[name], 100, scripted, np.random.default_rng(7))
        assert not beyond(BENCH, r).any()
        ended = (r[:, VERDICT] == CONTRADICTED) | (r[:, DISHONEST] != 0.0)
        assert np.count_nonzero(ended) >= 95


@pytest.mark.parametrize("plant", ["exact", "late", "lag", "observer"])
def test_the_proof_ends_no_honest_experiment(plant: str) -> None:
    assert not (honest(BENCH, plant, 100, np.random.default_rng(7))[:, VERDICT] == CONTRADICTED).any()
