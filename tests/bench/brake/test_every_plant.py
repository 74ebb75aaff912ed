"""The shipped actor and shield against every brake of the shipped bench file, on the simulated bus."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_bench.config.bench import Bench
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.safety.state_machine import Fault

from tests.conftest import SimRun, Simulate  # isort: skip

ENDS: dict[str, Fault | None] = {
    # What the shield is proved for, and what differs from it in friction at rest only.
    "euler": None,
    "exact": None,
    # Outside its assumptions; the run ends as it should, or the node ends it at a limit.
    "stribeck": None,
    "load": None,
    "cubic": None,
    "hysteresis": None,
    "play": None,
    "lag": Fault.RESPONSE_LATE,
    "late": Fault.RESPONSE_LATE,
    "offset": None,
    "jitter": None,
    "observer": Fault.RESPONSE_LATE,
    "rough": Fault.RESPONSE_LATE,
}
PROVED = ("euler", "exact")


def within_limits(run: SimRun, bench: Bench) -> bool:
    node, limits = run.transport.node, bench.limits
    low, high = node.angle_range
    return limits.angle[0] <= low and high <= limits.angle[1] and node.top_speed <= limits.velocity


def test_every_shipped_plant_has_a_documented_end(bench: Bench) -> None:
    assert list(ENDS) == list(bench.plants)


@pytest.mark.parametrize("plant", list(ENDS))
def test_full_current_on_any_plant_ends_by_itself_and_as_documented(
    simulate: Simulate, bench: Bench, plant: str
) -> None:
    run = simulate(lambda *_: 6.0, options=f"plant={plant}")
    assert run.outcome.fault is ENDS[plant]
    if run.outcome.fault is None:
        assert run.outcome.counters.answered == bench.timing.horizon


@pytest.mark.parametrize("plant", PROVED)
@pytest.mark.parametrize("theta", ["f_v=1e-5", "f_v=5e-5", "f_v=1e-5,k_m=3.2e-2", "f_v=5e-5,k_m=1.1e-2"])
def test_where_the_shield_s_assumptions_hold_the_limits_hold_and_the_brake_comes_home(
    simulate: Simulate, bench: Bench, plant: str, theta: str
) -> None:
    policy = load_policy(shipped_actor_path(), bench)
    run = simulate(actor=policy, options=f"plant={plant},{theta}")
    assert run.outcome.fault is None
    assert within_limits(run, bench)
    assert run.outcome.home


@pytest.mark.parametrize("current", [6.0, -6.0])
def test_a_shield_that_is_told_how_late_the_plant_is_holds_its_limits(
    simulate: Simulate, bench: Bench, current: float
) -> None:
    """A sample late each way: the answer to what is measured acts two periods after that."""
    told = replace(bench, shield=bench.shield._replace(frame_age=(2, 2)))
    run = simulate(lambda *_: current, options="plant=late", on_bench=told)
    assert run.outcome.fault is None
    assert within_limits(run, told)
    untold = simulate(lambda *_: current, options="plant=late")
    assert untold.outcome.fault is Fault.RESPONSE_LATE
    assert within_limits(untold, bench)
