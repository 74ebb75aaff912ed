"""The actor of a training as a policy file, by torch's exporter."""

from __future__ import annotations

import copy
import json
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.export.own_policy import finished
from emb_bench.export.policy_file import versions
from emb_bench.export.torch_policy import torch_graph
from emb_bench.information.symmetric import Floats
from emb_runtime.policy.contract import greatest_output
from emb_train.play import bounds
from emb_train.ppo import DeployedActor
from emb_train.training import Trained, Training


def network_file(trained: Trained, training: Training, bench: Bench) -> tuple[bytes, str]:
    """The policy file of a trained actor with the observations of a bench, and its origin in words.

    Raises:
        PolicyRefusedError: the network's answers are not finite, or the file would differ from it.
    """
    kind, width = training.conditions.acts, training.conditions.observation_size(len(training.parameters))
    actor = DeployedActor(trained.actor, greatest_output(kind, bench.limits), bench.timing.sample_time).eval()

    exact = copy.deepcopy(actor).double()  # the file's answers have to be met on other computers, however they round

    def answers(seen: NDArray[np.float32]) -> Floats:
        with torch.no_grad():
            found: Floats = exact(torch.from_numpy(seen).double()).numpy()
        return found

    parts = json.loads(msgspec.json.encode(training))
    provenance = {
        **{name: text_of(value) for name, value in parts.items() if value is not None},
        "steps": trained.iteration * training.ppo.batch,
        "score": trained.score,
        "bench": bench.identity_hash,
        **versions("torch", "onnxscript"),
    }
    ranges = bench.range_set(training.ranges)
    score = f"iteration {trained.iteration} of {training.ppo.iterations}, which returned {trained.score:.6g}"
    what = f"the trained network, of {score} on brakes that no training draws"
    fields = {"ranges": bounds(ranges), "gain": training.conditions.gain}
    return finished(torch_graph(actor, width), bench, provenance, what, answers, kind, **fields)


def text_of(value: Any) -> Any:
    """A value as a provenance has it: a table or a list as JSON."""
    return json.dumps(value, separators=(",", ":")) if isinstance(value, dict | list) else value
