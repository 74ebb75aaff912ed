"""A commissioning from the data sheet to the bench file, on a simulated brake: what is found, and that it goes on."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from emb_bench.cli import commission
from emb_bench.commission import examination
from emb_bench.commission.bench_file import MEASURED, working_text
from emb_bench.commission.commissioning import Commissioned, Commissioning, Run, StepFailedError, simulated
from emb_bench.config.bench import Bench, load_bench, parse_bench
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main
from emb_runtime.config.bench import Noise, Sensors, shipped_bench_text
from emb_runtime.errors import EmbError
from tests.bench.commission.test_steps import identification, sheet_text, with_interval
from tests.drives import EXAMPLES
from tests.runtime.operating import Sim

TRUTH = {"k_m": 0.03, "k_1": 17.0, "T_c": 0.0075, "f_v": 3.4e-5}
NOISE = Noise(7e-4, 0.6)
BRAKE = {**TRUTH, "angle_noise": NOISE.angle, "velocity_noise": NOISE.velocity}


def sheet(frame_age: str = "[0, 3]") -> Bench:
    """A factor of two for all four, and up to three samples late."""
    return parse_bench(sheet_text(frame_age=frame_age), "sheet")


def in_process(arguments: Sequence[str]) -> dict[str, Any]:
    """``emb-run --json`` without a process of its own."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exit_code = main(list(arguments))
    for number, handler in before.items():
        signal.signal(number, handler)
    document: dict[str, Any] = json.loads(printed.getvalue())
    return {**document, "exit_code": exit_code}


def _gives(document: Mapping[str, Any], _arguments: Sequence[str]) -> Mapping[str, Any]:
    return document


class EnoughError(Exception):
    """Ends a commissioning before a step."""


def up_to(step: str) -> Run:
    """Runs of all steps before this one."""

    def run(arguments: Sequence[str]) -> Mapping[str, Any]:
        if Path(arguments[arguments.index("--log") + 1]).stem == step:
            raise EnoughError
        return in_process(arguments)

    return run


def commissioning(folder: Path, run: Run = in_process, bench: Bench | None = None, iface: str = "") -> Commissioning:
    own = "sim:plant=late," + ",".join(f"{name}={value}" for name, value in BRAKE.items())
    return Commissioning(folder, bench or sheet(), iface or own, (), run, lambda _: None)


def mapping_for(folder: Path, drive: str, *edits: tuple[str, str]) -> Path:
    """A drive's mapping file, edited, for the data sheet's wide ranges."""
    text = re.sub(r"(?m)^end_stop_speed = \d+", "end_stop_speed = 5000", (EXAMPLES / f"{drive}.toml").read_text())
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    (folder / f"{drive}.dbc").write_text((EXAMPLES / f"{drive}.dbc").read_text())
    path = folder / f"{drive}.toml"
    path.write_text(text)
    return path


def on_a_drive(
    folder: Path, run: Run, *edits: tuple[str, str], drive: str = "odrive", frame_age: str = "[0, 3]"
) -> Commissioning:
    """The commissioning of a brake on a simulated drive, whose mapping is edited."""
    iface = f"map:{mapping_for(folder, drive, *edits)}@sim-drive:{drive},plant=late-command"
    bench = parse_bench(sheet(frame_age).text + "\n[plants.late-command]\ncommand_delay = 1\n", "sheet")
    return commissioning(folder, run, bench, iface)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Commissioned]:
    folder = tmp_path_factory.mktemp("brake")
    return folder, commissioning(folder).run()


def test_the_truth_lies_inside_of_ranges_much_narrower_than_the_data_sheets(done: tuple[Path, Commissioned]) -> None:
    _, result = done
    assert result.found.identified.fits
    for name, (low, high) in result.ranges.items():
        assert low <= TRUTH[name] <= high, name
        assert high - low <= 0.25 * TRUTH[name], name  # 150 % by the data sheet


def test_delays_and_noise_are_found(done: tuple[Path, Commissioned]) -> None:
    folder, result = done
    check, noise = result.found.current, result.found.noise
    assert (check.delay, result.found.identified.measurement_delay) == (1, 1)
    assert check.scale == pytest.approx(1.0, abs=1e-3)
    assert (noise.angle, noise.velocity) == pytest.approx((NOISE.angle, NOISE.velocity), rel=0.1)
    written = load_bench(folder / "bench.toml")
    assert written.shield.frame_age == (0, 2)
    instruments = written.plants[MEASURED].instruments
    assert instruments.command_delay == instruments.measurement_delay == 1
    assert NOISE.angle <= written.noise.angle <= 1.4 * NOISE.angle


def test_each_step_has_left_a_log_of_the_same_brake_and_a_policy(done: tuple[Path, Commissioned]) -> None:
    _, result = done
    assert len(result.logs) == result.runs == 9
    seeds = set()
    for log in result.logs:
        assert log.with_suffix(".onnx").exists()
        read = read_log(log)
        assert read.exit_reason == "DONE"
        assert read.truth is not None
        assert read.truth._asdict().items() >= TRUTH.items()
        seeds.add(read.run["iface"].partition("seed=")[2])
    assert len(seeds) == 9  # each with noise of its own


def test_it_goes_on_where_the_logs_end_and_comes_to_the_same(done: tuple[Path, Commissioned]) -> None:
    folder, result = done
    (folder / "9-full.mcap").unlink()
    written = {path: path.stat().st_mtime_ns for path in folder.glob("*.toml")}
    again = commissioning(folder).run()
    assert again.runs == 1
    assert written == {path: path.stat().st_mtime_ns for path in folder.glob("*.toml")}, "a full disk would empty them"
    assert again.found == result.found


@pytest.mark.parametrize("bandwidth", [800.0, 0.0])
def test_once_the_velocity_is_known_the_steps_go_on_with_it(tmp_path: Path, bandwidth: float) -> None:
    plant = f"[plants.drawn]\nobserver_bandwidth = {bandwidth}\n" if bandwidth else "[plants.drawn]\n"
    text = sheet("[0, 0]").text.replace("velocity = 1.0 ", "velocity = 1.8 ")
    bench = parse_bench(f"{text}\n{plant}", "sheet")
    with pytest.raises(EnoughError):
        commissioning(tmp_path, up_to("7-medium"), bench, "sim:plant=drawn").run()
    first, second = (load_bench(tmp_path / f"working{number}.toml") for number in ("", "-2"))
    assert first.sensors == Sensors("observer", 750.0)
    if bandwidth:
        assert second.sensors.observer_bandwidth == pytest.approx(0.97 * bandwidth, rel=0.04)
    else:
        assert second.sensors == Sensors()
    assert second.identity_hash == read_log(tmp_path / "6-small.mcap").bench.identity_hash
    assert first.identity_hash == read_log(tmp_path / "5-free-stroke.mcap").bench.identity_hash


def test_an_observer_that_the_data_sheet_denies_ends_it_at_low_speed(tmp_path: Path) -> None:
    bench = parse_bench(f'{sheet("[0, 0]").text}\n[sensors]\nvelocity = "sensor"\n', "sheet")
    with pytest.raises(
        EmbError,
        match=r'4-first-move .*RESPONSE_LATE: .*\[sensors\] velocity = "observer", observer_bandwidth = 14\d\d',
    ):
        commissioning(tmp_path, in_process, bench, "sim:plant=observer").run()
    assert float(read_log(tmp_path / "4-first-move.mcap").end["top_speed"]) < 60.0
    assert not (tmp_path / "5-free-stroke.mcap").exists()


@pytest.mark.slow
def test_a_mapped_drive_is_commissioned_up_to_its_first_move(tmp_path: Path) -> None:
    with pytest.raises(EnoughError):
        on_a_drive(tmp_path, up_to("5-free-stroke")).run()
    assert examination.first_move(read_log(tmp_path / "4-first-move.mcap"), NOISE).scale == pytest.approx(1.0, abs=0.05)
    check = examination.current(read_log(tmp_path / "3-current.mcap"))
    assert (check.delay, check.latest) == (1, 1)
    assert check.scale == pytest.approx(1.0, abs=1e-3)


def test_a_wrong_scale_of_the_current_ends_it_before_the_brake_has_moved(tmp_path: Path) -> None:
    """Five times the current that was meant would make the way home and the drive's stop run away."""
    factor_five = ("per_ampere = 0.0217, range = [-0.1303, 0.1303]", "per_ampere = 0.1085, range = [-0.66, 0.66]")
    with pytest.raises(EmbError, match="the drive reports 5 A for 1 A commanded"):
        on_a_drive(tmp_path, in_process, factor_five).run()
    log = read_log(tmp_path / "3-current.mcap")
    assert np.ptp(log.signals(log.layout.angle.name)["Angle"]) < 0.05
    assert not list(tmp_path.glob("*homing*"))


def test_a_polled_drive_is_listened_to_as_any_other(tmp_path: Path) -> None:
    with pytest.raises(EnoughError):
        on_a_drive(tmp_path, up_to("3-current"), drive="mit", frame_age="[1, 3]").run()
    assert read_log(tmp_path / "1-listen.mcap").run["stage"] == "read-only"
    assert examination.noise_at_rest(read_log(tmp_path / "1-listen.mcap"), sheet()).angle > 0.0


def test_a_run_that_was_not_completed_is_done_again_under_another_name(tmp_path: Path) -> None:
    def short(arguments: Sequence[str]) -> Mapping[str, Any]:  # as by Ctrl-C
        return in_process([*arguments, "--duration", "0.1"])

    with pytest.raises(StepFailedError, match="1-listen was not completed: it was ended before its time"):
        commissioning(tmp_path, short).run()
    with pytest.raises(EnoughError):
        commissioning(tmp_path, up_to("2-zero")).run()
    assert {path.name for path in tmp_path.glob("*.mcap")} == {"1-listen.mcap", "1-listen-attempt2.mcap"}


@pytest.mark.parametrize(
    ("heard", "enough"), [({"scatter": {"pairs": 299}}, False), ({"scatter": {"pairs": 300}}, True), ({}, False)]
)
def test_listening_counts_where_the_node_was_idle_for_long_enough_to_know_its_noise(
    heard: dict[str, int], enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = SimpleNamespace(complete=True, exit_reason="DONE", end={"heard": json.dumps({"pairs": 2000, **heard})})
    monkeypatch.setattr(examination, "read_log", lambda _path: log)
    assert (examination.completed(Path("1-listen.mcap")) is not None) is enough


def test_a_motion_of_no_brake_of_the_data_sheet_ends_it_with_what_to_look_at_and_its_exit_code(tmp_path: Path) -> None:
    fine = {"result": "done", "detail": "", "cause": "", "exit_code": 3, "homing": {}}
    for fault in ("OUT_OF_LIMITS", "MOTION_OUTSIDE_SET"):
        failed = {**fine, "result": fault, "cause": "the brake moves as none"}
        for document in (failed, {**fine, "homing": {"before": failed}}):
            with pytest.raises(StepFailedError, match=rf"{fault}: the brake moves.*; no parameter was found") as ended:
                commissioning(tmp_path, partial(_gives, document)).run()
            assert ended.value.exit_code == 3
    with pytest.raises(StepFailedError, match="begin again in the same folder") as ended:
        commissioning(tmp_path, lambda _: {**fine, "result": "NO_NODE", "exit_code": 4}).run()
    assert ended.value.exit_code == 4


def test_a_motion_of_no_brake_near_a_border_of_the_data_sheet_ends_it_with_the_range_to_widen(
    done: tuple[Path, Commissioned], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in done[0].iterdir():
        if path.name != "bench.toml" and not path.name.startswith(("8-", "9-")):
            shutil.copy(path, tmp_path)
    document = {"result": "MOTION_OUTSIDE_SET", "detail": "", "cause": "the brake moves as none", "exit_code": 3}
    for name, shares in (("k_m", (1.991, 2.0)), ("T_c", (0.49, 0.52))):  # one ends at a border, one lies across it
        found = with_interval(identification(sheet()), name, shares)
        monkeypatch.setattr(examination, "identify", lambda *_, found=found: found)
        with pytest.raises(StepFailedError, match=rf"8-large was not completed: .* widen {name} in \[ranges\.wide\]"):
            commissioning(tmp_path, partial(_gives, document)).run()


def test_a_start_that_a_few_samples_at_rest_tell_is_not_taken_for_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim, log = Sim(), tmp_path / "run.mcap"
    sim.angle = -0.1
    monkeypatch.setattr("emb_runtime.cli.experiment.open_transport", lambda _iface, bench, _ids: sim.open("", bench))
    assert in_process(["--iface", "sim", "--log", str(log), "--json"])["exit_code"] == 0
    own = read_experiment(read_log(log))
    assert own.x0() != (0.0, 0.0)
    for error in (-2.5, 2.5):
        unlucky = replace(own, angle=-0.1 + error * own.slack)
        monkeypatch.setattr(examination, "read_experiment", lambda _log, unlucky=unlucky: unlucky)
        bench = load_bench()
        one = examination.identify([read_log(log)], bench, bench.noise, None)
        assert one.fits
        for name, (low, high) in one.intervals.items():
            assert low <= getattr(bench.brake, name) <= high, name


def test_a_data_sheet_may_be_corrected_before_the_first_log_and_its_time_outs_later(tmp_path: Path) -> None:
    def run(text: str) -> None:
        with pytest.raises(EnoughError):
            commissioning(tmp_path, up_to("2-zero"), parse_bench(text, "sheet")).run()

    other = sheet().text.replace("0.5", "0.4", 1)
    (tmp_path / "working.toml").write_text(working_text(parse_bench(other, "before")))
    run(sheet().text)
    run(sheet().text.replace("start_timeout = 5.0", "start_timeout = 9.0"))
    written = load_bench(tmp_path / "working.toml")
    assert written.watch.start_timeout == 9.0
    with pytest.raises(EmbError, match=r"which rest on it; go on with the data sheet .* or take another folder"):
        commissioning(tmp_path, in_process, parse_bench(other, "after")).run()


def test_a_bench_file_of_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "working.toml").write_text(shipped_bench_text())
    with pytest.raises(EmbError, match="another bench"):
        commissioning(tmp_path).run()


@pytest.mark.parametrize(
    ("brake", "to_widen"),
    [
        ("seed=29,T_c=0.0048,k_m=0.03", "T_c"),
        pytest.param("seed=24,k_m=0.0456,T_c=0.0055", "k_m", marks=pytest.mark.slow),
        pytest.param("seed=30,f_v=4.6e-5", "f_v", marks=pytest.mark.slow),
    ],
)
def test_a_brake_a_little_outside_of_the_data_sheet_ends_it_with_the_range_to_widen_and_no_file(
    tmp_path: Path, brake: str, to_widen: str
) -> None:
    with pytest.raises(EmbError, match=rf"widen {to_widen} in \[ranges\.wide\]"):
        commissioning(tmp_path, in_process, sheet("[0, 0]"), f"sim:{brake}").run()
    assert not (tmp_path / "bench.toml").exists()


def test_a_brake_whose_latency_the_data_sheet_excludes_is_not_moved(tmp_path: Path) -> None:
    with pytest.raises(EmbError, match="commands act 1 samples late"):
        commissioning(tmp_path, in_process, sheet("[0, 0]")).run()
    assert not (tmp_path / "4-first-move.mcap").exists()


# --- emb-commission -------------------------------------------------------------------------------------------------


def test_a_simulated_brake_keeps_its_parameters_and_any_other_bus_stays_as_it_is() -> None:
    bench = load_bench()
    assert simulated("sim:k_m=0.03, seed = 7", bench, 2).startswith("sim:k_m=0.03, seed=9,")
    assert simulated("sim", bench, 2).endswith(f",velocity_noise={bench.noise.velocity},seed=3")
    assert simulated("map:d@x.toml@sim-drive:vesc", bench, 0).startswith("map:d@x.toml@sim-drive:vesc,k_m=")
    for iface in ("can0", "sim0", "map:d@x.toml@can0", "can0@sim0"):
        assert simulated(iface, bench, 3) == iface


def test_every_step_is_confirmed_unless_told_otherwise_or_nobody_else_is_on_the_bus() -> None:
    real = ("can0", "sim0", "map:d@x.toml@can0", "can0@sim")
    private = ("sim", "sim:seed=3", "map:d@x.toml@sim-drive:vesc")
    for iface in (*real, *private):
        for more in ([], ["--yes"], ["--confirm"]):
            given = commission.options(commission.parser().parse_args(["brake", "--iface", iface, *more]))
            assert ("--confirm" in given) is (more != ["--yes"] and (iface in real or more == ["--confirm"])), iface
            assert ("--yes" in given) is (more == ["--yes"])


SILENT = """
import time
from emb_runtime.system.clock import MonotonicClock
class Silent:
    name, truth, obtained = "silent", None, {}
    def send(self, frame): pass
    def receive(self, deadline_ns): time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
    def close(self): pass
def opened(options, bench): return Silent(), MonotonicClock()
"""
"""A bus on which nobody is, as a registered transport."""


@pytest.fixture
def begun(tmp_path: Path) -> Callable[[str], subprocess.Popen[str]]:
    """``emb-commission`` in a process of its own, as soon as the log of a step grows."""
    (tmp_path / "sheet.toml").write_text(sheet_text())
    (tmp_path / "silent-0.dist-info").mkdir()
    entry = "[emb_runtime.transports]\nsilent = silent:opened\n"
    (tmp_path / "silent-0.dist-info" / "entry_points.txt").write_text(entry)
    (tmp_path / "silent.py").write_text(SILENT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))}

    def begin(step: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "emb_bench.cli.commission", "brake", "--bench", "sheet.toml", "--iface"]
        process = subprocess.Popen(
            [*command, "silent", "--yes"],
            cwd=tmp_path,
            env=environment,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        while not (tmp_path / "brake" / step).exists() and process.poll() is None:
            time.sleep(0.05)
        return process

    return begin


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_the_run_and_the_commissioning_after_it(
    tmp_path: Path, begun: Callable[[str], subprocess.Popen[str]], number: signal.Signals
) -> None:
    process = begun("1-listen.mcap")
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 4, said  # nobody was heard until then
    assert "Traceback" not in said
    log = read_log(tmp_path / "brake" / "1-listen.mcap")
    assert log.complete
    assert log.metadata["emb.end"]["exit_reason"] == "NO_NODE"  # of what was heard until then
