"""No point of an ellipsoid that a strip allows is cut off."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emb_runtime.config.bench import load_bench
from emb_runtime.learning.assumptions import make_assumptions
from emb_runtime.learning.bounded import CENTRE, SHAPE, _cut_ellipsoid, start
from emb_runtime.learning.known import FALSIFIED


@settings(max_examples=200)
@given(
    seed=st.integers(0, 2**32 - 1),
    strip=st.tuples(*[st.floats(-3.0, 3.0)] * 4),
    middle=st.floats(-1.2, 1.2),
    half=st.floats(0.0, 1.0),
)
def test_what_is_in_the_ellipsoid_and_in_the_strip_is_in_the_ellipsoid_that_is_cut(
    seed: int, strip: tuple[float, float, float, float], middle: float, half: float
) -> None:
    state, rng = start(make_assumptions(load_bench())), np.random.default_rng(seed)
    factor = rng.normal(size=(4, 4)) * 0.05
    centre, shape = 1.0 + 0.05 * rng.normal(size=4), factor @ factor.T
    state[CENTRE : CENTRE + 4] = centre.tolist()
    state[SHAPE : SHAPE + 10] = shape[np.triu_indices(4)].tolist()
    phi = np.array(strip)
    reach = math.sqrt(phi @ shape @ phi)
    assume(reach > 1e-3)
    low, high = phi @ centre + reach * (middle - half), phi @ centre + reach * (middle + half)
    directions = rng.normal(size=(4, 2000))
    points = centre[:, None] + factor @ (directions / np.linalg.norm(directions, axis=0) * rng.random(2000) ** 0.25)
    kept = points[:, (phi @ points >= low) & (phi @ points <= high)]
    _cut_ellipsoid(state, *strip, float(low), float(high))
    if state[FALSIFIED]:
        assert kept.shape[1] == 0
        return
    cut = np.zeros((4, 4))
    cut[np.triu_indices(4)] = state[SHAPE : SHAPE + 10]
    cut = cut + np.triu(cut, 1).T
    off = kept - np.array(state[CENTRE : CENTRE + 4])[:, None]
    assert np.all(np.sum(off * np.linalg.solve(cut, off), axis=0) <= 1.0 + 1e-6)
    assert np.linalg.det(cut) <= np.linalg.det(shape) * (1.0 + 1e-6)
