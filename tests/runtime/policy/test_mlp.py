"""A network in numpy against ONNX Runtime, and which graphs it leaves to it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from emb_runtime.config.bench import load_bench
from emb_runtime.policy.contract import CONTRACT_KEY
from emb_runtime.policy.mlp import MOST_WEIGHTS, Network, network
from emb_runtime.policy.onnx_file import read_graph
from emb_runtime.policy.policy import load_policy
from tests.actors import alone, constant_actor, contract_for

BENCH = load_bench()
WIDTH = 3
Constants = dict[str, Any]


def file_of(nodes: list[onnx.NodeProto], constants: Constants, contract: str = "", raw: bool = True) -> bytes:
    """An ONNX file of one graph from obs [1, 3] to action [1, 1]."""
    tensors = []
    for name, value in constants.items():
        array = np.asarray(value, np.float32)
        if raw:
            tensors.append(onnx.numpy_helper.from_array(array, name))
        else:
            tensors.append(helper.make_tensor(name, TensorProto.FLOAT, array.shape, array.ravel().tolist()))
    graph = helper.make_graph(
        nodes,
        "actor",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, WIDTH])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, 1])],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    if contract:
        helper.set_model_props(model, {CONTRACT_KEY: contract})
    return bytes(model.SerializeToString())


def perceptron(seed: int, widths: list[int], *, transposed: bool = True) -> tuple[list[onnx.NodeProto], Constants]:
    """Centre and span of the observation, layers with tanh between, a clip and a factor: as actors are exported."""
    dice = np.random.default_rng(seed)
    nodes = [
        helper.make_node("Sub", ["obs", "centre"], ["a"]),
        helper.make_node("Div", ["a", "span"], ["x0"]),
    ]
    constants: Constants = {"centre": dice.normal(size=WIDTH) * 50, "span": dice.uniform(1, 100, WIDTH)}
    sizes = [WIDTH, *widths, 1]
    for k, (before, after) in enumerate(pairwise(sizes)):
        weights = dice.normal(size=(before, after)) / np.sqrt(before)
        constants[f"w{k}"] = weights.T if transposed else weights
        constants[f"b{k}"] = dice.normal(size=after)
        nodes.append(helper.make_node("Gemm", [f"x{k}", f"w{k}", f"b{k}"], [f"y{k}"], transB=int(transposed)))
        last = k == len(widths)
        nodes.append(
            helper.make_node("Clip", [f"y{k}", "low", "high"], ["z"])
            if last
            else helper.make_node("Tanh", [f"y{k}"], [f"x{k + 1}"])
        )
    constants |= {"low": -1.0, "high": 1.0, "gain": 6.0}
    return [*nodes, helper.make_node("Mul", ["z", "gain"], ["action"])], constants


def built(data: bytes) -> Network | None:
    return network(read_graph(data), "obs", "action")


@given(
    seed=st.integers(0, 2**32 - 1),
    widths=st.lists(st.integers(1, 64), max_size=3),
    transposed=st.booleans(),
    raw=st.booleans(),
)
def test_a_network_says_what_onnx_runtime_says(seed: int, widths: list[int], transposed: bool, raw: bool) -> None:
    data = file_of(*perceptron(seed, widths, transposed=transposed), raw=raw)
    ours, session = built(data), ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    assert ours is not None
    for observation in np.random.default_rng(seed).uniform(-100, 500, (5, WIDTH)).astype(np.float32):
        (theirs,) = session.run(["action"], {"obs": observation[None]})
        angle, velocity, step = observation.tolist()
        assert ours.act(angle, velocity, step, 0.0) == pytest.approx(float(theirs[0, 0]), abs=6e-5)
        assert ours.act(angle, velocity, step, 0.0) == ours.act(angle, velocity, step, 0.0)
        assert np.isnan(ours.act(np.nan, velocity, step, 0.0))


def test_a_network_of_operators_of_the_standard_domain_by_its_other_name_is_the_same_network() -> None:
    nodes, constants = perceptron(3, [8])
    plain = built(file_of(nodes, constants))
    for node in nodes:
        node.domain = "ai.onnx"
    named = built(file_of(nodes, constants))
    assert plain is not None
    assert named is not None
    assert named.act(10.0, -50.0, 7.0, 0.0) == plain.act(10.0, -50.0, 7.0, 0.0)


@pytest.mark.parametrize(
    ("nodes", "constants"),
    [
        ([helper.make_node("Relu", ["obs"], ["a"])], {}),  # an operator that is not known here
        ([helper.make_node("Tanh", ["obs"], ["a"], domain="ours")], {}),
        ([helper.make_node("Add", ["obs", "obs"], ["a"])], {}),  # not a chain
        ([helper.make_node("Add", ["c", "obs"], ["a"])], {"c": [1.0]}),
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": np.ones((3, 1))}),  # makes a matrix of the row
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": np.ones((1, 1, 3))}),
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": [1.0, 2.0]}),
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": [np.nan]}),
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": [1e7]}),
        ([helper.make_node("Add", ["obs", "c"], ["a"])], {"c": np.ones(0)}),
        ([helper.make_node("Div", ["obs", "c"], ["a"])], {"c": [0.0]}),
        ([helper.make_node("Div", ["obs", "c"], ["a"])], {"c": [1e-7]}),
        ([helper.make_node("Clip", ["obs", "c"], ["a"])], {"c": 1.0}),
        ([helper.make_node("Clip", ["obs", "", "c"], ["a"])], {"c": 1.0}),
        ([helper.make_node("Clip", ["obs", "c", "d"], ["a"])], {"c": np.zeros(3), "d": np.ones(3)}),
        ([helper.make_node("Tanh", ["obs"], ["a"], mode="x")], {}),
        ([helper.make_node("Tanh", ["obs"], ["a"], mode=1)], {}),
        ([helper.make_node("Gemm", ["obs", "w"], ["a"])], {"w": np.ones((3, 1))}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"])], {"w": np.ones((2, 1)), "b": [0.0]}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"])], {"w": np.ones((3, 2)), "b": np.ones((2, 1))}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"])], {"w": np.ones((3, 1, 1)), "b": [0.0]}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"], alpha=0.5)], {"w": np.ones((3, 1)), "b": [0.0]}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"], beta=0.5)], {"w": np.ones((3, 1)), "b": [0.0]}),
        ([helper.make_node("Gemm", ["obs", "w", "b"], ["a"], transA=1)], {"w": np.ones((3, 1)), "b": [0.0]}),
        (
            [helper.make_node("Gemm", ["obs", "w", "b"], ["a"])],
            {"w": np.ones((3, MOST_WEIGHTS // 3 + 1)), "b": [0.0]},
        ),
        ([], {}),
    ],
)
def test_what_is_not_known_is_left_to_onnx_runtime(nodes: list[onnx.NodeProto], constants: Constants) -> None:
    tail = helper.make_node("Gemm", ["a" if nodes else "other", "last", "bias"], ["action"])
    last = {"last": np.ones((WIDTH, 1)), "bias": [0.0]}
    assert built(file_of([*nodes, tail], {**constants, **last})) is None


def test_an_output_that_is_not_the_last_one_or_more_than_one_number_is_left_to_onnx_runtime() -> None:
    tanh, unnamed = helper.make_node("Tanh", ["obs"], ["action"]), helper.make_node("Tanh", ["obs"], ["a"])
    assert built(file_of([tanh], {})) is None
    assert built(file_of([unnamed], {})) is None


def answers_of(data: bytes) -> Callable[[tuple[float, ...]], float]:
    """What ONNX Runtime says of one observation."""
    session = ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    return lambda observation: float(session.run(["action"], {"obs": np.array([observation], np.float32)})[0][0, 0])


def signed(nodes: list[onnx.NodeProto], constants: Constants) -> bytes:
    """A policy file of this graph, whose vectors say what ONNX Runtime says."""
    says = answers_of(file_of(nodes, constants))
    vectors = alone(v._replace(action=says(v.observation)) for v in contract_for(BENCH, 1.0, {}).vectors)
    return file_of(nodes, constants, contract_for(BENCH, 1.0, {"sequences": vectors}).to_json())


def test_a_policy_of_a_plain_network_is_evaluated_without_onnx_runtime_and_says_the_same() -> None:
    data = signed(*perceptron(7, [64, 64]))
    policy, says = load_policy(data, BENCH), answers_of(data)
    assert policy.evaluated_by == "numpy"
    for observation in ((0.0, 0.0, 0.0), (40.0, -200.0, 123.0), (-10.0, 500.0, 499.0)):
        assert policy.act(*observation, 0.0) == pytest.approx(says(observation), abs=6e-5)


def test_a_policy_of_any_other_graph_is_evaluated_by_onnx_runtime() -> None:
    policy = load_policy(constant_actor(BENCH, 2.0), BENCH)
    assert policy.evaluated_by == "onnxruntime"
    assert policy.act(1.0, 2.0, 3.0, 0.0) == 2.0


def test_a_network_that_says_something_else_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    data, original = signed(*perceptron(7, [8])), Network.act
    monkeypatch.setattr(Network, "act", lambda self, *observation: original(self, *observation) * 1.001 + 0.01)
    assert load_policy(data, BENCH).evaluated_by == "onnxruntime"
