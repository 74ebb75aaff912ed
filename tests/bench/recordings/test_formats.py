"""Files that other libraries write of one recording, whole and broken."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emb_bench.experiment.experiment import Lack
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.log import read_log
from emb_bench.recordings.recording import open_recording
from emb_runtime.can.messages import load_layout
from emb_runtime.errors import UsageError
from tests.bench.linear_machine import MAP, Machine, record

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip

RECORDING = record(Machine(), 0.3)
COLUMNS = {"t": RECORDING.time, "x": RECORDING.position, "F": RECORDING.force}


def with_pyarrow_csv(path: Path) -> None:
    from pyarrow import csv

    csv.write_csv(pa.table(COLUMNS), path)


def with_pyarrow_parquet(path: Path) -> None:
    pq.write_table(pa.table(COLUMNS), path)


def with_scipy(path: Path) -> None:
    from scipy import io

    io.savemat(path, {name: values[:, None] for name, values in COLUMNS.items()}, do_compression=True)


def with_asammdf(path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="3.30" if path.suffix == ".mdf" else "4.10") as file:
        file.append([asammdf.Signal(COLUMNS[name], COLUMNS["t"], name=name) for name in ("x", "F")])
        file.save(path)


DBC = """\
VERSION ""
BO_ 256 State: 8 A
 SG_ Position : 0|64@1- (1,0) [0|0] "m" B
BO_ 2147483904 Command: 8 A
 SG_ F : 0|64@1- (1,0) [0|0] "N" B
BO_ 300 Bad: 2 B
 SG_ Long : 0|40@1- (1,0) [0|0] "" A
BO_ 301 Other: 8 B
 SG_ Position : 0|32@1- (1,0) [0|0] "" A
SIG_VALTYPE_ 256 Position : 2;
SIG_VALTYPE_ 2147483904 F : 2;
"""
"""Two messages of one number, with an identifier of 11 bits and of 29, and a bad one that is not used."""


def with_python_can(path: Path) -> None:
    import can

    (path.parent / "servo.dbc").write_text(DBC, encoding="cp1252")
    with can.Logger(path) as log:
        for t, x, force in zip(*(column.tolist() for column in COLUMNS.values()), strict=True):
            for extended, value in ((False, x), (True, force)):
                data = struct.pack("<d", value)
                log(can.Message(timestamp=t, arbitration_id=256, is_extended_id=extended, data=data, channel=0))
            log(can.Message(timestamp=t, arbitration_id=0x55, is_extended_id=False, data=b"1234", channel=0))


WITHOUT_TIMES = MAP.replace('column = "t"\nunit = "s"\n', "")
OF_FRAMES = WITHOUT_TIMES.replace("[timing]", '[file]\ndbc = "servo.dbc"\n[timing]').replace('"x"', '"State.Position"')
FORMATS: dict[str, tuple[Callable[[Path], None], str]] = {
    "r.csv": (with_pyarrow_csv, MAP),
    "r.parquet": (with_pyarrow_parquet, MAP),
    "r.mat": (with_scipy, MAP),
    "r.mf4": (with_asammdf, WITHOUT_TIMES),
    "r.mdf": (with_asammdf, WITHOUT_TIMES),
    "r.blf": (with_python_can, OF_FRAMES),
    "r.asc": (with_python_can, OF_FRAMES),
    "r.log": (with_python_can, OF_FRAMES),
    "frames.mf4": (with_python_can, OF_FRAMES),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Each format's file."""
    folder, found = tmp_path_factory.mktemp("written"), {}
    for name, (write, _) in FORMATS.items():
        write(folder / name)
        found[name] = (folder / name).read_bytes()
    return found


def put(folder: Path, name: str, content: bytes) -> tuple[Path, Path]:
    """A recording and its map."""
    (folder / name).write_bytes(content)
    (folder / "map.toml").write_text(FORMATS[name][1])
    (folder / "servo.dbc").write_text(DBC)
    return folder / name, folder / "map.toml"


def test_what_a_library_writes_is_read_back(written: dict[str, bytes], tmp_path: Path) -> None:
    for name in FORMATS:
        experiment = open_recording(*put(tmp_path, name, written[name])).experiment
        assert experiment.periods == len(RECORDING.time) - 1
        assert experiment.measured.all()
        np.testing.assert_allclose(experiment.all_samples[:, 0], RECORDING.position, rtol=1e-12, atol=1e-12)
        stamps = 2e-6 if FORMATS[name][0] is with_python_can else 1e-9  # the steps of their times
        largest = float(np.abs(np.diff(RECORDING.force)).max())
        np.testing.assert_allclose(experiment.currents, RECORDING.force[:-1], rtol=1e-6, atol=1e3 * stamps * largest)
        assert experiment.late is not None
        np.testing.assert_allclose(experiment.late, 0.0, atol=stamps)


def broken(content: bytes, other: bytes) -> Iterator[bytes]:
    """Other files, the file without its end, and with random bytes in it."""
    rng = np.random.default_rng(len(content))
    yield from (other, rng.bytes(4096), content[: int(0.9 * len(content))])
    for _ in range(6):
        changed = bytearray(content)
        for at in rng.integers(0, len(content), 20).tolist():
            changed[at] = int(rng.integers(256))
        yield bytes(changed)
    yield from (b"", b"\x00" * 64)
    for part in (0.02, 0.3, 0.999):
        yield content[: int(part * len(content))]


@pytest.mark.parametrize("count", [4, pytest.param(14, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMATS)
def test_a_broken_file_or_one_of_another_kind_is_read_or_refused_in_one_line(
    name: str, count: int, written: dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = written["r.parquet" if name != "r.parquet" else "r.csv"]
    for content in islice(broken(written[name], other), count):
        said = ""
        try:
            open_recording(*put(tmp_path, name, content))
        except UsageError as err:
            said = str(err)
            assert said
        assert "\n" not in said
        assert not capfd.readouterr().err
        if content is other:
            assert name in said


FRAMES_REFUSED = (
    ('"State.Position"', '"Position"', "2 columns are called 'Position': expected one: State.Position, Other.Position"),
    ('"State.Position"', '"State.Angle"', "no column is called 'State.Angle'; it has: State.Position, Command.F"),
    ('"State.Position"', '"Bad.Long"', "Bad: DBC: not readable: The signal Long does not fit in message Bad."),
    (
        '"State.Position"',
        '"Other.Position"',
        "no frame 0x12d has it: 602 have other numbers, 0x100 (301), 0x55 (301)",
    ),
    ('"servo.dbc"', '"none.dbc"', "none.dbc: cannot read the DBC: No such file"),
    ('dbc = "servo.dbc"', "", "[file] dbc: expected for CAN frames"),
    (
        'dbc = "servo.dbc"',
        'dbc = "servo.dbc"\nchannel = "7"',
        "no frame 0x100 has it: 903 have other channels, can0 (903)",
    ),
    ('unit = "m"', 'unit = "m"\ngroup = 1', "State.Position: only an MDF has groups"),
)


def test_a_map_of_frames_that_does_not_fit_says_what_there_is(written: dict[str, bytes], tmp_path: Path) -> None:
    for old, new, expected in FRAMES_REFUSED:
        source, map_path = put(tmp_path, "r.log", written["r.log"])
        text = map_path.read_text()
        assert old in text
        map_path.write_text(text.replace(old, new, 1))
        with pytest.raises(UsageError) as refused:
            open_recording(source, map_path)
        assert expected in str(refused.value)


def test_skipped_and_unreadable_frames_are_counted(written: dict[str, bytes], tmp_path: Path) -> None:
    source, map_path = put(tmp_path, "r.log", written["r.log"])
    count = len(RECORDING.time)
    assert open_recording(source, map_path).experiment.quality.lacks[Lack.OTHER_FRAMES] == (count, 1)
    lines = written["r.log"].decode().splitlines()
    lines[300] = lines[300].replace(lines[300].split("#")[1], "00")
    source.write_text("\n".join(lines))
    assert open_recording(source, map_path).experiment.quality.lacks[Lack.BAD_FRAMES] == (1,)
    source.write_text("\n".join([*lines, lines[0].replace(" can0 ", " can1 ").replace(lines[0].split()[1], "can1")]))
    with pytest.raises(UsageError, match="comes on channels"):
        open_recording(source, map_path)


def test_the_frames_of_a_log_of_ours_are_a_recording(tmp_path: Path, simulate: Simulate) -> None:
    run = simulate(square, steps=60, options="f_v=3e-5,seed=7")
    source = write_log(tmp_path / "run.mcap", run, steps=60)
    (tmp_path / "emb.dbc").write_text(load_layout().text)
    (tmp_path / "map.toml").write_text(OURS)
    found, own = open_recording(source, tmp_path / "map.toml").experiment, read_experiment(read_log(source))
    begin = int(np.argmin(np.abs(found.samples[:, 0] - own.samples[0, 0])))
    np.testing.assert_array_equal(found.samples[begin : begin + 50], own.samples[:50])
    np.testing.assert_allclose(found.currents[begin : begin + 50], own.currents[:50], atol=5e-3)  # times in floats


OURS = """\
schema = 1
name = "the frames of a run"
[file]
dbc = "emb.dbc"
[signals.angle]
column = "EMB_Angle.Angle"
unit = "rad"
noise = 1e-3
[signals.velocity]
column = "EMB_Velocity.Velocity"
unit = "rad/s"
noise = 1.0
[signals.command]
column = "AppliedCurrent"
unit = "A"
delay = -0.001  # of the period before
[machine.known]
J = 4.624e-6
[machine.guess]
k_m = 0.02
T_c = 0.01
f_v = 3e-5
"""


def test_a_column_of_an_mdf_is_told_by_its_group(tmp_path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(COLUMNS["x"], COLUMNS["t"], name="x")])
        file.append([asammdf.Signal(COLUMNS["F"][::50], COLUMNS["t"][::50], name="F")])
        file.append([asammdf.Signal(COLUMNS["F"], COLUMNS["t"], name="F")])
        file.save(tmp_path / "r.mf4")
    (tmp_path / "map.toml").write_text(WITHOUT_TIMES)
    with pytest.raises(UsageError, match=r"it is in the groups 1 \(7 values\), 2 \(301 values\): group = N"):
        open_recording(tmp_path / "r.mf4", tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(WITHOUT_TIMES.replace('"F"', '"F"\ngroup = 2'))
    experiment = open_recording(tmp_path / "r.mf4", tmp_path / "map.toml").experiment
    np.testing.assert_allclose(experiment.currents, RECORDING.force[:-1], rtol=1e-9)


def test_columns_of_matrices_and_structures_of_matlab_are_named_as_matlab_does(tmp_path: Path) -> None:
    from scipy import io

    matrix = np.stack([*COLUMNS.values()], axis=1)
    signals = np.zeros(2, dtype=[("label", "O"), ("values", "O")])
    signals[0], signals[1] = ("x", COLUMNS["x"]), ("F", COLUMNS["F"])
    cells = np.empty(3, dtype=object)
    cells[:] = [*COLUMNS.values()]
    out = {"time": COLUMNS["t"], "signals": signals, "one": {"raw": matrix.T}}
    io.savemat(tmp_path / "r.mat", {"cells": cells, "data": matrix, "out": out, "spectrum": COLUMNS["x"] + 1j})
    for t, x, force in (
        ("data(:,1)", "data(:, 2)", "data(:,3)"),
        ("out.time", "out.signals(1).values", "out.signals(2).values"),
        ("out.one(1).raw(1,:)", "out.one.raw(2,:)", "out.one.raw(3,:)"),
        ("cells{1}", "cells{2}", "cells(3)"),
    ):
        (tmp_path / "map.toml").write_text(
            MAP.replace('"t"', f'"{t}"').replace('"x"', f'"{x}"').replace('"F"', f'"{force}"')
        )
        experiment = open_recording(tmp_path / "r.mat", tmp_path / "map.toml").experiment
        np.testing.assert_allclose(experiment.all_samples[:, 0], RECORDING.position, rtol=1e-12)
    for place, said in (
        ("data", "a matrix of 301 x 3: name a column of it, data(:,1) to data(:,3)"),
        ("spectrum", "spectrum: expected real numbers, got complex ones"),
        ("data(:,0)", "no column is called 'data(:,0)'; it has: cells, data(:,1..3)"),
        ("data(:,4)", "data(:,4): beyond what data has: (301, 3)"),
        ("out.angle", "it has: cells, data(:,1..3), out.time, out.signals(1).label, out.signals(1).values"),
        ("out.signals(3).values", "signals(3): beyond what signals has"),
    ):
        (tmp_path / "map.toml").write_text(MAP.replace('"t"', '"data(:,1)"').replace('"x"', f'"{place}"'))
        with pytest.raises(UsageError) as refused:
            open_recording(tmp_path / "r.mat", tmp_path / "map.toml")
        assert said in str(refused.value)


def test_a_file_that_ends_in_dat_is_what_it_begins_as(tmp_path: Path, written: dict[str, bytes]) -> None:
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "r.dat").write_bytes(written["r.csv"])
    assert open_recording(tmp_path / "r.dat", tmp_path / "map.toml").experiment.periods == len(RECORDING.time) - 1
    (tmp_path / "map.toml").write_text(WITHOUT_TIMES)
    (tmp_path / "r.dat").write_bytes(written["r.mdf"])
    assert open_recording(tmp_path / "r.dat", tmp_path / "map.toml").experiment.periods == len(RECORDING.time) - 1


def test_a_file_of_matlab_7_3_is_named(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "r.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(500))
    with pytest.raises(UsageError, match=r"a file of MATLAB 7.3: save it with -v7"):
        open_recording(tmp_path / "r.mat", tmp_path / "map.toml")


@pytest.mark.parametrize("kind", [pa.timestamp("us", "UTC"), pa.timestamp("ms"), pa.time64("us"), pa.duration("us")])
def test_times_of_arrow_have_their_unit(kind: pa.DataType, tmp_path: Path) -> None:
    times = np.rint(RECORDING.time * (1e3 if kind == pa.timestamp("ms") else 1e6)).astype(np.int64)
    table = pa.table(COLUMNS | {"t": pa.array(times).cast(kind)})
    pq.write_table(table, tmp_path / "r.parquet")
    (tmp_path / "map.toml").write_text(MAP)
    found = open_recording(tmp_path / "r.parquet", tmp_path / "map.toml")
    assert found.experiment.periods == len(RECORDING.time) - 1
    assert found.bench.timing.sample_time == pytest.approx(RECORDING.time[1], rel=1e-6)
