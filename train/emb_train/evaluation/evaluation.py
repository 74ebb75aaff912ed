"""Evaluation of actors beside references, on the same brakes with the same noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.numbers import Score
from emb_runtime.config.bench import Bench
from emb_runtime.policy.contract import VECTOR_TOLERANCE
from emb_train.envs.conditions import NOTHING_RANDOM, Conditions, Randomisation
from emb_train.envs.excitations import Excitation
from emb_train.envs.measure import Measure, mean_score
from emb_train.envs.play import Beside, Draw, Outcome, fresh_draws, middle_of, play
from emb_train.evaluation.actors import Subject, references
from emb_train.evaluation.known_optimum import KnownOptimum, plant_of

Floats = NDArray[np.float64]
Tell = Callable[[str], None]

NETWORK, FILE, REFERENCE = "network", "file", "reference"  # Forms of an actor or a reference


@dataclass(frozen=True)
class Settings:
    """Measure, brakes and conditions of an evaluation."""

    measure: Measure
    parameters: tuple[str, ...]  # Unknown; others that vary in the ranges count as known
    ranges: str  # Set of the bench that brakes are drawn from
    plants: tuple[str, ...]  # Plants: mechanics and instruments
    draws: int
    seed: int  # Seed of brakes and noise
    optimum_draws: int  # Number of brakes, the first ones, whose optimum is searched for
    shield: str = ""  # Set of the bench that the shield holds the limits for; empty for the one that the bench names
    randomised: Randomisation = NOTHING_RANDOM  # Properties that are drawn for each experiment beside its brake

    @property
    def conditions(self) -> Conditions:
        """Conditions in which all are played."""
        return Conditions(information=self.measure.kind, shield_ranges=self.shield, randomised=self.randomised)


@dataclass(frozen=True, eq=False)
class Row:
    """One excitation on one plant."""

    name: str
    form: str  # ``network``, ``file`` or ``reference``
    outcome: Outcome
    values: Floats  # The measure of each draw, shape [draws]

    @property
    def score(self) -> Score:
        """Mean of the measure over the draws."""
        return mean_score(self.values)

    @property
    def worst_angle(self) -> float:
        """Largest |angle| at the end [rad]."""
        return float(np.abs(self.outcome.angle).max())

    @property
    def worst_speed(self) -> float:
        """Largest |velocity| at the end [rad/s]."""
        return float(np.abs(self.outcome.velocity).max())


@dataclass(frozen=True, eq=False)
class PlantResult:
    """All rows on one plant."""

    plant: str
    rows: tuple[Row, ...]  # Actors first
    apart: tuple[float, ...]
    """Largest difference between network and file, relative to the limit, of each actor that has both."""
    optimum_plant: str | None  # Plant of the search for the optimum; None without one
    optima: Floats  # The measure of the optimum for the first draws, shape [optimum draws], or [0]

    def share(self, row: Row, measure: Measure) -> Score | None:
        """Mean share of the optimum over the draws that have one; None without. See :meth:`Measure.shares`."""
        count = len(self.optima)
        return mean_score(measure.shares(row.values[:count], self.optima)) if count else None

    def ahead(self, row: Row) -> Score:
        """Mean lead of the first actor over a row, paired by draw."""
        return mean_score(self.rows[0].values - row.values)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All results of an evaluation."""

    settings: Settings
    subjects: tuple[Subject, ...]  # The actors
    draws: tuple[Draw, ...]
    plants: tuple[PlantResult, ...]

    @property
    def agree(self) -> bool:
        """True if every network and its file give the same currents, as far as single precision goes."""
        return all(apart <= VECTOR_TOLERANCE for p in self.plants for apart in p.apart)  # NaN is no agreement

    def over_seeds(self, plant: PlantResult) -> Score | None:
        """Mean of the actors' scores with its interval over the actors; None unless there are several."""
        own: dict[str, float] = {}
        for row in plant.rows:
            if row.form != REFERENCE:
                own.setdefault(row.name.removesuffix(SUFFIX), row.score.value)
        return mean_score(np.array(list(own.values()))) if len(own) > 1 else None


SUFFIX = ", exported"  # Suffix of the name of an actor's file where its network is there as well


def evaluate(
    bench: Bench, settings: Settings, subjects: Sequence[Subject], known: KnownOptimum | None, jobs: int, tell: Tell
) -> Evaluation:
    """Play all on all plants.

    Args:
        bench: of all subjects.
        settings: measure, brakes and conditions.
        subjects: the actors.
        known: source of the optima; None for none.
        jobs: processes that look for optima.
        tell: called with lines on the progress.

    Raises:
        EmbError: see :func:`emb_train.envs.play.play` and :meth:`KnownOptimum.optima`.
    """
    draws = fresh_draws(bench.range_set(settings.ranges), settings.seed, settings.draws)
    optima: dict[str, Floats] = {}
    found = []
    for name in settings.plants:
        on = plant_of(bench.plant(name)) if known else None
        if known and on is not None and on not in optima:
            middle = middle_of(bench.range_set(settings.ranges))
            optima[on] = known.optima(on, middle, [d.brake for d in draws[: settings.optimum_draws]], jobs, tell)
        rows, apart = _rows(bench, settings, subjects, draws, name, tell)
        found.append(PlantResult(name, tuple(rows), tuple(apart), on, optima[on] if on is not None else np.empty(0)))
    return Evaluation(settings, tuple(subjects), tuple(draws), tuple(found))


def _rows(
    bench: Bench, settings: Settings, subjects: Sequence[Subject], draws: Sequence[Draw], plant: str, tell: Tell
) -> tuple[list[Row], list[float]]:
    ranges, conditions = bench.range_set(settings.ranges), settings.conditions

    def row(name: str, form: str, excitation: Excitation) -> Row:
        tell(f"plant {plant}: {name}")
        outcome = play(bench, ranges, settings.parameters, excitation, draws, plant, conditions)
        return Row(name, form, outcome, settings.measure.values(outcome.matrices))

    rows, apart = [], []
    for subject in subjects:
        if subject.network and subject.file:
            both = Beside(subject.network(), subject.file())
            rows.append(row(subject.name, NETWORK, both))
            rows.append(row(subject.name + SUFFIX, FILE, subject.file()))
            apart.append(both.apart / bench.limits.current)
        elif subject.network:
            rows.append(row(subject.name, NETWORK, subject.network()))
        elif subject.file:
            rows.append(row(subject.name, FILE, subject.file()))
    rows += [row(name, REFERENCE, excitation) for name, excitation in references(bench).items()]
    return rows, apart


def worst(apart: Sequence[float]) -> float:
    """The largest difference; NaN if one of them is, or if there is none."""
    return float(np.max(apart)) if apart else math.nan
