"""Before the first sample the set is the bench's, and its law the bench's; what the bench cannot grant is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from emb_bench.compiled import compiled
from emb_runtime.config.bench import Bench, Noise, load_bench, parse_bench, shipped_bench_text
from emb_runtime.config.shield_config import shield_config
from emb_runtime.errors import BenchFileError
from emb_runtime.learning.assumptions import make_assumptions
from emb_runtime.learning.known import HEAD, falsify, known, start_head
from emb_runtime.learning.law import fits, law_for, middle, with_room
from emb_runtime.safety.shield_design import make_law

BENCH = load_bench()


def with_shield(bench: Bench = BENCH, **change: Any) -> Bench:
    return replace(bench, shield=replace(bench.shield, **change))


def test_before_anything_is_heard_of_the_brake_the_law_is_the_benchs_compiled_or_not() -> None:
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    start_head(assumptions, state)
    assert not known(assumptions, state).falsified
    falsify(assumptions, state, 3.0, 40.0)
    found = known(assumptions, state)
    assert found.falsified
    assert middle(found) == pytest.approx((3.0, 40.0))
    for function in (law_for, compiled(law_for)):
        law = function(shield_config(BENCH), BENCH.brake, found)
        assert law == pytest.approx(make_law(BENCH), rel=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"envelope": "coasting", "angle_margin": 1.1}, "coasts"),
        ({"frame_age": (0, 1)}, "late frames"),
        ({"current_lag": 5e-4}, "lags"),
        ({"break_away": 1.2}, "model_error"),
        ({"f_l": 1e-6}, "model_error"),
    ],
)
def test_a_bench_that_does_not_grant_an_assumption_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(BenchFileError, match=said):
        make_assumptions(with_shield(**change))


@pytest.mark.parametrize(
    ("noise", "said"), [(Noise(1.9e-4, 1.0), "noise.angle"), (Noise(1e-3, 9e-4), "noise.velocity")]
)
def test_noise_of_the_order_of_the_wires_steps_is_refused_where_it_must_be_independent(noise: Noise, said: str) -> None:
    for learn in ("bounded", "gaussian"):
        bench = replace(BENCH, noise=noise, shield=replace(BENCH.shield, learn=learn))
        if learn == "bounded":
            assert make_assumptions(bench)
        else:
            with pytest.raises(BenchFileError, match=f"{said}.*steps of the wire"):
                make_assumptions(bench)


def test_much_friction_beside_a_weak_motor_is_refused_for_the_margin_of_a_part_may_be_greater() -> None:
    sets = BENCH.range_set("envelope")
    low, high = (b._replace(T_c=0.036) for b in (sets.low, sets.high))
    bench = replace(BENCH, ranges={"envelope": replace(sets, low=low, high=high)})
    assert make_law(bench)
    with pytest.raises(BenchFileError, match="half of what the weakest motor"):
        make_assumptions(bench)


def test_the_keys_of_learning_are_read_and_change_no_contract() -> None:
    text = shipped_bench_text()
    keys = 'learn = "gaussian"\nmodel = "euler"\nmodel_error = 50.0\ncurrent_error = 0.01\ndelta = 1e-6\n'
    bench = parse_bench(text.replace("[shield]", "[shield]\n" + keys + "#"), "t")
    shield = bench.shield
    assert (shield.learn, shield.model, shield.model_error) == ("gaussian", "euler", 50.0)
    assert (shield.current_error, shield.delta) == (0.01, 1e-6)
    assert bench.contract_hash == BENCH.contract_hash
    assumptions = make_assumptions(bench)
    assert (assumptions.flow, assumptions.model_error, assumptions.delta) == (False, 50.0, 1e-6)
    assert (BENCH.shield.learn, BENCH.shield.model) == ("off", "flow")


def test_a_law_is_kept_while_the_possible_states_fit_into_its_noise_and_it_serves_a_part_of_its_set() -> None:
    setting = shield_config(BENCH)
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    falsify(assumptions, state, 3.0, 40.0)
    whole = known(assumptions, state)
    part = whole._replace(angle_low=2.999, angle_high=3.0, velocity_low=39.0, velocity_high=41.0)
    law = law_for(setting, BENCH.brake, with_room(setting, part))
    assert law.velocity_noise == pytest.approx(1.1)
    assert law.angle_noise == pytest.approx(setting.angle_noise)
    assert fits(law, part)
    assert fits(law, part._replace(velocity_low=50.0, velocity_high=52.19, angle_high=3.01))
    assert not fits(law, part._replace(velocity_high=41.3))
    assert not fits(law, part._replace(angle_high=3.0131))
    wide = law_for(setting, BENCH.brake, with_room(setting, whole))  # never beyond the measurement's noise
    assert (wide.angle_noise, wide.velocity_noise) == pytest.approx((setting.angle_noise, setting.velocity_noise))
    assert fits(wide, whole)
