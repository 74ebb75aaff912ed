"""The identified brake as FMU, as C and as calibration file, against the bench's own simulation and other readers."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from emb_bench import api
from emb_bench.analysis.study import Study
from emb_bench.brake.exact import LONGEST
from emb_bench.brake.forces import clamping_force, decay, sliding_torque, static_torque, travel
from emb_bench.brake.motion import Floats
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import Mechanics
from emb_bench.estimate.records import Unknown, searched
from emb_bench.experiment.simulate import Theta
from emb_bench.export.c_source import OUTPUTS, c_source
from emb_bench.export.export import write_model
from emb_bench.export.identified import CHOSEN, Identified, drawn
from emb_bench.sim.open_loop import march, trajectory, zero_order_hold
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.conftest import Replay  # isort: skip

BENCH = load_bench()
T_S = BENCH.timing.sample_time
PLAIN = Identified("test", BENCH, BENCH.brake, Mechanics())
FEATURES = {
    "exact": Mechanics(),
    "viscous asymmetry": Mechanics(viscous_asymmetry=0.3),
    "play": Mechanics(play=0.5, quadratic=1e-3, f_l=2e-6, break_away=1.2, stribeck_velocity=9.0, stribeck_exponent=1.5),
    "hysteresis": Mechanics(break_away=1.3, current_lag=0.002, hysteresis=0.2, hysteresis_travel=0.5, cubic=1e-5),
}


def profile(seed: int, periods: int = 400) -> Floats:
    """Currents that reverse, hold and release the brake; half of them are too small to move it from rest."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-4.0, 4.0, periods) * rng.choice([0.1, 1.0], periods)
    return np.repeat(levels, rng.integers(1, 60, periods))[:periods]


def expected(found: Identified, currents: Floats) -> Floats:
    """States after each period by the bench's simulation."""
    x, chosen, s = Theta(found.brake, contact=found.contact).begin(0.0, ())
    states, _ = trajectory(march, found.mechanics, found.brake, zero_order_hold(currents, T_S), chosen, x, s)
    shown: Floats = states[1:] + np.array([found.contact, 0.0, 0.0, 0.0])
    return shown


def simulated(path: Path, currents: Floats, **start: float) -> Any:
    """Outputs after each period by FMPy."""
    rows = [(T_S * k, current) for k, current in enumerate(currents)]
    found = fmpy.simulate_fmu(
        str(path),
        step_size=T_S,
        output_interval=T_S,
        stop_time=T_S * len(currents),
        start_values=start,
        input=np.array(rows, [("time", float), ("current", float)]),
        output=list(OUTPUTS),
    )
    return found[1 : len(currents) + 1]


def assert_same(found: Any, states: Floats) -> None:
    for column, name in enumerate(("angle", "velocity")):
        assert np.abs(found[name] - states[:, column]).max() < 1e-6 * np.ptp(states[:, column])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("identified") / "run.mcap"
    api.simulate(path, seed=1)
    return path


@pytest.fixture(scope="module")
def study(log: Path) -> Study:
    return api.estimate(log)


@pytest.mark.parametrize("name", FEATURES)
def test_an_fmu_moves_as_the_bench_simulates(name: str, tmp_path: Path) -> None:
    m, path = FEATURES[name], tmp_path / "brake.fmu"
    found = Identified("test", BENCH, BENCH.brake, m, contact=1.5)
    assert "binaries/" in write_model(found, path)
    assert validate_fmu(str(path)) == []
    at_rest = 0
    for seed in range(3):
        currents = profile(seed)
        states, moved = expected(found, currents), simulated(path, currents)
        assert_same(moved, states)
        at_rest += int((moved["velocity"] == 0.0).sum())
        for (x1, v, w, i), row in zip(states, moved, strict=True):
            p, x1 = found.brake, float(x1) - found.contact
            load = clamping_force(m, p, x1, w) if travel(m, x1, w) > 0.0 else 0.0
            assert row["clamping_force"] == pytest.approx(load, rel=1e-6, abs=1e-6)
            moving = sliding_torque(m, p, abs(v), load, decay(m, v)) * np.sign(v)
            moving += m.viscous_asymmetry * p.f_v * abs(v)
            most = static_torque(m, p, load)
            friction = moving if v != 0.0 else np.clip(p.k_m * i - p.gamma * load, -most, most)
            assert row["friction_torque"] == pytest.approx(friction, rel=1e-6, abs=1e-9)
    assert at_rest > 50


def test_every_parameter_of_an_fmu_can_be_set(tmp_path: Path) -> None:
    found = Identified("test", BENCH, BENCH.brake, FEATURES["play"])
    write_model(found, tmp_path / "brake.fmu")
    other = found.brake._replace(**{name: 1.2 * value for name, value in found.brake._asdict().items()})
    changed = Identified("test", BENCH, other, Mechanics(cubic=1e-5, play=0.3))
    start = {one.name: one.value for one in changed.parameters() if one.name in {p.name for p in found.parameters()}}
    assert len(start) == len(found.parameters())
    assert_same(simulated(tmp_path / "brake.fmu", profile(7), **start), expected(changed, profile(7)))


def test_an_fmu_has_all_functions_of_fmi_3_in_at_most_400_lines(tmp_path: Path) -> None:
    header = (Path(fmpy.__file__).parent / "c-code/fmi3Functions.h").read_text(encoding="utf-8")
    names = set(re.findall(r"FMI3_Export (fmi3\w+)TYPE", header))
    assert len(names) > 70
    for name, mechanics in FEATURES.items():
        write_model(Identified("test", BENCH, BENCH.brake, mechanics), tmp_path / "brake.fmu")
        folder = Path(fmpy.extract(str(tmp_path / "brake.fmu"), str(tmp_path / name)))
        library = ctypes.CDLL(str(next(folder.glob("binaries/*/brake.so"))))
        assert not [name for name in names if not hasattr(library, name)]
        sources = sorted((folder / "sources").glob("*.c"))
        assert sum(len(path.read_text(encoding="utf-8").splitlines()) for path in sources) <= 400


def test_an_importer_can_step_back_reset_and_is_refused_what_is_no_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(PLAIN, tmp_path / "brake.fmu")
    model = fmpy.read_model_description(tmp_path / "brake.fmu")
    unpacked = fmpy.extract(str(tmp_path / "brake.fmu"), str(tmp_path / "unpacked"))
    keys = {v.name: v.valueReference for v in model.modelVariables}
    fmu = FMU3Slave(guid=model.guid, unzipDirectory=unpacked, modelIdentifier="brake", instanceName="test")
    fmu.instantiate()

    def begun() -> None:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        fmu.setFloat64([keys["current"]], [3.0])

    def stepped() -> list[float]:
        fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.01)
        found: list[float] = fmu.getFloat64([keys["angle"], keys["velocity"]])
        return found

    begun()
    first = stepped()
    state = fmu.getFMUState()
    second = stepped()
    fmu.setFMUState(state)
    assert stepped() == second
    fmu.freeFMUState(state)
    fmu.reset()
    begun()
    assert stepped() == first
    fmu.setFloat64([keys["current"]], [-3.0])  # it opens, and does not come to rest
    refusals: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.0), "a step longer than 0 s"),
        (lambda: fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=1e9), "more than 100000 segments"),
        (lambda: fmu.setFloat64([keys["current"]], [float("nan")]), "beyond min or max"),
        (lambda: fmu.setFloat64([keys["angle"]], [1.0]), "neither a parameter nor the current"),
        (lambda: fmu.setFloat64([keys["J"]], [0.0]), "beyond min or max"),
        (lambda: fmu.setFloat64([keys["T_c"]], [-1.0]), "beyond min or max"),
        (lambda: fmu.setFloat64([keys["T_c"]], [1e300]), "beyond min or max"),
        (lambda: fmu.setFloat64([keys["contact"]], [1.0]), "set before the start"),
        (lambda: fmu.setFloat64([keys["x2_0"]], [1.0]), "set before the start"),
        (lambda: fmu.getFloat64([99]), "no such variable"),
        (fmu.enterEventMode, "fmi3EnterEventMode: this FMU does not have it"),
    )
    outputs = fmu.getFloat64([keys[name] for name in OUTPUTS])
    for refused, reason in refusals:
        capsys.readouterr()
        with pytest.raises(FMICallException):
            refused()
        assert reason in capsys.readouterr().out
        assert fmu.getFloat64([keys[name] for name in OUTPUTS]) == outputs
    fmu.reset()
    with pytest.raises(FMICallException):
        stepped()  # it has not been initialised
    fmu.terminate()
    fmu.freeInstance()


def compiled(found: Identified, folder: Path) -> tuple[ctypes.CDLL, Any]:
    """The library of a brake's C, and a brake that has started."""
    (folder / "brake.c").write_text(c_source(found), encoding="utf-8")
    command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", "brake.so", "brake.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    names = [*(one.name for one in found.parameters()), "current", *OUTPUTS, "x1", "x2", "w", "i"]

    class Brake(ctypes.Structure):
        _fields_ = [(name, ctypes.c_double) for name in names]

    library, brake = ctypes.CDLL(str(folder / "brake.so")), Brake()
    library.brake_step.argtypes = [ctypes.POINTER(Brake), ctypes.c_double, ctypes.c_double]
    library.brake_init(ctypes.byref(brake))
    return library, brake


@pytest.mark.parametrize("name", FEATURES)
def test_firmware_can_hold_the_c(name: str, tmp_path: Path) -> None:
    found, currents = Identified("test", BENCH, BENCH.brake, FEATURES[name]), profile(3)
    library, brake = compiled(found, tmp_path)
    assert [getattr(brake, one.name) for one in found.parameters()] == [one.value for one in found.parameters()]
    rows = np.zeros(len(currents), [(n, float) for n in OUTPUTS])
    for k, current in enumerate(currents):
        assert library.brake_step(ctypes.byref(brake), current, T_S) == 0
        rows[k] = tuple(getattr(brake, n) for n in OUTPUTS)
    assert_same(rows, expected(found, currents))


STRICT = ["-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]
COMPILERS = [
    ("cc", ["-std=c99", "-Wconversion", "-Wshadow", "-Wdouble-promotion"], "brake.c"),
    ("cc", ["-std=c99"], "fmi3.c"),
    ("c++", ["-std=c++11", "-x", "c++"], "brake.c"),
    ("clang", ["-std=c99", "-Wconversion", "-Wshadow", "-Wdouble-promotion"], "brake.c"),
    ("clang", ["-std=c99"], "fmi3.c"),
]


@pytest.mark.parametrize("name", FEATURES)
def test_compilers_take_the_c_without_a_warning_and_c_links_with_cpp(name: str, tmp_path: Path) -> None:
    write_model(Identified("test", BENCH, BENCH.brake, FEATURES[name]), tmp_path / "brake.fmu")
    folder = Path(fmpy.extract(str(tmp_path / "brake.fmu"), str(tmp_path / "unpacked"))) / "sources"
    for compiler, flags, source in COMPILERS:
        if compiler != "clang" or shutil.which(compiler):
            subprocess.run([compiler, *STRICT, *flags, "-c", source, "-o", "x.o"], cwd=folder, check=True)
    main = '#define BRAKE_DECLARATIONS_ONLY\n#include "brake.c"\n'
    main += "int main() { brake b; brake_init(&b); return brake_step(&b, 1.0, 1e-3); }\n"
    (folder / "main.cpp").write_text(main, encoding="utf-8")
    subprocess.run(["cc", "-std=c99", "-c", "brake.c"], cwd=folder, check=True)
    subprocess.run(["c++", *STRICT, "-o", "main", "main.cpp", "brake.o", "-lm"], cwd=folder, check=True)
    subprocess.run(["./main"], cwd=folder, check=True)


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [("J", 0.0, 1), ("current", math.inf, 1), ("current", math.nan, 1), ("dt", -1.0, 1), ("dt", math.nan, 1)]
    + [(name, value, 1) for name in (one.name for one in PLAIN.parameters()) for value in (math.nan, -1e300, 1e300)]
    + [("f_v", 1e12, 2), ("J", 1e-30, 2)],
)
def test_a_step_that_cannot_be_computed_says_so_and_changes_nothing(
    name: str, value: float, code: int, tmp_path: Path
) -> None:
    library, brake = compiled(PLAIN, tmp_path)
    step = {"current": 3.0, "dt": 0.01}
    assert library.brake_step(ctypes.byref(brake), *step.values()) == 0
    if name in step:
        step[name] = value
    else:
        setattr(brake, name, value)
    before = bytes(brake)
    assert library.brake_step(ctypes.byref(brake), *step.values()) == code
    assert bytes(brake) == before


def test_a_step_has_as_many_segments_as_a_second_of_any_brake_that_is_searched_needs(tmp_path: Path) -> None:
    library, brake = compiled(PLAIN, tmp_path)
    for name, end in (("J", 0), ("k_1", 1), ("f_v", 1), ("viscous_asymmetry", 0)):
        setattr(brake, name, searched(BENCH, Unknown(name))[end])
    rate = brake.f_v / brake.J * (1.0 - brake.viscous_asymmetry) + math.sqrt(brake.gamma * brake.k_1 / brake.J)
    longest = 100_000 * LONGEST / rate  # time of as many segments [s]; those of features take less, see the C
    assert longest > 5.0
    for seconds, code in ((0.99 * longest, 0), (1.01 * longest, 2)):
        library.brake_start(ctypes.byref(brake))
        assert library.brake_step(ctypes.byref(brake), -4.0, seconds) == code  # it opens, and never comes to rest


def test_an_exported_estimate_has_its_values_and_intervals(log: Path, study: Study, tmp_path: Path) -> None:
    said = api.export(log, tmp_path / "brake.fmu")
    assert said.endswith("parameters: estimate of run.mcap")
    model = fmpy.read_model_description(tmp_path / "brake.fmu")
    shown = {variable.name: variable for variable in model.modelVariables}
    for c in study:
        low, high = c.interval
        assert float(shown[c.label].start) == c.value
        assert shown[c.label].description.endswith(f"95 %: {low:.5g} to {high:.5g}")
    assert shown["k_m"].unit == "N.m/A"
    assert shown["gamma"].description.endswith("not estimated")


def test_a_calibration_file_has_each_value_with_its_unit_and_interval(log: Path, study: Study, tmp_path: Path) -> None:
    api.export(log, tmp_path / "brake.dcm")
    text = (tmp_path / "brake.dcm").read_bytes().decode("ascii")
    lines = [line for line in text.splitlines() if line]
    assert next(line for line in lines if not line.startswith("*")) == "KONSERVIERUNG_FORMAT 2.0"
    found: dict[str, dict[str, str]] = {}
    for block in re.findall(r"^FESTWERT (\w+)\n(.*?)^END$", text, re.MULTILINE | re.DOTALL):
        found[block[0]] = dict(re.findall(r'^ *(LANGNAME|EINHEIT_W|WERT|\*) "?(.*?)"?$', block[1], re.MULTILINE))
    for c in study:
        row = found[c.label]
        assert float(row["WERT"]) == c.value
        assert row["*"] == "95 %: {:.5g} to {:.5g}".format(*c.interval)
    assert not {*CHOSEN} & {*found}
    assert found["f_v"]["EINHEIT_W"] == "N.m.s/rad"
    assert found["T_c"]["LANGNAME"] == "Coulomb friction"


def test_drawn_brakes_scatter_as_the_estimate_says(study: Study) -> None:
    e = study.estimate
    at = [e.unknowns.index(Unknown(name)) for name in PARAMETER_NAMES]
    draws = [drawn(e, seed) for seed in range(2000)]
    errors = np.array([z - e.z for z, _ in draws])[:, at]
    assert errors.std(axis=0) == pytest.approx(e.deviations()[at], rel=0.08)
    inertia = np.log([factor for _, factor in draws])
    assert inertia.std() == pytest.approx(BENCH.systematic.inertia, rel=0.08)
    # The ratios to J are known far better than each: an error of J moves all of them with it.
    ratio = {one.name.partition("/")[0]: one for one in e.ratios()}["k_m"]
    relative = (ratio.interval[1] - ratio.interval[0]) / (2.0 * 1.96 * ratio.value)
    assert (errors[:, 0] - inertia).std() == pytest.approx(relative, rel=0.08)


def test_a_drawn_inertia_is_positive_where_it_is_hardly_known(log: Path, tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(re.sub(r"(?m)^inertia .*$", "inertia = 0.45", BENCH.text), encoding="utf-8")
    e = api.estimate(log, bench=bench, starts=1).estimate
    assert min(drawn(e, seed)[1] for seed in range(300)) > 0.0  # a normal distribution is negative at seed 220


def test_a_hostile_file_name_stays_in_its_comment(log: Path, tmp_path: Path) -> None:
    shutil.copy(log, path := tmp_path / 'x * "\x01\udcff.mcap')
    for ending in ("fmu", "c", "dcm"):
        api.export(path, tmp_path / f"x.{ending}", starts=1)
        assert b"estimate of x ? ???.mcap" in (tmp_path / f"x.{ending}").read_bytes() or ending == "fmu"
    assert validate_fmu(str(tmp_path / "x.fmu")) == []


def test_a_seed_draws_the_same_brake_again(tmp_path: Path) -> None:
    run = api.simulate(seed=1, quick=True)
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):  # a play that the run does not tell from none has its range
        said = api.export(run, tmp_path / f"{name}.c", nuisance="play", starts=1, draw=seed)
        assert said.endswith(f"drawn with seed {seed}")
    a, b, c = ((tmp_path / f"{name}.c").read_text(encoding="utf-8") for name in "abc")
    assert a == b != c


def test_features_that_are_estimated_are_exported(log: Path, tmp_path: Path) -> None:
    options = api.ExportOptions(nuisance="quadratic,contact", starts=1)
    api.export(log, tmp_path / "brake.fmu", options)
    shown = {v.name: v for v in fmpy.read_model_description(tmp_path / "brake.fmu").modelVariables}
    for name in ("quadratic", "contact"):
        assert float(shown[name].start) != 0.0
        assert "; 95 %: " in shown[name].description
    assert "without quadratic, contact, parameters" in api.export(log, tmp_path / "brake.xml", options)


def test_a_misfit_or_what_is_not_identified_is_refused_before_anything_is_written(
    tmp_path: Path, replay: Replay
) -> None:
    api.simulate(tmp_path / "rough.mcap", plant="rough", seed=1)
    said = replay.refused("export", tmp_path / "rough.mcap", "-o", tmp_path / "x.fmu", "--model", "exact", code=1)
    assert "the model 'exact' DOES NOT FIT, so that nothing is written" in said
    given = ("--theta", "nominal", "--model", "rough")
    assert replay.text("export", tmp_path / "rough.mcap", "-o", tmp_path / "x.fmu", *given)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rough.mcap", "x.fmu"]


def test_a_parameter_that_is_not_identified_has_no_value_to_export(path: Path, tmp_path: Path, replay: Replay) -> None:
    said = replay.refused("export", path, "-o", tmp_path / "x.c", code=1)
    assert "not identified: k_m, k_1, T_c, f_v, so that nothing is written" in said
    assert not (tmp_path / "x.c").exists()


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("", "there is no C compiler here (gcc and libc6-dev)"),
        ("#!/bin/sh\nexit 3\n", "failed: exit code 3"),
        ("#!/nowhere\n", "it was not compiled: No such file or directory"),
    ],
)
def test_without_a_compiler_that_works_an_fmu_has_sources_alone(
    script: str, reason: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replay: Replay
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CC", str(tmp_path / "cc"))
    if script:
        (tmp_path / "cc").write_text(script, encoding="utf-8")
        (tmp_path / "cc").chmod(0o755)
    said = replay.text("export", log, "-o", tmp_path / "x.fmu", "--theta", "nominal")
    assert said.startswith(f"{tmp_path / 'x.fmu'}: an FMU (sources alone: ")
    assert reason in said
    assert validate_fmu(str(tmp_path / "x.fmu")) == []
    with zipfile.ZipFile(tmp_path / "x.fmu") as archive:
        assert not [name for name in archive.namelist() if name.startswith("binaries")]
