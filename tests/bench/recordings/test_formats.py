"""Files that other libraries write of one recording, whole and broken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from emb_bench.recordings.recording import open_recording
from emb_runtime.errors import UsageError
from tests.bench.linear_machine import MAP, Machine, record

RECORDING = record(Machine(), 0.3)
COLUMNS = {"t": RECORDING.time, "x": RECORDING.position, "F": RECORDING.force}


def with_pyarrow_csv(path: Path) -> None:
    import pyarrow as pa
    from pyarrow import csv

    csv.write_csv(pa.table(COLUMNS), path)


def with_pyarrow_parquet(path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(COLUMNS), path)


def with_scipy(path: Path) -> None:
    from scipy import io

    io.savemat(path, {name: values[:, None] for name, values in COLUMNS.items()}, do_compression=True)


def with_asammdf(path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="3.30" if path.suffix == ".mdf" else "4.10") as file:
        file.append([asammdf.Signal(COLUMNS[name], COLUMNS["t"], name=name) for name in ("x", "F")])
        file.save(path)


WITHOUT_TIMES = MAP.replace('column = "t"\nunit = "s"\n', "")
FORMATS: dict[str, tuple[Callable[[Path], None], str]] = {
    "r.csv": (with_pyarrow_csv, MAP),
    "r.parquet": (with_pyarrow_parquet, MAP),
    "r.mat": (with_scipy, MAP),
    "r.mf4": (with_asammdf, WITHOUT_TIMES),
    "r.mdf": (with_asammdf, WITHOUT_TIMES),
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
    return folder / name, folder / "map.toml"


def test_what_a_library_writes_is_read_back(written: dict[str, bytes], tmp_path: Path) -> None:
    for name in FORMATS:
        experiment = open_recording(*put(tmp_path, name, written[name])).experiment
        assert experiment.periods == len(RECORDING.time) - 1
        assert experiment.measured.all()
        np.testing.assert_allclose(experiment.all_samples[:, 0], RECORDING.position, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(experiment.currents, RECORDING.force[:-1], rtol=1e-6, atol=1e-6)
        assert experiment.late is not None
        np.testing.assert_allclose(experiment.late, 0.0, atol=1e-9)


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
