"""What differs from one experiment to the next beside the brake: as the simulated node has it, drawn and covered."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.sim.node import BrakeNode
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, load_bench
from emb_runtime.config.plants import Instruments, Mechanics, Plant
from emb_runtime.errors import UsageError
from emb_runtime.records import CurrentCommand, Reason
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import (
    NOTHING_RANDOM,
    OWN,
    Conditions,
    Randomisation,
    drawn,
    instruments_of,
    longest_loss,
    mechanics_of,
    parse_randomisation,
)
from emb_train.envs.critic_view import EXTRA, critic_size
from emb_train.envs.env import EmbExcitationEnv, EmbExcitationVectorEnv
from emb_train.envs.excitations import Played
from emb_train.envs.measure import MEASURES
from emb_train.envs.play import fresh_draws, play
from emb_train.evaluate import references
from emb_train.rewards import Transition
from emb_train.structured.played import Following
from emb_train.structured.stored import stored
from emb_train.structured.trial import Trials

BENCH = load_bench()
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
PM50 = BENCH.range_set("pm50")
OPEN = Conditions(shielded=False)  # So that what is wanted is what is sent


def with_(conditions: Conditions = OPEN, **randomised: Any) -> Conditions:
    return msgspec.structs.replace(conditions, randomised=Randomisation(**randomised))


def trace_increment(t: Transition) -> Any:
    """A reward for any number of parameters."""
    return (t.after - t.before).sum(axis=1)


# --- against the simulated node ----------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**40),
    delays=st.tuples(st.integers(0, 3), st.integers(0, 2)),
    lag=st.sampled_from([0.0, 0.002]),
    offset=st.floats(-0.3, 0.3),
    loss=st.sampled_from([0.0, 0.3]),
)
@settings(max_examples=12, deadline=None)
def test_an_experiment_is_what_the_node_makes_of_the_same_commands(
    seed: int, delays: tuple[int, int], lag: float, offset: float, loss: float
) -> None:
    """The node is told plant and losses, the environment draws them from ranges without width."""
    layout, exact = load_layout(), BENCH.plant("exact")
    conditions = with_(
        command_delay=(delays[0],) * 2,
        measurement_delay=(delays[1],) * 2,
        current_lag=(lag, lag),
        encoder_offset=(offset, offset),
        frame_loss=(loss, loss),
    )
    batch = Batch(SHORT, PM50, ("f_v",), 1, plant="exact", conditions=conditions)
    batch.begin(0, np.random.default_rng(seed))
    lost = batch.experiments.lost[0]
    sides = exact.instruments._replace(command_delay=delays[0], measurement_delay=delays[1], encoder_offset=offset)
    noise = iter([(*errors, 0.0) for errors in batch.experiments.noise[0].tolist()])
    plant = Plant("told", exact.mechanics._replace(current_lag=lag), sides)
    node = BrakeNode(SHORT, layout, BrakeParameters(*batch.brakes[0].tolist()), lambda: next(noise), plant)
    step = layout.command.signal("Current").factor
    steps, frames = np.random.default_rng(seed).integers(-2000, 2000, SHORT.timing.horizon), node.tick()
    commands = 0
    for k in range(SHORT.timing.horizon):
        said, applied = layout.decode_angle(frames[0]), layout.decode_velocity(frames[1])
        if not lost[k]:
            assert batch.y[0, 0] == pytest.approx(said.angle, abs=1e-3)  # the frame's resolution
            assert batch.y[0, 1] == pytest.approx(applied.velocity, abs=0.05)
            assert batch.experiments.applied[0] == pytest.approx(applied.applied_current, abs=1.01 * step)
            node.receive(layout.encode_command(CurrentCommand(commands % 15, said.counter, steps[k] * step, True)))
            commands += 1
        batch.advance(np.array([np.nan if lost[k] else steps[k] * step]))
        frames = node.tick()
        # Its own braking is rounded to the frame's resolution.
        assert batch.x[0, 0] == pytest.approx(node.angle, abs=1e-3 if loss else 1e-9)
        assert batch.x[0, 1] == pytest.approx(node.velocity, abs=0.1 if loss else 1e-6)


def test_in_a_lost_period_nothing_is_sent_the_node_brakes_and_what_was_heard_stays_what_is_known() -> None:
    conditions = with_(frame_loss=(0.0, 0.1))
    batch = Batch(BENCH, BENCH.range_set("nominal"), ("f_v",), 2, plant="euler", conditions=conditions)
    for i in range(2):
        batch.begin(i, np.random.default_rng(0), BENCH.brake)
    batch.experiments.lost[:] = False
    batch.experiments.lost[:, 20] = True
    for _ in range(19):
        batch.advance(np.array([3.0, 3.0]))
    heard, velocity = batch.y.copy(), batch.x[0, 1]
    batch.advance(np.array([3.0, 3.0]))  # answers sample 19; sample 20 does not come
    assert (batch.y == heard).all()
    assert not batch.heard.any()
    assert batch.observation()[0].tolist() == [*heard[0].astype(np.float32), 20.0]
    assert np.isnan(batch.seen()[:, [0, 1, 3]]).all()
    assert (batch.seen()[:, 2] == 20.0).all()
    x1, x2 = batch.x[0, :2]
    assert x2 > velocity > 0.0
    batch.advance(np.array([6.0, np.nan]))  # whatever is wanted
    p, braked = BENCH.brake, -6.0 * x2 / BENCH.node.damping_velocity
    assert braked < 0.0
    slope = p.k_m * max(braked, -6.0) - p.gamma * p.k_1 * max(x1, 0.0) - p.T_c - p.f_v * x2
    for row in range(2):
        np.testing.assert_allclose(batch.x[row, :2], [x1 + 1e-3 * x2, x2 + 1e-3 * slope / p.J], rtol=1e-12)
    assert batch.reasons.tolist() == [Reason.MISSED, Reason.MISSED]
    assert batch.past[0].tolist() == [0.0, 3.0, 3.0, 3.0, 3.0]
    assert batch.heard.all()
    np.testing.assert_allclose(batch.y, batch.x[:, :2] + batch.experiments.noise[:, 21], rtol=1e-12)
    np.testing.assert_allclose(batch.seen()[:, 3], max(braked, -6.0), rtol=1e-6)


def test_a_loss_brakes_when_its_command_would_have_acted() -> None:
    conditions = with_(frame_loss=(0.0, 0.1), command_delay=(2, 2))
    batch = Batch(BENCH, BENCH.range_set("nominal"), ("f_v",), 1, conditions=conditions)
    batch.begin(0, np.random.default_rng(0))
    batch.experiments.lost[:] = False
    batch.experiments.lost[0, 5] = True
    acted = []
    for _ in range(10):
        batch.advance(np.array([2.0]))
        acted.append(float(batch.x[0, 3]))
    assert [u == 2.0 for u in acted] == [False, False, *[True] * 5, False, True, True]
    assert acted[:2] == [0.0, 0.0]
    assert acted[7] < 0.0


def test_a_node_that_lets_go_gives_no_current_in_a_lost_period() -> None:
    bench = dataclasses.replace(BENCH, node=dataclasses.replace(BENCH.node, stop="freewheel"))
    batch = Batch(bench, bench.range_set("nominal"), ("f_v",), 1, conditions=with_(frame_loss=(0.0, 0.1)))
    batch.begin(0, np.random.default_rng(0))
    batch.experiments.lost[:] = False
    batch.experiments.lost[0, 5] = True
    for _ in range(6):
        batch.advance(np.array([2.0]))
    assert batch.x[0, 1] > 0.0
    assert batch.x[0, 3] == 0.0


# --- what is drawn -------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**40),
    delay=st.tuples(st.integers(0, 5), st.integers(0, 5)).map(sorted),
    loss=st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 0.5)).map(sorted),
    longest=st.integers(0, 12),
)
def test_what_is_drawn_lies_in_its_range_and_no_loss_ends_a_run(
    seed: int, delay: list[int], loss: list[float], longest: int
) -> None:
    randomised = Randomisation(
        command_delay=(delay[0], delay[1]), frame_loss=(loss[0], loss[1]), current_lag=(0.0, 2e-5)
    )
    own, lost = drawn(randomised, np.random.default_rng(seed), 501, longest)
    found = dict(zip(OWN, own.tolist(), strict=True))
    assert found["command_delay"] in range(delay[0], delay[1] + 1)
    assert loss[0] <= found["frame_loss"] <= loss[1]
    assert found["current_lag"] == 0.0 or 1e-5 <= found["current_lag"] <= 2e-5
    assert (found["measurement_delay"], found["encoder_offset"]) == (0.0, 0.0)
    assert not lost[0]
    assert not lost[-1]
    in_a_row = max(len(run) for run in "".join("x" if v else " " for v in lost).split(" "))
    assert in_a_row <= longest


def test_every_delay_comes_equally_often_and_as_many_samples_are_lost_as_the_probability_says() -> None:
    randomised = Randomisation(command_delay=(1, 3), frame_loss=(0.1, 0.1))
    rng, found = np.random.default_rng(0), []
    lost = np.zeros((3000, 501), np.bool_)
    for i in range(3000):
        own, lost[i] = drawn(randomised, rng, 501, 9)
        found.append(own[0])
    assert np.bincount(np.array(found, np.int64)).tolist() == pytest.approx([0, 1000, 1000, 1000], abs=110)
    assert lost[:, 1:-1].mean() == pytest.approx(0.1, rel=0.01)
    assert longest_loss(BENCH) == 9  # its watchdog takes 10 ms, see the test of the node's safe stop
    assert np.corrcoef(lost[:, 1:-2].ravel(), lost[:, 2:-1].ravel())[0, 1] == pytest.approx(0.0, abs=0.01)


def test_what_is_randomised_changes_neither_the_brakes_nor_the_noise() -> None:
    batches = [Batch(SHORT, PM50, ("f_v",), 1, conditions=c) for c in (OPEN, with_(frame_loss=(0.1, 0.2)))]
    for batch in batches:
        batch.begin(0, np.random.default_rng(4))
    np.testing.assert_array_equal(batches[0].brakes, batches[1].brakes)
    np.testing.assert_array_equal(batches[0].experiments.noise, batches[1].experiments.noise)
    assert not batches[0].experiments.lost.any()
    assert batches[1].experiments.lost.any()


# --- one environment, two speeds -----------------------------------------------------------------------------------

ALL = with_(
    command_delay=(0, 2),
    measurement_delay=(0, 1),
    frame_loss=(0.0, 0.2),
    current_lag=(0.0, 0.002),
    encoder_offset=(-0.1, 0.1),
)
KIND: dict[str, Any] = {
    "bench": SHORT, "ranges": "pm50", "parameters": PARAMETER_NAMES, "reward": trace_increment, "plant": "exact",
    "conditions": ALL,
}  # fmt: skip


def test_the_vector_environment_is_the_scalar_one_whatever_is_randomised() -> None:
    many, ones = EmbExcitationVectorEnv(3, **KIND), [EmbExcitationEnv(**KIND) for _ in range(3)]
    seen, info = many.reset(seed=11)
    np.testing.assert_array_equal(seen, np.stack([env.reset(seed=11 + i)[0] for i, env in enumerate(ones)]))
    assert info["critic"].shape == (3, critic_size(4) + EXTRA)
    unheard = 0
    for k in range(70):  # into the second experiment
        actions = np.full((3, 1), 0.4 if k % 20 < 10 else -0.4, np.float32)
        seen, rewards, terminated, _, info = many.step(actions)
        for i, env in enumerate(ones):
            now, reward, over, _, told = env.step(actions[i])
            assert (rewards[i], terminated[i]) == (reward, over)
            if over:
                now, told = env.reset()
            np.testing.assert_array_equal(seen[i], now)
            np.testing.assert_array_equal(info["critic"][i], told["critic"])
            unheard += not told["heard"]
            assert info["heard"][i] == told["heard"]
    assert unheard > 0


def test_the_critic_is_told_what_an_experiment_has_of_its_own() -> None:
    batch = Batch(SHORT, PM50, PARAMETER_NAMES, 1, plant="exact", conditions=ALL)
    batch.begin(0, np.random.default_rng(2))
    batch.experiments.own[0] = [2, 0, 0.05, 0.001, -0.1]
    batch.experiments.lost[0] = np.arange(61) == 3
    for u in (1.5, -3.0, 6.0):
        batch.advance(np.array([u]))
    told = batch.critic_observation()[0, critic_size(4) :]
    assert told[:5] == pytest.approx([1.0, -1.0, -0.5, 0.0, -1.0], abs=1e-6)
    assert told[5] == 0.0  # not heard
    assert told[6] == pytest.approx(batch.x[0, 3] / 6.0)
    assert told[7:] == pytest.approx([1.0, -0.5, 0.25, 0.0, 0.0])


# --- the shield ----------------------------------------------------------------------------------------------------


def test_the_shield_covers_the_delay_or_lag_that_is_randomised_and_the_losses() -> None:
    draws = fresh_draws(PM50, 5, 40)
    for randomised in (
        Randomisation(command_delay=(0, 2), frame_loss=(0.0, 0.05)),
        Randomisation(measurement_delay=(1, 1), command_delay=(0, 1)),
        Randomisation(current_lag=(0.0, 0.002), frame_loss=(0.02, 0.02)),
    ):
        conditions = Conditions(randomised=randomised)
        for current in (6.0, -6.0):
            outcome = play(BENCH, PM50, PARAMETER_NAMES, Played(np.full(500, current)), draws, "exact", conditions)
            assert not outcome.left.any()


def test_the_shield_is_made_for_what_is_randomised_and_for_nothing_more() -> None:
    plain = Conditions().applied(BENCH).shield
    wide = with_(Conditions(), command_delay=(1, 2), measurement_delay=(0, 1)).applied(BENCH)
    assert wide.shield == plain._replace(frame_age=(0, 3))
    assert with_(Conditions(), command_delay=(1, 2)).applied(wide) == wide
    assert with_(Conditions(), current_lag=(0.0, 0.001)).applied(BENCH).shield.current_lag == 0.001
    assert with_(frame_loss=(0.0, 0.1)).applied(BENCH).shield == plain
    assert with_(command_delay=(5, 5), measurement_delay=(5, 5)).applied(BENCH).shield == plain  # there is none


def test_what_no_shield_covers_is_refused_where_there_is_one() -> None:
    def made(plant: str, conditions: Conditions) -> Batch:
        return Batch(BENCH, PM50, ("f_v",), 1, plant=plant, conditions=conditions)

    cases: list[tuple[str, dict[str, Any]]] = [
        ("exact", {"command_delay": (0, 3), "measurement_delay": (0, 3)}),
        ("exact", {"command_delay": (0, 1), "current_lag": (0.0, 0.001)}),
        ("late", {"command_delay": (0, 1)}),  # the sum of what the plant has and what is randomised
        ("late", {"measurement_delay": (1, 1)}),
        ("lag", {"current_lag": (0.0, 0.001)}),
    ]
    for plant, randomised in cases:
        with pytest.raises(UsageError):
            made(plant, with_(Conditions(), **randomised))
        made(plant, with_(OPEN, **randomised))
    made("late", with_(Conditions(), encoder_offset=(0.0, 0.1), frame_loss=(0.0, 0.1)))
    made("lag", with_(Conditions(), frame_loss=(0.0, 0.1)))


def test_a_lag_or_delay_that_the_plant_cannot_have_is_refused() -> None:
    slow = Plant("slow", BENCH.plant("exact").mechanics, BENCH.plant("exact").instruments._replace(command_delay=6))
    bench = dataclasses.replace(BENCH, plants={**BENCH.plants, "slow": slow})
    for plant, conditions in (
        ("euler", with_(current_lag=(0.0, 0.001))),
        ("slow", with_(command_delay=(0, 5))),  # 11 samples: the instruments remember 10
    ):
        with pytest.raises(UsageError):
            Batch(bench, PM50, ("f_v",), 1, plant=plant, conditions=conditions)


# --- excitations ---------------------------------------------------------------------------------------------------

LOSSY = with_(Conditions(information="physical"), frame_loss=(0.05, 0.05))


class Counted(Played):
    """A sequence of currents that remembers what it has seen."""

    def __init__(self) -> None:
        super().__init__(np.full(BENCH.timing.horizon, 2.0))
        self.seen: list[Any] = []

    def __call__(self, seen: Any) -> Any:
        self.seen.append(seen.copy())
        return super().__call__(seen)


def test_an_excitation_sees_nothing_but_the_step_of_a_sample_that_is_lost() -> None:
    counted = Counted()
    play(BENCH, PM50, ("f_v",), counted, fresh_draws(PM50, 1, 8), conditions=LOSSY)
    seen = np.stack(counted.seen)
    missing = np.isnan(seen[:, :, 0])
    assert missing.mean() == pytest.approx(0.05, abs=0.015)
    assert (np.isnan(seen[:, :, [1, 3]]) == missing[:, :, None]).all()
    np.testing.assert_array_equal(seen[:, :, 2], np.arange(500.0)[:, None].repeat(8, 1))


def test_every_reference_excitation_can_be_played_where_samples_are_lost() -> None:
    draws = fresh_draws(PM50, 1, 2)
    for name, excitation in references(BENCH).items():
        outcome = play(BENCH, PM50, ("f_v",), excitation, draws, conditions=LOSSY)
        assert np.isfinite(outcome.matrices).all(), name


def test_a_reference_that_nobody_asks_keeps_its_estimate_in_training_as_in_evaluation() -> None:
    kept, draws = stored("four-d-exact-quadratic"), fresh_draws(PM50, 9, 4)
    trials = Trials(BENCH, PM50, PARAMETER_NAMES, draws, "exact", LOSSY)
    (tuned,) = trials.play(kept.scale(BENCH), kept.array()[None])
    actor = Following(kept, BENCH, PM50)
    played = play(BENCH, PM50, PARAMETER_NAMES, actor, draws, "exact", LOSSY)
    values = MEASURES["D"].values
    assert values(played.matrices) == pytest.approx(values(tuned.matrices), abs=0.05)


def test_a_command_line_says_what_is_randomised() -> None:
    assert parse_randomisation([]) == NOTHING_RANDOM
    found = parse_randomisation(["command_delay=0,2", "encoder_offset=-0.1,0.1"])
    assert found == Randomisation(command_delay=(0, 2), encoder_offset=(-0.1, 0.1))
    assert found.delay == (0, 2)


def test_what_cannot_be_randomised_is_refused() -> None:
    for texts in (
        ["delay=0,1"],
        ["command_delay=0,1", "command_delay=0,2"],
        ["command_delay=1"],
        ["command_delay=0,0.5"],
        ["current_lag=0,x"],
        ["command_delay=0,6"],
        ["frame_loss=0.2,0.1"],
        ["current_lag=nan,nan"],
        ["encoder_offset=-11,0"],
    ):
        with pytest.raises(UsageError):
            parse_randomisation(texts)


def test_every_experiment_keeps_all_features_of_its_plant_but_what_is_its_own() -> None:
    mechanics = Mechanics(*range(1, 1 + len(Mechanics._fields)))
    instruments = Instruments(*range(1, 1 + len(Instruments._fields)))
    nothing = np.zeros((1, len(OWN)))
    assert mechanics_of(mechanics, nothing, 0) == mechanics
    assert instruments_of(instruments, nothing, 0) == instruments
