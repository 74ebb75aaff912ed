"""Actors with a state and with estimates: what they remember, what of it is believed, and how a run ends by it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import Contract, Vector
from emb_runtime.policy.inference import Inference
from emb_runtime.policy.policy import ONNX_RUNTIME, SCALARS, Policy, load_policy
from emb_runtime.safety.state_machine import Fault
from tests.actors import (
    LEAKY_ESTIMATES,
    LEAKY_STATE,
    WIDE,
    Leaky,
    constant_actor,
    contract_for,
    leaky_actor,
    leaky_sequences,
)
from tests.conftest import Simulate
from tests.runtime.operating import refusal

BENCH = load_bench()
SEEN = np.random.default_rng(3).uniform((0, -300, 0, -6), (90, 300, 500, 6), (300, 4)).astype(np.float32).tolist()


# What it remembers ----------------------------------------------------------------------------------------------------


def said(actor: Policy | Leaky) -> list[tuple[float, tuple[float, ...]]]:
    """What an actor wants, and what it estimates, at each of some samples."""
    return [(actor.act(*row), actor.estimate) for row in SEEN]


def test_an_actor_with_a_state_says_what_the_same_sums_in_python_say() -> None:
    policy, leaky = load_policy(leaky_actor(BENCH), BENCH), Leaky()
    leaky.begin()
    for (current, estimate), (wanted, estimated) in zip(said(policy), said(leaky), strict=True):
        assert current == pytest.approx(wanted, rel=1e-6)
        assert estimate == pytest.approx(estimated, rel=1e-6)


def test_onnx_runtime_and_scalar_operations_say_the_same_of_an_actor_with_a_state() -> None:
    fast, slow = (load_policy(leaky_actor(BENCH), BENCH, name) for name in (SCALARS, ONNX_RUNTIME))
    assert (fast.evaluated_by, slow.evaluated_by) == (SCALARS, ONNX_RUNTIME)
    assert said(fast) == said(slow)


def test_checking_and_warming_up_leave_nothing_behind_and_each_run_begins_anew() -> None:
    policy = load_policy(leaky_actor(BENCH), BENCH)
    assert policy.estimate == ()
    fresh = said(policy)
    assert said(policy) != fresh
    policy.begin()
    assert policy.estimate == ()
    assert said(policy) == fresh


def test_two_policies_of_one_file_do_not_share_their_state() -> None:
    one, other = (load_policy(leaky_actor(BENCH), BENCH) for _ in range(2))
    fresh = said(one)
    assert said(other) == fresh


def test_the_test_vectors_are_sequences_and_each_begins_with_the_initial_state() -> None:
    contract = load_policy(leaky_actor(BENCH), BENCH).contract
    swapped = tuple(tuple(reversed(sequence)) for sequence in contract.sequences)
    assert "test vector 0" in refusal(lambda: load_policy(leaky_actor(BENCH, sequences=swapped), BENCH))
    joined = ((*contract.sequences[0], *contract.sequences[1]),)
    assert "test vector 32" in refusal(lambda: load_policy(leaky_actor(BENCH, sequences=joined), BENCH))
    later = (1.0, 0.0)
    assert "test vector 0" in refusal(lambda: load_policy(leaky_actor(BENCH, initial_state=later), BENCH))


def shifted(vector: Vector, part: str, number: int, by: float) -> Vector:
    """The same with one number of what it tells changed by a part of the largest value of that number."""
    largest = max(abs(getattr(v, part)[number]) for sequence in leaky_sequences() for v in sequence)
    state, estimate = list(vector.state), list(vector.estimate)
    (state if part == "state" else estimate)[number] += by * largest
    return vector._replace(state=tuple(state), estimate=tuple(estimate))


@pytest.mark.parametrize(("part", "number"), [("state", 0), ("state", 1), ("estimate", 0), ("estimate", 3)])
@pytest.mark.parametrize("place", [0, 40, 49])
def test_what_is_remembered_and_estimated_is_held_against_the_test_vectors_too(
    part: str, number: int, place: int
) -> None:
    first, second = leaky_sequences()
    for by, taken in ((0.9e-5, True), (1.1e-5, False), (-1.1e-5, False)):
        other = (*second[:place], shifted(second[place], part, number, by), *second[place + 1 :])
        data = leaky_actor(BENCH, sequences=(first, other))
        if taken:
            load_policy(data, BENCH)
        else:
            said = refusal(lambda data=data: load_policy(data, BENCH))  # type: ignore[misc]  # a default in a lambda
            assert f"test vector {len(first) + place}: the policy's {part}, number {number}, should be" in said


def test_what_is_not_told_is_not_held_against_anything_but_each_sequence_ends_with_all_of_it() -> None:
    few = tuple((*(v._replace(state=(), estimate=()) for v in s[:-1]), s[-1]) for s in leaky_sequences())
    contract = dataclasses.replace(load_policy(leaky_actor(BENCH), BENCH).contract, sequences=few)
    assert Contract.from_json(contract.to_json()) == contract
    none = dataclasses.replace(contract, sequences=tuple((*s[:-1], s[-1]._replace(state=())) for s in few))
    assert "the last vector of a sequence" in refusal(lambda: Contract.from_json(none.to_json()))


def test_a_contract_of_schema_2_is_read_as_before_and_its_vectors_tell_the_action_alone() -> None:
    now = load_policy(leaky_actor(BENCH), BENCH).contract
    record = json.loads(now.to_json()) | {"schema": 2}
    assert "unknown key" in refusal(lambda: Contract.from_json(json.dumps(record)))
    for vector in (v for sequence in record["sequences"] for v in sequence):
        del vector["state"], vector["estimate"]
    then = Contract.from_json(json.dumps(record))
    bare = tuple(tuple(v._replace(state=(), estimate=()) for v in sequence) for sequence in now.sequences)
    assert then == dataclasses.replace(now, sequences=bare)
    model = onnx.load_from_string(leaky_actor(BENCH))
    model.metadata_props[0].value = json.dumps(record)
    assert load_policy(model.SerializeToString(), BENCH).contract == then


def test_a_contract_with_a_state_survives_json() -> None:
    contract = load_policy(leaky_actor(BENCH), BENCH).contract
    assert Contract.from_json(contract.to_json()) == contract
    assert (contract.initial_state, contract.estimates) == (LEAKY_STATE, LEAKY_ESTIMATES)


def test_a_contract_of_schema_1_is_read_as_before() -> None:
    old = load_policy(constant_actor(BENCH), BENCH).contract
    now = json.loads(old.to_json())
    then = {name: now[name] for name in now if name not in ("sequences", "initial_state", "estimates")}
    then |= {"schema": 1, "recurrent": [], "vectors": [vector for (vector,) in now["sequences"]]}
    assert Contract.from_json(json.dumps(then)) == old
    assert "recurrent" in refusal(lambda: Contract.from_json(json.dumps(then | {"recurrent": ["h"]})))
    assert "estimates" in refusal(lambda: Contract.from_json(json.dumps(then | {"estimates": []})))


def test_the_applied_current_reaches_a_graph_that_asks_for_it_and_no_other() -> None:
    wide = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]> agent (float[1,4] obs) => (float[1,1] action) '
        "<float[4,1] w = {0.0, 0.0, 0.0, 0.5}> { action = MatMul(obs, w) }"
    ).SerializeToString()
    contract = contract_for(BENCH, 0.0, {"observation": WIDE})
    assert Inference(wide, contract).act(1.0, 2.0, 3.0, 5.0) == 2.5
    assert "'obs' tensor(float) [1, 3], the graph has 'obs' tensor(float) [1, 4]" in refusal(
        lambda: Inference(wide, contract_for(BENCH, 0.0, {}))
    )
    assert load_policy(constant_actor(BENCH, 2.0), BENCH).act(1.0, 2.0, 3.0, math.nan) == 2.0


# What is refused ------------------------------------------------------------------------------------------------------


def with_port(name: str, change: Callable[[onnx.ValueInfoProto], object]) -> bytes:
    """The leaky actor with an input or output that is declared otherwise."""
    model = onnx.load_from_string(leaky_actor(BENCH))
    (port,) = (p for p in (*model.graph.input, *model.graph.output) if p.name == name)
    change(port)
    return bytes(model.SerializeToString())


def shaped(*dims: int | str) -> Callable[[onnx.ValueInfoProto], object]:
    def change(port: onnx.ValueInfoProto) -> None:
        kind = port.type.tensor_type.elem_type
        port.type.CopyFrom(onnx.helper.make_tensor_type_proto(kind, dims))

    return change


@pytest.mark.parametrize("name", ["state", "next_state", "estimate", "action", "obs"])
@pytest.mark.parametrize("dims", [(1,), (2, 2), (1, 1, 2), (1, "S"), (1, 3), ()])
def test_ports_of_other_shapes_are_refused_or_known_better(name: str, dims: tuple[int | str, ...]) -> None:
    """Of an output ONNX Runtime finds out the true shape, and takes that."""
    data = with_port(name, shaped(*dims))
    try:
        policy = load_policy(data, BENCH)
    except PolicyRefusedError:
        refusal(lambda: load_policy(data, BENCH))
        return
    assert name not in ("obs", "state")
    assert said(policy) == said(load_policy(leaky_actor(BENCH), BENCH))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"initial_state": ()}, "inputs: the contract needs 'obs' tensor(float) [1, 4], the graph has"),
        ({"initial_state": (0.0,)}, "'state' tensor(double) [1, 1]"),
        ({"initial_state": (0.0, 0.0, 0.0)}, "'state' tensor(double) [1, 3]"),
        ({"estimates": ()}, "outputs: the contract needs"),
        ({"estimates": LEAKY_ESTIMATES[:1]}, "'estimate' tensor(float) [1, 2]"),
        ({"observation": WIDE[:3]}, "observation"),
    ],
)
def test_a_contract_that_says_something_else_than_the_graph_is_refused(changes: dict[str, Any], said: str) -> None:
    assert said in refusal(lambda: load_policy(leaky_actor(BENCH, **changes), BENCH))


def test_a_state_in_single_precision_is_refused() -> None:
    model = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]> '
        "agent (float[1,3] obs, float[1,2] state) => (float[1,1] action, float[1,2] next_state) "
        "<float[3,1] w = {0.0, 0.0, 0.0}> { action = MatMul(obs, w) next_state = Identity(state) }"
    )
    contract = contract_for(BENCH, 0.0, {"initial_state": (0.0, 0.0)})
    assert "'state' tensor(double) [1, 2]" in refusal(lambda: Inference(model.SerializeToString(), contract))


def test_a_graph_that_lies_about_a_shape_is_refused_when_it_shows() -> None:
    """The lookup gives as many numbers as the step says; declared is one."""
    model = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]> agent (float[1,3] obs) => (float[1,1] action) '
        "<int64[1] one = {1}, float[1] x = {2.0}, int64[1] two = {2}, int64[1] three = {3}, int64[1] flat = {-1}> {"
        " step = Slice(obs, two, three, one) n = Cast<to=7>(step) row = Reshape(n, flat) all = Concat<axis=0>(one, row)"
        " action = Expand(x, all) }"
    )
    inference = Inference(model.SerializeToString(), contract_for(BENCH, 2.0, {}))
    assert inference.act(0.0, 0.0, 1.0, 0.0) == 2.0
    assert "could not evaluate" in refusal(lambda: inference.act(0.0, 0.0, 3.0, 0.0))


@pytest.mark.parametrize(
    ("breaks", "factor", "message"),
    [
        ("STATE", math.nan, "the policy's state is not finite after step"),
        ("STATE", math.inf, "the policy's state is not finite after step"),
        ("VALUE", math.nan, "the policy's estimate is none after step"),
        ("VALUE", 1e300, "the policy's estimate is none after step"),
        ("DEVIATION", math.inf, "the policy's estimate is none after step"),
        ("DEVIATION", -1.0, "the policy's estimate is none after step"),
    ],
)
def test_a_state_or_an_estimate_that_is_none_is_told_where_it_becomes_so(
    simulate: Simulate, breaks: str, factor: float, message: str
) -> None:
    assert message in refusal(lambda: load_policy(leaky_actor(BENCH, breaks, after=10, factor=factor), BENCH))
    policy = load_policy(leaky_actor(BENCH, breaks, factor=factor), BENCH)
    run = simulate(actor=policy)
    assert run.outcome.fault is Fault.POLICY_NOT_FINITE
    assert run.outcome.detail.startswith(f"{message} 100")
    assert len(run.journal.cycles) == len(run.journal.estimates) == 100
    assert run.outcome.estimate == run.journal.estimates[-1][2]
    assert not any(load_layout().decode_command(frame).enable for frame in run.sent[-3:])


def test_an_action_that_is_not_finite_ends_the_run_as_ever(simulate: Simulate) -> None:
    run = simulate(actor=load_policy(leaky_actor(BENCH, "ACTION"), BENCH))
    assert (run.outcome.fault, run.outcome.detail) == (Fault.POLICY_NOT_FINITE, "it answered nan")
