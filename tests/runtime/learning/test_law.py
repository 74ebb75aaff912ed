"""The law of a part of the set holds every brake of that part, and what the model lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emb_bench.brake.euler import acceleration
from emb_bench.compiled import compiled
from emb_runtime.config.bench import Bench, BrakeParameters, load_bench
from emb_runtime.config.shield_config import shield_config
from emb_runtime.errors import BenchFileError
from emb_runtime.learning.assumptions import make_assumptions
from emb_runtime.learning.law import covered_viscous, law_between
from emb_runtime.safety.shield import successor
from emb_runtime.safety.shield_design import VELOCITY_PAD, ShieldLaw, make_law

BENCH = load_bench()
SET = BENCH.range_set("envelope")


def learning(bench: Bench = BENCH, model_error: float = 0.0) -> Bench:
    return replace(bench, shield=replace(bench.shield, learn="gaussian", model_error=model_error))


def of(low: BrakeParameters, high: BrakeParameters, model_error: float = 0.0) -> ShieldLaw:
    law: ShieldLaw = compiled(law_between)(shield_config(learning(model_error=model_error)), low, high, 0.006, 6.0)
    return law


def change_of_viscous_friction(law: ShieldLaw, viscous: float) -> float:
    """Part of it that the velocity pad has to cover, within a sample of full braking at the limits (L1) [rad/s]."""
    slowed = law.braking + law.spring_low * BENCH.limits.angle[1] + viscous * BENCH.limits.velocity
    return 0.5 * law.sample_time**2 * viscous * slowed


def test_a_part_counts_on_viscous_friction_as_far_as_the_pad_covers_its_change() -> None:
    setting, law = shield_config(BENCH), of(SET.high, SET.high)
    assert change_of_viscous_friction(law, SET.high.f_v / SET.high.J) > VELOCITY_PAD
    assert 0.9 * VELOCITY_PAD < change_of_viscous_friction(law, law.viscous_low) <= VELOCITY_PAD
    assert law.viscous_low == pytest.approx(covered_viscous(setting, SET.high, SET.high) / SET.high.J)
    assert law.viscous_high == SET.high.f_v / SET.high.J
    assert covered_viscous(setting, SET.low, SET.high) == SET.low.f_v


def test_what_the_model_lacks_is_within_the_law_of_the_whole_set_and_of_every_part() -> None:
    error, rng = 700.0, np.random.default_rng(0)
    low, high = np.array(SET.low), np.array(SET.high)
    assert make_law(learning(model_error=error)) == pytest.approx(of(SET.low, SET.high, error), rel=1e-12)
    outside = 0
    for _ in range(2000):
        ends = low + np.sort(rng.random((2, len(low))), axis=0) * (high - low)
        p = BrakeParameters(*(ends[0] + rng.random(len(low)) * (ends[1] - ends[0])))
        part = BrakeParameters(*ends[0]), BrakeParameters(*ends[1])
        x, v, u = float(rng.uniform(-9.0, 99.0)), float(rng.uniform(-490.0, 490.0)), float(rng.uniform(-6.0, 6.0))
        after = v + 1e-3 * (acceleration(p, x, v, u) + error * float(rng.choice([-1.0, 1.0])))
        _, _, least, greatest = successor(of(*part, error), x, x, v, v, u)
        assert least <= after <= greatest
        _, _, least, greatest = successor(of(*part), x, x, v, v, u)
        outside += not least <= after <= greatest
    assert outside > 0


def test_viscous_friction_that_the_pad_does_not_cover_for_some_part_of_the_set_is_refused() -> None:
    def thicker(f_v: float) -> Bench:
        return replace(BENCH, ranges={"envelope": replace(SET, high=SET.high._replace(f_v=f_v))})

    assert make_law(thicker(5.2e-5))
    with pytest.raises(
        BenchFileError, match=r"viscous friction of a part of the set changes by 0\.311 rad/s and 0\.2988 are"
    ):
        make_assumptions(thicker(5.2e-5))
    with pytest.raises(BenchFileError, match=r"changes by 0\.300"):
        make_assumptions(thicker(5.02e-5))
    assert make_assumptions(learning(thicker(5.02e-5), 500.0))  # what may add to friction slows the way home
