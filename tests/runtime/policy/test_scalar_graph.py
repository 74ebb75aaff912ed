"""A graph as operations on single numbers against ONNX Runtime, and which graphs it leaves to it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.replay.rerun import carried_policy, rerun
from emb_runtime.cli import options
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy import policy as policies
from emb_runtime.policy.contract import Contract
from emb_runtime.policy.onnx_file import read_graph
from emb_runtime.policy.policy import ONNX_RUNTIME, SCALARS, load_policy, shipped_actor_path
from emb_runtime.policy.scalar_graph import OPERATIONS_PER_NODE, scalar_actor
from emb_runtime.policy.scalar_operations import ScalarActor
from tests.actors import WIDE, contract_for, leaky_actor
from tests.runtime.operating import EmbRun

BENCH = load_bench()
EDGES = (0.0, 1.0, -1.0, 0.5, -3.0, 800.0, -800.0, 1e30)

HEAD = """<ir_version: 10, opset_import: ["" : 20]>
agent (float[1,4] obs) => (float[1,1] action)
<int64[4] parts = {1, 1, 1, 1}, int64[2] uneven = {1, 3}, int64[2] square = {2, 2}, int64[2] flat = {1, -1},
 int64[1] zero = {0}, int64[1] one = {1}, int64[1] last = {-1}, int64[1] far = {9999}, float bent = {2.5},
 double low = {0.5}, double high = {2.0}, double[1,1] half = {0.5}, double[1,1] two = {2.0},
 double[4,4] mix = {0.0, 1.0, 0.0, 2.0, 0.0, 0.5, 0.0, -1.0, 0.0, 0.0, 1.0, 0.25, 0.0, 3.0, 0.0, -2.0},
 double[4,1] pick = {0.0, 0.0, 1.0, 0.0}> {
    seen = Cast<to=11>(obs)
    a, b, c, d = Split<axis=1>(seen, parts)
    same = Reshape(seen, square)
"""


def file_of(*lines: str) -> bytes:
    """An ONNX file whose action is ``y``, made of the observation's parts ``a`` to ``d``."""
    text = HEAD + "\n".join(lines) + "\n action = Cast<to=1>(y)\n}"
    return bytes(onnx.parser.parse_model(text).SerializeToString())


def built(data: bytes) -> ScalarActor | None:
    return scalar_actor(read_graph(data), contract_for(BENCH, 0.0, {"observation": WIDE}))


def require_the_same(data: bytes, observations: Any) -> None:
    ours, session = built(data), ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    assert ours is not None
    for row in np.asarray(observations, np.float32):
        (theirs,) = session.run(["action"], {"obs": row[None]})
        assert ours.act(*row.tolist()) == pytest.approx(float(theirs[0, 0]), rel=2e-7, nan_ok=True)


@pytest.mark.parametrize(
    "line",
    [
        *(f"y = {name}(a, b)" for name in ("Add", "Sub", "Mul", "Div", "Max", "Min")),
        *(f"y = {name}(a)" for name in ("Abs", "Exp", "Log", "Neg", "Relu", "Sign", "Sqrt", "Tanh")),
        *(f"z = {name}(a, b)\n y = Where(z, c, d)" for name in ("Greater", "GreaterOrEqual", "Less", "LessOrEqual")),
        "z = Equal(a, b)\n y = Where(z, c, d)",
        "v = Less(a, c)\n w = Less(b, d)\n z = And(v, w)\n y = Cast<to=11>(z)",
        "y = Clip(a, low, high)",
        "y = Clip(a, high, low)",
        "y = Sub(half, a)",
    ],
)
def test_each_operation_says_what_onnx_runtime_says_also_where_there_is_no_value(line: str) -> None:
    drawn = np.random.default_rng(1).normal(0.0, 3.0, (200, 4))
    edges = np.array(list(itertools.product(EDGES, EDGES, EDGES[:2], EDGES[2:4])))
    require_the_same(file_of(line), np.concatenate([drawn, edges]))


@pytest.mark.parametrize(
    "lines",
    [
        ("z = MatMul(seen, mix)", "y = MatMul(z, pick)"),
        ("z = MatMul(seen, mix)", "w = ReduceSum<keepdims=1>(z, one)", "y = Mul(w, half)"),
        ("s = MatMul(same, same)", "t = Transpose<perm=[1, 0]>(s)", "r = Reshape(t, flat)", "y = MatMul(r, pick)"),
        ("z = Slice(seen, one, far, one, one)", "y = ReduceSum<keepdims=1>(z, one)"),
        ("z = Slice(seen, last, zero, one, last)", "y = ReduceSum<keepdims=1>(z, last)"),
        ("z = Concat<axis=1>(a, b, seen)", "v, w = Split<axis=1, num_outputs=2>(z)", "y = ReduceSum(w, one)"),
        ("v, w = Split<axis=-1>(seen, uneven)", "z = Mul(v, w)", "y = ReduceSum<keepdims=1>(z, one)"),
        ("z = Mul(same, a)", "w = Reshape(z, flat)", "y = MatMul(w, pick)"),
        ("z = Sub(two, half)", "w = Sqrt(z)", "y = Add(w, a)"),
        ("k = Constant<value_float=2.5>()", "v = Cast<to=11>(k)", "y = Mul(a, v)"),
        ("v = Cast<to=11>(bent)", "y = Mul(a, v)"),
        ("z = Mul(a, b)", "y = Sub(c, z)"),
        ("z = Mul(a, b)", "y = Sub(z, c)"),
        ("z = Mul(a, b)", "w = Mul(c, d)", "y = Add(z, w)"),
        ("z = Mul(a, b)", "w = Add(z, c)", "y = Sub(w, z)"),  # a product that is used twice
    ],
)
def test_what_places_picks_and_sums_numbers_says_what_onnx_runtime_says(lines: tuple[str, ...]) -> None:
    require_the_same(file_of(*lines), np.random.default_rng(2).normal(0.0, 3.0, (20, 4)))


LETTERS = st.sampled_from(["a", "b", "c", "d", "half", "two"])


@settings(max_examples=60)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["Add", "Sub", "Mul", "Max", "Min", "Tanh", "Abs"]), LETTERS, LETTERS, st.booleans()),
        min_size=1,
        max_size=12,
    ),
    seed=st.integers(0, 1000),
)
def test_any_graph_of_them_says_what_onnx_runtime_says(steps: list[tuple[str, str, str, bool]], seed: int) -> None:
    lines, newest = [], "a"
    for i, (operator, one, other, joins) in enumerate(steps):
        operands = one if operator in ("Tanh", "Abs") else f"{newest if joins else one}, {other}"
        newest = f"n{i}"
        lines.append(f"{newest} = {operator}({operands})")
    data = file_of(*lines, f"y = Add({newest}, a)")
    ours, session = built(data), ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    assert ours is not None
    for row in np.random.default_rng(seed).normal(0.0, 2.0, (5, 4)).astype(np.float32):
        (theirs,) = session.run(["action"], {"obs": row[None]})
        assert ours.act(*row.tolist()) == pytest.approx(float(theirs[0, 0]), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    "lines",
    [
        ("y = Sin(a)",),  # an operator that is none of those
        ("y = Max(a, b, c)",),  # more operands
        ("y = Clip(a, low)",),
        ("y = Clip(a, , high)",),
        ("z = Cast<to=7>(a)", "y = Cast<to=11>(z)"),  # a number that is rounded to a whole one
        ("z = Mul(same, half)", "v = Slice(z, zero, one)", "w = Reshape(v, flat)", "y = ReduceSum(w, one)"),
        ("z = ReduceSum<keepdims=0>(seen, one)", "y = Reshape(z, flat)"),
        ("z = ReduceSum<keepdims=1>(seen)", "y = Identity(z)"),
        ("v, w, x = Split<axis=1, num_outputs=3>(seen)", "y = ReduceSum(x, one)"),  # of 4 numbers
        ("z = Transpose(same)", "w = Reshape(z, flat)", "y = MatMul(w, pick)"),
        ("p = Reshape(pick, last)", "z = MatMul(seen, p)", "y = Reshape(z, flat)"),  # a vector
    ],
)
def test_what_is_not_known_is_left_to_onnx_runtime(lines: tuple[str, ...]) -> None:
    data = file_of(*lines)
    ort.InferenceSession(data, providers=["CPUExecutionProvider"])  # which takes it
    assert built(data) is None


def test_a_graph_with_many_numbers_per_node_is_left_to_onnx_runtime() -> None:
    def chain(width: int) -> bytes:
        ones = ", ".join(["1.5"] * width)
        text = HEAD.replace("{\n    seen", f"{{\n wide = Constant<value = double[1,{width}] {{{ones}}}>()\n    seen")
        lines = "z = Mul(a, wide)\n w = Tanh(z)\n y = ReduceSum(w, one)\n action = Cast<to=1>(y)\n}"
        return bytes(onnx.parser.parse_model(text + lines).SerializeToString())

    assert built(chain(1)) is not None
    assert built(chain(64)) is None
    assert 8 * OPERATIONS_PER_NODE < 3 * 64


def test_constants_of_any_size_and_results_of_any_size_end_the_building_early() -> None:
    """A million products would be a million objects: ONNX Runtime may have them."""
    side = 400
    graph = onnx.parser.parse_graph(
        """agent (float[1,4] obs) => (float[1,1] action) <int64[1] one = {1}, int64[1] zero = {0},
        int64[1] four = {4}> {
        seen = Cast<to=11>(obs)
        q = MatMul(big, big)
        r = Slice(q, zero, four, zero, one)
        s = MatMul(seen, r)
        y = ReduceSum(s, one)
        action = Cast<to=1>(y)
    }"""
    )
    graph.initializer.append(onnx.numpy_helper.from_array(np.ones((side, side)), "big"))
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=10)
    assert built(model.SerializeToString()) is None


def test_not_a_number_stays_one_and_a_product_with_zero_is_zero() -> None:
    actor = built(file_of("z = Max(a, b)", "w = Min(z, c)", "v = Clip(w, low, high)", "y = Add(v, d)"))
    assert actor is not None
    for place in range(4):
        seen = [1.0, 1.0, 1.0, 1.0]
        seen[place] = math.nan
        assert math.isnan(actor.act(*seen))
    actor = built(file_of("z = MatMul(seen, pick)", "y = Mul(z, two)"))
    assert actor is not None
    assert actor.act(math.inf, math.nan, 1.5, 0.0) == 3.0


# The shipped actors, and who evaluates what ---------------------------------------------------------------------------


@pytest.mark.parametrize("quick", [False, True])
def test_a_shipped_actor_is_evaluated_by_scalar_operations_and_says_what_onnx_runtime_says(quick: bool) -> None:
    data = shipped_actor_path(quick).read_bytes()
    fast, slow = load_policy(data, BENCH), load_policy(data, BENCH, ONNX_RUNTIME)
    assert (fast.evaluated_by, slow.evaluated_by) == (SCALARS, ONNX_RUNTIME)
    for sequence in fast.contract.sequences:
        fast.begin()
        slow.begin()
        for vector in sequence:
            assert fast.act(*vector.observation) == pytest.approx(slow.act(*vector.observation), abs=1e-6)
            assert fast.estimate == pytest.approx(slow.estimate, rel=1e-6)
            assert fast.state == pytest.approx(slow.state, rel=1e-6)


@pytest.mark.parametrize("spoilt", ["state", "estimate", "action", "refusal"])
def test_scalar_operations_with_a_planted_error_are_not_used(spoilt: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Spoilt(ScalarActor):
        def act(self, *seen: float) -> float:
            said = super().act(*seen)
            if spoilt == "refusal":
                raise PolicyRefusedError("no")
            if spoilt == "estimate":
                self._estimate[0].value *= 1.001
            if spoilt == "state":
                self._state[0].value *= 1.001
            return said + 0.01 if spoilt == "action" else said

    def spoil(graph: Any, contract: Contract) -> Any:
        actor = scalar_actor(graph, contract)
        assert actor is not None
        actor.__class__ = Spoilt
        return actor

    monkeypatch.setattr(policies, "scalar_actor", spoil)
    assert load_policy(leaky_actor(BENCH), BENCH).evaluated_by == ONNX_RUNTIME


@pytest.mark.parametrize("evaluated_by", [SCALARS, ONNX_RUNTIME])
def test_a_rerun_has_the_policy_evaluated_by_what_the_log_names(
    emb_run: EmbRun, monkeypatch: pytest.MonkeyPatch, evaluated_by: str
) -> None:
    monkeypatch.setattr(options, "admit_policy", lambda path, bench: load_policy(path, bench, evaluated_by))
    emb_run.text("--iface", "sim", "--yes", "--policy", str(shipped_actor_path()))
    log = emb_run.log()
    assert log.run["policy_evaluated_by"] == evaluated_by
    policy = carried_policy(log)
    assert policy.evaluated_by == evaluated_by
    assert rerun(log, policy, policy.contract.action_limit).reproduced
    # A version that does not tell had no scalar operations.
    told = {name: value for name, value in log.run.items() if name != "policy_evaluated_by"}
    older = replace(log, metadata={**log.metadata, "emb.run": told})
    assert carried_policy(older).evaluated_by == ONNX_RUNTIME
