from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from emb_bench.cli.replay import main
from emb_bench.config.bench import load_bench
from emb_bench.experiment.experiment import Experiment, Lack
from emb_bench.experiment.from_log import Recording as Opened
from emb_bench.recordings.recording import open_recording
from emb_runtime.errors import BenchFileError
from tests.bench.linear_machine import MAP, T_S, Machine, Recording, record

RECORDING = record(Machine(), 0.4)


def csv(path: Path, found: Recording, delimiter: str = ",") -> Path:
    rows = [delimiter.join(("t", "x", "F"))]
    rows += [delimiter.join(map(repr, row)) for row in zip(*(c.tolist() for c in found), strict=True)]
    path.write_text("\n".join(rows) + "\n")
    return path


def opened(folder: Path, source: Path, text: str = MAP) -> Opened:
    (folder / "map.toml").write_text(text)
    return open_recording(source, folder / "map.toml")


def refused(folder: Path, source: Path, text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a recording is refused."""
    (folder / "map.toml").write_text(text)
    assert main(["fim", str(source), "--map", str(folder / "map.toml")]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    return said


def check(experiment: Experiment, found: Recording = RECORDING) -> None:
    """The experiment has the recording's samples."""
    np.testing.assert_allclose(experiment.all_samples[:, 0], found.position, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(experiment.currents, found.force[:-1], rtol=1e-9, atol=1e-9)
    assert experiment.measured.sum() == len(found.time) - 1


def test_a_csv_file_becomes_an_experiment_with_its_samples_and_the_machine(tmp_path: Path) -> None:
    found = opened(tmp_path, csv(tmp_path / "r.csv", RECORDING))
    check(found.experiment)
    bench = found.bench
    assert bench.machine is not None
    assert bench.machine.unknown == ("T_c", "f_v", "J")
    assert bench.brake.k_1 == 0.0
    assert bench.brake.J == 70.0
    assert bench.brake.T_c == 14.0
    assert bench.brake.f_v == 300.0


def test_what_a_recording_lacks_is_said_of_its_experiment(tmp_path: Path) -> None:
    experiment = opened(tmp_path, csv(tmp_path / "r.csv", RECORDING)).experiment
    assert {Lack.NO_COUNTERS, Lack.NO_VELOCITY, Lack.NO_CURRENT} <= experiment.quality.lacks.keys()


def test_a_column_that_an_observer_derives_is_told_and_without_it_the_machine_is_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = record(Machine(), 2.0)
    pole = np.exp(complex(-0.7, 0.51**0.5) * 800.0 * T_S)
    alpha, beta = 1.0 - abs(pole) ** 2, 1.0 + abs(pole) ** 2 - 2.0 * pole.real
    tracked, speed, rows = float(found.position[0]), 0.0, ["t,x,F,v"]
    for t, x, force in zip(*(column.tolist() for column in found), strict=True):
        ahead = tracked + T_S * speed
        tracked, speed = ahead + alpha * (x - ahead), speed + beta / T_S * (x - ahead)
        rows.append(f"{t!r},{x!r},{force!r},{float(speed)!r}")
    (tmp_path / "r.csv").write_text("\n".join(rows) + "\n")
    text, own = MAP.replace("window = 0.5", "window = 0.1"), '[signals.velocity]\ncolumn = "v"\nunit = "m/s"\n'
    said = []
    for given in (text.replace("[signals.command]", f"{own}noise = 1e-4\n\n[signals.command]"), text):
        (tmp_path / "map.toml").write_text(given)
        assert main(["estimate", str(tmp_path / "r.csv"), "--map", str(tmp_path / "map.toml")]) == 1, (
            "the simulation's steps show"
        )
        said.append(" ".join(capsys.readouterr().out.split()))
    told = "the velocity is derived from the angle, bandwidth about 800 rad/s: leave its column out of the map"
    assert [told in out for out in said] == [True, False]


TURNING = """\
schema = 1
name = "a drive that turns"
[timing]
sample_time = 0.01
[signals.angle]
column = "position"
unit = "rad"
scale = 6.283185307179586
noise = 0.0006
[signals.velocity]
column = "speed"
unit = "rad/s"
scale = 0.10471975511965977
noise = 0.01
sign = -1
[signals.command]
column = "torque"
unit = "Nm"
delay = -0.0045
[machine]
window = 0.1
[machine.guess]
J = 1e-4
T_c = 0.01
f_v = 1e-4
"""


def test_signals_with_times_of_their_own_are_paired_by_these(tmp_path: Path) -> None:
    import asammdf

    k = np.arange(60)
    turns, torques, times = 0.01 * k, 0.02 * (k % 7), 0.01 * k + 0.001 * (k % 3)
    columns = {"position": (turns, times), "speed": (60.0 * turns, times), "torque": (torques, 0.01 * k + 0.0045)}
    with asammdf.MDF() as file:
        for name, (values, stamps) in columns.items():
            file.append(asammdf.Signal(values, stamps, name=name))
        file.save(tmp_path / "drive.mf4")
    experiment = opened(tmp_path, tmp_path / "drive.mf4", TURNING).experiment
    np.testing.assert_allclose(experiment.all_samples, 2.0 * np.pi * np.stack([turns, -turns], axis=1), atol=1e-9)
    np.testing.assert_allclose(experiment.currents, torques[:-1], atol=1e-9)
    # The samples came up to 2 ms late; their own stamps say so.
    assert experiment.late is not None
    np.testing.assert_allclose(experiment.late, times[1:] - 0.01 * k[1:], atol=1e-6)


def test_a_linear_command_is_the_mean_of_what_lies_between_its_stamps(tmp_path: Path) -> None:
    text = MAP.replace('unit = "N"', 'unit = "N"\nbetween = "linear"')
    experiment = opened(tmp_path, csv(tmp_path / "r.csv", RECORDING), text).experiment
    force = RECORDING.force
    np.testing.assert_allclose(experiment.currents, 0.5 * (force[:-1] + force[1:]), rtol=1e-9, atol=1e-9)


def test_lost_and_shifted_samples_stay_where_their_times_are(tmp_path: Path) -> None:
    kept = np.ones(len(RECORDING.time), np.bool_)
    kept[[50, 51, 90]] = False
    found = Recording(*(column[kept] for column in RECORDING))
    experiment = opened(tmp_path, csv(tmp_path / "r.csv", found)).experiment
    assert experiment.periods == len(RECORDING.time) - 1
    lost = np.flatnonzero(~experiment.measured) + 1
    assert lost.tolist() == [50, 51, 90]
    np.testing.assert_allclose(experiment.all_samples[kept, 0], found.position)
    assert experiment.quality.lacks[Lack.LOST_OF_RECORDING] == (3,)


MAPS_REFUSED = (
    ('unit = "m"', 'unit = "inch"', "signals.angle.unit: expected one of rad"),
    ('unit = "m"', 'units = "m"', "signals.angle.units: unknown key"),
    ('unit = "m"', "", "signals.angle.unit: missing"),
    ('unit = "N"', 'unit = "Nm"', "signals.command.unit: expected one of A, V, 1, N,"),
    ('column = "x"', 'column = "y"', "no column is called 'y'; it has: t, x, F"),
    ('unit = "N"', 'unit = "A"', "needs [machine] k_m"),
    ('unit = "N"', 'unit = "A"\nsign = 0', "signals.command.sign: expected one of -1, 1, got 0"),
    ("mass = 70.0", "mass = 0.0", "machine.guess.mass: expected a positive number"),
    ("mass = 70.0", "", "J is missing, or mass"),
    ("mass = 70.0", "mass = 70.0\nJ = 1e-5", "J is given twice"),
    ("mass = 70.0", "mass = 70.0\nweight = 2.0", "machine.guess.weight: unknown key"),
    ("mass = 70.0", "mass = 70.0\ngamma = 1e-5", "k_1 and gamma go together"),
    ("window = 0.5", "window = 0.5\nspring = 1", "machine.spring: unknown key"),
    ('["current_offset"]', '["wind"]', "machine.nuisances[0]: expected one of"),
    ("schema = 1", "schema = 2", "schema: expected 1, got 2"),
    ("schema = 1", "schema = ", "not valid TOML"),
    (f"noise = {5e-8 / 12**0.5}", "", "signals.angle.noise: missing"),
    (f"sample_time = {T_S}", "sample_time = 5", "sample_time: expected a time from 0.0001 to 0.1 s"),
    ('column = "t"\nunit = "s"\nsample_time = 0.001', "", "[timing]"),
    ('unit = "N"', 'unit = "N"\n[signals.current]\ncolumn = "F"\nunit = "A"', "has no k_m and no current"),
)


def test_a_map_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = csv(tmp_path / "r.csv", RECORDING)
    for old, new, expected in MAPS_REFUSED:
        assert old in MAP
        assert expected in refused(tmp_path, source, MAP.replace(old, new, 1), capsys)


def test_k_m_and_inertia_without_a_known_load_are_only_a_ratio(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = MAP.replace('unit = "N"', 'unit = "A"') + "k_m = 0.02\n"
    said = refused(tmp_path, csv(tmp_path / "r.csv", RECORDING), text, capsys)
    assert "scale together" in said
    held = text.replace("mass = 70.0\n", "") + "[machine.known]\nmass = 95.0\n"
    assert opened(tmp_path, tmp_path / "r.csv", held).bench.machine.unknown == ("k_m", "T_c", "f_v")  # type: ignore[union-attr]
    (tmp_path / "map.toml").write_text(held.replace("k_m = 0.02", "k_m = 1.1"))
    asked = ["estimate", str(tmp_path / "r.csv"), "--map", str(tmp_path / "map.toml"), "--window", "0.02", "--json"]
    assert main(asked) in (0, 1)
    assert json.loads(capsys.readouterr().out)["parameters"]["k_m"]["value"] == pytest.approx(1.0, rel=0.01)


FILES_REFUSED = (
    ("r.csv", b"t,x,F\n0,1\n"),
    ("r.csv", b"t,x,F\n" + b"".join(b"%d,a,b\n" % k for k in range(40))),
    ("r.csv", b"t,x,F\n" + b"".join(b"%d,1.0,2.0\n" % (9 - k) for k in range(40))),
    ("r.csv", b"t,x,F\n0.0,0.0,0.0\n0.001,0.0,0.0\n"),
    ("r.xls", b"?"),
)


def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content in FILES_REFUSED:
        (tmp_path / name).write_bytes(content)
        assert name in refused(tmp_path, tmp_path / name, MAP, capsys)


def test_nothing_is_driven_or_designed_with_the_machine_of_a_recording(tmp_path: Path) -> None:
    found = opened(tmp_path, csv(tmp_path / "r.csv", RECORDING))
    (tmp_path / "bench.toml").write_bytes(found.attachments["bench.toml"])
    with pytest.raises(BenchFileError, match=r"machine: .* nothing is driven"):
        load_bench(tmp_path / "bench.toml")
    assert load_bench(tmp_path / "bench.toml", analysis=True).machine is not None


def test_the_map_in_the_documentation_is_whole(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs/howto/recordings-of-others.md").read_text(encoding="utf-8")
    text = page.partition("```toml\n")[2].partition("```")[0]
    found = opened(tmp_path, csv(tmp_path / "r.csv", RECORDING), text)
    check(found.experiment)
    machine = found.bench.machine
    assert machine is not None
    assert machine.unknown == ("T_c", "f_v", "J")
