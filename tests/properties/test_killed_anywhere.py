"""Whatever the policy does and whenever the runtime dies, the safe stop begins in time and no limit is passed."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.sim.transport import open_sim
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench
from emb_runtime.records import Frame, NodeState
from tests.conftest import FunctionActor, Journal, make_loop

BENCH = load_bench()
BOX = BENCH.range_set(BENCH.shield.ranges)

POLICIES = {
    "forward": lambda _a, _v, _k: 6.0,
    "backward": lambda _a, _v, _k: -6.0,
    "outward then home": lambda _a, _v, k: 6.0 if k < 200 else -6.0,
    "chatter": lambda _a, _v, k: 6.0 if k % 2 else -6.0,
    "away from zero": lambda a, _v, _k: math.copysign(6.0, a),
    "faster": lambda _a, v, _k: math.copysign(6.0, v),
    "slow bang-bang": lambda _a, _v, k: 6.0 if (k // 60) % 2 == 0 else -6.0,
}


class Killed(BaseException):
    """Stands for kill -9: whoever catches it can neither send nor receive any more."""


@settings(max_examples=15, deadline=None)
@given(
    policy=st.sampled_from(sorted(POLICIES)),
    where=st.tuples(*[st.sampled_from([0.0, 1.0, 0.5]) for _ in PARAMETER_NAMES]),
    last_step=st.integers(0, 499),
    seed=st.integers(0, 1000),
)
def test_a_runtime_killed_at_any_moment_leaves_the_brake_inside_its_limits(
    policy: str, where: tuple[float, ...], last_step: int, seed: int
) -> None:
    theta = {
        name: getattr(BOX.low, name) + share * (getattr(BOX.high, name) - getattr(BOX.low, name))
        for name, share in zip(PARAMETER_NAMES, where, strict=True)
    }
    options = ",".join([f"seed={seed}", *(f"{name}={value!r}" for name, value in theta.items())])
    transport, clock = open_sim(options, BENCH)
    node = transport.node

    dead = False

    def send(frame: Frame) -> None:
        nonlocal dead
        if not dead:
            transport.send(frame)
        dead = dead or node.obeyed > last_step
        if dead:
            raise Killed

    def receive(deadline_ns: int) -> Frame | None:
        if dead:
            raise Killed
        return transport.receive(deadline_ns)

    driven: Any = {"send": send, "receive": receive, "now_ns": clock.now_ns, "push": Journal().push}
    try:
        make_loop(BENCH, FunctionActor(POLICIES[policy]), 500, **driven).run()
    except Killed:
        obeyed, braked_until_stop = node.obeyed, 0
        while node.state is not NodeState.STOPPING:
            node.tick()
            braked_until_stop += 1
            assert braked_until_stop * BENCH.timing.sample_time <= BENCH.node.watchdog + 2 * BENCH.timing.sample_time
        assert node.obeyed <= obeyed + 1
    for _ in range(2000):
        node.tick()
    low, high = BENCH.limits.angle
    assert low <= node.angle_range[0]
    assert node.angle_range[1] <= high
    assert node.top_speed <= BENCH.limits.velocity
