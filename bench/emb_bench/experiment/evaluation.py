"""Fisher information of a recorded experiment about the brake, with one model of it, and the fit of that model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emb_bench.brake.motion import no_sensitivity, rest
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT, RECORDED_PLANT, THESIS_PLANT, Plant
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.fisher import Fisher, Kind, information_over_time, uniform_prior, weights_along
from emb_bench.information.identifiability import Identifiability
from emb_bench.information.symmetric import Floats
from emb_bench.logs.log import RunLog
from emb_bench.sim.instruments import MEMORY, observe, observer_noise, settle
from emb_bench.sim.open_loop import (
    NO_ERRORS,
    SystematicErrors,
    Trajectory,
    check_unknowns,
    fast_loop,
    held,
    show,
    trajectory,
)
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.errors import LogError, UsageError

KINDS: tuple[Kind, ...] = ("physical", "weighted")


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


class ModelEvaluator:
    """Evaluates one model along an experiment, piece by piece.

    A measurement delay of the model shifts what a sample measures: the first ones show the brake before the experiment
    and inform of the encoder's offset and of the start alone. The jitter of the clock makes the standard deviations
    larger where the brake is fast; an observer is run along the plant's own angle. Its noise is coloured, so that its
    mean square scatters more than that of white noise.

    Systematic ``errors`` count in the information and in the fit. The physical information before the first sample is
    ``start``, shape (p, p); the information is kept after the ``instants`` of the ``periods``, in ascending order.
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
        if errors.offset is None:
            errors = errors._replace(offset=plant.instruments.encoder_offset)
        self._bench, self._plant, self._theta, self._errors = bench, plant, theta, errors
        early = ("delay",) if errors.delay < 0.0 and "delay" not in names else ()
        self._unknowns, (self._chosen, begun) = len(names), no_sensitivity((*names, *early))
        x = rest()
        x[:2] = x0
        x[3] = errors.current_offset
        # Those of the instants that the next samples show, up to the one at which the next period begins.
        shown = plant.instruments.measurement_delay + 1
        self._x, self._s = np.repeat(x[None], shown, axis=0), np.repeat(begun[None], shown, axis=0)
        nothing = np.zeros((len(names), len(names)))
        self._totals: dict[Kind, Floats] = {"physical": nothing if start is None else start, "weighted": nothing}
        self._kept: dict[Kind, list[Floats]] = {kind: [np.empty((0, *nothing.shape))] for kind in KINDS}
        self._instants = np.asarray(instants, np.int64)
        self._loop = fast_loop(periods)
        self._done = 0
        self._memory = np.zeros(MEMORY)
        settle(plant.instruments._replace(encoder_offset=self._errors.offset or 0.0), self._memory, x0[0])
        self._squares, self._samples = np.zeros(2), 0

    def take(self, piece: Experiment) -> None:
        """Go through the next periods of the experiment."""
        n, t_s = piece.periods, self._bench.timing.sample_time
        acting = held(piece.currents + self._errors.current_offset, t_s, max(self._errors.delay, 0.0))
        x, moved = trajectory(
            self._loop, self._plant.mechanics, self._theta, acting, self._chosen, self._x[-1], self._s[-1]
        )
        self._x, self._s = np.concatenate([self._x, x[1:]]), np.concatenate([self._s, moved[1:]])
        shown = show(self._x[: n + 1], self._s[: n + 1], self._chosen, self._errors)
        self._x, self._s = self._x[n:], self._s[n:]
        if self._unknowns:
            self._inform(piece, shown)
        self._compare(piece, shown)
        self._done += n

    def _inform(self, piece: Experiment, shown: Trajectory) -> None:
        wanted = self._instants - self._done
        wanted = wanted[(wanted >= 0) & (wanted < piece.periods)]
        for kind in KINDS:
            weights = weights_along(self._bench, kind, self._plant.instruments, shown.states)
            s = shown.sensitivities[:, : self._unknowns]
            history = information_over_time(s, weights, self._totals[kind], piece.measured)
            self._totals[kind] = history[-1]
            self._kept[kind].append(history[wanted])

    def _compare(self, piece: Experiment, shown: Trajectory) -> None:
        """Add up how far the samples lie from what the instruments show of the motion, but for their noise."""
        instruments, t_s = self._plant.instruments, self._bench.timing.sample_time
        jitter_only = instruments._replace(observer_bandwidth=0.0)
        deviations = weights_along(self._bench, "physical", jitter_only, shown.states) ** -0.5
        samples = shown.samples
        if instruments.observer_bandwidth > 0.0:
            observed = [observe(instruments, self._memory, t_s, float(angle)) for angle in samples[:, 0]]
            samples[:, 1] = (1.0 + self._errors.velocity_gain) * np.array(observed)
            deviations[:, 1] = observer_noise(instruments.observer_bandwidth, t_s, 1.0) * deviations[:, 0]
        seen = ((piece.samples - samples) / deviations)[piece.measured]
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


PIECE = 8192  # Periods that are evaluated together
INSTANTS = 1000  # Instants after which the information is kept; of a record that is no longer, after each sample


@dataclass(frozen=True)
class Question:
    """Parameters of interest, nuisance parameters and prior of an evaluation."""

    params: tuple[str, ...] = PARAMETER_NAMES  # The parameters of interest
    nuisances: tuple[str, ...] = ()  # Other unknown parameters, of no interest
    prior: Ranges | None = None  # Ranges of the parameters known before the experiment

    def __post_init__(self) -> None:
        """Check the names."""
        if not any(self.params):
            raise UsageError(f"expected at least one parameter, such as {', '.join(PARAMETER_NAMES)}")
        check_unknowns(self.names)
        if self.prior is not None and not self.varied:
            raise UsageError(f"none of {', '.join(self.names)} varies in the ranges '{self.prior.name}'")

    @property
    def names(self) -> tuple[str, ...]:
        """All unknowns, nuisances last."""
        return (*self.params, *self.nuisances)

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the parameters that the prior is about."""
        p = self.prior
        return tuple(n for n in self.names if p and getattr(p.low, n, 0.0) < getattr(p.high, n, 0.0))

    def start(self, theta: BrakeParameters) -> Floats | None:
        """The prior's Fisher information, relative to ``theta``; zero for what does not vary in it."""
        if self.prior is None:
            return None
        start = np.zeros((len(self.names), len(self.names)))
        index = [self.names.index(name) for name in self.varied]
        start[np.ix_(index, index)] = uniform_prior(self.prior, self.varied, theta)
        return start


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """The Fisher information of one recorded experiment, and how well the model fits."""

    log: RunLog
    bench: Bench
    experiment: Experiment
    plant: Plant  # The model
    theta_name: str
    theta: BrakeParameters  # Parameters at which the information was computed, and to which relative values refer
    errors: SystematicErrors  # Systematic errors that were known besides
    question: Question
    fit: Fit
    instants: Sequence[int]
    """Periods after which the information was kept, the last one among them; all of them if they are not too many."""
    histories: Mapping[Kind, Floats]
    """The FIM after each of them, shape (instants, p, p), by kind; the physical one begins at the prior."""

    def __repr__(self) -> str:
        """Log, model and bounds in one line."""
        bounds = ", ".join(f"{name} {bound:.3g}" for name, bound in self.fisher("physical").cramer_rao().items())
        return f"<Evaluation of {self.log.path.name}: model '{self.plant.name}'; least deviations {bounds}>"

    def __getitem__(self, name: str) -> float:
        """Smallest possible standard deviation of a parameter, relative or in its unit (Cramér-Rao)."""
        return self.fisher("physical").cramer_rao()[name]

    def fisher(self, kind: Kind) -> Fisher:
        """The Fisher information of the whole experiment."""
        asked = self.question
        prior = asked.start(self.theta) if kind == "physical" else None
        matrix = self.histories[kind][-1]
        return Fisher(kind, asked.names, self.theta, matrix, prior, self.plant.name, asked.nuisances)

    def verdict(self) -> Identifiability:
        """Parameters that can be identified from the record, and those that cannot."""
        return self.fisher("physical").verdict(self.question.prior)

    @property
    def absent(self) -> tuple[str, ...]:
        """Unknowns that are zero in the model: relative to zero they have no sensitivity, whatever the brake has."""
        has = self.plant.mechanics._asdict()
        return tuple(name for name in self.question.names if has.get(name) == 0.0)


def evaluate(
    log: RunLog,
    experiment: Experiment,
    bench: Bench,
    plants: Sequence[Plant],
    question: Question,
    theta_name: str,
    theta: BrakeParameters,
    errors: SystematicErrors = NO_ERRORS,
) -> list[Evaluation]:
    """Compute both Fisher informations over time, and how well each model fits; all go through the record together.

    They are those at ``theta``, with the systematic errors of the bench there.
    """
    instants = evenly(experiment.periods, INSTANTS)
    evaluators = [
        ModelEvaluator(
            bench,
            plant,
            theta,
            experiment.x0(plant.instruments.encoder_offset if errors.offset is None else errors.offset),
            errors=errors,
            names=question.names,
            start=question.start(theta),
            periods=experiment.periods * len(plants),
            instants=instants,
        )
        for plant in plants
    ]
    for piece in experiment.split(PIECE):
        for evaluator in evaluators:
            evaluator.take(piece)
    return [
        Evaluation(log, bench, experiment, plant, theta_name, theta, errors, question, p.fit, instants, p.histories)
        for plant, p in zip(plants, evaluators, strict=True)
    ]


def evenly(count: int, most: int) -> list[int]:
    """Indices of at most ``most`` of ``count`` samples, evenly spread, the last one among them."""
    if count <= most:
        return list(range(count))
    return sorted({math.ceil(count * i / most) - 1 for i in range(1, most + 1)})


def default_model(log: RunLog) -> tuple[str, str]:
    """Name of the default model to evaluate a log with, and the reason for it."""
    if log.true_plant is not None:
        return log.true_plant, "it was simulated"
    if log.truth is not None:
        return THESIS_PLANT, "it was simulated, by a version that knew no other"
    if log.is_recording:
        return RECORDED_PLANT, "it is a recording of others"
    return DEFAULT_PLANT, "the log does not say what moved"


def check_sample_time(log: RunLog, bench: Bench) -> None:
    """Refuse a log whose own bench file states another sample time than a bench.

    A log without a readable bench file is taken to be on this bench's grid.
    """
    with suppress(LogError):
        if (its := log.bench.timing.sample_time) != (ours := bench.timing.sample_time):
            raise UsageError(f"{log.path}: expected a sample time of {ours:g} s, as in the bench file, got {its:g} s")


def bench_for(log: RunLog, path: str | Path | None) -> Bench:
    """The bench file inside a log, or another one with the same sample time."""
    if path is None:
        return log.bench
    bench = load_bench(path, analysis=True)
    check_sample_time(log, bench)
    return bench
