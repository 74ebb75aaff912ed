"""Fisher information of recorded or planned experiments, for one model of the brake, and the fit of that model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.brake.parameters import OF_AN_EXPERIMENT, PARAMETERS
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT, RECORDED_PLANT, THESIS_PLANT, Plant
from emb_bench.documents import ByName
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import NO_ERRORS, SystematicErrors, Theta, Trajectory, simulate, simulate_parts
from emb_bench.information.fisher import Fisher, Kind, information_over_time, uniform_prior, weights_along
from emb_bench.information.identifiability import Identifiability, schur_complement
from emb_bench.information.symmetric import Floats
from emb_bench.logs.estimates import LOG
from emb_bench.logs.log import RunLog
from emb_bench.numbers import relative
from emb_bench.sim.open_loop import check_unknowns, fast_loop
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.errors import LogError, UsageError, needs
from emb_runtime.estimator.estimate import NORMAL_95

KINDS: tuple[Kind, ...] = ("physical", "weighted")


@dataclass(frozen=True)
class Fit:
    """Distance of a record from a model's trajectory: root mean square, in the instruments' standard deviations.

    For a correct model and the stated noise, the expected value is 1.
    """

    angle: float
    velocity: float | None  # None of an observer's velocity, which is not measured
    samples: int

    @property
    def expected(self) -> float:
        """Limit that a correct model exceeds once in a billion times."""
        return 1.0 + 6.0 / math.sqrt(2.0 * max(self.samples, 1))

    @property
    def compared(self) -> tuple[float, ...]:
        """The distances of the measured outputs."""
        return (self.angle,) if self.velocity is None else (self.angle, self.velocity)

    @property
    def fits(self) -> bool:
        """True if there are samples, and they differ no more than the sensors' noise explains."""
        return self.samples > 0 and all(each <= self.expected for each in self.compared)  # not with NaN


PIECE = 8192  # Periods that are evaluated together
INSTANTS = 1000  # Most instants of the information over time


def information_and_fit(
    bench: Bench,
    plant: Plant,
    theta: Theta,
    experiment: Experiment,
    names: Sequence[str] = (),
    start: Floats | None = None,
    instants: Sequence[int] = (),
    piece: int = PIECE,
) -> tuple[Mapping[Kind, Floats], Fit]:
    """Fisher information of an experiment over time, by kind, and the fit of the model.

    The information, shape (instants, p, p), is that after the periods ``instants``, in ascending order; the physical
    one begins at ``start``, shape (p, p). Samples are at the instants of the grid, with the assumed currents in gaps.
    The simulation runs in pieces of ``piece`` periods.

    With a measurement delay the first samples measure the brake before the experiment, and have information on the
    encoder's offset and the start only. Jitter of the clock increases the standard deviations of a fast brake. An
    observer's velocity is not compared.
    """
    nothing, at = np.zeros((len(names), len(names))), np.asarray(instants, np.int64)
    totals: dict[Kind, Floats] = {"physical": nothing if start is None else start, "weighted": nothing}
    histories: dict[Kind, list[Floats]] = {kind: [np.empty((0, *nothing.shape))] for kind in KINDS}
    squares, count, done = np.zeros(2), 0, 0
    pieces = list(on_grid(experiment).split(piece))
    loop = fast_loop(experiment.periods)
    predicted = simulate_parts(plant, theta, pieces, bench.timing.sample_time, names, loop) if pieces else ()
    for part, motion in zip(pieces, predicted, strict=True):
        inside = at[(at >= done) & (at < done + part.periods)] - done
        for kind in KINDS if names else ():
            weights = weights_along(bench, kind, plant.instruments, motion.states)
            history = information_over_time(motion.sensitivities, weights, totals[kind], part.measured)
            totals[kind] = history[-1]
            histories[kind].append(history[inside])
        roots = np.sqrt(weights_along(bench, "physical", plant.instruments, motion.states))
        distances = ((part.samples - motion.samples) * roots)[part.measured]
        squares, count, done = squares + np.sum(distances**2, axis=0), count + len(distances), done + part.periods
    angle, velocity = np.sqrt(squares / max(count, 1)).tolist()
    fit = Fit(angle, None if plant.instruments.observer_bandwidth > 0.0 else velocity, count)
    return {kind: np.concatenate(parts) for kind, parts in histories.items()}, fit


def on_grid(experiment: Experiment) -> Experiment:
    """The experiment with samples at the instants of the grid, and with the assumed currents in gaps."""
    return replace(experiment, late=None, assumed=None, places=None)


@dataclass(frozen=True)
class Question:
    """Parameters of interest, nuisance parameters and prior of an evaluation."""

    params: tuple[str, ...] = PARAMETER_NAMES  # The parameters of interest
    nuisances: tuple[str, ...] = ()  # Other unknown parameters, of no interest
    prior: Ranges | None = None  # Prior ranges of the parameters

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
        """Names of the parameters with a prior."""
        p = self.prior
        return tuple(n for n in self.names if p and getattr(p.low, n, 0.0) < getattr(p.high, n, 0.0))

    def start(self, theta: BrakeParameters) -> Floats | None:
        """The prior's Fisher information, relative to ``theta``; zero for parameters without a prior."""
        if self.prior is None:
            return None
        start = np.zeros((len(self.names), len(self.names)))
        index = [self.names.index(name) for name in self.varied]
        start[np.ix_(index, index)] = uniform_prior(self.prior, self.varied, theta)
        return start


@dataclass(frozen=True, eq=False, repr=False)
class Information:
    """Fisher information about one brake over time: of a recorded experiment, of planned currents, or of several."""

    bench: Bench
    plant: Plant  # The model
    theta: BrakeParameters  # Parameters of the evaluation, and reference of relative values
    errors: SystematicErrors  # Given systematic errors
    question: Question
    experiment: Experiment | None  # None of several together
    instants: Sequence[int]
    """Periods after which ``histories`` have the information; the last one is among them."""
    histories: Mapping[Kind, Floats]
    """FIM after each of ``instants``, shape (instants, p, p), by kind; the physical one begins at the prior."""

    def __repr__(self) -> str:
        """Model and bounds in one line."""
        bounds = ", ".join(
            f"{name} ± {relative(NORMAL_95 * bound, PARAMETERS[name].relative)}"
            for name, bound in self.fisher("physical").cramer_rao().items()
        )
        return f"<{self.title}: model '{self.plant.name}'; smallest possible repeatability {bounds}>"

    @property
    def title(self) -> str:
        """Kind and source of the information."""
        return f"Information of {'several runs' if self.experiment is None else 'planned currents'}"

    def __getitem__(self, name: str) -> float:
        """Smallest possible standard deviation of a parameter, relative or in its unit (Cramér-Rao)."""
        return ByName(self.fisher("physical").cramer_rao())[name]

    def __add__(self, other: Information) -> Information:
        """The information of both together, see :func:`together`."""
        return together([self, other])

    def __radd__(self, zero: int) -> Information:
        """The begin of ``sum()``."""
        return self if zero == 0 else NotImplemented

    @property
    def params(self) -> tuple[str, ...]:
        """Names of the rows of ``matrix``: the parameters, then the nuisances."""
        return self.question.names

    @property
    def matrix(self) -> Floats:
        """The physical FIM with the prior, in relative parameters or the units of the others, shape (p, p)."""
        return self.fisher("physical").matrix

    @property
    def covariance(self) -> Floats:
        """Inverse of ``matrix``, the smallest possible covariance; inf on the diagonal if not identified."""
        return self.fisher("physical").covariance()

    cov = covariance  # As numpy calls it

    @property
    def correlation(self) -> Floats:
        """Correlations of the estimates, shape (p, p)."""
        return self.fisher("physical").correlation()

    @cached_property
    def trajectory(self) -> Trajectory:
        """Motion of the brake under the currents, samples without noise, and their sensitivities.

        Raises:
            UsageError: the information is of several runs.
        """
        if self.experiment is None:
            raise UsageError("each run has a trajectory of its own: expected the information of one of them")
        experiment = on_grid(self.experiment)
        at, loop = _placed(self.theta, self.errors, experiment, self.plant), fast_loop(experiment.periods)
        return simulate(self.plant, at, experiment, self.bench.timing.sample_time, self.params, loop)

    @property
    def sensitivities(self) -> Floats:
        """Derivatives of the n samples to the unknowns, relative (θ ∂y/∂θ) or per unit, shape (n, p, 2).

        The last axis is angle [rad] and velocity [rad/s].
        """
        return self.trajectory.sensitivities

    def to_dataframe(self) -> Any:
        """The matrix as a pandas frame with the names of its rows and columns."""
        with needs("a frame", "notebook"):
            import pandas as pd
        return pd.DataFrame(self.matrix, self.params, self.params)

    def fisher(self, kind: Kind) -> Fisher:
        """The Fisher information at the end of the experiment."""
        question = self.question
        prior = question.start(self.theta) if kind == "physical" else None
        matrix = self.histories[kind][-1]
        return Fisher(kind, question.names, self.theta, matrix, prior, self.plant.name, question.nuisances)

    def identifiability(self) -> Identifiability:
        """Identifiability of each parameter from the experiment."""
        return self.fisher("physical").identifiability(self.question.prior)

    @property
    def absent(self) -> tuple[str, ...]:
        """Unknowns that are zero in the model, and so have no relative sensitivity."""
        has = self.plant.mechanics._asdict()
        return tuple(name for name in self.question.names if has.get(name) == 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Information):
    """The Fisher information of one recorded experiment, and how well the model fits."""

    log: RunLog
    experiment: Experiment
    theta_name: str
    fit: Fit

    @property
    def title(self) -> str:
        """Kind and source of the information."""
        return f"Evaluation of {self.log.path.name}"


def together(parts: Sequence[Information]) -> Information:
    """Sum of the informations of several experiments with one brake, at the parameters of the first.

    Evaluations at running estimates are repeated at these parameters. Unknowns of single experiments are eliminated
    before the sum. A prior counts once.

    Raises:
        UsageError: the parameters, models or unknowns differ, or a parameter of interest belongs to one experiment.
    """
    first, names = parts[0], parts[0].params
    if local := [name for name in first.question.params if name in OF_AN_EXPERIMENT]:
        raise UsageError(f"each run has its own {local[0]}: expected it as a nuisance of several runs")
    parts = [
        evaluate(p.log, p.experiment, p.bench, [p.plant], p.question, LOG, first.theta, p.errors)[0]
        if isinstance(p, Evaluation) and p.theta_name == LOG
        else p
        for p in parts
    ]
    for part in parts:
        for what in ("plant", "theta", "question"):
            if getattr(part, what) != getattr(first, what):
                option = {"plant": "model", "question": "params, nuisance and prior"}.get(what, what)
                raise UsageError(f"informations add if they are about one brake: expected the same {option} of all")
    shared = [i for i, name in enumerate(names) if name not in OF_AN_EXPERIMENT]
    question = replace(first.question, nuisances=tuple(names[i] for i in shared[len(first.question.params) :]))
    start, found = question.start(first.theta), {}
    for kind in KINDS:
        matrix = np.sum([schur_complement(part.histories[kind][-1], shared) for part in parts], axis=0)
        if start is not None and kind == "physical":
            matrix -= (len(parts) - 1) * start
        found[kind] = matrix[None]
    last = sum(part.instants[-1] + 1 for part in parts) - 1
    return Information(first.bench, first.plant, first.theta, first.errors, question, None, [last], found)


def expected(
    bench: Bench,
    plant: Plant,
    question: Question,
    theta: BrakeParameters,
    errors: SystematicErrors,
    currents: Sequence[float] | Floats,
) -> Information:
    """Both Fisher informations of a planned experiment: currents [A], from rest at the origin; each sample counts.

    Raises:
        UsageError: the currents are no row of finite numbers.
    """
    experiment = planned(currents, Theta(theta, errors=errors).offset(plant))
    if not experiment.periods:
        raise UsageError("expected at least one current")
    every, instants = replace(experiment, samples=np.zeros_like(experiment.samples)), range(experiment.periods)
    at = _placed(theta, errors, experiment, plant)
    histories, _ = information_and_fit(bench, plant, at, every, question.names, question.start(theta), instants)
    return Information(bench, plant, theta, errors, question, experiment, instants, histories)


def _placed(theta: BrakeParameters, errors: SystematicErrors, experiment: Experiment, plant: Plant) -> Theta:
    """Parameters, errors and the start of an experiment."""
    at = Theta(theta, errors=errors)
    return at._replace(start=experiment.x0(at.offset(plant)))


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
    """Both Fisher informations over time at ``theta`` and ``errors``, and the fit, of each model."""
    instants = evenly(experiment.periods, INSTANTS)
    found = []
    for plant in plants:
        at = _placed(theta, errors, experiment, plant)
        histories, fit = information_and_fit(
            bench, plant, at, experiment, question.names, question.start(theta), instants
        )
        found.append(
            Evaluation(bench, plant, theta, errors, question, experiment, instants, histories, log, theta_name, fit)
        )
    return found


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
    """Refuse a log with another sample time in its bench file; one without a readable bench file passes."""
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
