"""What a frame says, read without the project's codec: cantools for the signals, the AUTOSAR library for the CRC."""

from __future__ import annotations

import cantools.database
import e2e.p01
from cantools.database.can import Database

from emb_runtime.can.messages import load_layout
from emb_runtime.records import Frame

Values = dict[str, float]


def _database() -> Database:
    loaded = cantools.database.load_string(load_layout().text, "dbc")
    assert isinstance(loaded, Database)
    return loaded


DATABASE = _database()
MESSAGES = {message.frame_id: message for message in DATABASE.messages}


def data_id(identifier: int) -> int:
    """The end-to-end data id of a message."""
    dbc = MESSAGES[identifier].dbc
    assert dbc is not None
    return int(dbc.attributes["DataId"].value)


DATA_IDS = {identifier: data_id(identifier) for identifier in MESSAGES}


def protected(identifier: int, body: bytes, *, by: int | None = None) -> bytes:
    """A payload with the CRC byte that its message needs, or that of another data id."""
    payload = bytearray(b"\0" + body)
    e2e.p01.e2e_p01_protect(payload, DATA_IDS[identifier] if by is None else by, increment_counter=False)
    return bytes(payload)


def read(frame: Frame) -> Values | None:
    """The values of a frame of ours that is valid in all respects; None for every other frame."""
    message = MESSAGES.get(frame.identifier)
    if message is None or frame.extended or frame.remote or frame.error or len(frame.data) != message.length:
        return None
    if not e2e.p01.e2e_p01_check(bytearray(frame.data), DATA_IDS[frame.identifier]):
        return None
    decoded = message.decode(frame.data, decode_choices=False)
    assert isinstance(decoded, dict)
    values: Values = {name: value for name, value in decoded.items() if isinstance(value, int | float)}
    try:
        again = message.encode(values, strict=True)  # refuses what is out of range; reserved bits come out as zero
    except cantools.database.EncodeError:
        return None
    return values if again == frame.data and values["Counter"] <= 14 else None
