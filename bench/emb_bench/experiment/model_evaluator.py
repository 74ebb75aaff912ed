"""A model of the brake driven through an experiment, piece by piece: its Fisher information and its fit.

Nothing is kept from one piece to the next but the state of the model, the sums and the information at the instants
that were requested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats, no_sensitivity, rest
from emb_bench.brake.parameters import DELAY, OFFSET, VELOCITY_GAIN
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.fisher import Kind, information_over_time, weights_along
from emb_bench.sim.instruments import MEMORY, observe, observer_noise, settle
from emb_bench.sim.open_loop import fast_loop, held, trajectory
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.config.plants import Plant

KINDS: tuple[Kind, ...] = ("physical", "weighted")


class SystematicErrors(NamedTuple):
    """Systematic errors of bench and sensors, beyond those that belong to the plant."""

    offset: float | None = None  # Reading of the encoder at the origin [rad]; None takes the plant's
    current_offset: float = 0.0  # Current that acts beyond what the node reports [A]
    delay: float = 0.0  # By which commands act late [samples], above -1 and below 1; below 0, samples are late
    velocity_gain: float = 0.0  # Relative error of the velocity's scale


NO_ERRORS = SystematicErrors()


@dataclass(frozen=True)
class Fit:
    """Distance of a record from a model's trajectory: root mean square, in the instruments' standard deviations.

    For a correct model and the stated noise, the expected value is 1.
    """

    angle: float
    velocity: float
    samples: int

    @property
    def expected(self) -> float:
        """Limit that a correct model exceeds once in a billion times."""
        return 1.0 + 6.0 / math.sqrt(2.0 * max(self.samples, 1))

    @property
    def fits(self) -> bool:
        """True if there are samples, and they differ no more than the sensors' noise explains."""
        return self.samples > 0 and self.angle <= self.expected and self.velocity <= self.expected  # not with NaN

    @property
    def loose(self) -> bool:
        """True if they differ so little that the model expects more noise than there is."""
        return self.fits and min(self.angle, self.velocity) < 2.0 - self.expected


class _DelayLine:
    """Rows that are seen some samples later; until then the first ones are what was seen ``before``."""

    def __init__(self, delay: int) -> None:
        self._delay = delay
        self._waiting: Floats | None = None

    def __call__(self, rows: Floats, before: Floats) -> Floats:
        if self._waiting is None:
            self._waiting = np.repeat(before, self._delay, axis=0)
        every = np.concatenate([self._waiting, rows])
        self._waiting = every[len(rows) :]
        return every[: len(rows)]


def later(samples: Floats, delay: int, before: Floats | None = None) -> Floats:
    """Samples as they are seen ``delay`` samples later.

    Args:
        samples: shape (n, ...).
        delay: whole samples.
        before: what is seen until then, shape (1, ...); the first sample without it.
    """
    return _DelayLine(delay)(samples, samples[:1] if before is None else before)


class ModelEvaluator:
    """Evaluates one model along an experiment, piece by piece.

    A measurement delay of the model shifts what a sample measures: the first ones show the brake before the experiment
    and carry no information. The jitter of the clock makes the standard deviations larger where the brake is fast;
    an observer is run along the plant's own angle. Its noise is coloured, so that its mean square scatters more than
    that of white noise.

    Args:
        bench: noise, limits and sample time.
        plant: how the brake moves, and what lies between it and the bus.
        theta: its parameters.
        x0: true angle [rad] and velocity [rad/s] at the start.
        errors: systematic errors besides; they count in the information and in the fit.
        names: the unknowns.
        start: the physical information before the first sample, shape (p, p); none without.
        periods: how long the whole experiment is.
        instants: periods after which the information is to be kept, in ascending order.
    """

    def __init__(
        self,
        bench: Bench,
        plant: Plant,
        theta: BrakeParameters,
        x0: tuple[float, float],
        *,
        errors: SystematicErrors = NO_ERRORS,
        names: Sequence[str] = (),
        start: Floats | None = None,
        periods: int = 0,
        instants: Sequence[int] = (),
    ) -> None:
        if errors.offset is not None:
            plant = replace(plant, instruments=plant.instruments._replace(encoder_offset=errors.offset))
        self._bench, self._plant, self._theta, self._errors = bench, plant, theta, errors
        self._unknowns = len(names)
        early = ("delay",) if errors.delay < 0.0 else ()
        self._chosen, self._s = no_sensitivity((*names, *early))
        self._x = rest()
        self._x[:2] = x0
        self._x[3] = errors.current_offset
        nothing = np.zeros((len(names), len(names)))
        self._totals: dict[Kind, Floats] = {"physical": nothing if start is None else start, "weighted": nothing}
        self._kept: dict[Kind, list[Floats]] = {kind: [np.empty((0, *nothing.shape))] for kind in KINDS}
        self._instants = np.asarray(instants, np.int64)
        self._loop = fast_loop(periods)
        self._done = 0
        delay = plant.instruments.measurement_delay
        self._lines = {name: _DelayLine(delay) for name in (*KINDS, "sensitivities", "shown", "deviations")}
        self._memory = np.zeros(MEMORY)
        settle(plant.instruments, self._memory, x0[0])
        self._squares, self._samples = np.zeros(2), 0

    def take(self, piece: Experiment) -> None:
        """Go through the next periods of the experiment."""
        chosen, mechanics, t_s = self._chosen, self._plant.mechanics, self._bench.timing.sample_time
        currents, late = piece.currents + self._errors.current_offset, max(self._errors.delay, 0.0)
        acting = held(currents, t_s, late)
        x, moved = trajectory(self._loop, mechanics, self._theta, acting, chosen, self._x, self._s)
        self._x, self._s = x[-1], moved[-1]
        states, s = x[:, :2].copy(), moved[1:, : self._unknowns, :2].copy()
        if self._errors.delay < 0.0:  # to first order: what acts early does so by thousandths of a period
            states += self._errors.delay * moved[:, -1, :2]
        chosen = chosen[: self._unknowns]
        s[:, chosen == DELAY] /= 1.0 - late
        s[:, chosen == OFFSET, 0] += 1.0
        s[:, :, 1] *= 1.0 + self._errors.velocity_gain
        s[:, chosen == VELOCITY_GAIN, 1] += states[1:, 1:2]
        if len(chosen):
            self._inform(piece, states, self._lines["sensitivities"](s, np.zeros_like(s[:1])))
        self._compare(piece, states)
        self._done += len(piece.currents)

    def _inform(self, piece: Experiment, states: Floats, s: Floats) -> None:
        wanted = self._instants - self._done
        wanted = wanted[(wanted >= 0) & (wanted < len(s))]
        for kind in KINDS:
            weights = weights_along(self._bench, kind, self._plant.instruments, states)
            seen = self._lines[kind](weights, weights[:1])
            history = information_over_time(s, seen, self._totals[kind], piece.measured)
            self._totals[kind] = history[-1]
            self._kept[kind].append(history[wanted])

    def _compare(self, piece: Experiment, states: Floats) -> None:
        """Add up how far the samples lie from what the instruments show of the motion, but for their noise."""
        instruments, t_s = self._plant.instruments, self._bench.timing.sample_time
        offset = np.array([instruments.encoder_offset, 0.0])
        shown = states[1:] + offset
        jitter_only = instruments._replace(observer_bandwidth=0.0)
        deviations = weights_along(self._bench, "physical", jitter_only, states) ** -0.5
        if instruments.observer_bandwidth > 0.0:
            shown[:, 1] = [observe(instruments, self._memory, t_s, float(angle)) for angle in shown[:, 0]]
            deviations[:, 1] = observer_noise(instruments.observer_bandwidth, t_s, 1.0) * deviations[:, 0]
        shown = self._lines["shown"](shown, states[:1] + offset)
        shown[:, 1] *= 1.0 + self._errors.velocity_gain
        deviations = self._lines["deviations"](deviations, deviations[:1])
        seen = ((piece.samples - shown) / deviations)[piece.measured]
        self._squares += np.sum(seen**2, axis=0)
        self._samples += len(seen)

    @property
    def fit(self) -> Fit:
        """Fit of the model to the samples so far."""
        angle, velocity = np.sqrt(self._squares / max(self._samples, 1)).tolist()
        return Fit(angle, velocity, self._samples)

    @property
    def histories(self) -> Mapping[Kind, Floats]:
        """The information after each of the instants, shape (instants, p, p), by kind."""
        return {kind: np.concatenate(parts) for kind, parts in self._kept.items()}
