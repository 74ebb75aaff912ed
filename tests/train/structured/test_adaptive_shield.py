"""A shield whose set of brakes follows the running estimate, and sets that a bench's own shield refuses."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, packed_index
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench
from emb_runtime.config.shield_config import shield_config
from emb_runtime.errors import BenchFileError, UsageError
from emb_runtime.learning.law import farthest, law_between
from emb_runtime.safety.shield_design import ShieldLaw, gap, make_law
from emb_train.envs.conditions import NOTHING_RANDOM, Conditions, Randomisation
from emb_train.envs.excitations import Constant
from emb_train.envs.play import Draw, Outcome, fresh_draws, play
from emb_train.structured.adaptive_shield import (
    PAD,
    SHIELDS,
    Belief,
    Shield,
    believed_law,
    believed_motion,
    believed_range,
    contains,
    make_belief,
    narrowest,
)
from emb_train.structured.estimator import (
    ANGLE,
    COVARIANCE,
    MISFIT,
    MOTION,
    PARAMETERS,
    UNKNOWNS,
    VELOCITY,
    WORST,
    Model,
    make_model,
    start,
)
from emb_train.structured.law import TERMS, no_loop
from emb_train.structured.stored import stored
from emb_train.structured.task import TASKS, around
from emb_train.structured.trial import ReportedOutcome, Trials
from studies.ladder.ladder import follow_all, oracle_laws, reference, shields_of

BENCH = load_bench()
EULER = BENCH.plant("euler")
FOUR, WIDE = (replace(TASKS[name], plant="euler") for name in ("four-d", "four-d-wide"))
LIMITED = Conditions(shield_ranges="envelope", information="physical")


def on_the_way() -> tuple[Belief, Floats]:
    """What a shield knows beforehand, and an estimator's state before the first sample."""
    bench = LIMITED.applied(BENCH)
    return make_belief(bench, "belief", EULER, NOTHING_RANDOM), start(
        make_model(bench, bench.range_set("pm50"), "euler")
    )


BEFORE = on_the_way()


def with_deviation(state: Floats, i: int, deviation: float) -> Floats:
    changed = state.copy()
    changed[COVARIANCE + packed_index(UNKNOWNS, i, i)] = deviation**2
    return changed


def played(task: Any, name: str, draws: list[Draw], laws: list[ShieldLaw] | None = None) -> ReportedOutcome:
    outcome = follow_all(reference(name), task, BENCH, draws, laws)
    assert isinstance(outcome, ReportedOutcome)
    return outcome


def test_the_law_between_the_ends_of_the_benchs_set_is_the_benchs_law_compiled_or_not() -> None:
    setting, ends = shield_config(BENCH), BENCH.range_set(BENCH.shield.ranges)
    given_ = (setting, ends.low, ends.high, setting.angle_noise, setting.velocity_noise)
    assert law_between(*given_) == make_law(BENCH)
    assert compiled(law_between)(*given_) == make_law(BENCH)


def test_before_the_first_sample_the_whole_set_is_believed() -> None:
    belief, state = on_the_way()
    ends = BENCH.range_set("envelope")
    for i, name in enumerate(PARAMETER_NAMES):
        low, high = believed_range(belief, state, i)
        nominal = getattr(BENCH.brake, name)
        assert low * nominal == pytest.approx(getattr(ends.low, name))
        assert high * nominal == pytest.approx(getattr(ends.high, name))


@given(
    i=st.integers(0, 3),
    value=st.floats(-1.0, 4.0),
    deviation=st.floats(0.0, 1.0),
)
def test_what_is_believed_of_a_parameter_lies_in_the_set_and_holds_the_estimate_where_the_set_does(
    i: int, value: float, deviation: float
) -> None:
    belief, state = BEFORE
    state = with_deviation(state, MOTION + i, deviation)
    state[PARAMETERS + i] = value
    low, high = believed_range(belief, state, i)
    assert belief.low[i] <= low <= high <= belief.high[i]
    if belief.low[i] <= value <= belief.high[i]:
        assert low <= value <= high


def test_a_parameter_is_believed_to_within_six_deviations_and_a_pad() -> None:
    belief, state = on_the_way()
    state = with_deviation(state, MOTION, 0.02)
    state[PARAMETERS] = 1.1
    reach = 6.0 * 0.02 + PAD * 1.1
    assert believed_range(belief, state, 0) == pytest.approx((1.1 - reach, 1.1 + reach))


def test_an_estimate_that_has_left_the_set_is_not_believed() -> None:
    belief, state = on_the_way()
    state = with_deviation(state, MOTION, 0.001)
    state[PARAMETERS] = 1.7
    assert believed_range(belief, state, 0) == (belief.low[0], belief.high[0])


def test_less_doubt_leaves_a_law_with_more_braking_and_less_noise() -> None:
    belief, state = on_the_way()
    for i in range(UNKNOWNS):
        state = with_deviation(state, i, 1e-4)
    law, whole = believed_law(belief, state), make_law(LIMITED.applied(BENCH))
    assert law.braking > 1.9 * whole.braking  # the nominal motor is twice as strong as the weakest
    assert (law.angle_noise, law.velocity_noise) == believed_motion(belief, state)
    assert law.velocity_noise < 0.1 * whole.velocity_noise
    assert (law.top, law.bottom, law.outward_speed) == (whole.top, whole.bottom, whole.outward_speed)


@pytest.mark.parametrize("far", range(UNKNOWNS))
def test_the_truth_is_missed_where_any_unknown_is_far_from_its_estimate(far: int) -> None:
    belief, state = on_the_way()
    state[ANGLE], state[VELOCITY] = 3.0, 40.0
    for i in range(UNKNOWNS):
        state = with_deviation(state, i, 1e-3)
    truth = np.array([3.0, 40.0, 1.0, 1.0, 1.0, 1.0])
    nominal = np.array(BENCH.brake)
    assert contains(belief, state, nominal, 3.0, 40.0)
    truth[far] += 1.0
    brake = nominal * [1.0, 1.0, *truth[MOTION:]]
    assert not contains(belief, state, brake, truth[0], truth[1])


def test_a_believing_shield_keeps_the_limits_and_tells_nearly_what_one_tells_that_knows_the_brake() -> None:
    draws = FOUR.draws(BENCH, 6, 24)
    believing = replace(FOUR, shield="belief")
    worst = played(FOUR, "four-d-affine", draws)
    found = played(believing, "four-d-affine", draws)
    known = played(FOUR, "four-d-affine", draws, oracle_laws(BENCH, [draw.brake for draw in draws]))
    assert not found.left.any()
    assert found.home.all()
    assert not found.mistaken.any()
    gain = FOUR.score(found) - FOUR.score(worst)
    assert gain.mean() > 0.1
    assert FOUR.score(found).mean() > FOUR.score(known).mean() - 0.01


def test_a_belief_that_is_wrong_is_counted() -> None:
    draws = FOUR.draws(BENCH, 6, 4)
    trials = replace(FOUR, shield="belief").trials(BENCH, draws)
    trials.model = make_model(BENCH, around(BENCH.brake, 0.0, "known"), "euler")  # sure of the nominal brake
    kept = stored("four-d-speed")
    (found,) = trials.play(kept.loop(BENCH), kept.array()[None])
    assert found.mistaken.all()


def test_a_believing_shield_is_refused_where_the_filter_does_not_know_what_it_covers() -> None:
    changes: list[dict[str, Any]] = [
        {"frame_age": (0, 1)},
        {"current_lag": 5e-4},
        {"envelope": "coasting", "angle_margin": 1.1},
    ]
    for change in changes:
        bench = replace(BENCH, shield=replace(BENCH.shield, **change))
        with pytest.raises(UsageError, match="fresh frames"):
            make_belief(bench, "belief", EULER, NOTHING_RANDOM)
        assert not make_belief(bench, "worst case", EULER, NOTHING_RANDOM).running


@pytest.mark.parametrize("plant", ["late", "lag", "offset", "observer", "rough"])
def test_a_believing_shield_is_refused_on_a_plant_that_the_filter_does_not_know(plant: str) -> None:
    task = replace(FOUR, plant=plant)
    assert shields_of(task, BENCH) == [task]
    with pytest.raises(UsageError, match="fresh frames"):
        replace(task, shield="belief").trials(BENCH, [])
    task.trials(BENCH, [])


@pytest.mark.parametrize("plant", ["euler", "exact", "stribeck", "jitter"])
def test_a_plant_whose_motion_alone_differs_has_a_shield_that_may_find_out(plant: str) -> None:
    task = replace(FOUR, plant=plant)
    assert [behind.shield for behind in shields_of(task, BENCH)] == ["worst case", "belief", "bounded", "gaussian"]
    assert replace(task, shield="belief").trials(BENCH, []).belief.running


@pytest.mark.parametrize(
    "randomised",
    [
        {"command_delay": (0, 1)},
        {"measurement_delay": (0, 1)},
        {"current_lag": (0.0, 0.001)},
        {"encoder_offset": (-0.1, 0.0)},
    ],
)
def test_a_believing_shield_is_refused_where_the_filter_does_not_know_what_is_randomised(
    randomised: dict[str, Any],
) -> None:
    for conditions in (
        Conditions(randomised=Randomisation(**randomised)),
        Conditions(shielded=False, randomised=Randomisation(**randomised)),
    ):
        begin = partial(Trials, BENCH, BENCH.range_set("pm50"), PARAMETER_NAMES, [], "exact", conditions)
        with pytest.raises(UsageError, match="fresh frames"):
            begin("belief")
        assert not begin().belief.running


def test_where_the_model_does_not_fit_the_believing_shield_is_the_one_for_the_whole_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    draws = FOUR.draws(BENCH, 6, 6)
    believing = replace(FOUR, shield="belief")
    worst, trusting = (played(task, "four-d-affine", draws) for task in (FOUR, believing))

    def misfitting(model: Model) -> Floats:
        state = start(model)
        state[WORST] = MISFIT + 1.0
        return state

    monkeypatch.setattr("emb_train.structured.trial.start", misfitting)
    found = played(believing, "four-d-affine", draws)
    for field in fields(Outcome):
        assert getattr(found, field.name).tolist() == getattr(worst, field.name).tolist()
    assert found.estimates[:, :WORST].tolist() == worst.estimates[:, :WORST].tolist()
    assert not found.mistaken.any()
    assert trusting.matrices.tolist() != worst.matrices.tolist()


def test_for_a_wide_set_the_shield_is_made_up_to_where_the_weakest_motor_holds_the_stiffest_spring() -> None:
    bench = WIDE.conditions.applied(WIDE.on(BENCH))
    with pytest.raises(BenchFileError, match="the stiffest spring accelerates"):
        make_law(bench)
    nearer, law = narrowest(bench)
    b = BENCH.brake
    # The weakest brake's 6079 rad/s² stop 334.4 rad/s, and the sample before that, within 9.7 rad.
    speed = 334.4
    torque = 0.2 * (6.0 * b.k_m + b.T_c + b.f_v * speed)
    assert nearer.limits.angle[1] == pytest.approx(0.95 * torque / (1.8 * b.gamma * b.k_1), rel=1e-3)
    assert law.homeward_speed == pytest.approx(speed, abs=0.1)
    assert law.top == pytest.approx(nearer.limits.angle[1] - 0.3)
    # Against 1.8 T_c and 1.8 f_v the weakest motor reaches 190 rad/s; the way home is planned with 0.8 of it.
    assert law.cruise == pytest.approx(0.8 * (1.2 * b.k_m - 1.8 * b.T_c) / (1.8 * b.f_v))
    assert law.ramp > 0.0
    assert gap(law, nearer) == ""


def test_where_no_angle_is_covered_a_set_has_no_shield() -> None:
    bench = replace(BENCH, ranges={**BENCH.ranges, "nearly all": around(BENCH.brake, 0.95, "nearly all")})
    with pytest.raises(BenchFileError, match=r"cannot guarantee the limits up to .* rad for 'nearly all'"):
        narrowest(replace(bench, shield=replace(bench.shield, ranges="nearly all")))


def test_a_set_that_the_bench_covers_has_its_own_shield() -> None:
    bench = LIMITED.applied(BENCH)
    assert narrowest(bench) == (bench, make_law(bench))
    ends = bench.range_set("envelope")
    assert farthest(shield_config(bench), ends.low, ends.high) == bench.limits.angle[1]


@pytest.mark.parametrize("shield", SHIELDS[1:])
def test_a_wide_set_is_held_and_comes_home_and_what_is_known_of_the_brake_tells_much_more(shield: Shield) -> None:
    draws = WIDE.draws(BENCH, 6, 24)
    scores = []
    for task in (WIDE, replace(WIDE, shield=shield)):
        found = played(task, "four-d-affine", draws)
        assert not found.left.any()
        assert found.home.all()
        assert not found.mistaken.any()
        scores.append(task.score(found).mean())
    assert scores[1] > scores[0] + 1.0


def test_an_experiment_that_leaves_the_limits_ends_there_as_in_the_evaluation() -> None:
    ranges = BENCH.range_set("pm50")
    conditions = Conditions(shielded=False, information="physical")
    draws = fresh_draws(ranges, 3, 6)
    table = np.zeros((1, 1, TERMS))
    table[0, 0, 0] = 1.0  # 6 A
    (found,) = Trials(BENCH, ranges, PARAMETER_NAMES, draws, conditions=conditions).play(no_loop(BENCH), table)
    expected = play(BENCH, ranges, PARAMETER_NAMES, Constant(6.0), draws, conditions=conditions)
    assert found.left.all()
    for field in fields(Outcome):
        assert getattr(found, field.name).tolist() == getattr(expected, field.name).tolist()
    outside = (found.angle > BENCH.limits.angle[1]) | (np.abs(found.velocity) > BENCH.limits.velocity)
    assert outside.all()
