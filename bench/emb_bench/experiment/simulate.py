"""The model of an experiment: samples of a brake under its currents by its instruments, and their sensitivities.

Information, fits, score tests, held-out predictions, the check of a design and commissioning all use :func:`simulate`.
It includes late commands, an unknown place of contact, gaps in the reports, the lateness of samples, and errors of the
sensors. A filter corrects the state between two samples, so it has a loop of its own
(:mod:`emb_bench.estimate.innovations`), with the same function for a period and the same
:func:`emb_bench.sim.instruments.reading`.

**Gaps.** The current of a single period without report is an unknown. After several such periods in a row the state is
set to the next sample, and its angle and velocity are unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import SENSITIVE, Floats, Integers, no_sensitivity, rest
from emb_bench.brake.parameters import COMMAND, DELAY
from emb_bench.config.plants import Instruments, Plant
from emb_bench.experiment.experiment import Experiment
from emb_bench.sim.instruments import reading, sensor_share
from emb_bench.sim.open_loop import Input, check_unknowns, delay_share, march, march_shares, trajectory, zero_order_hold
from emb_runtime.config.bench import BrakeParameters


class SystematicErrors(NamedTuple):
    """Systematic errors of bench and sensors, beyond those that belong to the plant."""

    offset: float | None = None  # Reading of the encoder at the origin [rad]; None takes the plant's
    current_offset: float = 0.0  # Applied current less the reported one [A]
    delay: float = 0.0  # Delay of commands [samples], above -1 and below 1; below 0 samples are late
    velocity_gain: float = 0.0  # Relative error of the velocity's scale


NO_ERRORS = SystematicErrors()


class Theta(NamedTuple):
    """Parameters, start and errors that determine motion and samples, besides the currents."""

    brake: BrakeParameters
    start: tuple[float, float] = (0.0, 0.0)  # Angle [rad] and velocity [rad/s] before the first period
    errors: SystematicErrors = NO_ERRORS
    contact: float = 0.0  # Angle at which the clamping begins [rad]

    def offset(self, plant: Plant) -> float:
        """Reading of the encoder at the origin [rad]."""
        return plant.instruments.encoder_offset if self.errors.offset is None else self.errors.offset

    def begin(self, before: float, params: Sequence[str]) -> tuple[Floats, Integers, Floats]:
        """State after a current ``before`` [A], indices of the unknowns, sensitivities to them.

        In the form of :func:`emb_bench.brake.motion.advance`. A shift of the contact shifts the angle and changes
        nothing else.
        """
        x = rest()
        x[0], x[1], x[3] = self.start[0] - self.contact, self.start[1], before + self.errors.current_offset
        return x, *no_sensitivity(params)


class Trajectory(NamedTuple):
    """Motion of a brake, its samples without noise, and their sensitivities."""

    states: Floats
    """Angle [rad] and velocity [rad/s] at the n + 1 instants that the samples y_0..y_n show, shape (n + 1, 2)."""
    samples: Floats  # Samples y_1..y_n: angle [rad] and velocity [rad/s], shape (n, 2)
    sensitivities: Floats
    """Of the samples to the parameters, then to the gap unknowns, shape (n, unknowns, 2).

    Relative for the brake's parameters, θ_i ∂y/∂θ_i at its θ (eq. 4.17); per unit for those in ``UNITS``, for the
    current of a single lost report [A], and for angle and velocity after a longer gap.
    """


def simulate(
    plant: Plant,
    theta: Theta,
    experiment: Experiment,
    t_s: float,
    params: Sequence[str] = (),
    loop: Callable[..., None] = march,
) -> Trajectory:
    """Simulates an experiment of n periods of ``t_s`` [s] with a plant's instruments; limits are not applied.

    ``params`` are any of ``PARAMETERS`` in any order; none gives the samples alone. ``loop`` is
    :func:`emb_bench.sim.open_loop.march`, as it is or compiled.
    """
    return next(simulate_parts(plant, theta, (experiment,), t_s, params, loop))


def simulate_parts(
    plant: Plant,
    theta: Theta,
    parts: Sequence[Experiment],
    t_s: float,
    params: Sequence[str] = (),
    loop: Callable[..., None] = march,
) -> Iterator[Trajectory]:
    """As :func:`simulate`, an experiment in parts one after the other, so that it takes little memory.

    If there are several parts, none may have a gap.
    """
    check_unknowns(params)
    errors, delay = theta.errors, plant.instruments.measurement_delay
    # A negative delay is linearised, which needs its sensitivity.
    early = ("delay",) if errors.delay < 0.0 and "delay" not in params else ()
    x, indices, s = theta.begin(parts[0].before, (*params, *early))
    if delay:  # states of the delayed samples; the start, until the delay has passed
        waiting = (
            np.repeat(x[None], delay, axis=0),
            np.pad(np.repeat(s[None], delay, axis=0), ((0, 0), (0, parts[0].gap_unknowns), (0, 0))),
        )
    for part in parts:
        acting = _acting(plant, theta, part, t_s)
        states, moved = trajectory(loop, plant.mechanics, theta.brake, acting, indices, x, s)
        x, s, n = states[-1], moved[-1], part.periods
        if delay:
            states, moved = (np.concatenate(both) for both in zip(waiting, (states, moved), strict=True))
            waiting = states[n:-1], moved[n:-1]
        unknowns = np.append(indices, np.full(part.gap_unknowns, COMMAND))
        shown = _shown(states[: n + 1], moved[: n + 1], unknowns, theta, theta.offset(plant), part.late, t_s)
        if early:
            shown = shown._replace(sensitivities=np.delete(shown.sensitivities, len(params), axis=1))
        yield shown


def simulate_shares(
    plant: Plant,
    theta: Theta,
    experiment: Experiment,
    t_s: float,
    unknowns: Integers,
    shares: Floats,
    loop: Callable[..., None] = march_shares,
) -> Floats:
    """Sensitivities of the samples to unknowns with weights in each period, the ``shares``, shape (n, m, 2).

    The unknowns are indices in ``PARAMETERS``, or ``COMMAND``; the shares have the shape (n, m).
    """
    (x, _, _), delay = theta.begin(experiment.before, ()), plant.instruments.measurement_delay
    states, s = np.tile(x, (len(shares) + 1, 1)), np.zeros((len(shares) + 1, len(unknowns), SENSITIVE))
    loop(plant.mechanics, theta.brake, _acting(plant, theta, experiment, t_s), unknowns, shares, states, s)
    rows = later(states, delay), later(s, delay)
    return _shown(*rows, unknowns, theta, theta.offset(plant), experiment.late, t_s).sensitivities


def _acting(plant: Plant, theta: Theta, experiment: Experiment, t_s: float) -> Input:
    """Currents of an experiment, and where its gaps end."""
    breaks, places = gap_ends(experiment, plant.instruments)
    currents, late = experiment.currents + theta.errors.current_offset, max(theta.errors.delay, 0.0)
    return Input(currents, t_s, late, experiment.gaps[0], breaks, places - [theta.contact, 0.0])


def simulate_apart(
    plant: Plant,
    theta: Theta,
    windows: Sequence[Experiment],
    starts: Floats,
    t_s: float,
    params: Sequence[str],
    loop: Callable[..., None],
) -> Trajectory:
    """As :func:`simulate`, independent experiments without gaps, rows stacked.

    Each begins at its row of ``starts``, angle [rad] and velocity [rad/s], shape (m, 2).
    """
    errors, delay = theta.errors, plant.instruments.measurement_delay
    early = ("delay",) if errors.delay < 0.0 and "delay" not in params else ()
    ends = np.cumsum([window.periods + 1 for window in windows])
    first = np.append(0, ends[:-1])
    origin, indices, s = theta.begin(0.0, (*params, *early))
    states, moved = np.zeros((ends[-1], len(origin))), np.zeros((ends[-1], *s.shape))
    states[first], moved[first] = origin, s
    states[first, :2] = starts - [theta.contact, 0.0]
    states[first, 3] += [window.before for window in windows]
    late, late_by = np.zeros(ends[-1]), max(errors.delay, 0.0)
    for window, a, b in zip(windows, first.tolist(), ends.tolist(), strict=True):
        acting = zero_order_hold(window.currents + errors.current_offset, t_s, late_by)
        loop(plant.mechanics, theta.brake, acting, indices, states[a:b], moved[a:b])
        if window.late is not None:
            late[a + 1 : b] = window.late
    if delay:
        seen = np.maximum(np.arange(ends[-1]) - delay, np.repeat(first, np.diff(ends, prepend=0)))
        states, moved = states[seen], moved[seen]
    shown = _shown(states, moved, indices, theta, theta.offset(plant), late[1:], t_s)
    real = np.delete(np.arange(ends[-1]), first) - 1  # no sample is between the end of one and the start of the next
    return Trajectory(shown.states, shown.samples[real], shown.sensitivities[real, : len(params)])


def gap_ends(experiment: Experiment, instruments: Instruments) -> tuple[Integers, Floats]:
    """Periods at whose ends the state is set after longer gaps, and that state: angle [rad], velocity [rad/s].

    They are those of the first sample after the gap, not one period earlier: integration back through a standstill
    cannot recover the velocity. The state is the estimated one, or else the measured one.
    """
    delay, last = instruments.measurement_delay, experiment.periods - 1
    breaks = np.minimum(experiment.gaps[1] + int(delay == 0), last)
    if experiment.places is not None:
        return breaks, experiment.places
    if not len(breaks):
        return breaks, np.zeros((0, 2))
    measured = experiment.samples[np.minimum(breaks + delay, last)]
    return breaks, np.nan_to_num(measured) - [instruments.encoder_offset, 0.0]


def later(rows: Floats, delay: int) -> Floats:
    """Rows, shape (n, ...), delayed by ``delay`` rows; until then the first one."""
    return np.concatenate([np.repeat(rows[:1], delay, axis=0), rows])[: len(rows)]


def _shown(
    x: Floats, s: Floats, unknowns: Integers, theta: Theta, offset: float, late: Floats | None, t_s: float
) -> Trajectory:
    """Samples along the states ``x`` of n + 1 instants, with their sensitivities ``s``.

    A delay of the commands is already in the states. Each sample is taken ``late`` [s] after its period, shape (n,).
    """
    delay, scale = theta.errors.delay, 1.0 + theta.errors.velocity_gain
    states, shares = x[:, :2] + [theta.contact, 0.0], s[:, :, :2].copy()
    shares[:, unknowns == DELAY] /= delay_share(DELAY, max(delay, 0.0))
    if delay < 0.0:
        states += delay * shares[:, np.argmax(unknowns == DELAY)]
    stamps = np.zeros(len(states) - 1) if late is None else late
    acceleration = np.diff(states[:, 1]) / t_s
    samples = np.stack(reading(states[1:, 0], states[1:, 1], acceleration, stamps, offset, scale), axis=1)
    angle, velocity = shares[1:, :, 0], shares[1:, :, 1]
    sensitivities = np.stack([angle + stamps[:, None] * velocity, scale * velocity], axis=2)
    for i, unknown in enumerate(unknowns.tolist()):
        for output in range(2):
            sensitivities[:, i, output] += sensor_share(unknown, output, samples[:, output] / scale)
    return Trajectory(states, samples, sensitivities)
