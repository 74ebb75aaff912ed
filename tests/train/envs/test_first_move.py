"""The first move: the batch sends what the loop sends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_bench.sim.simulated_brake import sent_current
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.safety.command_limits import LEFT
from emb_runtime.safety.sensor_monitor import CONFIRMED, OBEYS, largest_current
from emb_runtime.safety.sensor_monitor import begin as begin_monitor
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import make_law
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Conditions

BENCH = load_bench()
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


def test_without_a_shield_there_is_no_first_move() -> None:
    batch = begun("euler", 1, Conditions(shielded=False))
    batch.advance(np.array([6.0]))
    assert batch.past[0, 0] == 6.0


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
