"""Temperature and supply voltage: from the node's frame to log, campaign, control chart and certificate."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from matplotlib import rc_context
from pyarrow import parquet

from emb_bench.analysis.several_runs import beyond, slope
from emb_bench.batch.chart import draw_chart
from emb_bench.batch.row import CampaignOptions, Row
from emb_bench.batch.summary import campaign_text, summarise
from emb_bench.logs.log import read_log
from emb_runtime.can.messages import load_layout
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.log.ring_buffer import Attachment, FrameRecord, LogHeader
from emb_runtime.records import Frame

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.report_pages import make  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip
from tests.drives import EXAMPLES  # isort: skip
from tests.independent import protected  # isort: skip

LAYOUT = load_layout()
BODY = bytes.fromhex("17 ff7f ffff")  # 327.67 °C and 655.35 V: beyond the ranges, CRC right


def told(frames: list[Frame]) -> Callable[..., Frame | None]:
    """Puts frames on the bus of a run, each in the place of a status."""
    sent = 0

    def receive(frame: Frame | None, *_: object) -> Frame | None:
        nonlocal sent
        if frame is None or frame.identifier != LAYOUT.status.identifier or sent == len(frames):
            return frame
        sent += 1
        return frames[sent - 1]._replace(time_ns=frame.time_ns)

    return receive


def test_they_go_from_the_bus_to_log_campaign_and_certificate(
    tmp_path: Path, simulate: Simulate, replay: Replay
) -> None:
    frames = [LAYOUT.encode_conditions(0, 41.0, 23.9), LAYOUT.encode_conditions(1, 42.0, 24.1)]
    hostile = Frame(
        LAYOUT.optional["EMB_Conditions"].identifier, protected(LAYOUT.optional["EMB_Conditions"].identifier, BODY)
    )
    damaged = frames[0]._replace(data=bytes(6))
    run = simulate(square, options="plant=exact,seed=5", on_receive=told([*frames, hostile, damaged]))
    warm = write_log(tmp_path / "warm.mcap", run)
    plain = write_log(tmp_path / "plain.mcap", simulate(square, options="plant=exact,seed=6"))
    log = read_log(warm)
    assert log.conditions == pytest.approx({"temperature": 41.5, "supply_voltage": 24.0})
    assert log.end["undecoded_frames"] == "2", "what is out of range or damaged is no value"
    assert (read_log(plain).conditions, "/emb/EMB_Conditions" in read_log(plain).topics) == ({}, False)
    rows = tmp_path / "rows.parquet"
    replay.text("campaign", warm, plain, "-o", rows, "--method", "none", "--jobs", "1")
    table = parquet.read_table(rows)
    assert table.schema.field("temperature").metadata[b"unit"] == b"degC"
    assert sorted(table["supply_voltage"].to_pylist(), key=str) == [pytest.approx(24.0), None]
    assert "41.5 °C, 24 V" in make(tmp_path / "warm.html", warm, "--starts", "1").reader.texts
    assert "41.5 °C" not in " ".join(make(tmp_path / "plain.html", plain, "--starts", "1").reader.texts)


def test_a_simulated_node_sends_them_on_request_and_no_other_frame_changes(
    tmp_path: Path, simulate: Simulate, replay: Replay
) -> None:
    plain, telling = (
        write_log(tmp_path / f"{n}.mcap", simulate(square, options=f"plant=exact,seed=5{more}"))
        for n, more in enumerate(("", ",temperature=65,supply_voltage=12.8"))
    )
    frames = [[(f.identifier, f.data) for f in read_log(path).frames] for path in (plain, telling)]
    own = LAYOUT.optional["EMB_Conditions"].identifier
    assert [f for f in frames[1] if f[0] != own] == frames[0]
    periods = sum(f[0] == LAYOUT.angle.identifier for f in frames[1])
    assert sum(f[0] == own for f in frames[1]) == pytest.approx(periods / 100, abs=1.0)
    shown = replay.text("info", telling).splitlines()
    assert {"temperature  65 to 65 °C", "supply       12.8 to 12.8 V"} <= set(shown)
    assert "temperature" not in replay.text("info", plain)


def test_a_mapped_drive_s_own_signals_are_read_from_its_bus_where_they_can_be_believed(tmp_path: Path) -> None:
    toml, dbc = ((EXAMPLES / f"vesc.{kind}").read_text() for kind in ("toml", "dbc"))
    line, old = (next(row for row in toml.splitlines() if row.startswith(name)) for name in ("temperature", "supply"))
    voltage = 'supply_voltage = {signal = "VESC_Status_4.Temp_FET", unit = "mV", range = [-40, 200], offset = 1.0}'
    toml = toml.replace(f"{old}\n", "")
    status_4 = Frame(0x1005, b"", extended=True)
    told = [(120, 412), (130, 432), (140, 2001), (-401, -401)]  # tenths; the last two are beyond the range, or half so
    frames = [status_4._replace(data=struct.pack(">hhhh", *pair, 0, 0)) for pair in told]
    frames += [frames[0]._replace(data=frames[0].data[:7]), frames[0]._replace(extended=False, identifier=5)]
    for given, expected in (
        (toml, {"temperature": 42.2}),
        (toml.replace(line, f"{line}\n{voltage}"), {"temperature": 42.2, "supply_voltage": 1.013}),
        (toml.replace(line, ""), {}),
    ):
        header = LogHeader(
            start_ns=0,
            wall_offset_ns=0,
            simulated=True,
            dbc=LAYOUT.text,
            messages=LAYOUT.all_messages,
            metadata={"emb.run": {}, "emb.drive": {"bus": "can0", "lost": ""}},
            attachments=[
                Attachment("drive.toml", "application/toml", given.encode()),
                Attachment("drive.dbc", "text/plain", dbc.encode()),
            ],
            drive_bus="can0",
        )
        path = tmp_path / "drive.mcap"
        with path.open("wb") as file:
            writer = LogWriter(file, header)
            for n, frame in enumerate(frames):
                writer.write_frame("/drive/rx", FrameRecord(frame._replace(time_ns=n)), n)
            writer.finish({"exit_reason": "DONE"})
        assert read_log(path).conditions == pytest.approx(expected)


OF_K_M_AND_F_V = CampaignOptions(params="k_m,f_v")


def rows_of(values: list[float], apart: float = 3600.0) -> list[Row]:
    """Rows of runs that are so many seconds apart."""
    return [
        {
            "log": f"{n}.mcap",
            "error": None,
            "fits": True,
            "start_time": n * round(apart * 1e9),
            "temperature": 20.0 + n,
            "k_m_identified": False,
            "f_v_identified": True,
            "f_v_estimate": value,
            "f_v_between_runs": 0.01,
        }
        for n, value in enumerate(values)
    ]


@pytest.mark.parametrize(
    ("apart", "unit", "change"), [(0.5, "s", 16.7), (30.0, "min", 16.7), (1800.0, "h", 16.7), (86400.0, "d", 8.33)]
)
def test_a_chart_has_the_conditions_that_were_sent_the_limits_and_the_runs_beyond_them(
    apart: float, unit: str, change: float, tmp_path: Path
) -> None:
    path, rows = tmp_path / "chart.svg", rows_of([1.0, 1.1, 1.2, 1.3, 1.4], apart)
    found = summarise(rows, OF_K_M_AND_F_V, "rows.csv")
    said = " ".join(campaign_text(found).split())
    assert f"f_v changes with time: +{change} % per {unit} (p <" in said
    assert "f_v changes with temperature: +8.33 % per °C" in said
    assert "f_v: beyond the control limits (3 deviations between runs from the median): 0.mcap, 1.mcap, 3." in said
    with rc_context({"svg.fonttype": "none"}):
        assert draw_chart(rows, found, path)
    shown = " ".join(ElementTree.parse(path).getroot().itertext())
    assert all(text in shown for text in (f"time since the first run [{unit}]", "temperature [°C]", "f_v − median [%]"))
    assert not any(text in shown for text in ("supply voltage", "k_m"))
    rows = [row | {"fits": False} for row in rows]
    assert not draw_chart(rows, summarise(rows, OF_K_M_AND_F_V, "rows.csv"), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_a_slope_over_a_condition_is_that_of_weighted_least_squares() -> None:
    found = slope([1.0, 2.0, 3.5, 3.9], [0.1, 0.1, 0.2, 0.1], [20.0, 30.0, 45.0, 50.0])
    assert found is not None
    weights, x = [100.0, 100.0, 25.0, 100.0], [20.0, 30.0, 45.0, 50.0]
    mean = sum(w * at for w, at in zip(weights, x, strict=True)) / sum(weights)
    spread = sum(w * (at - mean) ** 2 for w, at in zip(weights, x, strict=True))
    values = zip(weights, x, [1.0, 2.0, 3.5, 3.9], strict=True)
    assert found.slope == pytest.approx(sum(w * (at - mean) * v for w, at, v in values) / spread)
    assert found.deviation == pytest.approx(spread**-0.5)
    assert found.significant
    scattered = slope([1.0, 3.0, 0.5, 3.9], [0.1] * 4, x)
    assert scattered is not None
    assert not scattered.significant, "runs that scatter more than they state tell no slope"
    assert slope([1.0, 2.0, 3.0], [0.1] * 3, [20.0] * 3) is None, "nothing changes with what does not change"


def test_a_run_beyond_the_control_limits_is_named_and_those_of_plain_scatter_are_not() -> None:
    assert beyond([1.0, 1.1, 0.9, 1.05, 2.0], [0.1] * 5) == [4]
    assert beyond([1.0, 1.1, 0.9, 1.05], [0.1] * 4) == []


@pytest.mark.parametrize("deviation", [0.0, math.inf, math.nan])
def test_a_run_without_a_deviation_has_no_part_in_a_slope(deviation: float) -> None:
    values, deviations, at = [1.0, 2.0, 3.0, 90.0], [0.1, 0.1, 0.1, deviation], [0.0, 1.0, 2.0, 3.0]
    assert slope(values, deviations, at) == slope(values[:3], deviations[:3], at[:3])
    assert slope(values[1:], deviations[1:], at[1:]) is None
    assert beyond([2.0, 2.0, 2.0], [deviation] * 3) == []


def test_a_slope_has_to_be_significant_as_one_of_all_that_a_campaign_tests() -> None:
    found = slope([0.0, 1.0, 2.0, 3.0], [1.0] * 4, [0.0, 1.2, 2.4, 3.6])
    assert found is not None
    assert replace(found, p_value=0.005).significant is False
    assert replace(found, p_value=0.0005).significant is True
