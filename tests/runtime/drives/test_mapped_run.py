"""emb-run on mapped drives in lock-step: whole runs, what the log has of the drive, and what is refused."""

from __future__ import annotations

import contextlib
import html
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emb_bench.api import fisher_information, open_run
from emb_bench.cli.replay import main as emb_replay
from emb_bench.rerun import rerun_as_recorded
from emb_runtime.cli.main import main
from emb_runtime.config.bench import parse_bench
from emb_runtime.drives.mapping import PROPERTIES, require_fit
from emb_runtime.drives.phases import Off
from emb_runtime.errors import BusError, UsageError
from simulated_drives import ODrive
from tests.actors import constant_actor
from tests.drives import SHIPPED, late_bench
from tests.runtime.drives.mapped import MappedBus, runner, within_limits
from tests.runtime.operating import EmbRun

pytestmark = pytest.mark.usefixtures("handlers", "one_process")


@pytest.fixture
def odrive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[MappedBus, EmbRun]:
    return runner("odrive", tmp_path, capsys, monkeypatch)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_run_on_a_mapped_drive_is_a_run_and_its_information_that_of_our_node(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # At 6 A the shield chatters at the limits as the noise has it, and two runs of one node differ by more.
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch, current=3.0)
    document = emb_run.document()
    assert (document["result"], document["answered"], document["not_obeyed"]) == ("done", 500, 0)
    node = bus.transport.node
    assert (node.answers.obeyed, node.outlet.guard.rejected, node.times.too_late) == (500, 0, "")
    assert (node.phase, node.failure) == (Off(), "")  # at rest, and let go
    within_limits(bus)
    told = {"temperature": 25.0, "supply_voltage": 24.0} if name == "vesc" else {}  # EMB_Conditions of its gateway
    assert open_run(tmp_path / "run.mcap").conditions == pytest.approx(told)
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
    # Per parameter. The sample at which the response is proven, and so the slower law ends, has a part in it.
    assert math.expm1((mapped - ours) / 4.0) == pytest.approx(0.0, abs=0.15 if name == "mit" else 0.02)


def test_the_log_has_the_mapping_and_reruns_and_another_mapping_in_it_is_found(
    odrive: tuple[MappedBus, EmbRun], tmp_path: Path
) -> None:
    bus, emb_run = odrive
    emb_run.document()
    log = emb_run.log()
    mapping = {"name": "ODrive CANSimple, axis 0", "sha256": bus.mapping.sha256}
    assert log.metadata["emb.drive"] == {**mapping, "lost": ", ".join(bus.mapping.lost), "bus": ""}
    assert log.attachments["drive.toml"] == bus.mapping.text.encode()
    assert log.attachments["drive.dbc"] == bus.mapping.dbc_text.encode()
    assert {frame.identifier for frame in bus.sent} - {0} == {0x00B, 0x007, 0x00E, 0x018}
    assert log.span[1] - log.span[0] == pytest.approx(0.7e9, abs=0.1e9)  # each frame has its time, the gateway's, too
    assert emb_replay(["rerun", str(tmp_path / "run.mcap")]) == 0
    files = {"drive.toml": bus.mapping.text.replace("0.0217", "0.0218").encode()}
    again = rerun_as_recorded(replace(log, attachments={**log.attachments, **files}))
    assert [difference.what for difference in again.differences] == ["mapping_sha256"]


def test_pre_flight_report_and_summary_name_what_the_drive_lacks(
    odrive: tuple[MappedBus, EmbRun], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, emb_run = odrive
    document = json.loads(emb_run.text("--read-only", "--duration", "0.2", "--json"))
    lines = {line["what"]: line for line in document["preflight"]}
    assert emb_replay(["info", str(tmp_path / "run.mcap")]) == 0
    summary = capsys.readouterr().out
    report = ["report", str(tmp_path / "run.mcap"), "-o", str(tmp_path / "run.html")]
    assert emb_replay(report) == 1  # nothing was sent: there is no experiment, and no estimate
    page = html.unescape((tmp_path / "run.html").read_text())
    for name in bus.mapping.lost:
        assert f"{name} ({PROPERTIES[name]})" in lines["drive"]["found"]
        assert f"{name}: {PROPERTIES[name]}" in " ".join(summary.split())
        assert f"{name}: {PROPERTIES[name]}" in page
    assert lines["drive"]["verdict"] == "warning"
    assert f'can.mapping = "{bus.mapping.sha256}"' in lines["drive"]["found"]
    assert f"ODrive CANSimple, axis 0, SHA-256 of the mapping {bus.mapping.sha256[:16]}" in page


def test_a_bench_file_that_names_its_mapping_takes_no_other(odrive: tuple[MappedBus, EmbRun], tmp_path: Path) -> None:
    bus, emb_run = odrive
    there = bus.mapping.sha256
    without = parse_bench(late_bench(), "bench.toml")
    named = late_bench().replace("bitrate = 1000000", f'bitrate = 1000000\nmapping = "{there}"')
    assert parse_bench(named, "bench.toml").identity_hash != without.identity_hash
    (tmp_path / "late.toml").write_text(named)
    (tmp_path / "actor.onnx").write_bytes(constant_actor(parse_bench(named, "bench.toml")))
    document = emb_run.document("--duration", "0.05", "--zero")
    (line,) = (line for line in document["preflight"] if line["what"] == "drive")
    assert f"mapping {there[:12]}, as the bench file names it" in line["found"]
    bus.edit("axis 0", "axis 1")
    (tmp_path / "run.mcap").unlink()
    emb_run.refused(f"the bench file was made for another (can.mapping = {there[:12]}…)")


def test_with_zero_only_0_a_leaves_and_the_time_out_was_proved_whenever_the_heartbeat_comes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for shift in (0, 20, 60, 95):
        (folder := tmp_path / str(shift)).mkdir()
        bus, emb_run = runner("odrive", folder, capsys, monkeypatch)
        bus.shift = shift
        assert emb_run.document("--duration", "0.05", "--zero")["result"] == "done"
        assert {frame.data for frame in bus.sent if frame.identifier == 0x00E} == {bytes(4)}
        assert bus.transport.node.arming.time_out == "disarmed within 0.011 s without a command"
        within_limits(bus)


def test_a_drive_whose_time_out_does_not_act_gets_no_current(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for watchdog in (None, 0.02):
        (folder := tmp_path / str(watchdog)).mkdir()
        bus, emb_run = runner("odrive", folder, capsys, monkeypatch)
        bus.watchdog = watchdog
        _, err = emb_run.streams(code=4)
        late = "set the drive's to node.watchdog = 0.01 s"
        assert (late if watchdog else "its time-out did not act: 0.111 s after the last command") in err
        assert not bus.drive.armed
        assert {frame.data for frame in bus.sent if frame.identifier == 0x00E} == {bytes(4)}


@pytest.mark.parametrize("says", [1, 2, 5, 7, 11, 12, 13, 20])
def test_no_drive_is_armed_whose_time_out_exceeds_what_its_end_stop_speed_was_computed_with(
    says: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ODrive, "HEARTBEAT_PERIODS", says)
    bus, armed = MappedBus("odrive", late_bench(), tmp_path), set[int]()
    for time_out in (5, 9, 10, 11, 12, 13, 14, 15, 20, 30):
        bus.watchdog, bus.shift = time_out * 1e-3 - 1e-6, 7 * time_out
        with contextlib.suppress(BusError):
            bus.open("", bus.bench)
            armed.add(time_out)
    assert armed <= {5, 9, 10, 11, 12}
    assert armed >= {5, 9, 10}


def test_the_age_of_answers_is_measured_and_one_beyond_the_declared_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A polled drive acts at the next poll; else two frames' worst time on the bus is what lock-step knows of.
    for name, age_ms in (("odrive", 0.23), ("vesc", 0.28), ("mit", 1.0)):
        bus, emb_run = runner(name, tmp_path, capsys, monkeypatch)
        emb_run.document("--zero", "--log", str(tmp_path / f"{name}.mcap"))
        assert bus.transport.node.times.largest_age_ns * 1e-6 == pytest.approx(age_ms, abs=0.005)
        assert not bus.transport.node.times.too_late
        says_its_state = name == "odrive"
        assert bus.transport.node.arming.time_out.startswith("disarmed" if says_its_state else "not provable")
    (folder := tmp_path / "slow").mkdir()
    bus, emb_run = runner("odrive", folder, capsys, monkeypatch)
    bus.edit("[can]", "[can]\nbitrate = 520000")
    bus.change = lambda frame: frame._replace(time_ns=frame.time_ns - 700_000)
    emb_run.document("--zero")
    late = "1.14 periods after its measurement, shield.frame_age = [0, 1] declares less: declare [0, 2]"
    assert late in bus.transport.node.times.too_late


def test_a_mapping_that_does_not_fit_the_bench_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    for drive, old, new, bench_old, bench_new, reason in (
        ("odrive", "range = [-0.1303, 0.1303]", "range = [-0.1, 0.1]", "", "", "does not cover the bench's -6 to 6 A"),
        ("odrive", "range = [-2, 17]", "range = [-2, 15]", "", "", "does not cover the bench's -10 to 100 rad"),
        ("odrive", "range = [-90, 90]", "range = [-70, 70]", "", "", "does not cover the bench's -500 to 500 rad/s"),
        ("mit", "0.1953, range = [-1.18", "0.05, range = [-1.18", "", "", "a step of 0.176 A is too coarse"),
        ("odrive", "pair_within = 0.0005", "pair_within = 0.0006", "", "", "at most half of the bench's sample time"),
        ("odrive", "speed = 1800", "speed = 1795", "", "", "may reach 1796 rad/s, and bears 1795 rad/s; narrow"),
        ("odrive", "", "", "watchdog         = 0.010", "watchdog = 0.008", "longer than the bench's node.watchdog"),
        ("odrive", "", "", "frame_age     = [0, 1]", "frame_age = [0, 0]", "a mapped drive does not answer by sample"),
        ("mit", "", "", "frame_age     = [1, 1]", "frame_age = [0, 1]", "a mapped drive does not answer by sample"),
        # Bits by hand, in each ms: an 11-bit frame of 8, 6, 4 bytes has at most 135, 115, 95; a 29-bit one of 8 and 4
        # 160 and 120. The ODrive's heartbeat of 8 bytes is believed for a quarter of a second.
        ("odrive", "[can]", "[can]\nbitrate = 456000", "", "", "take 80% of its bus at worst"),
        ("vesc", "[can]", "[can]\nbitrate = 549000", "", "", "take 80% of its bus at worst"),
        ("mit", "[can]", "[can]\nbitrate = 312000", "", "", "take 80% of its bus at worst"),
    ):
        text = late_bench(polled=drive == "mit")
        assert bench_old in text
        bench = parse_bench(text.replace(bench_old, bench_new) if bench_old else text, "bench.toml")
        bus = MappedBus(drive, text, tmp_path)
        if old:
            bus.edit(old, new)
        with pytest.raises(UsageError, match=re.escape(reason)):
            require_fit(bus.mapping, bench)
    for drive, bitrate in (("odrive", 458_000), ("vesc", 551_000), ("mit", 314_000)):
        text = late_bench(polled=drive == "mit")
        bus = MappedBus(drive, text, tmp_path)
        bus.edit("[can]", f"[can]\nbitrate = {bitrate}")
        require_fit(bus.mapping, parse_bench(text, "bench.toml"))
