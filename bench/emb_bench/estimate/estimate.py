"""An estimate: values of the unknowns of a problem, with their information, covariance and tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import Quantity, quantity
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.effects import SCALES
from emb_bench.estimate.intervals import deviations, largest, unnoticed
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, Contribution, End, EstimationProblem, ModelValidation, Unknown
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.identifiability import Identifiability, Spectrum, identifiability, schur_complement
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters

OF_THE_BENCH = ("J", *SCALES)  # Effects that all runs on one bench share


class Ratio(NamedTuple):
    """Ratio of a parameter to J."""

    name: str
    value: float
    unit: str
    interval: tuple[float, float]  # 95 %


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters from experiments."""

    problem: Problem  # Its plant has the features that were estimated
    z: Floats  # Unknowns in the coordinates of ``problem``
    information: Floats
    """Physical FIM at the estimate, relative parameters, with the priors, those of systematic errors averaged
    (:mod:`emb_bench.estimate.average`): the inverse covariance of the estimate."""
    samples: Floats  # FIM of the samples alone
    prior: Floats | None  # FIM of the priors in full
    sandwich: Floats
    """Covariance from the residuals, relative parameters: consistent also if the noise is not the bench's."""
    validation: ModelValidation
    ends: tuple[End, ...]  # Of all local searches, best first
    residuals: tuple[Floats, ...] = field(repr=False)
    """Of each experiment in standard deviations, NaN where lost, shape (n, 2); of a filter the innovations."""
    method: str = "oem"  # Key of ``METHODS``
    process_noise: float = 0.0
    """Standard deviation of the velocity's random walk, as the prediction error method estimates it [rad/s per √s]."""
    load_noise: float = 0.0
    """Standard deviation of the load's random walk, as a current, by the same method [A per √s]."""
    windows: int = 0  # Number of windows; 0 for a method without windows
    ideal_sensors: bool = False  # Systematic errors were requested, but the method cannot estimate them

    @property
    def bench(self) -> Bench:
        """Noise, sample time and nominal brake."""
        return self.problem.bench

    @property
    def plant(self) -> Plant:
        """The model, with the features that were estimated."""
        return self.problem.plant

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The experiments, without outliers."""
        return self.problem.experiments

    @property
    def question(self) -> EstimationProblem:
        """Parameters of interest, nuisances and priors."""
        return self.problem.question

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The unknowns, in the order of ``values``."""
        return self.problem.unknowns

    @property
    def theta(self) -> BrakeParameters:
        """The estimated brake; parameters without an estimate are nominal."""
        return self.problem.theta(self.z)

    @property
    def fit(self) -> Floats:
        """The unknowns that fit best with all priors in full, in the coordinates of ``problem``."""
        return self.ends[0].z

    @property
    def values(self) -> Floats:
        """The unknowns in SI units."""
        return self.problem.values(self.z)

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Labels of the unknowns that ended at the border of the search range."""
        return tuple(label for label, at in zip(self.labels, self.problem.at_border(self.fit), strict=True) if at)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the unknowns, in their order."""
        return tuple(self.label(unknown) for unknown in self.unknowns)

    @property
    def scale(self) -> Floats:
        """Factors from relative deviations, or those in an unknown's unit, to SI units."""
        return self.problem.scale(self.z)

    def cramer_rao(self) -> Floats:
        """Standard deviations by the information: relative or in the unknown's unit, inf if not identified."""
        bounds: Floats = np.sqrt(np.diag(Spectrum(self.information).inverse()))
        return bounds

    def with_full_priors(self) -> Floats:
        """Standard deviations with all priors in full, those of systematic errors as well; in the same units."""
        full = self.samples if self.prior is None else self.samples + self.prior
        bounds: Floats = np.sqrt(np.diag(Spectrum(full).inverse()))
        return bounds

    def robust(self) -> Floats:
        """Standard deviations from the residuals, in the same units."""
        deviations: Floats = np.sqrt(np.maximum(np.diag(self.sandwich), 0.0))  # which averaging can leave below zero
        return deviations

    def deviations(self) -> Floats:
        """Total standard deviations, by the rules of :mod:`emb_bench.estimate.intervals`."""
        return deviations(self.cramer_rao(), self.unmodelled_bias(), self.robust(), fits=self.validation.fits)

    def covariance(self) -> Floats:
        """Total covariance, with the squares of :meth:`deviations` on the diagonal; in the same units.

        Inverse information plus one term of rank one for each effect of the budget, which biases all unknowns at once.
        """
        biases = np.array([one.bias for one in self.validation.budget]).reshape(-1, len(self.unknowns))
        covariance = Spectrum(self.information).inverse() + biases.T @ biases
        variance = np.diag(covariance)
        grown = np.where(np.isfinite(variance), self.deviations() / np.sqrt(variance), 1.0)
        total: Floats = covariance * np.outer(grown, grown)
        return total

    def between_runs(self) -> Floats:
        """Total deviations without the errors that all runs on one bench share, to compare runs."""
        return deviations(
            self.cramer_rao(), self.unmodelled_bias(OF_THE_BENCH), self.robust(), fits=self.validation.fits
        )

    def unmodelled_bias(self, without: Sequence[str] = ()) -> Floats:
        """Root mean square bias of each unknown by unmodelled effects, except those ``without``."""
        return unnoticed(self.validation.budget, len(self.unknowns), without)

    def ratios(self) -> list[Ratio]:
        """Ratios of the parameters to J, which an error of J does not change."""
        inertia = [i for i, unknown in enumerate(self.unknowns) if unknown.name == "J"]
        over, found = quantity(self.bench.machine, "J"), []
        for i, name in enumerate(unknown.name for unknown in self.unknowns):
            if name not in PARAMETER_NAMES:
                continue
            at, signs = [i, *inertia], np.array([1.0, -1.0])[: 1 + len(inertia)]
            moved = [float(signs @ [one.bias[k] for k in at]) for one in self.validation.budget if one.name != "J"]
            covariances = (Spectrum(self.information).inverse(), self.sandwich)
            bound, robust = (np.sqrt(max(float(signs @ c[np.ix_(at, at)] @ signs), 0.0)) for c in covariances)
            deviation = float(deviations(bound, np.asarray(np.linalg.norm(moved)), robust, fits=self.validation.fits))
            of, value = quantity(self.bench.machine, name), float(self.values[i] / self.theta.J)
            half = NORMAL_95 * deviation * value
            found.append(
                Ratio(f"{of.name}/{over.name}", value, f"{of.unit}/({over.unit})", (value - half, value + half))
            )
        return found

    def largest_bias(self, i: int) -> Contribution | None:
        """The largest entry of the uncertainty budget of unknown ``i``; None without any."""
        return largest(self.validation.budget, i)

    def effects(self, i: int) -> dict[str, tuple[float, float]]:
        """Biases of unknown ``i`` by effects, with their sizes; not by those that move all runs on one bench alike."""
        return {one.name: (one.bias[i], one.size) for one in self.validation.budget if one.name not in OF_THE_BENCH}

    def intervals(self) -> Floats:
        """Gaussian 95 % intervals in SI units, shape (unknowns, 2)."""
        half = NORMAL_95 * self.deviations() * self.scale
        return np.stack([self.values - half, self.values + half], axis=1)

    def correlation(self) -> Floats:
        """Correlations of the estimates, shape (unknowns, unknowns)."""
        return Spectrum(self.information).correlation()

    def shared(self) -> list[int]:
        """Indices of the unknowns that all experiments share."""
        return [i for i, unknown in enumerate(self.unknowns) if unknown.experiment is None]

    def requested(self) -> list[int]:
        """Indices of the requested unknowns: all but the default nuisances."""
        return [i for i, unknown in enumerate(self.unknowns) if unknown.name not in self.question.default_nuisances]

    def shared_information(self) -> Floats:
        """FIM of the shared unknowns when those of single experiments are unknown too; relative, prior included."""
        return schur_complement(self.information, self.shared())

    def identifiability(self) -> Identifiability:
        """Identifiability of the requested unknowns; of several experiments, of those that they share."""
        shared = [i for i, u in enumerate(self.unknowns) if u.experiment is None or len(self.experiments) == 1]
        if not shared:
            return Identifiability((), (), ())
        matrix = schur_complement(self.information, shared)
        prior = None if self.question.prior is None or self.prior is None else self.prior[np.ix_(shared, shared)]
        found = identifiability(matrix, [self.unknowns[i].name for i in shared], prior)
        requested = tuple(f for f in found.findings if f.name not in self.question.default_nuisances)
        return replace(found, findings=requested).renamed(self.bench.machine)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Names and units of the unknowns for output, in their order."""
        return tuple(quantity(self.bench.machine, unknown.name) for unknown in self.unknowns)

    def label(self, unknown: Unknown) -> str:
        """Label of an unknown."""
        name = quantity(self.bench.machine, unknown.name).name
        return name if unknown.experiment is None or len(self.experiments) == 1 else f"{name}[{unknown.experiment}]"
