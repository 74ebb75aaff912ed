from __future__ import annotations

import itertools
import json
import math
import struct
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import to_builtins

from emb_runtime.can.codec import Fault, FrameRejectedError, Message, from_document
from emb_runtime.can.e2e import has_valid_crc
from emb_runtime.can.generated import Codec, Field, generate_codec
from emb_runtime.can.messages import AngleFrame, StatusFrame, StopReason, VelocityFrame, bench_identity, load_layout
from emb_runtime.config.bench import CEILING_ANGLE, CEILING_CURRENT, CEILING_VELOCITY, load_bench
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from tests.independent import DATABASE, protected

LAYOUT = load_layout()
MESSAGES = list(LAYOUT.all_messages)

COMMAND = CurrentCommand(counter=3, answers=2, current=-5.5, enable=True)
# Worked by hand from the DBC; the CRC byte from an independent library.
GOLDEN = {
    # 0x23: answers 2, counter 3. −5.5 A / 0.2 mA = −27500 = 0x9494. Enable.
    "EMB_Command": (0x080, "2c 23 9494 01", LAYOUT.encode_command(*COMMAND)),
    # 0x07: counter 7. 55.5 rad / 20 µrad = 2775000 = 0x2A57D8. 123456789 ns / 250 ns rounds to 493827 = 0x078903.
    "EMB_Angle": (0x100, "a2 07 d8572a 038907", LAYOUT.encode_angle(7, 55.5, 123_456_789)),
    # 0x1e: active, counter 14. −321.5 rad/s / 0.1 mrad/s = −3215000 = 0xCEF168. −1.234 A / 0.2 mA = −6170 = 0xFE7E6
    # in 20 bits, and above it command 4.
    "EMB_Velocity": (0x101, "d9 1e 68f1ce e6e74f", LAYOUT.encode_velocity(14, -321.5, -1.234, NodeState.ACTIVE, 4)),
    # 0x20: stopping, counter 0. Version 1, watchdog, 513 = 0x0201 rejected, bench 0xBEEF.
    "EMB_Status": (
        0x102,
        "56 20 01 02 0102 efbe",
        LAYOUT.encode_status(0, NodeState.STOPPING, StopReason.WATCHDOG, 513, 0xBEEF),
    ),
    # 0x15: version 1, counter 5. −0.25 A·s / 0.2 µA·s = −1250000, in 40 bits 2^40 − 1250000 = 0xFFFFECED30.
    "EMB_Charge": (0x0FF, "eb 15 30edecffff", LAYOUT.encode_charge(5, -0.25)),
    # 0x16: version 1, counter 6. 258 = 0x0102 not sent, 772 = 0x0304 braked, 0xABC not believed, above it 0xD refused.
    "EMB_Gateway": (0x103, "db 16 0201 0403 bcda", LAYOUT.encode_gateway(6, 258, 772, 0xABC, 0xD)),
    # 0x15: version 1, counter 5. −12.34 °C / 0.01 = −1234 = 0xFB2E. 23.99 V / 0.01 V = 2399 = 0x095F.
    "EMB_Conditions": (0x104, "55 15 2efb 5f09", LAYOUT.encode_conditions(5, -12.34, 23.99)),
}


def with_crc(message: Message, body: bytes) -> Frame:
    """A frame with a CRC that is right, whatever else is wrong."""
    return Frame(message.identifier, protected(message.identifier, body))


def generic(message: Message) -> Codec:
    """A generated codec of the physical values, by the signals' names."""
    names = [signal.name for signal in message.signals[1:]]
    return generate_codec(message, namedtuple(message.name, names), tuple(map(Field, names)))


CODECS: dict[int, Codec] = {}  # By the identity of a message


def fault_of(message: Message, frame: Frame) -> Fault | None:
    """Why both decoders reject a frame, None if neither does; their values are then equal."""
    codec = CODECS.get(id(message)) or CODECS.setdefault(id(message), generic(message))
    generated, values = outcome(codec.decode, frame), outcome(message.decode, frame)
    if isinstance(values, Fault):
        assert generated is values
        return Fault(values)
    assert {"CRC": frame.data[0], **generated._asdict()} == values
    return None


def outcome(decode: Callable[[Frame], Any], frame: Frame) -> Any:
    try:
        return decode(frame)
    except FrameRejectedError as err:
        return err.fault


def test_frames_have_the_bytes_that_were_worked_out_by_hand() -> None:
    for identifier, payload, frame in GOLDEN.values():
        assert frame == Frame(identifier, bytes.fromhex(payload))


def test_typed_decoders_read_what_the_typed_encoders_wrote() -> None:
    assert LAYOUT.decode_command(GOLDEN["EMB_Command"][2]) == COMMAND
    assert LAYOUT.decode_command(GOLDEN["EMB_Command"][2]).enable is True
    assert isinstance(LAYOUT.decode_velocity(GOLDEN["EMB_Velocity"][2]).node_state, NodeState)
    assert LAYOUT.decode_angle(GOLDEN["EMB_Angle"][2]) == AngleFrame(7, 2_775_000 * 2e-5, 123_456_750)
    assert LAYOUT.decode_velocity(GOLDEN["EMB_Velocity"][2]) == VelocityFrame(
        14, -3_215_000 * 1e-4, -6_170 * 2e-4, NodeState.ACTIVE, 4
    )
    assert LAYOUT.decode_status(GOLDEN["EMB_Status"][2]) == StatusFrame(
        0, NodeState.STOPPING, LAYOUT.protocol_version, StopReason.WATCHDOG, 513, 0xBEEF
    )


def test_each_of_all_currents_that_16_bits_can_say_is_within_the_ceiling_or_rejected() -> None:
    believed = []
    for raw in range(-32_768, 32_768):
        frame = with_crc(LAYOUT.command, struct.pack("<BhB", 0x23, raw, 1))
        if (fault := fault_of(LAYOUT.command, frame)) is not None:
            assert fault is Fault.RANGE
            continue
        believed.append(raw)
        decoded = LAYOUT.decode_command(frame)
        assert decoded == (3, 2, raw * 2e-4, True)
        assert abs(decoded.current) <= CEILING_CURRENT
        assert LAYOUT.encode_command(*decoded) == frame
    assert believed == list(range(-30_000, 30_001))


def test_every_current_that_can_be_commanded_is_reported_as_the_same_number() -> None:
    for raw in range(-30_000, 30_001, 3):
        current = raw * 2e-4
        velocity = LAYOUT.encode_velocity(0, 0.0, current, NodeState.ACTIVE, 0)
        assert LAYOUT.decode_velocity(velocity).applied_current == current


def test_sensor_ranges_reach_beyond_the_limits_so_that_a_violation_shows() -> None:
    angle, velocity = LAYOUT.angle.signal("Angle"), LAYOUT.velocity.signal("Velocity")
    assert angle.minimum < 1.5 * CEILING_ANGLE[0]
    assert angle.maximum > 1.5 * CEILING_ANGLE[1]
    assert velocity.maximum == -velocity.minimum > 1.5 * CEILING_VELOCITY
    assert LAYOUT.velocity.signal("AppliedCurrent").maximum > 2 * CEILING_CURRENT


def test_quantisation_costs_less_than_a_thousandth_of_the_noise_variance() -> None:
    noise = load_bench().noise
    assert LAYOUT.angle.signal("Angle").factor ** 2 / 12 < 4e-5 * noise.angle**2
    assert LAYOUT.velocity.signal("Velocity").factor ** 2 / 12 < 4e-5 * noise.velocity**2
    assert 0.5 * LAYOUT.angle.signal("DeviceTime").factor * CEILING_VELOCITY < 0.07 * noise.angle


@given(st.integers(0, 10**18))
def test_device_time_is_rounded_to_its_step_and_wraps(time_ns: int) -> None:
    decoded = LAYOUT.decode_angle(LAYOUT.encode_angle(0, 0.0, time_ns)).device_time_ns
    assert 0 <= decoded < LAYOUT.device_time_period_ns == 4_194_304_000
    assert decoded % 250 == 0
    error = (decoded - time_ns + 2_000_000_000) % LAYOUT.device_time_period_ns - 2_000_000_000
    assert abs(error) <= 125


def test_device_time_between_two_steps_is_rounded_up() -> None:
    for time_ns, rounded in [(124, 0), (125, 250), (374, 250), (375, 500), (625, 750)]:
        assert LAYOUT.decode_angle(LAYOUT.encode_angle(0, 0.0, time_ns)).device_time_ns == rounded


@pytest.mark.parametrize("value", [-1e9, -100.0, 12.5, 100.0, 1e9])
def test_a_value_beyond_the_range_of_a_signal_shows_its_end(value: float) -> None:
    angle = LAYOUT.angle.signal("Angle")
    expected = sorted((angle.minimum, value, angle.maximum))[1]
    assert angle.saturated(value) == expected
    LAYOUT.encode_angle(0, angle.saturated(value), 0)


def test_the_count_of_rejected_commands_saturates() -> None:
    for rejected, sent in [(0, 0), (65_535, 65_535), (65_536, 65_535), (10**9, 65_535)]:
        frame = LAYOUT.encode_status(0, NodeState.FAULT, StopReason.LIMIT, rejected, 0)
        assert LAYOUT.decode_status(frame).rejected == sent
    with pytest.raises(FrameError):
        LAYOUT.encode_status(0, NodeState.FAULT, StopReason.LIMIT, -1, 0)


def bit_errors(message: Message) -> list[int]:
    """Every pattern of one or two wrong bits: 2,080 of 64."""
    pairs = itertools.combinations_with_replacement(range(8 * message.length), 2)
    return [1 << first | 1 << second for first, second in pairs]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.name)
def test_no_single_or_double_bit_error_of_any_frame_at_all_can_pass(message: Message) -> None:
    """The CRC is linear: a pattern of errors passes in one frame if it passes in every, that of zeros included.

    A double error passes only if the CRC's register, shifted by their distance, comes back to where it was. The
    polynomial is primitive of degree 8: that takes 255 steps, and no frame is longer than 64 bits.
    """
    patterns = bit_errors(message)
    assert len(patterns) == math.comb(8 * message.length, 2) + 8 * message.length
    assert not any(has_valid_crc(0, pattern.to_bytes(message.length, "little")) for pattern in patterns)


@given(body=st.binary(min_size=7, max_size=7))
@settings(max_examples=25)
def test_a_frame_of_one_message_never_passes_for_another(body: bytes) -> None:
    for message, other in itertools.permutations(MESSAGES, 2):
        payload = with_crc(message, body[: other.length - 1]).data
        assert fault_of(other, Frame(other.identifier, payload)) is Fault.CRC


def test_the_messages_are_those_of_the_protocol() -> None:
    assert list(LAYOUT.messages) == ["EMB_Command", "EMB_Angle", "EMB_Velocity", "EMB_Status"]
    assert [m.name for m in LAYOUT.all_messages] == [*LAYOUT.messages, "EMB_Charge", "EMB_Gateway", "EMB_Conditions"]


def test_the_charge_is_rounded_to_its_step_and_wraps() -> None:
    for charge in (0.0, 1e-7, 1.5e-7, 0.2e-6 * (2**40 - 1), 0.2e-6 * 2**40, -0.2e-6, 123.456, -1e6):
        frame = LAYOUT.encode_charge(9, charge)
        theirs = DATABASE.decode_message("EMB_Charge", frame.data, scaling=False)
        assert theirs["Charge"] == round(charge / 2e-7) % 2**40
        assert (theirs["Counter"], theirs["Version"]) == (9, 1)
        assert LAYOUT.optional["EMB_Charge"].decode(frame) == DATABASE.decode_message("EMB_Charge", frame.data)


def test_the_gateway_s_counts_stay_at_their_greatest() -> None:
    frame = LAYOUT.encode_gateway(14, 65536, 10**6, 4096, 16)
    theirs = DATABASE.decode_message("EMB_Gateway", frame.data)
    assert [theirs[name] for name in ("NotSent", "Braked", "NotBelieved", "Refused")] == [65535, 65535, 4095, 15]


def test_the_command_wins_every_arbitration() -> None:
    assert LAYOUT.command.identifier == min(m.identifier for m in MESSAGES)


def test_the_bus_load_is_that_of_worst_case_stuffing() -> None:
    # 135 bits for 8 bytes and 105 for 5 (111 and 87 unstuffed): three frames each millisecond, one each 100 ms.
    assert LAYOUT.bus_load(1_000_000) == pytest.approx((2 * 135 + 105 + 135 / 100) / 1000)
    assert LAYOUT.bus_load(500_000) == pytest.approx(0.7527)


def test_each_message_reads_back_from_the_document_of_a_process() -> None:
    document = json.loads(json.dumps(to_builtins(LAYOUT.all_messages, str_keys=True)))
    assert tuple(map(from_document, document)) == LAYOUT.all_messages


def test_the_bench_identity_is_the_start_of_its_hash() -> None:
    assert bench_identity("beef" + 60 * "0") == 0xBEEF
    assert 0 <= bench_identity(load_bench().identity_hash) <= 0xFFFF


def test_the_enable_bit_is_read_as_it_was_written() -> None:
    for enable in (False, True):
        command = CurrentCommand(3, 4, 0.0, enable)
        assert LAYOUT.decode_command(LAYOUT.encode_command(*command)) == command


def test_a_command_is_read_as_it_was_written_to_half_a_step() -> None:
    for current in (0.0, -0.0, 1.00009, 1.00011, -3.3333, 6.0, -6.0):
        command = LAYOUT.decode_command(LAYOUT.encode_command(3, 4, current, True))
        assert (command.counter, command.answers, command.enable) == (3, 4, True)
        assert command.current == pytest.approx(current, abs=1e-4 + 1e-12)
    with pytest.raises(FrameError):
        LAYOUT.encode_command(3, 4, 6.0002, True)


def test_the_current_within_a_limit_lies_on_a_step_of_the_signal() -> None:
    for limit, within in [(6.0, 30_000), (0.6, 3_000), (1.0001, 5_000), (1.00019, 5_000), (0.0002, 1), (0.0001, 0)]:
        assert LAYOUT.current_within(limit) == pytest.approx(within * 2e-4, abs=1e-12)
        assert LAYOUT.current_within(limit) <= limit + 1e-9


def test_a_limit_that_a_decimal_fraction_puts_just_below_a_step_counts_as_the_step() -> None:
    below = [n for n in range(1, 30_001) if (n / 5000) / 2e-4 < n]
    assert below
    assert [round(LAYOUT.current_within(n / 5000) / 2e-4) for n in below] == below


def test_the_tables_of_values_and_the_version_are_those_of_the_protocol() -> None:
    velocity, status = (DATABASE.get_message_by_name(name) for name in ("EMB_Velocity", "EMB_Status"))
    for message, name, enum in (
        (velocity, "NodeState", NodeState),
        (status, "NodeState", NodeState),
        (status, "StopReason", StopReason),
    ):
        signal = message.get_signal_by_name(name)
        assert {value: str(text) for value, text in signal.choices.items()} == {e.value: e.name.lower() for e in enum}
        assert (signal.minimum, signal.maximum) == (0, len(enum) - 1)
    assert LAYOUT.protocol_version == DATABASE.dbc.attributes["EmbProtocolVersion"].value == 1


def test_every_message_has_the_shape_that_its_protection_needs() -> None:
    for message in DATABASE.messages:
        crc, counter = sorted(message.signals, key=lambda signal: signal.start)[:2]
        assert [(s.name, s.start, s.length) for s in (crc, counter)] == [("CRC", 0, 8), ("Counter", 8, 4)]
        assert message.length <= 8
        assert not any((message.is_extended_frame, message.is_fd, message.is_multiplexed()))
        for signal in message.signals:
            assert signal.byte_order == "little_endian"
            assert (signal.offset, signal.is_float) == (0, False)


def test_a_frame_on_which_the_decoders_disagree_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Message, "decode", lambda *_: {})
    with pytest.raises(FrameError, match="the two decoders disagree"):
        LAYOUT.decode_angle(Frame(0x100, bytes(8)))
    with pytest.raises(ValueError, match="EMB_Angle: a frame can carry"):
        raise LAYOUT.angle.refusal({"Angle": 0.0})
