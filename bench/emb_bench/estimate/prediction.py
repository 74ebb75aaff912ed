"""Predictions of the experiments: residuals in standard deviations, and their exact derivatives to the unknowns."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from emb_bench.brake.motion import Floats, Integers
from emb_bench.brake.parameters import FEATURES, PARAMETERS
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.machine import WINDOW
from emb_bench.config.plants import Mechanics, Plant
from emb_bench.estimate.records import EstimationProblem, Unknown, check_model, searched
from emb_bench.experiment.experiment import Booleans, Experiment
from emb_bench.experiment.simulate import (
    SystematicErrors,
    Theta,
    Trajectory,
    gap_ends,
    later,
    simulate,
    simulate_shares,
)
from emb_bench.information.fisher import information_of_range, weights_along
from emb_bench.sim.open_loop import march, march_shares
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import LogError, UsageError

NEAR_BOUND = 1e-6  # Share of the search range; nearer to its end an unknown is at the border


@dataclass(frozen=True, eq=False)
class Problem:
    """Experiments, a model and the unknowns.

    A search moves a vector z: the logarithm of each relative unknown, the others in their units. Derivatives to z are
    then the sensitivities themselves, θ ∂y/∂θ = ∂y/∂ln θ, and what is positive stays so.
    """

    bench: Bench
    plant: Plant
    question: EstimationProblem
    experiments: tuple[Experiment, ...]

    @property
    def window(self) -> float:
        """Length of the windows [s], of the method ``windows``."""
        machine = self.bench.machine
        return self.question.window or (WINDOW if machine is None else machine.window)

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The elements of z."""
        return self.question.unknowns(len(self.experiments))

    @cached_property
    def _logarithmic(self) -> Booleans:
        return np.array([unknown.relative for unknown in self.unknowns], np.bool_)

    def values(self, z: Floats) -> Floats:
        """The unknowns in SI units."""
        return np.exp(z, out=z.copy(), where=self._logarithmic)

    def coordinates(self, values: Floats) -> Floats:
        """Z of unknowns in SI units."""
        return np.log(values, out=values.copy(), where=self._logarithmic)

    def scale(self, z: Floats) -> Floats:
        """Derivatives of the unknowns in SI units to z."""
        return np.where(self._logarithmic, self.values(z), 1.0)

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest z."""
        low, high = np.array([searched(self.bench, u) for u in self.unknowns]).T
        return self.coordinates(low), self.coordinates(high)

    def at_border(self, z: Floats) -> Booleans:
        """Mask of the unknowns that are at a border of the search."""
        value, low, high = self.values(z), *map(self.values, self.bounds)
        return np.minimum(value - low, high - value) <= NEAR_BOUND * (high - low)

    @cached_property
    def prior(self) -> tuple[Floats, Floats]:
        """Prior means and inverse standard deviations of the unknowns; zero for a flat prior."""
        prior = self.question.prior
        mean, inverse = np.zeros(len(self.unknowns)), np.zeros(len(self.unknowns))
        if prior is not None:
            for name in self.question.varied:
                i, low, high = self.unknowns.index(Unknown(name)), getattr(prior.low, name), getattr(prior.high, name)
                mean[i], inverse[i] = 0.5 * (low + high), math.sqrt(information_of_range(low, high))
        for name, (value, deviation) in self.question.known.items():
            i = self.unknowns.index(Unknown(name))
            mean[i], inverse[i] = value, 1.0 / deviation
        for i, unknown in enumerate(self.unknowns):
            if unknown.name in self.question.systematic:
                mean[i] = self.plant.instruments.encoder_offset if unknown.name == "offset" else 0.0
                inverse[i] = 1.0 / self.question.systematic[unknown.name]
        return mean, inverse

    def nominal(self) -> Floats:
        """Initial z of a search: nominal parameters, and the measured start of each experiment."""
        offset = self.plant.instruments.encoder_offset
        free = "offset" in self.question.names
        estimated = "offset" in self.question.systematic
        of_all = self.plant.mechanics._asdict() | self.bench.brake._asdict()
        values = np.zeros(len(self.unknowns))
        for i, unknown in enumerate(self.unknowns):
            if unknown.experiment is None:
                value, row = of_all.get(unknown.name, 0.0), PARAMETERS[unknown.name]
                values[i] = row.start if unknown.name in FEATURES and value in (0.0, row.low) else value
                continue
            experiment = self.experiments[unknown.experiment]
            x1, x2 = experiment.start(experiment.angle if free else offset)
            starts = {"x1_0": 0.0 if free else x1, "x2_0": x2, "offset": offset if estimated else experiment.angle}
            values[i] = starts[unknown.name]
        return np.clip(self.coordinates(values), *self.bounds)

    def initial(self, values: Mapping[Unknown, float]) -> Floats:
        """Initial z of a search with given values of some unknowns [SI units], the others nominal."""
        nominal = self.values(self.nominal()).tolist()
        merged = [values.get(unknown, value) for unknown, value in zip(self.unknowns, nominal, strict=True)]
        return np.clip(self.coordinates(np.array(merged)), *self.bounds)

    def theta(self, z: Floats) -> BrakeParameters:
        """Parameters of the brake."""
        return self.bench.brake._replace(**self._named(z, BrakeParameters._fields))

    def _named(self, z: Floats, names: Container[str]) -> dict[str, Any]:
        pairs = zip(self.unknowns, self.values(z).tolist(), strict=True)
        return {unknown.name: value for unknown, value in pairs if unknown.name in names}

    def mechanics(self, z: Floats) -> Mechanics:
        """Mechanics of the brake: those of the plant with the features that are unknown.

        Static friction of a plant without a Stribeck velocity gets one: at rest alone it has no derivative.
        """
        m, found = self.plant.mechanics, self._named(z, Mechanics._fields)
        if m.stribeck_velocity == 0.0 and {"break_away", "f_l"} & {*found}:
            found.setdefault("stribeck_velocity", PARAMETERS["stribeck_velocity"].start)
        return m._replace(**found)

    def solved(self, z: Floats) -> Problem:
        """The problem whose plant has the features of ``z``."""
        return replace(self, plant=replace(self.plant, mechanics=self.mechanics(z)))

    def subset(self, index: Sequence[int]) -> tuple[Problem, list[int]]:
        """Problem of the experiments ``index``, which may repeat, and the places of its unknowns in z."""
        problem = replace(self, experiments=tuple(self.experiments[i] for i in index))
        unknowns = [Unknown(u.name, None if u.experiment is None else index[u.experiment]) for u in problem.unknowns]
        return problem, [self.unknowns.index(unknown) for unknown in unknowns]

    def indices(self, experiment: int) -> list[int]:
        """Indices of the elements of z that an experiment depends on."""
        return [i for i, u in enumerate(self.unknowns) if u.experiment in (None, experiment)]

    def at(self, z: Floats, experiment: int) -> Theta:
        """Parameters, start and systematic errors of an experiment at ``z``."""
        values = {self.unknowns[i].name: float(z[i]) for i in self.indices(experiment)}
        offset = values.get("offset", self.plant.instruments.encoder_offset)
        x1, x2 = self.experiments[experiment].start(offset)
        if "offset" in values:
            x1 = 0.0  # with an unknown offset the brake rests at the origin, unless the start is an unknown
        errors = SystematicErrors(
            offset, values.get("current_offset", 0.0), values.get("delay", 0.0), values.get("velocity_gain", 0.0)
        )
        start = values.get("x1_0", x1), values.get("x2_0", x2)
        return Theta(self.theta(z), start, errors, values.get("contact", 0.0))

    def names(self, experiment: int) -> tuple[str, ...]:
        """The unknowns that an experiment depends on, in the order of ``indices``."""
        return tuple(self.unknowns[i].name for i in self.indices(experiment))

    def predict(self, z: Floats, experiment: int, besides: tuple[str, ...] = ()) -> Trajectory:
        """Predicts an experiment, with sensitivities to its unknowns, those ``besides``, and those of its gaps."""
        return self._simulated(z, experiment, self.mechanics(z), (*self.names(experiment), *besides))

    def motion(self, z: Floats, experiment: int, mechanics: Mechanics | None = None) -> Trajectory:
        """Predicts an experiment with sensitivities to its gap unknowns only, optionally with other ``mechanics``."""
        return self._simulated(z, experiment, self.mechanics(z) if mechanics is None else mechanics, ())

    def parts(self, z: Floats, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """Sensitivities of an experiment to unknowns that count in each period by a share: :func:`simulate_shares`."""
        plant, data, t_s = self.solved(z).plant, self.experiments[experiment], self.bench.timing.sample_time
        return simulate_shares(plant, self.at(z, experiment), data, t_s, unknowns, shares, compiled(march_shares))

    def _simulated(self, z: Floats, experiment: int, mechanics: Mechanics, names: tuple[str, ...]) -> Trajectory:
        plant, t_s = replace(self.plant, mechanics=mechanics), self.bench.timing.sample_time
        return simulate(plant, self.at(z, experiment), self.experiments[experiment], t_s, names, compiled(march))

    def weights(self, z: Floats, trajectories: Sequence[Trajectory] | None = None) -> list[Floats]:
        """Inverse standard deviations of each experiment's samples at ``z``, 0 where they do not count, shape (n, 2).

        ``trajectories``: predictions at ``z``, if they have been computed.
        """
        result = []
        for i, experiment in enumerate(self.experiments):
            instruments = self.plant.instruments
            states = (self.motion(z, i) if trajectories is None else trajectories[i]).states
            along = weights_along(self.bench, "physical", instruments, states)
            root = np.sqrt(along) * experiment.measured[:, None]
            root[later(experiment.inside.astype(np.float64), instruments.measurement_delay) > 0.0] = 0.0
            result.append(root)
        return result

    def jacobian(
        self, z: Floats, weights: Sequence[Floats], trajectories: Sequence[Trajectory] | None = None
    ) -> tuple[Floats, Floats]:
        """Residuals measured − predicted in standard deviations and their Jacobian, gap unknowns projected out.

        A single period without report has an unknown current, Gaussian around the assumed one with the bench's limit as
        standard deviation. Several such periods in a row have unknown angle and velocity at their end, with a prior
        next to flat. Both are linearised at the values in the experiments. After the projection J^T J is the
        information on z with the gap unknowns marginalised, and |r|² the least sum of squares over them.

        Returns:
            Shapes (m,) and (m, len(z)): all samples of all experiments, angle and velocity in turn, then each
            experiment's start if that is unknown, then the prior, then the unknowns of the gaps.
        """
        residuals, rows = self.joint(z, weights, trajectories)
        jacobian, basis = rows[:, : len(z)], _orthonormal(rows[:, len(z) :])
        return residuals - basis @ (basis.T @ residuals), jacobian - basis @ (basis.T @ jacobian)

    def gap_basis(self, z: Floats, weights: Sequence[Floats]) -> Floats:
        """Orthonormal basis of the residuals that the unknowns of the gaps can explain, shape (m, gaps)."""
        return _orthonormal(self.joint(z, weights)[1][:, len(z) :])

    def joint(
        self, z: Floats, weights: Sequence[Floats], trajectories: Sequence[Trajectory] | None = None
    ) -> tuple[Floats, Floats]:
        """Residuals as in :meth:`jacobian`, with the gap unknowns at their values in the experiments.

        Returns:
            Shapes (m,) and (m, len(z) + gaps): derivatives to z, and to the unknowns of the gaps, experiment by
            experiment.
        """
        parts, columns = [], []
        for i, (experiment, root) in enumerate(zip(self.experiments, weights, strict=True)):
            at = self.predict(z, i) if trajectories is None else trajectories[i]
            rows = at.sensitivities * root[:, None]
            parts.append((np.nan_to_num(experiment.samples - at.samples) * root, rows[:, : len(self.indices(i))]))
            in_gaps = rows[:, rows.shape[1] - experiment.gap_unknowns :]
            columns.append(in_gaps.transpose(0, 2, 1).reshape(root.size, -1))
        residuals, rows = self.stacked(z, parts)
        count = sum(experiment.gap_unknowns for experiment in self.experiments)
        if not count:
            return residuals, rows
        current, assumed, inverse = (
            np.concatenate(part) for part in zip(*map(self._gaps, range(len(parts))), strict=True)
        )
        no_samples = np.zeros((len(residuals) - sum(len(block) for block in columns), count))
        of_gaps = -np.concatenate([block_diag(*columns), no_samples, np.diag(inverse)])
        rows = np.concatenate([rows, np.zeros((count, len(z)))])
        return np.concatenate([residuals, (assumed - current) * inverse]), np.concatenate([rows, of_gaps], axis=1)

    def in_gaps(self) -> Floats:
        """Values in the gaps of the experiments: currents [A], then angles [rad] and velocities [rad/s] in turn."""
        return np.concatenate([self._gaps(i)[0] for i in range(len(self.experiments))])

    def _gaps(self, experiment: int) -> tuple[Floats, Floats, Floats]:
        """Gap unknowns of an experiment: values, prior means and inverse prior deviations."""
        data = self.experiments[experiment]
        pulses, breaks = data.gaps
        places = gap_ends(data, self.plant.instruments)[1].ravel()
        assumed = data.currents if data.assumed is None else data.assumed
        inverse = np.full(len(pulses), 1.0 / self.bench.limits.current)
        low, high = self.bench.limits.angle
        free = np.tile([1.0 / (high - low), 1.0 / self.bench.limits.velocity], len(breaks))
        return (
            np.concatenate([data.currents[pulses], places]),
            np.concatenate([assumed[pulses], places]),
            np.concatenate([inverse, free]),
        )

    def filled(self, gaps: Floats) -> Problem:
        """The problem with these gap unknowns in its experiments, in the order of :meth:`in_gaps`."""
        ends, experiments = np.cumsum([experiment.gap_unknowns for experiment in self.experiments]), []
        for experiment, values in zip(self.experiments, np.split(gaps, ends[:-1]), strict=True):
            pulses, currents = experiment.gaps[0], experiment.currents.copy()
            currents[pulses] = values[: len(pulses)]
            places = values[len(pulses) :].reshape(-1, 2)
            experiments.append(
                replace(experiment, currents=currents, places=places) if experiment.gap_unknowns else experiment
            )
        return replace(self, experiments=tuple(experiments))

    def stacked(self, z: Floats, parts: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
        """All residuals in one row, and their derivatives to z, as :meth:`jacobian`.

        ``parts`` has for each experiment the whitened errors of its samples, shape (n, 2), and the derivatives of the
        prediction to the experiment's unknowns in the same unit, shape (n, indices, 2).
        """
        residuals, rows = [], []
        for i, (errors, shares) in enumerate(parts):
            columns = self.indices(i)
            block = np.zeros((*errors.shape, len(z)))
            block[:, :, columns] = -shares.transpose(0, 2, 1)
            residuals.append(errors.ravel())
            rows.append(block.reshape(-1, len(z)))
        of_priors, rows_of_priors = self.prior_residuals(z)
        return np.concatenate([*residuals, of_priors]), np.concatenate([*rows, rows_of_priors])

    def rests(self) -> dict[int, list[int]]:
        """Experiments with a measured angle at rest, by number, and the elements of z that it depends on."""
        found = {}
        for i, experiment in enumerate(self.experiments):
            touched = [c for c in self.indices(i) if self.unknowns[c].name in ("x1_0", "offset")]
            if touched and experiment.slack > 0.0:
                found[i] = touched
        return found

    def prior_residuals(self, z: Floats) -> tuple[Floats, Floats]:
        """Residuals of unknown starts and of the priors, and their derivatives to z."""
        residuals, rows = [], []
        for i, touched in self.rests().items():
            experiment, row = self.experiments[i], np.zeros((1, len(z)))
            row[0, touched] = -1.0 / experiment.slack
            free = any(self.unknowns[c].name == "offset" for c in touched)
            fixed = 0.0 if free else self.plant.instruments.encoder_offset
            predicted = sum(float(z[c]) for c in touched) + fixed
            residuals.append(np.array([(experiment.angle - predicted) / experiment.slack]))
            rows.append(row)
        mean, inverse = self.prior
        index = np.flatnonzero(inverse)
        residuals.append((mean - self.values(z))[index] * inverse[index])
        rows.append(-np.diag(inverse * self.scale(z))[index])
        return np.concatenate(residuals), np.concatenate(rows)


def _orthonormal(columns: Floats) -> Floats:
    basis: Floats = np.linalg.qr(columns)[0] if columns.shape[1] else columns
    return basis


def by_experiment(errors: Floats, weights: Sequence[Floats]) -> list[Floats]:
    """The residuals of each experiment's samples, shape (n, 2), from all of them in one row."""
    ends = np.cumsum([root.size for root in weights])
    return [part.reshape(root.shape) for part, root in zip(np.split(errors, ends), weights, strict=False)]


def make_problem(bench: Bench, plant: Plant, experiments: Sequence[Experiment], question: EstimationProblem) -> Problem:
    """The problem, once its model has the unknowns and there are enough samples."""
    check_model(plant, question.names)
    if not experiments:
        raise UsageError("expected at least one record")
    if why_not := too_few(plant, question, sum(int(r.measured.sum()) for r in experiments), len(experiments)):
        raise LogError(f"{', '.join(experiment.name for experiment in experiments)}: {why_not}")
    return Problem(bench, plant, question, tuple(experiments))


def too_few(plant: Plant, question: EstimationProblem, samples: int, experiments: int) -> str:
    """Reason that there are too few samples for the unknowns of all experiments; empty if there are enough."""
    unknowns, outputs = len(question.unknowns(experiments)), 1 if plant.instruments.observer_bandwidth > 0.0 else 2
    if samples * outputs >= unknowns:
        return ""
    requested = len(replace(question, systematic={}).unknowns(experiments))
    also = f" and {unknowns - requested} systematic errors" if unknowns > requested else ""
    return f"{'1 sample is' if samples == 1 else f'{samples} samples are'} too few for {requested} unknowns{also}"
