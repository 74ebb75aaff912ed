"""The Python API gives what the commands print, and takes the calls that a controls engineer tries first."""

from __future__ import annotations

import gc
import json
import math
import multiprocessing
import pickle
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from IPython.core.formatters import HTMLFormatter
from matplotlib.figure import Figure
from numpy.testing import assert_array_equal

from emb_bench import api
from emb_bench.cli import replay
from emb_bench.config.bench import load_bench
from emb_runtime.cli import main as emb_run
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.errors import EmbError, UsageError
from tests.bench.linear_machine import MAP, Machine, record


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api") / "run.mcap"
    api.simulate(path, plant="exact", parameters={"f_v": 3e-5}, seed=2)
    return path


def printed(capsys: pytest.CaptureFixture[str], exit_code: int) -> Any:
    assert exit_code == 0
    return json.loads(capsys.readouterr().out)


def test_a_simulated_run_is_that_of_emb_run(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "run.mcap"
    found = printed(capsys, emb_run.main(["--iface", "sim:plant=exact,f_v=3e-5,seed=2", "--log", str(other), "--json"]))
    run = api.open_run(log)
    assert (run.exit_reason, found["result"]) == ("DONE", "done")
    assert run.truth is not None
    assert run.truth.f_v == 3e-5
    sent = "sent_current"  # NaN where none was sent
    assert_array_equal(run.cycles[sent], api.open_run(other).cycles[sent])


def test_nothing_that_is_handed_on_says_where_its_user_keeps_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "Müller's own"
    (folder / "runs").mkdir(parents=True)
    (folder / "my.toml").write_text(shipped_bench_text(), encoding="utf-8")
    typed = ["--iface", "sim:seed=2", f"--bench={folder}/my.toml", "--log", f"{folder}/runs/a.mcap", "--serial", "8/15"]
    monkeypatch.setattr("sys.argv", [f"{folder}/bin/emb-run", *typed])
    assert emb_run.main() == 0
    api.simulate(folder / "runs" / "b.mcap")
    monkeypatch.chdir(folder)
    api.report("runs/a.mcap", "page.html")
    assert replay.main(["export", "runs/a.mcap", "-o", "a.parquet"]) == 0
    assert replay.main(["campaign", "runs", "-o", "rows.parquet", "--jobs", "1"]) == 0
    capsys.readouterr()
    assert replay.main(["info", "runs/a.mcap", "--json"]) == 0
    said = [str(api.open_run(log).metadata) for log in sorted(Path("runs").glob("*.mcap"))]
    assert "emb-run --iface sim:seed=2 --bench=my.toml --log a.mcap --serial 8/15" in said[0]
    assert "emb-run --iface sim:plant=exact,seed=1 --log b.mcap" in said[1]
    tables = [pq.read_table(name) for name in ("a.parquet", "rows.parquet")]
    said += [f"{table.schema.metadata}{table.to_pylist()[0]}" for table in tables]
    said += [Path("page.html").read_text(encoding="utf-8"), capsys.readouterr().out]
    assert [text for text in said if "own/" in text or str(tmp_path) in text] == []


def test_a_topic_is_the_table_that_emb_replay_export_writes(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "estimate.parquet"
    assert replay.main(["export", str(log), "--topic", "/estimate", "-o", str(path)]) == 0
    found = api.topic(api.open_run(log), "/estimate")
    assert found.equals(pq.read_table(path), check_metadata=True)
    assert found.schema.field("f_v").metadata == {b"unit": "N·m·s/rad".encode()}
    with pytest.raises(UsageError, match="/nothing"):
        api.topic(api.open_run(log), "/nothing")


def test_a_run_is_drawn_on_axes_of_the_caller(log: Path) -> None:
    run, axes = api.open_run(log), Figure().subplots(5, sharex=True)
    api.draw(run, axes)
    assert_array_equal(axes[0].lines[0].get_ydata(), run.cycles["angle"])
    with pytest.raises(UsageError, match="5 axes"):
        api.draw(run, axes[:4])


def test_the_interval_of_an_information_is_that_of_fim(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = printed(capsys, replay.main(["fim", str(log), "--json"]))["estimate"]
    interval = api.interval(api.fisher_information(log))
    assert dict(zip(interval.names, interval.between_runs.tolist(), strict=True)) == found["between_runs"]
    assert (interval.of_comparison, interval.of_repeatability) == (found["T"], found["I"])


NAMES = ["k_m", "k_1", "T_c", "f_v"]
CURRENTS = np.repeat([3.0, 1.5, 2.5], 8)  # [A]; the brake never turns back under these

STEPS = 50  # Of the equation of motion in a period
WRONG: Any = 3.0
Case = tuple[Callable[[Any], Any], Callable[[Any], bool]]


class Session:
    """Results that calls refer to, as in a notebook."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / "run.mcap"
        self.run = api.simulate(self.path, parameters={"f_v": 3e-5}, seed=2)
        self.second = api.simulate(folder / "second.mcap", f_v=3e-5, seed=3)
        self.study = api.estimate(self.run, starts=1)
        self.information = api.fisher_information(self.run)
        self.other = api.fisher_information(self.second)
        self.planned = api.fisher_information(CURRENTS, parameters={"f_v": 3e-5}, plant="exact")
        found = record(Machine())
        self.frame = pd.DataFrame({"t": found.time, "x": found.position, "F": found.force})
        self.map = folder / "map.toml"
        self.map.write_text(MAP, encoding="utf-8")
        self.csv = folder / "machine.csv"
        self.frame.to_csv(self.csv, index=False)
        self.slower = folder / "slower.toml"
        text = self.run.bench.text.replace("sample_time = 1.0e-3", "sample_time = 1.1e-3")
        self.slower.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("natural")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder))  # of other processes, too
        patch.setattr(tempfile, "tempdir", None)
        yield Session(folder)


def close(got: Any, expected: Any, rtol: float = 1e-9) -> bool:
    return np.shape(got) == np.shape(expected) and np.allclose(got, expected, rtol=rtol, atol=0.0)


def messages(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in mcap.reader.make_reader(file).iter_messages(topics=["/cycle"]))


def simulated(seed: int) -> Any:
    return api.simulate(seed=seed, currents=np.full(20, 1.0))


def in_two_processes(count: int) -> list[Any]:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        return pool.map(simulated, range(count))


WORKING: dict[str, Case] = {
    # ---- a run ----
    "simulate(path, parameters=, seed=)": (lambda s: s.run, lambda run: run.exit_reason == "DONE"),
    "simulate(parameters={'angle_noise': ...})": (
        lambda s: api.simulate(parameters={"angle_noise": 0.0}, currents=np.zeros(20)),
        lambda run: not run.angle[:20].any(),
    ),
    "simulate()": (lambda s: api.simulate(), lambda run: run.path.exists() and len(run.angle) == 501),
    "simulate(f_v=3e-5)": (lambda s: api.simulate(f_v=3e-5), lambda run: run.truth.f_v == 3e-5),
    "simulate(currents=u)": (
        lambda s: api.simulate(currents=CURRENTS),
        lambda run: close(run.policy_current[:24], CURRENTS) and run.cycles["step"].max() == 24,
    ),
    "4 simulations over 2 processes": (
        lambda s: in_two_processes(4),
        lambda runs: [run.truth.k_m for run in runs] == 4 * [0.0217] and len(runs[0].plot().axes) == 5,
    ),
    "run.plot()": (lambda s: s.run.plot(), lambda figure: len(figure.axes) == 5),
    "run.to_dataframe()": (lambda s: s.run.to_dataframe(), lambda frame: frame["angle"].max() > 10.0),
    "run.to_dataframe('/estimate')": (
        lambda s: s.run.to_dataframe("/estimate"),
        lambda frame: "f_v_deviation" in frame.columns,
    ),
    "run['/cycle']": (lambda s: s.run["/cycle"], lambda table: table["angle"].max() > 10.0),
    "repr(run)": (lambda s: repr(s.run), lambda text: "DONE, complete" in text and "\n" not in text),
    "run.angle": (lambda s: s.run.angle, lambda angle: angle.shape == (501,) and angle.max() > 10.0),
    "polars.from_arrow(topic(run, '/cycle'))": (
        lambda s: pa.table(api.topic(s.run, "/cycle")),  # what polars takes
        lambda table: table.num_rows == 501,
    ),
    "topics(run)": (lambda s: api.topics(s.path), lambda found: found["/cycle"] == 501),
    "a plain reader of MCAP": (lambda s: messages(s.path), lambda count: count == 501),
    # ---- information ----
    "fisher_information(run, theta=)": (
        lambda s: api.fisher_information(s.run, theta={"f_v": np.float64(3e-5)}),
        lambda found: found.theta.f_v == 3e-5,
    ),
    "information['f_v']": (lambda s: s.information, lambda found: 0.0 < found["f_v"] < 1e-3),
    "information.matrix": (
        lambda s: s.information,
        lambda found: close(found.matrix, found.fisher("physical").matrix) and list(found.params) == NAMES,
    ),
    "information.covariance": (
        lambda s: s.information,
        lambda found: (
            close(found.covariance @ found.matrix, np.eye(4), 1e-6)
            or np.allclose(found.covariance @ found.matrix, np.eye(4), atol=1e-9)
        ),
    ),
    "information.cov": (
        lambda s: s.information,
        lambda found: close(np.sqrt(np.diag(found.cov)), [found[name] for name in NAMES]),
    ),
    "information.correlation": (
        lambda s: s.information,
        lambda found: close(found.correlation[0, 1], found.cov[0, 1] / (found["k_m"] * found["k_1"])),
    ),
    "information.to_dataframe()": (
        lambda s: (s.information.to_dataframe(), s.information.matrix),
        lambda found: found[0].loc["k_m", "f_v"] == found[1][0, 3],
    ),
    "fisher_information([run, second])": (
        lambda s: (
            api.fisher_information([s.run, s.second], theta="true"),
            [api.fisher_information(run, theta="true").matrix for run in (s.run, s.second)],
        ),
        lambda found: close(found[0].matrix, found[1][0] + found[1][1]),
    ),
    "run + second + third": (lambda s: s.run + s.second + s.run, lambda runs: len(runs) == 3),
    "information + other": (
        lambda s: (s.information + s.other, api.fisher_information([s.path, s.second])),
        lambda found: close(found[0].matrix, found[1].matrix) and found[0]["f_v"] > 0.0,
    ),
    "sum([information, other])": (
        lambda s: (sum([s.information, s.other]), s.information + s.other),
        lambda found: close(found[0].covariance, found[1].covariance),
    ),
    "fisher_information(u)": (
        lambda s: api.fisher_information(CURRENTS),
        lambda found: found.matrix.shape == (4, 4) and found.theta == load_bench().brake,
    ),
    "fisher_information(u, parameters=, plant=)": (
        lambda s: s.planned,
        lambda found: found.theta.f_v == 3e-5 and found.plant.name == "exact",
    ),
    "fisher_information(u).sensitivities": (
        lambda s: s.planned.sensitivities,
        lambda found: found.shape == (24, 4, 2),
    ),
    "sensitivities(u)": (
        lambda s: api.sensitivities(CURRENTS.tolist(), params="k_m,f_v"),
        lambda found: found.sensitivities.shape == (24, 2, 2) and found.samples.shape == (24, 2),
    ),
    # ---- an estimate ----
    "estimate(run)": (lambda s: s.study, lambda study: study.model_fits and list(study.params) == NAMES),
    "estimate(run, options)": (
        lambda s: (
            api.estimate(s.run, api.EstimateOptions("f_v", starts=1)),
            api.estimate(s.run, params="f_v", starts=1),
        ),
        lambda both: both[0].to_dict() == both[1].to_dict(),
    ),
    "estimate([run])": (lambda s: api.estimate([s.run], params=["f_v"], starts=1), lambda study: "f_v" in study),
    "study['f_v'].value": (lambda s: s.study["f_v"].value, lambda value: math.isclose(value, 3e-5, rel_tol=0.03)),
    "study['f_v'].interval": (lambda s: s.study["f_v"].interval, lambda ends: ends[0] < 3e-5 < ends[1]),
    "study['f_v'].unit": (lambda s: s.study["f_v"].unit, lambda unit: unit == "N·m·s/rad"),
    "study.parameters": (lambda s: s.study.parameters["k_m"].unit, lambda unit: unit == "N·m/A"),
    "study.covariance": (
        lambda s: s.study,
        lambda study: close(
            1.96 * np.sqrt(np.diag(study.covariance)), [0.5 * (c.interval[1] - c.interval[0]) for c in study], 0.02
        ),
    ),
    "study.correlation": (
        lambda s: s.study.correlation,
        lambda found: close(found, found.T) and close(np.diag(found), np.ones(4)) and np.abs(found).max() < 1.0 + 1e-9,
    ),
    "study.residuals": (
        lambda s: s.study.residuals,
        lambda found: found[0].shape == (500, 2) and 0.8 < np.nanstd(found[0]) < 1.2,
    ),
    "study.summary()": (
        lambda s: s.study.summary(),
        lambda text: "'exact' fits" in text and "f_v = " in text and "N·m·s/rad" in text,
    ),
    "study, in a notebook": (lambda s: HTMLFormatter()(s.study), lambda text: text.count("<tr>") == 5),
    "'f_v' in study": (lambda s: s.study, lambda study: "f_v" in study and "J" not in study and len(study) == 4),
    "for c in study": (lambda s: [c.label for c in s.study], lambda labels: labels == NAMES),
    "pickle.loads(pickle.dumps(study))": (
        lambda s: (pickle.loads(pickle.dumps(s.study)), s.study),
        lambda both: both[0].to_dict() == both[1].to_dict(),
    ),
    "study.plot()": (lambda s: s.study.plot(), lambda figure: len(figure.axes[0].get_yticklabels()) == 4),
    "study.to_dataframe()": (lambda s: s.study.to_dataframe(), lambda frame: frame.loc["f_v", "unit"] == "N·m·s/rad"),
    "estimate(DataFrame, map=)": (
        lambda s: [api.estimate(each, map=s.map, starts=1) for each in (s.frame, s.csv)],
        lambda both: close([c.value for c in both[0]], [c.value for c in both[1]]) and "mass" in both[0],
    ),
    "estimate({name: array}, map=)": (
        lambda s: api.estimate({name: s.frame[name].to_numpy() for name in s.frame}, map=s.map, starts=1)["mass"],
        lambda mass: math.isclose(mass.value, 95.0, rel_tol=1e-3) and mass.unit == "kg",
    ),
    "fisher_information(DataFrame, map=)": (
        lambda s: api.fisher_information(s.frame, map=s.map),
        lambda found: found.matrix.shape[0] == len(found.params),
    ),
    "report(run, 'page.html')": (
        lambda s: repr(api.report(s.run, s.folder / "page.html", params="f_v", starts=1)),
        lambda text: text.startswith("<Report on run.mcap: SIMULATED") and len(text) < 300,
    ),
    "report(DataFrame, 'page.html', map=)": (
        lambda s: repr(api.report(s.frame, s.folder / "machine.html", map=s.map, starts=1)),
        lambda text: "table.parquet" in text,
    ),
    "dir(api)": (lambda s: dir(api), lambda names: set(names) == set(api.__all__) and "simulate" in names),
}

REFUSED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "study['fv']": (lambda s: s.study["fv"], "did you mean f_v?"),
    "study.params['fv']": (lambda s: s.study.params["fv"], "expected one of k_m, k_1, T_c, f_v"),
    "information['fv']": (lambda s: s.information["fv"], "did you mean f_v?"),
    "run['/cycel']": (lambda s: s.run["/cycel"], "did you mean /cycle?"),
    "run.angel": (lambda s: s.run.angel, "did you mean angle?"),
    "load(path)": (lambda s: api.load(s.path), "did you mean open_run?"),
    "simulate(noise=)": (lambda s: api.simulate(noise=0.0), "did you mean angle_noise?"),
    "simulate(fv=)": (lambda s: api.simulate(fv=3e-5), "did you mean f_v?"),
    "simulate(currents=u, policy=file)": (lambda s: api.simulate(currents=CURRENTS, policy="a.onnx"), "without policy"),
    "simulate(currents=[])": (lambda s: api.simulate(currents=[]), "expected 1 to 500 currents"),
    "simulate(currents='u')": (lambda s: api.simulate(currents="u"), "as numbers"),
    "estimate(DataFrame)": (lambda s: api.estimate(s.frame), "map='map.toml'"),
    "estimate([])": (lambda s: api.estimate([]), "at least one run"),
    "estimate(3.0)": (lambda s: api.estimate(WRONG), "an opened log, its path, or a table with a map"),
    "estimate({name: arrays of two lengths}, map=)": (
        lambda s: api.estimate({"t": [1.0, 2.0], "x": [1.0]}, map=s.map),
        "all as long",
    ),
    "estimate([frame, frame], map=)": (lambda s: api.estimate([s.frame, s.frame], map=s.map), "a table comes twice"),
    "estimate(DataFrame with other names, map=)": (
        lambda s: api.estimate(s.frame.rename(columns={"x": "y"}), map=s.map),
        "no column is called 'x'; it has: t, y, F",
    ),
    "estimate(t=, y=, u=)": (
        lambda s: api.estimate(t=CURRENTS, y=CURRENTS, u=CURRENTS),
        "arrays are a table: estimate({'t': t, 'y': y, 'u': u}, map='map.toml')",
    ),
    "estimate(run, parameters=)": (
        lambda s: api.estimate(s.run, parameters="f_v"),
        "estimate has no option 'parameters'; did you mean params?",
    ),
    "estimate(run, options, starts=)": (
        lambda s: api.estimate(s.run, api.EstimateOptions("f_v"), starts=1),
        "expected a record of options or keywords, got both",
    ),
    "estimate(run, run)": (
        lambda s: api.estimate(s.run, s.second),
        "estimate: expected EstimateOptions, or its fields as keywords",
    ),
    "estimate(run, systematic=None)": (
        lambda s: api.estimate(s.run, systematic=None),
        "--systematic: expected one of bench, none, got None",
    ),
    "estimate(run, starts='3')": (
        lambda s: api.estimate(s.run, starts="3"),
        "--starts: expected a number from 1, got '3'",
    ),
    "campaign(path, 'rows.csv', bench_of_all=)": (
        lambda s: api.campaign(s.path, s.folder / "rows.csv", bench_of_all=None),
        "campaign has no option 'bench_of_all'",
    ),
    "campaign(path, 'rows.csv', jobs=0)": (
        lambda s: api.campaign(s.path, s.folder / "rows.csv", jobs=0),
        "--jobs: expected a number from 1, got 0",
    ),
    "simulate(seed=1.5)": (
        lambda s: api.simulate(seed=1.5),  # type: ignore[arg-type]
        "seed: expected a whole number from 0 of up to 18 digits, got '1.5'",
    ),
    "simulate(u)": (lambda s: api.simulate(CURRENTS), "simulate(currents=...)"),  # type: ignore[arg-type]
    "fisher_information(run, bench=a slower one)": (
        lambda s: api.fisher_information(s.run, bench=s.slower),
        "sample time",
    ),
    "fisher_information([])": (lambda s: api.fisher_information([]), "at least one run"),
    "fisher_information(empty array)": (lambda s: api.fisher_information(np.zeros(0)), "one current"),
    "fisher_information(a matrix)": (lambda s: api.fisher_information(np.eye(2)), "one row of currents"),
    "fisher_information(u with NaN)": (lambda s: api.fisher_information([0.0, np.nan]), "currents, got nan at step 1"),
    "fisher_information(u, theta='true')": (
        lambda s: api.fisher_information(CURRENTS, theta="true"),
        "--theta: expected nominal, name=value or a file",
    ),
    "fisher_information(u, plant=, model=)": (
        lambda s: api.fisher_information(CURRENTS, plant="exact", model="exact"),
        "expected one of the two",
    ),
    "fisher_information([run, run])": (lambda s: api.fisher_information([s.run, s.path]), "comes twice"),
    "fisher_information(two runs, params='offset')": (
        lambda s: api.fisher_information([s.run, s.second], params="offset"),
        "nuisance of several runs",
    ),
    "informations of other brakes": (lambda s: s.planned + api.fisher_information(CURRENTS), "the same theta of all"),
    "(information + other).sensitivities": (lambda s: (s.information + s.other).sensitivities, "of one of them"),
}
LOOKED_UP = {
    **dict.fromkeys(("study['fv']", "information['fv']", "run['/cycel']"), KeyError),
    **dict.fromkeys(("run.angel", "load(path)"), AttributeError),
}
"""What is looked up by a name fails as Python's own look-ups do."""


@pytest.mark.parametrize("call", WORKING)
def test_a_natural_call_works(session: Session, call: str) -> None:
    make, holds = WORKING[call]
    assert holds(make(session))


@pytest.mark.parametrize("call", REFUSED)
def test_a_call_that_cannot_work_says_what_to_type(session: Session, call: str) -> None:
    make, said = REFUSED[call]
    with pytest.raises(LOOKED_UP.get(call, UsageError), match=re.escape(said)) as caught:
        make(session)
    assert "\n" not in str(caught.value)
    assert not str(caught.value).startswith(("'", '"'))
    assert isinstance(caught.value, EmbError | AttributeError)


def motion(currents: Any, k_m: float, k_1: float, T_c: float, f_v: float) -> Any:
    """J ω' = k_m i − γ k_1 φ − T_c − f_v ω of a brake that turns forward, by Heun's method; shape (n, 2)."""
    brake, h = load_bench().brake, load_bench().timing.sample_time / STEPS

    def slope(angle: float, velocity: float, i: float) -> tuple[float, float]:
        return velocity, (k_m * i - brake.gamma * k_1 * angle - T_c - f_v * velocity) / brake.J

    x, rows = (0.0, 0.0), []
    for i in currents:
        for _ in range(STEPS):
            a = slope(*x, i)
            b = slope(x[0] + h * a[0], x[1] + h * a[1], i)
            x = x[0] + 0.5 * h * (a[0] + b[0]), x[1] + 0.5 * h * (a[1] + b[1])
        assert x[1] > 0.0, "the equation holds forward only"
        rows.append(x)
    return np.array(rows)


def test_information_and_sensitivities_of_own_currents_are_those_of_the_equation_of_motion(session: Session) -> None:
    brake, noise = load_bench().brake, load_bench().noise
    theta = {"k_m": brake.k_m, "k_1": brake.k_1, "T_c": brake.T_c, "f_v": 3e-5}
    columns = []
    for name, value in theta.items():
        more, less = (motion(CURRENTS, **theta | {name: value * (1.0 + step)}) for step in (1e-4, -1e-4))
        columns.append((more - less) / 2e-4)
    expected = np.stack(columns, axis=1)
    found = session.planned.sensitivities
    assert np.abs(found - expected).max(axis=(0, 1)) == pytest.approx(0.0, abs=1e-3 * np.abs(expected).max())
    rows = expected[:, :, 0].T / noise.angle  # an observer's velocity adds nothing to the angles
    np.testing.assert_allclose(session.planned.matrix, rows @ rows.T, rtol=2e-3)
    np.testing.assert_allclose(session.planned.trajectory.samples, motion(CURRENTS, **theta), rtol=1e-3)


def test_the_total_covariance_is_that_of_an_inertia_and_a_scale_that_are_not_known(session: Session) -> None:
    """J ω' = k_m i − γ k_1 φ − T_c − f_v ω: all four scale with J, k_m and T_c with the angle, too."""
    values = np.array([c.value for c in session.study])
    relative = session.study.covariance / np.outer(values, values)
    scaled = np.array([1.0, 0.0, 1.0, 0.0])
    expected = 0.01**2 * np.ones((4, 4)) + 0.003**2 * np.outer(scaled, scaled)
    np.testing.assert_allclose(relative, expected, rtol=0.1)
    assert session.study.correlation.min() > 0.9


def test_runs_have_unknowns_of_their_own_and_a_prior_counts_once(session: Session) -> None:
    runs, more = [session.run, session.second], dict[str, Any](theta="true", prior="pm50")
    together = api.fisher_information(runs, nuisance="offset,J", **more)
    assert together.params == (*NAMES, "J")
    parts = [api.fisher_information(run, nuisance="J,offset", **more).covariance[:5, :5] for run in runs]
    known = np.diag([12.0, 12.0, 12.0, 12.0, 0.0])  # of a range of ±50 %: 12/(1.5 − 0.5)²
    expected = sum(np.linalg.inv(part) for part in parts) - known
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(together.matrix / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-4)


def test_a_temporary_log_lasts_as_long_as_its_run(session: Session) -> None:
    run = api.simulate(currents=CURRENTS)
    path, copy = run.path, pickle.dumps(run)
    del run
    gc.collect()
    again = pickle.loads(copy)
    assert again.plot() is not None, "a copy keeps it"
    path.unlink()
    run = api.simulate(currents=CURRENTS)
    folder = run.path.parent
    study = api.estimate(run, params="k_m", starts=1)
    del run
    gc.collect()
    assert study.logs[0].path.exists(), "a study has its run"
    del study
    gc.collect()
    assert not folder.exists()
    before = set(session.folder.iterdir())
    with pytest.raises(UsageError, match="f_v"):
        api.simulate(currents=CURRENTS, f_v=1.0)
    assert set(session.folder.iterdir()) == before, "what was refused leaves nothing"
