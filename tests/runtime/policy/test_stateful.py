"""Actors with a state and with estimates: what they remember, what of it is believed, and how a run ends by it."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.cli.replay import main as emb_replay
from emb_bench.logs.log import read_log
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench
from emb_runtime.control.loop import HOME_PAIRS
from emb_runtime.control.stop_condition import REACHED, StopCondition, parse_stop_condition
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.log.ring_buffer import MAX_PAYLOAD, EstimateRecord, Kind, pack_estimate, unpack
from emb_runtime.policy.contract import MAX_ESTIMATES, Contract, Quantity, Vector
from emb_runtime.policy.inference import Inference
from emb_runtime.policy.policy import ONNX_RUNTIME, SCALARS, Policy, load_policy
from emb_runtime.records import Reason
from emb_runtime.safety.shield_design import make_law
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
from tests.conftest import FunctionActor, SimRun, Simulate
from tests.runtime.operating import EmbRun, refusal

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


# The loop and the log -------------------------------------------------------------------------------------------------


def test_the_loop_asks_with_the_current_that_acted_and_writes_down_each_estimate(simulate: Simulate) -> None:
    policy, leaky = load_policy(leaky_actor(BENCH), BENCH), Leaky()
    for _ in range(2):  # the second run begins anew
        run = simulate(actor=policy)
        assert run.outcome.home
        leaky.begin()
        answered = run.journal.cycles[:-1]
        assert len(answered) == 500
        for cycle, (time_ns, step, estimate) in zip(answered, run.journal.estimates, strict=True):
            wanted = leaky.act(cycle.angle, cycle.velocity, cycle.step, cycle.applied_current)
            assert cycle.policy_current == pytest.approx(wanted, abs=1e-5)
            assert (time_ns, step) == (cycle.receive_time_ns, cycle.step)
            assert estimate == pytest.approx(leaky.estimate, rel=1e-6)
        assert run.outcome.estimate == run.journal.estimates[-1][2]
        assert not run.outcome.goal_reached


def test_an_actor_that_estimates_nothing_writes_down_nothing(simulate: Simulate) -> None:
    run = simulate()
    assert run.journal.estimates == []
    assert run.outcome.estimate == ()


@given(
    step=st.integers(-(2**31), 2**31 - 1),
    numbers=st.lists(st.floats(allow_nan=False), min_size=2, max_size=2 * MAX_ESTIMATES).map(tuple),
)
def test_an_estimate_survives_the_ring_however_many_there_are(step: int, numbers: tuple[float, ...]) -> None:
    payload = pack_estimate(123, step, numbers)
    assert len(payload) <= MAX_PAYLOAD
    assert unpack(Kind.ESTIMATE, payload) == EstimateRecord(123, step, numbers)


# Ending early ---------------------------------------------------------------------------------------------------------


def test_a_goal_is_reached_when_each_deviation_is_below_its_part_of_the_value() -> None:
    stop_condition = parse_stop_condition(" k_1 = 1%, f_v=50 % ", LEAKY_ESTIMATES)
    assert stop_condition.parts == ((0, 0.01), (1, 0.5))
    assert stop_condition.reached((-2.0, 1.0, 0.0199, 0.49))
    assert not stop_condition.reached((-2.0, 1.0, 0.0201, 0.49))
    assert not stop_condition.reached((-2.0, 1.0, 0.0199, 0.51))
    assert not stop_condition.reached((0.0, 1.0, 0.0, 0.1))
    assert not stop_condition.reached((-2.0, 1.0, 0.0, 0.49)), "what is certain was not measured"
    assert stop_condition.describe((-2.0, 1.0, 0.019, 0.4)) == "k_1 to 0.95 % of 1 %, f_v to 40 % of 50 %"
    assert parse_stop_condition("f_v=5%", LEAKY_ESTIMATES).reached((1.0, 1.0, 1e9, 0.04))


@pytest.mark.parametrize(
    "text",
    [
        *("", "k_1", "k_1=1", "k_1=%", "k_1=0%", "k_1=-1%", "k_1=101%", "k_1=nan%", "k_1=inf%", "k_1=1%%", "k_1=1%,"),
        *("T_c=1%", "k_1=1%,k_1=2%", "k_1=1%;f_v=2%", "=1%"),
    ],
)
def test_what_is_no_goal_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UsageError, match=r"--stop-when: ") as caught:
        parse_stop_condition(text, LEAKY_ESTIMATES)
    assert "\n" not in str(caught.value)


class Learning(FunctionActor):
    """An actor of a function, whose one estimate becomes better with time."""

    known_at = 0

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        self.estimate = (1.0, 0.02 if step < self.known_at else 0.005)
        return super().act(angle, velocity, step, applied_current)


GOAL = StopCondition("x=1%", ("x",), ((0, 0.01),))
LAWS: dict[str, Callable[[float, float, float], float]] = {
    "forward": lambda *_: 6.0,
    "backward": lambda *_: -6.0,
    "away": lambda y, v, k: math.copysign(6.0, y),
    "faster": lambda y, v, k: math.copysign(6.0, v),
    "square": lambda y, v, k: 6.0 if k // 20 % 2 == 0 else -6.0,
}


def learned(simulate: Simulate, law: str, known_at: int, options: str = "", **arguments: Any) -> SimRun:
    actor = Learning(LAWS[law])
    actor.known_at = known_at
    return simulate(actor=actor, stop_condition=GOAL, options=options, **arguments)


@pytest.mark.parametrize("known_at", [0, 60, 150, 300, 400, 480, 499])
@pytest.mark.parametrize("law", LAWS)
def test_once_enough_is_known_the_brake_comes_home_and_it_ends(simulate: Simulate, law: str, known_at: int) -> None:
    run = learned(simulate, law, known_at)
    assert (run.outcome.fault, run.outcome.home, run.outcome.goal_reached) == (None, True, True)
    assert run.journal.codes == ["SILENT", "ARMED", "ACTIVE", REACHED, "STOPPING", "OVER"]
    assert run.journal.events[3][2] == "x to 0.5 % of 1 %"
    cycles = run.journal.cycles
    assert len(cycles) <= 501
    ended = cycles[-1].step
    at_home = [abs(c.angle) <= BENCH.shield.home_angle for c in cycles[-HOME_PAIRS:]]
    assert ended == 500 or all(at_home)
    after = [c for c in cycles if known_at < c.step < ended]
    assert all(c.reasons & Reason.RETURNING and c.clipped_current == 0.0 for c in after)
    assert all(c.policy_current == pytest.approx(LAWS[law](c.angle, c.velocity, c.step)) for c in after)
    assert all(not c.reasons & Reason.CLIPPED for c in after)
    assert [step for _, step, _ in run.journal.estimates] == [c.step for c in cycles[:-1]]
    assert -10.0 <= run.outcome.counters.angle_min <= run.outcome.counters.angle_max <= 100.0
    assert run.outcome.counters.top_speed <= 510.0  # measured


def test_it_ends_early_indeed_and_not_before(simulate: Simulate) -> None:
    lengths = {known_at: learned(simulate, "forward", known_at).journal.cycles[-1].step for known_at in (0, 60, 150)}
    assert all(known_at + HOME_PAIRS <= length < 500 for known_at, length in lengths.items())
    assert lengths[0] < lengths[60] < lengths[150]
    never = learned(simulate, "forward", 10_000)
    assert not never.outcome.goal_reached
    assert never.journal.cycles[-1].step == 500


BOX = BENCH.range_set(BENCH.shield.ranges)


@given(
    corner=st.tuples(*(st.sampled_from((getattr(BOX.low, n), getattr(BOX.high, n))) for n in PARAMETER_NAMES)),
    known_at=st.integers(0, 499),
    law=st.sampled_from(sorted(LAWS)),
    plant=st.sampled_from(["euler", "exact"]),
)
@settings(max_examples=25)
def test_every_corner_of_the_set_comes_home_within_its_limits(
    simulate: Simulate, corner: tuple[float, ...], known_at: int, law: str, plant: str
) -> None:
    theta = ",".join(f"{name}={value!r}" for name, value in zip(PARAMETER_NAMES, corner, strict=True))
    outcome = learned(simulate, law, known_at, f"plant={plant},{theta}").outcome
    assert (outcome.fault, outcome.home, outcome.goal_reached) == (None, True, True)


def test_a_policy_that_goes_mad_on_the_way_home_is_stopped_as_ever(simulate: Simulate) -> None:
    actor = Learning(lambda _y, _v, k: math.nan if k == 90 else 6.0)
    actor.known_at = 80
    run = simulate(actor=actor, stop_condition=GOAL)
    assert (run.outcome.fault, run.outcome.goal_reached) == (Fault.POLICY_NOT_FINITE, True)


def test_a_way_home_of_its_own_takes_no_notice_of_a_goal(simulate: Simulate) -> None:
    run = simulate(homing=True)
    assert not run.outcome.goal_reached


def test_the_view_of_time_on_the_way_home_is_late_but_never_beyond_the_end() -> None:
    law = make_law(BENCH)
    late = law.steps - 2 - math.ceil(law.settling / law.sample_time)
    assert 0 < late < law.steps - 2


# emb-run --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def leaky(tmp_path: Path, bench: Bench, handlers: None, capsys: pytest.CaptureFixture[str]) -> EmbRun:
    path = tmp_path / "leaky.onnx"
    path.write_bytes(leaky_actor(bench))
    return EmbRun(("--policy", str(path)), capsys, tmp_path / "run.mcap")


def test_a_run_is_logged_with_its_estimates_and_decides_the_same_again(
    leaky: EmbRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    summary = leaky.document()
    assert (summary["answered"], summary["home"], summary["goal_reached"]) == (500, True, False)
    k_1 = summary["estimate"]["k_1"]
    assert (k_1["value"], k_1["deviation"], k_1["unit"]) == (pytest.approx(0.05001), pytest.approx(1e-4), "N m/rad")
    log = leaky.log()
    table = log.tables["/estimate"]
    assert [*table][3:] == ["step", "k_1", "k_1_deviation", "f_v", "f_v_deviation"]
    assert table["step"].tolist() == list(range(500))
    assert table["f_v_deviation"].tolist() == pytest.approx([2e-4 / (k + 1) for k in range(500)], rel=1e-6)
    assert table["publish_time"].tolist() == log.cycles["publish_time"][:500].tolist()
    assert emb_replay(["rerun", str(path)]) == 0
    assert capsys.readouterr().out.startswith("reproduced   each of 501 decisions, 503 sent frames")
    assert emb_replay(["info", str(path)]) == 0
    assert "estimate     f_v = 2.000e-05 ± 7.8e-07 N m s/rad (3.9 %) at 95 %, by the actor" in capsys.readouterr().out
    assert emb_replay(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["estimate"] == summary["estimate"]


def test_it_ends_early_where_that_is_asked_for(
    leaky: EmbRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    out = leaky.text("--stop-when", "f_v=10%")
    answered = re.match(r"done: (\d+) of 500 samples answered, ended early: enough is known after 0\.\d+ s\n", out)
    assert answered is not None
    assert 100 + HOME_PAIRS < int(answered[1]) < 500
    assert "\n  estimate   k_1 = 0.05" in out
    assert ": home\n" in out
    log = leaky.log()
    assert log.run["stop_when"] == "f_v=10%"
    assert (log.exit_reason, log.end["goal_reached"]) == ("DONE", "True")
    (event,) = (event for event in log.events if event.code == REACHED)
    assert event.text == "f_v to 9.9 % of 10 %"
    assert emb_replay(["rerun", str(path)]) == 0
    assert f"reproduced   each of {int(answered[1]) + 1} decisions" in capsys.readouterr().out
    for command in (["fim"], ["timing"], ["info"], ["estimate"], ["report", "-o", str(tmp_path / "page.html")]):
        assert emb_replay([command[0], str(path), *command[1:]]) in (0, 2), command
        describe = capsys.readouterr()
        assert "the experiment ends after" not in describe.out + describe.err, command
        assert "did not come to its end" not in describe.err, command


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--stop-when", "T_c=1%"], "the actor estimates k_1, f_v, got 'T_c'"),
        (["--stop-when", "k_1=1"], "as in k_1=1%"),
        (["--stop-when", "k_1=1%", "--read-only"], "--read-only"),
    ],
)
def test_what_cannot_be_stopped_for_is_a_usage_error(leaky: EmbRun, arguments: list[str], reason: str) -> None:
    leaky.refused(reason, *arguments)


def test_an_actor_that_estimates_nothing_cannot_be_stopped_for(leaky: EmbRun, tmp_path: Path) -> None:
    plain = tmp_path / "plain.onnx"
    plain.write_bytes(constant_actor(BENCH))
    leaky.refused("this actor estimates nothing", "--stop-when", "k_1=1%", "--policy", str(plain))


def test_a_campaign_asks_each_run_anew(leaky: EmbRun, tmp_path: Path) -> None:
    runs = leaky.documents("--log", str(tmp_path), "--repeat", "2", "--stop-when", "k_1=2%")
    assert [run["goal_reached"] for run in runs] == [True, True]
    assert all(read_log(Path(run["log"])).tables["/estimate"]["step"][0] == 0 for run in runs)


def test_names_of_estimates_are_fields_of_a_table() -> None:
    many = tuple(Quantity(f"{name}x", "1") for name in "abcdefghijkl")
    contract = contract_for(BENCH, 1.0, {"estimates": many})
    assert Contract.from_json(contract.to_json()).estimates == many
