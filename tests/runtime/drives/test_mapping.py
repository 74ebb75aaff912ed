"""A mapping file is refused in one line wherever it is wrong, and what the drive lacks must be accepted by name."""

from __future__ import annotations

import math
import random
import re
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from emb_runtime.config.bench import Sensors, load_bench
from emb_runtime.drives.mapping import PROPERTIES, MappingError, require_fit
from emb_runtime.drives.mapping_file import load_mapping, parse_mapping
from emb_runtime.drives.signals import make_field, physical_value, raw_value
from emb_runtime.drives.wire import Encoder, Receiver
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import BenchFileError
from emb_runtime.records import Frame
from tests.drives import EXAMPLES, LIMIT, SHIPPED, AnyCommand, RandomMapping


def texts(name: str) -> tuple[str, str]:
    return tuple((EXAMPLES / f"{name}.{kind}").read_text() for kind in ("toml", "dbc"))  # type: ignore[return-value]


def refusal(toml: str, dbc: str) -> str:
    with pytest.raises(MappingError) as caught:
        parse_mapping(toml, dbc, "drive.toml")
    message = str(caught.value)
    assert message.isprintable()
    assert message.startswith("drive.toml: ")
    return message


def test_the_shipped_examples_are_accepted_with_all_that_they_lack() -> None:
    for name in SHIPPED:
        mapping = load_mapping(EXAMPLES / f"{name}.toml")
        assert {"no_answers", "no_echo", "no_device_time", "no_identity", "hold_on_loss"} <= set(mapping.lost)
        assert set(mapping.lost) <= set(PROPERTIES)


def test_units_and_signs_become_si() -> None:
    toml, dbc = texts("vesc")
    mapping = parse_mapping(toml.replace('"deg", sign = 1', '"deg", sign = -1'), dbc, "drive.toml")
    assert mapping.angle.factor == pytest.approx(-math.pi / 180.0)
    assert mapping.velocity.factor == pytest.approx(2.0 * math.pi / 60.0 / 7.0)
    assert load_mapping(EXAMPLES / "odrive.toml").command.factor == pytest.approx(0.0217)
    assert load_mapping(EXAMPLES / "odrive.toml").angle.factor == pytest.approx(2.0 * math.pi)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_property_that_is_lost_must_be_accepted_by_name(name: str) -> None:
    toml, dbc = texts(name)
    for lost in parse_mapping(toml, dbc, "drive.toml").lost:
        message = refusal(toml.replace(f'"{lost}",', ""), dbc)
        assert f"node.accept: '{lost}' is not accepted" in message
        assert PROPERTIES[lost] in message
        assert "nor are" not in message
    first, *others = parse_mapping(toml, dbc, "drive.toml").lost
    message = refusal(re.sub(r"accept +=.*?\]", "accept = []", toml, flags=re.DOTALL), dbc)
    assert f"'{first}' is not accepted: {PROPERTIES[first]}; nor are {', '.join(others)}" in message


def test_nothing_accepts_a_drive_without_a_time_out() -> None:
    toml, dbc = texts("odrive")
    without = toml.replace("watchdog = 0.010", "").replace("accept   = [", 'accept   = ["no_watchdog",')
    message = refusal(without, dbc)
    assert "node.watchdog: missing" in message
    assert "no key accepts it" in message


def test_a_mistake_is_one_line_that_names_it() -> None:
    velocity = next(line for line in texts("odrive")[0].splitlines() if line.startswith("velocity"))
    arm = 'send = {MIT_Command = "ff ff ff ff ff ff ff fc"}'
    for old, new, reason in (
        ("schema = 1", "schema = 2", "schema: expected 1"),
        (velocity, "", "velocity: missing: expected the velocity, by which the shield stops the brake"),
        ("end_stop_speed = 1800", "", "node.end_stop_speed: missing"),
        ("watchdog = 0.010", "watchdog = 0", "node.watchdog: expected"),
        ("watchdog = 0.010", "watchdog = 0.011", "node.watchdog: expected"),
        ('"no_crc",', '"no_crc", "no_current",', "nothing that this drive lacks"),
        ("BO_ 1 ", "BO_ 256 ", "identifier 0x100 of a message of ours"),
        (", Kp = 0", "", "can.signals.command.others: expected a value for Kd, Kp, Position, Velocity"),
        (arm, f'{arm}\nwait = {{state = "idle", timeout = 1}}', "names no state"),
        ("ff ff ff ff ff ff ff fc", "ff", "expected 8 bytes, got 1"),
        ("ff ff ff ff ff ff ff fc", "arm!", "hexadecimal"),
        ("Pos_Estimate", "Position", "Axis0_Get_Encoder_Estimates has no signal 'Position'"),
        ("Axis0_Get_Iq.", "Axis1_Get_Iq.", "the DBC has no message 'Axis1_Get_Iq'"),
        ("Axis0_Get_Iq.Iq_Measured", "Iq_Measured", "expected MESSAGE.SIGNAL"),
        ('unit = "rev/s"', 'unit = "knots"', "can.signals.velocity.unit: expected one of"),
        ('unit = "rev", sign = 1', 'unit = "rev"', "can.signals.angle.sign: missing"),
        ('unit = "rev", sign = 1', 'unit = "rev", sign = 2', "expected one of -1, 1, got 2"),
        ('unit = "rev", sign = 1', 'unit = "rev", sign = true', "expected one of -1, 1, got true"),
        (", range = [-2, 17]", "", "can.signals.angle.range: missing"),
        ("range = [-2, 17]", "range = [17, -2]", "the lower value"),
        ("range = [-2, 17]", "range = [nan, 17]", "finite"),
        ("range = [-0.1303, 0.1303]", "range = [0.01, 0.1303]", "0 must lie inside"),
        ("per_ampere = 0.0217, ", "", "can.signals.command.per_ampere: missing"),
        ("per_ampere = 0.0217", "per_ampere = 0", "per_ampere: expected a number above 0"),
        ("active = [8]", "active = [1]", "cannot be both idle and active"),
        ('error = "Axis_Error"', 'error = "Error"', "no such signal"),
        ('exchange    = "broadcast"', 'exchange    = "gossip"', "can.exchange"),
        ("pair_within = 0.0005", "pair_within = 0", "can.pair_within"),
        ("Input_Torque = 0}", "Input_Torque = 0.1}", "a sequence commands no current"),
        ("Axis_Requested_State = 8", "Axis_Requested_State = -1", "does not fit the DBC"),
        ("Axis_Requested_State = 8", "Axis_Requested_State = 4294967296", "does not fit the DBC"),
        (", Kp = 0", ", Kp = 600", "can.signals.command: the DBC cannot carry -1.18, -6.04199 A"),
        ("range = [-1.18, 1.18]", "range = [-1.18, 18.1]", "can.signals.command: the DBC cannot carry 18.1"),
        ("range = [-1.2, 11.3]", "range = [-1.2, 12.6]", "can.signals.angle.range: MIT_Reply.Position carries"),
        ("range = [-60, 60]", "range = [-65.1, 60]", "can.signals.velocity.range: MIT_Reply.Velocity carries"),
        ("active = [8]", "active = [256]", "Axis0_Heartbeat.Axis_State carries 0 to 255, and never 256"),
        ("BO_ 9 ", "BO_ 99999999999 ", "the DBC has no message 'Axis0_Get_Encoder_Estimates'"),
        ("Axis_Requested_State = 8", "Axis_State = 8", "does not fit the DBC"),
        ('{state = "active", timeout = 0.5}', '{state = "active", timeout = 50}', "timeout"),
        ('on_loss  = "hold"', 'on_loss  = "brake"', "node.on_loss"),
        ('default = "none"', 'default = "profile1"', "can.protection.default"),
        ('default = "none"', 'Nothing = {kind = "none"}', "can.protection.Nothing: unknown key"),
        ('default = "none"', 'Axis0_Get_Iq = {kind = "xor"}', "checksum: missing"),
        ("[node]", "[nodes]", "nodes: unknown key"),
        ("range = [-90, 90]", "range = [-90, 90], observer_bandwidth = 0", "velocity.observer_bandwidth: expected"),
        ("range = [-90, 90]", "range = [-90, 90], velocity_lag = 2", "velocity_lag: expected"),
        (
            "range = [-90, 90]",
            "range = [-90, 90], observer_bandwidth = 1000, velocity_lag = 0.001",
            "can.signals.velocity.velocity_lag: does not go with observer_bandwidth",
        ),
        ("sign = 1, range = [-2, 17]", "sign = 1, sine = 1, range = [-2, 17]", "sine: unknown key"),
    ):  # fmt: skip
        toml, dbc = next(files for files in map(texts, ("odrive", "mit")) if any(old in text for text in files))
        wrong = (toml.replace(old, new, 1), dbc) if old in toml else (toml, dbc.replace(old, new, 1))
        assert reason in refusal(*wrong), old


def test_a_bench_file_must_declare_the_observer_of_a_mapping_or_a_slower_one() -> None:
    toml, dbc = texts("odrive")
    shipped = load_bench()
    bench = replace(shipped, shield=shipped.shield._replace(frame_age=(0, 1)))
    silent = parse_mapping(toml, dbc, "drive.toml")
    for key, value, slower, faster in (("observer_bandwidth", 1000, 900.0, 1100.0), ("velocity_lag", 9e-4, 1e-3, 8e-4)):
        drive = parse_mapping(toml.replace("[-90, 90]", f"[-90, 90], {key} = {value}"), dbc, "drive.toml")
        for declared in (float(value), slower):
            require_fit(drive, replace(bench, sensors=Sensors("observer", **{key: declared})))
        require_fit(silent, replace(bench, sensors=Sensors("observer", **{key: faster})))
        for sensors in (Sensors(), Sensors("observer", **{key: faster})):
            with pytest.raises(
                BenchFileError, match=rf"^sensors: .* is {drive.sensors} .* declares {sensors}: declare it"
            ):
                require_fit(drive, replace(bench, sensors=sensors))
    require_fit(silent, bench)


def test_the_ranges_of_the_dbc_are_not_used() -> None:
    for name in SHIPPED:
        toml, dbc = texts(name)
        for narrow in ("[0|0]", "[7|7]", "[-1|1]", "[5|-5]"):
            mapping = parse_mapping(toml, dbc.replace("[0|0]", narrow), "drive.toml")
            for current in (-6.0, 6.0):
                assert Encoder(mapping).command(current) == Encoder(load_mapping(EXAMPLES / f"{name}.toml")).command(
                    current
                )


def test_an_angle_that_begins_anew_is_believed_over_its_whole_period() -> None:
    toml, dbc = texts("vesc")
    for low, high, whole in ((0, 359.98, True), (-180, 180, True), (0, 350, False), (0, 720, False)):
        changed = toml.replace("range = [0, 360]", f"range = [{low}, {high}]")
        if whole:
            parse_mapping(changed, dbc, "drive.toml")
        else:
            assert "can.signals.angle.range: " in refusal(changed, dbc)


def multiplexed() -> tuple[str, str]:
    """An ODrive whose position and velocity are two pages of a message, and its torque one of another."""
    toml, dbc = texts("odrive")
    for old, new in (
        (' SG_ Pos_Estimate : 0|32@1- (1,0) [0|0] "rev" Host', ' SG_ Page M : 0|8@1+ (1,0) [0|0] "" Host\n'
         ' SG_ Age : 56|8@1+ (1,0) [0|0] "" Host\n SG_ Pos_Estimate m1 : 8|32@1- (1,0) [0|0] "rev" Host'),
        (' SG_ Vel_Estimate : 32|32@1-', ' SG_ Vel_Estimate m2 : 8|32@1-'),
        (' SG_ Input_Torque : 0|32@1- (1,0) [0|0] "Nm" Axis0', ' SG_ Mode M : 0|8@1+ (1,0) [0|0] "" Axis0\n'
         ' SG_ Input_Torque m3 : 8|32@1- (1,0) [0|0] "Nm" Axis0\n SG_ Input_Vel m4 : 40|16@1- (1,0) [0|0] "" Axis0'),
        ("BO_ 14 Axis0_Set_Input_Torque: 4", "BO_ 14 Axis0_Set_Input_Torque: 7"),
    ):  # fmt: skip
        assert old in dbc, old
        dbc = dbc.replace(old, new)
    toml = toml.replace("range = [-0.1303, 0.1303]}", "range = [-0.1303, 0.1303], others = {Mode = 3}}")
    return toml.replace("{Input_Torque = 0}", "{Mode = 3, Input_Torque = 0}"), dbc


def test_multiplexed_signals_are_read_by_the_value_of_their_multiplexor_and_sent_with_it() -> None:
    mapping = parse_mapping(*multiplexed(), "drive.toml")
    receiver = Receiver(mapping, 20)
    page = {number: struct.pack("<Bf2xB", number, 0.25 * number, 9) for number in (1, 2, 3)}
    for period in range(3):
        frames = [Frame(0x009, page[1 + (n + period) % 3], 10_000_000 * period + n) for n in range(3)]  # in any order
        frames.append(Frame(0x014, struct.pack("<ff", 0.0, 1.5), 10_000_000 * period + 3))
        (sample,) = (found for frame in frames if (found := receiver.add_frame(frame)) is not None)
        assert sample[:3] == pytest.approx((0.25 * 2.0 * math.pi, 0.5 * 2.0 * math.pi, 1.5))
    encoder, sent = Encoder(mapping), list[Frame]()
    guard = WireGuard(mapping, 6.0, sent.append)
    frame = encoder.command(2.0)
    assert frame.data == b"\x03" + struct.pack("<fH", 2.0 * 0.0217, 0)
    assert guard.command(frame, 2.0) == pytest.approx(2.0, rel=1e-6)
    with pytest.raises(WireGuardError, match="Mode is 4"):
        guard.command(frame._replace(data=b"\x04" + frame.data[1:]), 2.0)
    for step in mapping.disarm:
        for constant in step.frames:
            guard.constant(mapping.messages[constant.message].frame(constant.data), constant)
    assert sent[1].data == b"\x03" + bytes(6)


def test_what_of_a_multiplexed_message_has_no_one_meaning_is_refused() -> None:
    toml, dbc = multiplexed()
    assert "expected 3, of" in refusal(toml.replace("others = {Mode = 3}", "others = {Mode = 4}"), dbc)
    assert "expected a value for Mode" in refusal(toml.replace(", others = {Mode = 3}", ""), dbc)
    assert "does not fit the DBC" in refusal(toml.replace("{Mode = 3, Input_Torque = 0}", "{Mode = 3}"), dbc)
    scaled = dbc.replace("SG_ Page M : 0|8@1+ (1,0)", "SG_ Page M : 0|8@1+ (2,0)")
    assert "expected a multiplexor without scale and offset" in refusal(toml, scaled)
    common = dbc.replace("Input_Torque m3 :", "Input_Torque :")
    assert "expected a signal of one value of the multiplexor" in refusal(toml, common)
    counted = toml.replace('default = "none"', 'Axis0_Get_Encoder_Estimates = {kind = "none", counter = "Age"}')
    assert "a multiplexed message with a counter" in refusal(counted, dbc)
    pages = "".join(f"SG_MUL_VAL_ 9 {name} Page {n}-{n};\n" for name, n in (("Pos_Estimate", 1), ("Vel_Estimate", 2)))
    nested = dbc.replace("SG_ Age :", "SG_ Age m1M :") + pages + "SG_MUL_VAL_ 9 Age Page 1-1;\n"
    assert "one multiplexor at most" in refusal(toml, nested)


def test_a_command_of_any_signal_is_decoded_as_the_current_that_was_meant_or_the_mapping_is_refused() -> None:
    refused = 0
    for seed in range(500):
        drawn, draw = AnyCommand(seed), random.Random(seed)
        misfit, reason = max(map(drawn.error_carried, (-drawn.span, 0.0, drawn.span))), ""
        try:
            mapping = parse_mapping(drawn.toml, drawn.dbc, "drive.toml")
        except MappingError as err:
            reason = str(err)
        if misfit > 0.501:
            assert "can.signals.command: the DBC cannot carry" in reason
            refused += 1
            continue
        assert reason == "", seed
        sent = list[Frame]()
        encoder, guard = Encoder(mapping), WireGuard(mapping, 2.0 * LIMIT, sent.append)
        ends = [end / mapping.command.factor for end in (-drawn.span, drawn.span)]
        for meant in (0.0, *(end * (1.0 - 1e-15) for end in ends), *(draw.uniform(*ends) for _ in range(10))):
            guard.command(encoder.command(meant), meant)
            assert abs(drawn.amperes(sent[-1].data) - meant) <= 0.501 * drawn.ampere_step, seed
    assert 100 < refused < 400


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(MappingError, match=r"nowhere\.toml: cannot read the file"):
        load_mapping(tmp_path / "nowhere.toml")
    path = tmp_path / "drive.toml"
    path.write_text(texts("odrive")[0])
    with pytest.raises(MappingError, match=r"odrive\.dbc: cannot read the file"):
        load_mapping(path)
    (tmp_path / "odrive.dbc").write_text("no DBC")
    with pytest.raises(MappingError, match=r"can\.dbc: DBC: not readable"):
        load_mapping(path)
    path.write_text("[can")
    with pytest.raises(MappingError, match="not valid TOML"):
        load_mapping(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_a_dbc_is_read_in_the_encodings_that_its_tools_write(tmp_path: Path, encoding: str) -> None:
    dbc = (EXAMPLES / "odrive.dbc").read_text(encoding="utf-8") + 'CM_ "Temperatur in °C, Spannung ±5 %";\n'
    toml = (EXAMPLES / "odrive.toml").read_text(encoding="utf-8")
    (tmp_path / "drive.toml").write_text(toml, encoding="utf-8-sig")
    (tmp_path / "odrive.dbc").write_text(dbc, encoding=encoding)
    assert load_mapping(tmp_path / "drive.toml").sha256 == parse_mapping(toml, dbc, "drive.toml").sha256


def test_the_hash_follows_both_files() -> None:
    toml, dbc = texts("odrive")
    first = parse_mapping(toml, dbc, "drive.toml").sha256
    assert first == load_mapping(EXAMPLES / "odrive.toml").sha256
    assert first != parse_mapping(toml + "\n", dbc, "drive.toml").sha256
    assert first != parse_mapping(toml, dbc + "\n", "drive.toml").sha256


def test_bits_are_read_as_cantools_reads_them() -> None:
    for seed in range(100):
        drawn = RandomMapping(seed)
        message = parse_mapping(drawn.toml, drawn.dbc, "drive.toml").messages["Command"].dbc
        data = bytes((seed * 37 + 101 * i) % 251 for i in range(8))
        for signal in message.signals:
            field = make_field(signal)
            scaled = message.decode_simple(data, scaling=True, decode_choices=False)[signal.name]
            assert isinstance(scaled, float | int)
            assert physical_value(field, data) == pytest.approx(scaled, rel=1e-12, nan_ok=True)
            if not signal.is_float:
                assert raw_value(field, data) == message.decode_simple(data, scaling=False)[signal.name]
