"""What acted on a mapped drive, which tells its current coarsely, and what an estimate from its log is worth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import simulated_drives
from emb_bench import api
from emb_bench.experiment.experiment import Floats
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.evaluation import Evaluation
from emb_bench.logs.log import RunLog, read_log
from emb_bench.numbers import in_samples
from emb_bench.report import estimate as report
from emb_bench.report.information import notes
from emb_bench.report.sentences import assumptions
from emb_runtime.cli.main import main
from emb_runtime.config.bench import PARAMETER_NAMES, parse_bench
from emb_runtime.records import Frame
from tests.actors import constant_actor
from tests.benches import measured
from tests.drives import EXAMPLES, late_bench


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[RunLog, list[float]]:
    """A run whose commands act a sample later than the node assumes; its log, and what acted in each period [A]."""
    truly: list[float] = []

    broadcast = simulated_drives.DRIVES[name].broadcast

    def watched(drive: simulated_drives.SimulatedDrive) -> list[Frame]:
        truly.append(drive.applied)
        return broadcast(drive)

    monkeypatch.setattr(simulated_drives.DRIVES[name], "broadcast", watched)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    text = measured(late_bench(polled=name == "mit")).replace("frame_age     = [1, 1]", "frame_age     = [1, 2]")
    if name == "mit":  # its angle has steps of 3.4 mrad, which its bench file's noise covers
        text = text.replace("angle    = 1.0e-3", "angle    = 1.7e-3")
    bench, actor, log = (folder / file for file in ("late.toml", "actor.onnx", "run.mcap"))
    bench.write_text(text)
    actor.write_bytes(constant_actor(parse_bench(text, "late.toml"), 2.0))
    iface = f"map:{EXAMPLES / name}.toml@sim-drive:{name},plant=late-command,angle_noise=1e-3"
    files = ["--bench", str(bench), "--policy", str(actor), "--log", str(log)]
    assert main(["--iface", iface, "--serial", "x", *files]) == 0
    return read_log(log), truly


def error(currents: Floats, truly: list[float]) -> float:
    """Largest, of all periods, from where in the drive's own account they begin best [A]."""
    n = len(currents)
    return min(float(np.max(np.abs(currents - truly[begin : begin + n]))) for begin in range(len(truly) - n + 1))


@pytest.mark.parametrize(("name", "late"), [("vesc", 1), ("mit", 2)])
def test_parameters_are_known_from_a_log_of_a_drive_that_tells_its_current_coarsely(
    name: str, late: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, truly = run(name, tmp_path, monkeypatch)
    experiment = read_experiment(log)
    assert experiment.quality.command_delay == late
    assert experiment.quality.lacks == {}
    assert error(np.asarray(log.cycles["applied_current"])[1 : experiment.periods + 1], truly) > 0.04  # as it was told
    assert error(experiment.currents, truly) < 1e-3

    study = api.estimate(log, model="exact")
    assert study.model_fits
    truth = log.truth
    assert truth is not None
    for one in study.conclusions:
        assert one.interval[0] <= getattr(truth, one.label) <= one.interval[1]
        assert one.interval[1] - one.interval[0] < 0.06 * getattr(truth, one.label)  # 0.04 by an inertia known to 1 %
    assert [c.label for c in study.conclusions] == list(PARAMETER_NAMES)
    (note,) = assumptions(study)
    assert f"the command on the bus, {in_samples(late)} late" in note
    assert f"NOTE: {note}" in " ".join(report.study_text(study).split())
    information = api.fisher_information(log, model="exact")
    assert isinstance(information, Evaluation)
    assert note in notes(information)


def test_of_a_mapping_that_is_not_readable_what_was_told_acted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, _ = run("vesc", tmp_path, monkeypatch)
    damaged = replace(log, attachments={**log.attachments, "drive.toml": b"schema = "})
    experiment = read_experiment(damaged)
    assert experiment.currents.tolist() == log.cycles["applied_current"][1 : experiment.periods + 1].tolist()
    assert experiment.quality.within is not None
    assert np.isnan(experiment.quality.within)
