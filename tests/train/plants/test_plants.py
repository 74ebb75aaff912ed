"""Another plant: its information is right, it is learned and exported, and what is wrong with it is said."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from numpy.typing import NDArray

from emb_export.plant import KEY, export_actor
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_train.plants.experiments import Experiments
from emb_train.plants.interface import Floats, Output, Parameter, Plant
from emb_train.plants.learning import PlantVectorEnv, controlled_by, learn, play
from emb_train.ppo.networks import Actor, DeployedActor
from emb_train.ppo.ppo import PpoConfig

ROOT = Path(__file__).resolve().parents[3]


def example() -> ModuleType:
    """The worked example, as a module."""
    spec = importlib.util.spec_from_file_location("dc_motor", ROOT / "examples" / "dc_motor.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


EXAMPLE = example()
MOTOR: Plant = EXAMPLE.PLANT


def decay(p: Floats, x: Floats, u: float, t_s: float, out: Floats) -> None:
    """x' = -a x + b u, solved exactly for an input that is held."""
    out[0] = x[0] * math.exp(-p[0] * t_s) + p[1] * u * (1.0 - math.exp(-p[0] * t_s)) / p[0]


def square_of(p: Floats, x: Floats, out: Floats) -> None:
    """An output that depends on a parameter too."""
    out[0] = p[1] * x[0] * x[0]


def plain(_p: Floats, x: Floats, out: Floats) -> None:
    out[0] = x[0]


def own_sensitivity(p: Floats, x: Floats, u: float, t_s: float, j: int, s: Floats, out: Floats) -> None:
    """By hand: s e^(-a t) and what a, or b, does in the period, times its value."""
    e = math.exp(-p[0] * t_s)
    change = -p[0] * t_s * e * x[0] + p[1] * u * (t_s * e - (1.0 - e) / p[0])
    if j == 1:
        change = p[1] * u * (1.0 - e) / p[0]
    out[0] = s[0] * e + change


DECAY = Plant(
    name="decay",
    step=decay,
    observe=plain,
    parameters=(Parameter("a", "1/s", 2.0, 6.0), Parameter("b", "1/s", 1.0, 3.0)),
    outputs=(Output("x", "1", 0.1, -2.0, 2.0),),
    states=(1.0,),
    input="u",
    input_unit="1",
    input_limit=3.0,
    sample_time=0.01,
    horizon=40,
)


def informed(plant: Plant, parameters: Floats, inputs: Floats) -> Experiments:
    """One experiment with known parameters and inputs."""
    e = Experiments(plant, 1)
    e.begin(0, np.random.default_rng(0), parameters)
    for u in inputs:
        e.advance(np.array([u]))
    return e


def test_the_information_of_a_first_order_plant_is_that_of_its_closed_form() -> None:
    a, b, t = 4.0, 2.0, DECAY.sample_time * np.arange(1, 41)
    # Constant input from rest: x = b/a (1 - e^(-a t)); relative sensitivities a dx/da and b dx/db.
    x = b / a * (1.0 - np.exp(-a * t))
    by_a = -x + b * t * np.exp(-a * t)
    rows = np.stack([by_a, x]) / DECAY.outputs[0].deviation
    e = informed(DECAY, np.array([a, b]), np.ones(40))
    np.testing.assert_allclose(e.x[0, 0], x[-1], rtol=1e-12)
    np.testing.assert_allclose(e.information[0], rows @ rows.T, rtol=1e-8)
    grown = np.linalg.slogdet(rows @ rows.T + 12.0 * np.eye(2))[1] - np.linalg.slogdet(12.0 * np.eye(2))[1]
    assert e.growth[0] == pytest.approx(grown, rel=1e-8)  # both ranges are ±50 %: a prior of 12


def test_a_plant_may_bring_its_own_sensitivities() -> None:
    inputs, parameters = np.sin(np.arange(40.0)), np.array([3.0, 1.5])
    own = informed(dataclasses.replace(DECAY, sensitivity=own_sensitivity), parameters, inputs)
    np.testing.assert_allclose(own.s, informed(DECAY, parameters, inputs).s, rtol=1e-8)


def test_an_output_that_depends_on_a_parameter_tells_of_it() -> None:
    plant = dataclasses.replace(DECAY, observe=square_of)
    inputs, parameters = np.cos(np.arange(40.0)), np.array([3.0, 1.5])
    np.testing.assert_allclose(
        informed(plant, parameters, inputs).information[0], differenced(plant, parameters, inputs), rtol=1e-6
    )


def differenced(plant: Plant, parameters: Floats, inputs: Floats) -> Floats:
    """The FIM from central differences of whole simulations in plain Python."""

    def outputs(p: Floats) -> Floats:
        x, y, rows = np.zeros(len(plant.states)), np.zeros(len(plant.outputs)), []
        for u in inputs.tolist():
            after = np.zeros_like(x)
            plant.step(p, x, u, plant.sample_time, after)
            x = after
            plant.observe(p, x, y)
            rows.append(y / [o.deviation for o in plant.outputs])
        return np.concatenate(rows)

    slopes = []
    for j in plant.unknown:
        moved = [parameters.copy(), parameters.copy()]
        moved[0][j] *= 1.0 + 1e-5
        moved[1][j] *= 1.0 - 1e-5
        slopes.append((outputs(moved[0]) - outputs(moved[1])) / 2e-5)
    return np.array(slopes) @ np.array(slopes).T


def test_the_information_of_the_motor_is_that_of_finite_differences_of_whole_experiments() -> None:
    rng = np.random.default_rng(3)
    inputs, parameters = np.repeat(rng.uniform(-3.0, 3.0, 20), 10), MOTOR.middle * rng.uniform(0.9, 1.1, 5)
    e = informed(MOTOR, parameters, inputs)
    np.testing.assert_allclose(e.information[0], differenced(MOTOR, parameters, inputs), rtol=1e-5)


def test_an_experiment_that_leaves_its_limits_ends_and_gives_back_what_it_had() -> None:
    env = PlantVectorEnv(MOTOR, 2, scale=1.0)
    env.reset([0, 1])
    gathered = np.zeros(2)
    ended = np.zeros(2, np.bool_)
    while not ended[0]:  # full voltage in row 0: the current is soon beyond 5 A
        rewards, ended, left = env.step(np.array([1.0, 0.1], np.float32))
        gathered += rewards
    assert left.tolist() == [True, False]
    assert gathered[0] == pytest.approx(0.0, abs=1e-9)
    assert gathered[1] > 0.0


def test_equal_seeds_give_equal_experiments_and_others_do_not() -> None:
    def seen(seed: int) -> NDArray[np.float32]:
        e = Experiments(MOTOR, 1)
        e.begin(0, np.random.default_rng(seed))
        for _ in range(5):
            e.advance(np.array([1.0]))
        return e.seen()

    np.testing.assert_array_equal(seen(0), seen(0))
    assert (seen(0) != seen(1)).any()


def test_the_critic_sees_scales_of_order_one_and_an_input_beyond_the_limit_is_clipped() -> None:
    e = Experiments(MOTOR, 8)
    for i in range(8):
        e.begin(i, np.random.default_rng(i))
    for _ in range(MOTOR.horizon):
        e.advance(np.full(8, 2.5))
    assert np.abs(e.everything()).max() < 5.0
    x = np.zeros(1)
    decay(np.array([4.0, 2.0]), np.zeros(1), 3.0, DECAY.sample_time, x)
    assert informed(DECAY, np.array([4.0, 2.0]), np.array([99.0])).x[0, 0] == pytest.approx(x[0])
    assert informed(DECAY, np.array([4.0, 2.0]), np.array([math.nan])).x[0, 0] == 0.0


def test_an_experiment_that_is_over_is_not_continued() -> None:
    e = informed(DECAY, DECAY.middle, np.zeros(40))
    with pytest.raises(UsageError, match="is over or was not begun"):
        e.advance(np.zeros(1))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sample_time": 0.0}, "positive numbers"),
        ({"outputs": ()}, "states and outputs"),
        ({"parameters": (Parameter("a", "", 1.0, 1.0),)}, "at least one parameter that varies"),
        ({"parameters": (Parameter("a", "", 2.0, 1.0),)}, "a: expected a range, got 2 to 1"),
        ({"outputs": (Output("x", "", 0.1, math.nan, 1.0),)}, "x: expected a range"),
    ],
)
def test_a_plant_that_cannot_be_simulated_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        dataclasses.replace(DECAY, **changes)


def test_a_function_that_numba_does_not_understand_is_said_in_a_line() -> None:
    def strange(p: Floats, x: Floats, out: Floats) -> None:
        out[0] = json.loads("1")

    with pytest.raises(UsageError, match="decay: numba does not understand"):
        Experiments(dataclasses.replace(DECAY, observe=strange), 1)


TINY = PpoConfig(
    total_steps=30 * 16 * DECAY.horizon,
    envs=16,
    rollout=DECAY.horizon,
    minibatch=320,
    hidden=(8,),
    learning_rate=1e-2,
    initial_deviation=0.2,
)


def test_training_tells_more_than_it_did_before_and_is_the_same_again() -> None:
    returns: list[float] = []
    actor = learn(DECAY, TINY, 0, lambda metrics: returns.append(metrics.mean_return))
    assert np.mean(returns[-3:]) > np.mean(returns[:3]) + 0.05
    again = learn(DECAY, TINY, 0)
    for a, b in zip(actor.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_rollout_is_what_the_experiments_give_for_the_parts_of_the_limit_that_are_asked_for() -> None:
    actor = Actor(load_bench(), (4,), 0.8, 0.5, 2)
    envs = [PlantVectorEnv(DECAY, 3) for _ in range(2)]
    rollout = envs[0].collect(actor, 10, 0.0, [0, 1, 2], torch.Generator().manual_seed(0), 1)
    envs[1].reset([0, 1, 2])
    for t in range(10):
        u = rollout.actions[t, :, 0]
        rewards, _, _ = envs[1].step(u.clamp(-1.0, 1.0).numpy())
        np.testing.assert_array_equal(rewards.astype(np.float32), rollout.rewards[t].numpy())


@pytest.mark.slow
def test_the_example_trains_exports_and_says_what_its_file_is_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "motor.onnx"
    monkeypatch.setattr(EXAMPLE, "TRAINING", dataclasses.replace(EXAMPLE.TRAINING, envs=16, minibatch=3200))
    monkeypatch.setattr(sys, "argv", ["dc_motor.py", "--out", str(out), "--steps", "1"])
    EXAMPLE.main()
    said = capsys.readouterr().out
    assert "trained actor" in said
    assert next(x for x in said.splitlines() if x.startswith("constant 12 V")).endswith("200/200")
    document = json.loads({p.key: p.value for p in onnx.load(out).metadata_props}[KEY])
    assert (document["plant"], document["horizon"]) == ("dc motor", 200)
    assert [s["name"] for s in document["observation"]] == ["current", "speed", "step"]
    assert document["action"] == {"name": "voltage", "unit": "V", "limit": 12.0}
    session = ort.InferenceSession(out, providers=["CPUExecutionProvider"])
    for vector in document["vectors"]:
        seen = np.array([vector["observation"]], np.float32)
        got = session.run([OUTPUT_NAME], {INPUT_NAME: seen})[0]
        assert got.item() == pytest.approx(vector["action"], abs=1e-4)


def test_a_network_that_is_not_what_was_exported_is_refused() -> None:
    actor = learn(DECAY, dataclasses.replace(TINY, total_steps=1), 0)

    class Moody(DeployedActor):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return super().forward(observation) + float(len(observation) > 1)

    with pytest.raises(PolicyRefusedError, match="differs from the network"):
        export_actor(DECAY, Moody(actor.actor, DECAY.input_limit))


def test_playing_counts_what_leaves_the_limits_and_what_was_told_until_then() -> None:
    quiet = play(MOTOR, lambda seen: np.full(len(seen), 0.5), 5, 0)
    wild = play(MOTOR, lambda seen: np.full(len(seen), 12.0), 5, 0)
    assert not quiet.left.any()
    assert wild.left.all()
    actor = learn(DECAY, dataclasses.replace(TINY, total_steps=1), 0)
    assert (play(DECAY, controlled_by(actor), 3, 0).growth > 0.0).all()
