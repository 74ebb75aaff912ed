"""Estimator and speed loop, against an independent implementation of the same: that of commit c2c9e5a.

It worked on one row of numbers in place, without a branch.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from emb_runtime.estimator.kalman import MISFIT, State, believed, deviations, follow, make_model
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.estimator.stick_slip import Accelerations, contact, move, sign
from tests.benches import SENSOR_BENCH

FROZEN = json.loads((Path(__file__).parent / "frozen.json").read_text(encoding="utf-8"))
BENCH = SENSOR_BENCH


def test_a_period_is_the_frozen_one() -> None:
    for (pull, coulomb, damping, spring, *state), expected in FROZEN["move"]:
        # Its kinks reached 12 standard deviations far and no farther.
        found = list(move(Accelerations(pull, coulomb, damping, spring), *state))
        assert found == pytest.approx(expected, rel=0.0, abs=1e-30)
    for arguments, expected in FROZEN["contact"]:
        assert list(contact(*arguments)) == expected
    assert [sign(v) for v in (-2.0, 0.0, 3.0)] == [-1.0, 0.0, 1.0]


def test_an_estimate_and_its_current_are_the_frozen_ones() -> None:
    model = make_model(BENCH, BENCH.range_set("pm50"))
    for case in FROZEN["exact"]:
        step, *numbers, innovation, worst = case["before"]
        before = State(step, tuple(numbers[:6]), tuple(numbers[6:]), innovation, worst)
        state = follow(model, before, *case["sample"])
        assert [state.step, *state.mean, *state.covariance, state.innovation, state.worst] == case["after"]
        assert list(believed(model, state)) == case["believed"]
        expected = np.array(case["deviations"])
        if state.worst > MISFIT:
            expected = np.maximum(expected, (np.array(model.high) - model.low) / math.sqrt(12.0))
        assert deviations(model, state, believed(model, state)) == pytest.approx(expected, rel=1e-15)
        assert current_for(model, state, believed(model, state), *case["speed"]) == case["current"]
    assert {case["after"][-1] > MISFIT for case in FROZEN["exact"]} == {True, False}
