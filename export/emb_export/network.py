"""The actor of a training as a policy file, by torch's exporter."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import torch

from emb_bench.export.own_policy import observations
from emb_bench.export.policy_file import policy_file, versions
from emb_bench.export.torch_policy import torch_graph
from emb_export.file import bounds
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import SAMPLE, greatest_output
from emb_train.closed_loop import EVERYTHING
from emb_train.ppo import DeployedActor
from emb_train.training import load_training


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
    kind = "current"  # of the environment's action
    actor = DeployedActor(trained.actor, greatest_output(kind, bench.limits), bench.timing.sample_time).eval()
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
    fields = {"kind": kind, "inputs": SAMPLE, "ranges": bounds(ranges)}
    data = policy_file(torch_graph(actor, len(SAMPLE)), bench, seen, wanted, provenance, **fields)
    score = f"iteration {trained.iteration} of {training.ppo.iterations}, which returned {trained.score:.6g}"
    return data, f"the trained network, of {score} on brakes that no training draws"
