"""What a drive says becomes samples, and what cannot be believed becomes none.

Checksums are those of AUTOSAR's library, and published check values.
"""

from __future__ import annotations

import math
import random
import struct

import e2e
import numpy as np
import pytest

from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.mapping_file import load_mapping, parse_mapping
from emb_runtime.drives.signals import Field, Protection, crc8_h2f
from emb_runtime.drives.wire import DriveState, Receiver
from emb_runtime.records import Frame
from tests.drives import EXAMPLES
from tests.runtime.drives.mapped import protected, protected_odrive

MS = 1_000_000


def odrive() -> Mapping:
    return load_mapping(EXAMPLES / "odrive.toml")


def encoder(position: float, velocity: float, time_ns: int) -> Frame:
    return Frame(0x009, struct.pack("<ff", position, velocity), time_ns)


def iq(measured: float, time_ns: int) -> Frame:
    return Frame(0x014, struct.pack("<ff", 0.0, measured), time_ns)


def heartbeat(state: int, time_ns: int, error: int = 0) -> Frame:
    return Frame(0x001, struct.pack("<IB3x", error, state), time_ns)


def test_a_sample_is_complete_when_all_its_messages_have_come_in_any_order() -> None:
    for turned in (False, True):
        receiver, pair = Receiver(odrive(), 20), [encoder(1.5, -2.0, MS), iq(0.75, MS + 100_000)]
        first, second = reversed(pair) if turned else pair
        assert receiver.add_frame(first) is None
        sample = receiver.add_frame(second)
        assert sample is not None
        assert sample == pytest.approx((3.0 * math.pi, -4.0 * math.pi, 0.75, MS))


def test_messages_of_two_samples_make_none() -> None:
    receiver = Receiver(odrive(), 20)
    assert receiver.add_frame(encoder(1.0, 0.0, MS)) is None
    assert receiver.add_frame(iq(0.0, MS + 600_000)) is None
    assert receiver.add_frame(encoder(2.0, 0.0, 2 * MS)) is not None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, 17.1, -2.1])
def test_a_value_that_cannot_be_believed_makes_no_sample(value: float) -> None:
    receiver = Receiver(odrive(), 20)
    receiver.add_frame(encoder(value, 0.0, MS))
    assert receiver.add_frame(iq(0.0, MS)) is None
    assert receiver.rejected == {"Pos_Estimate out of range": 1}
    message = "Axis0_Get_Encoder_Estimates.Pos_Estimate out of range"
    assert receiver.refusal == f"{message}: {np.float32(value):g}, not -2 to 17"


def test_frames_of_the_wrong_length_and_of_others_make_no_sample() -> None:
    receiver = Receiver(odrive(), 20)
    right = encoder(1.0, 0.0, MS)
    for wrong in (
        right._replace(data=right.data[:7]),
        right._replace(remote=True, data=b""),
        right._replace(extended=True),
        right._replace(own=True),
        right._replace(error=True),
        right._replace(identifier=0x0A9),
    ):
        receiver.add_frame(wrong)
    assert receiver.add_frame(iq(0.0, MS)) is None
    assert receiver.rejected == {"wrong length": 2}
    assert receiver.refusal == "Axis0_Get_Encoder_Estimates: wrong length: 0 bytes came, the DBC has 8"


def test_the_state_is_what_the_heartbeat_says_until_it_is_too_old() -> None:
    receiver = Receiver(odrive(), 20)
    assert receiver.state(0) is DriveState.UNKNOWN
    assert receiver.reported == ""
    known = "; idle is 1, active 8"
    for frame, state, reported in (
        (heartbeat(1, MS), DriveState.IDLE, f"Axis_State is 1{known}"),
        (heartbeat(8, 2 * MS), DriveState.ACTIVE, f"Axis_State is 8{known}"),
        (heartbeat(8, 3 * MS, error=0x40), DriveState.FAULT, "Axis_Error is 64, not 0"),
        (heartbeat(3, 4 * MS), DriveState.FAULT, f"Axis_State is 3{known}"),
        (heartbeat(1, 5 * MS), DriveState.IDLE, f"Axis_State is 1{known}"),
    ):
        receiver.add_frame(frame)
        assert receiver.state(frame.time_ns) is state
        assert receiver.reported == f"Axis0_Heartbeat.{reported}"
    assert receiver.state(255 * MS) is DriveState.IDLE
    assert receiver.state(256 * MS) is DriveState.UNKNOWN


def test_an_angle_that_begins_anew_is_continued() -> None:
    receiver = Receiver(load_mapping(EXAMPLES / "vesc.toml"), 20)
    true = [-2.0, 30.0, 170.0, 200.0, 340.0, 380.0, 500.0, 660.0, 740.0, 600.0, 440.0, 280.0, 110.0, -60.0]  # deg
    for index, angle in enumerate(true):
        time_ns = index * MS
        receiver.add_frame(
            Frame(0x1005, struct.pack(">hhhh", 0, 0, 0, round(angle % 360.0 * 50)), time_ns, extended=True)
        )
        sample = receiver.add_frame(Frame(0x905, struct.pack(">ihh", 7 * 60, 15, 0), time_ns, extended=True))
        assert sample is not None
        assert math.degrees(sample.angle) == pytest.approx(angle, abs=0.011)
        assert sample.velocity == pytest.approx(2.0 * math.pi)
        assert sample.current == pytest.approx(1.5)


def test_a_protected_message_is_checked_and_a_repeated_one_is_none() -> None:
    toml, dbc = protected_odrive()
    receiver = Receiver(parse_mapping(toml, dbc, "drive.toml"), 20)

    for frame, whole in (
        (protected(0, MS), True),
        (protected(0, 2 * MS), False),
        (protected(1, 3 * MS, off=1), False),
        (protected(1, 4 * MS), True),
        (protected(15, 5 * MS), False),
        (protected(14, 6 * MS), True),
    ):
        receiver.add_frame(encoder(0.0, 0.0, frame.time_ns))
        assert (receiver.add_frame(frame) is not None) is whole
    assert receiver.rejected == {"repeated": 1, "wrong checksum": 1, "invalid counter": 1}
    assert receiver.refusal.endswith(": invalid counter")


@pytest.mark.parametrize(("step", "missing"), [(1, False), (2, True), (14, True)])
def test_a_message_whose_counter_skips_frames_for_ever_is_missing_some(step: int, missing: bool) -> None:
    toml, dbc = protected_odrive()
    receiver = Receiver(parse_mapping(toml, dbc, "drive.toml"), 5)
    for index in range(40):
        receiver.add_frame(protected(index * step % 15, index * MS))
    assert receiver.frames_missing == ("Axis0_Get_Iq" if missing else "")


def test_frames_that_were_lost_now_and_then_are_not_too_many() -> None:
    toml, dbc = protected_odrive()
    receiver = Receiver(parse_mapping(toml, dbc, "drive.toml"), 5)
    for index in (index for index in range(400) if index % 6 and index not in range(100, 104)):
        receiver.add_frame(protected(index % 15, index * MS))
        assert receiver.frames_missing == ""


# --- checksums ------------------------------------------------------------------------------------------------------


def field(name: str, start: int, length: int, big_endian: bool = False) -> Field:
    return Field(name, start, length, big_endian, False, False, 1.0, 0.0)


def test_the_crc_has_its_published_check_value() -> None:
    assert crc8_h2f(b"123456789") == 0xDF


def test_profiles_1_2_and_5_agree_with_the_reference_library() -> None:
    for seed in range(40):
        draw = random.Random(seed)
        data_id = draw.randrange(1 << 16)
        ids = tuple(draw.randrange(256) for _ in range(16))
        body = bytes(draw.randrange(256) for _ in range(8))

        first = bytearray(body)
        first[1] = first[1] & 0xF0 | draw.randrange(14)
        e2e.p01.e2e_p01_protect(first, data_id, data_id_mode=e2e.p01.E2E_P01_DATAID_BOTH, increment_counter=False)
        profile1 = Protection("profile1", field("c", 0, 8), field("n", 8, 4), 15, (data_id,))
        assert profile1.checksum_of(bytes(first)) == first[0]
        assert profile1.fault(bytes(first)) == ""

        second = bytearray(body)
        e2e.p02.e2e_p02_protect(second, bytes(ids), increment_counter=False)
        profile2 = Protection("profile2", field("c", 0, 8), field("n", 8, 4), 16, ids)
        assert profile2.checksum_of(bytes(second)) == second[0]

        fifth = bytearray(body)
        e2e.p05.e2e_p05_protect(fifth, data_id, increment_counter=False)
        profile5 = Protection("profile5", field("c", 0, 16), field("n", 16, 8), 256, (data_id,))
        assert profile5.checksum_of(bytes(fifth)).to_bytes(2, "little") == bytes(fifth[:2])
        fifth[3] ^= 1
        assert profile5.fault(bytes(fifth)) == "wrong checksum"


def test_xor_and_sum_are_those_of_all_other_bytes_and_the_start_value() -> None:
    data = bytes((0, 1, 2, 3, 250, 5, 6, 99))
    last = field("c", 63, 8, big_endian=True)
    assert Protection("xor", last, start=7).checksum_of(data) == 7 ^ 0 ^ 1 ^ 2 ^ 3 ^ 250 ^ 5 ^ 6
    assert Protection("sum", last, start=7).checksum_of(data) == (7 + 0 + 1 + 2 + 3 + 250 + 5 + 6) % 256
