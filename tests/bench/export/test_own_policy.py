"""Policies of others: a graph, a module, a model or a table becomes a file that gives what it was made of."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_bench.export.sequence import read_sequence
from emb_runtime.cli.main import main as run_main
from emb_runtime.errors import EmbError, PolicyRefusedError, UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.policy import load_policy
from emb_train.env import EmbExcitationEnv

BENCH = load_bench()
FLOAT, DOUBLE, HALF, INT64 = TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.FLOAT16, TensorProto.INT64
WEIGHTS = np.array([[0.1], [0.01], [1.0]])
MULTIPLY = (("MatMul", ["seen", "w"], ["act"]),)
Nodes = tuple[tuple[Any, ...], ...]


def graph(
    nodes: Nodes = MULTIPLY,
    seen: tuple[Any, ...] | None = (1, 3),
    act: tuple[Any, ...] | None = (1, 1),
    kind: int = FLOAT,
    opset: int = 20,
    more: tuple[str, ...] = (),
    weights: np.ndarray = WEIGHTS,
    declared: bool = False,
    function: bool = False,
) -> onnx.ModelProto:
    """A graph of others: names, types and shapes are theirs."""
    made = [helper.make_node(*node[:3], **(node[3] if len(node) > 3 else {})) for node in nodes]
    inputs = [helper.make_tensor_value_info(name, kind, seen) for name in ("seen", *more)]
    if declared:
        inputs.append(helper.make_tensor_value_info("w", kind, weights.shape))
    outputs = [helper.make_tensor_value_info(nodes[-1][2][-1], kind, act)]
    dtype = helper.tensor_dtype_to_np_dtype(kind if kind != INT64 else FLOAT)
    held = [numpy_helper.from_array(weights.astype(dtype), "w"), numpy_helper.from_array(np.array([2, 3]), "sizes")]
    model = helper.make_model(
        helper.make_graph(made, "theirs", inputs, outputs, held),
        opset_imports=[helper.make_opsetid("", opset), *([helper.make_opsetid("my", 1)] if function else [])],
        ir_version=8 if opset < 20 else 10,
    )
    if function:
        body = [helper.make_node("Neg", ["x"], ["y"])]
        model.functions.append(helper.make_function("my", "F", ["x"], ["y"], body, [helper.make_opsetid("", opset)]))
    return model


def exported(model: Any, folder: Path, kind: str = "current") -> Any:
    """The policy that becomes of a graph, a module or a table, as the runtime loads it."""
    source: Any = model
    if isinstance(model, onnx.ModelProto):
        source = folder / "mine.onnx"
        onnx.save(model, source)
    api.export_policy(source, folder / "policy.onnx", kind=kind)
    return load_policy(folder / "policy.onnx", BENCH)


def followed(policy: Any, speed: float, angle: float, velocity: float, step: int) -> bool:
    """Whether the policy asks for the current that the speed loop finds for this speed [rad/s].

    The brake is believed to be a little slower, so that the current is within its limits.
    """
    estimator = Estimator(BENCH)
    estimator.state = estimator.state._replace(mean=(angle, speed - 5.0, 1.0, 1.0, 1.0, 1.0))
    found = policy.act(angle, velocity, step, estimator)
    wanted = current_for(estimator.model, estimator.state, estimator.relative, speed, 1.0)
    return bool(found == pytest.approx(wanted, abs=1e-3)) and abs(found) < BENCH.limits.current


def current(policy: Any, angle: float, velocity: float, step: int) -> float:
    return float(policy.act(angle, velocity, step, Estimator(BENCH)))


def product(angle: float, velocity: float, step: int) -> float:
    """What the graph of these tests gives, clipped at the bench's limit."""
    return float(np.clip(np.array([angle, velocity, 1e-3 * step]) @ WEIGHTS[:, 0], -6.0, 6.0))


@pytest.mark.parametrize(
    ("model", "wanted"),
    [
        pytest.param(graph(), product, id="other names"),
        pytest.param(graph((("MatMul", ["seen", "w"], ["outputs"]),)), product, id="one of our names"),
        pytest.param(graph((("MatMul", ["seen", "w"], ["inputs"]), ("Neg", ["inputs"], ["outputs"]))),
                     lambda *s: -product(*s), id="our names for something else"),
        pytest.param(graph(kind=DOUBLE), product, id="double precision"),
        pytest.param(graph(kind=HALF, weights=1e-2 * WEIGHTS), lambda a, v, k: 1e-2 * (0.1 * a + 0.01 * v + 1e-3 * k),
                     id="half precision"),
        pytest.param(graph(seen=("batch", 3), act=("batch", 1)), product, id="any number of rows"),
        pytest.param(graph(seen=(3,), act=(1,)), product, id="no rows"),
        pytest.param(graph(act=None), product, id="an output without a shape"),
        pytest.param(graph(opset=9, declared=True), product, id="an old opset, weights among the inputs"),
        pytest.param(graph(opset=23), product, id="a new opset"),
        pytest.param(graph((("F", ["seen"], ["n"], {"domain": "my"}), ("MatMul", ["n", "w"], ["act"])), function=True),
                     lambda *s: -product(*s), id="a function of its own"),
    ],
)  # fmt: skip
def test_a_graph_keeps_its_function_under_the_contract_s_names(
    model: onnx.ModelProto, wanted: Callable[..., float], tmp_path: Path
) -> None:
    policy = exported(model, tmp_path)
    near = 2e-3 if model.graph.input[0].type.tensor_type.elem_type == HALF else 1e-5
    for sample in ((0.0, 0.0, 0), (3.0, -40.0, 17), (-1.5, 120.0, 499), (90.0, 490.0, 300), (-9.0, -490.0, 2)):
        assert current(policy, *sample) == pytest.approx(wanted(*sample), abs=near)
    assert policy.contract.inputs == ("angle", "velocity", "time")
    assert policy.contract.provenance["graph"] == "mine.onnx"


@pytest.mark.parametrize(
    ("kind", "limit", "said"),
    [
        ("current", 6.0, "2000 currents are beyond 6 A: clipped"),
        ("speed", 500.0, "speeds are beyond 500 rad/s: clipped"),
    ],
)
def test_the_kind_says_whether_it_is_a_current_or_a_target_speed(
    kind: str, limit: float, said: str, tmp_path: Path
) -> None:
    onnx.save(graph(weights=1e3 * WEIGHTS), tmp_path / "mine.onnx")
    assert said in api.export_policy(tmp_path / "mine.onnx", tmp_path / "x.onnx", kind=kind)
    contract = load_policy(tmp_path / "x.onnx", BENCH).contract
    assert (contract.kind, contract.greatest, contract.gain) == (kind, limit, 1.0)
    found = {output for vector in contract.vectors for output in vector.outputs}
    assert {limit, -limit} < found


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (graph(seen=(1, 4), weights=np.ones((4, 1))), "its input has the shape [1, 4]: expected 3 or 11 numbers"),
        (graph(seen=(64, 3), act=(64, 1)), "its input has the shape [64, 3]"),
        (graph(seen=("batch", "n"), act=None), "its input has the shape [N, N]"),
        (graph(seen=None), "its input has the shape []"),
        (graph((("Neg", ["seen"], ["act"]),), act=(1, 3)), "its output has the shape [1, 3]: expected one current"),
        (graph(more=("hidden",)), "expected one input, got 2 (seen, hidden)"),
        (graph(kind=INT64), "its input is of type int64: expected float32, float64 or float16"),
        (graph((*MULTIPLY, ("Sqrt", ["act"], ["root"]))), "its current is not finite for angle"),
        (graph((("RandomNormalLike", ["seen"], ["x"]), ("MatMul", ["x", "w"], ["act"]))), "RandomNormalLike"),
        (graph((("Expand", ["seen", "sizes"], ["x"]), ("MatMul", ["x", "w"], ["act"])), act=(2, 1)), "[2, 1]"),
        (graph(opset=99), "it is of opset 99, and cannot be written in 20"),
    ],
)  # fmt: skip
def test_a_graph_that_no_policy_can_be_made_of_is_refused_by_what_it_has(
    model: onnx.ModelProto, words: str, tmp_path: Path
) -> None:
    with pytest.raises(PolicyRefusedError) as refusal:
        exported(model, tmp_path)
    assert words in str(refusal.value)
    assert str(tmp_path / "mine.onnx") in str(refusal.value)
    assert not (tmp_path / "policy.onnx").exists()


def test_a_result_inside_that_takes_memory_is_refused_before_it_is_computed(tmp_path: Path) -> None:
    large = graph((("Expand", ["seen", "sizes"], ["x"]), ("ReduceSum", ["x"], ["act"])), act=None)
    large.graph.initializer[1].CopyFrom(numpy_helper.from_array(np.array([60000, 60000, 3]), "sizes"))
    with pytest.raises(PolicyRefusedError, match="10800000000 numbers"):
        exported(large, tmp_path)


def test_weights_in_a_file_beside_the_graph_are_taken_in_and_from_nowhere_else(tmp_path: Path) -> None:
    source = tmp_path / "mine.onnx"
    onnx.save(graph(), source, save_as_external_data=True, location="mine.onnx.data", size_threshold=0)
    api.export_policy(source, tmp_path / "policy.onnx")
    assert current(load_policy(tmp_path / "policy.onnx", BENCH), 3.0, -40.0, 17) == pytest.approx(
        product(3.0, -40.0, 17)
    )
    for place, words in (
        ("../mine.onnx.data", "expected a file in the same folder"),
        ("/etc/passwd", "expected a file in the same folder"),
        ("gone.data", "cannot be read: No such file"),
    ):
        model = onnx.load(source, load_external_data=False)
        for tensor in model.graph.initializer:
            (location,) = (entry for entry in tensor.external_data if entry.key == "location")
            location.value = place
        (tmp_path / "other.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(PolicyRefusedError) as refusal:
            api.export_policy(tmp_path / "other.onnx", tmp_path / "x.onnx")
        assert words in str(refusal.value)


def test_nothing_of_the_graph_s_makers_computer_is_in_the_file(tmp_path: Path) -> None:
    model = graph()
    model.doc_string = model.graph.doc_string = model.graph.node[0].doc_string = "/home/somebody/net.py"
    model.graph.node[0].metadata_props.add(key="stack", value="/home/somebody/net.py")
    model.metadata_props.add(key="author", value="somebody")
    exported(model, tmp_path)
    assert b"somebody" not in (tmp_path / "policy.onnx").read_bytes()


# Torch ----------------------------------------------------------------------------------------------------------------


class SeesTheEstimate(torch.nn.Module):
    """A current that depends on the running estimate and its deviations."""

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """One A per 0.01 of k_m, and one per 10 % of the deviation of f_v."""
        return 100.0 * inputs[:, 3:4] + 10.0 * inputs[:, 10:11] / inputs[:, 6:7]


def test_a_network_that_sees_the_estimate_is_exported_and_run(tmp_path: Path) -> None:
    policy, estimator = exported(SeesTheEstimate(), tmp_path), Estimator(BENCH)
    k_m, *_, f_v, _, _, _, deviation = estimator.parameters
    wanted = min(100.0 * k_m + 10.0 * deviation / f_v, 6.0)
    assert policy.act(1.0, 2.0, 3, estimator) == pytest.approx(wanted, rel=1e-5)
    run = api.simulate(tmp_path / "run.mcap", policy=tmp_path / "policy.onnx", duration=0.1)
    assert run.exit_reason == "DONE"
    assert len(set(np.round(run.policy_current, 6))) > 10  # the estimate changes, and the current with it


def test_a_module_stays_as_it_was_and_is_exported_as_it_is_in_evaluation(tmp_path: Path) -> None:
    torch.manual_seed(1)
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Dropout(0.5), torch.nn.Linear(4, 1)).double()
    policy = exported(module, tmp_path)
    assert module.training
    assert module[0].weight.dtype == torch.float64
    with torch.no_grad():
        wanted = module.eval()(torch.tensor([[3.0, -0.5, 0.017]], dtype=torch.float64)).item()
    assert current(policy, 3.0, -0.5, 17) == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize(
    ("policy", "kind", "words"),
    [
        (torch.nn.Linear(4, 1), "current", "it gives no current of a row of 3 or 11 numbers: mat1 and mat2"),
        (torch.nn.Linear(3, 2), "current", "its output has the shape [1, 2]: expected 3 or 11 numbers"),
        (lambda inputs: 3.0, "current", "which gives a tensor, got float"),
        (lambda inputs: inputs[:, :1] if inputs[0, 0] > 0.0 else -inputs[:, :1], "current", "torch cannot export it"),
        (lambda inputs: torch.log(inputs[:, :1]), "current", "its current is not finite for angle -"),
        (5.0, "current", "expected a file, a module"),
        (None, "current", "expected a file, a module"),
        ([0.1] * 501, "current", "expected 1 to 500 currents"),
        ([], "current", "expected a file, a module"),
        ([0.1, float("nan")], "current", "expected finite currents, got nan at step 1"),
        ("sawtooth:f=1", "current", "sawtooth"),
        ("none.csv", "current", "none.csv: cannot read the currents: No such file"),
        (lambda inputs: inputs[:, :2], "speed", "it gives no speed of a row of 3 or 11 numbers"),
        (lambda inputs: torch.log(inputs[:, :1]), "speed", "its speed is not finite for angle -"),
        (lambda inputs: inputs[:, :1], "torque", "kind: expected current or speed, got 'torque'"),
        (lambda inputs: inputs[:, :1], "reference", "kind: expected current or speed, got 'reference'"),
        ([0.1] * 500, "speed", "kind: speed is for a network"),
        ("step", "speed", "kind: speed is for a network"),
        ("mine.csv", "speed", "kind: speed is for a network"),
    ],
)
def test_what_is_no_policy_or_none_of_its_kind_is_refused(policy: Any, kind: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(EmbError) as refusal:
        api.export_policy(policy, tmp_path / "x.onnx", kind=kind)
    assert words in str(refusal.value)
    assert not list(tmp_path.iterdir())


def test_a_function_of_a_tensor_may_give_target_speeds(tmp_path: Path) -> None:
    policy = exported(lambda inputs: 5.0 + 0.1 * inputs[:, :1] + 40.0 * inputs[:, 2:3], tmp_path, kind="speed")
    assert followed(policy, 5.0 + 0.1 * 3.0 + 40.0 * 0.02, 3.0, 2.0, 20)
    run = api.simulate(tmp_path / "run.mcap", policy=tmp_path / "policy.onnx")
    assert run.exit_reason == "DONE"
    wanted = 5.0 + 0.1 * run.angle + 40.0 * 1e-3 * np.arange(len(run.angle))
    assert np.abs(run.velocity - wanted)[50:150].max() < 10.0


# Stable-Baselines3 ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def normalised() -> tuple[PPO, VecNormalize]:
    """A model that was trained for a moment, and the environment that scales its observations."""
    env = VecNormalize(make_vec_env(EmbExcitationEnv, n_envs=2))
    return PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=0).learn(128), env


def test_a_model_requests_what_it_predicts_for_the_scaled_observation(
    normalised: tuple[PPO, VecNormalize], tmp_path: Path
) -> None:
    model, env = normalised
    policy = exported(model, tmp_path)
    for angle, velocity, step in ((0.0, 0.0, 0), (3.0, -40.0, 17), (60.0, 300.0, 200), (95.0, -480.0, 499)):
        seen = env.normalize_obs(np.array([[angle, velocity, step]], np.float32))
        action, _ = model.predict(seen, deterministic=True)
        wanted = 6.0 * np.clip(action, -1.0, 1.0).item()
        assert current(policy, angle, velocity, step) == pytest.approx(wanted, abs=1e-4)
    assert policy.contract.provenance["module"] == "PPO"


def test_a_model_that_was_trained_on_target_speeds_requests_them_as_parts_of_the_speed_limit(
    normalised: tuple[PPO, VecNormalize], tmp_path: Path
) -> None:
    model, env = normalised
    policy = exported(model, tmp_path, kind="speed")
    sample = (0.0, 0.0, 0)
    action, _ = model.predict(env.normalize_obs(np.array([sample], np.float32)), deterministic=True)
    assert followed(policy, 500.0 * action.item(), *sample)


def test_a_model_without_its_environment_or_with_other_spaces_is_refused(
    normalised: tuple[PPO, VecNormalize], tmp_path: Path
) -> None:
    model, _ = normalised
    model.save(tmp_path / "model.zip")
    with pytest.raises(UsageError, match="with its environment"):
        api.export_policy(PPO.load(tmp_path / "model.zip"), tmp_path / "x.onnx")
    for name in ("Pendulum-v1", "CartPole-v1"):
        with pytest.raises(UsageError, match="expected the spaces of EmbExcitation-v0"):
            api.export_policy(PPO("MlpPolicy", name), tmp_path / "x.onnx")


# Tables ---------------------------------------------------------------------------------------------------------------

HELD = [3.0] * 100 + [-3.0] * 100 + [0.5] * 300


@pytest.mark.parametrize(
    ("text", "encoding", "wanted", "said"),
    [
        ("current\n1\n2.5\n", "utf-8", [1.0, 2.5] + [0.0] * 498, "2 rows of mine.csv, 0 A from 0.002 s on"),
        ("current\n" + "1\n" * 500, "utf-8", [1.0] * 500, "500 rows of mine.csv"),
        ("time,current\n0,3\n0.1,-3\n0.2,0.5\n", "utf-8", HELD, "3 rows of mine.csv, the last from 0.2 s to the end"),
        ("time [s];current [A]\n0;3\n0.1;-3\n0.2;0.5\n", "utf-8-sig", HELD, "3 rows"),
        ("time_s\tcurrent_A\tangle_rad\n0\t3\t\n0.1\t-3\t\n0.2\t0.5\t\n", "utf-16", HELD, "3 rows"),
        ("# Größe\nCurrent (A),Höhe °\n1,x\n\n2.5,y\n", "cp1252", [1.0, 2.5] + [0.0] * 498, "2 rows"),
        ('"time","current"\r\n"0","3"\r\n"0.1","-3"\r\n"0.2","0.5"\r\n', "utf-8", HELD, "3 rows"),
        ("current\n9\n-7\n1\n", "utf-8", [6.0, -6.0, 1.0] + [0.0] * 497, "2 currents are beyond 6 A: clipped"),
    ],
)
def test_a_table_of_currents_is_read_as_it_is_meant(
    text: str, encoding: str, wanted: list[float], said: str, tmp_path: Path
) -> None:
    (tmp_path / "mine.csv").write_bytes(text.encode(encoding))
    currents, what = read_sequence(str(tmp_path / "mine.csv"), BENCH)
    np.testing.assert_array_equal(currents, wanted)
    assert said in what


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a first line 'current' or 'time,current'"),
        ("current\n", "it has no rows"),
        ("1.0\n2.0\n", "got '1.0'"),
        ("current,current\n1,2\n", "got 'current,current'"),
        ("time,time,current\n0,0,1\n", "got 'time,time,current'"),
        ("current [mA]\n9\n", "current in 'mA': expected A"),
        ("time_ms,current\n0,1\n", "time in 'ms': expected s"),
        ("current\n1,5\n", "line 2: expected 1 numbers, got 2; write numbers with a point"),
        ("time;current\n0;1,5\n", "line 2: current: expected a number, got '1,5'; write numbers with a point"),
        ("time,current\n0\n", "line 2: expected 2 numbers, got 1"),
        ("# of us\ncurrent\n1\nx\n", "line 4: current: expected a number, got 'x'"),
        ("current\nnan\n", "got 'nan'"),
        ("current\n1e999\n", "got '1e999'"),
        ("current\n1_0\n", "got '1_0'"),
        ("current\n\x00\n", "line 2: current: expected a number"),
        ("current\n" + "1\n" * 501, "expected 1 to 500 currents, as the bench's horizon, got 501"),
        ("time,current\n0.1,1\n", "time: expected 0 s first"),
        ("time,current\n0,1\n0.0001,1\n", "at least one sample period of 0.001 s apart"),
        ("time,current\n0,1\n0.2,1\n0.1,1\n", "at least one sample period of 0.001 s apart"),
        ("time,current\n0,1\n0.5,1\n", "time: expected less than the horizon of 0.5 s, got 0.5 s"),
    ],
)
def test_a_table_that_says_something_else_is_refused_by_its_place(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text(text, encoding="utf-8", newline="")
    with pytest.raises(UsageError) as refusal:
        read_sequence(str(tmp_path / "mine.csv"), BENCH)
    assert words in str(refusal.value)


def test_a_plain_graph_s_refusal_by_emb_run_names_the_command_that_makes_it_a_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    onnx.save(graph(), tmp_path / "mine.onnx")
    assert run_main(["--iface", "sim", "--policy", str(tmp_path / "mine.onnx"), "--log", str(tmp_path / "x.mcap")]) == 5
    assert "emb-export FILE --output policy.onnx" in capsys.readouterr().err


def test_the_provenance_names_the_file_in_plain_letters(tmp_path: Path) -> None:
    onnx.save(graph(), tmp_path / "größer.onnx")
    api.export_policy(tmp_path / "größer.onnx", tmp_path / "x.onnx")
    (entry,) = onnx.load(tmp_path / "x.onnx").metadata_props
    assert json.loads(entry.value)["provenance"]["graph"] == "gr??er.onnx"
