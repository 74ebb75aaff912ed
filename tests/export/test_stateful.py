"""Actors with a state, exported: over whole experiments the file wants, remembers and estimates what torch says."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_export import stateful
from emb_export.export import main
from emb_export.stateful import (
    SEQUENCES,
    Answers,
    answers,
    export_stateful,
    recorded_sequences,
    require_sequence_parity,
)
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.policy.contract import APPLIED_CURRENT, OBSERVATION
from emb_runtime.policy.policy import Policy, load_policy

HORIZON = 60
BENCH = parse_bench(shipped_bench_text().replace("horizon     = 500", f"horizon     = {HORIZON}"), "short")
BOX = BENCH.range_set("viscous")
ORIGIN: dict[str, str | int | float] = {"preset": "made up", "seed": 1}
Seen = NDArray[np.float32]


class Leaky(nn.Module):
    """A leaking integral of the current; k_1 and f_v are estimated from thin air."""

    estimates: tuple[str, ...] = ("k_1", "f_v")
    observation_size = 4
    initial_state: Tensor
    scale = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("initial_state", torch.tensor([0.25, 0.0], dtype=torch.float64))

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        leak = 0.95 * state[:, 0] + 0.05 * obs[:, 3].double()
        count = state[:, 1] + 1.0
        current = torch.clamp(4.0 - leak, -6.0, 6.0)
        one = torch.ones_like(count)
        estimate = torch.stack([23.0 * (1.0 + 0.1 / count), 2e-5 * one, self.scale / count, 1e-5 / count], 1)
        return current[:, None].float(), torch.stack([leak, count], 1), estimate.float()


class Recurrent(nn.Module):
    """A GRU of the three that every actor sees, which estimates nothing."""

    estimates: tuple[str, ...] = ()
    observation_size = 3
    initial_state: Tensor
    span: Tensor

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.cell, self.head = nn.GRUCell(3, 16), nn.Linear(16, 1)
        self.register_buffer("initial_state", torch.linspace(-1.0, 1.0, 16).double())
        self.register_buffer("span", torch.tensor([50.0, 250.0, 60.0]))

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        hidden = self.cell(obs / self.span, state.float())
        return 6.0 * torch.tanh(self.head(hidden)), hidden.double(), hidden[:, :0]


@pytest.fixture(scope="module", params=[Leaky, Recurrent], ids=["leaky", "gru"])
def actor(request: pytest.FixtureRequest) -> Leaky | Recurrent:
    module: Leaky | Recurrent = request.param()
    return module.eval()


@pytest.fixture(scope="module")
def exported(actor: Leaky | Recurrent) -> bytes:
    data, difference = export_stateful(actor, BENCH, BOX, ORIGIN)
    assert difference < 1e-6
    return data


def test_the_runtime_takes_the_file_and_its_contract_says_what_the_module_is(
    actor: Leaky | Recurrent, exported: bytes
) -> None:
    contract = load_policy(exported, BENCH).contract
    assert contract.observation == (*OBSERVATION, APPLIED_CURRENT)[: actor.observation_size]
    assert contract.initial_state == tuple(actor.initial_state.tolist())
    units = {"k_1": "N/rad", "f_v": "N·m·s/rad"}
    assert contract.estimates == tuple(Quantity(name, units[name]) for name in actor.estimates)
    assert [len(sequence) for sequence in contract.sequences] == [HORIZON] * SEQUENCES
    assert [vector.observation[2] for vector in contract.sequences[0]] == list(range(HORIZON))
    assert contract.provenance == ORIGIN


def test_the_test_vectors_tell_what_torch_remembers_and_estimates_at_the_end_and_now_and_then(
    actor: Leaky | Recurrent, monkeypatch: pytest.MonkeyPatch
) -> None:
    for every, places in ((64, [59]), (25, [24, 49, 59])):
        monkeypatch.setattr(stateful, "TELLING", every)
        for sequence in load_policy(export_stateful(actor, BENCH, BOX, ORIGIN)[0], BENCH).contract.sequences:
            assert [k for k, vector in enumerate(sequence) if vector.state] == places
            state = actor.initial_state[None]
            for vector in sequence:
                with torch.no_grad():
                    _, state, estimate = actor(torch.tensor([vector.observation], dtype=torch.float32), state)
                if vector.state:
                    assert vector.state == pytest.approx(state[0].tolist(), abs=1e-6)
                    assert vector.estimate == pytest.approx(estimate[0].tolist(), rel=1e-5)


@pytest.mark.parametrize("part", ["state", "estimate"])
def test_a_graph_that_remembers_or_estimates_something_else_is_refused_at_load_whatever_it_wants(part: str) -> None:
    """The current of this actor depends on half of its state, and not on its estimate."""
    data = export_stateful(Leaky(), BENCH, BOX, ORIGIN)[0]
    model = onnx.load_from_string(data)
    (output,) = (o for o in model.graph.output if o.name == {"state": "next_state", "estimate": "estimate"}[part])
    (node,) = (n for n in model.graph.node if output.name in n.output)
    node.output[:] = ["true"]
    size = output.type.tensor_type.shape.dim[1].dim_value
    kind = onnx.helper.tensor_dtype_to_np_dtype(output.type.tensor_type.elem_type)
    factors = np.array([[1.0] * (size - 1) + [1.0 + 1e-4]], kind)  # the last number is a little off
    model.graph.initializer.append(onnx.numpy_helper.from_array(factors, "factors"))
    model.graph.node.append(onnx.helper.make_node("Mul", ["true", "factors"], [output.name]))
    said = f"the policy's {part}, number {size - 1}, should be"
    with pytest.raises(PolicyRefusedError, match=said):
        load_policy(model.SerializeToString(), BENCH)


def test_it_wants_remembers_and_estimates_what_torch_says_one_sample_at_a_time(
    actor: Leaky | Recurrent, exported: bytes
) -> None:
    policy = load_policy(exported, BENCH)
    dice = np.random.default_rng(5)
    for _ in range(3):
        policy.begin()
        state = actor.initial_state[None]
        for k in range(100):
            seen = np.array([[*dice.uniform((-10, -500), (100, 500)), k, dice.uniform(-6, 6)]], np.float32)
            with torch.no_grad():
                current, state, estimate = actor(torch.from_numpy(seen[:, : actor.observation_size]), state)
            assert policy.act(*map(float, seen[0])) == pytest.approx(current.item(), abs=1e-5)
            assert policy.state == pytest.approx(state[0].tolist(), rel=1e-5, abs=1e-6)
            assert policy.estimate == pytest.approx(estimate[0].tolist(), rel=1e-5)


def test_the_same_module_gives_the_same_bytes_and_nothing_of_this_machine(
    actor: Leaky | Recurrent, exported: bytes
) -> None:
    assert export_stateful(actor, BENCH, BOX, ORIGIN)[0] == exported
    for trace in (str(Path.home()), str(Path.cwd()), "site-packages", ".py", "stack_trace"):
        assert trace.encode() not in exported


def test_the_graph_is_whole_and_has_what_is_asked_for(actor: Leaky | Recurrent, exported: bytes) -> None:
    model = onnx.load_from_string(exported)
    onnx.checker.check_model(model, full_check=True)
    assert [port.name for port in model.graph.input] == ["obs", "state"]
    wanted = ["action", "next_state", *(["estimate"] if actor.estimates else [])]
    assert [port.name for port in model.graph.output] == wanted


@pytest.fixture(scope="module")
def proven() -> tuple[Policy, Seen, Answers]:
    """A file, what it has to answer, and what the module does."""
    module = Leaky()
    seen = recorded_sequences(module, BENCH, BOX)
    return load_policy(export_stateful(module, BENCH, BOX, ORIGIN)[0], BENCH), seen, answers(module, seen)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda wanted: wanted._replace(currents=wanted.currents + 1e-4), "current"),
        (lambda wanted: wanted._replace(currents=wanted.currents * math.nan), "current"),
        (lambda wanted: wanted._replace(states=wanted.states * (1.0 + 2e-5)), "state"),
        (lambda wanted: wanted._replace(estimates=wanted.estimates * [1.0, 1.0, 1.0, 1.00002]), "estimate"),
    ],
)
def test_a_file_that_says_something_else_fails_the_proof(
    proven: tuple[Policy, Seen, Answers], change: Callable[[Answers], Answers], what: str
) -> None:
    policy, seen, wanted = proven
    assert require_sequence_parity(wanted, policy, seen) < 1e-6
    with pytest.raises(PolicyRefusedError, match=f"its {what} by"):
        require_sequence_parity(change(wanted), policy, seen)


def test_the_proof_is_of_experiments_that_the_actor_itself_drives() -> None:
    seen = recorded_sequences(Leaky(), BENCH, BOX)
    assert seen.shape == (8, HORIZON, 4)
    assert np.ptp(seen[:, -1, 1]) > 1.0  # other brakes, other speeds
    assert (seen[:, 0, 3] == 0.0).all()
    assert seen[:, 1, 3] == pytest.approx(4.0 - 0.95 * 0.25, abs=1e-6)  # within the first move's limit, as in a run
    assert seen.dtype == np.float32


def test_what_is_not_finite_or_no_parameter_is_not_exported() -> None:
    broken = Leaky()
    broken.scale = math.inf
    with pytest.raises(PolicyRefusedError):
        export_stateful(broken, BENCH, BOX, ORIGIN)
    strange = Leaky()
    strange.estimates = ("k_1", "charm")
    with pytest.raises(UsageError):
        export_stateful(strange, BENCH, BOX, ORIGIN)


def test_a_structured_actor_is_exported_by_its_name_and_drives_a_brake_whose_parameters_it_finds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "structured.onnx"
    assert main(["four-d-exact-blind", "--out", str(path)]) == 0
    assert "of the actor in torch" in capsys.readouterr().out
    contract = load_policy(path, load_bench()).contract
    assert [quantity.name for quantity in contract.estimates] == ["k_m", "k_1", "T_c", "f_v"]
    arguments = [
        "--iface",
        "sim:f_v=3e-5,k_1=20",
        "--policy",
        str(path),
        "--log",
        str(tmp_path / "run.mcap"),
        "--json",
    ]
    assert emb_run([*arguments, "--stop-when", "k_1=1%,f_v=5%"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["home"], said["goal_reached"]) == (True, True)
    for name, truth in (("f_v", 3e-5), ("k_1", 20.0)):
        estimate = said["estimate"][name]
        assert abs(estimate["value"] - truth) < 6.0 * estimate["deviation"] + 1e-3 * truth
