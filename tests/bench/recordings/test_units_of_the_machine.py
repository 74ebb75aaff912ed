"""Results of a machine that is no brake are in its own names and units."""

from __future__ import annotations

import contextlib
import io
import json
from typing import Any

import pytest

from emb_bench.brake.parameters import quantity
from emb_bench.cli.replay import main
from emb_bench.config.machine import Machine as Kind
from emb_bench.report.sentences import random_walks

LINEAR = Kind(("J",), (), 0.5, "m", "N")
TURNING = Kind(("J",), (), 0.5, "rad", "V")


@pytest.fixture(scope="module")
def repeated(recording: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The document of an estimate that is compared with the same one before."""
    last = tmp_path_factory.mktemp("repeated") / "last.json"
    last.write_text(printed("estimate", *recording, "--starts", "1", "--json"))
    found: dict[str, Any] = json.loads(printed("estimate", *recording, "--starts", "1", "--json", "--last", str(last)))
    return found


def printed(*arguments: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*arguments]) in (0, 1)  # 1: the machine is not quite the model's
    return out.getvalue()


def test_the_document_of_an_estimate_has_the_true_values_in_the_units_it_names(repeated: dict[str, Any]) -> None:
    wanted = {"mass": (95.0, "kg"), "F_c": (20.0, "N"), "F_v": (200.0, "N·s/m"), "force_offset": (-3.0, "N")}
    assert repeated["parameters"].keys() == wanted.keys()
    for name, (true, unit) in wanted.items():
        entry = repeated["parameters"][name]
        assert entry["value"] == pytest.approx(true, rel=0.02)
        assert entry["interval_95"][0] <= entry["value"] <= entry["interval_95"][1]
        assert entry["unit"] == unit
        assert repeated["starts"][0]["values"][name] == pytest.approx(true, rel=0.02)
    offset = repeated["parameters"]["force_offset"]
    half = 0.5 * (offset["interval_95"][1] - offset["interval_95"][0])
    assert half == pytest.approx(1.96 * offset["deviation"], rel=1e-3)
    # What another command goes on with has the names of the equations.
    assert repeated["theta"]["J"] == pytest.approx(95.0, rel=0.02)


def test_an_estimate_is_compared_with_an_earlier_one_in_the_same_units(repeated: dict[str, Any]) -> None:
    drifts = {d["name"]: d for d in repeated["drifts"]}
    assert drifts.keys() == {"mass", "F_c", "F_v", "force_offset"}
    assert all(d["relative_change"] == pytest.approx(0.0, abs=1e-9) and not d["drifted"] for d in drifts.values())
    assert drifts["mass"]["now"] == pytest.approx(95.0, rel=0.02)


def test_information_is_told_by_the_names_of_the_machine(recording: tuple[str, ...]) -> None:
    said = printed("fim", *recording)
    assert "F_c = 14 N, F_v = 300 N·s/m, mass = 70 kg" in " ".join(said.split())
    assert " N" in next(line for line in said.splitlines() if line.startswith("  force_offset"))
    assert "T_c" not in said
    assert "braked by the node" not in said


def test_names_and_units_follow_what_was_measured_and_commanded() -> None:
    assert [
        quantity(LINEAR, name)
        for name in ("angle", "velocity", "current", "J", "T_c", "f_v", "current_offset", "offset")
    ] == [
        *(("position", "m"), ("velocity", "m/s"), ("force", "N"), ("mass", "kg"), ("F_c", "N"), ("F_v", "N·s/m")),
        *(("force_offset", "N"), ("offset", "m")),
    ]
    assert [quantity(TURNING, name) for name in ("angle", "current", "k_m", "current_offset", "J")] == [
        *(("angle", "rad"), ("voltage", "V"), ("k_m", "N·m/V"), ("voltage_offset", "V"), ("J", "kg·m²")),
    ]
    assert quantity(None, "current_offset") == ("current_offset", "A")


def test_a_disturbance_is_in_the_units_of_the_machine() -> None:
    for machine, velocity, command in ((LINEAR, "m/s", "a force of 2 N"), (None, "rad/s", "a current of 2 A")):
        walks = random_walks(machine, 0.5, 2.0)
        assert f"0.5 {velocity} per" in walks[0]
        assert f"{command} per" in walks[1]
    assert random_walks(LINEAR, 0.0, 0.0) == []
