"""Timing of a run, from the time stamps in its control cycles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import COUNTED, QUANTILE_NAMES, QUANTILES, Budgets
from emb_bench.logs.log import RunLog, Table
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.control.memory import latest_answer_ns
from emb_runtime.records import Reason, RunState

Floats = NDArray[np.float64]

INTERVALS: Mapping[str, str] = {
    "period": "sample to sample",
    "age": "sample to loop",
    "decision": "deciding",
    "sending": "sending",
    "response": "sensor to command",
    "slack": "time to spare",
}
"""The intervals of a :class:`Timing` and their names in text; of the last, small values are the bad ones."""


class DeviceClock(NamedTuple):
    """The node's clock against this computer's: a straight line through the arrivals over its time stamps."""

    drift: float  # Seconds of arrival per second of device time, minus one: positive where the node's clock is slow
    jitter: float  # Standard deviation of the arrivals about the line [s]
    residuals: Floats  # Arrivals minus the line, one per sample [s]


@dataclass(frozen=True, eq=False)
class Timing:
    """The timing of a run's experiment.

    ``period`` and the clock are over all samples, the other intervals over the answered ones.
    """

    simulated: bool  # True if the times are those of a simulation, which are no measure of any computer
    times: Floats  # Arrival times of the answered samples, since the experiment's first sample [s]
    period: Floats  # Times from one sample's arrival to the next one's, where no period was missed between [s]
    age: Floats  # Times from a sample's arrival until the loop had it [s]
    decision: Floats  # Times from there until policy, clip and shield had answered [s]
    sending: Floats  # Times from there until the bus had taken the command [s]
    response: Floats  # Times from a sample's arrival until the bus had taken its answer [s]
    slack: Floats  # Time from the answer to the latest one that would still act in its period [s]
    samples: int  # Samples of the experiment
    missed: int  # Periods without a sample
    unanswered: int  # Samples that got no answer
    not_obeyed: int | None
    """Answers that came too late, as the node counted; None where the log ends before the run does."""
    clock: DeviceClock | None  # None with fewer than three samples

    def interval(self, name: str) -> Floats:
        """One of :data:`INTERVALS` [s]."""
        values: Floats = getattr(self, name)
        return values

    def share(self, name: str) -> float | None:
        """Share of one of :data:`emb_bench.config.bench.COUNTED`, 0..1; None where nothing was counted."""
        count = {"missed": self.missed, "unanswered": self.unanswered, "not_obeyed": self.not_obeyed}[name]
        of = {"missed": self.samples + self.missed, "unanswered": self.samples, "not_obeyed": len(self.response)}[name]
        return None if count is None or of == 0 else count / of


class BudgetCheck(NamedTuple):
    """One budget, and the measured value."""

    name: str  # Interval and quantile, or share: ``response p99.9``, ``missed``
    budget: float  # [s], or a share
    measured: float | None  # None where nothing was measured; then it is not met

    @property
    def met(self) -> bool:
        """True if the run is within the budget."""
        return self.measured is not None and self.measured <= self.budget


def check_budgets(t: Timing, budgets: Budgets) -> list[BudgetCheck]:
    """Every budget beside the measured value of a run."""
    checks = [BudgetCheck(name, budgets.shares[name], t.share(name)) for name in COUNTED if name in budgets.shares]
    for name, limits in budgets.intervals.items():
        found = quantiles(t.interval(name))
        checks += [BudgetCheck(f"{name} {quantile}", limit, found.get(quantile)) for quantile, limit in limits.items()]
    return checks


def timing(log: RunLog) -> Timing:
    """The timing of the experiment, or the way home, in a log; where there was none, its intervals are empty."""
    active = in_control(log.cycles)
    cycles = {name: column[active] for name, column in log.cycles.items()}
    answered = cycles["command_counter"] != NO_COUNTER
    arrival = cycles["receive_time_ns"]
    received, woken, decided, sent = (cycles[f"{at}_time_ns"][answered] for at in ("receive", "wake", "decide", "send"))
    reported = log.end.get("not_obeyed", "")
    return Timing(
        simulated="emb.truth" in log.metadata,
        times=_seconds(received - arrival[:1].sum()),
        period=_seconds(np.diff(arrival)[cycles["missed"][1:] == 0]),
        age=_seconds(woken - received),
        decision=_seconds(decided - woken),
        sending=_seconds(sent - decided),
        response=_seconds(sent - received),
        slack=_seconds(latest_answer_ns(log.bench) - (sent - received)),
        samples=len(arrival),
        missed=int(cycles["missed"].sum()),
        unanswered=int(((cycles["reasons"] & (Reason.MISSED | Reason.LEFT)) != 0).sum()),
        not_obeyed=int(reported) if reported.isascii() and reported.isdigit() and len(reported) < 19 else None,
        clock=_device_clock(cycles["device_time_ns"], arrival),
    )


def in_control(cycles: Table) -> NDArray[np.bool_]:
    """Mask of the control cycles of the experiment, or of the way home, itself."""
    state = cycles["state"]
    mask: NDArray[np.bool_] = ((state == RunState.ACTIVE) | (state == RunState.HOMING)) & (cycles["step"] >= 0)
    return mask


def quantiles(values: Floats) -> dict[str, float]:
    """The :data:`QUANTILES` of an interval; of an empty one, none."""
    if not len(values):
        return {}
    return dict(zip(QUANTILE_NAMES, np.percentile(values, QUANTILES).tolist(), strict=True))


def timing_numbers(t: Timing) -> dict[str, Any]:
    """The timing in numbers [s]; of an interval that nothing was measured of, no quantiles."""
    return {
        "simulated": t.simulated,
        "samples": t.samples,
        "missed_periods": t.missed,
        "unanswered": t.unanswered,
        "not_obeyed": t.not_obeyed,
        "intervals": {name: quantiles(t.interval(name)) for name in INTERVALS},
        "least_slack": float(t.slack.min()) if len(t.slack) else None,
        "clock_drift": None if t.clock is None else t.clock.drift,
        "clock_jitter": None if t.clock is None else t.clock.jitter,
    }


def _device_clock(device_ns: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> DeviceClock | None:
    if len(device_ns) < 3:
        return None
    device, arrival = (_seconds(stamps - stamps[0]) for stamps in (device_ns, arrival_ns))
    device, arrival = device - device.mean(), arrival - arrival.mean()
    spread = float(device @ device)
    if spread == 0.0:
        return None
    # Of the difference, so that drifts of parts per million keep their digits.
    drift = float(device @ (arrival - device)) / spread
    residuals = arrival - device - drift * device
    return DeviceClock(drift, float(np.sqrt(residuals @ residuals / (len(device) - 2))), residuals)


def _seconds(nanoseconds: NDArray[np.int64]) -> Floats:
    return np.asarray(nanoseconds * 1e-9, dtype=np.float64)
