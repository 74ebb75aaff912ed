"""Innovations of an extended Kalman filter: the part of each sample that those before it do not predict.

The filter predicts with the exact brake. The covariance of angle and velocity is carried through a period by the exact
sensitivities to the state at its start, jumps at reversals included; a brake that sticks forgets its velocity. Between
samples the velocity does a random walk of q rad/s per √s, a torque disturbance as seen by the inertia, which over a
period T adds q² [[T³/3, T²/2], [T²/2, T]] to the covariance. Where the brake is in its hysteresis, and the current of a
motor that lags, are taken as the model has them.

The outputs of a sample are taken one after the other, which whitens them as the Cholesky factor of their covariance
does. One that was lost, or that does not count, is predicted through.

**Derivatives** are those of the innovations with the gains held: then the sensitivities s of the state obey the update
s ← (I − K H) s, exactly. What they leave out, the dependence of the gains on the unknowns, multiplies white noise.

Without disturbance and with a known start the gains are zero, and the innovations are the residuals of output error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emb_bench.brake.motion import SENSITIVE, Floats, Integers
from emb_bench.brake.parameters import OFFSET, VELOCITY_GAIN
from emb_bench.compiled import compiled
from emb_bench.estimate.prediction import Problem
from emb_bench.sim.open_loop import advance_period, delay_share
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics

START = ("x1_0", "x2_0")
"""Sensitivities to the state at the start of a period come first: the transition matrix."""
GAIN = 3
"""Of an output of a sample: gains of the angle and of the velocity, and the inverse deviation of the innovation."""


@dataclass(frozen=True, eq=False)
class Filter:
    """Innovations of the records of a problem under a disturbance."""

    problem: Problem
    walk: float
    """q, standard deviation of the velocity's random walk [rad/s per √s]."""

    def gains(self, z: Floats, weights: Sequence[Floats]) -> list[Floats]:
        """Gains of each record along the motion for ``z``, shape (n, 2, 3), in the order of ``GAIN``.

        Args:
            z: the unknowns.
            weights: inverse standard deviations of the samples of each record, zero where one does not count.
        """
        gains = [np.zeros((*root.shape, GAIN)) for root in weights]
        self._parts(z, weights, gains, False, ())
        return gains

    def jacobian(self, z: Floats, weights: Sequence[Floats], gains: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Whitened innovations with these gains, and their derivatives to z, as :meth:`Problem.jacobian`."""
        return self.problem.stacked(z, self._parts(z, weights, gains, True, ()))

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
        self, z: Floats, weights: Sequence[Floats], gains: Sequence[Floats], held: bool, besides: tuple[str, ...]
    ) -> list[tuple[Floats, Floats]]:
        return [
            self.followed(z, i, root, gain, held, besides)
            for i, (root, gain) in enumerate(zip(weights, gains, strict=True))
        ]

    def followed(
        self,
        z: Floats,
        i: int,
        root: Floats,
        gain: Floats,
        held: bool = True,
        besides: tuple[str, ...] = (),
        *,
        mechanics: Mechanics | None = None,
        added: Floats | float = 0.0,
        shifted: Floats | float = 0.0,
    ) -> tuple[Floats, Floats]:
        """Innovations of one record over their standard deviations, and what unknowns add to what is shown.

        Args:
            z: the unknowns.
            i: number of the record.
            root: inverse standard deviations of its samples, shape (n, 2).
            gain: its gains, shape (n, 2, 3); become those if they are not held.
            held: True if the gains are given.
            besides: further unknowns, which come last.
            mechanics: how another brake moves; without, that of ``z``.
            added: current that acts besides [A].
            shifted: what is added to the samples, shape (n, 2).

        Returns:
            Shapes (n, 2) and (n, unknowns, 2).
        """
        problem, record, t_s = self.problem, self.problem.records[i], self.problem.bench.timing.sample_time
        n, names = len(record.currents), (*problem.names(i), *besides)
        start = problem.opening(z, i, (*START, *names))
        innovations, shares = np.zeros((n, 2)), np.zeros((n, len(names), 2))
        compiled(march_filtered)(
            problem.mechanics(z) if mechanics is None else mechanics,
            start.p,
            start.x,
            self._uncertainty(i),
            record.currents + start.current_offset + added,
            t_s,
            max(start.late, 0.0),
            problem.plant.instruments.measurement_delay,
            np.nan_to_num(record.samples) + shifted,
            np.zeros(n) if record.late is None else record.late,
            root,
            start.contact + start.offset,
            1.0 + start.velocity_gain,
            self.walk,
            start.chosen,
            start.s,
            held,
            gain,
            innovations,
            shares,
        )
        if start.late < 0.0:  # to first order, as in the simulation
            innovations -= start.late * shares[:, names.index("delay")]
        return innovations, shares

    def _uncertainty(self, record: int) -> Floats:
        """Variances and covariance at the start: of what was measured and is not estimated."""
        data, asked = self.problem.records[record], self.problem.names(record)
        covariance = np.zeros(3)
        if not data.from_origin and "x1_0" not in asked and "offset" not in asked:
            covariance[0] = data.slack**2
        if data.velocity != 0.0 and "x2_0" not in asked:
            covariance[2] = self.problem.bench.noise.velocity**2
        return covariance


@dataclass(frozen=True, eq=False)
class Followed:
    """Innovations at an estimate, as score tests take them: :class:`emb_bench.estimate.suspects.Shown`."""

    filter: Filter
    z: Floats
    weights: Sequence[Floats]
    gains: Sequence[Floats]

    def columns(self, record: int, names: tuple[str, ...]) -> Floats:
        """Derivatives of what is shown to other unknowns, in standard deviations, shape (n, names, 2)."""
        _, shares = self.filter.followed(self.z, record, self.weights[record], self.gains[record], besides=names)
        return shares[:, -len(names) :]

    def shown(self, record: int, mechanics: Mechanics, added: Floats | float = 0.0) -> Floats:
        """Expected less measured samples of another brake under the same currents, and some more [A], whitened."""
        innovations, _ = self.filter.followed(
            self.z, record, self.weights[record], self.gains[record], mechanics=mechanics, added=added
        )
        return -innovations

    def whitened(self, record: int, shift: Floats) -> Floats:
        """A small change of what is shown, shape (n, 2), as the innovations have it."""
        weights, gains = self.weights[record], self.gains[record]
        whole, _ = self.filter.followed(self.z, record, weights, gains, shifted=shift)
        without, _ = self.filter.followed(self.z, record, weights, gains)
        return whole - without

    def motion(self, record: int) -> Floats:
        """Angle and velocity that are expected of each sample from those before, shape (n, 2)."""
        root, scale = self.weights[record], self.gains[record][:, :, 2]
        innovations, _ = self.filter.followed(self.z, record, root, self.gains[record])
        expected, instants = np.zeros_like(root), np.arange(len(root))
        for output in range(2):
            counts = root[:, output] > 0.0
            if counts.any():
                seen = self.filter.problem.records[record].samples[counts, output]
                at = seen - innovations[counts, output] / scale[counts, output]
                expected[:, output] = np.interp(instants, instants[counts], at)
        return expected


def march_filtered(
    mechanics: Mechanics,
    p: BrakeParameters,
    x: Floats,
    covariance: Floats,
    currents: Floats,
    t_s: float,
    late: float,
    delay: int,
    samples: Floats,
    stamps: Floats,
    root: Floats,
    bias: float,
    velocity_scale: float,
    walk: float,
    chosen: Integers,
    s: Floats,
    held: bool,
    gains: Floats,
    innovations: Floats,
    shares: Floats,
) -> None:
    """One record through the filter, which corrects the state between two periods; runs as it is or compiled.

    Args:
        mechanics: how the brake moves.
        p: its parameters.
        x: state, in place.
        covariance: of angle and velocity: P11, P12, P22, shape [3], in place.
        currents: shape (n,) [A].
        t_s: period [s].
        late: share of the period in which the command before still acts.
        delay: periods that a sample waits before it is sent.
        samples: angle [rad] and velocity [rad/s], shape (n, 2).
        stamps: how much later than on the grid each was taken [s], shape (n,).
        root: inverse standard deviations of the samples, zero where one does not count, shape (n, 2).
        bias: what is shown of a brake at the angle zero [rad].
        velocity_scale: what is shown of a velocity of 1 rad/s [rad/s].
        walk: q [rad/s per √s].
        chosen: indices of the unknowns, ``START`` first.
        s: sensitivities of the state, in place.
        held: True if the gains are given; else they are computed.
        gains: shape (n, 2, 3), in the order of ``GAIN``.
        innovations: become those, over their standard deviation, shape (n, 2).
        shares: become what the unknowns after ``START`` add to what is shown, in the same unit, shape (n, unknowns, 2).
    """
    before = float(x[3])
    for i in range(currents.shape[0]):
        k, acceleration, tau = i - delay, 0.0, stamps[i]
        if k >= 0:  # the first samples are of the brake at its start
            u, velocity = float(currents[k]), float(x[1])
            for j in range(2):
                for m in range(SENSITIVE):
                    s[j, m] = 0.0
                s[j, j] = 1.0
            advance_period(mechanics, p, x, before, u, t_s, late, chosen, s)
            before = u
            if not held:
                _spread(covariance, s, walk * walk, t_s)
            acceleration = (x[1] - velocity) / t_s
        for output in range(2):  # angle, then velocity; the brake goes on to its stamp as it went through the period
            if root[i, output] == 0.0:
                continue
            if output == 0:
                h1, h2 = 1.0, tau
                shown = x[0] + bias + tau * (x[1] + 0.5 * tau * acceleration)
            else:
                h1, h2 = 0.0, velocity_scale
                shown = velocity_scale * (x[1] + tau * acceleration)
            if not held:
                _weigh(covariance, h1, h2, 1.0 / root[i, output] ** 2, gains[i, output])
            k1, k2, scale = gains[i, output, 0], gains[i, output, 1], gains[i, output, 2]
            surprise = samples[i, output] - shown
            innovations[i, output] = surprise * scale
            for j in range(2, chosen.shape[0]):
                share = h1 * s[j, 0] + h2 * s[j, 1] + _of_a_sensor(int(chosen[j]), output, shown / velocity_scale)
                shares[i, j - 2, output] = share * scale / delay_share(int(chosen[j]), late)
                s[j, 0] -= k1 * share
                s[j, 1] -= k2 * share
            x[0] += k1 * surprise
            x[1] += k2 * surprise


def _of_a_sensor(unknown: int, output: int, velocity: float) -> float:
    """Derivative of what a sensor shows to an unknown of its own."""
    if output == 0:
        return 1.0 if unknown == OFFSET else 0.0
    return velocity if unknown == VELOCITY_GAIN else 0.0


def _spread(covariance: Floats, s: Floats, intensity: float, t_s: float) -> None:
    """Carry a covariance through a period: F P F^T + Q."""
    f11, f12, f21, f22 = s[0, 0], s[1, 0], s[0, 1], s[1, 1]
    p11, p12, p22 = covariance[0], covariance[1], covariance[2]
    a1, a2 = f11 * p11 + f12 * p12, f11 * p12 + f12 * p22
    b1, b2 = f21 * p11 + f22 * p12, f21 * p12 + f22 * p22
    covariance[0] = a1 * f11 + a2 * f12 + intensity * t_s**3 / 3.0
    covariance[1] = a1 * f21 + a2 * f22 + intensity * t_s**2 / 2.0
    covariance[2] = b1 * f21 + b2 * f22 + intensity * t_s


def _weigh(covariance: Floats, h1: float, h2: float, variance: float, gain: Floats) -> None:
    """Gains of a measurement, and the covariance after it in Joseph's form, which stays positive."""
    p11, p12, p22 = covariance[0], covariance[1], covariance[2]
    c1, c2 = p11 * h1 + p12 * h2, p12 * h1 + p22 * h2
    whole = h1 * c1 + h2 * c2 + variance
    k1, k2 = c1 / whole, c2 / whole
    a11, a12, a21, a22 = 1.0 - k1 * h1, -k1 * h2, -k2 * h1, 1.0 - k2 * h2
    covariance[0] = a11 * a11 * p11 + 2.0 * a11 * a12 * p12 + a12 * a12 * p22 + k1 * k1 * variance
    covariance[1] = a11 * (a21 * p11 + a22 * p12) + a12 * (a21 * p12 + a22 * p22) + k1 * k2 * variance
    covariance[2] = a21 * a21 * p11 + 2.0 * a21 * a22 * p12 + a22 * a22 * p22 + k2 * k2 * variance
    gain[0], gain[1], gain[2] = k1, k2, 1.0 / math.sqrt(whole)
