"""References: what they are, what they are worth, and the errors of their estimates."""

from __future__ import annotations

import dataclasses
import json
import shlex
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from emb_bench.excitation import parse_excitation
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.estimator.kalman import MISFIT, State, follow, make_model, start
from emb_runtime.estimator.speed_loop import scale_of
from emb_train.cli import parser
from emb_train.closed_loop import Batch, Conditions
from emb_train.evolve import BATCH
from emb_train.plan import BRAKES
from emb_train.play import Draw, Law, fresh_draws, play
from emb_train.presets import reference_names
from emb_train.reference import (
    PRODUCTS,
    TERMS,
    Following,
    box_of,
    features,
    of_features,
    read_text,
    set_reference,
    stored,
    wanted_current,
)
from emb_train.trial import TASKS, Task, Trials
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
PM50 = BENCH.range_set("pm50")
BOX, SCALE = box_of(BENCH, PM50), scale_of(BENCH)
NOMINAL = np.array([getattr(BENCH.brake, n) for n in PARAMETER_NAMES])
COLUMNS = [BrakeParameters._fields.index(n) for n in PARAMETER_NAMES]
HORIZON = BENCH.timing.horizon
OUT_AND_BACK = np.zeros((5, TERMS))
OUT_AND_BACK[:, 0] = [1.0, -1.0, -0.01, 0.3, 0.6]
LEANING = OUT_AND_BACK.copy()
LEANING[:, 1:] = np.random.default_rng(4).uniform(-0.03, 0.03, (5, TERMS - 1))


@given(st.tuples(*[st.floats(0.4, 1.6)] * 4), st.integers(0, 10**6))
def test_a_level_is_the_clipped_polynomial_of_the_scaled_logarithms(
    relative: tuple[float, float, float, float], seed: int
) -> None:
    table = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, TERMS))
    f = np.interp(np.log(relative), np.log([0.5, 1.5]), [-1.0, 1.0])
    found = features(BOX, relative)
    assert found == pytest.approx(tuple(f), abs=1e-12)
    expected = table @ [1.0, *f, *(f[i] * f[j] for i, j in PRODUCTS)]
    assert [of_features(row, found) for row in table] == pytest.approx(expected, abs=1e-12)
    reference = np.zeros(3)
    set_reference(table, found, reference)
    assert reference == pytest.approx(np.clip(expected, -1.0, 1.0), abs=1e-12)
    known = box_of(BENCH, BENCH.range_set("viscous"))
    assert features(known, relative)[:3] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("plant", ["euler", "exact"])
def test_a_trial_is_the_environments_experiment_with_the_runtimes_functions(plant: str) -> None:
    draws, conditions = fresh_draws(PM50, 9, 3), Conditions(information="physical")
    (outcome,) = Trials(BENCH, PM50, PARAMETER_NAMES, draws, plant, conditions).play(SCALE, [LEANING])
    model = make_model(BENCH, PM50, sticks=plant == "exact")
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, 3, plant, conditions)
    for i, draw in enumerate(draws):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)
    states, reference = [start(model)] * 3, np.zeros(5)
    for k in range(HORIZON):
        rows = zip(states, batch.y.tolist(), batch.x[:, 3].tolist(), strict=True)
        states = [follow(model, s, y1, y2, float(k), u) for s, (y1, y2), u in rows]
        wanted = [wanted_current(model, s, SCALE, BOX, LEANING, reference) for s in states]
        batch.advance(np.array(wanted))
    assert outcome.matrices.tolist() == unpack(batch.m, 4).tolist()
    assert outcome.home.tolist() == batch.home.tolist()


def test_a_reference_as_an_excitation_is_the_trial() -> None:
    kept, draws = stored("four-d-exact-quadratic"), fresh_draws(PM50, 9, 4)
    conditions = Conditions(information="physical")
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, draws, "exact", conditions)
    (tuned,) = trials.play(kept.scale(BENCH), [kept.array()])
    played = play(BENCH, PM50, PARAMETER_NAMES, Following(kept, BENCH, PM50), draws, "exact", conditions)
    # What is seen is rounded to single precision.
    assert np.linalg.slogdet(played.matrices)[1] == pytest.approx(np.linalg.slogdet(tuned.matrices)[1], abs=0.05)
    assert played.home.all()


def test_an_experiment_that_leaves_the_limits_keeps_its_information_until_then() -> None:
    p = BENCH.brake  # its braking is outside of what the shield covers, its motor is not
    strong = p._replace(k_m=0.55 * p.k_m, k_1=-2.0 * p.k_1)
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, [Draw(0, strong), Draw(1, BENCH.brake)])
    (outcome,) = trials.play(SCALE, [OUT_AND_BACK])
    assert (outcome.left.tolist(), outcome.home.tolist()) == ([True, False], [False, True])
    assert 0.0 < outcome.matrices[0, 0, 0] < outcome.matrices[1, 0, 0]


def test_two_references_meet_the_same_brakes_and_noise() -> None:
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, fresh_draws(PM50, 2, 70))  # more than one chunk
    one, two = trials.play(SCALE, [OUT_AND_BACK, OUT_AND_BACK])
    assert one.matrices.tolist() == two.matrices.tolist()
    assert len(one.matrices) == 70


def test_ranges_in_which_the_inertia_varies_are_refused() -> None:
    wide = dataclasses.replace(PM50, high=PM50.high._replace(J=2.0 * BENCH.brake.J))
    with pytest.raises(UsageError):
        Trials(BENCH, wide, PARAMETER_NAMES, [])


# The errors of the estimate -------------------------------------------------------------------------------------------


def followed(kind: str, delay: int, count: int, plant: str = "exact") -> tuple[list[list[State]], Floats]:
    """States of N estimators at some steps under an excitation, and the true relative parameters [N, 4]."""
    conditions = Conditions(information="physical", command_delay=(delay, delay))
    batch = Batch(BENCH, PM50, PARAMETER_NAMES, count, plant, conditions)
    for i, draw in enumerate(fresh_draws(PM50, 11, count)):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)
    rng, found = np.random.default_rng(4), []
    excitation = Following(stored("four-d-exact-delay-quadratic"), BENCH, PM50)
    excitation.begin(count)
    for k in range(HORIZON):
        wanted = excitation(batch.seen())
        batch.advance({"random": rng.uniform(-6.0, 6.0, count), "constant": np.full(count, 3.0)}.get(kind, wanted))
        if k in (60, 150, 300, 499):
            found.append(excitation.states.copy())
    return found, batch.brakes[:, COLUMNS] / NOMINAL


AT_NIGHT = [pytest.param(*row, marks=pytest.mark.slow) for row in (("random", 2), ("constant", 1), ("tuned", 0))]


@pytest.mark.parametrize(("kind", "delay"), [("random", 0), ("tuned", 2), *AT_NIGHT])
def test_errors_are_as_large_as_the_filter_says_whatever_the_delay(kind: str, delay: int) -> None:
    found, truth = followed(kind, delay, 200)
    for states in found:
        errors = np.array([s.mean[2:] for s in states]) - truth
        covariance = unpack(np.array([s.covariance for s in states]), 6)[:, 2:, 2:]
        shares = errors / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        spread = np.sqrt((shares**2).mean(axis=0))
        assert 0.75 < spread.min() < spread.max() < 1.3
        squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
        assert (squares < chi2.ppf(0.95, 4)).mean() > 0.85  # 0.95 of a linear model
        assert squares.max() < 60.0
        assert max(s.worst for s in states) < MISFIT


def test_a_brake_that_is_not_the_filters_is_noticed() -> None:
    for plant in ("euler", "stribeck", "lag", "rough"):
        states, _ = followed("tuned", 0, 12, plant)
        assert min(s.worst for s in states[-1]) > MISFIT, plant


# Those that are kept --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["four-d-exact-delay-quadratic", "four-e-exact-delay-quadratic"])
def test_references_for_delays_beat_a_constant_speed_on_the_same_brakes_and_come_home(name: str) -> None:
    kept = stored(name)
    task = Task.of(kept)
    assert (kept.plant, task.conditions.command_delay) == ("exact", (0, 2))
    draws = task.draws(BENCH, 3, 24)
    (outcome,) = task.trials(BENCH, draws).play(kept.scale(BENCH), [kept.array()])
    constant = Law(parse_excitation("constant-speed:turn=0.15", BENCH).law)
    beaten = play(BENCH, PM50, task.parameters, constant, draws, kept.plant, task.conditions)
    more = task.score(outcome) - task.score(beaten)
    assert more.mean() > 5.0 * more.std() / np.sqrt(len(draws))  # whichever brakes are drawn
    assert outcome.home.all()
    assert not outcome.left.any()


def test_every_packaged_reference_is_made_by_a_command_that_exists_and_keeps_what_it_was_tuned_for() -> None:
    for name in reference_names():
        kept = stored(name)
        program, command, *options = shlex.split(kept.command)
        assert (program, command) == ("emb-train", "reference")
        asked = parser().parse_args([command, *options])
        task = TASKS[asked.task]
        assert (asked.task, asked.plant, asked.gain) == (kept.task, kept.plant, kept.gain), name
        assert kept.form == (asked.form or task.form)
        assert (tuple(asked.command_delay), asked.seed) == (kept.command_delay, kept.seed)
        assert kept.draws == (BRAKES if asked.task == "four-t" else (asked.steps or task.steps) * BATCH)
        assert asked.output.name == name


def test_a_kept_delay_that_is_none_is_refused() -> None:
    record: dict[str, Any] = json.loads(stored("four-d-exact-delay-quadratic").to_json())
    for delay in ([0], [2, 1], [0, 99], [0, 1.5], [-1, 0]):
        with pytest.raises(UsageError, match="command_delay"):
            read_text(json.dumps({**record, "command_delay": delay}), "mine")
