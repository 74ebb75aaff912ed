"""The exported file: one file, nothing of the machine in it, and the same function as the network."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from emb_bench.excitation.reference import excitation
from emb_export.entry import emb_export
from emb_export.export import export, main
from emb_export.network import random_observations, recorded_observations, require_parity
from emb_runtime.config.bench import Bench, load_bench, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, Contract
from emb_runtime.policy.policy import Policy, load_policy
from emb_train.cli import main as train_main
from emb_train.ppo import DeployedActor
from emb_train.structured.stored import stored
from emb_train.training import ACTOR, BENCH, CONFIGURATION, load_training, save_actor
from tests.commands import refused
from tests.train.trainings import HORIZON, ITERATION, make_tiny, short_bench


@pytest.fixture(scope="module", autouse=True)
def _tiny() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training")
    arguments = ["ppo", "single-viscous", "--out", str(folder / "run"), "--seed", "5"]
    assert train_main([*arguments, "--bench", str(short_bench(folder))]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def exported(run: Path) -> bytes:
    return export(run)[0]


def deployed(run: Path) -> tuple[DeployedActor, Bench]:
    trained = load_training(run)
    return DeployedActor(trained.actor, trained.bench.limits.current), trained.bench


def policy_of(run: Path, data: bytes) -> Policy:
    return load_policy(data, deployed(run)[1])


def test_the_runtime_takes_the_file_and_says_what_the_network_says(run: Path, exported: bytes) -> None:
    actor, bench = deployed(run)
    policy = load_policy(exported, bench)
    for seen in random_observations(bench)[:200]:
        with torch.no_grad():
            wanted = actor(torch.from_numpy(seen[None])).item()
        angle, velocity, step = map(float, seen)
        assert policy.act(angle, velocity, step, 0.0) == pytest.approx(wanted, abs=1e-5 * bench.limits.current)


def test_the_contract_says_what_the_actor_was_trained_for(run: Path, exported: bytes) -> None:
    _, bench = deployed(run)
    contract = policy_of(run, exported).contract
    assert contract.bench_hash == bench.contract_hash
    assert (contract.sample_time, contract.horizon, contract.action_limit) == (1e-3, HORIZON, 6.0)
    assert contract.ranges["f_v"] == (1e-5, 5e-5)
    assert contract.ranges["k_m"] == (bench.brake.k_m, bench.brake.k_m)
    config = json.loads((run / CONFIGURATION).read_text())
    for name, value in config.items():
        told = contract.provenance[name]
        assert (json.loads(str(told)) if isinstance(value, dict | list) else told) == value
    assert contract.provenance["seed"] == 5
    best = load_training(run)
    assert contract.provenance["steps"] == best.iteration * ITERATION
    assert contract.provenance["score"] == best.score
    assert len(contract.vectors) >= MIN_VECTORS
    assert contract.vectors[0].observation[2] == 0.0


def test_an_actor_is_exported_for_another_bench_whose_shield_differs_and_nothing_else_that_it_knows(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, path = (run / "bench.toml").read_text(), tmp_path / "bench.toml"
    path.write_text(text.replace('ranges        = "envelope"', 'ranges        = "viscous"'))
    assert main([str(run), "--bench", str(path), "--out", str(tmp_path / "a.onnx")]) == 0
    assert "behind another shield (ranges envelope, here viscous)" in capsys.readouterr().out
    load_policy(tmp_path / "a.onnx", load_bench(path))
    for old, new in (
        ("velocity = 500.0", "velocity = 400.0"),
        ("velocity = 1.0 ", "velocity = 2.0 "),
        (f"horizon     = {HORIZON}", "horizon     = 90"),
        ("J     = 4.624e-6", "J     = 5e-6"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        refused(lambda: main([str(run), "--bench", str(path), "--out", str(tmp_path / "b.onnx")]), capsys)
    assert not (tmp_path / "b.onnx").exists()


def test_a_file_for_another_bench_does_not_take_the_place_of_the_training_s_own(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "run"
    shutil.copytree(run, other)
    (other / "actor.onnx").write_bytes(b"the training's own")
    assert "--bench: expected --out FILE" in refused(
        lambda: main([str(other), "--bench", str(other / "bench.toml")]), capsys
    )
    assert (other / "actor.onnx").read_bytes() == b"the training's own"


def test_an_actor_for_brakes_that_the_shield_does_not_cover_is_exported_for_a_bench_whose_shield_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = dataclasses.replace(stored("viscous-exact-quadratic"), task="viscous-stiffness", shield="bounded")
    source, path, bench = tmp_path / "own.json", tmp_path / "a.onnx", tmp_path / "my.toml"
    source.write_text(kept.to_json())
    monkeypatch.setattr("emb_export.stateful.export_stateful", lambda *_: (b"data", 0.0))
    refused(lambda: main([str(source), "--out", str(path)]), capsys)
    text = shipped_bench_text().replace("k_1   = 2.304e1 ", "k_1   = 37.5 ")
    bench.write_text(text.replace('ranges        = "envelope"', 'ranges        = "viscous-stiffness"'))
    assert main([str(source), "--bench", str(bench), "--out", str(path)]) == 0
    assert "another shield (bounded, here worst case)" in capsys.readouterr().out  # worth something else behind it
    assert path.read_bytes() == b"data"


def test_the_checkpoints_may_be_read_by_whoever_may_read_the_rest_of_a_training(run: Path) -> None:
    modes = {name: (run / name).stat().st_mode for name in (CONFIGURATION, ACTOR)}
    assert len(set(modes.values())) == 1


def test_the_same_training_gives_the_same_bytes(run: Path, exported: bytes) -> None:
    assert export(run)[0] == exported


def test_nothing_of_this_machine_is_in_the_file(run: Path, exported: bytes) -> None:
    for trace in (str(run), str(Path.home()), str(Path.cwd()), socket.gethostname(), "site-packages", ".py", "stack"):
        assert trace.encode() not in exported


def test_the_graph_stands_alone_in_a_version_that_the_runtime_s_oldest_library_reads(exported: bytes) -> None:
    model = onnx.load_from_string(exported)
    onnx.checker.check_model(model, full_check=True)
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 20)]
    assert model.ir_version <= 10
    assert [p.key for p in model.metadata_props] == [CONTRACT_KEY]
    assert not model.functions
    assert all(not n.metadata_props and not n.doc_string for n in model.graph.node)
    assert all(t.data_location == onnx.TensorProto.DEFAULT for t in model.graph.initializer)


def test_the_reference_evaluator_of_onnx_agrees(run: Path, exported: bytes) -> None:
    _, bench = deployed(run)
    reference = onnx.reference.ReferenceEvaluator(onnx.load_from_string(exported))
    policy = policy_of(run, exported)
    for seen in random_observations(bench)[:50]:
        (wanted,) = reference.run(None, {"obs": seen[None]})
        angle, velocity, step = map(float, seen)
        assert policy.act(angle, velocity, step, 0.0) == pytest.approx(np.asarray(wanted).item(), abs=6e-5)


def test_the_clip_is_in_the_graph(run: Path) -> None:
    actor, bench = deployed(run)
    with torch.no_grad():
        actor.actor.layers[-1].bias.fill_(50.0)  # type: ignore[operator]  # the last layer is Linear
    policy = policy_of(run, export(saved_beside(run, actor, "clip"))[0])
    assert policy.act(0.0, 0.0, 0, 0.0) == bench.limits.current


def saved_beside(run: Path, actor: DeployedActor, name: str) -> Path:
    """A directory as that of the training, with another actor."""
    other = run.parent / name
    other.mkdir()
    for part in (CONFIGURATION, BENCH):
        (other / part).write_bytes((run / part).read_bytes())
    save_actor(other, actor.actor, 3, 0.0)
    return other


def test_a_network_that_is_not_finite_is_not_exported(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    actor, _ = deployed(run)
    actor.actor.span.zero_()  # every weight is finite, and no answer is
    other = saved_beside(run, actor, "infinite")
    assert "not finite" in refused(lambda: main([str(other)]), capsys, code=5)
    assert not (other / "actor.onnx").exists()


@pytest.mark.parametrize("difference", [2e-5, 1.0, math.nan])
def test_a_file_that_computes_something_else_fails_the_proof(run: Path, exported: bytes, difference: float) -> None:
    actor, bench = deployed(run)
    observations = random_observations(bench)[:100]
    assert require_parity(actor, policy_of(run, exported), observations) < 1e-5
    with torch.no_grad():
        actor.actor.layers[-1].bias.add_(difference)  # type: ignore[operator]  # the last layer is Linear
    with pytest.raises(PolicyRefusedError):
        require_parity(actor, policy_of(run, exported), observations)


def test_the_proof_uses_observations_that_the_actor_meets(run: Path) -> None:
    actor, bench = deployed(run)
    recorded = recorded_observations(actor, bench, bench.range_set("viscous"), ("f_v",))
    assert sorted(set(recorded[:, 2])) == list(range(HORIZON))
    assert np.ptp(recorded[:, 1]) > 50.0
    assert recorded.dtype == np.float32


def test_the_command_writes_one_file_and_nothing_beside_it(
    run: Path, exported: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "actor.onnx"
    assert main([str(run), "--out", str(path)]) == 0
    assert path.read_bytes() == exported
    assert [p.name for p in tmp_path.iterdir()] == ["actor.onnx"]
    assert str(path) in capsys.readouterr().out


def test_ctrl_c_is_no_traceback_and_an_output_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.onnx.part").mkdir()
    assert main(["step", "--out", str(tmp_path / "x.onnx")]) == 2
    monkeypatch.setattr(Path, "replace", interrupt)
    monkeypatch.setattr(sys, "argv", ["emb-export", "step", "--out", str(tmp_path / "y.onnx")])
    assert emb_export() == 130


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_contract_of_an_exported_file_is_refused_by_a_bench_with_another_sample_time(
    run: Path, exported: bytes
) -> None:
    _, bench = deployed(run)
    other = dataclasses.replace(bench, timing=dataclasses.replace(bench.timing, sample_time=2e-3))
    with pytest.raises(PolicyRefusedError):
        load_policy(exported, other)
    assert isinstance(policy_of(run, exported).contract, Contract)


def test_no_actor_is_made_for_a_bench_that_no_shield_can_be_made_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench, path = tmp_path / "my.toml", tmp_path / "ramp.onnx"
    bench.write_text(shipped_bench_text().replace('envelope      = "braking"', 'envelope      = "coasting"'))
    assert main(["ramp:amplitude=-5", "--bench", str(bench), "--out", str(path)]) == 2
    assert "shield.angle_margin" in capsys.readouterr().err
    assert not path.exists()


def test_a_reference_excitation_is_exported_as_an_actor_that_says_what_it_says(tmp_path: Path) -> None:
    bench, path = load_bench(), tmp_path / "ramp.onnx"
    assert main(["ramp:amplitude=-5", "--out", str(path)]) == 0
    policy, wanted = load_policy(path, bench), excitation("ramp", bench, amplitude=-5.0).currents
    assert wanted is not None
    said = [policy.act(17.0, -3.0, float(k), 0.0) for k in range(len(wanted))]
    assert said == pytest.approx(wanted, abs=1e-5 * bench.limits.current)
    assert policy.act(0.0, 0.0, -1.0, 0.0) == said[0]
    assert policy.act(0.0, 0.0, 1e9, 0.0) == said[-1]
    assert policy.contract.provenance["sequence"] == "ramp:amplitude=-5.0,start=0.0"


def test_a_design_is_exported_as_an_actor(tmp_path: Path) -> None:
    bench, design, path = load_bench(), tmp_path / "best.npz", tmp_path / "best.onnx"
    current = np.linspace(-6.0, 6.0, bench.timing.horizon + 1)
    metadata = json.dumps({"contract_hash": bench.contract_hash, "criterion": "D"})
    np.savez(design, current=current, metadata=metadata)
    assert main([str(design), "--out", str(path)]) == 0
    policy = load_policy(path, bench)
    said = [policy.act(0.0, 0.0, float(k), 0.0) for k in range(bench.timing.horizon)]
    assert said == pytest.approx(current[:-1], abs=1e-5 * bench.limits.current)


def test_what_cannot_be_exported_is_one_line_and_leaves_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text("{")
    Path("10:30").mkdir()  # a directory, and no excitation with options
    before = sorted(tmp_path.iterdir())
    for arguments in (
        ["step"],
        ["constant-speed", "--out", "x.onnx"],  # a feedback law
        ["sawtooth:f=1", "--out", "x.onnx"],
        ["none.npz", "--out", "x.onnx"],
        ["none.json", "--out", "x.onnx"],
        ["bad.json", "--out", "x.onnx"],
        ["four-d-exact-blind"],
        ["step", "--bench", "none.toml", "--out", "x.onnx"],
        ["step", "--out", "."],
        ["nowhere", "--out", "x.onnx"],
        ["10:30"],
        [str(run), "--out", "none/actor.onnx"],
    ):
        assert refused(lambda: main(arguments), capsys), arguments  # noqa: B023  # called at once
    assert sorted(tmp_path.iterdir()) == before


def test_a_sequence_is_exported_without_torch(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from emb_export.export import main\n"
        f"sys.exit(main(['step', '--out', {str(tmp_path / 'step.onnx')!r}]))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120, check=False).returncode == 0
