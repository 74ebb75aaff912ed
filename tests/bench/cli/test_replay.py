"""Commands of emb-replay: information, estimates and facts of a log, beside what is computed otherwise."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emb_bench import api
from emb_bench.cli.replay import COMMANDS, main
from emb_bench.config.bench import Bench
from emb_bench.logs.estimates import last_estimate
from emb_bench.logs.log import read_log
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Sensors
from emb_runtime.numbers import plain
from emb_runtime.records import CycleRecord
from tests.bench.conftest import Log, Replay
from tests.bench.experiment.test_experiment import Lose
from tests.bench.flows import fisher
from tests.bench.simulated_logs import square, write_log
from tests.benches import SENSOR_TEXT
from tests.conftest import SimRun, Simulate


@pytest.fixture
def run(simulate: Simulate) -> SimRun:
    return simulate(square, options="f_v=4e-5")


@pytest.fixture
def path(tmp_path: Path, run: SimRun) -> Path:
    return write_log(tmp_path / "run.mcap", run)


def test_both_informations_are_those_of_the_currents_that_were_sent(
    path: Path, run: SimRun, bench: Bench, layout: Layout, replay: Replay
) -> None:
    got = replay.document("fim", path, "--theta", "true")
    theta = read_log(path).truth
    assert theta is not None
    commands = [layout.decode_command(frame) for frame in run.sent]
    currents = [command.current for command in commands if command.enable]
    for kind in ("physical", "weighted"):
        expected = fisher(bench, theta, currents, kind=kind, plant=bench.plant("exact"))
        np.testing.assert_allclose(got[kind]["matrix"], expected.matrix, rtol=1e-12)
        assert got[kind]["log_det"] == pytest.approx(np.linalg.slogdet(expected.matrix)[1], rel=1e-6)
        assert got[kind]["lambda_min"] == pytest.approx(np.linalg.eigvalsh(expected.matrix)[0], rel=1e-4)
        assert got[kind]["condition"] == pytest.approx(np.linalg.cond(expected.matrix), rel=1e-4)
        assert got[kind]["trace_inverse"] == pytest.approx(np.trace(np.linalg.inv(expected.matrix)), rel=1e-4)
    covariance = np.linalg.inv(np.array(got["physical"]["matrix"]))
    assert list(got["physical"]["cramer_rao"].values()) == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
    assert "cramer_rao" not in got["weighted"]


def test_information_over_time_grows_to_that_of_the_whole(path: Path, replay: Replay) -> None:
    got = replay.document("fim", path)
    for kind in ("physical", "weighted"):
        series = got[kind]["over_time"]
        assert series["time"] == pytest.approx([0.001 * k for k in range(1, 501)])
        assert series["log_det"][0] is None  # one sample cannot tell four parameters
        assert series["log_det"][-1] == pytest.approx(got[kind]["log_det"], rel=1e-12)
        assert series["lambda_min"][-1] == pytest.approx(got[kind]["lambda_min"], rel=1e-12)


def test_an_information_has_the_model_the_unknowns_and_the_prior_that_were_asked_for(log: Log, replay: Replay) -> None:
    path = log("exact.mcap", "plant=exact")
    alone = replay.document("fim", path, "--theta", "nominal")
    assert (alone["model"], alone["warnings"]) == ("exact", [])
    other = replay.document("fim", path, "--theta", "nominal", "--model", "euler")
    assert (other["model"], other["fit_sigmas"]["fits"], len(other["warnings"])) == ("euler", False, 1)
    along = replay.document("fim", path, "--theta", "nominal", "--nuisance", "delay,offset,x1_0")
    assert along["nuisances"] == ["delay", "offset", "x1_0"]
    whole = np.array(along["physical"]["matrix"])
    schur = whole[:4, :4] - whole[:4, 4:] @ np.linalg.solve(whole[4:, 4:], whole[4:, :4])
    assert along["physical"]["log_det"] == pytest.approx(np.linalg.slogdet(schur)[1], rel=1e-6)
    inertia = replay.document("fim", path, "--theta", "nominal", "--nuisance", "J")["physical"]
    assert (inertia["identified"], inertia["log_det"]) == (False, None)
    known = replay.document("fim", path, "--theta", "nominal", "--nuisance", "J", "--prior", "pm50")
    assert (known["prior"], known["physical"]["identified"]) == ("pm50", True)


def test_an_experiment_that_tells_nothing_is_reported_as_that(
    tmp_path: Path, simulate: Simulate, replay: Replay
) -> None:
    still = write_log(tmp_path / "zero.mcap", simulate(lambda *_: 0.0))
    for prior in ((), ("--prior", "pm50")):
        said = replay.text("fim", still, *prior)
        assert "no information" in said
        assert "inf" not in said.replace("information", "")


def test_a_log_that_does_not_say_what_moved_is_evaluated_with_the_brake_that_sticks(
    tmp_path: Path, run: SimRun, replay: Replay
) -> None:
    real = write_log(tmp_path / "real.mcap", run, metadata={"emb.run": {}})
    assert replay.document("fim", real)["model"] == "exact"
    truth = {name: str(value) for name, value in run.transport.truth.items() if name != "plant"}
    old = write_log(tmp_path / "old.mcap", run, metadata={"emb.run": {}, "emb.truth": truth})
    assert replay.document("fim", old)["model"] == "euler"


OBSERVED = Sensors("observer", 760.0)
"""With another declaration, a run of plant ``observer`` ends before it tells anything."""


@pytest.mark.parametrize("plant", ["observer", "exact", "stribeck"])
def test_of_a_bench_that_declares_an_observer_every_command_counts_the_angle_alone(
    bench: Bench, log: Log, replay: Replay, tmp_path: Path, plant: str
) -> None:
    driven = replace(bench, sensors=OBSERVED) if plant == "observer" else bench
    path, declared = log("run.mcap", f"plant={plant}", on_bench=driven), tmp_path / "declared.toml"
    declared.write_text(f'{SENSOR_TEXT}\n[sensors]\nvelocity = "observer"\nobserver_bandwidth = 760\n')
    told = replay.document("fim", path, "--theta", "true", "--bench", declared)
    measured = replay.document("fim", path, "--theta", "true", "--model", "exact" if plant == "observer" else plant)
    assert told["fit_sigmas"] == {"angle": measured["fit_sigmas"]["angle"], "velocity": None, "fits": True}
    assert [note for note in told["notes"] if "observer" in note]
    assert told["physical"]["log_det"] < measured["physical"]["log_det"]
    assert told["weighted"] == measured["weighted"]
    assert ", velocity" not in replay.text("fim", path, "--theta", "true", "--bench", declared)
    found = replay.document("estimate", path, "--bench", declared)
    assert (found["model"], found["model_fits"]) == (plant, True)
    assert [*found["misfit"]["whiteness"]] == ["angle"]
    assert main(["campaign", str(path), "--output", str(tmp_path / "c.csv"), "--bench", str(declared)]) == 0
    with (tmp_path / "c.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert (row["nominal_velocity_sigmas"], row["model"]) == ("", plant)


def test_what_a_measurement_delay_hides_counts_for_nothing(bench: Bench, log: Log, replay: Replay) -> None:
    path = log("late.mcap", "plant=late", on_bench=replace(bench, shield=bench.shield._replace(frame_age=(2, 2))))
    late, prompt = (replay.document("fim", path, "--theta", "nominal", "--model", name) for name in ("late", "exact"))
    assert late["warnings"] == []
    assert late["samples"]["command_delay"] == 1
    assert late["fit_sigmas"]["fits"]
    assert not prompt["fit_sigmas"]["fits"]
    assert len(prompt["warnings"]) == 2  # of the delay, and of the fit
    series = {d["model"]: d["physical"]["over_time"]["log_det"] for d in (late, prompt)}
    assert series["late"][1:] == pytest.approx(series["exact"][:-1])


def test_given_parameters_replace_nominal_ones(path: Path, replay: Replay) -> None:
    given, true = (replay.document("fim", path, "--theta", theta)["physical"] for theta in ("f_v=4e-5", "true"))
    assert given == true


def test_parameters_from_an_estimate_replace_nominal_ones(tmp_path: Path, path: Path, replay: Replay) -> None:
    said = replay.document("estimate", path, "--params", "f_v", "--starts", "1", "--systematic", "none")
    file = tmp_path / "estimate.json"
    for document in (said, {"estimate": said}):
        file.write_text(json.dumps(document))
        found = replay.document("fim", path, "--theta", file)
        f_v = said["parameters"]["f_v"]["value"]
        assert found["theta"]["name"] == "estimate.json"
        assert found["physical"] == replay.document("fim", path, "--theta", f"f_v={f_v!r}")["physical"]


def test_the_command_calculates_on_one_thread_unless_the_caller_says_another_number() -> None:
    said = (
        "import os, sys; from emb_bench.cli import entry; sys.argv[1:] = ['--version']\n"
        "try: entry.emb_replay()\n"
        "finally: print(os.environ['OMP_NUM_THREADS'], os.environ['OPENBLAS_NUM_THREADS'], file=sys.stderr)"
    )
    there = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    asked = there | {"OPENBLAS_NUM_THREADS": "2"}
    for environment, expected in ((there, "1 1\n"), (asked, "1 2\n")):
        got = subprocess.run([sys.executable, "-c", said], env=environment, capture_output=True, text=True, check=False)
        assert (got.returncode, got.stderr) == (0, expected)


def test_the_fit_at_an_estimate_is_judged_with_its_systematic_errors(log: Log, replay: Replay, tmp_path: Path) -> None:
    path, file = log("exact.mcap", "plant=exact"), tmp_path / "estimate.json"
    said = replay.document("estimate", path, "--starts", "1")
    file.write_text(json.dumps(said))
    found = replay.document("fim", path, "--theta", file)
    assert found["fit_sigmas"]["fits"]
    assert found["warnings"] == []
    values = {name: entry["value"] for name, entry in said["systematic"].items()}
    assert found["systematic"] == values
    assert plain(values["current_offset"]) in found["notes"][0]
    several = replay.document("estimate", log("other.mcap", "plant=exact,seed=5"), path, "--starts", "1")
    assert several["model_fits"]
    for document, offset in (
        (several, several["systematic"]["offset[1]"]["value"]),
        (said | {"records": [{"name": "another.mcap"}]}, None),  # whose encoder is homed another time
    ):
        file.write_text(json.dumps(document))
        found = replay.document("fim", path, "--theta", file)
        assert found["systematic"]["offset"] == offset
        assert found["systematic"]["delay"] == document["systematic"]["delay"]["value"]
    for wrong in ("x", None, True, 2.0, float("nan")):
        file.write_text(json.dumps(said | {"systematic": {"delay": {"value": wrong}}}))
        assert "estimate.json: " in replay.refused("fim", path, "--theta", file)


def test_another_bench_file_replaces_the_noise_of_the_one_in_the_log(
    tmp_path: Path, path: Path, replay: Replay
) -> None:
    file = tmp_path / "bench.toml"
    text = SENSOR_TEXT.replace("angle    = 1.0e-3", "angle    = 1.0e-2")
    file.write_text(text.replace("velocity = 1.0 ", "velocity = 10.0 "))
    once, ten = replay.document("fim", path), replay.document("fim", path, "--bench", file)
    np.testing.assert_allclose(np.array(ten["physical"]["matrix"]) * 100.0, once["physical"]["matrix"], rtol=1e-9)


def test_the_sample_that_stopped_a_run_counts_among_the_largest(
    tmp_path: Path, simulate: Simulate, replay: Replay
) -> None:
    run = simulate(lambda *_: 5.0, options="plant=exact,k_m=4e-2")
    path, counters = write_log(tmp_path / "stopped.mcap", run), run.outcome.counters
    assert counters.top_speed > max(abs(cycle.velocity) for cycle in run.journal.cycles)
    largest = replay.document("info", path)["largest"]
    assert largest["speed"] == pytest.approx(counters.top_speed)
    assert largest["angle_max"] == pytest.approx(counters.angle_max)
    said = replay.text("info", path, "-q")
    assert "MOTION_OUTSIDE_SET" in said


def test_info_tells_the_delay_from_sensor_to_command(tmp_path: Path, run: SimRun, replay: Replay) -> None:
    records = run.journal.records
    records[:] = [
        r._replace(send_time_ns=r.receive_time_ns + 1000 * r.step) if isinstance(r, CycleRecord) else r for r in records
    ]
    got = replay.document("info", write_log(tmp_path / "run.mcap", run))
    delays = [1e-6 * k for k in range(500)]
    expected = {f"p{q:g}": float(np.percentile(delays, q)) for q in (50, 90, 99, 99.9, 100)}
    assert got["sensor_to_command"] == pytest.approx(expected)


@pytest.mark.parametrize("name", ["rubber", "all", "", "\x1b[31m"])
def test_a_log_of_a_plant_that_the_bench_does_not_have_is_refused(
    tmp_path: Path, run: SimRun, bench: Bench, name: str, replay: Replay
) -> None:
    truth = {key: str(value) for key, value in bench.brake._asdict().items()}
    path = write_log(tmp_path / "run.mcap", run, metadata={"emb.run": {}, "emb.truth": {**truth, "plant": name}})
    err = replay.refused("fim", path)
    assert f"no plant is called {name!r}; this bench has: euler, exact" in err
    assert err.removesuffix("\n").isprintable()


def test_an_unknown_that_the_model_does_not_have_is_said_to_be_missing(path: Path, replay: Replay) -> None:
    asked = ("fim", path, "--theta", "true", "--nuisance", "cubic")
    (warning,) = (w for w in replay.document(*asked, "--model", "euler")["warnings"] if "cubic" in w)
    assert "'euler'" in warning
    assert not any("cubic" in w for w in replay.document(*asked, "--model", "cubic")["warnings"] if "is zero" in w)


def test_the_information_is_that_at_the_controllers_estimate_where_the_log_has_one(
    tmp_path: Path, replay: Replay
) -> None:
    path = tmp_path / "shipped.mcap"
    run = api.simulate(path, parameters={"f_v": 3e-5}, seed=2)
    last = {name: entry["value"] for name, entry in last_estimate(run).items()}
    found = replay.document("fim", path)
    assert found["theta"] == {"name": "log", **run.bench.brake._replace(**last)._asdict()}
    assert found["fit_sigmas"]["fits"]
    assert not replay.document("fim", path, "--theta", "nominal")["fit_sigmas"]["fits"]


def test_the_help_of_a_command_has_its_own_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    for name, command in COMMANDS.items():
        with pytest.raises(SystemExit) as left:
            main([name, "--help"])
        assert left.value.code == 0
        end = capsys.readouterr().out.partition("exit codes:\n")[2].partition("\n\n")[0]
        assert [*map(int, re.findall(r"^  (\d+) ", end, re.MULTILINE))] == sorted(command.codes)


def test_a_reader_who_leaves_early_is_no_error(path: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "wb") as pipe:
        done = subprocess.run(
            [sys.executable, "-m", "emb_bench.cli.replay", "info", str(path)],
            stdout=pipe,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert (done.returncode, done.stderr) == (0, b"")


ESTIMATE = ("estimate", "--starts", "2")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    run = simulate(square, options="plant=exact,f_v=3e-5,T_c=1.2e-2,seed=5")
    return write_log(tmp_path_factory.mktemp("estimate") / "run.mcap", run)


def test_a_gap_that_hides_what_acted_is_said(tmp_path: Path, simulate: Simulate, replay: Replay) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 121, 122, 300))
    path = write_log(tmp_path / "gap.mcap", run)
    got = replay.document(*ESTIMATE, path)
    assert got["model_fits"]
    assert (len(got["caveats"]), len(got["warnings"])) == (2, 1)  # of single periods, and of gaps
    assert f"WARNING: {got['warnings'][0]}"[:60] in replay.text(*ESTIMATE, path)
    assumed = replay.document(*ESTIMATE, path, "--method", "windows", "--window", "0.04")["warnings"]
    assert "4 periods" in assumed[1]
    assert len(replay.document(*ESTIMATE, path, "--method", "rls")["warnings"]) == 1


def test_a_prior_is_named_and_counts(drawn: Path, replay: Replay) -> None:
    free, held = replay.document(*ESTIMATE, drawn), replay.document(*ESTIMATE, drawn, "--prior", "pm50")
    assert (free["prior"], held["prior"]) == (None, "pm50")
    for name, found in free["parameters"].items():
        shift = abs(held["parameters"][name]["value"] - found["value"]) / found["value"]
        assert 0.0 < shift < 0.1 * found["deviation"]


def test_strict_fails_where_the_model_does_not_fit_or_something_is_not_identified(drawn: Path, replay: Replay) -> None:
    replay.text(*ESTIMATE, drawn, "--strict")
    for arguments in (("--model", "lag"), ("--nuisance", "J")):
        replay.text(*ESTIMATE, drawn, "--strict", "--starts", "1", *arguments, code=1)


def test_without_scipy_and_numba_the_other_commands_work_and_this_one_says_what_to_install(drawn: Path) -> None:
    """As on the bench computer; and a report without matplotlib."""
    report = ["report", str(drawn), "-o", str(drawn.with_suffix(".html"))]
    for missing, command in ((("scipy", "numba"), ["estimate", str(drawn)]), (("matplotlib",), report)):
        code = (
            "import sys\n"
            f"sys.modules |= dict.fromkeys({missing})\n"
            "from emb_bench.cli.replay import main\n"
            f"assert main(['info', {str(drawn)!r}]) == 0\n"
            f"sys.exit(main({command}))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "'.[bench]'" in done.stderr
