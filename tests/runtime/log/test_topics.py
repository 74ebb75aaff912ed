"""The messages of a log's topics against what is written into them, and against ``emb.proto``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor

from emb_runtime.estimator.estimate import UNITS
from emb_runtime.log import ring_buffer, topics
from emb_runtime.records import Call, CycleRecord, NodeState, Reason, RunState
from tests.independent import DATABASE
from tools.compile_proto import SOURCES, compile_proto


def fields(message: str) -> dict[str, Any]:
    return dict(topics.message_class(message).DESCRIPTOR.fields_by_name)


def units(message: str) -> dict[str, str]:
    return dict(json.loads(topics.metadata(message).get("units", "{}")))


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_the_compiled_messages_are_those_of_the_proto_file(source: Path, tmp_path: Path) -> None:
    assert compile_proto(source, tmp_path / "it.binpb") == 0
    assert (tmp_path / "it.binpb").read_bytes() == source.with_suffix(".binpb").read_bytes()


def test_every_field_has_presence_and_no_number_was_left_out() -> None:
    for message in topics.TOPICS.values():
        assert all(field.has_presence for field in fields(message).values())
        assert [field.number for field in fields(message).values()] == list(range(1, len(fields(message)) + 1))


def test_a_cycle_has_the_fields_of_its_record() -> None:
    assert tuple(fields("Cycle")) == CycleRecord._fields
    for name, enum in (("state", RunState), ("node_state", NodeState)):
        values = fields("Cycle")[name].enum_type.values
        assert {value.name: value.number for value in values} == {e.name: e.value for e in enum}
    said = topics.metadata("Cycle")["reasons"]
    assert said == "bits: " + ", ".join(f"{int(bit)} {bit.name}" for bit in Reason if bit)


def test_the_other_records_have_as_many_values_as_their_messages_have_fields() -> None:
    assert tuple(fields("ClockSample")) == ring_buffer.ClockRecord._fields
    assert tuple(fields("SafetyEvent")) == ring_buffer.EventRecord._fields[1:]
    assert tuple(fields("Input")) == ring_buffer.InputRecord._fields[1:]
    calls = fields("Input")["call"].enum_type.values
    assert {value.name: value.number for value in calls} == {call.name: call.value for call in Call}
    assert tuple(fields("Estimate")) == ("step", *UNITS, *(f"{name}_deviation" for name in UNITS))
    assert units("Estimate") == {**UNITS, **{f"{name}_deviation": unit for name, unit in UNITS.items()}}


def test_the_decoded_frames_have_the_signals_of_the_dbc() -> None:
    assert {name for name in topics.TOPICS.values() if name.startswith("EMB_")} == {m.name for m in DATABASE.messages}
    for message in DATABASE.messages:
        signals = {signal.name: signal for signal in message.signals}
        found = fields(message.name)
        assert list(found) == sorted(signals, key=lambda name: signals[name].start)
        assert units(message.name) == {name: signal.unit for name, signal in signals.items() if signal.unit}
        for name, signal in signals.items():
            if found[name].enum_type:
                values = {value.number: value.name for value in found[name].enum_type.values}
                assert values == {number: str(text).upper() for number, text in signal.choices.items()}
            else:
                whole = FieldDescriptor.TYPE_INT64 if signal.scale == 1 else FieldDescriptor.TYPE_DOUBLE
                assert found[name].type == whole
