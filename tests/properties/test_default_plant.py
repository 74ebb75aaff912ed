"""One brake is meant wherever none is named: the one that sticks. A first log fits the model that is chosen for it."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import pytest

from emb_bench import api
from emb_bench.cli import node, replay
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EXACT
from emb_bench.design.problem import make_problem
from emb_bench.sim.simulated_brake import read_brake
from emb_bench.sim.transport import open_sim
from emb_runtime.cli import options
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.closed_loop import Batch

from tests.bench.simulated_logs import write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip


def test_whatever_is_told_no_plant_takes_the_same(bench: Bench) -> None:
    defaults = [
        open_sim("", bench)[0].truth["plant"],
        read_brake(node.parser().parse_args(["--iface", "vcan0"]).brake, bench, "").plant.name,
        *(inspect.signature(call).parameters["plant"].default for call in (api.simulate, Batch)),
        *(inspect.signature(call).parameters["model"].default for call in (api.DesignOptions, make_problem)),
    ]
    assert set(defaults) == {DEFAULT_PLANT}
    assert bench.plant(DEFAULT_PLANT).mechanics.solver == EXACT
    assert f"(default: {DEFAULT_PLANT})" in options.EPILOG


@pytest.mark.parametrize("told", [True, False], ids=["simulated", "over a bus"])
def test_a_first_log_fits_the_model_that_is_chosen_for_it(
    tmp_path: Path, simulate: Simulate, bench: Bench, capsys: pytest.CaptureFixture[str], told: bool
) -> None:
    run = simulate(actor=load_policy(shipped_actor_path(), bench))
    header: dict[str, Any] = {} if told else {"metadata": {"emb.run": {}}}  # a bus does not say what moved
    path = write_log(tmp_path / "first.mcap", run, **header)
    assert replay.main(["fim", str(path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["model"], said["fit_sigmas"]["fits"], said["warnings"]) == (DEFAULT_PLANT, True, [])
