"""What leaves to a mapped drive says what was meant, or nothing leaves."""

from __future__ import annotations

import itertools
import math
import random
import struct
from dataclasses import replace

import pytest

from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.mapping_file import load_mapping, parse_mapping
from emb_runtime.drives.wire import Encoder
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame
from tests.drives import EXAMPLES, LIMIT, SHIPPED, RandomMapping


class Way:
    """Encoder, second guard and bus of a mapping."""

    def __init__(self, mapping: Mapping, limit: float = LIMIT) -> None:
        self.bus: list[Frame] = []
        self.encoder = Encoder(mapping)
        self.guard = WireGuard(mapping, limit, self.bus.append)

    def command(self, current: float) -> float:
        return self.guard.command(self.encoder.command(current), current)


def test_bytes_on_the_bus_decode_to_what_was_meant_or_nothing_leaves() -> None:
    for seed in range(150):
        drawn, draw = RandomMapping(seed), random.Random(-seed)
        mapping = parse_mapping(drawn.toml, drawn.dbc, "random.toml")
        message = mapping.messages["Command"].dbc
        way = Way(mapping)
        for current in (0.0, LIMIT, -LIMIT, *(draw.uniform(-LIMIT, LIMIT) for _ in range(7))):
            said = way.command(current)
            data = way.bus[-1].data
            assert drawn.amperes(data) == pytest.approx(current, abs=0.51 * drawn.ampere_step)
            assert said == pytest.approx(drawn.amperes(data), abs=1e-9)
            by_cantools = message.decode_simple(data)["Current"]
            assert isinstance(by_cantools, float | int)
            assert by_cantools * drawn.scale * drawn.sign / drawn.per_ampere == pytest.approx(said, abs=1e-9)
        left = len(way.bus)
        for current in (math.nan, math.inf, -math.inf, 1.5 * LIMIT, -1e300):
            with pytest.raises((FrameError, WireGuardError)):
                way.command(current)
        assert len(way.bus) == left


def test_a_flipped_bit_is_refused_or_changes_nothing_of_the_current() -> None:
    for seed in range(60):
        drawn, draw = RandomMapping(seed), random.Random(seed)
        mapping = parse_mapping(drawn.toml, drawn.dbc, "random.toml")
        for bit in range(64):
            way, current = Way(mapping), draw.uniform(-LIMIT, LIMIT)
            frame = way.encoder.command(current)
            try:
                way.guard.command(_flipped(frame, bit), current)
            except WireGuardError:
                assert not way.bus
                continue
            assert drawn.kind == "none"
            assert drawn.amperes(way.bus[0].data) == pytest.approx(current, abs=0.51 * drawn.ampere_step)


@pytest.fixture(params=SHIPPED)
def mapping(request: pytest.FixtureRequest) -> Mapping:
    return load_mapping(EXAMPLES / f"{request.param}.toml")


def test_another_kind_of_frame_is_refused(mapping: Mapping) -> None:
    for change in ("identifier", "extended", "remote", "error", "short", "long"):
        way = Way(mapping)
        frame = way.encoder.command(1.0)
        changed = {
            "identifier": frame._replace(identifier=frame.identifier + 1),
            "extended": frame._replace(extended=not frame.extended),
            "remote": frame._replace(remote=True),
            "error": frame._replace(error=True),
            "short": frame._replace(data=frame.data[:-1]),
            "long": frame._replace(data=frame.data + b"\0"),
        }[change]
        with pytest.raises(WireGuardError):
            way.guard.command(changed, 1.0)
        assert not way.bus, change


def test_the_frames_of_the_sequences_pass_as_they_are_and_in_no_other_way(mapping: Mapping) -> None:
    for step in (*mapping.arm, *mapping.disarm):
        for constant in step.frames:
            way = Way(mapping)
            frame = mapping.messages[constant.message].frame(constant.data)
            way.guard.constant(frame, constant)
            assert way.bus == [frame]
            others = [_flipped(frame, bit) for bit in range(8 * len(frame.data))]
            for changed in (*others, frame._replace(identifier=frame.identifier ^ 1)):
                with pytest.raises(WireGuardError):
                    way.guard.constant(changed, constant)
            assert (way.guard.passed, way.guard.rejected) == (1, len(others) + 1)


def _flipped(frame: Frame, bit: int) -> Frame:
    data = bytearray(frame.data)
    data[bit // 8] ^= 1 << bit % 8
    return frame._replace(data=bytes(data))


def test_a_limit_that_is_no_current_is_refused(mapping: Mapping) -> None:
    for limit in (math.nan, math.inf, -1.0):
        with pytest.raises(ValueError, match="limit"):
            WireGuard(mapping, limit, lambda _frame: None)


# --- a command of which every bit is known ----------------------------------------------------------------------------

STEP = 0.125  # Of the current, little-endian in the first twelve bits [A]; four bits that nothing covers follow
DBC = """\
VERSION ""

NS_ :

BS_:

BU_: Host Drive

BO_ 300 Command: 5 Host
 SG_ Current : 0|12@1- (0.125,0) [0|0] "A" Drive
 SG_ Mode : 16|4@1+ (1,0) [0|0] "" Drive
 SG_ Counter : 20|4@1+ (1,0) [0|0] "" Drive
 SG_ Checksum : 24|8@1+ (1,0) [0|0] "" Drive
 SG_ Gain : 32|8@1- (0.5,0) [0|0] "" Drive

BO_ 301 Mode: 2 Host
 SG_ Mode : 0|4@1+ (1,0) [0|0] "" Drive

BO_ 800 Sensors: 8 Drive
 SG_ Angle : 0|32@1- (0.001,0) [0|0] "rad" Host
 SG_ Velocity : 32|32@1- (0.001,0) [0|0] "rad/s" Host
"""
TOML = """\
schema = 1
name = "known"
[can]
dbc = "known.dbc"
exchange = "broadcast"
pair_within = 0.001
[can.signals]
angle = {signal = "Sensors.Angle", unit = "rad", sign = 1, range = [-100, 200]}
velocity = {signal = "Sensors.Velocity", unit = "rad/s", sign = 1, range = [-900, 900]}
command = {signal = "Command.Current", unit = "A", sign = 1, range = [-5, 4.5], others = {Mode = 5, Gain = -3}}
[can.protection.Command]
kind = "xor"
checksum = "Checksum"
counter = "Counter"
modulus = 3
[[can.arm]]
send = {Mode = {Mode = 2}}
[node]
on_loss = "hold"
watchdog = 0.01
stop = "freewheel"
end_stop_speed = 1800
accept = ["no_answers", "no_echo", "no_device_time", "no_identity", "hold_on_loss", "no_counter", "no_crc", \
"no_current", "no_state"]
"""
KNOWN = parse_mapping(TOML, DBC, "known.toml")


def by_hand(current: float, counter: int = 0, mode: int = 5, gain: int = -6 & 0xFF, unused: int = 0) -> Frame:
    """The command frame, packed by no code of the product."""
    first = (round(current / STEP) & 0xFFF | unused << 12).to_bytes(2, "little")
    rest = bytes((*first, mode | counter << 4, gain))
    return Frame(300, rest[:3] + bytes((rest[0] ^ rest[1] ^ rest[2] ^ rest[3],)) + rest[3:])


class Guarded:
    """The second guard of that drive, and what it let out."""

    def __init__(self, limit: float = LIMIT) -> None:
        self.bus: list[Frame] = []
        self.guard = WireGuard(KNOWN, limit, self.bus.append)

    def refuses(self, frame: Frame, meant: float, words: str) -> None:
        left, rejected = len(self.bus), self.guard.rejected
        with pytest.raises(WireGuardError, match=words):
            self.guard.command(frame, meant)
        assert (len(self.bus), self.guard.rejected) == (left, rejected + 1)


def test_the_packer_by_hand_says_what_the_encoder_says() -> None:
    encoder = Encoder(KNOWN)
    assert [encoder.command(i) for i in (1.0, -2.0, 4.5, 0.0)] == [
        by_hand(i, n) for i, n in ((1.0, 0), (-2.0, 1), (4.5, 2), (0.0, 0))
    ]


def test_what_the_file_s_range_reaches_to_leaves_and_what_is_beyond_it_does_not() -> None:
    for current in (-5.0, 0.0, 4.5):
        it = Guarded()
        assert it.guard.command(by_hand(current), current) == current
        assert it.bus == [by_hand(current)]
        assert (it.guard.passed, it.guard.rejected) == (1, 0)
    for current in (-5.125, 4.625, 100.0):
        Guarded().refuses(by_hand(current), current, f"its bytes say {current:g}, the file allows -5 to 4.5")


@pytest.mark.parametrize(("end", "says", "passes"), [(-5.0625, -5.125, True), (-5.06249, -5.125, False)])
def test_an_end_of_the_range_may_be_passed_by_half_a_step(end: float, says: float, passes: bool) -> None:
    for sign in (1.0, -1.0):
        bounds = sorted((sign * end, 0.0))
        command = replace(KNOWN.command, low=bounds[0], high=bounds[1])
        guard = WireGuard(replace(KNOWN, command=command), LIMIT, lambda _frame: None)
        if passes:
            assert guard.command(by_hand(sign * says), sign * end) == sign * says
        else:
            with pytest.raises(WireGuardError, match="the file allows"):
                guard.command(by_hand(sign * says), sign * end)


def test_half_a_step_beyond_the_range_is_half_a_step_to_the_last_bit() -> None:
    field = KNOWN.command.field
    for sign in (1.0, -1.0):
        says = sign * 5.125
        end = says - sign * 0.500001 * field.step(says)
        assert end + sign * 0.500001 * field.step(end) == says
        low, high = sorted((end, 0.0))
        guard = WireGuard(
            replace(KNOWN, command=replace(KNOWN.command, low=low, high=high)), LIMIT, lambda _frame: None
        )
        assert guard.command(by_hand(says), sign * 5.1) == says


def test_numbers_that_are_not_finite_are_refused() -> None:
    guard = WireGuard(load_mapping(EXAMPLES / "odrive.toml"), LIMIT, lambda _frame: None)
    for value in (math.inf, -math.inf, math.nan):
        with pytest.raises(WireGuardError, match="the file allows"):
            guard.command(Frame(0x00E, struct.pack("<f", value)), 0.0)


def test_a_counter_and_a_checksum_with_scale_and_offset_are_sent_as_they_are_counted() -> None:
    dbc = DBC.replace("Counter : 20|4@1+ (1,0)", "Counter : 20|4@1+ (2,1)").replace("24|8@1+ (1,0)", "24|8@1+ (1,7)")
    encoder = Encoder(parse_mapping(TOML, dbc, "known.toml"))
    assert [encoder.command(1.0) for _ in range(4)] == [by_hand(1.0, counter) for counter in (0, 1, 2, 0)]


def test_a_current_meant_that_is_beyond_the_limit_is_refused_whatever_the_bytes_say() -> None:
    for meant in (1.5, -1.5, math.nan, -math.inf):
        Guarded(limit=1.0).refuses(by_hand(0.5), meant, f"{meant:g} A is beyond 1 A")
    for limit in (0.0, 0.5):  # little or no current
        it = Guarded(limit)
        assert it.guard.command(by_hand(-limit), -limit) == -limit
        it.refuses(by_hand(limit + STEP, 1), limit, f"say {limit + STEP:g} A, expected {limit:g} A")


def test_bytes_may_be_off_by_half_a_step_and_by_what_floating_point_numbers_are_off() -> None:
    for (says, rounding), side in itertools.product(((0.0, 0.0), (1.0, 1e-14), (-3.0, 1e-14)), (1.0, -1.0)):
        farthest = says
        for _ in range(9):  # about 0 the value at which both are the same to the last bit
            farthest = says + side * (0.500001 * STEP + 1e-12 * abs(farthest))
        assert Guarded().guard.command(by_hand(says), farthest - side * rounding) == says
        Guarded().refuses(by_hand(says), farthest + side * max(rounding, 1e-16), "expected")


def test_the_message_s_other_signals_say_what_the_file_says() -> None:
    for mode in (4, 6, 13):
        Guarded().refuses(by_hand(1.0, mode=mode), 1.0, f"Mode is {mode}, expected 5")
    Guarded().refuses(by_hand(1.0, gain=-7 & 0xFF), 1.0, "Gain is -3.5, expected -3")
    for unused in (1, 8, 15):
        Guarded().refuses(by_hand(1.0, unused=unused), 1.0, "has a bit that no signal covers")


def test_a_counter_that_stays_or_leaps_is_refused_until_the_next_one_comes() -> None:
    it = Guarded()
    for wrong in (1, 2):
        it.refuses(by_hand(1.0, wrong), 1.0, f"its counter is {wrong}, expected 0")
    for counter, wrong in ((0, 0), (1, 0), (2, 1), (0, 2)):
        it.guard.command(by_hand(1.0, counter), 1.0)
        it.refuses(by_hand(1.0, wrong), 1.0, f"its counter is {wrong}, expected")
    assert (it.guard.passed, len(it.bus)) == (4, 4)


def test_a_frame_of_a_sequence_that_says_something_else_than_the_file_s_values_is_refused() -> None:
    constant = KNOWN.arm[0].frames[0]
    for data, words in ((b"\x03\0", "Mode is 3, expected 2"), (b"\x12\0", "no signal covers")):
        it = Guarded()
        with pytest.raises(WireGuardError, match=words):  # whoever encoded it was wrong
            it.guard.constant(Frame(301, data), replace(constant, data=data))
        assert (it.bus, it.guard.passed, it.guard.rejected) == ([], 0, 1)
