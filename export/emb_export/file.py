"""The common part of exported files: an ONNX graph of one opset, with its contract in the metadata. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping

import onnx

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.policy.contract import ACTION, CONTRACT_KEY, MIN_VECTORS, OBSERVATION, Contract, Quantity, Vector

OPSET = 20
"""Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows."""

VECTORS = 2 * MIN_VECTORS
"""Test vectors in a contract."""


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
    """The contract of what is to drive a bench.

    Args:
        bench: sample time, horizon and limit.
        low: smallest parameters of the brakes that it is for.
        high: largest ones.
        sequences: what it answers, each from the initial state.
        provenance: how it came to be.
        observation: what it sees.
        initial_state: what it remembers before the first sample.
        estimates: what it estimates.
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
