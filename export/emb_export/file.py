"""Exported files: an ONNX graph of one opset with its contract in the metadata; and the simplest one, a sequence.

A sequence of currents, a reference excitation or an optimal design, answers the step of the experiment and nothing
else. So it runs where a trained actor does, behind the same clip, shield and guard, and its log carries it. Needs no
torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from emb_bench.brake.motion import Floats
from emb_bench.excitation.reference import parse_excitation
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.policy.contract import (
    ACTION,
    CONTRACT_KEY,
    MIN_VECTORS,
    OBSERVATION,
    VECTOR_TOLERANCE,
    Contract,
    Vector,
)
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_runtime.policy.policy import load_policy

OPSET = 20  # Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows

IR_VERSION = 10  # Of the file format: the one that goes with the opset

VECTORS = 2 * MIN_VECTORS  # Test vectors in a contract


def contract_for(
    bench: Bench,
    low: BrakeParameters,
    high: BrakeParameters,
    sequences: tuple[tuple[Vector, ...], ...],
    provenance: Mapping[str, str | int | float],
    observation: tuple[Quantity, ...] = OBSERVATION,
    initial_state: tuple[float, ...] = (),
    estimates: tuple[Quantity, ...] = (),
) -> Contract:
    """The contract of a file that is to drive a bench.

    Args:
        bench: sample time, horizon and limit.
        low: smallest parameters of the brakes that it is for.
        high: largest ones.
        sequences: its answers, each from the initial state.
        provenance: its origin.
        observation: its inputs.
        initial_state: its state before the first sample.
        estimates: the quantities that it estimates.
    """
    return Contract(
        observation=observation,
        action=ACTION,
        action_limit=bench.limits.current,
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        bench_hash=bench.contract_hash,
        ranges={name: (getattr(low, name), getattr(high, name)) for name in PARAMETER_NAMES},
        sequences=sequences,
        initial_state=initial_state,
        estimates=estimates,
        provenance=provenance,
    )


def add_contract(model: onnx.ModelProto, contract: Contract) -> bytes:
    """The finished file: the graph with its contract, the same bytes for the same actor."""
    onnx.helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def read_sequence(text: str, bench: Bench) -> tuple[Floats, str]:
    """The currents that a text or a file names [A], shape (horizon,), and what they are in words.

    Args:
        text: as :func:`emb_bench.excitation.reference.parse_excitation` reads it, or a file of ``emb-design -o``,
        ``.npz``.
        bench: its sample time, horizon and limits.

    Raises:
        UsageError: there is no such excitation or file, it is for another bench, or it is a feedback law.
    """
    if Path(text).suffix == ".npz":
        from emb_bench.design.report import read_design  # scipy takes its time

        return read_design(Path(text), bench)
    excited = parse_excitation(text, bench)
    if excited.currents is None:
        raise UsageError(f"{excited.name} is a feedback law: expected an excitation that is a sequence of currents")
    return excited.currents, excited.text


def export_sequence(currents: Floats, what: str, bench: Bench) -> bytes:
    """The file's bytes, checked as the runtime will check them.

    Args:
        currents: shape (horizon,) [A].
        what: for the provenance.
        bench: that they are for; it does not name the brakes, so the contract names the nominal one.

    Raises:
        PolicyRefusedError: the runtime would refuse it, or its answers differ from the sequence.
    """
    wanted = currents.astype(np.float32)
    data = add_contract(_graph(wanted), _contract(wanted, what, bench))
    policy = load_policy(data, bench)
    said = np.array([policy.act(0.0, 0.0, float(k), 0.0) for k in range(len(wanted))])
    worst = float(np.max(np.abs(said - currents))) / bench.limits.current
    if not worst <= VECTOR_TOLERANCE:  # written so that NaN fails
        raise PolicyRefusedError(f"the exported graph is off the sequence by {worst:.3g} of the limit")
    return data


def _graph(currents: NDArray[np.float32]) -> onnx.ModelProto:
    """Look the step up; before the first and after the last the nearest one."""
    last = np.array(len(currents) - 1)
    constants = {"currents": currents, "step_index": np.array([2]), "first": np.array(0), "last": last}
    nodes = [
        helper.make_node("Gather", [INPUT_NAME, "step_index"], ["step"], axis=1),
        helper.make_node("Round", ["step"], ["whole"]),
        helper.make_node("Cast", ["whole"], ["number"], to=TensorProto.INT64),
        helper.make_node("Clip", ["number", "first", "last"], ["place"]),
        helper.make_node("Gather", ["currents", "place"], [OUTPUT_NAME], axis=0),
    ]
    graph = helper.make_graph(
        nodes,
        "sequence",
        [helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, [1, len(OBSERVATION)])],
        [helper.make_tensor_value_info(OUTPUT_NAME, TensorProto.FLOAT, [1, 1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def _contract(currents: NDArray[np.float32], what: str, bench: Bench) -> Contract:
    steps = np.linspace(0, len(currents) - 1, VECTORS).astype(int).tolist()
    vectors = tuple((Vector((0.0, 0.0, float(k)), float(currents[k])),) for k in steps)
    return contract_for(bench, bench.brake, bench.brake, vectors, {"sequence": what})
