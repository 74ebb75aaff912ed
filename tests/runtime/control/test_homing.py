"""The way home: from anywhere, for every brake that the shield is for, and never beyond what may leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.can.messages import StopReason
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench
from emb_runtime.control.actor import Still, homing_steps
from emb_runtime.control.memory import RunCounters
from emb_runtime.control.phases import HOME_PAIRS
from emb_runtime.control.result import TRUSTED_AFTER, Outcome, may_go_home
from emb_runtime.records import Reason, RunState
from emb_runtime.safety.shield_design import make_law
from emb_runtime.safety.state_machine import Fault
from tests.benches import SENSOR_BENCH
from tests.conftest import SimRun, Simulate

from .test_faults import assert_within_limits

BENCH: Bench = load_bench()
LOWEST = -9.4  # rad, from where it is driven home; with a sensor of the velocity from 0.2 rad below
BOX = BENCH.range_set(BENCH.shield.ranges)
CORNER = st.tuples(*(st.sampled_from((getattr(BOX.low, name), getattr(BOX.high, name))) for name in PARAMETER_NAMES))
INSIDE = st.tuples(*(st.floats(getattr(BOX.low, name), getattr(BOX.high, name)) for name in PARAMETER_NAMES))


GoHome = Callable[..., SimRun]
ENDED = Outcome(
    fault=None, detail="", counters=RunCounters(), end=None, last=None, home=False, node_at_rest=True,
    node_stop_reason=StopReason.DISABLED, duration_ns=0, rejections={}, bus_errors={},
)  # fmt: skip
"""Of an experiment that ended as it should."""


@pytest.fixture(scope="session")
def go_home(simulate: Simulate) -> GoHome:
    """A way home from where a hand has turned the brake."""

    def run(
        angle: float,
        theta: tuple[float, ...] = (),
        plant: str = "euler",
        seed: int = 1,
        limit: float = 6.0,
        steps: int = 0,
        on_bench: Bench = BENCH,
    ) -> SimRun:
        options = [f"plant={plant}", f"seed={seed}"]
        options += [f"{name}={value!r}" for name, value in zip(PARAMETER_NAMES, theta, strict=False)]
        steps = steps or homing_steps(BENCH)
        return simulate(
            options=",".join(options),
            angle=angle,
            steps=steps,
            limit=limit,
            homing=True,
            actor=Still(),
            law=make_law(on_bench),
            on_bench=on_bench,
        )

    return run


@settings(max_examples=25, deadline=None)
@given(
    angle=st.one_of(st.floats(-9.6, 99.6), st.sampled_from((-9.6, -0.6, 0.6, 24.0, 99.6))),
    on_bench=st.sampled_from((BENCH, SENSOR_BENCH)),
    theta=st.one_of(CORNER, INSIDE),
    plant=st.sampled_from(("euler", "exact")),
    seed=st.integers(0, 1000),
)
def test_every_brake_of_the_set_comes_home_from_anywhere_in_bounded_time(
    go_home: GoHome, angle: float, on_bench: Bench, theta: tuple[float, ...], plant: str, seed: int
) -> None:
    begin = angle if on_bench is SENSOR_BENCH else max(angle, LOWEST)
    run = go_home(begin, theta, plant, seed, on_bench=on_bench)
    assert run.outcome.fault is None, (run.outcome.fault, run.outcome.detail)
    assert run.outcome.home
    assert abs(run.transport.node.angle) <= BENCH.shield.home_angle
    assert run.outcome.duration_ns < 1_000_000_000  # searched: 0.31 s at worst
    assert_within_limits(run)


@settings(max_examples=12, deadline=None)
@given(
    angle=st.floats(LOWEST, 99.6),
    theta=CORNER,
    plant=st.sampled_from(("euler", "exact")),
    limit=st.sampled_from((0.1, 0.5, 1.0, 2.0)),
)
def test_with_less_current_a_brake_comes_home_or_it_is_said_that_it_did_not(
    go_home: GoHome, angle: float, theta: tuple[float, ...], plant: str, limit: float
) -> None:
    run = go_home(angle, theta, plant, limit=limit, steps=600)
    if run.outcome.fault is None:
        assert run.outcome.home
    else:
        # The node brakes by itself where the limit is in the way, and for longer than its watchdog's time it stops.
        assert run.outcome.fault in (Fault.NOT_HOME, Fault.NODE_STOPPED)
        assert not run.outcome.home
    assert_within_limits(run)
    sent = [cycle.sent_current for cycle in run.journal.cycles if cycle.send_time_ns]
    assert max(map(abs, sent), default=0.0) <= limit + 1e-9


def test_the_way_home_ends_when_the_brake_has_rested_there_for_a_while(go_home: GoHome) -> None:
    run = go_home(0.1)
    assert run.outcome.home
    assert run.outcome.counters.answered == HOME_PAIRS
    assert {cycle.state for cycle in run.journal.cycles} == {RunState.HOMING}


def test_the_shield_alone_decides_on_the_way_home(go_home: GoHome) -> None:
    run = go_home(40.0)
    decided = [cycle for cycle in run.journal.cycles if cycle.send_time_ns]
    assert all(cycle.policy_current == 0.0 for cycle in decided)
    assert all(cycle.reasons & Reason.RETURNING for cycle in decided)


def test_a_brake_that_does_not_move_is_given_up(go_home: GoHome) -> None:
    run = go_home(1.0, limit=0.0, steps=300)
    assert run.outcome.fault is Fault.NOT_HOME
    assert "after 300 periods" in run.outcome.detail
    assert run.transport.node.angle == pytest.approx(1.0, abs=0.2)


def test_nothing_moves_by_itself_after_a_fault_that_casts_doubt_on_brake_drive_or_bus() -> None:
    assert may_go_home(ENDED)
    assert {fault for fault in Fault if may_go_home(replace(ENDED, fault=fault))} == TRUSTED_AFTER
    for doubtful in (Fault.OUT_OF_LIMITS, Fault.CURRENT_MISMATCH, Fault.FOREIGN_COMMAND, Fault.BUS_LOST):
        assert doubtful not in TRUSTED_AFTER
    assert Fault.INTERRUPTED not in TRUSTED_AFTER


def test_after_the_brake_has_reached_a_limit_nothing_moves_by_itself() -> None:
    for fault in (None, *TRUSTED_AFTER):
        assert not may_go_home(replace(ENDED, fault=fault, node_stop_reason=StopReason.LIMIT))
