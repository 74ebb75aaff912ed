"""The topics of a log and their messages, which ``emb.proto`` describes, for the recorder and for readers."""

from __future__ import annotations

import json
import re
from functools import cache
from importlib import resources
from typing import Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from emb_runtime.log import ring_buffer

_COMPILED: Final = resources.files("emb_runtime.log").joinpath("emb.binpb").read_bytes()
_FILE: Final = descriptor_pb2.FileDescriptorSet.FromString(_COMPILED).file[0]
_POOL: Final = descriptor_pool.DescriptorPool()
_POOL.Add(_FILE)
_COMMENTS: Final = {
    tuple(place.path): (place.leading_comments + place.trailing_comments).strip()
    for place in _FILE.source_code_info.location
    if place.leading_comments or place.trailing_comments
}
"""Comments by the path of the described element: (4, i) for message i, (4, i, 2, j) for its field j."""

TOPICS: Final = {
    **dict(ring_buffer.TOPICS.values()),
    "/can/tx": "CanFrame",
    "/drive/rx": "CanFrame",
    **{f"/emb/{message.name}": message.name for message in _FILE.message_type if message.name.startswith("EMB_")},
}
"""Message of each topic."""


@cache
def message_class(message: str) -> Any:
    """The class of a message."""
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"emb.{message}"))


def schema(message: str) -> bytes:
    """A message and the enumerations as a serialised FileDescriptorSet, so that any reader can decode the log."""
    file = descriptor_pb2.FileDescriptorProto(name=f"emb/{message}.proto", package="emb", syntax="proto3")
    file.message_type.extend(m for m in _FILE.message_type if m.name == message or m.enum_type)
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


@cache
def metadata(message: str) -> dict[str, str]:
    """Metadata of a channel: the message's description, units of its fields as JSON, and the meaning of each field."""
    i = [found.name for found in _FILE.message_type].index(message)
    notes, units = {"description": _COMMENTS.get((4, i), "")}, {}
    for j, field in enumerate(_FILE.message_type[i].field):
        text = _COMMENTS.get((4, i, 2, j), "")
        if unit := re.match(r"\[(.+?)\] ?", text):
            units[field.name] = unit[1]
            text = text.removeprefix(unit[0])
        notes[field.name] = text
    notes["units"] = json.dumps(units, ensure_ascii=False) if units else ""
    return {key: text for key, text in notes.items() if text}
