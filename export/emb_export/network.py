"""The actor of a training as a policy file, by torch's exporter."""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import nn

from emb_bench.config.bench import Bench
from emb_bench.export.policy_file import OPSET, policy_file, versions
from emb_export.file import bounds
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import SAMPLE
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_train.closed_loop import EVERYTHING
from emb_train.ppo import DeployedActor
from emb_train.training import load_training

OBSERVATIONS = 2000


def network_file(directory: Path) -> tuple[bytes, str]:
    """The file of a training, and its origin in words.

    Raises:
        UsageError: the directory holds no usable training.
        PolicyRefusedError: the network's answers are not finite, or the file would differ from it.
    """
    trained = load_training(directory)
    training, bench = trained.training, trained.bench
    if training.conditions.observes == EVERYTHING:
        raise UsageError(f"{directory}: observes the parameters and the information, which no bench measures")
    torch.set_num_threads(1)
    actor = DeployedActor(trained.actor, bench.limits.current, bench.timing.sample_time).eval()
    seen = observations(bench)
    with torch.no_grad():
        wanted = actor(torch.from_numpy(seen)).numpy().astype(np.float64)
    if not np.isfinite(wanted).all():
        raise PolicyRefusedError("the trained network's answers are not finite: there is nothing to export")
    parts = json.loads(msgspec.json.encode(training))
    provenance = {
        **{k: json.dumps(v, separators=(",", ":")) if isinstance(v, dict | list) else v for k, v in parts.items()},
        "steps": trained.iteration * training.ppo.batch,
        "score": trained.score,
        **versions("torch", "onnxscript"),
    }
    ranges = bench.range_set(training.ranges)
    fields = {"kind": "current", "inputs": SAMPLE, "ranges": bounds(ranges)}
    data = policy_file(_graph(actor), bench, seen, wanted, provenance, **fields)
    score = f"iteration {trained.iteration} of {training.ppo.iterations}, which returned {trained.score:.6g}"
    return data, f"the trained network, of {score} on brakes that no training draws"


def observations(bench: Bench) -> NDArray[np.float32]:
    """Inputs all over the limits, beyond them, and near the origin, shape [OBSERVATIONS, 3]."""
    rng = np.random.default_rng(0)
    low, high = bench.limits.angle
    reach = np.array([2.0 * (high - low), 3.0 * bench.limits.velocity]) * 10.0 ** -rng.uniform(
        0.0, 4.0, (OBSERVATIONS, 1)
    )
    time = rng.integers(0, bench.timing.horizon, (OBSERVATIONS, 1)) * bench.timing.sample_time
    return np.hstack([rng.uniform(-reach, reach), time]).astype(np.float32)


def _graph(module: nn.Module) -> onnx.ModelProto:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # its chatter is nothing that a user can act on
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's, about itself
        program = torch.onnx.export(
            module,
            (torch.zeros(1, len(SAMPLE)),),
            dynamo=True,
            opset_version=OPSET,
            input_names=[INPUT_NAME],
            output_names=[OUTPUT_NAME],
            verbose=False,
        )
    assert program is not None  # it is None only for the old exporter
    model: onnx.ModelProto = program.model_proto
    graph = model.graph
    del graph.value_info[:]
    parts: list[Any] = [model, graph, *graph.node, *graph.initializer, *graph.input, *graph.output]
    for part in parts:  # stack traces, with paths of this machine
        part.doc_string = ""
        del part.metadata_props[:]
    return model
