"""A policy file is of unknown origin: it is taken only if it is what its contract says and fits, else refused."""

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
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Sensors, load_bench
from emb_runtime.errors import UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.kalman import believed
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.contract import (
    CONTRACT_KEY,
    INPUTS,
    MAX_VECTORS,
    MIN_VECTORS,
    UNITS,
    PolicyLimits,
    Vector,
    read_contract,
)
from emb_runtime.policy.onnx_file import FIXED, MAX_PARTS, read_graph
from emb_runtime.policy.policy import MAX_FILE_BYTES, load_policy, open_session, shipped_actor_path
from tests.actors import constant_actor, contract_for, parsed, with_contract
from tests.runtime.operating import refusal

BENCH = load_bench()
GOOD = contract_for(BENCH, 2.0)
ESTIMATOR = Estimator(BENCH)


def refused(file: bytes | Path, bench: Bench = BENCH) -> str:
    """Why a policy file is refused."""
    return refusal(lambda: load_policy(file, bench))


def edited(change: Callable[[dict[str, Any]], None]) -> str:
    record = json.loads(GOOD.to_json())
    change(record)
    return json.dumps(record)


def model_of(text: str, **changes: Any) -> bytes:
    """An ONNX file from ONNX's own text form, with a contract."""
    return with_contract(parsed(text), contract_for(BENCH, 2.0, **changes))


def asked(policy: Any, angle: float, velocity: float, step: float) -> float:
    return float(policy.act(angle, velocity, step, ESTIMATOR))


# The contract ---------------------------------------------------------------------------------------------------------


def test_a_contract_survives_json_with_full_precision() -> None:
    third = 1.0 / 3.0
    limits = PolicyLimits(third, (-1e-300, 1e300), 5e-324)
    vectors = tuple(Vector((math.nextafter(n, 9.0), -0.1, 1e-17), (-third,)) for n in range(MIN_VECTORS))
    provenance = {"seed": -(2**60), "loss": math.nextafter(0.1, 1.0), "by": "emb-train"}
    contract = msgspec.structs.replace(GOOD, limits=limits, vectors=vectors, provenance=provenance)
    assert read_contract(contract.to_json()) == contract


def test_what_is_no_contract_is_refused() -> None:
    for text in (
        *("", "{", "[]", "null", "[" * 100_000, '{"schema": NaN}', '{"schema": 4, "schema": 4}'),
        '{"schema": ' + "9" * 10_000 + "}",
        *(edited(lambda r, n=n: r.update(schema=n)) for n in (0, 1, 2, 3, 5)),  # type: ignore[misc]
        edited(lambda r: r.update(kind="state")),
        edited(lambda r: r.update(inputs=["angle", "velocity", "step"])),
        edited(lambda r: r.update(inputs=list(PARAMETER_NAMES))),
        edited(lambda r: r.update(sample_time=0.0)),
        edited(lambda r: r.update(gain=1.5)),
        edited(lambda r: r["limits"].update(angle=[1.0, -1.0])),
        edited(lambda r: r["ranges"].update(f_v=[2e-5, 1e-5])),
        edited(lambda r: r["ranges"].update(J=[1e-6, 1e-5])),
        edited(lambda r: r["vectors"][0]["inputs"].append(1.0)),
        edited(lambda r: r["vectors"][0]["outputs"].append(1.0)),
        edited(lambda r: r.update(vectors=[{**v, "outputs": [0.0] * 3} for v in r["vectors"]])),
        edited(lambda r: r.update(vectors=r["vectors"][: MIN_VECTORS - 1])),
        edited(lambda r: r.update(vectors=[r["vectors"][0]] * (MAX_VECTORS + 1))),
        *(edited(lambda r, n=n: r["provenance"].update({n: 1})) for n in ("\x1b[31m", "x\ny", "x\n", "x" * 121)),  # type: ignore[misc]
        GOOD.to_json().replace("0.001", "1e999", 1),
        GOOD.to_json().replace("0.001", "Infinity", 1),
        GOOD.to_json() + " " * 1_000_001,
    ):
        refusal(partial(read_contract, text))
    for kind, outputs, expected in (
        ("current", [0.0] * 3, "one current, got 3 and 3"),
        ("speed", [0.0] * 2, "one speed, got 3 and 2"),
    ):
        assert f"expected 3 inputs and {expected}" in refusal(partial(read_contract, vectors_of(kind, outputs)))


def vectors_of(kind: str, outputs: list[float]) -> str:
    """A contract for 3 A and 300 rad/s, all of whose test vectors have these outputs."""
    inputs = list(INPUTS[0])
    vectors = [{"inputs": [1.0] * len(inputs), "outputs": outputs}] * MIN_VECTORS
    record = json.loads(GOOD.to_json()) | {"kind": kind, "inputs": inputs, "vectors": vectors}
    record["limits"] |= {"current": 3.0, "velocity": 300.0}
    return json.dumps(record)


def test_the_outputs_of_test_vectors_are_within_what_a_policy_may_ask_for() -> None:
    for kind, outputs in (
        ("current", [3.0]),
        ("current", [-3.0 * (1.0 + 0.5e-6)]),
        ("speed", [300.0 * (1.0 + 0.5e-6)]),
        ("speed", [-300.0]),
    ):
        assert read_contract(vectors_of(kind, outputs)).vectors[0].outputs == tuple(outputs)
    for kind, outputs in (
        ("current", [3.0 * (1.0 + 2e-6)]),
        ("current", [-1e9]),
        ("speed", [-300.0 * (1.0 + 2e-6)]),
        ("speed", [500.0]),
    ):
        assert "vectors[0]" in refusal(partial(read_contract, vectors_of(kind, outputs)))


# The bench ------------------------------------------------------------------------------------------------------------


def on(**changes: Any) -> Bench:
    """The shipped bench with other limits or another sample time."""
    timing = {key: changes.pop(key) for key in ("sample_time", "horizon") if key in changes}
    return dataclasses.replace(
        BENCH, limits=dataclasses.replace(BENCH.limits, **changes), timing=dataclasses.replace(BENCH.timing, **timing)
    )


def test_a_bench_that_goes_beyond_the_policys_limits_is_refused_by_its_key_and_a_narrower_one_is_not() -> None:
    small = PolicyLimits(3.0, (-5.0, 50.0), 300.0)
    for data in (constant_actor(BENCH, 2.0, limits=small), constant_actor(BENCH, 300.0, limits=small, kind="speed")):
        load_policy(data, on(current=3.0, angle=(-5.0, 50.0), velocity=300.0))
        load_policy(data, on(current=1.0, angle=(-1.0, 20.0), velocity=100.0))
        for key, wider in (
            ("limits.current", on(current=3.1, angle=(-5.0, 50.0), velocity=300.0)),
            ("limits.angle", on(current=3.0, angle=(-5.1, 50.0), velocity=300.0)),
            ("limits.angle", on(current=3.0, angle=(-5.0, 50.1), velocity=300.0)),
            ("limits.velocity", on(current=3.0, angle=(-5.0, 50.0), velocity=301.0)),
        ):
            assert key in refused(data, wider)
    for other in (0.002, math.nextafter(0.001, 1.0)):
        assert "timing.sample_time" in refused(constant_actor(BENCH, 2.0), on(sample_time=other))


def test_wider_ranges_and_another_horizon_are_a_warning_and_all_else_of_a_bench_is_no_matter() -> None:
    ranges = {**GOOD.ranges, "k_1": (20.0, 25.0)}
    wide = load_policy(constant_actor(BENCH, 2.0, ranges=ranges), BENCH)
    assert [line.partition(" ")[0] for line in wide.warnings] == ["k_1"]
    assert load_policy(constant_actor(BENCH, 2.0, ranges={}), BENCH).warnings == []
    assert "300" in load_policy(constant_actor(BENCH, 2.0), on(horizon=300)).warnings[0]
    other = dataclasses.replace(
        BENCH,
        name="another",
        brake=BENCH.brake._replace(f_v=2.5e-5),
        noise=dataclasses.replace(BENCH.noise, angle=1.3e-3, velocity=1.3),
        watch=dataclasses.replace(BENCH.watch, stop_missed=3),
        node=dataclasses.replace(BENCH.node, watchdog=0.005),
    )
    for quick in (False, True):
        assert load_policy(shipped_actor_path(quick), other).warnings == []


def test_a_policy_that_was_made_for_another_origin_of_the_velocity_is_a_warning() -> None:
    measured = dataclasses.replace(BENCH, sensors=Sensors())
    for bench, made_for, warned in (
        (measured, "sensor", []),
        (measured, "observer", ["velocity by sensor, made for one by observer"]),
        (BENCH, "sensor", ["velocity by observer, made for one by sensor"]),
        (BENCH, "observer", []),
    ):
        assert load_policy(constant_actor(BENCH, 2.0, velocity=made_for), bench).warnings == warned
    assert load_policy(shipped_actor_path(), measured).warnings == ["velocity by sensor, made for one by observer"]


# What it computes -----------------------------------------------------------------------------------------------------


def test_a_sane_policy_is_loaded_and_gives_what_its_graph_gives(tmp_path: Path) -> None:
    path = tmp_path / "actor.onnx"
    path.write_bytes(constant_actor(BENCH, 2.5, later=-1.5))
    policy = load_policy(path, BENCH)
    assert [asked(policy, 0.1, -3.0, k) for k in (0, 99, 100, 499)] == [2.5, 2.5, -1.5, -1.5]
    assert policy.data == path.read_bytes()
    assert policy.sha256 == hashlib.sha256(policy.data).hexdigest()


def test_angle_velocity_and_time_reach_the_graph_and_the_estimate_where_it_asks_for_it() -> None:
    def summing(inputs: tuple[str, ...], kind: str) -> tuple[bytes, Any]:
        width = len(inputs)
        weights = np.random.default_rng(1).uniform(0.5, 1.0, width).astype(np.float32)
        numbers = ", ".join(map(repr, weights.tolist()))
        text = f"agent (float[1,{width}] inputs) => (float[1,1] outputs) <float[{width},1] w = {{{numbers}}}>"
        vectors = tuple(Vector((n / 64,) * width, (float(n / 64 * weights.sum()),)) for n in range(MIN_VECTORS))
        return model_of(
            text + " { outputs = MatMul(inputs, w) }", inputs=inputs, vectors=vectors, kind=kind, gain=0.01
        ), weights

    estimator = Estimator(BENCH)
    estimator.add_sample(0.1, 20.0, 0, 0.0)
    model, state = estimator.model, estimator.state
    for inputs in INPUTS:
        for kind in UNITS:
            data, weights = summing(inputs, kind)
            seen = np.array([2.0, 100.0, 0.004, *estimator.parameters])[: len(inputs)]
            wanted = float(weights @ seen)
            if kind == "speed":
                wanted = current_for(model, state, believed(model, state), wanted, 0.01)
            found = load_policy(data, BENCH).act(2.0, 100.0, 4, estimator)
            assert abs(found) < 6.0 or kind == "current"  # the speed loop cuts off nothing
            assert found == pytest.approx(wanted, rel=1e-5)


def test_the_speed_loop_takes_an_estimate_within_its_range_only() -> None:
    policy, estimator = load_policy(constant_actor(BENCH, 250.0, kind="speed", gain=0.01), BENCH), Estimator(BENCH)
    found = []
    for k_m in (9.0, estimator.model.high[0], 1.0):
        estimator.state = estimator.state._replace(mean=(10.0, 50.0, k_m, 1.0, 1.0, 1.0))
        found.append(policy.act(10.0, 50.0, 0.0, estimator))
    assert found[0] == found[1] != found[2]


def test_a_speed_of_an_estimate_that_is_not_finite_asks_for_a_current_that_is_not() -> None:
    policy, estimator = load_policy(constant_actor(BENCH, 250.0, kind="speed"), BENCH), Estimator(BENCH)
    for mean in ((math.nan, 0.0, 1.0, 1.0, 1.0, 1.0), (0.0, math.nan, 1.0, 1.0, 1.0, 1.0)):
        estimator.state = estimator.state._replace(mean=mean)
        assert math.isnan(policy.act(0.0, 0.0, 0.0, estimator))


def test_what_the_graph_gives_is_passed_on_as_it_is_and_nan_measurements_raise_nothing() -> None:
    for output in (math.nan, 1e9, math.inf):
        policy = load_policy(constant_actor(BENCH, 2.0, later=output), BENCH)
        np.testing.assert_equal(asked(policy, 0.0, 0.0, 100), float(np.float32(output)))
        assert asked(policy, math.nan, math.inf, 3) == 2.0


def test_a_policy_that_does_not_reproduce_its_vectors_is_refused() -> None:
    for output in (math.nan, 2.001, 1e9):
        assert "test vector 0" in refused(constant_actor(BENCH, output, vectors=GOOD.vectors))
    for kind, difference, taken in (
        ("current", 0.9e-5 * 6.0, True),
        ("current", 1.2e-5 * 6.0, False),
        ("speed", 0.9e-5 * 500.0, True),
        ("speed", 1.2e-5 * 500.0, False),
    ):
        vectors = tuple(Vector(v.inputs, (2.0 + difference,)) for v in GOOD.vectors)
        data = constant_actor(BENCH, 2.0, vectors=vectors, kind=kind)
        if taken:
            load_policy(data, BENCH)
        else:
            refused(data)
    widest = PolicyLimits(1e9, (-10.0, 100.0), 1e9)  # a contract cannot widen what its vectors may be off by
    other = tuple(Vector(v.inputs, (-2.0,)) for v in GOOD.vectors)
    for kind in UNITS:
        assert "test vector 0" in refused(constant_actor(BENCH, 2.0, limits=widest, vectors=other, kind=kind))


# The file -------------------------------------------------------------------------------------------------------------


def test_a_file_cut_anywhere_or_of_random_bytes_is_refused() -> None:
    data = constant_actor(BENCH, 2.0)
    for length in (*range(0, len(data), max(1, len(data) // 60)), len(data) - 1):
        refused(data[:length])
    dice = np.random.default_rng(0)
    for _ in range(100):
        refused(dice.bytes(int(dice.integers(1, 200))))


def test_a_file_beyond_the_bound_is_refused_without_being_read_whole_and_a_missing_one_is_a_usage_error(
    tmp_path: Path,
) -> None:
    path = tmp_path / "big.onnx"
    with path.open("wb") as file:
        file.truncate(MAX_FILE_BYTES * 100)  # sparse
    assert "larger" in refused(path)
    for missing in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(UsageError, match="cannot read"):
            load_policy(missing, BENCH)


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


def test_what_no_policy_has_is_refused_before_onnx_runtime_sees_it(tmp_path: Path) -> None:
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
        ("the policy has functions", lambda m: m.functions.append(function)),
        ("sparse tensors", lambda m: m.graph.sparse_initializer.append(sparse)),
        ("sparse tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], sparse_value=sparse))),
        ("sparse tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], many=[sparse]))),
        ("a list of tensors", lambda m: m.graph.node.append(helper.make_node("Constant", [], ["c"], many=[plain]))),
    ]
    for reason, change in rows:
        model = onnx.load_from_string(constant_actor(BENCH, 2.0))
        change(model)
        assert reason in refused(model.SerializeToString())


def test_other_inputs_and_outputs_than_the_contracts_are_refused() -> None:
    for inputs, outputs, weights in (
        ("float[1,3] x", "float[1,1] outputs", "float[3,1] w = {0.,0.,0.}"),
        ("float[1,4] inputs", "float[1,1] outputs", "float[4,1] w = {0.,0.,0.,0.}"),
        ("float[N,3] inputs", "float[N,1] outputs", "float[3,1] w = {0.,0.,0.}"),
        ("double[1,3] inputs", "double[1,1] outputs", "double[3,1] w = {0.,0.,0.}"),
        ("float[1,3] inputs, float[1] h", "float[1,1] outputs", "float[3,1] w = {0.,0.,0.}"),
        ("float[1,3] inputs", "float[1,1] y", "float[3,1] w = {0.,0.,0.}"),
        ("float[1,3] inputs", "float[1,2] outputs", "float[3,2] w = {0.,0.,0.,0.,0.,0.}"),
        ("float[1,3] inputs", "float[1,1] outputs, float[1,1] h", "float[3,1] w = {0.,0.,0.}"),
    ):
        seen = inputs.split(",")[1].split()[1]
        body = " ".join(f"{name.split()[1]} = MatMul({seen}, w)" for name in outputs.split(", "))
        data = model_of(f"agent ({inputs}) => ({outputs}) <{weights}> {{ {body} }}")
        assert "inputs and outputs: the contract needs" in refused(data), (inputs, outputs)


def test_an_operator_of_another_domain_is_refused_and_the_standard_one_has_two_names() -> None:
    model = onnx.load_from_string(constant_actor(BENCH, 2.0))
    for node in model.graph.node:
        node.domain = "ai.onnx"
    assert asked(load_policy(model.SerializeToString(), BENCH), 0.0, 0.0, 0) == 2.0
    model.opset_import.add(domain="else where", version=1)
    model.graph.node[0].domain = "else where"
    assert "has the operator 'else?where.Slice', which is none of" in refused(model.SerializeToString())


def test_a_file_in_onnx_runtimes_own_format_is_refused_for_its_operators_are_not_those_that_were_judged(
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


def test_a_file_of_more_parts_than_a_policy_can_have_is_refused_wherever_they_are() -> None:
    for field in ("node", "attribute", "initializer", "metadata_props"):
        model = onnx.ModelProto(graph=onnx.GraphProto(name="agent"))
        where = model if field == "metadata_props" else model.graph
        parts = model.graph.node.add().attribute if field == "attribute" else getattr(where, field)
        for _ in range(MAX_PARTS):
            parts.add()
        read_graph(model.SerializeToString())
        parts.add()
        assert f"has {MAX_PARTS + 1} nodes, attributes or tensors" in refused(model.SerializeToString()), field


N3 = "n = Cast<to=7>(inputs) n3 = Reshape(n, row) "
GROWING = {
    "Expand": "time = Slice(inputs, two, three, axis) n = Cast<to=7>(time) n1 = Reshape(n, row) b = Expand(inputs, n1)",
    "Slice": N3 + "n1 = Slice(n3, two, three) big = Slice(inputs, axis, n1, axis)",
    "Reshape": N3 + "big = Reshape(inputs, n3)",
    "Split": N3 + "big, b, c = Split<axis=1>(inputs, n3)",
    "ReduceSum": N3 + "n1 = Slice(n3, two, three) big = ReduceSum(inputs, n1)",
}
"""What grows, or shrinks, with what is measured."""
UNKNOWN = {
    "NonZero": "big = NonZero(inputs)",
    "Compress": "b = Cast<to=9>(inputs) f = Reshape(b, row) big = Compress<axis=1>(inputs, f)",
    "RandomNormalLike": "big = RandomNormalLike(inputs)",
    "SequenceConstruct": "big = SequenceConstruct(inputs)",
    "ConstantOfShape": N3 + "big = ConstantOfShape(n3)",
    "Tile": "big = Tile(inputs, two)",
}
"""Operators that are not in the table: work or memory depends on the data, or no policy has them."""
STEADY = "int64[1] two = {2}, int64[1] three = {3}, int64[1] axis = {1}, int64[1] row = {-1}, "
STEADY += "float[3,1] w = {0.0, 0.0, 0.0}"
HEAD = "agent (float[1,3] inputs) => (float[1,1] outputs)"


def test_an_operator_whose_work_is_not_known_to_be_the_same_for_every_sample_is_refused() -> None:
    for table, reason in ((GROWING, "operator {} takes a size or a place"), (UNKNOWN, "has the operator '{}'")):
        for operator, body in table.items():
            text = f"{HEAD} <{STEADY}> {{ {body} outputs = MatMul(inputs, w) }}"
            assert reason.format(operator) in refused(model_of(text))
    model = parsed(f"{HEAD} <{STEADY}> {{ {GROWING['Expand']} outputs = MatMul(inputs, w) }}")
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([1]), "n1"))  # the name of what is computed
    assert "Expand takes a size" in refused(with_contract(model, GOOD))


def test_sizes_that_stand_in_the_file_are_taken_whether_as_initializers_or_as_constants() -> None:
    weights = "float[1,1] u = {2.0}, int64[2] shape = {1, 1}, float[3,1] w = {0.0, 0.0, 0.0}"
    text = f"{HEAD} <{weights}> {{ zero = MatMul(inputs, w) "
    text += "same = Constant<value = int64[2] {1, 1}>() a = Expand(zero, shape) b = Reshape(a, same) "
    text += "c = ReduceSum<keepdims=1>(b, ) outputs = Add(c, u) }"
    assert asked(load_policy(model_of(text), BENCH), 1.0, 2.0, 3.0) == 2.0


NAMED = {
    "of torch": "Flatten HardSwish HardSigmoid Celu Mish Softplus LeakyRelu Selu Elu Gelu Erf LogSoftmax",
    "of each element": "Acos Acosh Asin Asinh Atan Atanh Ceil Cosh Floor Sinh Tan Shrink Softsign Sum Mean",
    "of a row": "ThresholdedRelu ReduceL1 ReduceL2 ReduceProd ReduceSumSquare",
}
"""Operators that the page on the contract allows, by their kinds."""


def test_the_operators_that_the_page_names_are_accepted() -> None:
    for operator in " ".join(NAMED.values()).split():
        body = f"a = {operator}(inputs) b = Mul(a, zero) c = ReduceSum<keepdims=1>(b, axis) outputs = Add(c, two)"
        tensors = "float[1] zero = {0.0}, float[1,1] two = {2.0}, int64[1] axis = {1}"
        inside = ((1.5 if operator == "Acosh" else 0.5,) * 3,) * MIN_VECTORS  # where it is defined
        vectors = tuple(Vector(inputs, (2.0,)) for inputs in inside)
        policy = load_policy(model_of(f"{HEAD} <{tensors}> {{ {body} }}", vectors=vectors), BENCH)
        assert asked(policy, 0.0, 0.0, 0.0) == 2.0 or operator == "Acosh", operator


def test_the_reason_of_onnx_runtime_is_said_whole() -> None:
    model = parsed(f"{HEAD} <float[3,1] w = {{0.0, 0.0, 0.0}}> {{ outputs = MatMul(inputs, w) }}")
    for version, opset, reason in (
        (99, 17, "IR version: 99, max supported"),
        (8, 99, "support for domain ai.onnx is till"),
    ):
        model.ir_version, model.opset_import[0].version = version, opset
        said = refused(with_contract(model, GOOD))
        assert reason in said
        assert "onnxruntime::" not in said


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
    text = f"""{HEAD} <int64[1] two = {{2}}, int64[1] three = {{3}}, int64[1] axis = {{1}}, int64[1] row = {{-1}},
        float[10,1] table = {{2.,2.,2.,2.,2.,2.,2.,2.,2.,2.}}> {{
        time = Slice(inputs, two, three, axis)
        index = Cast<to=7>(time)
        flat = Reshape(index, row)
        outputs = Gather<axis=0>(table, flat) }}"""
    vectors = (Vector((0.0, 0.0, 3.0), (2.0,)),) * MIN_VECTORS
    policy = load_policy(model_of(text, vectors=vectors), BENCH)
    assert "could not evaluate" in refusal(lambda: asked(policy, 0.0, 0.0, 4_000_000.0))


def test_loading_and_asking_a_policy_starts_no_thread() -> None:
    before = set(Path("/proc/self/task").iterdir())
    policy = load_policy(constant_actor(BENCH, 2.0), BENCH)
    for k in range(100):
        asked(policy, 0.0, 0.0, k)
    assert set(Path("/proc/self/task").iterdir()) <= before


def test_onnx_runtime_leaves_nothing_behind_and_reports_to_nobody(tmp_path: Path) -> None:
    """Its wheels keep an identifier of the machine in the user's cache for reports to their maker."""
    code = (
        "from emb_runtime.policy.policy import load_policy, shipped_actor_path\n"
        "from emb_runtime.config.bench import load_bench\n"
        "load_policy(shipped_actor_path(), load_bench())\n"
    )
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "PATH": os.environ["PATH"]}
    done = subprocess.run([sys.executable, "-c", code], env=home, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    assert list(tmp_path.iterdir()) == []
