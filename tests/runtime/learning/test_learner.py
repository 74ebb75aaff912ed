"""A run that learns: the true brake stays possible in each cycle; where there is doubt, the law is that for all."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from emb_bench.brake.euler import step
from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import BenchFileError
from emb_runtime.learning.known import Known
from emb_runtime.learning.law import fits
from emb_runtime.learning.learner import Learner, ranges_of, words
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.safety.shield_design import make_law

from tests.conftest import SimRun, Simulate  # isort: skip

BENCH = load_bench()


def learning(model: str = "flow", **shield: Any) -> Bench:
    keys = f'learn = true\nmodel = "{model}"\n'
    bench = parse_bench(shipped_bench_text().replace("[shield]", f"[shield]\n{keys}#"), "learning")
    return replace(bench, shield=bench.shield._replace(**shield))


def test_learning_changes_no_contract() -> None:
    assert learning(model_error=50.0, current_error=0.01).identity_hash == BENCH.identity_hash


def square(_angle: float, _velocity: float, step: float) -> float:
    return 6.0 if step % 160 < 90 else -6.0


def outside(run: SimRun) -> list[str]:
    """Names of what the shield took for impossible, and is true."""
    truth = run.transport.truth
    found = []
    for i, name in enumerate(PARAMETER_NAMES):
        share = float(truth[name]) / getattr(BENCH.brake, name)
        found += [name for *_, numbers in run.journal.learnt if not numbers[2 * i] <= share <= numbers[2 * i + 1]]
    return found


@pytest.mark.parametrize(("model", "plant"), [("flow", "exact"), ("euler", "euler")])
@pytest.mark.parametrize("brake", ["", ",k_m=0.013,k_1=30,T_c=0.015,f_v=4e-5", ",k_m=0.031,k_1=13,T_c=0.006"])
def test_a_run_that_learns_keeps_the_limits_comes_home_and_holds_the_true_brake_possible(
    simulate: Simulate, model: str, plant: str, brake: str
) -> None:
    run = simulate(square, on_bench=learning(model), options=f"seed=3,plant={plant}{brake}")
    assert run.outcome.fault is None, run.outcome.detail
    assert run.outcome.home
    assert [step for _, step, _ in run.journal.learnt] == list(range(500))
    assert outside(run) == []
    for numbers, cycle in zip((row for *_, row in run.journal.learnt), run.journal.cycles, strict=False):
        angle, velocity = numbers[8:10], numbers[10:12]
        assert cycle.angle - 6e-3 - 1e-8 <= angle[0] <= angle[1] <= cycle.angle + 6e-3 + 1e-8
        assert cycle.velocity - 6.0 - 1e-8 <= velocity[0] <= velocity[1] <= cycle.velocity + 6.0 + 1e-8
    assert run.outcome.learnt is not None
    ranges = ranges_of(run.outcome.learnt)
    assert all(high - low < 0.2 for low, high in (ranges["k_m"], ranges["k_1"]))
    assert "k_m" in words(run.outcome.learnt)


def test_samples_that_are_lost_and_commands_that_are_not_obeyed_leave_the_true_brake_possible(
    simulate: Simulate,
) -> None:
    dice = np.random.default_rng(1)
    lost = set(dice.choice(np.arange(20, 490), 30, replace=False).tolist())
    sent = iter(range(10_000))

    def lose(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        while frame is not None and frame.identifier == 0x100 and transport.node.periods - 200 in lost:
            frame = transport.receive(clock.now_ns())
        return frame

    def refuse(_frame: Frame) -> None:
        if next(sent) % 23 == 22:  # the node brakes by itself, and reports it
            raise TransmitQueueFullError("no room")

    run = simulate(square, on_bench=learning(), options="seed=4,plant=exact", on_receive=lose, on_send=refuse)
    assert run.outcome.counters.missed > 10
    assert run.outcome.counters.not_taken > 10
    assert run.outcome.fault is None, run.outcome.detail
    assert outside(run) == []


def test_where_nothing_is_to_be_learnt_nothing_is_recorded(simulate: Simulate) -> None:
    never_begun = simulate(square, on_bench=learning(), stop_requested=lambda: True)
    on_the_way_home = simulate(homing=True, on_bench=learning(), angle=3.0, steps=200)
    for run in (simulate(square), never_begun, on_the_way_home):
        assert run.outcome.learnt is None
        assert run.journal.learnt == []


def sample(angle: float = 0.0, velocity: float = 0.0) -> SensorSample:
    return SensorSample(0, angle, velocity, 0, 0, 0.0, 15, NodeState.ACTIVE)


def test_whatever_is_in_doubt_is_the_law_for_the_whole_set() -> None:
    law = make_law(BENCH)
    learner = Learner(learning(), law)
    assert learner.question(sample(1.0, 2.0)) == (law, 1.0, 2.0)  # before the first sample
    learner.begin(sample())
    for _ in range(20):
        learner.hear(sample(), 1)
    assert learner.question(sample())[0] is not law
    learner.hear(sample(), 0)  # two in one period: off the grid
    assert learner.known is None
    assert learner.question(sample())[0] is law
    learner.hear(sample(), 1)
    assert learner.known is None
    learner.begin(sample())
    learner.hear(sample(), 3_600_000)  # the node's clock jumped by an hour: not one period of it is gone through
    assert learner.known is None
    assert learner.question(sample())[0] is law
    learner.begin(sample())
    learner.hear(sample(4.0), 1)
    assert learner.contradicted
    assert learner.question(sample(4.0)) == (law, 4.0, 0.0)
    learner.begin(sample())
    assert learner.question(sample())[0] is not law
    silent = Learner(learning(), law, active=False)
    silent.begin(sample())
    silent.hear(sample(), 1)
    assert silent.question(sample())[0] is law


def moved(last: SensorSample, current: float) -> SensorSample:
    """The nominal brake's next sample."""
    return sample(*step(BENCH.brake, last.angle, last.velocity, current, 1e-3))._replace(applied_current=current)


def driven(bench: Bench) -> tuple[Learner, SensorSample]:
    """A learner that has followed the nominal brake for 100 samples, and the last of them."""
    learner, last = Learner(bench, make_law(bench)), sample()
    learner.begin(last)
    for k in range(100):
        last = moved(last, 4.0 if k < 50 else -4.0)
        learner.hear(last, 1)
    return learner, last


def test_a_run_that_begins_anew_has_forgotten_the_law_of_the_one_before() -> None:
    bench = learning("euler")
    fresh, (learner, last) = Learner(bench, make_law(bench)), driven(bench)
    assert (fresh.age, fresh.contradicted) == (0, False)
    narrow = learner.question(last)[0]
    learner.hear(last, 3)
    assert learner.age == 3
    for one in (learner, fresh):
        one.begin(sample())
        assert one.age == 0
    assert learner.question(sample()) == fresh.question(sample())
    assert learner.question(sample())[0].motor_high > 1.1 * narrow.motor_high


def test_a_law_is_made_anew_as_soon_as_a_lost_sample_leaves_more_states_possible_than_it_allows_for() -> None:
    learner, last = driven(learning("euler"))
    law = learner.question(last)[0]
    last = moved(moved(last, -4.0), -4.0)
    learner.hear(last, 2)
    assert learner.known is not None
    assert not learner.contradicted
    assert not fits(law, learner.known)
    assert learner.question(last)[0] is not law
    assert fits(learner.question(last)[0], learner.known)
    assert learner.age == 0


def test_fifty_periods_from_one_sample_to_the_next_are_the_most_after_which_something_is_learnt() -> None:
    for periods, learns in ((50, True), (51, False)):
        learner = Learner(learning(), make_law(BENCH))
        learner.begin(sample())
        learner.hear(sample(), periods)
        assert (learner.known is not None) == learns


def test_the_ranges_of_the_four_parameters_are_said_in_their_order() -> None:
    known = Known(0.1, 1.1, 0.2, 1.2, 0.3, 1.3, 0.4, 1.4, -2.0, 2.0, -30.0, 30.0, False)
    assert ranges_of(known) == {"k_m": (0.1, 1.1), "k_1": (0.2, 1.2), "T_c": (0.3, 1.3), "f_v": (0.4, 1.4)}
    assert words(known) == "k_m 0.100 to 1.100, k_1 0.200 to 1.200, T_c 0.300 to 1.300, f_v 0.400 to 1.400"


def test_a_law_has_the_commands_of_the_run_and_not_of_the_bench() -> None:
    learner = Learner(learning(), make_law(BENCH)._replace(steps=100))
    learner.begin(sample())
    assert learner.question(sample())[0].steps == 100


def test_a_bench_that_does_not_grant_an_assumption_has_no_learner() -> None:
    with pytest.raises(BenchFileError, match="lags"):
        Learner(learning(current_lag=1e-3), make_law(BENCH))


def test_a_law_is_kept_for_ten_samples_at_most_and_its_age_is_recorded(simulate: Simulate) -> None:
    run = simulate(square, on_bench=learning(), options="seed=3,plant=exact")
    ages = [int(numbers[-1]) for *_, numbers in run.journal.learnt]
    assert ages[0] == 0
    assert max(ages) == 9
    assert all(after in (0, before + 1) for before, after in pairwise(ages))
    assert ages.count(0) < 250  # so that the median cycle makes none
