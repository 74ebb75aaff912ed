"""Batches of experiments: they send what a run sends, and do what the node does, late and lost samples included."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import Instruments, Plant
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import sent_current
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.records import CurrentCommand, Reason
from emb_runtime.safety.command_limits import LEFT
from emb_runtime.safety.sensor_monitor import CONFIRMED, OBEYS, largest_current
from emb_runtime.safety.sensor_monitor import begin as begin_monitor
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import make_law
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Conditions, delayed, longest_loss
from emb_train.evaluate import references
from emb_train.play import Played, fresh_draws, play

BENCH = load_bench()
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
PM50 = BENCH.range_set("pm50")
OPEN = Conditions(shielded=False)  # So that what is wanted is what is sent


def with_(conditions: Conditions = OPEN, **changes: Any) -> Conditions:
    return msgspec.structs.replace(conditions, **changes)


@given(
    seed=st.integers(0, 2**40),
    delay=st.integers(0, 3),
    loss=st.sampled_from([0.0, 0.3]),
    stop=st.sampled_from(["damped", "freewheel"]),
)
@settings(max_examples=20, deadline=None)
def test_an_experiment_is_what_the_node_makes_of_the_same_commands(
    seed: int, delay: int, loss: float, stop: Literal["damped", "freewheel"]
) -> None:
    """The node has the delay and the losses that the environment draws from ranges without width."""
    layout, exact = load_layout(), BENCH.plant("exact")
    bench = dataclasses.replace(SHORT, node=dataclasses.replace(SHORT.node, stop=stop))
    conditions = with_(command_delay=(delay, delay), frame_loss=(loss, loss))
    batch = Batch(bench, PM50, ("f_v",), 1, plant="exact", conditions=conditions)
    batch.begin(0, np.random.default_rng(seed))
    lost = batch.experiments.lost[0]
    sides = exact.instruments._replace(command_delay=delay)
    noise = iter([(*errors, 0.0) for errors in batch.experiments.noise[0].tolist()])
    node = BrakeNode(
        bench,
        layout,
        BrakeParameters(*batch.brakes[0].tolist()),
        lambda: next(noise),
        Plant("told", exact.mechanics, sides),
    )
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


def test_in_a_lost_period_nothing_is_sent_the_node_brakes_and_the_last_sample_stays() -> None:
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
    assert batch.x[0, 1] > velocity > 0.0
    braked = -6.0 * batch.x[0, 1] / BENCH.node.damping_velocity
    batch.advance(np.array([6.0, np.nan]))  # whatever is wanted
    assert batch.x[0].tolist() == batch.x[1].tolist()
    assert batch.reasons.tolist() == [Reason.MISSED, Reason.MISSED]
    assert batch.past[0].tolist() == [0.0, 3.0, 3.0, 3.0, 3.0]
    assert batch.heard.all()
    np.testing.assert_allclose(batch.y, batch.x[:, :2] + batch.experiments.noise[:, 21], rtol=1e-12)
    np.testing.assert_allclose(batch.seen()[:, 3], max(braked, -6.0), rtol=1e-6)


@given(
    seed=st.integers(0, 2**40),
    delay=st.tuples(st.integers(0, 5), st.integers(0, 5)).map(sorted),
    loss=st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 0.5)).map(sorted),
    longest=st.integers(0, 12),
)
def test_what_is_drawn_lies_in_its_range_and_no_loss_ends_a_run(
    seed: int, delay: list[int], loss: list[float], longest: int
) -> None:
    conditions = with_(command_delay=(delay[0], delay[1]), frame_loss=(loss[0], loss[1]))
    found, lost = conditions.drawn(np.random.default_rng(seed), 501, longest)
    assert delay[0] <= found <= delay[1]
    assert not lost[0]
    assert not lost[-1]
    assert max(len(run) for run in "".join("x" if v else " " for v in lost).split(" ")) <= longest


def test_every_delay_comes_equally_often_and_as_many_samples_are_lost_as_the_probability_says() -> None:
    conditions, rng = with_(command_delay=(1, 3), frame_loss=(0.1, 0.1)), np.random.default_rng(0)
    pairs = [conditions.drawn(rng, 501, 9) for _ in range(3000)]
    delays, lost = np.array([delay for delay, _ in pairs]), np.array([lost for _, lost in pairs])
    assert np.bincount(delays).tolist() == pytest.approx([0, 1000, 1000, 1000], abs=110)
    assert lost[:, 1:-1].mean() == pytest.approx(0.1, rel=0.01)
    assert np.corrcoef(lost[:, 1:-2].ravel(), lost[:, 2:-1].ravel())[0, 1] == pytest.approx(0.0, abs=0.01)
    assert longest_loss(BENCH) == 9  # its watchdog takes 10 ms, see the test of the node's safe stop


def test_delay_and_losses_change_neither_the_brakes_nor_the_noise() -> None:
    batches = [Batch(SHORT, PM50, ("f_v",), 1, conditions=c) for c in (OPEN, with_(frame_loss=(0.1, 0.2)))]
    for batch in batches:
        batch.begin(0, np.random.default_rng(4))
    np.testing.assert_array_equal(batches[0].brakes, batches[1].brakes)
    np.testing.assert_array_equal(batches[0].experiments.noise, batches[1].experiments.noise)
    assert not batches[0].experiments.lost.any()
    assert batches[1].experiments.lost.any()


def test_the_critic_sees_what_an_experiment_has_of_its_own() -> None:
    conditions = with_(command_delay=(0, 4), frame_loss=(0.0, 0.2))
    batch = Batch(SHORT, PM50, PARAMETER_NAMES, 1, conditions=conditions)
    batch.begin(0, np.random.default_rng(2))
    batch.experiments.delay[0] = 2
    batch.experiments.lost[0] = np.arange(61) == 3
    for u in (1.5, -3.0, 6.0):
        batch.advance(np.array([u]))
    told = batch.critic_observation()[0, -8:]
    assert told[:2].tolist() == [0.5, 0.0]  # its delay of at most 4, and that the sample has not arrived
    assert told[2] == pytest.approx(batch.x[0, 3] / 6.0)
    assert told[3:] == pytest.approx([1.0, -0.5, 0.25, 0.0, 0.0])


def test_the_shield_covers_the_drawn_delay_and_the_losses_and_no_more() -> None:
    conditions = Conditions(command_delay=(0, 2), frame_loss=(0.0, 0.05))
    for current in (6.0, -6.0):
        pushing = Played(np.full(500, current))
        assert not play(BENCH, PM50, PARAMETER_NAMES, pushing, fresh_draws(PM50, 5, 40), "exact", conditions).left.any()
    plain, late = Conditions().applied(BENCH).shield, Conditions(command_delay=(1, 2))
    assert late.applied(BENCH).shield == plain._replace(frame_age=(0, 2))
    assert late.applied(late.applied(BENCH)) == late.applied(BENCH)
    for unchanged in (Conditions(frame_loss=(0.0, 0.1)), with_(command_delay=(5, 5))):
        assert unchanged.applied(BENCH).shield == plain


def test_delays_that_cannot_be_are_refused() -> None:
    slow = Plant("slow", BENCH.plant("exact").mechanics, BENCH.plant("exact").instruments._replace(command_delay=6))
    bench = dataclasses.replace(BENCH, plants={**BENCH.plants, "slow": slow})
    for plant, conditions in (
        ("late", Conditions(command_delay=(0, 1))),  # the shield covers no sum of what the plant has and what is drawn
        ("slow", with_(command_delay=(0, 5))),  # 11 samples: the instruments remember 10
    ):
        with pytest.raises(UsageError):
            Batch(bench, PM50, ("f_v",), 1, plant=plant, conditions=conditions)
    Batch(bench, PM50, ("f_v",), 1, plant="late", conditions=with_(command_delay=(0, 1)))
    instruments = Instruments(*range(1, 1 + len(Instruments._fields)))
    assert delayed(instruments, 2) == instruments._replace(command_delay=3)


def test_an_excitation_sees_nothing_but_the_step_of_a_sample_that_is_lost() -> None:
    lossy, observed = Conditions(information="physical", frame_loss=(0.05, 0.05)), []

    class Noting(Played):
        def __call__(self, seen: Any) -> Any:
            observed.append(seen.copy())
            return super().__call__(seen)

    play(BENCH, PM50, ("f_v",), Noting(np.full(500, 2.0)), fresh_draws(PM50, 1, 8), conditions=lossy)
    seen = np.stack(observed)
    missing = np.isnan(seen[:, :, 0])
    assert missing.mean() == pytest.approx(0.05, abs=0.015)
    assert (np.isnan(seen[:, :, [1, 3]]) == missing[:, :, None]).all()
    np.testing.assert_array_equal(seen[:, :, 2], np.arange(500.0)[:, None].repeat(8, 1))
    for name, excitation in references(BENCH).items():  # each can be played where samples are lost
        outcome = play(BENCH, PM50, ("f_v",), excitation, fresh_draws(PM50, 1, 2), conditions=lossy)
        assert np.isfinite(outcome.matrices).all(), name


LAW = make_law(BENCH)
FIRST = sensor_thresholds(BENCH, LAW).first_current
HORIZON = BENCH.timing.horizon
RESOLUTION = 0.0031  # Of a current on the bus [A]


def begun(plant: str, seed: int, conditions: Conditions = BENCH_CONDITIONS) -> Batch:
    batch = Batch(BENCH, BENCH.range_set("pm50"), PARAMETER_NAMES, 1, plant, conditions)
    batch.begin(0, np.random.default_rng(seed), BENCH.brake)
    return batch


@pytest.mark.parametrize("plant", ["exact", "euler"])
def test_a_batch_that_hears_what_a_run_heard_sends_what_that_sent(plant: str, tmp_path: Path) -> None:
    cycles = api.simulate(tmp_path / "run.mcap", plant=plant, seed=3).cycles
    of = {name: np.asarray(cycles[name]) for name in ("step", "angle", "velocity", "policy_current", "sent_current")}
    active = np.flatnonzero(of["step"] >= 0)[:HORIZON]
    heard = np.column_stack([of["angle"], of["velocity"]])[active]
    batch = begun(plant, 0)
    batch.experiments.noise[:] = 0.0
    batch.y[0] = heard[0]
    begin_monitor(batch.experiments.monitor[0], *heard[0].tolist())
    for k in range(HORIZON - 1):
        # The noise that makes the batch's next measurement the run's.
        asked = float(of["policy_current"][active[k]])
        ahead = begun(plant, 0)
        for mine, other in zip(ahead.experiments, batch.experiments, strict=True):
            mine[:] = other
        ahead.advance(np.array([asked]))
        batch.experiments.noise[0, k + 1] = heard[k + 1] - ahead.y[0]
        batch.advance(np.array([asked]))
        assert batch.past[0, 0] == pytest.approx(of["sent_current"][active[k]], abs=RESOLUTION)


def test_until_the_motion_has_shown_its_sign_a_batch_sends_no_more_than_friction_can_stop() -> None:
    batch, shown = begun("exact", 1), []
    weak = np.array([1.5, 1.0, 0.5, 1.0, 1.5, 1.0])
    batch.experiments.brakes[0] *= weak
    for _ in range(15):
        monitor = batch.experiments.monitor[0]
        shown.append(bool(monitor[OBEYS]))
        most = largest_current(LAW, batch.setup.thresholds, monitor, 6.0)
        batch.advance(np.array([6.0]))
        assert batch.past[0, 0] == most
        assert FIRST <= most <= 6.0
        assert most == 6.0 or not shown[-1]
    assert 1 <= shown.index(True) <= 3


def test_a_lost_first_sample_only_delays_the_confirmation() -> None:
    batch = begun("exact", 1)
    batch.experiments.lost[0, 2:4] = True
    for _ in range(40):
        batch.advance(np.array([6.0]))
    assert batch.experiments.monitor[0, CONFIRMED] == 1.0


def test_where_the_shield_needs_more_than_may_be_sent_nothing_is_sent() -> None:
    near, fast = BENCH.limits.angle[1] - 2.0, 0.6 * BENCH.limits.velocity
    braking, _ = sent_current(LAW, True, near, fast, 0.0, NO_PAST, 0, LAW.current)
    assert braking < -FIRST
    current, reasons = sent_current(LAW, True, near, fast, 0.0, NO_PAST, 0, FIRST)
    assert np.isnan(current)
    assert reasons & LEFT
    enough = -braking
    held, reasons = sent_current(LAW, True, near, fast, 0.0, NO_PAST, 0, enough)
    assert (held, reasons & LEFT) == (braking, 0)
