"""A trained actor as an ONNX graph, and its contract with its test vectors."""

from __future__ import annotations

import io
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_export.file import OPSET, VECTORS, contract_for
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import OBSERVATION, Contract, Vector
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_train.ppo.networks import DeployedActor

Floats = NDArray[np.float32]


def export_graph(actor: DeployedActor) -> onnx.ModelProto:
    """The graph of an actor, for one observation at a time, without anything of the machine that exported it."""
    return graph_of(actor, (torch.zeros(1, len(OBSERVATION)),), [INPUT_NAME], [OUTPUT_NAME])


def graph_of(module: nn.Module, examples: tuple[Tensor, ...], inputs: list[str], outputs: list[str]) -> onnx.ModelProto:
    """The graph of a module.

    Args:
        module: whatever torch can trace.
        examples: of its arguments; their shapes are those of the graph.
        inputs: names of its arguments.
        outputs: names of what it returns.
    """
    with _quiet(), tempfile.TemporaryDirectory() as folder:
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
        path = Path(folder) / "actor.onnx"
        program.save(path, external_data=False)
        model = onnx.load(path)
    _strip(model)
    onnx.checker.check_model(model, full_check=True)
    return model


def make_contract(
    actor: DeployedActor,
    bench: Bench,
    ranges: Ranges,
    observations: Floats,
    provenance: Mapping[str, str | int | float],
) -> Contract:
    """The contract of an actor for a bench.

    Args:
        actor: the trained network, which answers the test vectors.
        bench: what it was trained for.
        ranges: the brakes it was trained on.
        observations: shape [M, 3]; some of them, spread over all, become test vectors.
        provenance: how it came to be.

    Raises:
        PolicyRefusedError: an answer of the network is not finite.
    """
    return contract_for(bench, ranges.low, ranges.high, _vectors(actor, observations), provenance)


def _vectors(actor: DeployedActor, observations: Floats) -> tuple[tuple[Vector], ...]:
    """Some of the observations, with the network's answers; each stands for itself."""
    chosen = observations[np.linspace(0, len(observations) - 1, VECTORS).astype(int)]
    with torch.no_grad():
        answers = actor(torch.from_numpy(chosen))[:, 0]
    if not bool(torch.isfinite(answers).all()):
        raise PolicyRefusedError("the trained network's answers are not finite: there is nothing to export")
    rows = zip(chosen.tolist(), answers.tolist(), strict=True)
    return tuple((Vector(tuple(row), action),) for row, action in rows)


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


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's chatter, which a user can do nothing about; its errors are raised."""
    names = ("torch.onnx", "onnxscript", "onnx_ir")
    before = [logging.getLogger(name).level for name in names]
    try:
        for name in names:
            logging.getLogger(name).setLevel(logging.ERROR)
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for name, level in zip(names, before, strict=True):
            logging.getLogger(name).setLevel(level)
