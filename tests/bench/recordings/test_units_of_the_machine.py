"""Results of a machine that is no brake are in its own names and units."""

from __future__ import annotations

import contextlib
import io
import json
import math
from typing import Any

import pytest

from emb_bench.brake.parameters import angle, command, quantity, velocity
from emb_bench.cli.replay import main
from emb_bench.config.machine import Machine as Kind
from emb_bench.config.machine import Units
from emb_bench.recordings.map_file import parse_map
from tests.bench.linear_machine import MAP, TRAVEL

LINEAR = Kind(("J",), (), 0.5, "held", 2e-3, Units("mm", "kN"))
TURNING = Kind(("J",), (), 0.5, "held", 0.0, Units("deg", "V"))
IN_VOLTS = (
    MAP.partition("[machine]")[0].replace('unit = "m"', 'unit = "deg"').replace('"N"', '"V"')
    + "[machine]\nwindow = 0.5\n[machine.known]\nJ = 1e-5\nk_m = 0.02\n[machine.guess]\nT_c = 0.01\nf_v = 1e-4\n"
)


@pytest.fixture(scope="module")
def repeated(recording: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The document of an estimate that is compared with the same one before."""
    last = tmp_path_factory.mktemp("repeated") / "last.json"
    last.write_text(printed("estimate", *recording, "--starts", "1", "--json"))
    found: dict[str, Any] = json.loads(printed("estimate", *recording, "--starts", "1", "--json", "--last", str(last)))
    return found


def printed(*arguments: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*arguments]) == 0
    return out.getvalue()


def test_the_document_of_an_estimate_has_the_true_values_in_the_units_it_names(repeated: dict[str, Any]) -> None:
    wanted = {"mass": (95.0, "kg"), "F_c": (20.0, "N"), "F_v": (200.0, "N·s/m"), "force_offset": (-3e-3, "kN")}
    assert repeated["parameters"].keys() == wanted.keys()
    for name, (true, unit) in wanted.items():
        entry = repeated["parameters"][name]
        assert entry["value"] == pytest.approx(true, rel=0.02)
        assert entry["interval_95"][0] <= entry["value"] <= entry["interval_95"][1]
        assert entry["unit"] == unit
        assert repeated["starts"][0]["values"][name] == pytest.approx(true, rel=0.02)
    assert {c["label"]: c["unit"] for c in repeated["conclusions"]} == {
        name: unit for name, (_, unit) in wanted.items()
    }
    offset = repeated["parameters"]["force_offset"]
    half = 0.5 * (offset["interval_95"][1] - offset["interval_95"][0])
    assert half == pytest.approx(1.96 * offset["deviation"], rel=1e-3)
    # What another command goes on with stays in coordinates of the motor.
    assert repeated["theta"]["J"] == pytest.approx(95.0 * TRAVEL**2, rel=0.02)


def test_an_estimate_is_compared_with_an_earlier_one_in_the_same_units(repeated: dict[str, Any]) -> None:
    drifts = {d["name"]: d for d in repeated["drifts"]}
    assert drifts.keys() == {"mass", "F_c", "F_v", "force_offset"}
    assert all(d["relative_change"] == pytest.approx(0.0, abs=1e-9) and not d["drifted"] for d in drifts.values())
    assert drifts["mass"]["now"] == pytest.approx(95.0, rel=0.02)


def test_information_is_told_by_the_names_of_the_machine(recording: tuple[str, ...]) -> None:
    said = printed("fim", *recording)
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
