"""The excitation of a step: a policy file like any other, that drives the brake no farther out of its window."""

from __future__ import annotations

import onnx
import pytest

from emb_bench.commission.records import Kind, Step, Window
from emb_bench.commission.steps import policy_file
from emb_bench.config.bench import load_bench
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.policy.policy import Policy, load_policy

STEP = Step("try", Kind.EXPERIMENT, "", "", 2.0, 0.5, Window(-1.0, 2.0, 30.0), (1.0, 1.0, -1.5, 0.25))

ESTIMATOR = Estimator(load_bench())


@pytest.fixture(scope="module")
def policy() -> Policy:
    bench = load_bench()
    return load_policy(policy_file(STEP, bench), bench)


def test_the_file_is_onnx_by_the_reference_checker() -> None:
    model = onnx.load_from_string(policy_file(STEP, load_bench()))
    onnx.checker.check_model(model, full_check=True)


def test_inside_of_the_window_the_sequence_is_played_and_its_end_stays(policy: Policy) -> None:
    assert [policy.act(0.5, 1.0, k, ESTIMATOR) for k in range(6)] == [1.0, 1.0, -1.5, 0.25, 0.25, 0.25]


@pytest.mark.parametrize(
    ("angle", "velocity", "step", "wanted"),
    [
        (2.5, 0.0, 0, 0.0),  # beyond the upper angle: no more up,
        (2.5, 0.0, 2, -1.5),  # but down
        (-1.5, 0.0, 2, 0.0),
        (-1.5, 0.0, 0, 1.0),
        (0.0, 31.0, 0, 0.0),
        (0.0, 31.0, 2, -1.5),
        (0.0, -31.0, 2, 0.0),
        (0.0, -31.0, 0, 1.0),
        (2.5, -31.0, 0, 0.0),
        (2.5, -31.0, 2, 0.0),
    ],
)
def test_outside_of_it_no_current_drives_farther_out(
    policy: Policy, angle: float, velocity: float, step: int, wanted: float
) -> None:
    assert policy.act(angle, velocity, step, ESTIMATOR) == wanted
