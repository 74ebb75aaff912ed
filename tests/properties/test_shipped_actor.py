"""The shipped actors, as the ONNX files that they are: each is its reference, and what is said of it holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.envs.conditions import Conditions
from emb_train.envs.excitations import OnnxFile, Played
from emb_train.envs.measure import MEASURES
from emb_train.envs.network import StatefulNetwork
from emb_train.envs.play import fresh_draws, play
from emb_train.structured.actor import actor_of
from emb_train.structured.stored import stored
from tools.shipped_actors import REFERENCES

from tests.runtime.operating import EmbRun  # isort: skip

PHYSICAL = Conditions(information="physical")


@pytest.mark.parametrize("quick", [False, True])
def test_a_shipped_file_is_the_actor_of_its_reference(bench: Bench, quick: bool) -> None:
    kept, policy = stored(REFERENCES[quick]), load_policy(shipped_actor_path(quick), bench)
    draws, ranges = fresh_draws(bench.range_set("pm50"), 4, 3), bench.range_set("pm50")
    excitations = StatefulNetwork(actor_of(kept, bench).eval()), OnnxFile(policy.data, policy.contract.initial_state)
    actor, file = (play(bench, ranges, PARAMETER_NAMES, e, draws, kept.plant, PHYSICAL) for e in excitations)
    np.testing.assert_allclose(file.matrices, actor.matrices, rtol=1e-3)


@pytest.mark.parametrize("quick", [False, True])
def test_a_shipped_file_says_at_each_of_its_test_vectors_what_its_reference_says_with_the_estimator_as_it_is(
    bench: Bench, quick: bool
) -> None:
    actor = actor_of(stored(REFERENCES[quick]), bench).eval()
    sequences = load_policy(shipped_actor_path(quick), bench).contract.sequences
    state, judged = actor.initial_state.to(torch.float64).repeat(len(sequences), 1), 0
    for vectors in zip(*sequences, strict=True):
        with torch.no_grad():
            current, state, estimate = actor(torch.tensor([v.observation for v in vectors]), state)
        np.testing.assert_allclose(current[:, 0].numpy(), [v.action for v in vectors], atol=1e-4)
        for found, vector in zip(estimate.numpy(), vectors, strict=True):
            if vector.estimate:
                np.testing.assert_allclose(found, vector.estimate, rtol=1e-4)
                judged += 1
    assert judged > 10


def test_on_brakes_that_it_never_saw_the_shipped_actor_returns_within_limits_and_tells_more_than_constant_current(
    bench: Bench,
) -> None:
    policy, ranges = load_policy(shipped_actor_path(), bench), bench.range_set("pm50")
    shipped, constant = (
        OnnxFile(policy.data, policy.contract.initial_state),
        Played(np.full(bench.timing.horizon, bench.limits.current)),
    )
    draws = fresh_draws(ranges, 1000, 20)
    actor, push = (play(bench, ranges, PARAMETER_NAMES, e, draws, conditions=PHYSICAL) for e in (shipped, constant))
    for played in (actor, push):
        assert (int(played.left.sum()), int(played.home.sum())) == (0, len(draws))  # the shield's doing
    for name in ("D", "E"):
        more = MEASURES[name].values(actor.matrices) - MEASURES[name].values(push.matrices)
        assert (more > 0.0).all()


def test_the_first_run_of_a_newcomer_states_all_four_parameters_to_three_thousandths_of_a_percent_and_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = EmbRun((), capsys, tmp_path / "run.mcap").document("--iface", "sim")
    assert (said["answered"], said["home"]) == (500, True)
    truth = read_log(tmp_path / "run.mcap").truth
    for name in PARAMETER_NAMES:
        found = said["estimate"][name]
        assert found["deviation"] < 3e-5 * found["value"]
        assert abs(found["value"] - getattr(truth, name)) < 4.0 * found["deviation"]


def test_quick_ends_in_about_a_tenth_of_a_second_with_all_four_parameters_within_two_percent_and_comes_home(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = EmbRun(("--quick",), capsys, tmp_path / "run.mcap")
    said = run.document("--iface", "sim:f_v=3e-5,k_1=20")
    assert (said["goal_reached"], said["home"]) == (True, True)
    assert said["goal_s"] < 0.13 < said["duration_s"] < 0.3
    truth = {"k_m": 0.0217, "k_1": 20.0, "T_c": 0.01037, "f_v": 3e-5}
    for name, value in truth.items():
        assert said["estimate"][name]["value"] == pytest.approx(value, rel=0.02)
    assert run.log().run["stop_when"] == "k_m=0.6%,k_1=0.6%,T_c=0.6%,f_v=0.6%"


def test_quick_ends_where_stop_when_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = []
    for goal in ("k_m=1%", "f_v=0.1%"):
        run = EmbRun(("--quick", "--stop-when", goal), capsys, tmp_path / f"{goal}.mcap")
        ends.append(run.document()["goal_s"])
        assert run.log().run["stop_when"] == goal
    assert ends[0] < ends[1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [(["--quick", "--policy", "a.onnx"], "not allowed with"), (["--quick", "--read-only"], "--quick could end")],
)
def test_quick_says_no_where_it_means_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    from emb_runtime.cli.main import main

    try:
        code = main([*arguments, "--log", str(tmp_path / "run.mcap")])
    except SystemExit as end:  # argparse
        code = int(str(end.code))
    assert code == 2
    assert reason in capsys.readouterr().err
