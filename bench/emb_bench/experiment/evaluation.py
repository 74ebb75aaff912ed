"""Fisher information of a recorded experiment about the brake, with one model of it, and the fit of that model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.model_evaluator import NO_ERRORS, Fit, ModelEvaluator, SystematicErrors
from emb_bench.information.fisher import Fisher, Kind, uniform_prior
from emb_bench.information.identifiability import Identifiability
from emb_bench.information.symmetric import Floats
from emb_bench.logs.log import RunLog
from emb_bench.sim.open_loop import check_unknowns
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, Ranges, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT, IMPORTED_PLANT, THESIS_PLANT, Plant
from emb_runtime.errors import LogError, UsageError

PIECE = 8192  # Periods that are evaluated together
INSTANTS = 1000  # Instants after which the information is kept; of a record that is no longer, after each sample


@dataclass(frozen=True)
class Question:
    """Parameters of interest, nuisance parameters and prior of an evaluation."""

    params: tuple[str, ...] = PARAMETER_NAMES  # The parameters of interest
    nuisances: tuple[str, ...] = ()  # Other unknown parameters, of no interest
    prior: Ranges | None = None  # Ranges of the parameters known before the experiment

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            UsageError: a name is unknown, comes twice or is missing, or no given parameter varies in the prior.
        """
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
    plant: Plant,
    question: Question,
    theta_name: str,
    theta: BrakeParameters,
    errors: SystematicErrors = NO_ERRORS,
) -> Evaluation:
    """Compute both Fisher informations over time, and how well the model fits.

    Args:
        log: the record.
        experiment: its content, from :func:`emb_bench.experiment.from_log.read_experiment`.
        bench: noise, limits and sample time.
        plant: the model.
        question: unknown parameters and prior.
        theta_name: what to call ``theta``.
        theta: the brake at which the information is computed.
        errors: systematic errors of the bench there.
    """
    return evaluate_all(log, experiment, bench, [plant], question, theta_name, theta, errors)[0]


def evaluate_all(
    log: RunLog,
    experiment: Experiment,
    bench: Bench,
    plants: Sequence[Plant],
    question: Question,
    theta_name: str,
    theta: BrakeParameters,
    errors: SystematicErrors = NO_ERRORS,
) -> list[Evaluation]:
    """Evaluate several models, which go through the record together; arguments as for :func:`evaluate`."""
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
    if log.imported:
        return IMPORTED_PLANT, "the recording was imported"
    return DEFAULT_PLANT, "the log does not say what moved"


def other_sample_time(log: RunLog, bench: Bench) -> float | None:
    """The sample time that the log's own bench file states, if it is not this bench's [s].

    A log without a readable bench file is taken to be on this bench's grid.
    """
    with suppress(LogError):
        if (its := log.bench.timing.sample_time) != bench.timing.sample_time:
            return its
    return None


def bench_for(log: RunLog, path: str | Path | None) -> Bench:
    """The bench file inside a log, or another one with the same sample time.

    Raises:
        UsageError: the sample times differ.
        BenchFileError: a file cannot be read.
    """
    if path is None:
        return log.bench
    bench = load_bench(path, analysis=True)
    if (its := other_sample_time(log, bench)) is not None:
        raise UsageError(f"{path}: expected the sample time of the log, {its:g} s, got {bench.timing.sample_time:g} s")
    return bench
