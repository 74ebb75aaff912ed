"""A trained network as an ONNX file: its graph, its test vectors, and the proof that the file computes the same."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_export.file import OPSET, VECTORS
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import VECTOR_TOLERANCE, Vector
from emb_runtime.policy.policy import Policy
from emb_train.envs.batch import Batch
from emb_train.envs.excitations import Excitation
from emb_train.envs.network import PLAIN, Network
from emb_train.envs.play import followed
from emb_train.ppo import DeployedActor

Floats = NDArray[np.float32]

EPISODES = 8
RANDOM_OBSERVATIONS = 2000


def graph_of(module: nn.Module, examples: tuple[Tensor, ...], inputs: list[str], outputs: list[str]) -> onnx.ModelProto:
    """The graph of a module."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # its chatter is nothing that a user can act on
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's, about itself
        program = torch.onnx.export(
            module.eval(),
            examples,
            dynamo=True,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
            verbose=False,
        )
    assert program is not None  # it is None only for the old exporter
    model = program.model_proto
    _strip(model)
    onnx.checker.check_model(model, full_check=True)
    return model


def vectors_of(actor: DeployedActor, observations: Floats) -> tuple[tuple[Vector], ...]:
    """Test vectors: some of the observations, shape [M, 3], each with the network's answer.

    Raises:
        PolicyRefusedError: an answer is not finite.
    """
    chosen = observations[np.linspace(0, len(observations) - 1, VECTORS).astype(int)]
    with torch.no_grad():
        answers = actor(torch.from_numpy(chosen))[:, 0]
    if not bool(torch.isfinite(answers).all()):
        raise PolicyRefusedError("the trained network's answers are not finite: there is nothing to export")
    rows = zip(chosen.tolist(), answers.tolist(), strict=True)
    return tuple((Vector(tuple(row), action),) for row, action in rows)


def recorded(excitation: Excitation, bench: Bench, ranges: Ranges, parameters: Sequence[str]) -> Floats:
    """Observations of an excitation in a few experiments on random brakes, shape [horizon, EPISODES, 4]."""
    batch = Batch(bench, ranges, parameters, EPISODES)
    for i in range(EPISODES):
        batch.begin(i, np.random.default_rng(i))
    return np.stack(list(followed(batch, excitation)))


def recorded_observations(actor: DeployedActor, bench: Bench, ranges: Ranges, parameters: tuple[str, ...]) -> Floats:
    """Observations of the actor in a few experiments on random brakes, shape [EPISODES · horizon, 3]."""
    return recorded(Network(actor), bench, ranges, parameters)[:, :, :PLAIN].reshape(-1, PLAIN)


def random_observations(bench: Bench) -> Floats:
    """Observations all over the limits and well beyond them, shape [RANDOM_OBSERVATIONS, 3]."""
    rng = np.random.default_rng(0)
    low, high = bench.limits.angle
    width = high - low
    size = RANDOM_OBSERVATIONS
    return np.stack(
        [
            rng.uniform(low - width, high + width, size),
            rng.uniform(-3.0, 3.0, size) * bench.limits.velocity,
            rng.uniform(0.0, bench.timing.horizon, size),
        ],
        axis=1,
    ).astype(np.float32)


def require_parity(actor: DeployedActor, policy: Policy, observations: Floats) -> float:
    """Compare the network with the file, through the runtime's own policy.

    Returns:
        The largest difference as a part of the current limit.

    Raises:
        PolicyRefusedError: it is above 1e-5, or an answer is not finite.
    """
    with torch.no_grad():
        wanted = actor(torch.from_numpy(observations))[:, 0].numpy().astype(np.float64)
    got = np.array([policy.act(float(a), float(v), float(k), 0.0) for a, v, k in observations])
    worst = float(np.max(np.abs(got - wanted))) / actor.limit
    if not worst <= VECTOR_TOLERANCE:  # written so that NaN fails
        raise PolicyRefusedError(
            f"the exported graph differs from the trained network by {worst:.3g} of the limit, at most "
            f"{VECTOR_TOLERANCE:g} is allowed: nothing was written"
        )
    return worst


def _strip(model: onnx.ModelProto) -> None:
    """Remove what the exporter notes down beside the graph: stack traces, with paths of this machine."""
    model.doc_string = ""
    del model.metadata_props[:]
    graph = model.graph
    graph.doc_string = ""
    del graph.metadata_props[:]
    del graph.value_info[:]
    parts: list[Any] = [*graph.node, *graph.initializer, *graph.input, *graph.output]
    for part in parts:
        part.doc_string = ""
        del part.metadata_props[:]
