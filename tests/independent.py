"""Frames without the project's codec: cantools for the signals, the AUTOSAR library for the CRC."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools.database
import e2e.p01

from emb_runtime.records import Frame

Values = dict[str, float]
DATABASE: Any = cantools.database.load_file(Path(__file__).parents[1] / "runtime" / "emb_runtime" / "can" / "emb.dbc")
MESSAGES: dict[int, Any] = {message.frame_id: message for message in DATABASE.messages}


DATA_IDS = {identifier: int(message.dbc.attributes["DataId"].value) for identifier, message in MESSAGES.items()}
"""End-to-end data id of each."""


def protected(identifier: int, body: bytes, *, by: int | None = None) -> bytes:
    """A payload with the CRC byte that its message needs, or that of another data id."""
    return with_crc(DATA_IDS[identifier] if by is None else by, body)


def encoded(identifier: int, values: Values) -> Frame:
    """A protected frame of these values, of every signal but the CRC."""
    return Frame(identifier, protected(identifier, MESSAGES[identifier].encode({**values, "CRC": 0}, strict=True)[1:]))


def with_crc(data_id: int, body: bytes) -> bytes:
    """A payload with the CRC byte of end-to-end profile 1 before it."""
    payload = bytearray(b"\0" + body)
    e2e.p01.e2e_p01_protect(payload, data_id, increment_counter=False)
    return bytes(payload)


def read(frame: Frame) -> Values | None:
    """The values of a frame of ours that is valid in all respects; None for every other frame."""
    message = MESSAGES.get(frame.identifier)
    if message is None or frame.extended or frame.remote or frame.error or len(frame.data) != message.length:
        return None
    if not e2e.p01.e2e_p01_check(bytearray(frame.data), DATA_IDS[frame.identifier]):
        return None
    values: Values = message.decode(frame.data, decode_choices=False)
    try:
        again = message.encode(values, strict=True)  # refuses what is out of range; reserved bits come out as zero
    except cantools.database.EncodeError:
        return None
    return values if again == frame.data and values["Counter"] <= 14 else None
