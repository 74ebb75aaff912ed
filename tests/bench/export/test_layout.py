"""The layout for viewers, against a log that was just recorded."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2
from mcap.reader import make_reader

from emb_runtime.cli.main import main as emb_run

PATH = re.compile(r"(/[\w/]+)(?:\.(\w+))?")


@pytest.fixture(scope="module")
def schemas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, dict[str, int]]]:
    """Schema and fields (with their protobuf types) by topic, of a fresh log, by a reader that is not ours."""
    log = tmp_path_factory.mktemp("layout") / "run.mcap"
    assert emb_run(["--iface", "sim", "--log", str(log)]) == 0
    found = {}
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            (message,) = [
                message
                for entry in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
                for message in entry.message_type
                if f"{entry.package}.{message.name}" == schema.name
            ]
            found[channel.topic] = (schema.name, {field.name: int(field.type) for field in message.field})
    return found


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(Path("docs/reference/viewer-layout.json").read_text(encoding="utf-8"))
    return document


def panels(layout: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [config for name, config in layout["configById"].items() if name.partition("!")[0] == kind]


def script_fields(layout: dict[str, Any]) -> dict[str, set[str]]:
    """What the scripts in the layout publish, by topic."""
    published = {}
    for node in layout["userNodes"].values():
        code = node["sourceCode"]
        output = re.search(r'export const output = "(/studio_script/\w+)"', code)
        names = re.search(r"type Output = \{([^}]*)\}", code)
        assert output is not None
        assert names is not None
        published[output[1]] = set(re.findall(r"(\w+):", names[1]))
    return published


def test_every_topic_and_field_of_the_layout_is_in_a_fresh_log(
    layout: dict[str, Any], schemas: dict[str, tuple[str, dict[str, int]]]
) -> None:
    known = {topic: set(fields) for topic, (_, fields) in schemas.items()} | script_fields(layout)
    named = [
        path["value"] for kind in ("Plot", "StateTransitions") for p in panels(layout, kind) for path in p["paths"]
    ]
    named += [panel["topicPath"] for panel in panels(layout, "RawMessages")]
    assert len(named) > 10
    for path in named:
        match = PATH.fullmatch(path)
        assert match is not None, path
        topic, field = match.groups()
        assert topic in known, path
        assert field is None or field in known[topic], path


def test_curves_and_states_are_drawn_over_when_they_happened_not_over_when_they_were_written(
    layout: dict[str, Any],
) -> None:
    paths = [path for kind in ("Plot", "StateTransitions") for panel in panels(layout, kind) for path in panel["paths"]]
    for path in paths:  # of what a script computes the viewers know no other time
        expected = "receiveTime" if path["value"].startswith("/studio_script/") else "publishTime"
        assert path["timestampMethod"] == expected


def test_the_panels_can_show_what_they_are_given(
    layout: dict[str, Any], schemas: dict[str, tuple[str, dict[str, int]]]
) -> None:
    of_field = descriptor_pb2.FieldDescriptorProto
    texts = (of_field.TYPE_STRING, of_field.TYPE_BYTES, of_field.TYPE_MESSAGE)
    for panel in panels(layout, "Plot"):
        for path in panel["paths"]:
            topic, _, field = path["value"].rpartition(".")
            if topic in schemas:
                assert schemas[topic][1][field] not in texts
    states = [path["value"] for panel in panels(layout, "StateTransitions") for path in panel["paths"]]
    for path in ("/cycle.state", "/cycle.node_state"):  # shown by name
        assert path in states
        assert schemas["/cycle"][1][path.rpartition(".")[2]] == of_field.TYPE_ENUM
    assert {panel["topicPath"] for panel in panels(layout, "RawMessages")} == {"/safety", "/cycle"}
