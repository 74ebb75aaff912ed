"""CAN error frames: their classes by ``<linux/can/error.h>``, and the count of each.

An error frame is the kernel's own message and never on the bus. Its identifier has one bit per kind of error, which is
why it must be told apart first: the bit of a bus error, 0x080, is also the identifier of our command.
"""

from __future__ import annotations

from enum import StrEnum

from emb_runtime.records import Frame


class ErrorClass(StrEnum):
    """Error classes of a frame, in words."""

    TX_TIMEOUT = "transmission timed out"
    LOST_ARBITRATION = "arbitration lost"
    CONTROLLER = "controller problem without details"
    RX_OVERFLOW = "controller's receive buffer overflowed"
    TX_OVERFLOW = "controller's transmit buffer overflowed"
    RX_WARNING = "many receive errors (warning level)"
    TX_WARNING = "many transmit errors (warning level)"
    RX_PASSIVE = "error passive by receive errors"
    TX_PASSIVE = "error passive by transmit errors"
    ACTIVE = "error active again"
    PROTOCOL = "protocol violation"
    TRANSCEIVER = "transceiver problem"
    NO_ACKNOWLEDGE = "no acknowledgement"
    BUS_OFF = "bus-off"
    BUS_ERROR = "bus error"
    RESTARTED = "controller restarted"
    UNKNOWN = "of a class that is not known here"


_CONTROLLER = 0x004
_COUNTERS = 0x200
_CLASSES = {
    0x001: ErrorClass.TX_TIMEOUT,
    0x002: ErrorClass.LOST_ARBITRATION,
    0x008: ErrorClass.PROTOCOL,
    0x010: ErrorClass.TRANSCEIVER,
    0x020: ErrorClass.NO_ACKNOWLEDGE,
    0x040: ErrorClass.BUS_OFF,
    0x080: ErrorClass.BUS_ERROR,
    0x100: ErrorClass.RESTARTED,
}
"""By bit of the identifier."""
_CONTROLLER_CLASSES = {
    0x01: ErrorClass.RX_OVERFLOW,
    0x02: ErrorClass.TX_OVERFLOW,
    0x04: ErrorClass.RX_WARNING,
    0x08: ErrorClass.TX_WARNING,
    0x10: ErrorClass.RX_PASSIVE,
    0x20: ErrorClass.TX_PASSIVE,
    0x40: ErrorClass.ACTIVE,
}
"""By bit of byte 1, where the identifier says that the controller has a problem."""


def classify(frame: Frame) -> tuple[ErrorClass, ...]:
    """All that an error frame reports; nothing for one that only tells the error counters."""
    found = [name for bit, name in _CLASSES.items() if frame.identifier & bit]
    if frame.identifier & _CONTROLLER:
        status = frame.data[1] if len(frame.data) > 1 else 0
        found += [name for bit, name in _CONTROLLER_CLASSES.items() if status & bit] or [ErrorClass.CONTROLLER]
    # The error counters may come alone, which is no error.
    return tuple(found) or (() if frame.identifier & _COUNTERS else (ErrorClass.UNKNOWN,))


def error_counters(frame: Frame) -> tuple[int, int] | None:
    """The controller's counts of transmit and of receive errors, 0..255; None from a driver that does not tell them."""
    if not frame.identifier & _COUNTERS or len(frame.data) < 8:
        return None
    return frame.data[6], frame.data[7]


class BusErrors:
    """Counts of each error class, and the highest values of the controller's error counters."""

    def __init__(self) -> None:
        self.counts: dict[ErrorClass, int] = {}
        """Reports by class; only of what was reported."""
        self.transmit_errors: int | None = None
        """Highest count of transmit errors so far; None when no driver has told one."""
        self.receive_errors: int | None = None
        """Highest count of receive errors so far."""

    @property
    def bus_off(self) -> bool:
        """The controller has stopped taking part; that it was restarted later does not change that."""
        return ErrorClass.BUS_OFF in self.counts

    def count(self, frame: Frame) -> None:
        """Take one error frame."""
        for name in classify(frame):
            self.counts[name] = self.counts.get(name, 0) + 1
        counters = error_counters(frame)
        if counters is not None:
            self.transmit_errors = max(self.transmit_errors or 0, counters[0])
            self.receive_errors = max(self.receive_errors or 0, counters[1])
