"""Compiled for the batch, estimator and speed loop have the bits of plain Python."""

from __future__ import annotations

from emb_bench.compiled import compiled
from emb_runtime.config.bench import load_bench
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.kalman import believed, follow, initial_state
from emb_runtime.estimator.speed_loop import current_for

BENCH = load_bench()
SAMPLES = [(0.0, 0.3, 0.0, 0.0), (0.02, 15.0, 1.0, 6.0), (0.4, 80.0, 6.0, 6.0), (0.45, 60.0, 7.0, -6.0)]


def test_compiled_for_the_batch_it_has_the_same_bits() -> None:
    for derived in (False, True):
        model = Estimator(BENCH).model._replace(derived=derived)
        plain = fast = initial_state(model)
        for sample in SAMPLES:
            plain, fast = follow(model, plain, *sample), compiled(follow)(model, fast, *sample)
            assert plain == fast
            for speed in (120.0, -3.0):
                asked = model, plain, believed(model, plain), speed, 0.4
                assert current_for(*asked) == compiled(current_for)(*asked)
