"""CAN error frames: what they report, by ``<linux/can/error.h>``.

An error frame is the kernel's own message and never on the bus. Its identifier has one bit per kind of error, which is
why it must be told apart first: the bit of a bus error, 0x080, is also the identifier of our command.
"""

from __future__ import annotations

from typing import Final

from emb_runtime.records import Frame

BUS_OFF: Final = "bus-off"  # The controller has stopped taking part
KINDS: Final = {
    0x001: "transmission timed out",
    0x002: "arbitration lost",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x040: BUS_OFF,
    0x080: "bus error",
    0x100: "controller restarted",
}
"""By bit of the identifier."""
CONTROLLER_KINDS: Final = {
    0x01: "controller's receive buffer overflowed",
    0x02: "controller's transmit buffer overflowed",
    0x04: "many receive errors (warning level)",
    0x08: "many transmit errors (warning level)",
    0x10: "error passive by receive errors",
    0x20: "error passive by transmit errors",
    0x40: "error active again",
}
"""By bit of byte 1, where the identifier says that the controller has a problem."""
WITHOUT_DETAILS: Final = "controller problem without details"
UNKNOWN: Final = "of a class that is not known here"

_CONTROLLER: Final = 0x004
_COUNTERS: Final = 0x200  # The controller's error counters, which may come alone and are no error then


def classify(frame: Frame) -> tuple[str, ...]:
    """All that an error frame reports; nothing for one that only has the error counters."""
    found = [text for bit, text in KINDS.items() if frame.identifier & bit]
    if frame.identifier & _CONTROLLER:
        status = frame.data[1] if len(frame.data) > 1 else 0
        found += [text for bit, text in CONTROLLER_KINDS.items() if status & bit] or [WITHOUT_DETAILS]
    return tuple(found) or (() if frame.identifier & _COUNTERS else (UNKNOWN,))
