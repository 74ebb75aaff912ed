"""The experiment inside a log: which current acted in which period, and what was measured at its end.

The node's own time stamps say which period is which. What acted is what the node reports at the period's end, which is
exact, also where commands act late: it obeys and reports currents in the steps of the CAN signal. The frames are taken
through the very reception that the run used, so that a sample is one here exactly if it was one there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.information import weights_along
from emb_bench.instruments import MEMORY, observe, observer_noise, settle
from emb_bench.log import RunLog
from emb_bench.sensitivity import simulate
from emb_runtime.bench import Bench, BrakeParameters
from emb_runtime.e2e import NO_COUNTER
from emb_runtime.errors import FrameError, LogError
from emb_runtime.plants import LONGEST_DELAY, Instruments, Plant
from emb_runtime.reception import Reception
from emb_runtime.records import CurrentCommand, NodeState, RunState, SensorSample

REST_SAMPLES = 50
"""Most samples before the experiment that say where the brake rested."""
REST_SIGMAS = 4.0
"""A mean that lies this near to zero, in its own standard deviations, is taken as zero: the origin, at rest."""


class Rest(NamedTuple):
    """Where the brake was before the experiment, as far as the samples tell."""

    angle: float
    """Measured [rad]."""
    velocity: float
    """Measured [rad/s]; 0 if the brake rested."""
    slack: float
    """The angle is not known any better [rad]."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """n sampling periods and the n + 1 samples around them; period k begins at sample k."""

    planned: int
    """Periods that the run was to have."""
    currents: NDArray[np.float64]
    """What acted in each period [A], shape (n,)."""
    known: NDArray[np.bool_]
    """Whether the node reported it; else it is what must be assumed, shape (n,)."""
    braked: int
    """Periods that the node braked by itself because no command came in time."""
    measured: NDArray[np.bool_]
    """Whether the sample at each period's end was received, shape (n,)."""
    angle: NDArray[np.float64]
    """Measured [rad], NaN where the sample was lost, shape (n + 1,)."""
    velocity: NDArray[np.float64]
    """Measured [rad/s], NaN where the sample was lost, shape (n + 1,)."""
    device_time_ns: NDArray[np.int64]
    """The node's own time since sample 0, on the grid where the sample was lost [ns], shape (n + 1,)."""
    before: Rest
    """From the samples before sample 0."""
    command_delay: int
    """Samples by which commands acted late, as the node's reports tell."""
    missing: tuple[str, ...]
    """What is not there, or not to be trusted, in words."""

    def x0(self, encoder_offset: float = 0.0) -> tuple[float, float]:
        """True angle [rad] and velocity [rad/s] at sample 0; an angle that may be the origin is taken as the origin.

        Args:
            encoder_offset: what the encoder shows at the origin [rad].
        """
        angle = self.before.angle - encoder_offset
        return (0.0 if abs(angle) <= self.before.slack else angle), self.before.velocity


@dataclass(frozen=True)
class Fit:
    """How far a record lies from a model's trajectory: root mean square, in the instruments' standard deviations.

    Of the right model, and noise as the bench file says, both are 1 but for chance.
    """

    angle: float
    velocity: float
    samples: int

    @property
    def expected(self) -> float:
        """What the right model stays below, but for one time in a billion."""
        return 1.0 + 6.0 / math.sqrt(2.0 * max(self.samples, 1))

    @property
    def fits(self) -> bool:
        """Whether there are differences, and they are no larger than those of the sensors' noise."""
        return self.samples > 0 and self.angle <= self.expected and self.velocity <= self.expected  # not with NaN

    @property
    def loose(self) -> bool:
        """Whether they are so small that the model expects more noise than there is."""
        return self.fits and min(self.angle, self.velocity) < 2.0 - self.expected


def read_experiment(log: RunLog, bench: Bench | None = None) -> Experiment:
    """Find the experiment in a log.

    Args:
        log: the log.
        bench: used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left.
    """
    bench = log.bench if "bench.toml" in log.attachments or bench is None else bench
    period_ns = bench.timing.sample_time_ns
    samples, commands = _replayed(log, bench)
    origin_ns, count = _grid(log, samples, period_ns)
    steps = {s.receive_time_ns: round((s.device_time_ns - origin_ns) / period_ns) for s in samples}
    grid = {steps[s.receive_time_ns]: s for s in samples}
    before = [s for s in samples if steps[s.receive_time_ns] <= 0][-REST_SAMPLES:]
    answers = {steps[when]: command for when, command in commands.items()}

    angle, velocity = np.full(count + 1, np.nan), np.full(count + 1, np.nan)
    device_time_ns = np.arange(count + 1, dtype=np.int64) * period_ns
    for k in range(count + 1):
        if (sample := grid.get(k)) is not None:
            angle[k], velocity[k] = sample.angle, sample.velocity
            device_time_ns[k] = sample.device_time_ns - origin_ns
    measured = np.isfinite(angle[1:])
    disagreements = [_disagreements(grid, answers, count, delay) for delay in range(LONGEST_DELAY + 1)]
    delay = int(np.argmin(disagreements))
    currents = np.empty(count)
    for k in range(count):
        acts = answers.get(k - delay)
        currents[k] = grid[k + 1].applied_current if measured[k] else _assumed(bench, acts, velocity[: k + 1])
    planned = int(log.run["steps"]) if log.run.get("steps", "").isdecimal() else bench.timing.horizon
    return Experiment(
        planned=planned,
        currents=currents,
        known=measured.copy(),
        braked=sum(grid[k + 1].command_counter == NO_COUNTER for k in range(count) if measured[k]),
        measured=measured,
        angle=angle,
        velocity=velocity,
        device_time_ns=device_time_ns,
        before=_rest(before, bench),
        command_delay=delay,
        missing=tuple(_missing(count, planned, measured, disagreements[delay])),
    )


def fit(experiment: Experiment, bench: Bench, theta: BrakeParameters, plant: Plant) -> Fit:
    """Compare what was measured with what a plant's instruments would show of it under the same currents.

    The jitter of the clock makes the standard deviations larger where the brake is fast; an observer is run along the
    plant's own angle. Its noise is coloured, so that its mean square scatters more than that of white noise.

    Args:
        experiment: what acted and what was measured.
        bench: its noise and sample time.
        theta: the brake's parameters.
        plant: how it moves, and what lies between it and the bus.
    """
    instruments, t_s = plant.instruments, bench.timing.sample_time
    x0 = experiment.x0(instruments.encoder_offset)
    states = simulate(plant.mechanics, theta, experiment.currents, t_s, (), x0).states
    shown, deviations = _shown(bench, instruments, states)
    differences = (np.stack([experiment.angle, experiment.velocity], axis=1)[1:] - shown) / deviations
    seen = differences[experiment.measured]
    return Fit(_root_mean_square(seen[:, 0]), _root_mean_square(seen[:, 1]), len(seen))


def _shown(bench: Bench, instruments: Instruments, states: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """What the instruments show of a motion but for noise, and its standard deviations, each of shape (n, 2)."""
    t_s, offset = bench.timing.sample_time, np.array([instruments.encoder_offset, 0.0])
    shown = states[1:] + offset
    jitter_only = instruments._replace(observer_bandwidth=0.0)
    deviations = weights_along(bench, "physical", jitter_only, states) ** -0.5
    if instruments.observer_bandwidth > 0.0:
        memory = np.zeros(MEMORY)
        settle(instruments, memory, float(states[0, 0]))
        shown[:, 1] = [observe(instruments, memory, t_s, float(angle)) for angle in shown[:, 0]]
        deviations[:, 1] = observer_noise(instruments.observer_bandwidth, t_s, 1.0) * deviations[:, 0]
    delay = instruments.measurement_delay
    return later(shown, delay, states[:1] + offset), later(deviations, delay)


def later(samples: NDArray[np.float64], delay: int, before: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Samples as they are seen ``delay`` samples later.

    Args:
        samples: shape (n, ...).
        delay: whole samples.
        before: what is seen until then, shape (1, ...); the first sample without it.
    """
    first = samples[:1] if before is None else before
    result: NDArray[np.float64] = np.concatenate([np.repeat(first, delay, axis=0), samples])[: len(samples)]
    return result


def _root_mean_square(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _replayed(log: RunLog, bench: Bench) -> tuple[list[SensorSample], dict[int, CurrentCommand]]:
    """The samples, and the commands by the receive time of the sample that each answered."""
    layout = log.layout
    reception = Reception(layout, bench, lambda _frame, _why: None)
    samples: list[SensorSample] = []
    recent: dict[int, SensorSample] = {}
    commands: dict[int, CurrentCommand] = {}
    for frame in log.frames:
        if (sample := reception.take(frame)) is not None:
            samples.append(sample)
            recent[sample.counter] = sample
        elif frame.own and frame.identifier == layout.command.identifier:
            try:
                command = layout.decode_command(frame)
            except FrameError:
                continue
            if command.enable and command.answers in recent:
                commands[recent[command.answers].receive_time_ns] = command
    return samples, commands


def _grid(log: RunLog, samples: list[SensorSample], period_ns: int) -> tuple[int, int]:
    """Device time of sample 0 [ns], and the number of periods."""
    cycles = log.cycles
    active = (cycles["state"] == RunState.ACTIVE) & (cycles["step"] >= 0)
    if not active.any():
        raise LogError(
            f"{log.path}: no experiment in this log: {log.missing or f'it never became active ({log.exit_reason})'}"
        )
    count = int(cycles["step"][active].max())
    if count < 1:
        raise LogError(f"{log.path}: not one whole period of the experiment is left")
    by_time = {sample.receive_time_ns: sample for sample in samples}
    for step, when in zip(cycles["step"][active].tolist(), cycles["receive_time_ns"][active].tolist(), strict=True):
        if (sample := by_time.get(when)) is not None:
            return sample.device_time_ns - step * period_ns, count
    raise LogError(f"{log.path}: the frames of the experiment are missing: what acted is not known")


def _assumed(bench: Bench, command: CurrentCommand | None, velocity: NDArray[np.float64]) -> float:
    """What most likely acted in a period whose report is missing: the command, else what the node does by itself."""
    if command is not None:
        return command.current
    seen = velocity[np.isfinite(velocity)]
    if bench.node.stop == "freewheel" or not len(seen):
        return 0.0
    limit = bench.limits.current
    return float(np.clip(-limit * seen[-1] / bench.node.damping_velocity, -limit, limit))


def _rest(before: list[SensorSample], bench: Bench) -> Rest:
    """Where the brake was. One that rests has rested since the node was idle, so its samples are averaged."""
    rest = [s for s in before if s.node_state is NodeState.IDLE] or before
    if not rest:
        return Rest(0.0, 0.0, 0.0)
    slack = REST_SIGMAS / math.sqrt(len(rest))
    velocity = float(np.mean([s.velocity for s in rest]))
    if abs(velocity) > slack * bench.noise.velocity:
        return Rest(rest[-1].angle, rest[-1].velocity, 0.0)
    return Rest(float(np.mean([s.angle for s in rest])), 0.0, slack * bench.noise.angle)


def _disagreements(grid: dict[int, SensorSample], answers: dict[int, CurrentCommand], count: int, delay: int) -> int:
    """Periods whose report does not name the command that was sent for them, or another current than the one to act.

    That is the command of ``delay`` periods before. What the node does where there was none is its own affair.
    """
    wrong = 0
    for k in range(count):
        sample, command, acts = grid.get(k + 1), answers.get(k), answers.get(k - delay)
        if sample is None or sample.command_counter == NO_COUNTER:
            continue
        # Both currents are the same multiple of one step.
        obeyed = command is not None and command.counter == sample.command_counter
        agrees = acts is None or abs(acts.current - sample.applied_current) <= 1e-9
        if not obeyed or not agrees:
            wrong += 1
    return wrong


def _missing(count: int, planned: int, measured: NDArray[np.bool_], disagreements: int) -> list[str]:
    missing = []
    if count < planned:
        missing.append(f"the experiment ends after {count} of {planned} samples")
    if lost := int((~measured).sum()):
        missing.append(
            f"{lost} samples were lost: they count for no information, and what acted in the periods before them is "
            "taken from the commands, or from the node's braking where there was none"
        )
    if disagreements:
        missing.append(f"in {disagreements} periods the node reports another current than the command says")
    return missing
