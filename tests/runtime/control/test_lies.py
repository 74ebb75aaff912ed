"""No run with a node that lies is called done, or what it could lie is too little to matter.

Each time to detection is a bound in periods of one millisecond, from the first lie to the first stop frame.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from emb_runtime.can.messages import bench_identity
from emb_runtime.policy.policy import Policy, load_policy, shipped_actor_path
from emb_runtime.records import Frame
from emb_runtime.safety.state_machine import FAULTS, Fault
from tests.conftest import FunctionActor, Journal, make_loop
from tests.lying.node import COMMAND, HONEST, PERIOD_NS, Lie, LyingNode
from tests.scenarios.lies import BENCH, ENDS, SENSORS, UNEXPLAINED, LyingBus, Seen, assert_inside, run

IDENTITY = bench_identity(BENCH.identity_hash)


def assert_ends(seen: Seen, fault: Fault, within: int) -> None:
    assert seen.outcome.fault is fault, (seen.outcome.fault, seen.outcome.detail)
    assert FAULTS[fault].exit_code == 3
    assert seen.detected is not None
    assert seen.detected <= within, seen.detected
    assert_inside(seen)


def test_an_honest_node_completes_its_experiment() -> None:
    seen = run(HONEST)
    assert seen.outcome.fault is None, seen.outcome.detail
    assert (seen.outcome.counters.answered, seen.outcome.counters.not_obeyed, seen.node.obeyed) == (500, 0, 500)
    assert seen.outcome.home
    assert_inside(seen)


@pytest.mark.parametrize("name", ENDS)
def test_a_lie_that_samples_show_ends_the_run_in_time_and_below_every_limit(name: str) -> None:
    end = ENDS[name]
    seen = run(end.lie)
    assert seen.outcome.fault in end.faults, seen.outcome.detail
    assert end.says in seen.outcome.detail
    assert_ends(seen, seen.outcome.fault, end.within)


# --- device time ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sign", "window", "words"), [(1, 3, "it has gained 2."), (-1, 43, "it has lost")])
def test_a_clock_that_is_fast_or_slow_is_noticed_at_two_periods_and_sooner_where_the_brake_moves(
    sign: int, window: int, words: str
) -> None:
    for percent in (1, 2, 5, 10, 20):
        lie = Lie(clock=1.0 + sign * percent / 100, begin=0.0)
        at_rest, moving = run(lie, law=lambda *_: 0.0), run(lie)
        assert_ends(at_rest, Fault.DEVICE_TIME, within=round(2.0 / (percent / 100 - 0.0005)) + window)
        assert words in at_rest.outcome.detail
        assert moving.outcome.fault in (Fault.DEVICE_TIME, Fault.FRAMES_REJECTED, Fault.SENSORS_CONTRADICT)
        assert moving.detected is not None
        assert at_rest.detected is not None
        assert moving.detected <= at_rest.detected


@pytest.mark.parametrize("ppm", [-400, pytest.param(400, marks=pytest.mark.slow)])
def test_two_quartzes_are_never_blamed_however_long_the_experiment(ppm: int) -> None:
    seen = run(Lie(clock=1.0 + ppm * 1e-6, begin=0.0), law=lambda *_: 0.0, steps=6_000)  # 2.4 periods
    assert seen.outcome.fault is None, seen.outcome.detail


def late_frames(seed: int) -> Callable[[], int]:
    """Latencies of a busy computer: mostly below a fifth of a period, now and then some periods, in bursts."""
    draw = random.Random(seed)
    stalled = 0

    def delay_ns() -> int:
        nonlocal stalled
        if stalled <= 0 and draw.random() < 0.004:
            stalled = draw.randrange(PERIOD_NS, 8 * PERIOD_NS)
        late, stalled = max(stalled, 0), stalled - PERIOD_NS
        return late + round(min(draw.expovariate(1.0 / 60_000), 800_000))

    return delay_ns


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 30), marks=pytest.mark.slow)], ids=str)
def test_bursts_of_late_frames_are_no_wrong_clock(seeds: range) -> None:
    for seed in seeds:
        seen = run(Lie(clock=1.0 + 400e-6 * (-1) ** seed, begin=0.0), seed, late_frames(seed))
        assert seen.outcome.fault in (None, Fault.INCOMPLETE), (seed, seen.outcome.fault, seen.outcome.detail)
        assert_inside(seen)


def test_a_node_that_sends_twice_in_a_period_is_told_so_and_no_error_of_the_program() -> None:
    seen = run(Lie(twice=True), law=lambda *_: 0.0)
    assert_ends(seen, Fault.DEVICE_TIME, within=3)
    assert run(Lie(twice=True)).outcome.fault in (Fault.DEVICE_TIME, Fault.FRAMES_REJECTED, Fault.SENSORS_CONTRADICT)
    assert "error in the program" not in FAULTS[Fault.DEVICE_TIME].cause


# --- shares ---------------------------------------------------------------------------------------------------------

SHARES: dict[str, tuple[Lie, Fault]] = {
    "jump": (Lie(jump=5.0), Fault.FRAMES_REJECTED),
    "crc": (Lie(crc=True), Fault.FRAMES_REJECTED),
    "deaf": (Lie(deaf=True), Fault.NOT_OBEYED),
    "current": (Lie(current=20.0), Fault.CURRENT_MISMATCH),
}


@pytest.mark.parametrize("name", SHARES)
def test_a_share_above_a_fifth_ends_the_run_and_a_tenth_is_survived_and_reported(name: str) -> None:
    """Jumps, wrong CRCs, commands not obeyed, and a braking current of 20 A."""
    lie, fault = SHARES[name]
    for percent in (25, 50, 90):
        seen = run(replace(lie, duty=percent / 100))
        expected = {fault, Fault.INCOMPLETE, Fault.NOT_OBEYED, Fault.NODE_STOPPED}
        assert seen.outcome.fault in expected, (percent, seen.outcome.fault, seen.outcome.detail)
        assert_inside(seen)
        if percent >= 50:
            tolerated = BENCH.watch.stop_missed if name == "deaf" else BENCH.watch.rejected
            assert seen.detected is not None
            assert seen.detected <= 4 * tolerated / (5 * percent / 100 - 1) + 6
    seen = run(replace(lie, duty=0.1))
    counters = seen.outcome.counters
    assert seen.outcome.fault is None, seen.outcome.detail
    assert counters.rejected + counters.not_obeyed >= 40
    assert_inside(seen)


@pytest.mark.parametrize(("nth", "within"), [(2, 60), (3, 120), (4, 320), (10, 501)])
def test_more_than_a_fifth_of_the_pairs_missing_ends_the_run_and_a_tenth_does_not(nth: int, within: int) -> None:
    node = LyingNode(IDENTITY)
    bus = LyingBus(node, lambda: 0)

    def receive(deadline_ns: int) -> Frame | None:
        frame = bus.receive(deadline_ns)
        while frame is not None and frame.identifier != COMMAND and node.obeyed and node.periods % nth == 0:
            frame = bus.receive(deadline_ns)
        return frame

    driven: Any = {"send": bus.send, "receive": receive, "now_ns": bus.clock.now_ns, "push": Journal().push}
    outcome = make_loop(BENCH, FunctionActor(lambda *_: 6.0), 500, **driven).run()
    assert outcome.fault is (Fault.SENSOR_LOST if nth < 10 else None), outcome.detail
    assert outcome.counters.pairs + outcome.counters.missed <= within
    assert nth < 10 or outcome.counters.missed in (49, 50)


@pytest.mark.parametrize("lie", [Lie(motor=-1, begin=0.0), Lie(sensors=-1, begin=0.0)], ids=["motor", "sensors"])
def test_a_wrong_polarity_is_noticed_before_anything_is_fast(lie: Lie) -> None:
    seen = run(lie)
    assert_ends(seen, Fault.WRONG_POLARITY, within=80)  # the first move is gentle
    assert seen.node.fastest <= 60.0
    assert max(-seen.node.lowest, seen.node.highest) <= 0.5


@pytest.mark.parametrize("pushed", [50, 80])
def test_a_wrong_polarity_found_just_before_the_end_is_not_forgotten(pushed: int) -> None:
    """The brake rests until then, and friction has not stopped it when the run ends."""
    steps = BENCH.timing.horizon

    def law(_angle: float, _velocity: float, step: float) -> float:
        return 6.0 if step >= steps - pushed else 0.0

    seen = run(Lie(sensors=-1, begin=0.0), law=law)
    assert seen.outcome.fault is Fault.WRONG_POLARITY, seen.outcome.detail
    assert "WRONG_POLARITY" in seen.journal.codes


def test_a_wrong_polarity_is_waited_out_within_the_slew_that_the_guard_allows() -> None:
    bench = replace(BENCH, guard=replace(BENCH.guard, slew=1500.0))
    seen = run(Lie(motor=-1, begin=0.0), bench=bench)
    assert seen.outcome.fault is Fault.WRONG_POLARITY, seen.outcome.detail
    assert_inside(seen)


@pytest.mark.parametrize("percent", [10, 50, 90])
@pytest.mark.parametrize("lie", [Lie(offset=40.0), Lie(sensors=-1), Lie(scale=0.5)], ids=["offset", "sensors", "scale"])
def test_a_sensor_that_lies_now_and_then_never_drives_the_brake_out_of_its_limits(lie: Lie, percent: int) -> None:
    seen = run(Lie(**{**vars(lie), "duty": percent / 100}))
    assert seen.outcome.fault in (None, Fault.INCOMPLETE, *SENSORS), seen.outcome.detail
    assert seen.outcome.fault is not None or seen.outcome.counters.rejected > 0 or percent == 10
    assert_inside(seen)


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy(shipped_actor_path(), BENCH)


@pytest.mark.parametrize("name", UNEXPLAINED)
def test_what_no_one_brake_explains_is_not_done(name: str, policy: Policy) -> None:
    seen = run(UNEXPLAINED[name], actor=policy)
    assert seen.outcome.fault is Fault.MOTION_UNEXPLAINED, (seen.outcome.fault, seen.outcome.detail)
    assert "MOTION_UNEXPLAINED" in seen.journal.codes
    assert FAULTS[Fault.MOTION_UNEXPLAINED].exit_code == 8
    assert seen.node.lowest >= -10.0
    assert seen.node.highest <= 100.0
    assert seen.node.fastest <= 580.0  # what remains: docs/explanation/sensor-monitor.md


def test_an_honest_node_under_the_shipped_actor_is_explained_with_and_without_losses(policy: Policy) -> None:
    for seed, lie in enumerate((HONEST, Lie(lost=0.02), Lie(lost=0.05), HONEST)):
        outcome = run(lie, seed, actor=policy).outcome
        assert outcome.fault is None, outcome.detail
        unexplained, allowed = outcome.unexplained
        assert 0.0 < unexplained < 0.5 * allowed < 30.0
        assert outcome.model_fits
        for value, deviation in zip(outcome.estimate[:4], outcome.estimate[4:], strict=True):
            assert deviation < 0.002 * value


@pytest.mark.parametrize("lie", [Lie(zero=2.0), Lie(zero=-2.0), Lie(slide=0.2, begin=0.0), Lie(gain_rate=0.2)], ids=str)
def test_what_stays_unseen_keeps_within_what_the_page_says(lie: Lie, policy: Policy) -> None:
    seen = run(replace(lie, blind=True), actor=policy)
    assert seen.node.lowest >= -3.5
    assert seen.node.highest <= 80.0
    assert seen.node.fastest <= 522.0
    assert not seen.outcome.model_fits
