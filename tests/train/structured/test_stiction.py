"""The estimator on a brake that sticks: its flow, its kinks, and whether its errors are as large as it says."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import integrate
from scipy.stats import chi2, norm

from emb_bench.brake.motion import advance, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, packed_index, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, load_bench
from emb_runtime.errors import EXIT_DONE, EXIT_USAGE, UsageError
from emb_train.cli.tune import main, parser
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import Conditions, Randomisation
from emb_train.envs.play import fresh_draws
from emb_train.names import reference_names
from emb_train.structured.actor import StructuredActor, actor_of
from emb_train.structured.estimator import (
    COVARIANCE,
    INNOVATION,
    MISFIT,
    PARAMETERS,
    STATE,
    UNKNOWNS,
    VELOCITY,
    WORST,
    follow,
    make_model,
    predict,
    start,
)
from emb_train.structured.evolution import BATCH
from emb_train.structured.law import act, current_for
from emb_train.structured.stiction import KINK, KINK_DECAY, Accelerations, contact, excess, move, normal
from emb_train.structured.stored import read_text, stored

BENCH = load_bench()
PM50 = BENCH.range_set("pm50")
MODEL = make_model(BENCH, PM50, "exact")
NOMINAL = np.array([getattr(BENCH.brake, n) for n in PARAMETER_NAMES])
COLUMNS = [BrakeParameters._fields.index(n) for n in PARAMETER_NAMES]
SURE = 1e-9
T_S = BENCH.timing.sample_time


def moved(unknowns: Floats, current: float) -> Floats:
    """One period of the bench's own exact brake from angle, velocity and relative parameters."""
    x, (chosen, s) = rest(), no_sensitivity(["k_m"])
    x[0], x[1] = unknowns[0], unknowns[1]
    brake = BENCH.brake._replace(**dict(zip(PARAMETER_NAMES, unknowns[2:] * NOMINAL, strict=True)))
    advance(BENCH.plant("exact").mechanics, brake, x, current, T_S, chosen, s)
    return np.array([x[0], x[1], *unknowns[2:]])


def known_state(x: float, v: float, variance: float = 0.0) -> Floats:
    state = start(MODEL)
    state[1], state[2] = x, v
    state[COVARIANCE:INNOVATION] = 0.0
    for i in range(UNKNOWNS):
        state[COVARIANCE + packed_index(UNKNOWNS, i, i)] = variance
    return state


@settings(max_examples=60, deadline=None)
@given(st.floats(0.5, 95.0), st.floats(-490.0, 490.0), st.floats(-6.0, 6.0))
def test_a_prediction_is_one_period_of_the_exact_brake_also_where_it_stops(x: float, v: float, current: float) -> None:
    state = known_state(x, v)
    predict(MODEL, state, 1.0, current)
    expected = moved(np.array([x, v, 1.0, 1.0, 1.0, 1.0]), current)
    assert state[1] == pytest.approx(expected[0], abs=3e-5)
    assert state[2] == pytest.approx(expected[1], abs=3e-4)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.5, 95.0), st.floats(-490.0, 490.0), st.floats(-6.0, 6.0))
def test_its_derivatives_are_those_of_the_exact_brake(x: float, v: float, current: float) -> None:
    z = np.array([x, v, 1.0, 1.0, 1.0, 1.0])
    columns, scale = [], np.array([1e-6, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6])
    for i in range(UNKNOWNS):
        nudge = scale[i] * np.eye(UNKNOWNS)[i]
        columns.append(np.array([moved(z + nudge, current)[:2], moved(z - nudge, current)[:2]]))
    pull = 4692.906574394464 * current - 94.12318339100347 * x
    edges = (v, moved(z, current)[1], abs(pull) - 2242.6470588235297)  # a kink is not differentiable
    assume(min(abs(edges[0]), abs(edges[1])) > 0.05 and abs(edges[2]) > 50.0)
    expected = np.array([(up - down) / (2.0 * scale[i]) for i, (up, down) in enumerate(columns)]).T
    state = known_state(x, v, 1e-12)
    predict(MODEL, state, 1.0, current)
    covariance = unpack(state[COVARIANCE:INNOVATION], UNKNOWNS)
    assert covariance[0, 2:] / 1e-12 == pytest.approx(expected[0, 2:], rel=2e-2, abs=1e-5)
    assert covariance[1, 2:] / 1e-12 == pytest.approx(expected[1, 2:], rel=1e-2, abs=2e-2)


def test_a_brake_that_surely_sticks_stands_still_and_tells_nothing_of_the_friction() -> None:
    state = known_state(0.2, 0.0)
    for i in range(2, UNKNOWNS):
        state[COVARIANCE + packed_index(UNKNOWNS, i, i)] = 0.02**2
    before = state.copy()
    for k in range(1, 20):
        follow(MODEL, state, 0.2, 0.0, float(k), 0.1)
    assert abs(state[VELOCITY]) < 1e-12
    assert state[PARAMETERS:COVARIANCE] == pytest.approx(before[PARAMETERS:COVARIANCE], abs=1e-12)
    where = [COVARIANCE + packed_index(UNKNOWNS, i, i) for i in range(2, UNKNOWNS)]
    assert state[where] == pytest.approx(before[where], rel=1e-9)


def test_where_it_is_not_sure_whether_the_brake_sticks_it_stays_unsure() -> None:
    state = start(MODEL)
    current = MODEL.coulomb / MODEL.motor  # what breaks the nominal brake away
    follow(MODEL, state, 0.0, 0.0, 0.0, 0.0)
    before = state.copy()
    for k in range(1, 40):
        follow(MODEL, state, 0.0, 0.0, float(k), current)
    where = COVARIANCE + packed_index(UNKNOWNS, 4, 4)
    assert math.sqrt(state[where]) > 0.8 * math.sqrt(before[where])


@pytest.mark.parametrize("z", [-4.0, -2.0, -0.7, 0.0, 0.3, 1.0, 2.5])
def test_a_kink_has_the_moments_of_a_gaussian_number_cut_off_at_zero(z: float) -> None:
    def moment(of: int) -> float:
        low = -z if z > -8.0 else 8.0
        return float(integrate.quad(lambda e: (z + e) ** of * norm.pdf(e), low, 9.0)[0])

    mean, slope = moment(1), float(norm.cdf(z))
    assert normal(z) == pytest.approx(slope, abs=4e-4)
    assert excess(z, normal(z)) == pytest.approx(mean - max(z, 0.0), abs=1e-3)
    assert KINK * math.exp(-KINK_DECAY * z * z) == pytest.approx(moment(2) - mean**2 - slope**2, abs=4e-3)


def test_a_stop_that_may_be_a_reversal_has_the_mean_and_spread_of_a_sample_of_brakes() -> None:
    now, v, spread = Accelerations(-20000.0, 2200.0, 4.7, 0.0), 21.5, 0.8
    rng = np.random.default_rng(0)
    ends = np.array([move(now, 5.0, v + spread * e, T_S, SURE, SURE, SURE).velocity for e in rng.normal(size=4000)])
    told = move(now, 5.0, v, T_S, spread, spread, spread)
    assert told.velocity == pytest.approx(ends.mean(), abs=0.03)
    spread_told = math.sqrt((told.velocity_by_velocity * spread) ** 2 + told.kinked)
    assert spread_told == pytest.approx(ends.std(), rel=0.1)


def test_a_brake_at_rest_answers_a_drive_for_the_whole_period_however_little_it_may_have_moved_before() -> None:
    pull, by, v, spread = 28000.0, 100.0, 0.003, 0.14
    noise = spread * np.random.default_rng(1).normal(size=4000)

    def mean_end(pull: float) -> float:
        now = Accelerations(pull, 2200.0, 4.7, 0.0)
        return float(np.mean([move(now, 5.0, v + e, T_S, SURE, SURE, SURE).velocity for e in noise]))

    told = move(Accelerations(pull, 2200.0, 4.7, 0.0), 5.0, v, T_S, spread, 8.0, 8.0)
    assert told.velocity_by_pull == pytest.approx((mean_end(pull + by) - mean_end(pull - by)) / (2.0 * by), rel=5e-3)
    assert told.velocity_by_friction == pytest.approx(-told.velocity_by_pull, rel=1e-2)


@pytest.mark.parametrize("driven", [-1000.0, -300.0, 0.0, 300.0, 1000.0])
def test_a_brake_that_stops_and_may_break_away_is_known_no_better_than_a_sample_of_such_brakes(driven: float) -> None:
    v, spread, doubt = -1.4, 0.3, 600.0  # against the pull, known to 0.3 rad/s; whether it breaks away is not
    rng = np.random.default_rng(2)
    ends = []
    for e, d in rng.normal(size=(4000, 2)):
        now = Accelerations(2200.0 + driven + doubt * d, 2200.0, 4.7, 0.0)
        ends.append(move(now, 5.0, v + spread * e, T_S, SURE, SURE, SURE).velocity)
    around = math.hypot(spread, T_S * doubt)
    told = move(Accelerations(2200.0 + driven, 2200.0, 4.7, 0.0), 5.0, v, T_S, spread, around, around)
    explained = math.hypot(told.velocity_by_velocity * spread, told.velocity_by_pull * doubt)
    scatter = float(np.std(ends))
    assert math.hypot(explained, math.sqrt(told.kinked)) > scatter
    assert told.velocity == pytest.approx(float(np.mean(ends)), abs=1.5 * scatter)
    assert abs(told.velocity_by_pull) <= T_S


@pytest.mark.parametrize(("x", "v"), [(-0.2, 400.0), (0.2, -400.0), (3.0, 100.0), (-3.0, 100.0)])
def test_contact_in_a_period_is_its_integral_over_the_path(x: float, v: float) -> None:
    x1 = x + T_S * v
    times = np.linspace(0.0, T_S, 20001)
    squeezed = np.maximum(x + v * times, 0.0)
    share, to_velocity, to_angle = contact(x, x1, T_S, v, v)
    assert share == pytest.approx((squeezed > 0.0).mean(), abs=1e-3)
    assert to_velocity == pytest.approx(integrate.trapezoid(squeezed, times) / T_S, abs=1e-6)
    weighted = integrate.trapezoid(squeezed * (T_S - times), times) / (T_S * T_S / 2.0)
    assert to_angle == pytest.approx(weighted, abs=1e-6)


def test_a_brake_at_rest_is_driven_against_the_friction_of_where_it_is_to_go() -> None:
    def current(speed: float) -> float:
        return current_for(MODEL, 0.0, 0.0, 0.0, (1.0, 1.0, 1.0, 1.0), speed, 1.0)

    assert MODEL.motor * current(3.0) == pytest.approx(3.0 / T_S + MODEL.coulomb)
    assert MODEL.motor * current(-3.0) == pytest.approx(-3.0 / T_S - MODEL.coulomb)
    assert current(0.0) == 0.0


def followed(kind: str, delay: int, count: int, plant: str = "exact") -> tuple[Floats, Floats]:
    """States of the estimator [steps, N, STATE] under an excitation, and the true relative parameters [N, 4]."""
    conditions = Conditions(information="physical", randomised=Randomisation(command_delay=(delay, delay)))
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, count, compiled, plant, conditions)
    for i, draw in enumerate(fresh_draws(PM50, 11, count)):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)
    rng, kept, fast = np.random.default_rng(4), stored("four-d-exact-delay-quadratic"), compiled(act)
    loop = kept.loop(BENCH)
    states, found = np.tile(start(MODEL), (count, 1)), []
    for k in range(BENCH.timing.horizon):
        seen = batch.seen().astype(float)
        asked = [fast(MODEL, loop, kept.array(), s, *row) for s, row in zip(states, seen.tolist(), strict=True)]
        if kind == "random":
            asked = rng.uniform(-6.0, 6.0, count).tolist()
        elif kind == "constant":
            asked = [3.0] * count
        batch.advance(np.array(asked))
        if k in (60, 150, 300, 499):
            found.append(states.copy())
    return np.array(found), batch.brakes[:, COLUMNS] / NOMINAL


@pytest.mark.parametrize(("kind", "delay"), [("random", 0), ("random", 2), ("constant", 1), ("tuned", 0), ("tuned", 2)])
def test_errors_are_as_large_as_the_filter_says_on_the_exact_brake_whatever_the_delay(kind: str, delay: int) -> None:
    states, truth = followed(kind, delay, 200)
    for state in states:
        errors = state[:, PARAMETERS:COVARIANCE] - truth
        covariance = unpack(state[:, COVARIANCE:INNOVATION], UNKNOWNS)[:, 2:, 2:]
        shares = errors / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        spread = np.sqrt((shares**2).mean(axis=0))
        assert spread.min() > 0.75
        assert spread.max() < 1.3
        squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
        assert (squares < chi2.ppf(0.95, 4)).mean() > 0.85  # 0.95 of a linear model
        assert squares.max() < 60.0
        assert (state[:, WORST] < MISFIT).all()


@pytest.mark.parametrize("plant", ["euler", "stribeck", "lag", "rough"])
def test_a_brake_that_is_not_the_filter_s_is_noticed(plant: str) -> None:
    states, _ = followed("tuned", 0, 12, plant)
    assert (states[-1, :, WORST] > MISFIT).all()


def test_of_a_model_that_did_not_fit_once_nothing_is_believed_that_was_not_known_before() -> None:
    actor = actor_of(stored("four-d-exact-delay-quadratic"), BENCH)
    state = actor.initial_state[None].clone()
    state[:, COVARIANCE:INNOVATION] *= 1e-6
    seen = torch.zeros(1, 4)
    with torch.no_grad():
        _, _, sure = actor(seen, state)
        state[:, WORST] = MISFIT + 0.1
        _, following, doubted = actor(seen, state)
    prior = (np.array(MODEL.high) - np.array(MODEL.low)) / math.sqrt(12.0) * NOMINAL
    assert (sure[0, 4:].numpy() < 0.01 * prior).all()
    assert doubted[0, 4:].numpy() == pytest.approx(prior, rel=1e-6)
    assert doubted[0, :4].numpy() == pytest.approx(sure[0, :4].numpy())
    assert following[0, WORST] == pytest.approx(MISFIT + 0.1)


def test_the_running_mean_of_the_innovations_is_kept_and_so_is_its_greatest() -> None:
    state = start(MODEL)
    follow(MODEL, state, 30.0, 0.0, 0.0, 0.0)  # 60 standard deviations from home
    assert state[INNOVATION] > 20.0
    assert state[WORST] == state[INNOVATION]
    worst = state[WORST]
    for _ in range(200):
        follow(MODEL, state, state[1], state[2], 0.0, 0.0)
    assert state[INNOVATION] < 2.0
    assert state[WORST] == worst


@pytest.mark.parametrize(
    ("name", "least"), [("four-d-exact-delay-quadratic", 99.5), ("four-e-exact-delay-quadratic", 22.0)]
)
def test_references_for_the_exact_brake_beat_a_constant_speed_with_delays_and_come_home(
    name: str, least: float
) -> None:
    kept = stored(name)
    task = kept.asked()
    assert (kept.plant, task.conditions.randomised.command_delay) == ("exact", (0, 2))
    (outcome,) = task.trials(BENCH, task.draws(BENCH, 3, 24)).play(kept.loop(BENCH), kept.array()[None])
    assert task.score(outcome).mean() > least  # constant-speed:turn=0.15 is worth 96.8 (D) without a delay
    assert outcome.home.all()
    assert not outcome.left.any()


def test_a_module_for_many_is_one_for_each() -> None:
    kept = stored("four-d-exact-delay-quadratic")
    actor = StructuredActor(BENCH, PM50, "exact", kept.loop(BENCH), kept.array())
    rng = np.random.default_rng(2)
    seen = np.column_stack((rng.uniform(-1, 5, 6), rng.uniform(-30, 30, 6), np.arange(6), rng.uniform(-6, 6, 6)))
    with torch.no_grad():
        together = actor(torch.tensor(seen, dtype=torch.float32), actor.initial_state.repeat(6, 1))
        for i in range(6):
            alone = actor(torch.tensor(seen[i : i + 1], dtype=torch.float32), actor.initial_state[None])
            for many, one in zip(together, alone, strict=True):
                assert many[i].numpy() == pytest.approx(one[0].numpy(), rel=1e-9, abs=1e-12)
    assert together[1].shape == (6, STATE)


def test_every_packaged_reference_is_made_by_a_command_that_exists_and_keeps_what_it_was_tuned_for() -> None:
    for name in reference_names():
        kept = stored(name)
        program, command, *options = shlex.split(kept.command)
        assert (program, command) == ("emb-train", "tune")
        asked = parser().parse_args(options)
        assert (asked.task, asked.form, asked.plant, asked.gain) == (kept.task, kept.form, kept.plant, kept.gain), name
        assert (asked.shield, tuple(asked.command_delay), asked.seed) == (kept.shield, kept.command_delay, kept.seed)
        assert kept.draws == asked.steps * BATCH
        assert asked.out.name == f"{name}.json"


def test_a_search_keeps_the_delays_it_met_and_a_blind_one_depends_on_no_estimate(tmp_path: Path) -> None:
    blind, found = tmp_path / "blind.json", tmp_path / "found.json"
    options = ["--command-delay", "1", "2", "--gain", "0.3", "--steps", "2"]
    assert main(["four-d", "--form", "blind", "--begin=1,-1,0,0.3,0.6", *options, "--out", str(blind)]) == EXIT_DONE
    assert main(["four-d", "--start", str(blind), *options, "--out", str(found)]) == EXIT_DONE
    assert not stored(str(blind)).array()[:, 1:].any()
    kept = stored(str(found))
    assert kept.asked().conditions.randomised.command_delay == kept.command_delay == (1, 2)
    assert (kept.form, kept.draws) == ("quadratic", 2 * BATCH)


def test_a_search_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    out = str(tmp_path / "a.json")
    for options in (
        ["--steps", "0"],
        ["--seed", "-1"],
        ["--gain", "0"],
        ["--gain", "1.1"],
        ["--begin=1,-1"],
        ["--begin=1,nan,2"],
        ["--begin=one"],
        ["--start", "none"],
        ["--start", "four-d-exact-quadratic", "--form", "blind"],
        ["--plant", "none"],
        ["--out", str(tmp_path)],
        ["--out", str(tmp_path / "none" / "a.json")],
    ):
        assert main(["four-d", "--steps", "1", "--out", out, *options]) == EXIT_USAGE, options
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("delay", [[0], [2, 1], [0, 99], [0, 1.5], [-1, 0]])
def test_a_kept_delay_that_is_none_is_refused(delay: list[float]) -> None:
    record = json.loads(stored("four-d-exact-delay-quadratic").to_json())
    with pytest.raises(UsageError, match="mine: command_delay: "):
        read_text(json.dumps({**record, "command_delay": delay}), "mine")
