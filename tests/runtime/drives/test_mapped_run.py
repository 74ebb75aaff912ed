"""emb-run on mapped drives: a whole run, and every way in which one goes wrong. Simulated drives, in lock-step."""

from __future__ import annotations

import html
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from emb_bench.api import fisher_information, open_run
from emb_bench.cli.replay import main as emb_replay
from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main
from emb_runtime.config.bench import parse_bench, shipped_bench_text
from emb_runtime.drives.mapping import PROPERTIES, MappingError
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from tests.actors import constant_actor
from tests.drives import EXAMPLES, SHIPPED
from tests.runtime.drives.mapped import MappedBus, late_bench, runner
from tests.runtime.operating import EmbRun

pytestmark = pytest.mark.usefixtures("handlers")
COMES_TO_REST = 600  # periods


@pytest.fixture
def odrive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[MappedBus, EmbRun]:
    return runner("odrive", tmp_path, capsys, monkeypatch)


def within_limits(bus: MappedBus) -> None:
    """The true brake, which goes on for a while without a commander, stays within the bench's limits."""
    for _ in range(COMES_TO_REST):
        bus.drive.tick()
    low, high = bus.bench.limits.angle
    assert low <= bus.drive.angle_range[0]
    assert bus.drive.angle_range[1] <= high
    assert bus.drive.top_speed <= bus.bench.limits.velocity
    assert not bus.drive.armed


@pytest.mark.parametrize("name", SHIPPED)
def test_a_run_on_a_mapped_drive_is_a_run_and_its_information_that_of_our_node(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # At 6 A the shield chatters at the limits as the noise has it, and two runs of one node differ by more.
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch, current=2.0)
    document = emb_run.document()
    assert (document["result"], document["answered"], document["not_obeyed"]) == ("done", 500, 0)
    within_limits(bus)
    monkeypatch.undo()
    iface = "sim:plant=late-command" if name == "mit" else "sim"
    same = ["--policy", str(tmp_path / "actor.onnx"), "--bench", str(tmp_path / "late.toml")]
    assert main(["--iface", iface, *same, "--log", str(tmp_path / "node.mcap")]) == 0
    mapped, ours = (
        np.linalg.slogdet(
            fisher_information(open_run(tmp_path / f"{log}.mcap"), model=model).fisher("physical").matrix
        )[1]
        for log, model in (("run", "late-command" if name == "mit" else "exact"), ("node", None))
    )
    assert math.expm1((mapped - ours) / 4.0) == pytest.approx(0.0, abs=0.01)  # per parameter


def test_the_log_has_both_sides_and_the_mapping(odrive: tuple[MappedBus, EmbRun]) -> None:
    bus, emb_run = odrive
    emb_run.document()
    log = emb_run.log()
    received, sent = log.tables["/drive/rx"], log.tables["/drive/tx"]
    assert set(received["id"]) == {0x001, 0x009, 0x014}
    assert set(sent["id"]) == {0x00B, 0x007, 0x00E, 0x018}
    assert len(sent["id"]) == sum(frame.identifier != 0 for frame in bus.sent)
    assert set(log.tables["/can/rx"]["id"]) == {0x100, 0x101, 0x102}
    assert log.metadata["emb.drive"]["lost"].split(", ") == list(bus.transport.mapping.lost)
    assert log.metadata["emb.run"]["bus_mapping_sha256"] == bus.transport.mapping.sha256
    assert int(log.metadata["emb.end"]["drive_obeyed"]) == 500
    assert log.metadata["emb.end"]["drive_frames_refused"] == "0"
    assert {"drive.toml", "drive.dbc"} <= set(log.attachments)
    assert log.attachments["drive.toml"] == bus.transport.mapping.text.encode()


def test_the_report_and_the_summary_of_a_log_say_what_the_drive_lacks(
    odrive: tuple[MappedBus, EmbRun], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, emb_run = odrive
    emb_run.text("--read-only", "--duration", "0.2")
    assert emb_replay(["info", str(tmp_path / "run.mcap")]) == 0
    summary = capsys.readouterr().out
    report = ["report", str(tmp_path / "run.mcap"), "-o", str(tmp_path / "run.html")]
    assert emb_replay(report) == 1  # nothing was sent: there is no experiment, and no estimate
    page = html.unescape((tmp_path / "run.html").read_text())
    for name in bus.transport.mapping.lost:
        assert f"{name}: {PROPERTIES[name]}" in summary
        assert f"{name}: {PROPERTIES[name]}" in page
    assert f"ODrive CANSimple, axis 0, SHA-256 of the mapping {bus.transport.mapping.sha256[:16]}" in page


def test_a_bench_file_that_names_its_mapping_takes_no_other(odrive: tuple[MappedBus, EmbRun], tmp_path: Path) -> None:
    bus, emb_run = odrive
    there = load_mapping(EXAMPLES / "odrive.toml").sha256
    without = parse_bench(late_bench(), "bench.toml")
    named = late_bench().replace("bitrate = 1000000", f'bitrate = 1000000\nmapping = "{there}"')
    assert parse_bench(named, "bench.toml").contract_hash != without.contract_hash
    (tmp_path / "late.toml").write_text(named)
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(named, "bench.toml")))
    document = emb_run.document("--duration", "0.05", "--zero")
    (line,) = (line for line in document["preflight"] if line["what"] == "drive")
    assert f"mapping {there[:12]}, as the bench file names it" in line["found"]
    bus.edits.append(("axis 0", "axis 1"))
    (tmp_path / "run.mcap").unlink()
    emb_run.refused(f"the bench file was made for another (can.mapping = {there[:12]}…)")


def test_the_pre_flight_names_all_that_the_drive_lacks(odrive: tuple[MappedBus, EmbRun]) -> None:
    bus, emb_run = odrive
    (line,) = (line for line in emb_run.document()["preflight"] if line["what"] == "drive")
    for name in bus.transport.mapping.lost:
        assert f"{name} ({PROPERTIES[name]})" in line["found"]
    assert line["verdict"] == "warning"
    assert f'can.mapping = "{bus.transport.mapping.sha256}"' in line["found"]


# Bits by hand, in each ms: an 11-bit frame of 8, 6, 4 bytes has at most 135, 115, 95; a 29-bit one of 8 and 4 160 and
# 120. The ODrive's heartbeat of 8 bytes is believed for a quarter of a second, and comes each tenth.
@pytest.mark.parametrize(
    ("name", "worst", "heard"),
    [("odrive", 2 * 135 + 95 + 135 / 250, 2 * 135 + 1.35), ("vesc", 2 * 160 + 120, 2 * 160), ("mit", 250, 250)],
)
def test_the_bus_load_of_the_pre_flight_is_that_of_the_drive_s_own_frames(
    name: str,
    worst: float,
    heard: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    (line,) = (line for line in emb_run.document("--zero")["preflight"] if line["what"] == "bus load")
    assert line["found"] == (
        f"{worst / 1000:.0%} at worst by the drive's DBC at 1000000 bit/s (can.bitrate), {heard / 1000:.0%} heard"
    )
    assert float(emb_run.log().metadata["emb.run"]["bus_load_worst"]) == pytest.approx(worst / 1000, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "bitrate", "verdict"),
    [
        ("odrive", 400_000, "refused"),
        ("vesc", 600_000, "ok"),
        ("vesc", 500_000, "refused"),
        ("mit", 300_000, "refused"),
    ],
)
def test_a_bus_too_slow_for_the_drive_s_frames_is_refused_before_anything_is_armed(
    name: str,
    bitrate: int,
    verdict: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Our own messages would take 94, 63, 75 and 125 % of it.
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    text = late_bench(polled=name == "mit").replace("bitrate = 1000000", f"bitrate = {bitrate}")
    (tmp_path / "late.toml").write_text(text)
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(text, "slow.toml")))
    if verdict == "ok":
        document = emb_run.document("--zero")
        assert {line["verdict"] for line in document["preflight"] if line["what"] == "bus load"} == {"ok"}
    else:
        _, err = emb_run.streams("--zero", code=2)
        assert "emb-run: pre-flight, bus load: " in err
        asked = {b"\x80\0\x80\0\0\0\x08\0"} if name == "mit" else set()  # 0 A, to be answered
        assert {frame.data for frame in bus.sent} == asked


@pytest.mark.parametrize("shift", [20, 60, 95])
def test_the_drive_is_armed_whenever_its_heartbeat_comes(shift: int, odrive: tuple[MappedBus, EmbRun]) -> None:
    bus, emb_run = odrive
    bus.shift = shift
    assert emb_run.document("--duration", "0.05", "--zero")["result"] == "done"


def test_with_zero_the_drive_is_armed_and_gets_0_a_only(odrive: tuple[MappedBus, EmbRun]) -> None:
    bus, emb_run = odrive
    assert emb_run.document("--zero")["result"] == "done"
    torques = {struct.unpack("<f", frame.data)[0] for frame in bus.sent if frame.identifier == 0x00E}
    assert torques == {0.0}
    assert any(frame.identifier == 0x007 and frame.data[0] == 8 for frame in bus.sent)
    within_limits(bus)
    # It was let go by its own time-out once, and its heartbeat was awaited for just after that.
    assert emb_run.log().metadata["emb.end"]["drive_time_out"] == "let go within 0.013 s without a command"


@pytest.mark.parametrize("watchdog", [None, 0.02], ids=["off", "twice as long"])
def test_with_zero_a_drive_whose_time_out_does_not_act_is_refused(
    watchdog: float | None, odrive: tuple[MappedBus, EmbRun]
) -> None:
    bus, emb_run = odrive
    bus.at = 0, lambda drive: setattr(drive, "watchdog", watchdog)
    _, err = emb_run.streams("--zero", code=4)
    assert "its time-out did not act: 0.013 s after" in err
    assert "node.watchdog says 0.01 s; switch it on in the drive" in err
    assert not bus.drive.armed
    assert {frame.data for frame in bus.sent if frame.identifier == 0x00E} == {bytes(4)}


@pytest.mark.parametrize("name", ["vesc", "mit"])
def test_where_the_drive_does_not_say_its_state_the_log_says_that_the_time_out_is_not_proved(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    assert emb_run.document("--zero")["result"] == "done"
    assert emb_run.log().metadata["emb.end"]["drive_time_out"].startswith("not provable")


@pytest.mark.parametrize(("name", "bit_ms"), [("odrive", 0.23), ("vesc", 0.28), ("mit", 1.0)])
def test_with_zero_it_is_told_how_late_the_answers_acted(
    name: str, bit_ms: float, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A polled drive acts at the next poll; else two frames' worst time on the bus is what lock-step knows of.
    _, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    assert f"answers acted at most {bit_ms:.2f} ms after the measurement" in emb_run.text("--zero")


def test_answers_later_than_declared_end_zero_with_exit_1_and_the_declaration_that_fits(
    odrive: tuple[MappedBus, EmbRun], tmp_path: Path
) -> None:
    bus, emb_run = odrive
    slow = late_bench().replace("bitrate = 1000000", "bitrate = 520000")
    (tmp_path / "late.toml").write_text(slow)
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(slow, "slow.toml")))
    bus.change = lambda frame: frame._replace(time_ns=frame.time_ns - 700_000)
    document = emb_run.document("--zero", code=1)
    assert document["answered"] == 500
    assert (
        "1.14 periods after its measurement, shield.frame_age = [0, 1] declares less: declare [0, 2]"
        in (document["detail"])
    )


def test_read_only_sends_nothing(odrive: tuple[MappedBus, EmbRun]) -> None:
    bus, emb_run = odrive
    emb_run.text("--read-only", "--duration", "0.5")
    assert bus.sent == []
    assert set(emb_run.log().tables["/drive/rx"]["id"]) == {0x001, 0x009, 0x014}


def test_read_only_is_refused_where_the_drive_speaks_only_when_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, emb_run = runner("mit", tmp_path, capsys, monkeypatch)
    emb_run.refused("--zero asks it for samples", "--read-only")
    assert bus.sent == []


def test_a_drive_that_is_not_commanded_any_more_lets_go_by_its_own_time_out(
    odrive: tuple[MappedBus, EmbRun],
) -> None:
    bus, emb_run = odrive

    def killed(_frame: Frame) -> None:
        raise BusError("vcan0: the interface is down")

    bus.at = 50, lambda _drive: setattr(bus, "before_send", killed)
    assert emb_run.document(code=4)["result"] == "BUS_LOST"
    assert bus.drive.armed
    for _ in range(12):
        bus.drive.tick()
    assert not bus.drive.armed


def test_a_drive_that_cannot_be_armed_is_one_line_and_exit_4(
    odrive: tuple[MappedBus, EmbRun], capsys: pytest.CaptureFixture[str]
) -> None:
    bus, emb_run = odrive
    bus.edits.append(("Axis_Requested_State = 8", "Axis_Requested_State = 3"))
    out, err = emb_run.streams("--json", code=4)
    assert "cannot arm the drive: the drive did not become active within 0.5 s" in err
    assert not any(json.loads(line).get("answered") for line in out.splitlines())
    assert not bus.drive.armed


def test_the_mapped_log_reruns(odrive: tuple[MappedBus, EmbRun], tmp_path: Path) -> None:
    _, emb_run = odrive
    emb_run.document()
    assert read_log(tmp_path / "run.mcap").complete
    assert emb_replay(["rerun", str(tmp_path / "run.mcap")]) == 0


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("range = [-0.1303, 0.1303]", "range = [-0.1, 0.1]", "does not cover the bench's ±6 A"),
        ("range = [-2, 17]", "range = [-2, 15]", "does not cover the bench's -10 to 100 rad"),
        ("range = [-90, 90]", "range = [-70, 70]", "does not cover the bench's -500 to 500 rad/s"),
        ("pair_within = 0.0005", "pair_within = 0.0006", "at most half of the bench's sample time"),
        ("end_stop_speed = 1800", "end_stop_speed = 1700", "may reach 1711 rad/s, and bears 1700 rad/s; narrow"),
    ],
)
def test_a_mapping_that_does_not_cover_the_bench_is_refused(old: str, new: str, reason: str) -> None:
    bus = MappedBus("odrive", late_bench())
    bus.edits.append((old, new))
    with pytest.raises(MappingError, match=reason):
        bus.open("map:odrive.toml@sim-drive", bus.bench)


def test_a_drive_whose_time_out_is_longer_than_the_bench_s_is_refused() -> None:
    text = late_bench().replace("watchdog         = 0.010", "watchdog         = 0.008")
    assert text != late_bench()
    bus = MappedBus("odrive", text)
    with pytest.raises(MappingError, match=r"longer than the bench's node\.watchdog"):
        bus.open("map:odrive.toml@sim-drive", bus.bench)


def test_frames_without_an_age_are_refused(odrive: tuple[MappedBus, EmbRun], tmp_path: Path) -> None:
    _, emb_run = odrive
    (tmp_path / "late.toml").write_text(shipped_bench_text())
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(shipped_bench_text(), "bench.toml")))
    emb_run.refused("shield.frame_age: a mapped drive does not answer by sample")
