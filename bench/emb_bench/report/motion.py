"""Motion and currents of a run by its log, with the prediction of the estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.study import StudiedRun, Study
from emb_bench.config.bench import Bench
from emb_bench.experiment.experiment import Experiment
from emb_bench.logs import timing
from emb_bench.logs.info import cycle_summary
from emb_bench.logs.log import RunLog
from emb_runtime.errors import LogError
from emb_runtime.records import Reason

Floats = NDArray[np.float64]
REASONS = {
    Reason.CLIPPED: "beyond the bench's current",
    Reason.LIMITED: "kept inside the limits by the shield",
    Reason.RETURNING: "the shield returns home",
    Reason.MISSED: "no sample in time, nothing sent",
    Reason.LEFT: "the needed current is beyond slew or limit: the node brakes",
}
"""Reasons for a difference between sent and requested current, in words."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion and currents of the brake in a run."""

    run: StudiedRun
    bench: Bench
    cycles: ActiveCycles | None  # None if the log has no control cycles, as a recording of others
    after: StopSamples | None  # None if the run was not stopped, or its log has no later samples
    residuals: Floats | None = None
    """In standard deviations, NaN where lost, shape (n, 2); none without an estimate."""
    predicted: Floats | None = None
    """Angle [rad] and velocity [rad/s] that the model predicts at the estimate, shape (n, 2)."""

    @property
    def experiment(self) -> Experiment | None:
        """The experiment, if there is one."""
        return self.run.experiment

    @classmethod
    def of(cls, run: StudiedRun, bench: Bench, study: Study | None = None) -> Self:
        """The motion of a run; with a study also the prediction of its estimate."""
        try:
            cycles: ActiveCycles | None = ActiveCycles(run.log, bench)
        except LogError:
            cycles = None
        if cycles is not None and not len(cycles.time):
            cycles = None
        after = None if run.stop is None else _after(run.log, bench)
        if study is None or run.why_not:
            return cls(run, bench, cycles, after)
        e, number = study.estimate, study.logs.index(run.log)
        # With a start for each window there is no prediction of the run as one.
        predicted = None if e.method == "windows" else e.problem.motion(e.z, number).samples
        return cls(run, bench, cycles, after, e.residuals[number], predicted)


class ActiveCycles:
    """The cycles of an experiment as columns, in order; n of them."""

    def __init__(self, log: RunLog, bench: Bench) -> None:
        """Take them from the log."""
        cycles = log.cycles
        active = timing.in_control(cycles)
        self.time: Floats = cycles["step"][active] * bench.timing.sample_time
        """Time since the run began [s]."""
        self.requested, self.clipped, self.sent = (
            cycles[f"{name}_current"][active] for name in ("policy", "clipped", "sent")
        )
        """Currents [A], NaN where there was none."""
        self.angle, self.velocity = cycles["angle"][active], cycles["velocity"][active]
        """Angle [rad] and velocity [rad/s] in the samples that the loop received."""
        reasons = cycles["reasons"][active]
        self.reasons = {reason: (reasons & reason) != 0 for reason in REASONS}
        """Mask of the cycles with each reason."""
        self.largest = cycle_summary(log).largest
        """Extremes of angle, speed and current, as the command ``info`` gives them."""


@dataclass(frozen=True)
class StopSamples:
    """Samples after the last cycle of a run, while it was stopped and until the recording ended; each over its time."""

    angle: tuple[Floats, Floats]  # Time since the run began [s] and angle [rad]
    velocity: tuple[Floats, Floats]  # Time [s] and velocity [rad/s]
    current: tuple[Floats, Floats]  # Time [s] and current that the node applied [A]

    @property
    def end(self) -> float:
        """Time of the last one [s]."""
        return max((float(time[-1]) for time, _ in (self.angle, self.velocity, self.current) if len(time)), default=0.0)


def _after(log: RunLog, bench: Bench) -> StopSamples | None:
    try:
        cycles = log.cycles
        active = timing.in_control(cycles)
        if not active.any():
            return None
        last, step = int(cycles["publish_time"][active][-1]), float(cycles["step"][active][-1])

        def after(message: str, signal: str) -> tuple[Floats, Floats]:
            table = log.signals(message)
            where = table["publish_time"] > last
            time = step * bench.timing.sample_time + 1e-9 * (table["publish_time"][where] - last)
            return time, np.asarray(table[signal][where], dtype=np.float64)

        found = StopSamples(
            after("EMB_Angle", "Angle"), after("EMB_Velocity", "Velocity"), after("EMB_Velocity", "AppliedCurrent")
        )
    except (LogError, KeyError, TypeError, ValueError):
        return None  # a log without these messages, or with others of their names
    return found if found.end > 0.0 else None
