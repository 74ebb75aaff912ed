"""What the record of an honest experiment says of lies is what becomes of a run with a node that lies."""

from __future__ import annotations

import numpy as np
import pytest

from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.safety.state_machine import Fault
from emb_train.closed_loop import Conditions
from emb_train.env import EmbExcitationVectorEnv
from emb_train.lies import LIES, clearness
from emb_train.play import Planned
from emb_train.rewards import log_determinant
from tests.scenarios.lies import UNEXPLAINED, run

BENCH = load_bench()
PLANS = {  # Parts of the limit of the speed, and periods
    "one stroke": [(0.9, 120), (0.0, 60), (-0.3, 320)],
    "strokes": [(0.9, 100), (-0.9, 60), (0.9, 60), (-0.9, 80), (0.6, 60), (-0.5, 140)],
    "creep": [(0.2, 100), (-0.1, 100), (0.1, 100), (-0.2, 200)],
}


@pytest.mark.parametrize("plan", PLANS)
def test_a_run_with_a_lie_is_ended_where_the_honest_record_shows_it_clearly_and_not_where_it_does_not(
    plan: str,
) -> None:
    speeds = [speed for speed, periods in PLANS[plan] for _ in range(periods)]
    conditions = Conditions(acts="speed", observes="estimate", information="physical")
    env = EmbExcitationVectorEnv(1, BENCH, "pm50", PARAMETER_NAMES, log_determinant, conditions=conditions)
    env.reset(seed=1, options={"brakes": [BENCH.brake]})
    for speed in speeds:
        env.advance(np.array([[speed]], np.float32))
    e = env.batch.experiments
    found = clearness(BENCH, [BENCH.brake], e.x[:, :, :2], e.applied[:, 1:])[0]
    clear = 0
    for name, share in zip(LIES, found.tolist(), strict=True):
        fault = run(UNEXPLAINED[name], actor=Planned(speeds, BENCH)).outcome.fault
        if share > 1.4:
            assert fault is Fault.MOTION_UNEXPLAINED, (name, share, fault)
        if share < 0.7:
            assert fault is None, (name, share, fault)
        clear += not 0.7 <= share <= 1.4
    assert clear >= 5, found
