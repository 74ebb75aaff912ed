"""What every exported file is: an ONNX graph of one opset, with its contract in the metadata. Needs no torch."""

from __future__ import annotations

import onnx

from emb_runtime.contract import CONTRACT_KEY, MIN_VECTORS, Contract

OPSET = 20
"""Of the default domain: old enough for ONNX Runtime 1.20, the oldest that the runtime allows."""

VECTORS = 2 * MIN_VECTORS
"""Test vectors in a contract."""


def add_contract(model: onnx.ModelProto, contract: Contract) -> bytes:
    """The finished file: the graph with its contract, the same bytes for the same actor."""
    onnx.helper.set_model_props(model, {CONTRACT_KEY: contract.to_json()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))
