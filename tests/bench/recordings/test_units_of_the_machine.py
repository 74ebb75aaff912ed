"""Results of a machine that is no brake are in its own names and units."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from emb_bench.brake.parameters import angle, command, quantity, velocity
from emb_bench.cli.replay import main
from emb_bench.config.machine import Machine as Kind
from emb_bench.config.machine import Units
from emb_bench.recordings.map_file import parse_map
from tests.bench.linear_machine import MAP, TRAVEL, Machine, record

LINEAR = Kind(("J",), (), 0.5, "held", 2e-3, Units("mm", "kN"))
TURNING = Kind(("J",), (), 0.5, "held", 0.0, Units("deg", "V"))
IN_VOLTS = (
    MAP.partition("[machine]")[0].replace('unit = "m"', 'unit = "deg"').replace('"N"', '"V"')
    + "[machine]\nwindow = 0.5\n[machine.known]\nJ = 1e-5\nk_m = 0.02\n[machine.guess]\nT_c = 0.01\nf_v = 1e-4\n"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A recording in millimetres and kilonewtons as a log."""
    folder = tmp_path_factory.mktemp("units")
    found = record(Machine(), 4.0)
    rows = zip(found.time.tolist(), (1e3 * found.position).tolist(), (1e-3 * found.force).tolist(), strict=True)
    (folder / "r.csv").write_text("t,x,F\n" + "".join(f"{t!r},{x!r},{f!r}\n" for t, x, f in rows))
    text = MAP.replace('"m"', '"mm"').replace('"N"', '"kN"').replace("window = 0.5", "window = 0.1")
    (folder / "map.toml").write_text(text.replace(f"noise = {5e-8 / math.sqrt(12.0)}", "noise = 1.4e-5"))
    out = str(folder / "run.mcap")
    assert main(["import", str(folder / "r.csv"), "--map", str(folder / "map.toml"), "-o", out]) == 0
    return out


def test_an_estimate_prints_a_linear_machine_in_kilograms_and_newtons(
    run: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["estimate", run, "--starts", "1"]) == 0
    said = capsys.readouterr().out
    for label, unit in (("mass", "kg"), ("F_c", "N"), ("F_v", "N·s/m")):
        line = next(line for line in said.splitlines() if line.startswith(f"{label} "))
        assert f" {unit} " in line
    for foreign in ("kg·m²", "N·m ", "rad ", "T_c", "f_v", "stiffness", "hysteresis"):
        assert foreign not in said
    assert "only ratios do without" in said.replace("\n    ", " ")


def test_the_document_of_an_estimate_has_the_true_values_in_the_units_it_names(
    run: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["estimate", run, "--starts", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    wanted = {"mass": (95.0, "kg"), "F_c": (20.0, "N"), "F_v": (200.0, "N·s/m"), "force_offset": (-3e-3, "kN")}
    assert document["parameters"].keys() == wanted.keys()
    for name, (true, unit) in wanted.items():
        entry = document["parameters"][name]
        assert entry["value"] == pytest.approx(true, rel=0.02)
        assert entry["interval_95"][0] <= entry["value"] <= entry["interval_95"][1]
        assert entry["unit"] == unit
        assert document["starts"][0]["values"][name] == pytest.approx(true, rel=0.02)
    assert {c["label"]: c["unit"] for c in document["conclusions"]} == {
        name: unit for name, (_, unit) in wanted.items()
    }
    offset = document["parameters"]["force_offset"]
    half = 0.5 * (offset["interval_95"][1] - offset["interval_95"][0])
    assert half == pytest.approx(1.96 * offset["deviation"], rel=1e-3)
    # What another command goes on with stays in coordinates of the motor.
    assert document["theta"]["J"] == pytest.approx(95.0 * TRAVEL**2, rel=0.02)


def test_the_report_shows_the_machine_and_nothing_of_a_loop_or_a_limit(run: str, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    assert main(["report", run, "--starts", "1", "-o", str(page)]) in (0, 1)
    text = page.read_text(encoding="utf-8")
    assert "mass" in text
    assert "N·s/m" in text
    assert "Force that acted over time" in text
    assert "Residuals of angle over time" in text
    assert "residuals of the velocity" not in text  # which the recording does not have
    for foreign in ("kg·m²", "shield", "the node", 'id="safety"', 'id="timing"', "rad/s, limit"):
        assert foreign not in text


def test_an_estimate_is_compared_with_an_earlier_one_in_the_same_units(
    run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["estimate", run, "--starts", "1", "--json"]) == 0
    (tmp_path / "last.json").write_text(capsys.readouterr().out)
    assert main(["estimate", run, "--starts", "1", "--json", "--last", str(tmp_path / "last.json")]) == 0
    drifts = {d["name"]: d for d in json.loads(capsys.readouterr().out)["drifts"]}
    assert drifts.keys() == {"mass", "F_c", "F_v", "force_offset"}
    assert all(d["relative_change"] == pytest.approx(0.0, abs=1e-9) and not d["drifted"] for d in drifts.values())
    assert drifts["mass"]["now"] == pytest.approx(95.0, rel=0.02)


def test_information_is_told_by_the_names_of_the_machine(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["fim", run]) == 0
    said = capsys.readouterr().out
    assert "F_c = 14 N, F_v = 300 N·s/m, mass = 70 kg" in " ".join(said.split())
    assert " kN" in next(line for line in said.splitlines() if line.startswith("  force_offset"))
    assert "T_c" not in said
    assert "braked by the node" not in said


def test_quantities_follow_what_was_measured_and_commanded() -> None:
    for found, name, unit, factor in (
        (angle(LINEAR), "position", "mm", 2.0),
        (velocity(LINEAR), "velocity", "mm/s", 2.0),
        (command(LINEAR), "force", "kN", 0.5),
        (quantity(LINEAR, "J"), "mass", "kg", 250000.0),
        (quantity(LINEAR, "T_c"), "F_c", "N", 500.0),
        (quantity(LINEAR, "current_offset"), "force_offset", "kN", 0.5),
        (angle(TURNING), "angle", "°", 180.0 / math.pi),
        (quantity(TURNING, "k_m"), "k_m", "N·m/V", 1.0),
        (quantity(TURNING, "current_offset"), "voltage_offset", "V", 1.0),
        (quantity(TURNING, "J"), "J", "kg·m²", 1.0),
        (quantity(None, "current_offset"), "current_offset", "A", 1.0),
    ):
        assert found[:2] == (name, unit)
        assert found.factor == pytest.approx(factor)


def test_results_are_in_the_units_of_the_recording() -> None:
    assert parse_map(MAP, "map").shown == {"angle": "m", "command": "N"}
    assert parse_map(IN_VOLTS, "map").shown == {"angle": "deg", "command": "V"}
