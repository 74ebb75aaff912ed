"""Excitation of a step as a policy file: a sequence of currents within a window of angle and speed.

Written without the ``onnx`` package, which a bench computer does not have; what is written is checked by
:func:`emb_runtime.policy.policy.load_policy` as any other file.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from emb_runtime.commission.records import Step
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.policy.contract import ACTION, CONTRACT_KEY, MIN_VECTORS, OBSERVATION, Contract, Vector
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME

OPSET = 20  # Of the default domain, as of the exported actors
IR_VERSION = 10
_FLOAT, _INT64 = 1, 7  # TensorProto.DataType
_ATTRIBUTE_INT = 2  # AttributeProto.AttributeType


def policy_file(step: Step, bench: Bench) -> bytes:
    """The policy of a step: its current, but none that drives the brake farther out of the window.

    Args:
        step: currents and window.
        bench: that it is for.
    """
    wanted = [_single(value) for value in step.currents or (0.0,)]
    model = _number(1, IR_VERSION) + _part(7, _graph(wanted, step, _single(bench.limits.current)))
    model += _part(8, _text(1, "") + _number(2, OPSET))
    return model + _part(14, _text(1, CONTRACT_KEY) + _text(2, _contract(wanted, step, bench).to_json()))


def _contract(wanted: Sequence[float], step: Step, bench: Bench) -> Contract:
    places = [k * (len(wanted) - 1) // (MIN_VECTORS - 1) for k in range(MIN_VECTORS)]
    return Contract(
        observation=OBSERVATION,
        action=ACTION,
        action_limit=bench.limits.current,
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        bench_hash=bench.contract_hash,
        ranges={name: (getattr(bench.brake, name), getattr(bench.brake, name)) for name in PARAMETER_NAMES},
        sequences=tuple((Vector((0.0, 0.0, float(k)), wanted[k]),) for k in places),
        provenance={"commissioning": step.name},
    )


def _graph(wanted: Sequence[float], step: Step, limit: float) -> bytes:
    """The current of the step, cut to zero on the side that leads out of the window."""
    window = step.window
    nodes = [
        _node("Gather", [INPUT_NAME, "first"], "angle", axis=1),
        _node("Gather", [INPUT_NAME, "second"], "velocity", axis=1),
        _node("Gather", [INPUT_NAME, "third"], "step", axis=1),
        _node("Round", ["step"], "whole"),
        _node("Cast", ["whole"], "number", to=_INT64),
        _node("Clip", ["number", "zeroth_place", "last_place"], "place"),
        _node("Gather", ["currents", "place"], "wanted", axis=0),
        _node("Greater", ["angle", "highest"], "above"),
        _node("Greater", ["velocity", "fastest_up"], "fast_up"),
        _node("Or", ["above", "fast_up"], "no_more_up"),
        _node("Where", ["no_more_up", "zero", "most"], "upper"),
        _node("Less", ["angle", "lowest"], "below"),
        _node("Less", ["velocity", "fastest_down"], "fast_down"),
        _node("Or", ["below", "fast_down"], "no_more_down"),
        _node("Where", ["no_more_down", "zero", "least"], "lower"),
        _node("Max", ["wanted", "lower"], "raised"),
        _node("Min", ["raised", "upper"], OUTPUT_NAME),
    ]
    floats = {
        "highest": window.highest,
        "lowest": window.lowest,
        "fastest_up": window.speed,
        "fastest_down": -window.speed,
        "zero": 0.0,
        "most": limit,
        "least": -limit,
    }
    constants = [_tensor(name, [value]) for name, value in floats.items()]
    constants += [_tensor("currents", wanted)]
    constants += [_whole(name, place, [1]) for name, place in (("first", 0), ("second", 1), ("third", 2))]
    constants += [_whole("zeroth_place", 0, []), _whole("last_place", len(wanted) - 1, [])]
    ports = _part(11, _port(INPUT_NAME, len(OBSERVATION))) + _part(12, _port(OUTPUT_NAME, 1))
    return (
        b"".join(_part(1, node) for node in nodes)
        + _text(2, "commissioning")
        + b"".join(_part(5, constant) for constant in constants)
        + ports
    )


# --- the part of onnx.proto3 that is written: messages of protobuf, field by field ----------------------------------


def _single(value: float) -> float:
    """The nearest number of single precision."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _part(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _text(field: int, text: str) -> bytes:
    return _part(field, text.encode())


def _node(operator: str, inputs: Sequence[str], output: str, **attributes: int) -> bytes:
    data = b"".join(_text(1, name) for name in inputs) + _text(2, output) + _text(4, operator)
    for name, value in attributes.items():
        data += _part(5, _text(1, name) + _number(3, value) + _number(20, _ATTRIBUTE_INT))
    return data


def _tensor(name: str, values: Sequence[float]) -> bytes:
    data = struct.pack(f"<{len(values)}f", *values)
    return _number(1, len(values)) + _number(2, _FLOAT) + _text(8, name) + _part(9, data)


def _whole(name: str, value: int, shape: Sequence[int]) -> bytes:
    sizes = b"".join(_number(1, size) for size in shape)
    return sizes + _number(2, _INT64) + _text(8, name) + _part(9, struct.pack("<q", value))


def _port(name: str, width: int) -> bytes:
    """A tensor of single precision and shape (1, width)."""
    sizes = b"".join(_part(1, _number(1, size)) for size in (1, width))
    return _text(1, name) + _part(2, _part(1, _number(1, _FLOAT) + _part(2, sizes)))
