"""The actor that is shipped, as the ONNX file that it is: it comes home within limits, and beats pushing."""

from __future__ import annotations

from emb_runtime.config.bench import Bench
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.envs.excitations import Constant, OnnxFile
from emb_train.envs.play import GRID, run_grid


def test_on_the_grid_of_f_v_the_shipped_actor_returns_within_limits_and_tells_more_than_constant_current(
    bench: Bench,
) -> None:
    shipped, constant = OnnxFile(load_policy(shipped_actor_path(), bench).data), Constant(bench.limits.current)
    actor, push = run_grid(bench, bench.range_set("viscous"), "f_v", [shipped, constant], 1000, "euler")
    assert (actor.violations, actor.home) == (0, GRID)
    assert (push.violations, push.home) == (0, GRID)  # the shield's doing
    assert actor.mean > 1.03 * push.mean
    assert actor.mean > 2.03e7  # the thesis's agent B, Table 5.1
