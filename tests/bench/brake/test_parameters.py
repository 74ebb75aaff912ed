"""The table of parameters: complete, and each row usable by all that read it."""

from __future__ import annotations

import numpy as np

from emb_bench.brake.parameters import FEATURES, PARAMETERS, scale
from emb_bench.config.plants import Mechanics

SHAPING = {"solver", "stribeck_exponent", "hysteresis_travel"}  # say how, not how much


def test_each_feature_of_the_mechanics_has_a_row() -> None:
    assert set(Mechanics._fields) - SHAPING - set(PARAMETERS) == set()
    assert set(FEATURES) < set(Mechanics._fields)


def test_each_row_has_what_its_readers_take() -> None:
    for name, row in PARAMETERS.items():
        assert row.unit, name
        assert row.low <= row.start <= row.high or row.start == 0.0, name
        assert row.low < row.high or name not in FEATURES, name
        assert bool(row.effect) == bool(row.remedy), name
        assert row.step == 0.0 or name in FEATURES, name
        assert row.gross > 0.0, name


def test_the_scale_is_the_value_of_a_relative_parameter_and_one_of_an_absolute_one() -> None:
    np.testing.assert_array_equal(scale(["k_m", "delay", "play"], [0.02, 0.3, 0.5]), [0.02, 1.0, 0.5])
