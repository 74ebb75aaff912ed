"""A commissioning from the data sheet to the bench file, on a simulated brake: what is found, and that it goes on."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emb_bench.commission import examiner
from emb_bench.commission.examiner import LogExaminer
from emb_bench.experiment.experiment import REST_SIGMAS, read_experiment
from emb_bench.logs.log import read_log
from emb_runtime.cli.commissioning import Commissioned, Commissioning
from emb_runtime.cli.main import main
from emb_runtime.cli.repeat import ExperimentResult
from emb_runtime.cli.session import Console
from emb_runtime.commission.bench_file import measured_ranges, working_text
from emb_runtime.commission.records import FirstMove, Rest
from emb_runtime.config.bench import Bench, Noise, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import EmbError, SafetyStopError
from tests.drives import EXAMPLES
from tests.runtime.commission.test_steps import sheet_text
from tests.runtime.operating import Sim

TRUTH = {"k_m": 0.03, "k_1": 17.0, "T_c": 0.0075, "f_v": 3.4e-5}
NOISE = Noise(7e-4, 0.6)


def sheet(frame_age: str = "[0, 3]") -> Bench:
    """A factor of two for all four, and up to three samples late."""
    return parse_bench(sheet_text(frame_age=frame_age), "sheet")


def commissioning(folder: Path, plant: str = "late", **truth: float) -> Commissioning:
    options = {"plant": plant, **TRUTH, **truth, "angle_noise": NOISE.angle, "velocity_noise": NOISE.velocity}
    iface = "sim:" + ",".join(f"{name}={value}" for name, value in options.items())
    alone = Console(stop_requested=lambda: False, show=lambda *_: None, may_arm=lambda _: True)
    return Commissioning(folder, sheet(), iface, (), LogExaminer(), lambda _: alone, lambda _: None)


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
    folder: Path,
    *edits: tuple[str, str],
    drive: str = "odrive",
    examiner: LogExaminer | None = None,
    frame_age: str = "[0, 3]",
) -> Commissioning:
    """The commissioning of a brake on a simulated drive, whose mapping is edited."""
    iface = f"map:{mapping_for(folder, drive, *edits)}@sim-drive:{drive},plant=late-command"
    alone = Console(stop_requested=lambda: False, show=lambda *_: None, may_arm=lambda _: True)
    bench = parse_bench(sheet(frame_age).text + "\n[plants.late-command]\ncommand_delay = 1\n", "sheet")
    return Commissioning(folder, bench, iface, (), examiner or LogExaminer(), lambda _: alone, lambda _: None)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Commissioned]:
    folder = tmp_path_factory.mktemp("brake")
    return folder, commissioning(folder).run()


def test_the_truth_lies_inside_of_ranges_much_narrower_than_the_data_sheets(done: tuple[Path, Commissioned]) -> None:
    _, result = done
    one = result.found.identified
    assert one is not None
    assert one.fits
    for name, (low, high) in measured_ranges(sheet(), one).items():
        assert low <= TRUTH[name] <= high, name
        assert high - low <= 0.25 * TRUTH[name], name  # 150 % by the data sheet


def test_delays_and_noise_are_found(done: tuple[Path, Commissioned]) -> None:
    folder, result = done
    assert result.found.current is not None
    assert result.found.current.delay == 1
    assert result.found.current.scale == pytest.approx(1.0, abs=1e-3)
    assert result.found.identified is not None
    assert result.found.identified.measurement_delay == 1
    assert result.found.rest is not None
    assert result.found.rest.noise.angle == pytest.approx(NOISE.angle, rel=0.1)
    assert result.found.rest.noise.velocity == pytest.approx(NOISE.velocity, rel=0.1)
    written = load_bench(folder / "bench.toml")
    assert written.shield.frame_age == (0, 2)
    assert NOISE.angle <= written.noise.angle <= 1.4 * NOISE.angle


def test_each_step_has_left_a_log_and_a_policy_that_do_it_again(done: tuple[Path, Commissioned]) -> None:
    _, result = done
    assert len(result.logs) == result.runs == 9
    for log in result.logs:
        assert log.with_suffix(".onnx").exists()
        assert LogExaminer().ended(log) == "DONE"


def test_it_goes_on_where_the_logs_end_and_comes_to_the_same(done: tuple[Path, Commissioned]) -> None:
    folder, result = done
    (folder / "9-full.mcap").unlink()
    again = commissioning(folder).run()
    assert again.runs == 1
    assert again.found == result.found


def test_the_simulated_brake_stays_the_same_when_the_bench_file_changes(done: tuple[Path, Commissioned]) -> None:
    _, result = done
    truths = [read_log(log).truth for log in result.logs]
    assert all(truth == truths[0] for truth in truths)
    assert truths[0] is not None
    assert truths[0].k_m == TRUTH["k_m"]


def test_a_mapped_drive_is_commissioned_up_to_its_first_move(tmp_path: Path) -> None:
    class Curious(LogExaminer):
        def first_move(self, log: Path, noise: Noise) -> FirstMove:
            raise SafetyStopError(f"{super().first_move(log, noise).scale:.3f}")

    one = on_a_drive(tmp_path, examiner=Curious())
    with pytest.raises(SafetyStopError) as ended:
        one.run()
    assert float(str(ended.value)) == pytest.approx(1.0, abs=0.05)
    check = LogExaminer().current(tmp_path / "3-current.mcap")
    assert (check.delay, check.uncertain) == (1, 0)
    assert check.scale == pytest.approx(1.0, abs=1e-3)


def test_a_wrong_scale_of_the_current_ends_it_before_the_brake_has_moved(tmp_path: Path) -> None:
    """Five times the current that was meant would make the way home and the drive's stop run away."""
    one = on_a_drive(
        tmp_path, ("per_ampere = 0.0217, range = [-0.1303, 0.1303]", "per_ampere = 0.1085, range = [-0.66, 0.66]")
    )
    with pytest.raises(SafetyStopError, match="the drive reports 5 A for 1 A commanded"):
        one.run()
    log = read_log(tmp_path / "3-current.mcap")
    assert np.ptp(log.signals(log.layout.angle.name)["Angle"]) < 0.05
    assert not list(tmp_path.glob("*homing*"))


def test_a_listening_that_the_operator_ends_is_done_again(tmp_path: Path) -> None:
    polls = iter(range(10_000))
    impatient = Console(stop_requested=lambda: next(polls) > 15, show=lambda *_: None, may_arm=lambda _: True)
    one = commissioning(tmp_path)
    one._console = lambda _: impatient
    with pytest.raises(SafetyStopError, match="1-listen was not completed: it was ended before its time"):
        one.run()

    class Resting(LogExaminer):
        def rest(self, log: Path) -> Rest:
            raise SafetyStopError(log.name)

    one = commissioning(tmp_path)
    one._examiner = Resting()
    with pytest.raises(SafetyStopError, match=r"1-listen-attempt2\.mcap"):
        one.run()


def test_a_polled_drive_is_asked_for_its_samples(tmp_path: Path) -> None:
    class Resting(LogExaminer):
        def rest(self, log: Path) -> Rest:
            raise SafetyStopError(f"{len(read_log(log).cycles)} periods at rest")

    with pytest.raises(SafetyStopError, match="periods at rest"):
        on_a_drive(tmp_path, drive="mit", examiner=Resting(), frame_age="[1, 3]").run()
    sent = read_log(tmp_path / "1-listen.mcap").cycles["sent_current"]
    assert set(np.asarray(sent)[np.isfinite(sent)]) == {0.0}


def test_a_folder_of_another_data_sheet_is_refused(tmp_path: Path) -> None:
    (tmp_path / "working.toml").write_text(shipped_bench_text())
    with pytest.raises(EmbError, match="another bench"):
        commissioning(tmp_path).run()


def test_a_start_that_a_few_samples_at_rest_tell_is_not_taken_for_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim, log = Sim(), tmp_path / "run.mcap"
    sim.angle = -0.1
    monkeypatch.setattr("emb_runtime.cli.repeat.open_transport", lambda _iface, bench, _ids: sim.open("", bench))
    with monkeypatch.context() as signals:
        signals.setattr("signal.signal", lambda *_: None)
        assert main(["--iface", "sim", "--log", str(log)]) == 0
    own = read_experiment(read_log(log))
    assert own.x0() != (0.0, 0.0)
    one_sigma = own.before.slack / REST_SIGMAS
    for error in (-2.5, 2.5):
        unlucky = replace(own, before=own.before._replace(angle=-0.1 + error * one_sigma))
        monkeypatch.setattr(examiner, "read_experiment", lambda _log, unlucky=unlucky: unlucky)
        bench = load_bench()
        one = LogExaminer().identify([log], bench, bench.noise, None)
        assert one.fits
        for name, (low, high) in one.intervals.items():
            assert low <= getattr(bench.brake, name) <= high, name


def test_a_data_sheet_that_was_corrected_before_anything_was_logged_is_taken(tmp_path: Path) -> None:
    """The first attempt found no bus: the folder holds a bench file and a policy, and nothing that rests on them."""

    class Deaf(LogExaminer):
        def rest(self, log: Path) -> Rest:
            raise SafetyStopError("ended here")

    one = commissioning(tmp_path)
    one._bench("working.toml", working_text(parse_bench(sheet().text.replace("0.5", "0.4", 1), "before")))
    before = load_bench(tmp_path / "working.toml")
    one._examiner = Deaf()
    with pytest.raises(SafetyStopError, match="ended here"):
        one.run()
    after = load_bench(tmp_path / "working.toml")
    assert before.contract_hash != after.contract_hash
    assert after.contract_hash == parse_bench(working_text(sheet()), "now").contract_hash
    one = commissioning(tmp_path)  # and now there is a log that rests on it
    one._sheet = parse_bench(sheet().text.replace("0.5", "0.4", 1), "again another")
    with pytest.raises(EmbError, match=r"which rest on it; go on with the data sheet .* or take another folder"):
        one.run()


def test_time_outs_that_were_changed_later_are_taken_and_the_logs_stay_good(tmp_path: Path) -> None:
    one = commissioning(tmp_path)
    one._bench("working.toml", working_text(sheet()))
    (tmp_path / "1-listen.mcap").touch()
    patient = parse_bench(sheet().text.replace("start_timeout = 5.0", "start_timeout = 9.0"), "patient")
    assert one._bench("working.toml", working_text(patient)).watch.start_timeout == 9.0
    assert load_bench(tmp_path / "working.toml").watch.start_timeout == 9.0


def test_a_motion_of_no_brake_of_the_data_sheet_ends_it_with_what_to_look_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for fault in ("OUT_OF_LIMITS", "MOTION_OUTSIDE_SET", "SET_CONTRADICTED"):
        run = {"result": fault, "detail": "", "cause": "the brake moves as none", "exit_code": 3}
        done = ExperimentResult({**run, "homing": {}}, 3, False, {})
        monkeypatch.setattr("emb_runtime.cli.commissioning.experiment", lambda *_, done=done: done)
        with pytest.raises(SafetyStopError, match=rf"2-zero was not completed: {fault}: .*; no parameter that was"):
            commissioning(tmp_path).run()


@pytest.mark.parametrize(
    ("brake", "to_widen"),
    [
        ("seed=29,T_c=0.0048,k_m=0.03", "T_c"),
        ("seed=24,k_m=0.0456,T_c=0.0055", "k_m"),
        ("seed=30,f_v=4.6e-5", "f_v"),
    ],
)
def test_a_brake_a_little_outside_of_the_data_sheet_ends_it_with_the_range_to_widen_and_no_file(
    tmp_path: Path, brake: str, to_widen: str
) -> None:
    one = commissioning(tmp_path)
    one._sheet = sheet(frame_age="[0, 0]")
    one._iface = f"sim:{brake}"
    with pytest.raises(EmbError, match=rf"widen {to_widen} in \[ranges\.wide\]"):
        one.run()
    assert not (tmp_path / "bench.toml").exists()


def test_a_brake_whose_latency_the_data_sheet_excludes_is_not_moved(tmp_path: Path) -> None:
    one = commissioning(tmp_path)
    one._sheet = sheet(frame_age="[0, 0]")
    with pytest.raises(EmbError, match="commands act 1 samples late"):
        one.run()
    assert not (tmp_path / "4-first-move.mcap").exists()
