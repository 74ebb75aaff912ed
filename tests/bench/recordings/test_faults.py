"""Faults of data and map are named, with the row of the file and with what mends them; what is no fault is not."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from emb_bench.cli.replay import main
from emb_bench.recordings.recording import open_recording
from emb_runtime.errors import UsageError
from tests.bench.recordings.turning import T_S, TIMED, Floats, columns, csv_text, put

RIGHT = columns()
N = len(RIGHT["t"])
K = np.arange(N)
TURN = 2.0 * math.pi


def late(samples: float) -> dict[str, Floats]:
    """Sensors that show where the machine was some samples ago."""
    return {name: np.interp(K - samples, K, RIGHT[name]) for name in ("angle", "velocity")}


def with_value(name: str, value: float, rows: tuple[int, ...] = (301, 302, 700)) -> dict[str, Floats]:
    """A column with a value in some rows."""
    changed = RIGHT[name].copy()
    changed[[row - 1 for row in rows]] = value
    return {name: changed}


class Fault(NamedTuple):
    """A change of a recording, what is said of it, and the lines of a map that mend it."""

    changed: Mapping[str, Floats]
    said: str
    mended: Mapping[str, str] | None = None  # None where nothing in a map does
    given: Mapping[str, str] = {}  # Lines of the map already


T = RIGHT["t"]
MS = f'{TIMED}\nunit = "ms"'
EVEN = "sample_time = 0.002"
TURNS = {"angle": f"scale = {TURN}"}
SPECIAL = "are apart from all others, the first one"
REFUSED = {
    "a wrapped angle": Fault({"angle": RIGHT["angle"] % TURN}, "wrap = 6.283185307", {"angle": f"wrap = {TURN}"}),
    "one about zero": Fault(
        {"angle": (RIGHT["angle"] + 3.0) % TURN - 3.0}, "wraps around after a period", {"angle": f"wrap = {TURN}"}
    ),
    "one in degrees": Fault(
        {"angle": np.degrees(RIGHT["angle"]) % 360.0},
        "wrap = 360 ",
        {"angle": f"wrap = 360\nscale = {math.pi / 180}"},
        {"angle": f"scale = {math.pi / 180}"},
    ),
    "one of half turns": Fault(
        {"angle": RIGHT["angle"] / TURN % 0.5}, "wrap = 0.5 ", {"angle": f"wrap = 0.5\nscale = {TURN}"}, TURNS
    ),
    "steps that begin anew at once": Fault(
        {"angle": np.floor(RIGHT["angle"] / TURN * 4000.0) % 4000.0},
        "wrap = 4000 ",
        {"angle": f"wrap = 4000\nscale = {TURN / 4000.0}"},
        {"angle": f"scale = {TURN / 4000.0}"},
    ),
    "signed bytes": Fault(
        {"angle": (np.floor(RIGHT["angle"] * 20.0) + 128.0) % 256.0 - 128.0},
        "wrap = 256 ",
        {"angle": "wrap = 256\nscale = 0.05"},
        {"angle": "scale = 0.05"},
    ),
    "few steps": Fault(
        {"angle": np.floor(RIGHT["angle"] * 20.0) % 97.0},
        "wrap = 97 ",
        {"angle": "wrap = 97\nscale = 0.05"},
        {"angle": "scale = 0.05"},
    ),
    "steps that begin anew once": Fault(
        {"angle": (np.floor(RIGHT["angle"] / TURN * 8192.0) + 65500.0) % 65536.0},
        "wrap = 65536 ",
        {"angle": f"wrap = 65536\nscale = {TURN / 8192.0}"},
        {"angle": f"scale = {TURN / 8192.0}"},
    ),
    "a wrapped angle and the velocity of the other sign": Fault(
        {"angle": RIGHT["angle"] % TURN, "velocity": -RIGHT["velocity"]},
        "wrap = 6.283185307",
        {"angle": f"wrap = {TURN}", "velocity": "sign = -1"},
    ),
    "a period in another unit": Fault(
        {"angle": RIGHT["angle"] / TURN % 1.0},
        "further than wrap = 0.5 says",
        {"angle": f"wrap = 1.0\nscale = {TURN}"},
        {"angle": f"wrap = 0.5\nscale = {TURN}"},
    ),
    "a special angle": Fault(
        with_value("angle", 65535.0),
        f"3 values of angle ([signals.angle]) {SPECIAL} 65535 in row 301",
        {"angle": "special = [65535]"},
    ),
    "one by its range": Fault(with_value("angle", -999.0), "or range = [", {"angle": "range = [-10, 100]"}),
    "one among others": Fault(with_value("angle", 0.0), f"{SPECIAL} 0 in row 301", {"angle": "special = [0]"}),
    "one in every twelfth row": Fault(
        with_value("angle", -9999.0, tuple(range(3, N, 12))),
        f"{SPECIAL} -9999 in row 3",
        {"angle": "special = [-9999]"},
    ),
    "one for a fifth of a second": Fault(
        with_value("angle", 32767.0, tuple(range(601, 701))), f"{SPECIAL} 32767 in", {"angle": "special = [32767]"}
    ),
    "a command of ones": Fault(with_value("current", 255.0), f"{SPECIAL} 255 in", {"command": "special = [255]"}),
    "a velocity": Fault(with_value("velocity", 32767.0), f"{SPECIAL} 32767 in", {"velocity": "special = [32767]"}),
    "a command": Fault(with_value("current", 65535.0), f"{SPECIAL} 65535 in", {"command": "special = [65535]"}),
    "the largest float": Fault(
        with_value("current", 1.797e308), "is 1.797e+308 in row 301", {"command": "range = [-10, 10]"}
    ),
    "an encoder set anew": Fault(
        {"angle": RIGHT["angle"] - 9.0 * (K >= 600)}, "after row 600, 1 times", {"file": "rows = [1, 600]"}
    ),
    "single precision": Fault(
        {"t": (1.7e9 + T).astype(np.float32).astype(float)}, "999 of 1000 rows have the same time", {"timing": EVEN}
    ),
    "blocks": Fault(
        {"t": T_S * 5 * (K // 5).astype(np.float64)},
        "800 of 1000 rows have the same time as the row before, the first one row 2",
        {"timing": EVEN},
        {"timing": f"{TIMED}\n{EVEN}"},
    ),
    "midnight": Fault(
        {"t": (86_399_000.0 + 1e3 * T) % 86_400_000.0},
        "begins anew after row 500, at 86399.998 s: of a counter, [timing] wrap = 86400000",
        {"timing": f"{MS}\nwrap = 86400000"},
        {"timing": MS},
    ),
    "two recordings": Fault({"t": T % 1.0}, "rows = [1, 500] or [501, 1000]", {"file": "rows = [501, 1000]"}),
    "a row too early": Fault({"t": np.where(K == 700, T - 2.5 * T_S, T)}, "runs backwards after row 700"),
    "a time apart": Fault({"t": np.where(K == 700, 1e20, T)}, "is 1e+20 s in row 701, between 1.398 and 1.402 s"),
    "a time before all": Fault({"t": np.where(K == 700, -1.0, T)}, "is -1 s in row 701, between 1.398 and 1.402 s"),
    "rows from last to first": Fault({"t": T[::-1]}, "runs backwards after row 1, from 1.998 to 1.996 s"),
    "a guess that no machine has": Fault({}, "the guess of f_v is too far off", {}, {"f_v": "1.0"}),
    "a tail of zeros": Fault({"t": np.where(K < 900, T, 0.0)}, "after row 900", {"file": "rows = [1, 900]"}),
    "a clock that is set": Fault(
        {"t": T + 3600.0 * (K >= 400)}, "jumps by 3600 s after row 400", {"file": "rows = [401, 1000]"}
    ),
    "sparse rows": Fault({}, "the rows are 0.002 s apart", {}, {"timing": f"{TIMED}\nsample_time = 0.0005"}),
    "another unit": Fault({"t": 1e3 * T}, "with unit = 'ms' it is", {"timing": MS}),
}
NAMED = {
    "a command of the other sign": Fault(
        {"current": -RIGHT["current"]}, "against the command: sign = -1", {"command": "sign = -1"}
    ),
    "a velocity of the other sign": Fault(
        {"velocity": -RIGHT["velocity"]}, "velocity is against the angle", {"velocity": "sign = -1"}
    ),
    "a velocity per minute": Fault(
        {"velocity": 60.0 / TURN * RIGHT["velocity"]}, "0.1047 times as far", {"velocity": f"scale = {TURN / 60.0}"}
    ),
    "a current in mA": Fault(
        {"current": 1e3 * RIGHT["current"]},
        "the angle moves 0.001 times as far as the command",
        {"command": "scale = 1e-3"},
    ),
    "angle and velocity in degrees": Fault(
        {name: np.degrees(RIGHT[name]) for name in ("angle", "velocity")},
        "the angle moves 57 times as far as the command",
        dict.fromkeys(("angle", "velocity"), f"scale = {TURN / 360.0}"),
    ),
    "a velocity that is the angle": Fault({"velocity": RIGHT["angle"]}, "the velocity is not that of the angle"),
    "a velocity of the other sign, with gaps": Fault(
        {"velocity": np.where(K % 100 == 7, np.nan, -RIGHT["velocity"])},
        "velocity is against the angle",
        {"velocity": "sign = -1"},
    ),
    "very late sensors": Fault(late(30.0), "delay = 0.06 in [signals.command]", {"command": "delay = 0.06"}),
    "late sensors": Fault(late(3.4), "delay = 0.0068 in [signals.command]", {"command": "delay = 0.0068"}),
    "early sensors": Fault(late(-3.0), "3.0 samples early, more than is searched", {"command": "delay = -0.006"}),
    "a guess too large": Fault({}, "the guess of T_c and f_v is too far off", {}, {"T_c": "0.36", "f_v": "0.006"}),
    "a guess too small": Fault({}, "the recording says about f_v = 0.0002", {}, {"f_v": "4e-6"}),
}


def opened_faults(folder: Path, fault: Fault, text: Mapping[str, str]) -> tuple[str, ...]:
    return open_recording(*put(folder, csv_text(RIGHT | dict(fault.changed)), text)).experiment.quality.faults


@pytest.mark.parametrize("name", REFUSED)
def test_a_fault_of_the_data_is_refused_with_its_row_and_what_mends_it(name: str, tmp_path: Path) -> None:
    fault = REFUSED[name]
    with pytest.raises(UsageError) as refused:
        opened_faults(tmp_path, fault, fault.given)
    assert fault.said in str(refused.value)
    if fault.mended is not None:
        assert opened_faults(tmp_path, fault, fault.mended) == ()


@pytest.mark.parametrize("name", NAMED)
def test_a_contradiction_of_the_map_is_the_first_thing_that_is_said(name: str, tmp_path: Path) -> None:
    fault = NAMED[name]
    assert fault.said in opened_faults(tmp_path, fault, fault.given)[0]
    if fault.mended is not None:
        assert opened_faults(tmp_path, fault, fault.mended) == ()


def test_a_fault_comes_before_any_suspect_and_has_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("late sensors", "a command of the other sign", "a guess too large"):
        fault = NAMED[name]
        source, map_path = put(tmp_path, csv_text(RIGHT | dict(fault.changed)), fault.given)
        command = ["estimate", str(source), "--map", str(map_path), "--window", "0.25"]
        assert main(command) == 1
        said = " ".join(capsys.readouterr().out.split())
        assert fault.said in said
        assert "correct the map by the first line" in said
        assert "explains the misfit" not in said


def test_the_remedy_for_what_the_model_lacks_works_as_it_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, map_path = put(tmp_path, csv_text(columns(static=1.6)))
    command = ["estimate", str(source), "--map", str(map_path), "--window", "0.25"]
    assert main(command) == 1
    said = " ".join(capsys.readouterr().out.split())
    remedy = re.search(
        r"remedy: (?:estimate it as well: )?(--nuisance break_away,stribeck_velocity --window [\d.]+) ", said
    )
    assert remedy is not None, said
    assert main([*command[:-2], *remedy[1].split()]) in (0, 1)
    assert "break_away 1." in " ".join(capsys.readouterr().out.split())


STEPS = {
    "a step of the current": lambda: columns(seed=3),
    "a coarse encoder": lambda: RIGHT | {"angle": np.round(RIGHT["angle"] * 650.0) / 650.0},
    "a machine at rest": lambda: RIGHT | dict.fromkeys(("angle", "velocity", "current"), 0.0 * T),
    "times of a busy recorder": lambda: RIGHT | {"t": T + T_S * np.random.default_rng(1).uniform(-0.3, 0.3, N)},
    "a gap of a second": lambda: RIGHT | {"t": T + 1.0 * (K >= 400)},
    "repeated rows": lambda: {name: np.repeat(column, 2) for name, column in RIGHT.items()},
    "a current that drops out": lambda: RIGHT | with_value("current", 0.0),
}


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("velocity", [True, False])
def test_what_is_no_fault_is_not_called_one(name: str, velocity: bool, tmp_path: Path) -> None:
    make: Callable[[], dict[str, Floats]] = STEPS[name]
    source, map_path = put(tmp_path, csv_text(make()))
    if not velocity:
        text = map_path.read_text()
        begin, end = text.index("[signals.velocity]"), text.index("[signals.command]")
        map_path.write_text(text[:begin] + text[end:])
    assert open_recording(source, map_path).experiment.quality.faults == ()
