"""A policy file is hostile input: it is taken only if it is exactly what the bench needs, and refused in one line."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.policy.contract import (
    APPLIED_CURRENT,
    CONTRACT_KEY,
    MAX_ESTIMATES,
    MAX_STATE,
    MAX_VECTORS,
    MIN_VECTORS,
    Contract,
    Vector,
)
from emb_runtime.policy.inference import open_session
from emb_runtime.policy.onnx_file import MAX_PARTS, read_graph
from emb_runtime.policy.operators import FIXED
from emb_runtime.policy.policy import MAX_FILE_BYTES, load_policy, shipped_actor_path
from tests.actors import alone, constant_actor, contract_for
from tests.runtime.operating import refusal

BENCH = load_bench()
GOOD = contract_for(
    BENCH, 2.0, {"estimates": (Quantity("k_1", "N m/rad"), Quantity("c2", "1")), "initial_state": (0.5, -1.0)}
)
PLAIN = contract_for(BENCH, 2.0, {})
BAD_NAMES = ("", "2x", "a b", "x/y", "näme", "k_1", "K1", "k1", "step", "publish_time", "k_2_deviation", "a" * 33)
"""No names of estimates, or such as GOOD's table in the log has already."""

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=1e-300, max_value=1e300)
words = st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=20)


def refused(file: bytes | Path) -> str:
    """Why a policy file is refused."""
    return refusal(lambda: load_policy(file, BENCH))


def edited(change: Callable[[dict[str, Any]], None]) -> str:
    record = json.loads(GOOD.to_json())
    change(record)
    return json.dumps(record)


def named(name: str) -> dict[str, str]:
    """An estimate as JSON."""
    return {"name": name, "unit": "1"}


def with_estimate(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda record: record["estimates"].append(named(name))


def with_provenance(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda record: record["provenance"].update({name: 1})


def model_of(text: str, contract: Contract = PLAIN) -> bytes:
    """An ONNX file from ONNX's own text form, with a contract."""
    model = onnx.parser.parse_model('<ir_version: 10, opset_import: ["" : 20]>\n' + text)
    helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    return bytes(model.SerializeToString())


# The contract ---------------------------------------------------------------------------------------------------------


@given(
    limit=positive,
    sample_time=positive,
    horizon=st.integers(1, 1_000_000),
    bounds=st.lists(st.tuples(positive, positive).map(sorted), min_size=4, max_size=4),
    numbers=st.lists(st.tuples(finite, finite, finite), min_size=MIN_VECTORS, max_size=MIN_VECTORS),
    share=st.floats(-1.0, 1.0),
    state=st.lists(finite, max_size=9),
    units=st.lists(words, max_size=MAX_ESTIMATES),
    provenance=st.dictionaries(words, st.one_of(words, st.integers(-(2**60), 2**60), finite), max_size=5),
)
@settings(max_examples=50)
def test_a_contract_survives_json_with_full_precision(
    limit: float,
    sample_time: float,
    horizon: int,
    bounds: list[list[float]],
    numbers: list[tuple[float, float, float]],
    share: float,
    state: list[float],
    units: list[str],
    provenance: dict[str, str | int | float],
) -> None:
    told = tuple(limit + n for n in range(2 * len(units)))
    contract = dataclasses.replace(
        GOOD,
        action_limit=limit,
        sample_time=sample_time,
        horizon=horizon,
        ranges={name: (low, high) for name, (low, high) in zip(PARAMETER_NAMES, bounds, strict=True)},
        sequences=(
            (*(Vector(n, share * limit) for n in numbers), Vector((0.0, 0.0, 0.0), 0.0, tuple(state), told)),
            (Vector((0.0, 0.0, 0.0), 0.0, tuple(state), told),),
        ),
        initial_state=tuple(state),
        estimates=tuple(Quantity(f"p{n}x", unit) for n, unit in enumerate(units)),
        provenance=provenance,
    )
    assert Contract.from_json(contract.to_json()) == contract


def test_a_contract_without_a_key_or_with_one_too_many_is_refused_by_its_name() -> None:
    for key in json.loads(GOOD.to_json()):
        assert key in refusal(partial(Contract.from_json, edited(methodcaller("pop", key))))
    places: list[tuple[str | int, ...]]
    places = [(), ("action",), ("ranges",), ("observation", 0), ("sequences", 3, 0), ("estimates", 1)]
    for place in places:
        record = inner = json.loads(GOOD.to_json())
        for step in place:
            inner = inner[step]
        inner["surprise"] = 1
        assert "surprise" in refusal(partial(Contract.from_json, json.dumps(record)))


def every_place(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(p for key, child in list(entries)[:9] for p in every_place(child, (*path, key)))]


PLACES = [p for p in every_place(json.loads(GOOD.to_json())) if p and p[0] != "provenance"]
JUNK: st.SearchStrategy[object] = st.sampled_from(
    [None, True, "", "x\ny", "\u202e", -1, 0, 0.5, 10**400, [], [[]], {}, {"a": {}}, "a" * 10_000]
)


@given(place=st.sampled_from(PLACES), junk=JUNK)
@settings(max_examples=150)
def test_junk_anywhere_is_refused_or_harmless_but_never_another_error(place: tuple[Any, ...], junk: Any) -> None:
    def spoil(record: Any) -> None:
        for step in place[:-1]:
            record = record[step]
        record[place[-1]] = junk

    text = edited(spoil)
    try:
        contract = Contract.from_json(text)
    except PolicyRefusedError:
        refusal(lambda: Contract.from_json(text))
        return
    assert contract.action_limit > 0.0
    assert all(math.isfinite(v) for vector in contract.vectors for v in (*vector.observation, vector.action))


NO_CONTRACTS = (
    "",
    "{",
    "[]",
    "null",
    "[" * 100_000,
    '{"schema": NaN}',
    '{"schema": 1, "schema": 1}',
    '{"schema": ' + "9" * 10_000 + "}",
    edited(lambda r: r.update(schema=4)),
    edited(lambda r: r.update(schema=0)),
    edited(lambda r: r.update(schema=1)),
    edited(lambda r: r.update(schema=2)),  # which knows no state in a vector
    edited(lambda r: r.update(sample_time="0.001")),
    edited(lambda r: r.update(horizon=True)),
    edited(lambda r: r.update(horizon=500.0)),
    edited(lambda r: r["ranges"].update(f_v=[2e-5, 1e-5])),
    edited(lambda r: r["sequences"][0][0].update(action=6.001)),
    edited(lambda r: r["sequences"][0][0]["observation"].append(1.0)),
    edited(lambda r: r.update(sequences=r["sequences"][: MIN_VECTORS - 1])),
    edited(lambda r: r.update(sequences=[*r["sequences"], []])),
    edited(lambda r: r.update(sequences=[[r["sequences"][0][0]] * (MAX_VECTORS + 1)])),
    edited(lambda r: r.update(sequences=[[r["sequences"][0][0]] * MAX_VECTORS, r["sequences"][0]])),
    edited(lambda r: r.update(initial_state=[0.0] * (MAX_STATE + 1))),
    edited(lambda r: r.update(initial_state=["0"])),
    edited(lambda r: r.update(initial_state=0.0)),
    edited(lambda r: r.update(estimates=[named(f"p{n}x") for n in range(MAX_ESTIMATES + 1)])),
    *(edited(with_estimate(name)) for name in BAD_NAMES),
    *(edited(with_provenance(name)) for name in ("\x1b[31m", "x\ny", "\u202e", "é", "x" * 121)),
    GOOD.to_json().replace("0.001", "1e999", 1),
    GOOD.to_json().replace("0.001", "Infinity", 1),
    GOOD.to_json() + " " * 1_000_001,
)


def test_what_is_no_contract_is_refused() -> None:
    for text in NO_CONTRACTS:
        refusal(partial(Contract.from_json, text))


OTHER_BENCHES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"sample_time": 0.002}, "sample time"),
    ({"sample_time": math.nextafter(0.001, 1.0)}, "sample time"),
    ({"horizon": 300}, "horizon"),
    ({"observation": (GOOD.observation[1], GOOD.observation[0], GOOD.observation[2])}, "observation"),
    ({"observation": (Quantity("angle", "deg"), *GOOD.observation[1:])}, "observation"),
    ({"action": Quantity("current", "mA")}, "action"),
    ({"action": Quantity("torque", "A")}, "action"),
    ({"action_limit": 5.0}, "action limit"),
    ({"bench_hash": "0" * 64}, "bench hash"),
    ({"ranges": {**GOOD.ranges, "k_1": (1.0, 1000.0)}}, "range of k_1"),
    ({"observation": (*GOOD.observation, GOOD.observation[0])}, "observation"),
    ({"observation": (*GOOD.observation, Quantity("applied_current", "mA"))}, "observation"),
    ({"observation": (APPLIED_CURRENT, *GOOD.observation)}, "observation"),
)


def test_a_policy_for_another_bench_is_refused_with_the_difference() -> None:
    for changes, said in OTHER_BENCHES:
        assert said in refused(constant_actor(BENCH, 2.0, **changes)), changes
    other: Bench = dataclasses.replace(BENCH, limits=dataclasses.replace(BENCH.limits, velocity=400.0))
    assert "bench hash" in refusal(lambda: load_policy(shipped_actor_path(), other))


def test_a_contract_cannot_widen_what_its_test_vectors_may_be_off_by() -> None:
    other = alone(Vector(v.observation, -v.action) for v in PLAIN.vectors)
    data = constant_actor(BENCH, 2.0, action_limit=1e9, sequences=other)
    assert "test vector 0" in refused(data)


def test_a_bench_with_a_narrower_limit_takes_a_policy_with_a_wider_one() -> None:
    narrow = dataclasses.replace(BENCH, limits=dataclasses.replace(BENCH.limits, current=3.0))
    dataclasses.replace(PLAIN, bench_hash=narrow.contract_hash, action_limit=6.0).require_bench(narrow)


# The file -------------------------------------------------------------------------------------------------------------


def test_a_sane_actor_is_loaded_and_says_what_its_graph_says(tmp_path: Path) -> None:
    path = tmp_path / "actor.onnx"
    path.write_bytes(constant_actor(BENCH, 2.5, later=-1.5))
    policy = load_policy(path, BENCH)
    assert [policy.act(0.1, -3.0, k, 0.0) for k in (0, 99, 100, 499)] == [2.5, 2.5, -1.5, -1.5]
    assert policy.data == path.read_bytes()
    assert policy.sha256 == hashlib.sha256(policy.data).hexdigest()


def test_the_order_of_the_observation_reaches_the_graph() -> None:
    weights = "float[3,1] w = {0.5, 0.001, -0.25}"
    text = f"agent (float[1,3] obs) => (float[1,1] action) <{weights}> {{ action = MatMul(obs, w) }}"
    vectors = alone(Vector((0.1 * n, float(n), 0.0), 0.05 * n + 0.001 * n) for n in range(MIN_VECTORS))
    policy = load_policy(model_of(text, dataclasses.replace(PLAIN, sequences=vectors)), BENCH)
    assert policy.act(2.0, 100.0, 4, 0.0) == pytest.approx(0.1, abs=1e-6)


def test_what_the_graph_gives_is_passed_on_as_it_is_and_nan_measurements_raise_nothing() -> None:
    for output in (math.nan, 1e9, math.inf):
        policy = load_policy(constant_actor(BENCH, 2.0, later=output), BENCH)
        np.testing.assert_equal(policy.act(0.0, 0.0, 100, 0.0), float(np.float32(output)))
        assert policy.act(math.nan, math.inf, 3, 0.0) == 2.0


def test_an_actor_that_does_not_reproduce_its_vectors_is_refused() -> None:
    for output in (math.nan, 2.001, 1e9):
        assert "test vector 0" in refused(constant_actor(BENCH, output, sequences=PLAIN.sequences))


def test_vectors_may_differ_by_a_hundred_thousandth_of_the_limit_and_no_more() -> None:
    for difference, taken in ((0.9e-5 * 6.0, True), (1.2e-5 * 6.0, False)):
        vectors = alone(v._replace(action=2.0 + difference) for v in PLAIN.vectors)
        data = constant_actor(BENCH, 2.0, sequences=vectors)
        if taken:
            load_policy(data, BENCH)
        else:
            refused(data)


def test_a_file_cut_anywhere_is_refused() -> None:
    data = constant_actor(BENCH, 2.0)
    for length in (*range(0, len(data), max(1, len(data) // 60)), len(data) - 1):
        refused(data[:length])


@given(data=st.binary(max_size=200))
def test_random_bytes_are_refused(data: bytes) -> None:
    refused(data)


@given(position=st.floats(0.0, 1.0, exclude_max=True), value=st.integers(0, 255))
@settings(max_examples=100, deadline=None)
def test_a_damaged_byte_is_refused_or_harmless(position: float, value: int) -> None:
    data = bytearray(constant_actor(BENCH, 2.0))
    data[int(position * len(data))] = value
    try:
        policy = load_policy(bytes(data), BENCH)
    except PolicyRefusedError:
        refused(bytes(data))
    else:
        assert abs(policy.act(1.0, -3.0, 1, 0.0) - 2.0) < 1e-4


def test_a_file_beyond_the_bound_is_refused_without_being_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "big.onnx"
    with path.open("wb") as file:
        file.truncate(MAX_FILE_BYTES * 100)  # sparse
    assert "larger" in refused(path)


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot read"):
        load_policy(tmp_path / "none.onnx", BENCH)
    with pytest.raises(UsageError, match="cannot read"):
        load_policy(tmp_path, BENCH)


def test_a_file_without_a_contract_or_with_two_is_refused() -> None:
    model = onnx.load_from_string(constant_actor(BENCH, 2.0))
    model.metadata_props.add(key=CONTRACT_KEY, value=GOOD.to_json())
    assert "got 2" in refused(model.SerializeToString())
    del model.metadata_props[:]
    assert CONTRACT_KEY in refused(model.SerializeToString())


def elsewhere(folder: Path) -> TensorProto:
    """A tensor that keeps its data in another file, which is there."""
    (folder / "weights.data").write_bytes(b"\0" * 4)
    tensor = onnx.numpy_helper.from_array(np.zeros((1, 1), np.float32), "outside")
    onnx.external_data_helper.set_external_data(tensor, "weights.data")
    tensor.ClearField("raw_data")
    return tensor


def test_what_no_actor_has_is_refused_before_onnx_runtime_sees_it(tmp_path: Path) -> None:
    tensor, sparse = elsewhere(tmp_path), onnx.SparseTensorProto()
    plain = onnx.numpy_helper.from_array(np.zeros(1, np.float32), "plain")
    body = helper.make_graph([], "body", [], [])
    identity = helper.make_node("Identity", ["x"], ["y"])
    function = helper.make_function("ours", "F", ["x"], ["y"], [identity], [helper.make_opsetid("", 20)])
    rows: list[tuple[str, Callable[[onnx.ModelProto], object]]] = [
        ("another file", lambda m: m.graph.initializer.append(tensor)),
        ("another file", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], value=tensor))),
        ("control flow", lambda m: m.graph.node.append(helper.make_node("Loop", ["", ""], [], body=body))),
        ("control flow", lambda m: m.graph.node.append(helper.make_node("Add", [], ["c"], many=[body]))),
        ("functions of its own", lambda m: m.functions.append(function)),
        ("sparse tensors", lambda m: m.graph.sparse_initializer.append(sparse)),
        ("sparse tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], sparse_value=sparse))),
        ("sparse tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], many=[sparse]))),
        ("a list of tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], many=[plain]))),
    ]
    for said, change in rows:
        model = onnx.load_from_string(constant_actor(BENCH, 2.0))
        change(model)
        assert said in refused(model.SerializeToString())


PORTS = (
    ("float[1,3] x", "float[1,1] action", "float[3,1] w = {0.,0.,0.}", "input"),
    ("float[1,4] obs", "float[1,1] action", "float[4,1] w = {0.,0.,0.,0.}", "input"),
    ("float[N,3] obs", "float[N,1] action", "float[3,1] w = {0.,0.,0.}", "input"),
    ("double[1,3] obs", "double[1,1] action", "double[3,1] w = {0.,0.,0.}", "input"),
    ("float[1,3] obs, float[1] h", "float[1,1] action", "float[3,1] w = {0.,0.,0.}", "input"),
    ("float[1,3] obs", "float[1,1] y", "float[3,1] w = {0.,0.,0.}", "output"),
    ("float[1,3] obs", "float[1,2] action", "float[3,2] w = {0.,0.,0.,0.,0.,0.}", "output"),
    ("float[1,3] obs", "float[1,1] action, float[1,1] h", "float[3,1] w = {0.,0.,0.}", "output"),
)


def test_other_inputs_and_outputs_than_the_contract_s_are_refused() -> None:
    for inputs, outputs, weights, said in PORTS:
        seen = inputs.split(",")[1].split()[1]
        body = " ".join(f"{name.split()[1]} = MatMul({seen}, w)" for name in outputs.split(", "))
        data = model_of(f"agent ({inputs}) => ({outputs}) <{weights}> {{ {body} }}")
        port = {"input": "obs", "output": "action"}[said]
        assert f"{said}s: the contract needs '{port}'" in refused(data), (inputs, outputs)


def test_an_operator_of_another_domain_is_refused() -> None:
    model = onnx.load_from_string(constant_actor(BENCH, 2.0))
    model.opset_import.add(domain="else where", version=1)
    model.graph.node[0].domain = "else where"
    assert "has the operator 'else?where.Slice', which is none of" in refused(model.SerializeToString())


def test_the_standard_domain_may_be_called_by_its_other_name() -> None:
    model = onnx.load_from_string(constant_actor(BENCH, 2.0))
    for node in model.graph.node:
        node.domain = "ai.onnx"
    assert load_policy(model.SerializeToString(), BENCH).act(0.0, 0.0, 0, 0.0) == 2.0


def test_a_file_in_onnx_runtime_s_own_format_is_refused_for_its_operators_are_not_those_that_were_judged(
    tmp_path: Path,
) -> None:
    options, path = ort.SessionOptions(), tmp_path / "actor.ort"
    options.optimized_model_filepath = str(path)
    options.add_session_config_entry("session.save_model_format", "ORT")
    ort.InferenceSession(constant_actor(BENCH, 2.0), options, providers=["CPUExecutionProvider"])
    data = path.read_bytes()
    assert data[4:8] == b"ORTM"
    assert ort.InferenceSession(data, providers=["CPUExecutionProvider"]).get_inputs()
    assert "ONNX Runtime refuses the policy file" in refusal(lambda: open_session(data))


def test_a_file_of_more_parts_than_an_actor_can_have_is_refused_wherever_they_are() -> None:
    for field in ("node", "attribute", "initializer", "metadata_props"):
        model = onnx.ModelProto(graph=onnx.GraphProto(name="agent"))
        where = model if field == "metadata_props" else model.graph
        parts = model.graph.node.add().attribute if field == "attribute" else getattr(where, field)
        for _ in range(MAX_PARTS):
            parts.add()
        read_graph(model.SerializeToString())
        parts.add()
        assert f"has {MAX_PARTS + 1} nodes, attributes or tensors" in refused(model.SerializeToString()), field


N3 = "n = Cast<to=7>(obs) n3 = Reshape(n, row) "
GROWING = {
    "Expand": "step = Slice(obs, two, three, axis) n = Cast<to=7>(step) n1 = Reshape(n, row) big = Expand(obs, n1)",
    "Slice": N3 + "n1 = Slice(n3, two, three) big = Slice(obs, axis, n1, axis)",
    "Reshape": N3 + "big = Reshape(obs, n3)",
    "Split": N3 + "big, b, c = Split<axis=1>(obs, n3)",
    "ReduceSum": N3 + "n1 = Slice(n3, two, three) big = ReduceSum(obs, n1)",
}
"""What grows, or shrinks, with what is measured."""
UNKNOWN = {
    "NonZero": "big = NonZero(obs)",
    "Compress": "b = Cast<to=9>(obs) f = Reshape(b, row) big = Compress<axis=1>(obs, f)",
    "RandomNormalLike": "big = RandomNormalLike(obs)",
    "SequenceConstruct": "big = SequenceConstruct(obs)",
    "ConstantOfShape": N3 + "big = ConstantOfShape(n3)",
    "Tile": "big = Tile(obs, two)",
}
"""Operators that are not in the table: work or memory depends on the data, or no actor has them."""
STEADY = "int64[1] two = {2}, int64[1] three = {3}, int64[1] axis = {1}, int64[1] row = {-1}, "
STEADY += "float[3,1] w = {0.0, 0.0, 0.0}"


def test_an_operator_whose_work_is_not_known_to_be_the_same_for_every_sample_is_refused() -> None:
    for table, said in ((GROWING, "operator {} takes a size, a place"), (UNKNOWN, "has the operator '{}'")):
        for operator, body in table.items():
            text = f"agent (float[1,3] obs) => (float[1,1] action) <{STEADY}> {{ {body} action = MatMul(obs, w) }}"
            assert said.format(operator) in refused(model_of(text))


def test_sizes_that_stand_in_the_file_are_taken_whether_as_initializers_or_as_constants() -> None:
    weights = "float[1,1] u = {2.0}, int64[2] shape = {1, 1}, float[3,1] w = {0.0, 0.0, 0.0}"
    text = f"agent (float[1,3] obs) => (float[1,1] action) <{weights}> {{ zero = MatMul(obs, w) "
    text += "same = Constant<value = int64[2] {1, 1}>() a = Expand(zero, shape) b = Reshape(a, same) "
    text += "c = ReduceSum<keepdims=1>(b, ) action = Add(c, u) }"
    assert load_policy(model_of(text), BENCH).act(1.0, 2.0, 3.0, 0.0) == 2.0


def test_a_size_that_is_computed_under_the_name_of_a_constant_is_refused() -> None:
    body = f"{GROWING['Expand']} action = MatMul(obs, w)"
    model = onnx.load_from_string(model_of(f"agent (float[1,3] obs) => (float[1,1] action) <{STEADY}> {{ {body} }}"))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([1]), "n1"))
    assert "Expand takes a size" in refused(model.SerializeToString())


def test_how_many_steps_a_recurrent_operator_takes_stands_in_the_file_and_what_it_remembers_need_not() -> None:
    for operator, gates in (("GRU", 3), ("LSTM", 4)):
        weights = f"float[1,{gates},1] w = {{{', '.join(['0.0'] * gates)}}}, float[1,1] u = {{2.0}}, "
        weights += "float nought = {0.0}, int64[3] column = {3, 1, 1}, int64[2] unit = {1, 1}, int64[1] row = {-1}, "
        weights += "int32[1] three = {3}, int64[1] start = {0}, int64[1] end = {1}"

        def told(steps: str, operator: str = operator, weights: str = weights) -> bytes:
            body = "x = Reshape(obs, column) first = Slice(x, start, end) n = Cast<to=6>(first) seen = Reshape(n, row) "
            body += f"y, last = {operator}<hidden_size=1>(x, w, w, , {steps}, first) "
            body += "z = Mul(last, nought) flat = Reshape(z, unit) action = Add(flat, u)"
            return model_of(f"agent (float[1,3] obs) => (float[1,1] action) <{weights}> {{ {body} }}")

        for steps in ("three", ""):
            assert load_policy(told(steps), BENCH).act(1.0, 2.0, 3.0, 0.0) == 2.0
        assert f"operator {operator} takes a size, a place or a number of steps" in refused(told("seen"))


INTEGERS = {f"tensor({sign}int{bits})" for sign in ("", "u") for bits in (2, 4, 8, 16, 32, 64)}
WHICH = {"indices"}  # Which numbers are taken; how many is in the shape of this input


def test_every_operator_that_is_let_through_is_one_of_onnx_without_a_graph_and_its_sizes_are_fixed() -> None:
    """By ONNX's own schema: an input that can hold nothing but integers is a size, an axis, a place or a count."""
    every = onnx.defs.get_all_schemas_with_history()
    for operator in FIXED:
        versions = [s for s in every if (s.domain, s.name) == ("", operator)]
        assert versions, operator
        for schema in versions:
            kinds = {attribute.type for attribute in schema.attributes.values()}
            assert not kinds & {onnx.defs.OpSchema.AttrType.GRAPH, onnx.defs.OpSchema.AttrType.GRAPHS}
            fixed = {port.name for port in schema.inputs[FIXED[operator]]}
            decides = {p.name for p in schema.inputs if set(p.types) <= INTEGERS and p.name not in WHICH}
            assert decides <= fixed, operator


def test_an_error_inside_onnx_runtime_is_a_refusal_of_one_line() -> None:
    text = """agent (float[1,3] obs) => (float[1,1] action) <
        int64[1] two = {2}, int64[1] three = {3}, int64[1] axis = {1},
        float[10,1] table = {2.,2.,2.,2.,2.,2.,2.,2.,2.,2.}, int64[1] row = {-1}> {
        step = Slice(obs, two, three, axis)
        index = Cast<to=7>(step)
        flat = Reshape(index, row)
        action = Gather<axis=0>(table, flat) }"""
    vectors = alone(Vector((0.0, 0.0, 3.0), 2.0) for _ in range(MIN_VECTORS))
    policy = load_policy(model_of(text, dataclasses.replace(PLAIN, sequences=vectors)), BENCH)
    assert "could not evaluate" in refusal(lambda: policy.act(0.0, 0.0, 4000, 0.0))


def test_loading_and_asking_a_policy_starts_no_thread() -> None:
    before = set(Path("/proc/self/task").iterdir())
    policy = load_policy(constant_actor(BENCH, 2.0), BENCH)
    for k in range(100):
        policy.act(0.0, 0.0, k, 0.0)
    assert set(Path("/proc/self/task").iterdir()) <= before


@pytest.mark.parametrize("quick", [False, True])
def test_the_shipped_actors_fit_the_shipped_bench_and_estimate_all_four_parameters(quick: bool) -> None:
    policy = load_policy(shipped_actor_path(quick), BENCH)
    assert tuple(quantity.name for quantity in policy.contract.estimates) == PARAMETER_NAMES
    assert policy.contract.provenance["plant"] == DEFAULT_PLANT
    assert len(policy.data) < 300_000


def test_onnx_runtime_leaves_nothing_behind_and_reports_to_nobody(tmp_path: Path) -> None:
    """Its wheels keep an identifier of the machine in the user's cache for reports to their maker."""
    code = (
        "from emb_runtime.policy.policy import load_policy, shipped_actor_path\n"
        "from emb_runtime.config.bench import load_bench\n"
        "load_policy(shipped_actor_path(), load_bench()).act(0.0, 0.0, 0, 0.0)\n"
    )
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "PATH": os.environ["PATH"]}
    done = subprocess.run([sys.executable, "-c", code], env=home, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    assert list(tmp_path.iterdir()) == []
