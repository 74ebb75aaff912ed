"""Experiments in logs, of nodes and of mapped drives: what acted, what was measured, and what is lacking."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import simulated_drives
from emb_bench import api
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.experiment.experiment import Experiment, Floats, Lack
from emb_bench.experiment.from_log import (
    LOST,
    UNKNOWN,
    Samples,
    control_cycles,
    currents_by_charge,
    read_experiment,
    samples_before,
)
from emb_bench.experiment.simulate import Theta
from emb_bench.information.evaluation import Evaluation, Fit, information_and_fit
from emb_bench.logs.log import RunLog, read_log
from emb_bench.numbers import in_samples
from emb_bench.report import estimate as report
from emb_bench.report.information import notes
from emb_bench.report.sentences import assumptions
from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout
from emb_runtime.can.receiver import Reception
from emb_runtime.cli.main import main
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Sensors, parse_bench
from emb_runtime.errors import LogError
from emb_runtime.log.ring_buffer import FrameRecord
from emb_runtime.records import CycleRecord, Frame, RunState, SensorSample
from tests.actors import constant_actor
from tests.bench.hostile import HostileBus, drive, write_trace
from tests.bench.simulated_logs import square, write_log
from tests.benches import measured
from tests.conftest import SimRun, Simulate
from tests.drives import EXAMPLES, late_bench
from tests.independent import DATABASE

VELOCITY = 0x101


class Lose:
    """Keeps some velocity frames from the loop: those of the given numbers, counted from the first."""

    def __init__(self, *numbers: int) -> None:
        self.numbers = numbers
        self.seen = 0
        self.applied: list[float] = []
        """Currents that the lost frames report [A]."""

    def __call__(self, frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and frame.identifier == VELOCITY:
            self.seen += 1
            if self.seen in self.numbers:
                self.applied.append(DATABASE.decode_message(VELOCITY, frame.data)["AppliedCurrent"])
                return transport.receive(2**62)
        return frame


def commanded(run: SimRun, layout: Layout) -> list[float]:
    commands = [layout.decode_command(frame) for frame in run.sent]
    return [command.current for command in commands if command.enable]


def knowing_how_late(bench: Bench) -> Bench:
    """The bench whose shield and monitor expect the plant ``late``: a sample each way."""
    return replace(bench, shield=bench.shield._replace(frame_age=(2, 2)))


def recorded(tmp_path: Path, run: SimRun, steps: int = 500) -> tuple[RunLog, Experiment]:
    log = read_log(write_log(tmp_path / "run.mcap", run, steps=steps))
    return log, read_experiment(log)


def fit(experiment: Experiment, bench: Bench, theta: BrakeParameters, plant: Plant) -> Fit:
    at = Theta(theta, experiment.x0(plant.instruments.encoder_offset))
    return information_and_fit(bench, plant, at, experiment)[1]


def test_what_acted_is_exactly_what_the_node_was_told(
    tmp_path: Path, simulate: Simulate, layout: Layout, bench: Bench
) -> None:
    run = simulate(square, options="f_v=4e-5,T_c=1.2e-2")
    log, experiment = recorded(tmp_path, run)
    assert experiment.currents.tolist() == commanded(run, layout)
    assert experiment.measured.all()
    assert (experiment.quality.planned, experiment.quality.braked, experiment.quality.lacks) == (500, 0, {})
    assert experiment.x0() == (0.0, 0.0)
    assert experiment.all_samples[:-1, 0].tolist() == [c.angle for c in run.journal.cycles[:-1]]
    assert experiment.all_samples[:, 1].tolist() == [c.velocity for c in run.journal.cycles]
    assert experiment.late is not None
    assert experiment.late.tolist() == [0.0] * 500
    assert log.complete


def test_a_lost_sample_is_a_gap_whose_currents_are_assumed_and_said_to_be(
    tmp_path: Path, simulate: Simulate, bench: Bench
) -> None:
    run = simulate(square, options="f_v=4e-5", on_receive=Lose(200, 300, 301))
    log, experiment = recorded(tmp_path, run)
    lost = np.flatnonzero(~experiment.measured)
    assert len(lost) == 3
    assert np.isnan(experiment.samples[lost, 0]).all()
    assert experiment.quality.lacks == {Lack.LOST: (3,)}
    # A period that begins at a lost sample has no command: the node braked, and of two in a row one is not reported.
    assert experiment.quality.braked == 2
    sent = {c.step: c.sent_current for c in run.journal.cycles if c.command_counter != 15}
    first, second, third = lost.tolist()
    assert (experiment.currents[first], experiment.currents[second]) == (sent[first], sent[second])
    assert experiment.currents[third] == pytest.approx(np.clip(-0.1 * experiment.samples[second - 1, 1], -6.0, 6.0))
    assert log.truth is not None
    near = fit(experiment, bench, log.truth, bench.plant("exact"))
    assert near.compared[1] < 3.0  # the assumption about one braked period is close, not exact


def test_an_experiment_whose_last_sample_was_lost_ends_where_it_was_due(tmp_path: Path, simulate: Simulate) -> None:
    run = simulate(square, options="f_v=4e-5", on_receive=Lose(512))
    assert run.journal.cycles[-1].step == 501
    log, experiment = recorded(tmp_path, run)
    assert (len(experiment.currents), experiment.quality.planned) == (500, 500)
    assert np.flatnonzero(~experiment.measured).tolist() == [499]
    assert log.truth is not None
    assert fit(experiment, log.bench, log.truth, log.bench.plant("exact")).fits


def test_without_gaps_in_the_reports_braked_periods_are_known_exactly(
    tmp_path: Path, simulate: Simulate, bench: Bench
) -> None:
    log, experiment = recorded(tmp_path, simulate(square, options="f_v=4e-5", on_receive=Lose(150, 260, 370)))
    assert experiment.quality.braked == 3
    assert log.truth is not None
    assert fit(experiment, bench, log.truth, bench.plant("exact")).fits


def test_the_charge_tells_what_acted_before_a_single_lost_sample_and_nothing_else_changes(
    tmp_path: Path, simulate: Simulate
) -> None:
    losses = (150, 151, 200, 260, 370, 371, 372, 480)
    lose, silent = Lose(*losses), Lose(*losses)
    run = simulate(square, options="f_v=4e-5,charge=1", on_receive=lose)
    log, experiment = recorded(tmp_path, run)
    topics, charges = log.topics, log.signals("EMB_Charge")["Charge"]
    without = simulate(square, options="f_v=4e-5", on_receive=silent)
    assert [f.data for f in run.sent] == [f.data for f in without.sent]
    decided = [[(c.step, c.state, c.reasons, c.sent_current) for c in r.journal.cycles] for r in (run, without)]
    assert repr(decided[0]) == repr(decided[1])
    older, assumed = recorded(tmp_path, without)
    lost = np.flatnonzero(~experiment.measured)
    told = lost[experiment.reported[lost]]
    acted = dict(zip(lost.tolist(), lose.applied[-len(lost) :], strict=True))
    assert len(told) == 3
    assert experiment.currents[told] == pytest.approx([acted[k] for k in told.tolist()], abs=1e-7)
    assert experiment.quality.lacks[Lack.LOST_WITH_CHARGE][1] == 3
    assert assumed.reported.tolist() == assumed.measured.tolist() == experiment.measured.tolist()
    assert Lack.LOST_WITH_CHARGE not in assumed.quality.lacks
    assert "/emb/EMB_Charge" in topics
    assert "/emb/EMB_Charge" not in older.topics
    assert len(charges) > 500


def test_a_charge_that_cannot_be_is_not_believed(bench: Bench, layout: Layout) -> None:
    samples = Samples(*(np.full(5, value) for value in LOST))
    samples.angle[[0, 1, 3, 4]] = 0.0
    samples.applied[[0, 1, 3, 4]] = 1.0
    wrap = 2e-7 * 2**40
    for passed, expected in ((3e-3, 2.0), (-4e-3, -5.0), (5e-3 + wrap, 4.0), (7.2e-3, math.nan), (math.nan, math.nan)):
        samples.charge[[1, 3]] = 0.001, 0.001 + passed
        told = currents_by_charge(samples, bench, layout)
        assert told.tolist()[2] == pytest.approx(expected, abs=1e-6, nan_ok=True)
        assert np.isnan(np.delete(told, 2)).all()


def test_a_brake_that_rests_off_the_origin_starts_where_it_rests(tmp_path: Path, simulate: Simulate) -> None:
    def shifted(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        while frame is not None and transport.node.samples < 3:  # nobody looks while it is moved
            transport.node.angle = -0.3
            frame = transport.receive(clock.now_ns() + 1_000_000)
        return frame

    _, experiment = recorded(tmp_path, simulate(square, on_receive=shifted))
    assert experiment.x0()[0] == pytest.approx(-0.3, abs=0.002)
    assert experiment.x0()[1] == 0.0


@pytest.mark.parametrize("plant", ["euler", "exact", "offset", "jitter", "observer"])
def test_a_record_fits_the_plant_that_was_simulated_and_its_instruments(
    tmp_path: Path, simulate: Simulate, bench: Bench, plant: str
) -> None:
    told = replace(bench, sensors=Sensors("observer", 1520.0)) if plant == "observer" else bench
    log, experiment = recorded(tmp_path, simulate(square, options=f"plant={plant},f_v=3e-5", on_bench=told))
    assert log.true_plant == plant
    assert log.truth is not None
    right = fit(experiment, bench, log.truth, bench.plant(plant))
    assert right.fits
    assert right.angle == pytest.approx(1.0, abs=0.15)
    assert right.velocity == (None if plant == "observer" else pytest.approx(1.0, abs=0.15))
    assert not fit(experiment, bench, log.truth, bench.plant("euler" if plant == "exact" else "late")).fits
    assert not fit(experiment, bench, bench.brake, bench.plant(plant)).fits


def test_of_a_late_plant_what_acted_is_known_exactly_and_how_late_is_found(
    tmp_path: Path, simulate: Simulate, layout: Layout, bench: Bench
) -> None:
    run = simulate(square, options="plant=late", on_bench=knowing_how_late(bench))
    log, experiment = recorded(tmp_path, run)
    sent = commanded(run, layout)
    assert experiment.quality.command_delay == 1
    assert experiment.currents.tolist() == [0.0, *sent[:-1]]
    assert experiment.quality.lacks == {}
    assert log.truth is not None
    assert fit(experiment, bench, log.truth, bench.plant("late")).fits
    assert not fit(experiment, bench, log.truth, bench.plant("exact")).fits


def test_a_lost_report_of_a_late_plant_is_taken_from_the_command_that_was_to_act(
    tmp_path: Path, simulate: Simulate, bench: Bench
) -> None:
    run = simulate(square, options="plant=late", on_bench=knowing_how_late(bench), on_receive=Lose(200))
    _, experiment = recorded(tmp_path, run)
    (lost,) = np.flatnonzero(~experiment.measured).tolist()
    sent = {c.step: c.sent_current for c in run.journal.cycles if c.command_counter != 15}
    assert (experiment.quality.command_delay, experiment.currents[lost]) == (1, sent[lost - 1])
    # That the node braked a period later, for want of that command, contradicts nothing.
    assert experiment.quality.lacks == {Lack.LOST: (1,)}


def test_what_cannot_be_compared_does_not_fit() -> None:
    assert Fit(1.0, 1.0, 500).fits
    assert not Fit(0.0, 0.0, 0).fits
    assert not Fit(1.0, math.nan, 500).fits
    assert not Fit(math.nan, 1.0, 500).fits
    assert Fit(1.0, None, 500).fits
    assert not Fit(math.nan, None, 500).fits


def test_a_report_that_contradicts_the_command_is_counted(tmp_path: Path, simulate: Simulate) -> None:
    run = simulate(square)
    records, cycles = run.journal.records, run.journal.cycles
    for changed in (
        cycles[100]._replace(sent_current=cycles[100].sent_current + 0.0002),
        cycles[200]._replace(sent_current=math.nan, command_counter=NO_COUNTER),
    ):
        at = next(n for n, r in enumerate(records) if isinstance(r, CycleRecord) and r.step == changed.step)
        records[at] = changed
    _, experiment = recorded(tmp_path, run)
    assert experiment.quality.lacks == {Lack.CONTRADICTED: (2,)}


def test_a_log_without_an_experiment_its_frames_or_a_whole_period_is_refused(
    tmp_path: Path, simulate: Simulate
) -> None:
    none = simulate(square, stop_requested=lambda: True)
    without_frames, without_period = simulate(square, steps=20), simulate(square, steps=20)
    for run, kind, kept in ((without_frames, FrameRecord, 20), (without_period, CycleRecord, 1)):
        numbers = count()
        records = run.journal.records
        records[:] = [record for record in records if not isinstance(record, kind) or next(numbers) < kept]
    for run, why in (
        (none, r"never became active \(INTERRUPTED\)"),
        (without_frames, "the applied currents are not in it"),
        (without_period, "not one complete period"),
    ):
        with pytest.raises(LogError, match=why):
            recorded(tmp_path, run)


N = 23
ASSUMED = np.where(np.isin(np.arange(N), [3, 7, 8, 9, 22]), 0.5, np.nan)


def whole() -> Experiment:
    samples = np.stack([np.arange(1.0, N + 1), np.arange(N) / 7.0], axis=1)
    currents, late = np.sin(np.arange(N)), 1e-6 * np.arange(N, dtype=np.float64)
    return Experiment("x", currents, samples, 0.25, 0.5, 1e-3, False, late, ASSUMED, before=2.0, first=(0.3, 0.6))


def test_parts_follow_each_other() -> None:
    x = whole()
    parts = [*x.split(8)]
    assert [part.periods for part in parts] == [8, 8, 7]
    for name in ("currents", "samples", "late", "assumed"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(x, name))
    assert [(p.before, p.angle, p.velocity, p.first) for p in parts] == [
        (2.0, 0.25, 0.5, (0.3, 0.6)),
        *((float(x.currents[k - 1]), *x.samples[k - 1], tuple(x.samples[k - 1])) for k in (8, 16)),
    ]
    assert [p.slack for p in parts] == [1e-3, 0.0, 0.0]
    np.testing.assert_array_equal(x.until(9).samples, x.samples[:9])


def test_gaps_of_one_period_and_of_several() -> None:
    x = whole()
    assert [gap.tolist() for gap in x.gaps] == [[3, 22], [9]]
    assert np.flatnonzero(x.inside).tolist() == [7, 8]
    assert x.gap_unknowns == 4
    assert np.flatnonzero(~x.reported).tolist() == [3, 7, 8, 9, 22]
    assert x.until(9).gap_unknowns == 3  # a gap that the end cuts to two periods is one of several all the same


def test_a_start_that_may_be_the_origin_is_taken_as_the_origin() -> None:
    x = Experiment("x", np.zeros(2), np.zeros((2, 2)), 0.203, 0.0, 1e-3, False)
    assert x.x0() == (0.203, 0.0)
    assert x.x0(0.2) == (0.0, 0.0)  # within four standard deviations of what the encoder shows there
    assert x.start(0.2)[0] == 0.203 - 0.2


STEPS = 300
BUSES: dict[str, dict[str, Any]] = {
    "quiet": {},
    "lossy": {"lost": 0.02},
    "noisy": {"damaged": 0.02},
    "slow": {"slow": 0.1},
    "all at once": {"lost": 0.01, "damaged": 0.01, "slow": 0.05},
}


def law(_angle: float, _velocity: float, step: float) -> float:
    return 1.5 + math.sin(0.3 * step)


def taken(log: RunLog, layout: Layout, bench: Bench) -> list[SensorSample]:
    """All samples that the runtime's reception takes from the frames in a log."""
    reception = Reception(layout, bench, lambda _frame, _why: None)
    return [sample for frame in log.frames if (sample := reception.add_frame(frame)) is not None]


@pytest.mark.parametrize("bus", BUSES)
@pytest.mark.parametrize("batch", [1, 4 << 20])
def test_the_samples_are_those_that_the_run_took_from_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench, layout: Layout, bus: str, batch: int
) -> None:
    monkeypatch.setattr("emb_bench.logs.log.BATCH", batch)
    run = drive(HostileBus(bench, layout, random.Random(len(bus)), **BUSES[bus]), law, STEPS)
    path = tmp_path / "run.mcap"
    write_trace(path, run.journal.records, bench, layout, run.outcome, steps=STEPS, flush_every=150)
    log = read_log(path)
    every = taken(log, layout, bench)
    first = next(cycle for cycle in run.journal.cycles if cycle.state == RunState.ACTIVE)
    begin = next(n for n, sample in enumerate(every) if sample.device_time_ns == first.device_time_ns)
    rows = [
        row
        for step, samples in control_cycles(log, bench, STEPS)
        for row in zip(*(column.tolist() for column in (step, *samples)), strict=True)
    ]
    assert rows
    assert UNKNOWN not in [row[7] for row in rows]
    t_s = bench.timing.sample_time_ns
    assert [(*row[1:3], row[4], row[7]) for row in rows] == [
        (s.angle, s.velocity, s.applied_current, s.command_counter) for s in every[begin : begin + len(rows)]
    ]
    assert [row[3] for row in rows] == [
        (s.device_time_ns - first.device_time_ns - row[0] * t_s) * 1e-9
        for s, row in zip(every[begin : begin + len(rows)], rows, strict=True)
    ]
    before = samples_before(log, bench, 50)
    expected = every[: begin + 1][-50:]
    assert [(s.angle, s.velocity, s.node_state) for s in before] == [
        (s.angle, s.velocity, s.node_state) for s in expected
    ]


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
