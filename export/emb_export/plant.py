"""The actor of a plant that is no brake as one ONNX file that describes its use.

It has no contract, for the runtime drives brakes; under its own key its metadata say as much: signals with their units,
limit, timing, ranges, and test vectors.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray

from emb_export.network import graph_of
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import VECTOR_TOLERANCE
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_train.plants.interface import Plant
from emb_train.ppo.networks import DeployedActor

KEY = "emb.plant"
VECTORS = 64


def export_actor(plant: Plant, actor: DeployedActor) -> bytes:
    """The file of a trained actor.

    Raises:
        PolicyRefusedError: the file's answers differ from the network's.
    """
    low, high = np.array([*((o.low, o.high) for o in plant.outputs), (0.0, plant.horizon)]).T
    observations = np.random.default_rng(0).uniform(low, high, (VECTORS, len(low))).astype(np.float32)
    with torch.no_grad():
        inputs = actor(torch.from_numpy(observations))[:, 0].numpy()
    model = graph_of(actor, (torch.zeros(1, len(low)),), [INPUT_NAME], [OUTPUT_NAME])
    onnx.helper.set_model_props(model, {KEY: json.dumps(metadata(plant, observations, inputs), allow_nan=False)})
    data = bytes(model.SerializeToString(deterministic=True))
    session = ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    said = [session.run([OUTPUT_NAME], {INPUT_NAME: row[None]})[0].item() for row in observations]
    if not np.abs(np.array(said) - inputs).max() <= VECTOR_TOLERANCE * plant.input_limit:
        raise PolicyRefusedError(f"{plant.name}: the exported graph differs from the network: nothing is written")
    return data


def metadata(plant: Plant, observations: NDArray[np.float32], inputs: NDArray[np.float32]) -> dict[str, Any]:
    """Metadata of the file.

    Args:
        plant: what it is for.
        observations: of the test vectors, shape [M, o + 1].
        inputs: the network's answers, shape [M].
    """
    seen = [*(o._asdict() for o in plant.outputs), {"name": "step", "unit": "1", "low": 0, "high": plant.horizon}]
    return {
        "schema": 1,
        "plant": plant.name,
        "observation": seen,
        "action": {"name": plant.input, "unit": plant.input_unit, "limit": plant.input_limit},
        "sample_time": plant.sample_time,
        "horizon": plant.horizon,
        "parameters": [p._asdict() for p in plant.parameters],
        "vectors": [
            {"observation": row, "action": answer}
            for row, answer in zip(observations.tolist(), inputs.tolist(), strict=True)
        ],
    }
