"""Batches of experiments: they send what a run sends, and do what the node does, late commands included."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench import api
from emb_bench.config.plants import Instruments, Plant
from emb_bench.information.symmetric import unpack
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import sent_current
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.safety.command_limits import LEFT
from emb_runtime.safety.sensor_monitor import largest_current
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import make_law
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Conditions, delayed, first_loop
from emb_train.play import fresh_draws, play
from tests.benches import SENSOR_BENCH, SENSOR_TEXT
from tests.train.trainings import constant

BENCH = SENSOR_BENCH
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
PM50 = BENCH.range_set("pm50")
OPEN = Conditions(shielded=False)  # So that what is wanted is what is sent


def with_(conditions: Conditions = OPEN, **changes: Any) -> Conditions:
    return msgspec.structs.replace(conditions, **changes)


@given(
    seed=st.integers(0, 2**40),
    delay=st.integers(0, 3),
)
@settings(max_examples=20, deadline=None)
def test_an_experiment_is_what_the_node_makes_of_the_same_commands(seed: int, delay: int) -> None:
    """The node has the delay that the environment draws from a range without width."""
    layout, exact = load_layout(), BENCH.plant("exact")
    batch = Batch(SHORT, PM50, ("f_v",), 1, plant="exact", conditions=with_(command_delay=(delay, delay)))
    batch.begin(0, np.random.default_rng(seed))
    sides = exact.instruments._replace(command_delay=delay)
    noise = map(tuple, batch.experiments.noise[0].tolist())
    node = BrakeNode(
        SHORT,
        layout,
        BrakeParameters(*batch.experiments.brakes[0].tolist()),
        lambda: next(noise),
        Plant("told", exact.mechanics, sides),
    )
    step = layout.command.signal("Current").factor
    steps, frames = np.random.default_rng(seed).integers(-2000, 2000, SHORT.timing.horizon), node.tick()
    for k in range(SHORT.timing.horizon):
        said, applied = layout.decode_angle(frames[0]), layout.decode_velocity(frames[1])
        assert batch.experiments.y[0, 0] == pytest.approx(said.angle, abs=1e-3)  # the frame's resolution
        assert batch.experiments.y[0, 1] == pytest.approx(applied.velocity, abs=0.05)
        assert batch.experiments.applied[0, k] == pytest.approx(applied.applied_current, abs=1.01 * step)
        node.receive(layout.encode_command(k % 15, said.counter, steps[k] * step, True))
        batch.advance(np.array([steps[k] * step]))
        frames = node.tick()
        assert batch.x[0, 0] == pytest.approx(node.angle, abs=1e-9)
        assert batch.x[0, 1] == pytest.approx(node.velocity, abs=1e-6)


def test_every_delay_comes_equally_often_and_changes_neither_the_brakes_nor_the_noise() -> None:
    batches = [Batch(SHORT, PM50, ("f_v",), 600, conditions=c) for c in (OPEN, with_(command_delay=(1, 3)))]
    for batch in batches:
        for i in range(600):
            batch.begin(i, np.random.default_rng(i))
    np.testing.assert_array_equal(batches[0].experiments.brakes, batches[1].experiments.brakes)
    np.testing.assert_array_equal(batches[0].experiments.noise, batches[1].experiments.noise)
    assert not batches[0].experiments.delay.any()
    assert np.bincount(batches[1].experiments.delay).tolist() == pytest.approx([0, 200, 200, 200], abs=45)


def test_normal_draws_lie_around_the_middle_of_their_ranges_and_within_them() -> None:
    batch = Batch(SHORT, PM50, ("f_v",), 2000, conditions=with_(draws="normal"))
    for i in range(2000):
        batch.begin(i, np.random.default_rng(i))
    low, high = np.array(PM50.low), np.array(PM50.high)
    assert (batch.experiments.brakes >= low).all()
    assert (batch.experiments.brakes <= high).all()
    free = high > low
    z = ((batch.experiments.brakes - 0.5 * (low + high))[:, free]) / (0.25 * (high - low)[free])
    # Of a normal distribution that is cut off at two standard deviations.
    assert np.abs(z.mean(axis=0)).max() < 0.08
    assert np.abs(z.var(axis=0) - 0.7737).max() < 0.1
    assert np.abs((np.abs(z) < 1.0).mean(axis=0) - 0.6827 / 0.9545).max() < 0.05
    assert (batch.experiments.brakes[:, ~free] == low[~free]).all()


def test_information_over_nominal_values_is_that_of_parameters_in_units_of_them() -> None:
    names = ("k_1", "f_v")
    batch = Batch(SHORT, PM50, names, 3, conditions=with_(normalised_by="nominal"))
    for i in range(3):
        batch.begin(i, np.random.default_rng(i))
    for _ in range(40):
        batch.advance(np.full(3, 5.0))
    k = batch.experiments.k
    for brake, own, seen in zip(
        batch.experiments.brakes, batch.newest(batch.experiments.m), batch.information(k), strict=True
    ):
        true = dict(zip(BrakeParameters._fields, brake.tolist(), strict=True))
        scale = np.diag([getattr(BENCH.brake, name) / true[name] for name in names])
        np.testing.assert_allclose(unpack(seen, 2), scale @ unpack(own, 2) @ scale, rtol=1e-12)
        assert np.abs(scale - np.eye(2)).max() > 0.01


def test_the_critic_sees_what_an_experiment_has_of_its_own() -> None:
    batch = Batch(SHORT, PM50, PARAMETER_NAMES, 1, conditions=with_(command_delay=(0, 4)))
    batch.begin(0, np.random.default_rng(2))
    batch.experiments.delay[0] = 2
    for u in (1.5, -3.0, 6.0):
        batch.advance(np.array([u]))
    told = batch.critic_observation()[0, -7:]
    assert told[0] == 0.5  # its delay of at most 4
    assert told[1] == pytest.approx(batch.experiments.x[0, 3, 3] / 6.0)
    assert told[2:] == pytest.approx([1.0, -0.5, 0.25, 0.0, 0.0])


def test_the_shield_covers_the_drawn_delay_and_no_more() -> None:
    conditions = Conditions(command_delay=(0, 2))
    for current in (6.0, -6.0):
        pushing, draws = constant(current), fresh_draws(PM50, 5, 40)
        outcome = play(BENCH, PM50, PARAMETER_NAMES, pushing, draws, "exact", conditions)
        assert not outcome.violated.any()
        assert outcome.home.all()
    plain, late = Conditions().applied(BENCH).shield, Conditions(command_delay=(1, 2))
    assert late.applied(BENCH).shield == plain._replace(frame_age=(0, 2))
    assert late.applied(late.applied(BENCH)) == late.applied(BENCH)
    assert with_(command_delay=(5, 5)).applied(BENCH).shield == plain


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
    assert delayed(instruments, 2, 0.0) == instruments._replace(command_delay=3)


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
    (tmp_path / "bench.toml").write_text(SENSOR_TEXT, encoding="utf-8")
    cycles = api.simulate(tmp_path / "run.mcap", plant=plant, seed=3, bench=tmp_path / "bench.toml").cycles
    of = {name: np.asarray(cycles[name]) for name in ("step", "angle", "velocity", "policy_current", "sent_current")}
    active = np.flatnonzero(of["step"] >= 0)[:HORIZON]
    heard = np.column_stack([of["angle"], of["velocity"]])[active]
    batch = begun(plant, 0)
    batch.experiments.noise[:] = 0.0
    batch.experiments.y[0] = heard[0]
    batch.experiments.loops[0] = first_loop(batch.setup, *heard[0].tolist())
    for k in range(HORIZON - 1):
        # The noise that makes the batch's next measurement the run's.
        asked = float(of["policy_current"][active[k]])
        ahead = begun(plant, 0)
        pairs: Any = zip(ahead.experiments, batch.experiments, strict=True)
        for mine, other in pairs:
            mine[0] = other[0]
        ahead.advance(np.array([asked]))
        batch.experiments.noise[0, k + 1, :2] = heard[k + 1] - ahead.experiments.y[0]
        batch.advance(np.array([asked]))
        assert batch.experiments.past[0, 0] == pytest.approx(of["sent_current"][active[k]], abs=RESOLUTION)


def test_until_the_motion_has_shown_its_sign_a_batch_sends_no_more_than_friction_can_stop() -> None:
    batch, shown = begun("exact", 1), []
    weak = np.array([1.5, 1.0, 0.5, 1.0, 1.5, 1.0])
    batch.experiments.brakes[0] *= weak
    for _ in range(15):
        monitor = batch.experiments.loops[0].monitor
        shown.append(monitor.obeys)
        most = largest_current(LAW, batch.setup.thresholds, monitor, 6.0)
        batch.advance(np.array([6.0]))
        assert batch.experiments.past[0, 0] == most
        assert FIRST <= most <= 6.0
        assert most == 6.0 or not shown[-1]
    assert 1 <= shown.index(True) <= 3


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
