"""The work of a graph is known before it is done: shapes as ONNX itself has them, and bounds that nothing gets past."""

from __future__ import annotations

import math
import tracemalloc
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import numpy_helper
from onnx.backend.test.case.node import collect_testcases
from onnx.backend.test.case.test_case import TestCase as NodeCase

from emb_runtime.config.bench import load_bench
from emb_runtime.policy.onnx_file import read_graph
from emb_runtime.policy.operators import FIXED
from emb_runtime.policy.policy import shipped_actor_path
from emb_runtime.policy.shapes import MAX_RESULT, MAX_WORK, require_bounded_work, result_shapes
from tests.actors import constant_actor, leaky_actor
from tests.runtime.operating import refusal

ONLY_BOUNDED = {"LayerNormalization"}  # Further results are smaller than is reckoned with


def graph_of(text: str) -> Any:
    model = onnx.parser.parse_model('<ir_version: 10, opset_import: ["" : 20]>\n' + text)
    return read_graph(model.SerializeToString())


def judged(body: str, weights: str = "float[1,1] u = {2.0}", inputs: str = "float[1,3] obs") -> None:
    require_bounded_work(graph_of(f"agent ({inputs}) => (float[1,1] action) <{weights}> {{ {body} }}"))


def told(body: str, weights: str = "float[1,1] u = {2.0}") -> str:
    return refusal(lambda: judged(body, weights))


def onnx_s_own() -> Iterator[NodeCase]:
    """ONNX's tests of single operators, with what they must give."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # ONNX makes its expectations with numpy, and some overflow on purpose
        cases = collect_testcases(None)
    for case in cases:
        if case.model is None or not case.data_sets or len(case.model.graph.node) != 1:
            continue
        (node,) = case.model.graph.node
        data = [*case.data_sets[0][0], *case.data_sets[0][1]]
        known = all(isinstance(each, np.ndarray | np.generic) and each.dtype.kind in "biufUO" for each in data)
        known &= case.name != "test_range_float16_type_positive_delta"  # ONNX Runtime computes none
        if node.op_type in FIXED and node.domain == "" and known:
            yield case


def with_constants(case: NodeCase) -> onnx.ModelProto:
    """The model of a test with the inputs that must stand in the file as initializers."""
    assert case.data_sets is not None
    assert case.model is not None
    model = onnx.ModelProto()
    model.CopyFrom(case.model)
    (node,) = model.graph.node
    sizes = set(node.input[FIXED[node.op_type]])
    for port, value in zip(list(model.graph.input), case.data_sets[0][0], strict=True):
        if port.name in sizes:
            model.graph.input.remove(port)
            model.graph.initializer.append(numpy_helper.from_array(np.asarray(value), port.name))
    return model


CASES = list(onnx_s_own())


def test_onnx_has_a_test_of_every_operator_that_is_let_through() -> None:
    tested = {case.model.graph.node[0].op_type for case in CASES if case.model is not None}
    assert set(FIXED) - tested <= {"Cast", "CastLike"}  # they have theirs in types that numpy does not know
    assert len(CASES) > 400


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_shapes_are_those_that_onnx_expects(case: NodeCase) -> None:
    assert case.data_sets is not None
    graph = read_graph(with_constants(case).SerializeToString())
    (node,) = graph.nodes
    found = result_shapes(node, {name: t.shape for name, t in graph.tensors.items()} | dict(graph.inputs), graph)
    expected = [np.asarray(value).shape for value in case.data_sets[0][1]]
    given = [shape for shape, name in zip(found, node.outputs, strict=False) if name]
    assert len(given) == len(expected)
    if node.operator in ONLY_BOUNDED:
        assert all(math.prod(a) >= math.prod(b) for a, b in zip(given, expected, strict=True))
    else:
        assert given == expected


def test_an_honest_actor_is_far_from_every_bound() -> None:
    bench = load_bench()
    for data in (constant_actor(bench), leaky_actor(bench), shipped_actor_path().read_bytes()):
        require_bounded_work(read_graph(data))


BIG = "int64[2] big = {1000000, 1000000}, int64[1] one = {1}, float[1,3] row = {1.,2.,3.}, float zero = {0.0}, "
BIG += "float last = {1e12}, float step = {1.0}, int64[4] pads = {0, 0, 2000000000, 2000000000}, float[1,1] u = {2.0}"


@pytest.mark.parametrize(
    ("operator", "body"),
    [
        ("Expand", "x = Expand(u, big)"),
        ("Tile", "x = Tile(row, big)"),
        ("Pad", "x = Pad(row, pads)"),
        ("ConstantOfShape", "x = ConstantOfShape(big)"),
        ("Range", "x = Range(zero, last, step)"),
        ("MatMul", "a = Expand(u, wide) b = Transpose(a) x = MatMul(b, a)"),
        ("Add", "a = Expand(u, wide) b = Transpose(a) x = Add(b, a)"),
        ("Gather", "a = Expand(u, wide) b = Gather(a, many)  x = Gather<axis=1>(b, many)"),
        ("Einsum", 'a = Expand(u, wide) x = Einsum<equation="ij,ik,il->jkl">(a, a, a)'),
        ("Einsum", 'a = Expand(u, wide) x = Einsum<equation="...a,...b,...c->...">(a, a, a)'),
    ],
)
def test_a_result_beyond_the_bound_is_refused_by_its_operator_and_nothing_is_computed(operator: str, body: str) -> None:
    many = ", ".join(["0"] * 60)
    weights = f"{BIG}, int64[2] wide = {{1, 100000}}, int64[60] many = {{{many}}}"
    if operator == "Gather":
        weights = weights.replace("int64[60] many", "int64[6000] many").replace(many, ", ".join(["0"] * 6000))
    tracemalloc.start()
    try:
        assert f"the policy's operator {operator} " in told(f"{body} action = Identity(u)", weights)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()


def test_many_results_that_are_each_within_the_bound_are_refused_together() -> None:
    body = "a0 = Expand(u, size) " + " ".join(f"a{n + 1} = Neg(a{n})" for n in range(5)) + " action = Identity(u)"
    sized = f"float[1,1] u = {{2.0}}, int64[1] size = {{{MAX_RESULT // 2}}}"
    assert "more than 2097152 numbers" in told(body, sized)
    judged(body.replace("a3 = Neg(a2) a4 = Neg(a3) a5 = Neg(a4)", ""), sized)


def test_a_long_chain_of_products_is_refused_for_its_work_though_every_result_is_small() -> None:
    body = "a0 = Expand(u, size) " + " ".join(f"a{n + 1} = MatMul(a{n}, a{n})" for n in range(70))
    sized = "float[1,1] u = {2.0}, int64[2] size = {100, 100}"
    assert f"more than {MAX_WORK} operations" in told(f"{body} action = Identity(u)", sized)


@pytest.mark.parametrize(
    "body",
    [
        "action = Add(u, nobody)",
        "a = Reshape(obs, two) action = Identity(u)",
        "a = Concat<axis=0>(obs, u) action = Identity(u)",
        "a = MatMul(obs, u) action = Identity(u)",
        "a = Transpose<perm=[0]>(obs) action = Identity(u)",
        "a = Gather<axis=7>(obs, two) action = Identity(u)",
        'a = Einsum<equation="ij,jk->ik">(obs) action = Identity(u)',
        "a = Einsum(obs) action = Identity(u)",
        "a = ConstantOfShape(minus) action = Identity(u)",
        "a = Squeeze(obs, one) action = Identity(u)",
        "a = Range(u, u, u0) action = Identity(u)",
    ],
)
def test_a_graph_whose_parts_do_not_fit_is_refused(body: str) -> None:
    told(
        body,
        "float u0 = {0.0}, float[1,1] u = {2.0}, int64[2] two = {2, 2}, int64[2] minus = {-4, -4}, int64[1] one = {1}",
    )


def test_a_constant_node_tells_a_size_like_an_initializer() -> None:
    body = "size = Constant<value_ints=[1000000, 1000000]>() a = Expand(u, size) action = Identity(u)"
    assert "operator Expand makes 1e+12 numbers" in told(body)
    judged("size = Constant<value_int=3>() n = Constant<value_floats=[1.0, 2.0]>() action = Identity(u)")
