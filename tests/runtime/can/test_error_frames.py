"""Error frames: read as <linux/can/error.h> says."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.receiver import BUS_OFF, CONTROLLER_KINDS, KINDS, UNKNOWN, WITHOUT_DETAILS, classify
from emb_runtime.records import Frame


def reported(identifier: int, payload: str = "00 00 00 00 00 00 00 00") -> set[str]:
    return set(classify(Frame(identifier, bytes.fromhex(payload), error=True)))


def test_each_kind_is_read_from_its_bit() -> None:
    for identifier, payload, kinds in [
        (0x001, "00 00 00 00 00 00 00 00", {"transmission timed out"}),
        (0x002, "0c 00 00 00 00 00 00 00", {"arbitration lost"}),  # lost at bit 12
        (0x004, "00 00 00 00 00 00 00 00", {WITHOUT_DETAILS}),
        (0x004, "00 01 00 00 00 00 00 00", {"controller's receive buffer overflowed"}),
        (0x004, "00 02 00 00 00 00 00 00", {"controller's transmit buffer overflowed"}),
        (0x004, "00 04 00 00 00 00 00 00", {"many receive errors (warning level)"}),
        (0x004, "00 08 00 00 00 00 00 00", {"many transmit errors (warning level)"}),
        (0x004, "00 10 00 00 00 00 00 00", {"error passive by receive errors"}),
        (0x004, "00 20 00 00 00 00 00 00", {"error passive by transmit errors"}),
        (0x004, "00 40 00 00 00 00 00 00", {"error active again"}),
        (0x008, "00 00 04 03 00 00 00 00", {"protocol violation"}),  # bit stuffing, at the start of the frame
        (0x010, "00 00 00 00 04 00 00 00", {"transceiver problem"}),  # CAN_H has no wire
        (0x020, "00 00 00 00 00 00 00 00", {"no acknowledgement"}),
        (0x040, "00 00 00 00 00 00 00 00", {BUS_OFF}),
        (0x080, "00 00 00 00 00 00 00 00", {"bus error"}),
        (0x100, "00 00 00 00 00 00 00 00", {"controller restarted"}),
        (0x200, "00 00 00 00 00 00 07 09", set()),  # the error counters, and nothing wrong
        (0x400, "00 00 00 00 00 00 00 00", {UNKNOWN}),
        # What sja1000 says when nobody acknowledges: a bus error in the acknowledge slot, 128 and 0 errors so far.
        (0x28C, "00 20 80 19 00 00 80 00", {"error passive by transmit errors", "protocol violation", "bus error"}),
    ]:
        assert reported(identifier, payload) == kinds, hex(identifier)


def test_every_kind_can_be_reported() -> None:
    bits = [1 << n for n in range(11)]
    found = set().union(*(reported(b, f"00 {s:02x} 00 00 00 00 00 00") for b in bits for s in [0, *bits[:7]]))
    assert found == {*KINDS.values(), *CONTROLLER_KINDS.values(), WITHOUT_DETAILS, UNKNOWN}


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_any_error_frame_reports_each_of_its_bits_once(identifier: int, data: bytes) -> None:
    kinds = classify(Frame(identifier, data, error=True))
    assert len(set(kinds)) == len(kinds)
    assert kinds or identifier & 0x200
    assert (BUS_OFF in kinds) == bool(identifier & 0x40)
