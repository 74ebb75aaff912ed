"""Error frames: read as <linux/can/error.h> says, and counted."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.error_frames import BusErrors, ErrorClass, classify, error_counters
from emb_runtime.records import Frame


def told(identifier: int, payload: str = "00 00 00 00 00 00 00 00") -> Frame:
    return Frame(identifier, bytes.fromhex(payload), error=True)


@pytest.mark.parametrize(
    ("identifier", "payload", "classes"),
    [
        (0x001, "00 00 00 00 00 00 00 00", {ErrorClass.TX_TIMEOUT}),
        (0x002, "0c 00 00 00 00 00 00 00", {ErrorClass.LOST_ARBITRATION}),  # lost at bit 12
        (0x004, "00 00 00 00 00 00 00 00", {ErrorClass.CONTROLLER}),
        (0x004, "00 01 00 00 00 00 00 00", {ErrorClass.RX_OVERFLOW}),
        (0x004, "00 02 00 00 00 00 00 00", {ErrorClass.TX_OVERFLOW}),
        (0x004, "00 04 00 00 00 00 00 00", {ErrorClass.RX_WARNING}),
        (0x004, "00 08 00 00 00 00 00 00", {ErrorClass.TX_WARNING}),
        (0x004, "00 10 00 00 00 00 00 00", {ErrorClass.RX_PASSIVE}),
        (0x004, "00 20 00 00 00 00 00 00", {ErrorClass.TX_PASSIVE}),
        (0x004, "00 40 00 00 00 00 00 00", {ErrorClass.ACTIVE}),
        (0x008, "00 00 04 03 00 00 00 00", {ErrorClass.PROTOCOL}),  # bit stuffing, at the start of the frame
        (0x010, "00 00 00 00 04 00 00 00", {ErrorClass.TRANSCEIVER}),  # CAN_H has no wire
        (0x020, "00 00 00 00 00 00 00 00", {ErrorClass.NO_ACKNOWLEDGE}),
        (0x040, "00 00 00 00 00 00 00 00", {ErrorClass.BUS_OFF}),
        (0x080, "00 00 00 00 00 00 00 00", {ErrorClass.BUS_ERROR}),
        (0x100, "00 00 00 00 00 00 00 00", {ErrorClass.RESTARTED}),
        (0x200, "00 00 00 00 00 00 07 09", set()),  # the error counters, and nothing wrong
        (0x400, "00 00 00 00 00 00 00 00", {ErrorClass.UNKNOWN}),
        # What sja1000 says when nobody acknowledges: a bus error in the acknowledge slot, 128 and 0 errors so far.
        (0x28C, "00 20 80 19 00 00 80 00", {ErrorClass.TX_PASSIVE, ErrorClass.PROTOCOL, ErrorClass.BUS_ERROR}),
    ],
)
def test_each_class_is_read_from_its_bit(identifier: int, payload: str, classes: set[ErrorClass]) -> None:
    assert set(classify(told(identifier, payload))) == classes


def test_every_class_can_be_reported() -> None:
    bits = [1 << n for n in range(11)]
    frames = [told(bit, f"00 {status:02x} 00 00 00 00 00 00") for bit in bits for status in [0, *bits[:7]]]
    assert {name for frame in frames for name in classify(frame)} == set(ErrorClass)


def test_the_error_counters_are_believed_only_where_the_driver_says_that_it_tells_them() -> None:
    assert error_counters(told(0x204, "00 08 00 00 00 00 60 7f")) == (0x60, 0x7F)
    assert error_counters(told(0x004, "00 08 00 00 00 00 60 7f")) is None
    assert error_counters(Frame(0x204, bytes(7), error=True)) is None


def test_reports_are_counted_by_class_and_the_highest_counters_are_kept() -> None:
    errors = BusErrors()
    assert (errors.counts, errors.bus_off, errors.transmit_errors, errors.receive_errors) == ({}, False, None, None)
    for frame in (
        told(0x204, "00 08 00 00 00 00 60 00"),
        told(0x204, "00 28 00 00 00 00 88 05"),
        told(0x200, "00 00 00 00 00 00 02 03"),
        told(0x020),
    ):
        errors.count(frame)
    assert errors.counts == {ErrorClass.TX_WARNING: 2, ErrorClass.TX_PASSIVE: 1, ErrorClass.NO_ACKNOWLEDGE: 1}
    assert (errors.transmit_errors, errors.receive_errors) == (0x88, 5)
    assert not errors.bus_off


def test_bus_off_stays_even_if_the_controller_is_restarted() -> None:
    errors = BusErrors()
    errors.count(told(0x044, "00 20 00 00 00 00 00 00"))
    assert errors.bus_off
    errors.count(told(0x100))
    assert errors.bus_off


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_any_error_frame_is_counted_and_each_bit_of_it_once(identifier: int, data: bytes) -> None:
    frame = Frame(identifier, data, error=True)
    classes = classify(frame)
    assert len(set(classes)) == len(classes)
    assert classes or identifier & 0x200
    errors = BusErrors()
    errors.count(frame)
    assert errors.counts == dict.fromkeys(classes, 1)
    assert errors.bus_off == bool(identifier & 0x40)
