"""Commands on recordings of others work in their names and units, or say in one line what is missing."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from emb_bench import api
from emb_bench.brake.parameters import quantity
from emb_bench.cli.replay import main
from emb_bench.config.machine import Machine as Kind
from emb_bench.report.sentences import random_walks
from examples.recording import TRUTH
from tests.bench.linear_machine import MAP, Machine, record
from tests.drives import EXAMPLES


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """A recording in millimetres and kilonewtons, and its map, as arguments."""
    folder = tmp_path_factory.mktemp("others")
    found = record(Machine(), 2.0)
    rows = zip(found.time.tolist(), (1e3 * found.position).tolist(), (1e-3 * found.force).tolist(), strict=True)
    (folder / "r.csv").write_text("t,x,F\n" + "".join(f"{t!r},{x!r},{f!r}\n" for t, x, f in rows))
    text = (
        MAP.replace('"m"', '"m"\nscale = 1e-3')
        .replace('"N"', '"N"\nscale = 1e3')
        .replace("window = 0.5", "window = 0.1")
    )
    (folder / "map.toml").write_text(text)
    return str(folder / "r.csv"), "--map", str(folder / "map.toml")


WORKS: dict[str, tuple[str, ...]] = {
    "fim": ("fim",),
    "estimate": ("estimate", "--starts", "1"),
    "estimate --method pem": ("estimate", "--method", "pem", "--starts", "1"),
    "report": ("report", "--starts", "1", "-o", "OUT.html"),
}
LACKS: dict[str, tuple[tuple[str, ...], str]] = {
    "estimate --method rls": (("estimate", "--method", "rls"), "another method does"),
    "estimate --model all": (("estimate", "--model", "all"), "expected --method oem"),
    "estimate --params k_1": (("estimate", "--params", "k_1"), "zero in this bench"),
}


def called(words: tuple[str, ...], recording: tuple[str, ...], folder: Path) -> int:
    command, *options = words
    return main([command, *recording, *(option.replace("OUT", str(folder / "out")) for option in options)])


class Saying(NamedTuple):
    """What a command printed, and where it has written."""

    out: str
    folder: Path


Say = Callable[[str], Saying]


@pytest.fixture(scope="module")
def say(recording: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> Say:
    """Calls a command that works, once."""

    @cache
    def of(name: str) -> Saying:
        folder = tmp_path_factory.mktemp("said")
        with contextlib.redirect_stdout(io.StringIO()) as out:
            assert called(WORKS[name], recording, folder) in (0, 1)
        return Saying(out.getvalue(), folder)

    return of


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n == "estimate --method pem" else n for n in WORKS]
)
def test_a_command_works_and_says_nothing_of_a_loop(name: str, say: Say) -> None:
    for nonsense in ("missed", "unanswered", "returning home", "braked by the node", "nan", "sensor to command"):
        assert nonsense not in say(name).out


def test_an_estimate_prints_a_linear_machine_in_kilograms_and_newtons(say: Say) -> None:
    said = say("estimate").out
    for label, unit in (("mass", "kg"), ("F_c", "N"), ("F_v", "N·s/m")):
        line = next(line for line in said.splitlines() if line.startswith(f"{label} "))
        assert f" {unit} " in line
    for foreign in ("kg·m²", "N·m ", "rad ", "T_c", "f_v", "stiffness", "hysteresis"):
        assert foreign not in said
    assert "which their ratios do not need" in " ".join(said.split())


def test_the_report_shows_the_machine_and_nothing_of_a_loop_or_a_limit(say: Say) -> None:
    page = (say("report").folder / "out.html").read_text(encoding="utf-8")
    for own in ("mass", "N·s/m", "Force that acted over time", "Residuals of angle over time"):
        assert own in page
    assert "residuals of the velocity" not in page  # which the recording does not have
    for foreign in ("kg·m²", "shield", "the node", 'id="safety"', 'id="timing"', "rad/s, limit"):
        assert foreign not in page


@pytest.mark.parametrize("name", LACKS)
def test_a_command_says_in_one_line_what_it_lacks(
    name: str, recording: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = LACKS[name]
    capsys.readouterr()
    assert called(words, recording, tmp_path) == 2
    said = capsys.readouterr().err.strip()
    assert expected in said
    assert "\n" not in said


def test_the_page_has_every_case() -> None:
    page = (Path(__file__).parents[3] / "docs/howto/recordings-of-others.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for name in (*WORKS, *LACKS):
        assert any(f"`{name}`" in row for row in rows), name


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


FOLDER = EXAMPLES.parent
WORN = {"k_m": 0.0217, "k_1": 23.04, "T_c": 0.01037, "f_v": 4e-5}
RECORDED = {"k_m": TRUTH.k_m, "k_1": TRUTH.k_1, "T_c": TRUTH.t_c, "f_v": TRUTH.f_v}


@pytest.mark.parametrize(
    ("name", "options", "truth", "most"),
    [("worn.mcap", {"starts": 1}, WORN, 300e3), ("recording.csv", {"map": FOLDER / "map.toml"}, RECORDED, 150e3)],
)
def test_the_values_lie_within_their_totals(
    name: str, options: dict[str, Any], truth: dict[str, float], most: float
) -> None:
    assert (FOLDER / name).stat().st_size < most
    study = api.estimate(FOLDER / name, **options)
    assert study.model_fits
    assert {*study.params} == {*truth}
    assert all(c.interval[0] <= truth[c.label] <= c.interval[1] for c in study)
