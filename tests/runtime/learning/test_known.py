"""What is known: the numbers of a state by name; before the first sample the set is the bench's, and so is its law."""

from __future__ import annotations

import pytest

from emb_bench.compiled import compiled
from emb_runtime.config.bench import load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import BenchFileError
from emb_runtime.learning.assumptions import make_assumptions
from emb_runtime.learning.known import FALSIFIED, HEAD, HEARD, Known, falsify, known, numbers, start_head
from emb_runtime.learning.law import fits, law_for, middle, with_room
from emb_runtime.safety.shield_design import design_inputs, make_law

BENCH = load_bench()


def test_what_is_known_are_the_numbers_of_the_head_by_name_and_for_the_log_in_order() -> None:
    """Least four at 2, greatest four at 6, the box of states at 10; contradicted or not at 1."""
    head = [5.0, 0.0, 0.1, 0.2, 0.3, 0.4, 1.1, 1.2, 1.3, 1.4, -2.0, 2.0, -30.0, 30.0]
    now = known(head)
    assert now == (0.1, 1.1, 0.2, 1.2, 0.3, 1.3, 0.4, 1.4, -2.0, 2.0, -30.0, 30.0, False)
    assert Known._fields[:4] == ("k_m_low", "k_m_high", "k_1_low", "k_1_high")
    assert Known._fields[4:8] == ("t_c_low", "t_c_high", "f_v_low", "f_v_high")
    assert numbers(now, 7) == (0.1, 1.1, 0.2, 1.2, 0.3, 1.3, 0.4, 1.4, -2.0, 2.0, -30.0, 30.0, 7.0)
    assert known([*head[:1], 1.0, *head[2:]]) == now._replace(falsified=True)
    assert len(head) == HEAD  # where the numbers of the learner begin


def test_a_contradiction_is_the_set_known_beforehand_around_the_newest_sample() -> None:
    assumptions = make_assumptions(BENCH)
    state = [9.0] * HEAD
    falsify(assumptions, state, 3.0, 40.0)
    assert (state[HEARD], state[FALSIFIED]) == (0.0, 1.0)
    now = known(state)
    assert now[0:8:2] == assumptions.low
    assert now[1:8:2] == assumptions.high
    assert now[8:] == pytest.approx((2.994, 3.006, 34.0, 46.0, True), rel=1e-12)
    start_head(assumptions, state)
    assert state[:10] == [0.0, 0.0, *assumptions.low, *assumptions.high]


def test_before_anything_is_heard_of_the_brake_the_law_is_the_benchs_compiled_or_not() -> None:
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    start_head(assumptions, state)
    assert not known(state).falsified
    falsify(assumptions, state, 3.0, 40.0)
    found = known(state)
    assert found.falsified
    assert middle(found) == pytest.approx((3.0, 40.0))
    for function in (law_for, compiled(law_for)):
        law = function(design_inputs(BENCH), BENCH.brake, found)
        assert law == pytest.approx(make_law(BENCH), rel=1e-12)


def test_the_keys_of_learning_are_read_and_change_no_contract() -> None:
    text = shipped_bench_text()
    keys = 'learn = true\nmodel = "euler"\nmodel_error = 50.0\ncurrent_error = 0.01\n'
    bench = parse_bench(text.replace("[shield]", "[shield]\n" + keys + "#"), "t")
    shield = bench.shield
    assert (shield.learn, shield.model, shield.model_error, shield.current_error) == (True, "euler", 50.0, 0.01)
    assert bench.identity_hash == BENCH.identity_hash
    assumptions = make_assumptions(bench)
    assert (assumptions.flow, assumptions.model_error) == (False, 50.0)
    assert (BENCH.shield.learn, BENCH.shield.model) == (False, "flow")
    with pytest.raises(BenchFileError, match="expected true or false"):
        parse_bench(text.replace("[shield]", '[shield]\nlearn = "bounded"\n#'), "t")


def test_a_law_is_kept_while_the_possible_states_fit_into_its_noise_and_it_serves_a_part_of_its_set() -> None:
    setting = design_inputs(BENCH)
    assumptions = make_assumptions(BENCH)
    state = [0.0] * HEAD
    falsify(assumptions, state, 3.0, 40.0)
    whole = known(state)
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
