"""The structured excitation: estimator, reference, speed loop; as scalar functions, compiled, in torch and in ONNX."""

from __future__ import annotations

import dataclasses
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake.euler import step
from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, packed_index, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, load_bench
from emb_runtime.errors import UsageError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import Conditions
from emb_train.envs.excitations import StatefulNetwork
from emb_train.envs.measure import MEASURES
from emb_train.envs.play import Draw, fresh_draws, play
from emb_train.structured.actor import StructuredActor
from emb_train.structured.estimator import (
    ANGLE,
    COVARIANCE,
    INNOVATION,
    PARAMETERS,
    STATE,
    UNKNOWNS,
    VELOCITY,
    VELOCITY_VARIANCE,
    believed,
    correct,
    direction,
    follow,
    make_model,
    predict,
    start,
)
from emb_train.structured.law import (
    PRODUCTS,
    TERMS,
    act,
    current_for,
    features,
    level_of,
    of_features,
    share_after,
    speed_loop,
)
from emb_train.structured.trial import Trials

BENCH = load_bench()
PM50 = BENCH.range_set("pm50")
MODEL = make_model(BENCH, PM50, "euler")
NOMINAL = np.array([getattr(BENCH.brake, n) for n in PARAMETER_NAMES])
COLUMNS = [BrakeParameters._fields.index(n) for n in PARAMETER_NAMES]
HORIZON = BENCH.timing.horizon

OUT_AND_BACK = np.zeros((5, TERMS))
OUT_AND_BACK[:, 0] = [1.0, -1.0, -0.01, 0.3, 0.6]
LEANING = OUT_AND_BACK.copy()
LEANING[:, 1:] = np.random.default_rng(4).uniform(-0.03, 0.03, (5, TERMS - 1))


def brake_of(relative: Any) -> BrakeParameters:
    return BENCH.brake._replace(**dict(zip(PARAMETER_NAMES, np.asarray(relative) * NOMINAL, strict=True)))


def random_state(seed: int, velocity: float) -> Floats:
    """A state with a full covariance, so fast that the direction is sure."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(UNKNOWNS, UNKNOWNS)) * np.array([1e-2, 0.5, 0.05, 0.05, 0.05, 0.05])[:, None]
    state = np.zeros(STATE)
    state[ANGLE], state[VELOCITY] = rng.uniform(1.0, 90.0), velocity
    state[PARAMETERS:COVARIANCE] = rng.uniform(0.6, 1.4, 4)
    state[COVARIANCE:INNOVATION] = (root @ root.T)[np.triu_indices(UNKNOWNS)]
    return state


def moved(unknowns: Floats, current: float) -> Floats:
    x1, x2 = step(brake_of(unknowns[2:]), unknowns[0], unknowns[1], current, MODEL.sample_time)
    return np.array([x1, x2, *unknowns[2:]])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([-300.0, 300.0]), st.floats(-6.0, 6.0))
def test_a_prediction_is_that_of_the_brake_and_of_its_numerical_derivatives(
    seed: int, velocity: float, current: float
) -> None:
    state = random_state(seed, velocity)
    before, covariance = state[ANGLE:COVARIANCE].copy(), unpack(state[COVARIANCE:INNOVATION], UNKNOWNS)
    predict(MODEL, state, 1.0, current)
    jacobian = np.empty((UNKNOWNS, UNKNOWNS))
    for i in range(UNKNOWNS):
        nudge = np.zeros(UNKNOWNS)
        nudge[i] = 1e-4
        jacobian[:, i] = (moved(before + nudge, current) - moved(before - nudge, current)) / 2e-4
    assert state[ANGLE:COVARIANCE] == pytest.approx(moved(before, current), rel=1e-12)
    expected = jacobian @ covariance @ jacobian.T
    assert unpack(state[COVARIANCE:INNOVATION], UNKNOWNS) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_two_corrections_in_turn_are_the_textbook_s_joint_one(seed: int) -> None:
    state = random_state(seed, 100.0)
    mean, p = state[ANGLE:COVARIANCE].copy(), unpack(state[COVARIANCE:INNOVATION], UNKNOWNS)
    y, noise = mean[:2] + np.array([0.003, -0.7]), np.diag([MODEL.angle_variance, MODEL.velocity_variance])
    gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + noise)
    correct(state, 0, y[0], noise[0, 0])
    correct(state, 1, y[1], noise[1, 1])
    assert state[ANGLE:COVARIANCE] == pytest.approx(mean + gain @ (y - mean[:2]), rel=1e-9)
    assert unpack(state[COVARIANCE:INNOVATION], UNKNOWNS) == pytest.approx(p - gain @ p[:2], rel=1e-6, abs=1e-12)


def test_the_direction_of_an_uncertain_velocity_has_the_mean_sign_of_a_gaussian_number() -> None:
    for v, sigma in [(0.0, 1.0), (0.5, 1.0), (-2.0, 1.5), (3.0, 0.2)]:
        assert direction(v, sigma**2) == pytest.approx(math.erf(v / sigma / math.sqrt(2.0)), abs=0.03)


def test_what_is_known_beforehand_is_the_variance_of_the_uniform_ranges() -> None:
    state = start(make_model(BENCH, BENCH.range_set("viscous"), "euler"))
    deviation = np.sqrt([state[COVARIANCE + packed_index(UNKNOWNS, i, i)] for i in range(2, UNKNOWNS)])
    assert state[PARAMETERS:COVARIANCE] == pytest.approx([1.0, 1.0, 1.0, 3.0e-5 / 2.16e-5])
    assert deviation == pytest.approx([0.0, 0.0, 0.0, 4.0e-5 / 2.16e-5 / math.sqrt(12.0)])


@pytest.mark.parametrize("plant", ["euler", "exact"])
def test_errors_of_the_estimate_are_as_large_as_the_filter_says(plant: str) -> None:
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, fresh_draws(PM50, 5, 100), plant)
    (outcome,) = trials.play(speed_loop(BENCH), OUT_AND_BACK[None])
    errors = outcome.estimates[:, PARAMETERS:COVARIANCE] - trials.brakes[:, COLUMNS] / NOMINAL
    where = [COVARIANCE + packed_index(UNKNOWNS, i, i) for i in range(2, UNKNOWNS)]
    shares = np.abs(errors) / np.sqrt(outcome.estimates[:, where])
    if plant == "euler":
        assert 0.5 < np.median(shares) < 0.85  # 0.67 for a Gaussian number
    assert np.abs(errors).max() < 0.02
    assert not outcome.left.any()
    assert outcome.home.all()


def test_after_lost_samples_the_estimate_goes_on_less_sure_and_not_wrong() -> None:
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, 1, plant="euler")
    batch.begin(0, np.random.default_rng(8))
    truth = batch.brakes[0, COLUMNS] / NOMINAL
    all_seen, state = start(MODEL), start(MODEL)
    for k in range(120):
        angle, velocity = batch.y[0].tolist()
        act(MODEL, speed_loop(BENCH), OUT_AND_BACK, all_seen, angle, velocity, float(k), batch.x[0, 3])
        if not 60 <= k < 64:
            wanted = act(MODEL, speed_loop(BENCH), OUT_AND_BACK, state, angle, velocity, float(k), batch.x[0, 3])
        batch.advance(np.array([wanted]))
    for i in range(4):
        where = COVARIANCE + packed_index(UNKNOWNS, 2 + i, 2 + i)
        assert state[where] >= all_seen[where]
        assert abs(state[PARAMETERS + i] - truth[i]) < 4.0 * math.sqrt(state[where])


def test_a_step_that_was_seen_already_predicts_nothing() -> None:
    state = random_state(1, 50.0)
    before = state.copy()
    predict(MODEL, state, -3.0, 6.0)
    assert state == pytest.approx(before, rel=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(-15.0, 15.0))
def test_the_loop_reaches_the_speed_within_one_period_where_the_current_suffices(seed: int, change: float) -> None:
    state = random_state(seed, 200.0)
    x: float = state[ANGLE]
    parameters: Any = state[PARAMETERS:COVARIANCE]
    current = current_for(MODEL, x, 200.0, state[VELOCITY_VARIANCE], parameters, 200.0 + change, 1.0)
    if abs(current) < MODEL.current:
        _, v = step(brake_of(parameters), x, 200.0, current, MODEL.sample_time)
        assert v == pytest.approx(200.0 + change, abs=1e-6)
    else:
        assert abs(current) == MODEL.current


def held(table: Floats, state: Floats, step: float) -> float:
    """Mean level of the coming period, by the plainest loop over its levels."""
    f, levels = features(MODEL, state), (len(table) + 1) // 2
    after = np.minimum.accumulate([share_after(table, i, f, step, float(HORIZON)) for i in range(levels + 1)])
    return float(sum(level_of(table, i, f) * (after[i] - after[i + 1]) for i in range(levels)))


def test_a_reference_is_held_between_its_switches_and_leans_on_the_estimate_within_full_speed() -> None:
    state = start(MODEL)
    assert [held(OUT_AND_BACK, state, float(k)) for k in (0, 149, 150, 299, 300, 499)] == pytest.approx(
        [1.0, 1.0, -1.0, -1.0, -0.01, -0.01]
    )
    table = OUT_AND_BACK.copy()
    table[1, 1], table[3, 2] = 0.4, -0.1
    state[PARAMETERS : PARAMETERS + 4] = math.sqrt(0.75)  # the middle of the logarithms: 0
    state[PARAMETERS : PARAMETERS + 2] = [0.75**0.25 * 1.5**0.5, 1.5]  # half and all of the way to the ends
    assert held(table, state, 99.0) == 1.0
    assert held(table, state, 100.0) == pytest.approx(-1.0 + 0.5 * 0.4)
    state[PARAMETERS] = -9.0  # what is used is cut off at the range, and the level at full speed
    assert believed(MODEL, state, 0) == pytest.approx(0.5)
    assert held(table, state, 100.0) == -1.0


def test_in_the_period_of_a_switch_the_current_is_the_mean_of_both_levels_by_time() -> None:
    table = OUT_AND_BACK.copy()
    table[3, 0] = 100.25 / HORIZON
    steps = (99.0, 100.0, 101.0)
    asked = [act(MODEL, speed_loop(BENCH), table, start(MODEL), 0.0, 0.0, now, 0.0) for now in steps]
    assert asked == pytest.approx([6.0, 0.25 * 6.0 - 0.75 * 6.0, -6.0])  # full speed is out of reach in a period
    table[4, 0] = 0.1  # a switch before the one that comes first comes with it
    assert held(table, start(MODEL), 99.0) == 1.0
    assert held(table, start(MODEL), 101.0) == pytest.approx(-0.01)


@given(st.lists(st.floats(0.5, 1.5), min_size=4, max_size=4), st.integers(0, 10**6))
def test_a_level_is_the_polynomial_of_the_logarithms(relative: list[float], seed: int) -> None:
    state, terms = start(MODEL), np.random.default_rng(seed).uniform(-1.0, 1.0, TERMS)
    state[PARAMETERS:COVARIANCE] = relative
    f = np.interp(np.log(relative), np.log([0.5, 1.5]), [-1.0, 1.0])
    assert features(MODEL, state) == pytest.approx(tuple(f), abs=1e-12)
    products = [f[i] * f[j] for i, j in PRODUCTS]
    expected = terms @ [1.0, *f, *products]
    assert of_features(terms, features(MODEL, state)) == pytest.approx(expected, abs=1e-12)


def recorded(plant: str, table: Floats, count: int) -> tuple[Any, Any, Any]:
    """What was seen [500, N, 4] float32, wanted [500, N] and the last states, by the plain scalar functions."""
    loop = speed_loop(BENCH)
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, count, compiled, plant)
    model = make_model(BENCH, PM50, plant)
    for i in range(count):
        batch.begin(i, np.random.default_rng((9, i)))
    states = np.tile(start(model), (count, 1))
    seen, wanted = [], []
    for _ in range(HORIZON):
        seen.append(batch.seen())
        wanted.append(
            [act(model, loop, table, s, *(float(v) for v in row)) for s, row in zip(states, seen[-1], strict=True)]
        )
        batch.advance(np.array(wanted[-1]))
    return np.array(seen), np.array(wanted), states


RECORDED = {plant: recorded(plant, LEANING, 3) for plant in ("euler", "exact")}
SEEN, WANTED, LAST = RECORDED["euler"]


@pytest.mark.parametrize("plant", RECORDED)
def test_compiled_functions_are_the_plain_ones(plant: str) -> None:
    seen, wanted, last = RECORDED[plant]
    model = make_model(BENCH, PM50, plant)
    fast, states = compiled(act), np.tile(start(model), (3, 1))
    for rows, currents in zip(seen.tolist(), wanted, strict=True):
        again = [fast(model, speed_loop(BENCH), LEANING, s, *row) for s, row in zip(states, rows, strict=True)]
        assert again == pytest.approx(currents.tolist(), abs=1e-6)
    assert states == pytest.approx(last, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("plant", RECORDED)
def test_the_torch_module_is_the_scalar_functions_over_whole_experiments(plant: str) -> None:
    seen, wanted, last = RECORDED[plant]
    actor = StructuredActor(BENCH, PM50, plant, speed_loop(BENCH), LEANING)
    state = actor.initial_state.repeat(3, 1)
    with torch.no_grad():
        for rows, currents in zip(seen, wanted, strict=True):
            current, state, estimate = actor(torch.from_numpy(rows), state)
            assert current.dtype == estimate.dtype == torch.float32
            assert current[:, 0].numpy() == pytest.approx(currents, abs=1e-4)
    assert state.numpy() == pytest.approx(last, rel=1e-5, abs=1e-11)
    expected = last[:, PARAMETERS:COVARIANCE] * NOMINAL
    assert estimate[:, :4].numpy() == pytest.approx(expected, rel=1e-6)
    where = [COVARIANCE + packed_index(UNKNOWNS, i, i) for i in range(2, UNKNOWNS)]
    assert estimate[:, 4:].numpy() == pytest.approx(np.sqrt(last[:, where]) * NOMINAL, rel=1e-4)


def test_the_torch_module_bridges_lost_samples_as_the_scalar_functions_do() -> None:
    actor = StructuredActor(BENCH, PM50, "exact", speed_loop(BENCH), LEANING)
    model = make_model(BENCH, PM50, "exact")
    row, state = start(model), actor.initial_state[None]
    with torch.no_grad():
        for k in [0, 1, 2, 7, 8, 8, 30, 31, 200, 201]:
            wanted = act(model, speed_loop(BENCH), LEANING, row, *(float(v) for v in SEEN[k, 0]))
            current, state, _ = actor(torch.from_numpy(SEEN[k, :1]), state)
            assert current.item() == pytest.approx(wanted, abs=1e-5)
    assert state[0].numpy() == pytest.approx(row, rel=1e-6, abs=1e-12)


def test_the_level_that_holds_moves_the_current_and_no_other_does() -> None:
    slow = OUT_AND_BACK.copy()
    slow[:3] *= 0.001  # so that the current is within its limit
    actor = StructuredActor(BENCH, PM50, "euler", speed_loop(BENCH), slow)
    current, *_ = actor(torch.from_numpy(SEEN[0]), actor.initial_state.repeat(3, 1))
    current.sum().backward()
    assert actor.table.grad is not None
    assert actor.table.grad[0, 0] > 0.0
    assert not actor.table.grad[1:].any()


def test_one_onnx_graph_with_its_state_answers_as_the_module_does(tmp_path: Path) -> None:
    actor = StructuredActor(BENCH, PM50, "euler", speed_loop(BENCH), LEANING).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter about itself
        program = torch.onnx.export(
            actor,
            (torch.zeros(1, 4), actor.initial_state[None]),
            dynamo=True,
            input_names=["obs", "state"],
            output_names=["action", "next_state", "estimate"],
            verbose=False,
        )
    assert program is not None
    program.save(tmp_path / "actor.onnx", external_data=False)
    session = ort.InferenceSession(str(tmp_path / "actor.onnx"), providers=["CPUExecutionProvider"])
    types = {port.name: (port.type, port.shape) for port in [*session.get_inputs(), *session.get_outputs()]}
    assert types == {
        "obs": ("tensor(float)", [1, 4]),
        "state": ("tensor(double)", [1, STATE]),
        "action": ("tensor(float)", [1, 1]),
        "next_state": ("tensor(double)", [1, STATE]),
        "estimate": ("tensor(float)", [1, 8]),
    }
    state = actor.initial_state[None].numpy()
    for seen, wanted in zip(SEEN, WANTED, strict=True):
        action, state, _ = session.run(["action", "next_state", "estimate"], {"obs": seen[:1], "state": state})
        assert action.item() == pytest.approx(wanted[0], abs=1e-5)
    assert state[0] == pytest.approx(LAST[0], rel=1e-6, abs=1e-12)


def test_a_trial_is_the_environment_s_experiment() -> None:
    draws = fresh_draws(PM50, 9, 3)
    conditions = Conditions(information="physical")
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, draws, "euler", conditions)
    (outcome,) = trials.play(speed_loop(BENCH), LEANING[None])
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, 3, compiled, "euler", conditions)
    for i, draw in enumerate(draws):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)
    states = np.tile(start(MODEL), (3, 1))
    loop = speed_loop(BENCH)
    for k in range(HORIZON):
        rows = zip(states, batch.y.tolist(), batch.x[:, 3].tolist(), strict=True)
        wanted = [compiled(act)(MODEL, loop, LEANING, s, y1, y2, float(k), u) for s, (y1, y2), u in rows]
        batch.advance(np.array(wanted))
    assert outcome.matrices.tolist() == unpack(batch.m, 4).tolist()
    assert [*outcome.angle, *outcome.velocity] == batch.x[:, :2].T.ravel().tolist()
    assert outcome.home.tolist() == batch.home.tolist()
    assert outcome.estimates.tolist() == states.tolist()


def test_the_torch_module_is_worth_what_the_compiled_trial_is() -> None:
    draws = fresh_draws(PM50, 9, 4)
    conditions = Conditions(information="physical")
    (outcome,) = Trials(BENCH, PM50, PARAMETER_NAMES, draws, "euler", conditions).play(speed_loop(BENCH), LEANING[None])
    actor = StatefulNetwork(StructuredActor(BENCH, PM50, "euler", speed_loop(BENCH), LEANING))
    again = play(BENCH, PM50, PARAMETER_NAMES, actor, draws, "euler", conditions)
    measure = MEASURES["D"]
    # What is seen is rounded to single precision, and an experiment with sign() is chaotic in its last digits.
    assert measure.values(again.matrices) == pytest.approx(measure.values(outcome.matrices), abs=0.05)
    assert again.home.all()


def test_an_experiment_that_leaves_the_limits_keeps_what_it_had_told() -> None:
    strong = BENCH.brake._replace(k_m=4.0 * BENCH.brake.k_m)  # far outside what the shield was told
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, [Draw(0, strong), Draw(1, BENCH.brake)])
    (outcome,) = trials.play(speed_loop(BENCH), OUT_AND_BACK[None])
    assert outcome.left.tolist() == [True, False]
    assert outcome.home.tolist() == [False, True]
    assert 0.0 < outcome.matrices[0, 0, 0] < outcome.matrices[1, 0, 0]


def test_two_references_meet_the_same_brakes_and_noise() -> None:
    draws = fresh_draws(PM50, 2, 70)  # more than one chunk
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, draws)
    one, two = trials.play(speed_loop(BENCH), np.array([OUT_AND_BACK, OUT_AND_BACK]))
    assert one.matrices.tolist() == two.matrices.tolist()
    assert len(one.matrices) == 70


def test_an_estimator_that_takes_the_inertia_as_known_refuses_ranges_in_which_it_varies() -> None:
    wide = dataclasses.replace(PM50, high=PM50.high._replace(J=2.0 * BENCH.brake.J))
    with pytest.raises(UsageError):
        make_model(BENCH, wide, "euler")


def test_a_first_sample_that_comes_late_is_taken_in() -> None:
    state = start(MODEL)
    follow(MODEL, state, 0.5, 3.0, 40.0, 0.0)
    assert state[ANGLE] == pytest.approx(0.5, abs=2e-3)
