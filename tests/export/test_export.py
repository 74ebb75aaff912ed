"""The exported file: one file, nothing of the machine in it, and the same function as what it was made of."""

from __future__ import annotations

import copy
import dataclasses
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.reference
import pytest
import torch

from emb_bench.config.bench import Bench, load_bench
from emb_bench.excitation import excitation
from emb_bench.export.own_policy import observations
from emb_bench.export.policy_file import sequence_file
from emb_bench.export.torch_policy import torch_graph
from emb_export import emb_export
from emb_export.export import main
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.contract import CONTRACT_KEY, INPUTS, MAX_VECTORS, MIN_VECTORS, Contract, read_contract
from emb_runtime.policy.policy import load_policy
from emb_train.cli import main as train_main
from emb_train.network import network_file
from emb_train.ppo import DeployedActor
from emb_train.training import BENCH as BENCH_FILE
from emb_train.training import CONFIGURATION, METRICS, Trained, Training, load_preset, run_training
from tests.actors import parsed
from tests.commands import refused
from tests.train.trainings import HORIZON, make_tiny, short_bench

BENCH = load_bench()


@pytest.fixture(scope="module", autouse=True)
def _tiny() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training")
    arguments = ["ppo", "single-viscous", "--output", str(folder / "run"), "--seed", "5"]
    assert train_main([*arguments, "--bench", str(short_bench(folder))]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def exported(run: Path) -> bytes:
    return (run / "actor.onnx").read_bytes()


@pytest.fixture(scope="module")
def trained(run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trained, Training, Bench]:
    """The training of ``run`` once more: its actor."""
    bench, training = load_bench(run / BENCH_FILE), load_preset("single-viscous", seed=5)
    *_, best = run_training(tmp_path_factory.mktemp("again"), training, bench)
    return best, training, bench


def contract_of(data: bytes) -> Contract:
    (entry,) = onnx.load_from_string(data).metadata_props
    assert entry.key == CONTRACT_KEY
    return read_contract(entry.value)


def answers(data: bytes, seen: np.ndarray) -> np.ndarray:
    """Outputs of a file for inputs of shape [N, n], by ONNX's own evaluation, shape [N, m]."""
    evaluator: Any = onnx.reference.ReferenceEvaluator(onnx.load_from_string(data))
    return np.concatenate([evaluator.run(None, {"inputs": row[None]})[0] for row in seen])


# A network ------------------------------------------------------------------------------------------------------------


def test_the_runtime_takes_the_file_and_gives_what_the_network_gives(
    trained: tuple[Trained, Training, Bench], exported: bytes
) -> None:
    best, _, bench = trained
    actor = DeployedActor(best.actor, bench.limits.current)
    policy, reference = load_policy(exported, bench), onnx.reference.ReferenceEvaluator(onnx.load_from_string(exported))
    for seen in observations(bench)[:200]:
        angle, velocity, time = map(float, seen)
        step = round(time / bench.timing.sample_time)
        with torch.no_grad():
            wanted = actor(torch.tensor([[angle, velocity, float(step)]])).item()
        found = policy.act(angle, velocity, step, Estimator(bench))
        assert found == pytest.approx(wanted, abs=1e-5 * bench.limits.current)
        (again,) = reference.run(None, {"inputs": seen[None]})
        assert np.asarray(again).item() == pytest.approx(found, abs=6e-5)


def test_the_contract_has_what_the_actor_was_trained_for(run: Path, exported: bytes) -> None:
    bench = load_bench(run / BENCH_FILE)
    contract = contract_of(exported)
    ranges: dict[Any, Any] = contract.ranges
    assert (contract.kind, contract.inputs) == ("current", ("angle", "velocity", "time"))
    assert contract.velocity == bench.sensors.velocity
    assert (contract.sample_time, contract.horizon, contract.limits.current) == (1e-3, HORIZON, 6.0)
    assert ranges["f_v"] == (1e-5, 5e-5)
    assert ranges["k_m"] == (bench.brake.k_m, bench.brake.k_m)
    configuration = json.loads((run / CONFIGURATION).read_text())
    assert configuration.pop("schema") == 1  # of the file
    for name, value in configuration.items():
        found = contract.provenance.get(name)
        assert (json.loads(str(found)) if isinstance(value, dict | list) else found) == value
    records = [json.loads(line) for line in (run / METRICS).read_text().splitlines()]
    best = max(records, key=lambda record: record["score"])
    assert (contract.provenance["steps"], contract.provenance["score"]) == (best["steps"], best["score"])
    assert len(contract.vectors) >= MIN_VECTORS


def test_the_clip_is_in_the_graph_and_a_network_that_is_not_finite_is_not_exported(
    trained: tuple[Trained, Training, Bench],
) -> None:
    best, training, bench = trained
    other = best._replace(actor=copy.deepcopy(best.actor))
    with torch.no_grad():
        other.actor.layers[-1].bias.fill_(50.0)  # type: ignore[operator]  # the last layer is Linear
    data, said = network_file(other, training, bench)
    assert f"are beyond {bench.limits.current:g} A: clipped" not in said  # its own clip
    assert load_policy(data, bench).act(0.0, 0.0, 0, Estimator(bench)) == bench.limits.current
    for constant in other.actor.features.buffers():
        constant.zero_()  # every weight is finite, and no answer is
    with pytest.raises(PolicyRefusedError, match="not finite"):
        network_file(other, training, bench)


def test_nothing_of_this_machine_is_in_the_file_and_it_is_the_same_each_time(
    run: Path, trained: tuple[Trained, Training, Bench], exported: bytes
) -> None:
    assert network_file(*trained)[0] == exported
    for trace in (str(run), str(Path.home()), str(Path.cwd()), socket.gethostname(), "site-packages", ".py", "stack"):
        assert trace.encode() not in exported


# A training for speeds ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def speeds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trained]:
    """The folder of a training, and the actor that it has found."""
    folder, kept = tmp_path_factory.mktemp("speeds"), list[Trained]()

    def keeping(*arguments: Any) -> Iterator[Trained]:
        for best in run_training(*arguments):
            kept.append(best)
            yield best

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("emb_train.training.run_training", keeping)
        assert train_main(["ppo", "--output", str(folder / "run"), "--bench", str(short_bench(folder))]) == 0
    return folder / "run", kept[-1]


def test_a_training_for_speeds_gives_target_speeds_of_the_estimate_which_the_runtime_follows(
    speeds: tuple[Path, Trained],
) -> None:
    folder, best = speeds
    bench, training = load_bench(folder / BENCH_FILE), load_preset("interval")
    data, said = network_file(best, training, bench)
    assert data == (folder / "actor.onnx").read_bytes()
    assert "the trained network" in said
    policy = load_policy(data, bench)
    contract = policy.contract
    assert (contract.kind, contract.inputs) == ("speed", INPUTS[1])
    low, high = bench.range_set("pm50").low, bench.range_set("pm50").high
    assert contract.ranges == {n: (getattr(low, n), getattr(high, n)) for n in PARAMETER_NAMES}
    estimator, rng = Estimator(bench), np.random.default_rng(1)
    for step in range(HORIZON):
        angle, velocity = float(rng.normal(0.0, 1e-3)), float(rng.normal(0.0, 1.0))
        estimator.add_sample(angle, velocity, float(step), 0.0)
        with torch.no_grad():
            action = best.actor(torch.tensor([[angle, velocity, float(step), *estimator.parameters]]))
            speed = bench.limits.velocity * best.actor.part(action).item()
        wanted = current_for(estimator.model, estimator.state, estimator.relative, speed, contract.gain)
        assert policy.act(angle, velocity, float(step), estimator) == pytest.approx(wanted, abs=1e-2)


def test_a_file_that_computes_something_else_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def wrong(actor: Any, width: int) -> Any:
        actor = copy.deepcopy(actor)
        with torch.no_grad():
            actor.layers[-1].bias.add_(0.1)
        return torch_graph(actor, width)

    monkeypatch.setattr("emb_train.network.torch_graph", wrong)
    command = ["ppo", "single-viscous", "--output", str(tmp_path / "run"), "--bench", str(short_bench(tmp_path))]
    assert "differs" in refused(lambda: train_main(command), capsys, code=5)
    assert not (tmp_path / "run" / "actor.onnx").exists()


# A sequence -----------------------------------------------------------------------------------------------------------


def test_a_sequence_is_exported_as_a_policy_that_gives_it(tmp_path: Path) -> None:
    path, estimator = tmp_path / "ramp.onnx", Estimator(BENCH)
    assert main(["ramp:amplitude=-5", "--output", str(path)]) == 0
    policy, wanted = load_policy(path, BENCH), excitation("ramp", BENCH, amplitude=-5.0).currents
    assert wanted is not None
    found = [policy.act(17.0, -3.0, float(k), estimator) for k in range(len(wanted))]
    assert found == pytest.approx(wanted, abs=1e-5 * BENCH.limits.current)
    assert policy.act(0.0, 0.0, -1.0, estimator) == found[0]
    assert policy.act(0.0, 0.0, 1e9, estimator) == found[-1]
    assert policy.contract.provenance["sequence"] == "ramp:amplitude=-5.0,start=0.0"
    assert policy.contract.ranges == {}


@pytest.mark.parametrize("horizon", [MIN_VECTORS - 12, MAX_VECTORS + 10])
def test_a_sequence_shorter_or_longer_than_a_contract_has_vectors_is_compared_whole(horizon: int) -> None:
    bench = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=horizon))
    wanted = np.linspace(-6.0, 6.0, bench.timing.horizon)
    policy = load_policy(sequence_file(wanted, "ramp", bench), bench)
    found = [policy.act(0.0, 0.0, float(k), Estimator(bench)) for k in range(0, len(wanted), 10)]
    assert found == pytest.approx(wanted[::10], abs=1e-5 * bench.limits.current)


def test_a_design_is_exported_as_a_policy(tmp_path: Path) -> None:
    design, path = tmp_path / "best.csv", tmp_path / "best.onnx"
    current = np.linspace(-6.0, 6.0, BENCH.timing.horizon + 1)
    metadata = json.dumps({"identity_hash": BENCH.identity_hash, "criterion": "D"})
    design.write_text("\n".join([f"# {metadata}", "current", *map(str, current.tolist())]))
    assert main([str(design), "--output", str(path)]) == 0
    policy = load_policy(path, BENCH)
    found = [policy.act(0.0, 0.0, float(k), Estimator(BENCH)) for k in range(BENCH.timing.horizon)]
    assert found == pytest.approx(current[:-1], abs=1e-5 * BENCH.limits.current)


# The command ----------------------------------------------------------------------------------------------------------


def test_each_graph_stands_alone_in_a_version_that_the_runtimes_oldest_library_reads(
    exported: bytes, speeds: tuple[Path, Trained], tmp_path: Path
) -> None:
    assert main(["step", "--output", str(tmp_path / "step.onnx")]) == 0
    for data in (exported, (speeds[0] / "actor.onnx").read_bytes(), (tmp_path / "step.onnx").read_bytes()):
        model = onnx.load_from_string(data)
        onnx.checker.check_model(model, full_check=True)
        assert [(o.domain, o.version) for o in model.opset_import] == [("", 20)]
        assert model.ir_version <= 10
        assert [p.key for p in model.metadata_props] == [CONTRACT_KEY]
        assert not model.functions
        assert all(not n.metadata_props and not n.doc_string for n in model.graph.node)
        assert all(t.data_location == onnx.TensorProto.DEFAULT for t in model.graph.initializer)


@pytest.mark.parametrize(("typed", "kind"), [("", "current"), ("--kind current", "current"), ("--kind speed", "speed")])
def test_a_network_of_others_is_of_the_kind_that_is_typed(
    typed: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = "agent (float[1,3] seen) => (float[1,1] act) <float[3,1] w = {0.,0.,9.}> { act = MatMul(seen, w) }"
    onnx.save(parsed(graph), tmp_path / "mine.onnx")
    assert main([str(tmp_path / "mine.onnx"), *typed.split(), "--output", str(tmp_path / "x.onnx")]) == 0
    assert f"({kind} of angle, velocity, time)" in capsys.readouterr().out
    assert load_policy(tmp_path / "x.onnx", BENCH).contract.kind == kind


def test_ctrl_c_is_no_traceback_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupt)
    monkeypatch.setattr(sys, "argv", ["emb-export", "step", "--output", str(tmp_path / "y.onnx")])
    assert emb_export() == 130
    assert not list(tmp_path.iterdir())


def test_a_file_is_for_the_limits_and_the_sample_time_of_the_bench_that_is_named(tmp_path: Path) -> None:
    bench, path = tmp_path / "my.toml", tmp_path / "x.onnx"
    bench.write_text(shipped_bench_text().replace("velocity = 500.0", "velocity = 400.0"))
    assert main(["ramp:amplitude=-3", "--bench", str(bench), "--output", str(path)]) == 0
    load_policy(path, load_bench(bench))
    for other in (BENCH, dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, sample_time=2e-3))):
        with pytest.raises(PolicyRefusedError):
            load_policy(path, other)
    bench.write_text(shipped_bench_text().replace('envelope      = "braking"', 'envelope      = "coasting"'))
    path.unlink()
    assert (
        main(["ramp:amplitude=-5", "--bench", str(bench), "--output", str(path)]) == 2
    )  # no shield can be made for it
    assert not path.exists()


def test_the_folder_of_a_training_is_refused_for_its_policy_is_in_it(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(lambda: main([str(run), "--output", str(tmp_path / "x.onnx")]), capsys)
    assert f"emb-run takes {run / 'actor.onnx'} as it is" in said


def test_a_sequence_is_exported_without_torch(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name.partition('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError(name=name)\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "from emb_export.export import main\n"
        f"sys.exit(main(['step', '--output', {str(tmp_path / 'x.onnx')!r}]))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120, check=False).returncode == 0
