"""Innovations of an extended Kalman filter: the part of each sample that those before it do not predict.

The filter predicts with the exact brake. The covariance of angle and velocity is carried through a period by the exact
sensitivities to the state at its start, jumps at reversals included; a brake that sticks forgets its velocity. Between
samples the velocity does a random walk of q rad/s per √s, a white torque as seen by the inertia, which over a period T
adds q² [[T³/3, T²/2], [T²/2, T]] to the covariance. A load with a random walk of r A per √s is a third state, an added
current d that begins at zero; its effect is the exact sensitivity to a current offset. The state of hysteresis or play
and a lagging current are those of the model, without covariance.

The filter updates with one output of a sample after the other, which whitens them as the Cholesky factor of their
covariance does. A lost sample has no update. In a period without report the current has the bench's limit as standard
deviation; its effect on a free inertia adds to the covariance.

**Derivatives** of the innovations are taken with fixed gains: the update of the state's sensitivities is then exactly s
← (I − K H) s. The neglected derivatives of the gains multiply white noise.

Without disturbance, with a given start and with all reports the gains are zero, and the innovations are the residuals
of output error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats, Integers
from emb_bench.compiled import compiled
from emb_bench.config.plants import Mechanics
from emb_bench.estimate.prediction import Problem
from emb_bench.sim.instruments import reading, sensor_share
from emb_bench.sim.open_loop import advance_shares, delay_share
from emb_runtime.config.bench import BrakeParameters

START = ("x1_0", "x2_0", "current_offset")
"""Sensitivities to the state at the start of a period and to its load come first: the transition matrix."""
GAIN = 4
"""Of an output of a sample: gains of angle and velocity, the inverse deviation of the innovation, gain of the load."""


@dataclass(frozen=True, eq=False)
class Filter:
    """Innovations of the experiments of a problem under a disturbance."""

    problem: Problem
    walk: float  # q, standard deviation of the velocity's random walk [rad/s per √s]
    load: float = 0.0  # r, standard deviation of the load's random walk, as a current [A per √s]

    def gains(self, z: Floats, weights: Sequence[Floats]) -> list[Floats]:
        """Gains of each experiment along the motion for ``z``, shape (n, 2, 4), in the order of ``GAIN``."""
        gains = [np.zeros((*root.shape, GAIN)) for root in weights]
        self._parts(z, weights, gains, fixed=False)
        return gains

    def jacobian(self, z: Floats, weights: Sequence[Floats], gains: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Whitened innovations with these gains, and their derivatives to z, as :meth:`Problem.jacobian`."""
        return self.problem.stacked(z, self._parts(z, weights, gains, fixed=True))

    def deviance(self, z: Floats, weights: Sequence[Floats]) -> float:
        """Minus twice the logarithm of the likelihood, prior included, but for a constant."""
        gains = self.gains(z, weights)
        errors, _ = self.jacobian(z, weights, gains)
        growth = 0.0
        for root, gain in zip(weights, gains, strict=True):
            counts = root > 0.0
            growth += 2.0 * float(np.sum(np.log(root[counts] / gain[:, :, 2][counts])))
        return float(errors @ errors) + growth

    def _parts(
        self, z: Floats, weights: Sequence[Floats], gains: Sequence[Floats], *, fixed: bool
    ) -> list[tuple[Floats, Floats]]:
        pairs = enumerate(zip(weights, gains, strict=True))
        return [self.followed(z, i, root, gain, fixed=fixed) for i, (root, gain) in pairs]

    def followed(
        self,
        z: Floats,
        i: int,
        root: Floats,
        gain: Floats,
        *,
        fixed: bool = True,
        besides: tuple[str, ...] = (),
        mechanics: Mechanics | None = None,
        parts: tuple[Integers, Floats] | None = None,
        shifted: Floats | float = 0.0,
    ) -> tuple[Floats, Floats]:
        """Whitened innovations of experiment ``i``, and whitened derivatives of the prediction to its unknowns.

        Args:
            z: the unknowns.
            i: number of the experiment.
            root: inverse standard deviations of its samples, shape (n, 2).
            gain: its gains, shape (n, 2, 4); computed in place unless ``fixed``.
            fixed: True if the gains are given.
            besides: further unknowns, after those of ``z``.
            mechanics: other mechanics than those of ``z``.
            parts: unknowns that come last, and their weights in each period, shape (n, m).
            shifted: change of the samples, shape (n, 2).

        Returns:
            Shapes (n, 2) and (n, unknowns, 2).
        """
        problem, experiment = self.problem, self.problem.experiments[i]
        n, names = len(experiment.currents), (*problem.names(i), *besides)
        at = problem.at(z, i)
        x, unknowns, s = at.begin(experiment.before, (*START, *names))
        in_part, counted = (np.zeros(0, np.int64), np.zeros((n, 0))) if parts is None else parts
        unknowns, s = np.append(unknowns, in_part), np.pad(s, ((0, len(in_part)), (0, 0)))
        innovations, shares = np.zeros((n, 2)), np.zeros((n, len(names) + len(in_part), 2))
        given = FilterInput(
            experiment.currents + at.errors.current_offset,
            problem.bench.timing.sample_time,
            max(at.errors.delay, 0.0),
            problem.plant.instruments.measurement_delay,
            np.nan_to_num(experiment.samples) + shifted,
            np.zeros(n) if experiment.late is None else experiment.late,
            self._unreported(i),
            root,
            at.contact + at.offset(problem.plant),
            1.0 + at.errors.velocity_gain,
            self.walk,
            self.load,
            counted,
        )
        moves, results = problem.mechanics(z) if mechanics is None else mechanics, Innovations(innovations, shares)
        covariance = self._uncertainty(i)
        loop = compiled(march_filtered)
        loop(moves, at.brake, given, unknowns, x, s, covariance, fixed, gain, results)
        if at.errors.delay < 0.0:  # to first order, as in the simulation
            innovations -= at.errors.delay * shares[:, names.index("delay")]
        return innovations, shares

    def _unreported(self, experiment: int) -> Floats:
        """Variances of the currents of an experiment [A²], zero in periods with a report, shape (n,)."""
        data = self.problem.experiments[experiment]
        lost = np.zeros(len(data.currents)) if data.assumed is None else np.isfinite(data.assumed)
        return self.problem.bench.limits.current**2 * lost

    def _uncertainty(self, experiment: int) -> Floats:
        """Covariance of angle, velocity and load at the start; zero for what is estimated or exact."""
        data, names = self.problem.experiments[experiment], self.problem.names(experiment)
        covariance = np.zeros((3, 3))
        if not data.from_origin and "x1_0" not in names and "offset" not in names:
            covariance[0, 0] = data.slack**2
        if data.velocity != 0.0 and "x2_0" not in names:
            covariance[1, 1] = self.problem.bench.noise.velocity**2
        return covariance


@dataclass(frozen=True, eq=False)
class FilterPrediction:
    """Prediction of a filter at an estimate, a :class:`emb_bench.estimate.effects.Prediction`: one step ahead."""

    filter: Filter
    z: Floats
    weights: Sequence[Floats]
    gains: Sequence[Floats]

    def derivatives(self, experiment: int, names: tuple[str, ...]) -> Floats:
        """As :class:`~emb_bench.estimate.effects.Prediction`."""
        return self._followed(experiment, besides=names)[1][:, -len(names) :]

    def parts(self, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """As :class:`~emb_bench.estimate.effects.Prediction`."""
        return self._followed(experiment, parts=(unknowns, shares))[1][:, -len(unknowns) :]

    def whitened_samples(self, experiment: int, mechanics: Mechanics) -> Floats:
        """As :class:`~emb_bench.estimate.effects.Prediction`, less the samples, which cancel in differences."""
        return -self._followed(experiment, mechanics=mechanics)[0]

    def whitened(self, experiment: int, shift: Floats) -> Floats:
        """As :class:`~emb_bench.estimate.effects.Prediction`."""
        return self._followed(experiment, shifted=shift)[0] - self._followed(experiment)[0]

    def motion(self, experiment: int) -> Floats:
        """Prediction of each sample from those before, shape (n, 2)."""
        root, scale = self.weights[experiment], self.gains[experiment][:, :, 2]
        innovations, _ = self._followed(experiment)
        expected, instants = np.zeros_like(root), np.arange(len(root))
        for output in range(2):
            counts = root[:, output] > 0.0
            if counts.any():
                seen = self.filter.problem.experiments[experiment].samples[counts, output]
                at = seen - innovations[counts, output] / scale[counts, output]
                expected[:, output] = np.interp(instants, instants[counts], at)
        return expected

    def _followed(self, experiment: int, **changes: Any) -> tuple[Floats, Floats]:
        """:meth:`Filter.followed` at the estimate, with some of its options."""
        return self.filter.followed(self.z, experiment, self.weights[experiment], self.gains[experiment], **changes)


class FilterInput(NamedTuple):
    """Experiment of n samples and instruments, as a filter takes them."""

    currents: Floats  # [A], shape (n,)
    t_s: float  # Period [s]
    late: float  # Share of the period in which the command before still acts
    delay: int  # Periods between sampling and sending
    samples: Floats  # Angle [rad] and velocity [rad/s], shape (n, 2)
    stamps: Floats  # Lateness of each sample after the grid [s], shape (n,)
    unreported: Floats  # Variances of the currents [A²], zero with a report, shape (n,)
    root: Floats  # Inverse standard deviations of the samples, zero where one does not count, shape (n, 2)
    bias: float  # Reading at the angle zero [rad]
    velocity_scale: float  # Reading at a velocity of 1 rad/s [rad/s]
    walk: float  # q [rad/s per √s]
    load: float  # r [A per √s]
    parts: Floats  # Weights of the last unknowns in each period, shape (n, m)


class Innovations(NamedTuple):
    """Results of a filter."""

    errors: Floats  # Innovations over their standard deviations, shape (n, 2)
    shares: Floats  # Derivatives of the reading to the unknowns after ``START``, likewise, shape (n, unknowns, 2)


def march_filtered(
    mechanics: Mechanics,
    p: BrakeParameters,
    given: FilterInput,
    unknowns: Integers,
    x: Floats,
    s: Floats,
    covariance: Floats,
    fixed: bool,
    gains: Floats,
    results: Innovations,
) -> None:
    """One experiment through the filter, which corrects the state between two periods; runs as it is or compiled.

    The ``unknowns`` begin with ``START``. State ``x``, its sensitivities ``s``, the ``covariance`` of angle, velocity
    and load, shape (3, 3), and ``results`` change in place; so do the ``gains``, unless they are ``fixed``.
    """
    currents, t_s, late, delay, samples, stamps, unreported, root, bias, velocity_scale, walk, load, parts = given
    innovations, shares = results
    before, acting, first, every = float(x[3]), 0.0, len(START), unknowns.copy()
    follows = np.zeros(unknowns.shape[0])  # derivatives of the load
    for i in range(currents.shape[0]):
        k, acceleration, tau = i - delay, 0.0, stamps[i]
        if k >= 0:  # the first samples are of the brake at its start
            u, velocity = float(currents[k]), float(x[1])
            for j in range(first):
                for m in range(s.shape[1]):
                    s[j, m] = 0.0
            s[0, 0] = s[1, 1] = 1.0
            advance_shares(mechanics, p, x, before + acting, u + acting, t_s, late, unknowns, parts, k, every, s)
            before = u
            for j in range(first, unknowns.shape[0]):
                s[j, 0] += s[2, 0] * follows[j]
                s[j, 1] += s[2, 1] * follows[j]
            if not fixed:
                _spread(covariance, s, walk * walk, load * load, t_s)
                _push(covariance, unreported[k], p.k_m / p.J * t_s, t_s)
            acceleration = (x[1] - velocity) / t_s
        for output in range(2):  # angle, then velocity; the brake goes on to its stamp as it went through the period
            if root[i, output] == 0.0:
                continue
            shown = reading(x[0], x[1], acceleration, tau, bias, velocity_scale)[output]
            h1, h2 = (1.0, tau) if output == 0 else (0.0, velocity_scale)
            if not fixed:
                _weigh(covariance, h1, h2, 1.0 / root[i, output] ** 2, gains[i, output])
            k1, k2, scale, k3 = gains[i, output, 0], gains[i, output, 1], gains[i, output, 2], gains[i, output, 3]
            surprise = samples[i, output] - shown
            innovations[i, output] = surprise * scale
            for j in range(first, unknowns.shape[0]):
                share = h1 * s[j, 0] + h2 * s[j, 1] + sensor_share(int(unknowns[j]), output, shown / velocity_scale)
                shares[i, j - first, output] = share * scale / delay_share(int(unknowns[j]), late)
                s[j, 0] -= k1 * share
                s[j, 1] -= k2 * share
                follows[j] -= k3 * share
            x[0] += k1 * surprise
            x[1] += k2 * surprise
            acting += k3 * surprise
            x[3] += k3 * surprise  # a load is neither late nor does it lag


def _spread(covariance: Floats, s: Floats, walk: float, load: float, t_s: float) -> None:
    """Carry a covariance through a period: F P F^T + Q, with the load's part of Q as for a free inertia."""
    f, g1, g2 = np.eye(3), s[2, 0], s[2, 1]
    f[0, 0], f[0, 1], f[0, 2] = s[0, 0], s[1, 0], g1
    f[1, 0], f[1, 1], f[1, 2] = s[0, 1], s[1, 1], g2
    carried = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                for n in range(3):
                    carried[i, j] += f[i, m] * covariance[m, n] * f[j, n]
    _copy(carried, covariance)
    covariance[0, 0] += walk * t_s**3 / 3.0 + load * t_s * g1 * g1 / 5.0
    covariance[1, 1] += walk * t_s + load * t_s * g2 * g2 / 3.0
    covariance[2, 2] += load * t_s
    across = (walk * t_s**2 / 2.0 + load * t_s * g1 * g2 / 4.0, load * t_s * g1 / 3.0, load * t_s * g2 / 2.0)
    covariance[0, 1] += across[0]
    covariance[1, 0] += across[0]
    covariance[0, 2] += across[1]
    covariance[2, 0] += across[1]
    covariance[1, 2] += across[2]
    covariance[2, 1] += across[2]


def _copy(source: Floats, target: Floats) -> None:
    for i in range(3):
        for j in range(3):
            target[i, j] = source[i, j]


def _push(covariance: Floats, variance: float, change: float, t_s: float) -> None:
    """Add the effect of an unknown current of a ``variance`` [A²] on a free inertia, also if the model sticks.

    A current of 1 A changes its velocity by ``change`` in a period [rad/s].
    """
    if variance > 0.0:
        way = 0.5 * change * t_s
        covariance[0, 0] += variance * way * way
        covariance[0, 1] += variance * way * change
        covariance[1, 0] += variance * way * change
        covariance[1, 1] += variance * change * change


def _weigh(covariance: Floats, h1: float, h2: float, variance: float, gain: Floats) -> None:
    """Gains of a measurement, and the covariance after it in Joseph's form, which stays positive."""
    c, k = np.empty(3), np.empty(3)
    for i in range(3):
        c[i] = covariance[i, 0] * h1 + covariance[i, 1] * h2
    total = h1 * c[0] + h2 * c[1] + variance
    for i in range(3):
        k[i] = c[i] / total
    reduced, after = np.eye(3), np.zeros((3, 3))
    for i in range(3):
        reduced[i, 0] -= k[i] * h1
        reduced[i, 1] -= k[i] * h2
    for i in range(3):
        for j in range(3):
            after[i, j] = k[i] * k[j] * variance
            for m in range(3):
                for n in range(3):
                    after[i, j] += reduced[i, m] * covariance[m, n] * reduced[j, n]
    _copy(after, covariance)
    gain[0], gain[1], gain[2], gain[3] = k[0], k[1], 1.0 / math.sqrt(total), k[2]
