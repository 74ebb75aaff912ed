"""Whatever target speeds a network requests, the brake keeps its limits and comes home, also where a node lies."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.policy.policy import Policy, load_policy, shipped_actor_path
from emb_runtime.safety.state_machine import Fault
from tests.actors import constant_actor, speed_network
from tests.conftest import Simulate
from tests.lying.node import HONEST, Lie
from tests.runtime.operating import EmbRun
from tests.scenarios.lies import assert_inside, run

BENCH = load_bench()
HALF = math.pi / 2

NETWORKS: dict[str, tuple[tuple[float, float, float], float]] = {
    "full speed forward": ((0.0, 0.0, 0.0), HALF),
    "full speed backward": ((0.0, 0.0, 0.0), -HALF),
    "faster the way it moves": ((0.0, 0.003, 0.0), 0.0),
    "another speed at each sample": ((0.0, 0.0, 1000.0 * math.pi), 0.001),
    "to and fro at the angle limit": ((0.03, 0.0, 0.0), HALF),
    "to and fro at the speed limit": ((0.0, 0.0062, 0.0), HALF),
    "chaos": ((17.3, 5.7, 911.0), 0.5),
    "slow chaos": ((0.31, 0.017, 23.0), -0.5),
}
"""Weights of angle, velocity and time, and the phase, of :func:`tests.actors.speed_network`."""

LIES: dict[str, Lie] = {
    "honest": HONEST,
    "frames are lost": Lie(lost=0.05),
    "angles jump": Lie(jump=5.0, duty=0.1),
    "the velocity is off": Lie(offset=40.0),
    "both sensors halve": Lie(scale=0.5, duty=0.5),
    "sensors have the wrong sign": Lie(sensors=-1, begin=0.0),
    "commands are not obeyed": Lie(deaf=True, duty=0.25),
    "the clock is random": Lie(clock_random=0.01),
}


SHIPPED = "the shipped one"


def network(name: str) -> Policy:
    return load_policy(shipped_actor_path() if name == SHIPPED else speed_network(BENCH, *NETWORKS[name]), BENCH)


@pytest.mark.parametrize("name", [*NETWORKS, SHIPPED])
def test_no_brake_of_the_set_leaves_its_limits_and_each_comes_home(name: str, simulate: Simulate) -> None:
    ranges, limits = BENCH.range_set(BENCH.shield.ranges), BENCH.limits
    shares = np.random.default_rng(7).uniform(-0.5, 1.5, (4, 4)).clip(0.0, 1.0)  # half of them at a border
    actor = network(name)
    for number, row in enumerate(shares.tolist()):
        box = zip(PARAMETER_NAMES, row, strict=True)
        theta = [f"{p}={getattr(ranges.low, p) * (1 - s) + getattr(ranges.high, p) * s!r}" for p, s in box]
        found = simulate(actor=actor, options=",".join((*theta, f"seed={number}")))
        low, high = found.transport.node.angle_range
        assert found.outcome.fault is None, (theta, found.outcome.detail)
        assert found.outcome.home
        assert limits.angle[0] <= low <= high <= limits.angle[1], theta
        assert found.transport.node.top_speed <= limits.velocity, theta


@pytest.mark.parametrize("skipped", [1, pytest.param(0, marks=pytest.mark.slow)], ids=["", "the other networks"])
@pytest.mark.parametrize("lie", LIES)
def test_a_node_that_lies_meanwhile_does_not_drive_it_out_of_its_limits(lie: str, skipped: int) -> None:
    """By half of the networks, every lie by others than the one before; by the other half at night."""
    for name in [*NETWORKS][(list(LIES).index(lie) + skipped) % 2 :: 2]:
        seen = run(LIES[lie], actor=network(name))
        assert seen.outcome.fault is None or lie != "honest", (name, seen.outcome.detail)
        assert_inside(seen)


@pytest.mark.parametrize(
    ("later", "fault", "words"),
    [
        (math.nan, Fault.POLICY_NOT_FINITE, "it answered nan"),
        (-math.inf, Fault.POLICY_NOT_FINITE, "it answered nan"),
        (math.inf, Fault.POLICY_NOT_FINITE, "it answered nan"),
        (1e9, Fault.POLICY_BEYOND_CONTRACT, "it requested 2e+06 times what its contract allows"),
        (-900.0, Fault.POLICY_BEYOND_CONTRACT, "it requested 1.8 times what its contract allows"),
        *((beyond, Fault.POLICY_BEYOND_CONTRACT, "it requested 1 times") for beyond in (500.001, -500.001)),
        *((within, None, "") for within in (500.0, -500.0, 0.0)),
    ],
)
def test_a_speed_that_no_contract_allows_ends_the_run_by_the_stop_frame(
    later: float, fault: Fault | None, words: str, simulate: Simulate
) -> None:
    policy = load_policy(constant_actor(BENCH, 300.0, later, kind="speed"), BENCH)
    found = simulate(actor=policy)
    assert found.outcome.fault is fault
    assert found.outcome.detail.startswith(words)
    assert found.outcome.counters.answered == (500 if fault is None else 100)
    assert found.transport.node.top_speed <= BENCH.limits.velocity


def test_emb_run_follows_a_target_speed_and_names_the_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "speed.onnx").write_bytes(constant_actor(BENCH, 100.0, -100.0, kind="speed"))
    run_ = EmbRun(("--policy", str(tmp_path / "speed.onnx"), "--duration", "0.2"), capsys, tmp_path / "run.mcap")
    said = run_.document("--iface", "sim")
    assert (said["result"], said["policy_kind"]) == ("done", "speed")
    assert run_.log().run["policy_kind"] == "speed"
