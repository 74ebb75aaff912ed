"""Effects that a model lacks or holds fixed: a row for each, with the change of the samples per unit of it.

Score tests (:mod:`emb_bench.estimate.suspects`), the uncertainty budget, the average over effects that may be there
(:mod:`emb_bench.estimate.average`) and the expected interval (:mod:`emb_bench.estimate.expected`) come from these rows.
A new effect is a row in :data:`EFFECTS`, and a field of ``[systematic]`` of the bench file for its prior.

The regressor of an effect is the plant's sensitivity, if it has one; a secant from the null value, if the effect has a
threshold there; or the sensitivity to a parameter's torque with a weight in each period, if the plant lacks the effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from emb_bench.brake.motion import Floats, Integers, is_plain
from emb_bench.brake.parameters import COMMAND, F_V, FEATURES, K_1, K_M, PARAMETERS, SI, T_C, Quantity, quantity
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.machine import Machine
from emb_bench.config.plants import DIRECTED, EXACT, Mechanics, Plant
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import (
    FACTOR,
    SYSTEMATIC,
    Contribution,
    EstimationProblem,
    Suspect,
    Unknown,
    freed,
    has_time_for_a_delay,
    searched,
)
from emb_bench.experiment.simulate import Trajectory
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Limits

SLOW = 30.0  # Stribeck velocity of the score test of static friction, for a plant without one [rad/s]
SMALLEST = 1e-12  # Share of a period that counts, per unit of an effect; a sensitivity is divided by it
SMALL = 1e-6  # Step of the finite differences of samples [rad, rad/s]

DRIFTS = tuple(f"{name}_drift" for name in PARAMETER_NAMES)
"""Linear changes of the parameters, as shares of them from the start of a run to its end."""
ANGLE_SCALE, CURRENT_SCALE, TIME_SCALE = SCALES = "angle_scale", "current_scale", "time_scale"
"""Relative errors of the scales of angle and current, and of the clock."""
LAGGING = "velocity_lag"  # Explains a misfit if an observer is found in the velocity


# ---- the model at an estimate ----


class Prediction(Protocol):
    """Predicted samples of each experiment at an estimate, in standard deviations of the residuals."""

    def derivatives(self, experiment: int, names: tuple[str, ...]) -> Floats:
        """Derivatives to further unknowns, shape (n, names, 2)."""

    def parts(self, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """Derivatives to unknowns with a weight in each period, ``shares`` of shape (n, m), shape (n, m, 2)."""

    def whitened_samples(self, experiment: int, mechanics: Mechanics) -> Floats:
        """Samples of a brake with other ``mechanics`` under the same currents, shape (n, 2)."""

    def whitened(self, experiment: int, shift: Floats) -> Floats:
        """A small change of the samples [rad, rad/s], in the unit of the residuals, shape (n, 2)."""

    def motion(self, experiment: int) -> Floats:
        """Predicted angle [rad] and velocity [rad/s], shape (n, 2)."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """Prediction of output error."""

    problem: Problem
    z: Floats
    weights: Sequence[Floats]
    trajectories: Sequence[Trajectory] | None = None  # Trajectory of each experiment, if they have been computed,
    besides: tuple[str, ...] = ()  # and their sensitivities besides those of the problem

    @cached_property
    def _mechanics(self) -> Mechanics:
        return self.problem.mechanics(self.z)

    @cached_property
    def _motion(self) -> list[Floats]:
        found = self.trajectories or [self.problem.motion(self.z, i) for i in range(len(self.problem.experiments))]
        return [one.samples for one in found]

    def derivatives(self, experiment: int, names: tuple[str, ...]) -> Floats:
        """As :class:`Prediction`."""
        first, computed = len(self.problem.indices(experiment)), self.trajectories
        is_computed = computed is not None and names == self.besides
        at = computed[experiment] if computed and is_computed else self.problem.predict(self.z, experiment, names)
        return at.sensitivities[:, first : first + len(names)] * self.weights[experiment][:, None]

    def parts(self, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """As :class:`Prediction`."""
        return self.problem.parts(self.z, experiment, unknowns, shares) * self.weights[experiment][:, None]

    def whitened_samples(self, experiment: int, mechanics: Mechanics) -> Floats:
        """As :class:`Prediction`."""
        nominal = mechanics == self._mechanics
        samples = self._motion[experiment] if nominal else self.problem.motion(self.z, experiment, mechanics).samples
        return samples * self.weights[experiment]

    def whitened(self, experiment: int, shift: Floats) -> Floats:
        """As :class:`Prediction`."""
        return shift * self.weights[experiment]

    def motion(self, experiment: int) -> Floats:
        """As :class:`Prediction`."""
        return self._motion[experiment]


class Path(NamedTuple):
    """Motion of the model in an experiment."""

    brake: BrakeParameters
    limits: Limits
    passed: Floats  # Share of the experiment that has passed, -½ to ½, shape (n,)
    current: Floats  # Shape (n,) [A]
    angles: Floats  # From contact, at the ends of the periods, shape (n + 1,) [rad]
    velocities: Floats  # At the same, shape (n + 1,) [rad/s]


def regressors(
    problem: Problem, z: Floats, prediction: Prediction, jacobian: Floats, names: tuple[str, ...]
) -> dict[str, Floats]:
    """Regressor of each effect that the model lacks, of those named: whitened samples per unit of the effect, by name.

    As long as all residuals, whose derivatives to z are the ``jacobian``.
    """
    ends = np.cumsum([0, *(experiment.samples.size for experiment in problem.experiments)]).tolist()
    at = [
        Linearised(problem, z, prediction, i, jacobian[begin:end], names)
        for i, (begin, end) in enumerate(pairwise(ends))
    ]
    found = dict[str, Floats]()
    for name in names:
        row = EFFECTS[name]
        if row.of_the_spring and problem.bench.brake.k_1 == 0.0:
            continue
        parts = [part.ravel() for one in at if (part := row.regressor(one, name)) is not None]
        if parts:
            found[name] = np.zeros(len(jacobian))
            found[name][: ends[-1]] = np.concatenate(parts)
        if name == ANGLE_SCALE:  # the angles at rest before the experiments follow the samples among the residuals
            rests = [
                (problem.experiments[i].angle - at[i].offset) / problem.experiments[i].slack for i in problem.rests()
            ]
            found[name][ends[-1] : ends[-1] + len(rests)] = rests
    return found


@dataclass(frozen=True, eq=False)
class Linearised:
    """Model linearised at an estimate, along one experiment; its regressors are whitened samples, shape (n, 2).

    A regressor is None if the model has the effect, or its brake cannot have it.
    """

    problem: Problem
    z: Floats
    prediction: Prediction
    experiment: int
    jacobian: Floats  # Derivatives of the residuals of its samples to z, shape (2 n, p)
    names: tuple[str, ...]  # Requested effects

    def sensitivity(self, name: str) -> Floats | None:
        """The sensitivity to an unknown of the brake or of its instruments."""
        return None if name in _estimated(self.problem) else self._sensitivities.get(name)

    def secant(self, name: str) -> Floats | None:
        """The secant from a feature's value to a little more."""
        step, before = PARAMETERS[name].step, self.mechanics
        after = None if name in _estimated(self.problem) else _with(before, name, step)
        if after is None:
            return self._turned.get(name)
        slow = after.stribeck_velocity
        if slow not in self._slowed:
            self._slowed[slow] = self.prediction.whitened_samples(
                self.experiment, before._replace(stribeck_velocity=slow)
            )
        return (self.prediction.whitened_samples(self.experiment, after) - self._slowed[slow]) / step

    def turned(self, name: str) -> Floats | None:
        """The sensitivity to a parameter's torque with a weight in each period."""
        return self._turned[name]

    def lag(self, _: str) -> Floats | None:
        """A lag of the velocity; None if the plant has an observer."""
        if self._is_observed:
            return None
        before, velocity = (
            self.problem.experiments[self.experiment].velocity,
            self.prediction.motion(self.experiment)[:, 1],
        )
        slope = np.diff(velocity, prepend=before) / self.problem.bench.timing.sample_time
        return self._small(np.stack([np.zeros_like(slope), -slope], axis=1))

    def angle_scale(self, _: str) -> Floats:
        """A larger angle; a velocity by an observer follows it."""
        return self._small((self.prediction.motion(self.experiment) - [self.offset, 0.0]) * [1.0, self._is_observed])

    def current_scale(self, _: str) -> Floats:
        """A larger current, which acts as a larger k_m does."""
        return self._sensitivities["k_m"]

    def time_scale(self, _: str) -> Floats:
        """A faster clock by the factor s: torques scale with s⁻², as with a smaller J, and that of f_v with s⁻¹."""
        return 2.0 * self._sensitivities["J"] + self._sensitivities["f_v"]

    def _small(self, shift: Floats) -> Floats:
        """A change of the samples [rad, rad/s], whitened, to first order."""
        return self.prediction.whitened(self.experiment, SMALL * shift) / SMALL

    @property
    def _is_observed(self) -> bool:
        return self.problem.plant.instruments.observer_bandwidth > 0.0

    @cached_property
    def mechanics(self) -> Mechanics:
        """Those of the estimate."""
        return self.problem.mechanics(self.z)

    @cached_property
    def offset(self) -> float:
        """Reading of the encoder at the origin [rad]."""
        return self.problem.at(self.z, self.experiment).offset(self.problem.plant)

    @cached_property
    def _slowed(self) -> dict[float, Floats]:
        """Samples with a Stribeck velocity and unchanged static friction, by that velocity."""
        return {self.mechanics.stribeck_velocity: self.prediction.whitened_samples(self.experiment, self.mechanics)}

    @cached_property
    def _sensitivities(self) -> dict[str, Floats]:
        """Sensitivities to fixed parameters, and to k_m, f_v and J even if they are estimated."""
        names, unknowns = lacked_sensitivities(self.problem, self.names), [u.name for u in self.problem.unknowns]
        found: dict[str, Floats] = {
            n: -self.jacobian[:, unknowns.index(n)].reshape(-1, 2) for n in ("k_m", "f_v", "J") if n in unknowns
        }
        if names:
            found |= zip(names, self.prediction.derivatives(self.experiment, names).transpose(1, 0, 2), strict=True)
        return found

    @cached_property
    def _turned(self) -> dict[str, Floats]:
        shares = self.shares()
        if not shares:
            return {}
        unknowns, counted = zip(*shares.values(), strict=True)
        moved = self.prediction.parts(self.experiment, np.array(unknowns), np.stack(counted, axis=1))
        return dict(zip(shares, moved.transpose(1, 0, 2), strict=True))

    def shares(self) -> dict[str, tuple[int, Floats]]:
        """Parameter whose torque acts as an effect does, and its weight in each period, by name."""
        path, m, found = self._path(), self.mechanics, dict[str, tuple[int, Floats]]()
        for name in self.names:
            torque = EFFECTS[name].torque
            if torque is not None and (name != "play" or (m.play == 0.0 and m.solver == EXACT)):
                share = torque[1](path)
                found[name] = torque[0], np.where(np.abs(share) < SMALLEST, 0.0, share)
        return found

    def _path(self) -> Path:
        """The predicted motion."""
        at, motion = self.problem.at(self.z, self.experiment), self.prediction.motion(self.experiment)
        n, delay = len(motion), self.problem.plant.instruments.measurement_delay
        ends = np.concatenate([motion[delay:], np.repeat(motion[-1:], min(delay, n), axis=0)])[:n]
        return Path(
            at.brake,
            self.problem.bench.limits,
            (np.arange(n) + 0.5) / n - 0.5,
            self.problem.experiments[self.experiment].currents + at.errors.current_offset,
            np.append(at.start[0], ends[:, 0] - self.offset) - at.contact,
            np.append(at.start[1], ends[:, 1]),
        )


def _estimated(problem: Problem) -> set[str]:
    return {unknown.name for unknown in problem.unknowns}


def lacked_sensitivities(problem: Problem, names: Iterable[str]) -> tuple[str, ...]:
    """Fixed parameters of the model with a sensitivity: k_m, f_v and J, and the named effects."""
    plant, lacked = problem.plant, {"k_m", "f_v", "J", *names} - _estimated(problem)
    if not has_time_for_a_delay(plant):
        lacked -= {"delay"}
    if plant.instruments.observer_bandwidth > 0.0:
        lacked -= {"velocity_gain"}
    if problem.bench.machine is None or not is_plain(plant.mechanics) or _estimated(problem) & {*FEATURES}:
        lacked -= {DIRECTED}
    return tuple(name for name, row in EFFECTS.items() if row.regressor is Linearised.sensitivity and name in lacked)


def _with(m: Mechanics, name: str, step: float) -> Mechanics | None:
    """The mechanics with a small amount of an effect added; None if they cannot have it, or have no play yet."""
    if m.solver != EXACT or (name == "play" and m.play == 0.0) or (name == "hysteresis" and m.play > 0.0):
        return None
    changed = m._replace(**{name: getattr(m, name) + step})
    if name in ("break_away", "f_l") and m.stribeck_velocity == 0.0:
        changed = changed._replace(stribeck_velocity=SLOW)
    return changed


# ---- the rows ----


class Effect(NamedTuple):
    """One row."""

    effect: str  # Noun phrase
    remedy: str
    regressor: Callable[[Linearised, str], Floats | None]  # Of one unit
    unit: str = ""
    prior: str = ""  # Key of ``[systematic]`` with the prior deviation; empty without a prior
    positive: bool = False  # Only positive amounts are tested
    torque: tuple[int, Callable[[Path], Floats]] | None = None
    """Parameter, and the weight of its torque in each period per unit of the effect."""
    alone: bool = False
    """Not part of the joint test, which low-frequency noise would fail because of it."""
    tested: bool = True  # There is a score test of it
    is_certain: bool = False  # A constant with some error in every brake
    of_the_spring: bool = False  # A machine without a spring cannot have it


def _mean(of: Callable[[Floats], Floats], ends: Floats) -> Floats:
    """Means over periods of a function of a number that changes linearly between these ends (Simpson)."""
    first, last = ends[:-1], ends[1:]
    mean: Floats = (of(first) + 4.0 * of(0.5 * (first + last)) + of(last)) / 6.0
    return mean


def _clearance(at: Path) -> Floats:
    """Decrease of the clamping torque by a clearance, per size of it, as a current [A/rad]: the nut lags the screw."""
    play, behind = PARAMETERS["play"].step, np.empty(len(at.angles))
    compiled(_behind)(at.angles, play, behind)
    result: Floats = at.brake.gamma * at.brake.k_1 / at.brake.k_m * 0.5 * (behind[1:] + behind[:-1]) / play
    return result


def _behind(angles: Floats, play: float, behind: Floats) -> None:
    """Fills ``behind`` with the angle of contact that the nut lags the screw [rad]."""
    nut = angles[0]
    for k in range(len(angles)):
        nut = min(max(nut, angles[k] - 0.5 * play), angles[k] + 0.5 * play)
        behind[k] = max(angles[k], 0.0) - max(nut, 0.0)


def _decaying(speed: float) -> Callable[[Path], Floats]:
    return lambda at: _mean(lambda v: np.exp(-((v / speed) ** 2)), at.velocities)


def _ripple(wave: Callable[[Floats], Floats]) -> Callable[[Path], Floats]:
    return lambda at: at.brake.T_c / at.brake.k_m * _mean(wave, at.angles)


def _turning(effect: str, remedy: str, prior: str, unknown: int, share: Callable[[Path], Floats]) -> Effect:
    """An effect that acts as a weighted torque of a parameter, or as a current [A]."""
    return Effect(effect, remedy, Linearised.turned, prior=prior, torque=(unknown, share), alone=True)


def _drift(name: str, unknown: int, remedy: str) -> Effect:
    """A linear drift by 100 % of the parameter over the run, zero in the middle."""
    row = _turning(f"a change of {name} over the run", remedy, "drift", unknown, lambda at: at.passed)
    return row._replace(alone=name != "k_m", of_the_spring=name == "k_1")


_STRIBECK = PARAMETERS["break_away"].remedy
_SLOWER = f"{_STRIBECK}, or lower the velocity in [limits] of the bench file and excite again"
_WALKS = "allow for a disturbance: --method pem"
_CALIBRATE = "calibrate the current of the drive"
_WARM = "begin when all that moves is warm, or use a shorter run"
_TURN = "a torque that changes over a turn", _WALKS, "ripple", COMMAND
_STIFF = "a stiffness that changes over a turn", _WALKS, "stiffness_ripple", K_1
_SLOWLY = "a friction that decays over about {} rad/s"
_PRIORS = {"J": "inertia", "contact": "", "x1_0": "", "x2_0": "", DIRECTED: ""} | dict.fromkeys(PARAMETER_NAMES, "held")
"""Keys of priors that differ from the name of the parameter; empty without a prior."""
_SPRING = ("k_1", "contact", "play", "f_l", "quadratic", "cubic", "hysteresis")

EFFECTS: Mapping[str, Effect] = {
    **{
        name: Effect(
            row.effect,
            row.remedy,
            Linearised.secant if row.step else Linearised.sensitivity,
            row.unit,
            "" if name in SYSTEMATIC else _PRIORS.get(name, name),
            row.positive,
            (COMMAND, _clearance) if name == "play" else None,
            is_certain=name in ("J", *PARAMETER_NAMES),
            of_the_spring=name in _SPRING,
        )
        for name, row in PARAMETERS.items()
        if row.effect
    },
    LAGGING: Effect("a velocity that lags, as an observer's does", "estimate with a plant that has it: --model",
                    Linearised.lag, "s", positive=True),
    "k_m_drift": _drift("k_m", K_M, "keep the motor cool, or use a shorter run"),
    "k_1_drift": _drift("k_1", K_1, "clamp some times before the run, or use a shorter one"),
    "T_c_drift": _drift("T_c", T_C, _WARM),
    "f_v_drift": _drift("f_v", F_V, _WARM),
    "friction_100": _turning(_SLOWLY.format(100), _STRIBECK, "slow_friction", T_C, _decaying(100.0)),
    "friction_200": _turning(_SLOWLY.format(200), _STRIBECK, "slow_friction", T_C, _decaying(200.0)),
    "drag": _turning("a viscous friction that grows faster than the speed", _SLOWER, "drag", F_V,
                     lambda at: _mean(np.abs, at.velocities) / at.limits.velocity),
    "ripple_sine": _turning(*_TURN, _ripple(np.sin)),
    "ripple_cosine": _turning(*_TURN, _ripple(np.cos)),
    "stiffness_sine": _turning(*_STIFF, lambda at: _mean(np.sin, at.angles))._replace(of_the_spring=True),
    "stiffness_cosine": _turning(*_STIFF, lambda at: _mean(np.cos, at.angles))._replace(of_the_spring=True),
    "current_gain": _turning("a k_m that depends on the current", _CALIBRATE, "current_gain", K_M,
                             lambda at: np.abs(at.current) / at.limits.current),
    "dead_current": _turning("a current that is smaller than the drive reports", _CALIBRATE, "dead_current", COMMAND,
                             lambda at: -np.sign(at.current))._replace(unit="A"),
    **{
        name: Effect(
            f"an error of the {name.removesuffix('_scale')}'s scale", "", regressor, "1", name,
            tested=False, is_certain=True,
        )
        for name, regressor in zip(
            SCALES, (Linearised.angle_scale, Linearised.current_scale, Linearised.time_scale), strict=True
        )
    },
}  # fmt: skip
"""Effects that a model may lack, in the order of their tests."""


def possible(name: str, bench: Bench) -> tuple[float, float]:
    """Least and greatest physically possible amount of an effect.

    A constant keeps its sign and its search range; an added torque is no larger than the torque that it changes. A
    delay may exceed its search range, which ends at one sample.
    """
    if name == LAGGING:
        return 0.0, 0.1
    if name not in PARAMETERS:
        return -1.0, 1.0
    row = PARAMETERS[name]
    if row.positive:
        return 0.0, row.high - row.low
    if row.relative:
        return -1.0, FACTOR - 1.0
    low, high = searched(bench, Unknown(name))
    return low, math.inf if name == "delay" else high


def shown_as(s: Suspect | Contribution, machine: Machine | None) -> Quantity:
    """Name and unit of an effect for output; no unit if it is relative."""
    if s.name in SCALES:
        return Quantity(s.name.replace("_", " "), "")
    if s.name in DRIFTS:
        parameter = s.name.removesuffix("_drift")
        return Quantity(f"{quantity(machine, parameter).name}_drift", "")
    found = quantity(machine, s.name) if s.name in SI else Quantity(s.name, EFFECTS[s.name].unit)
    row = PARAMETERS.get(s.name)
    is_share = row is not None and (row.unit == "1" or (row.relative and row.step == 0.0))
    return found._replace(unit="") if is_share else found


def with_systematic(question: EstimationProblem, bench: Bench, plant: Plant) -> EstimationProblem:
    """The problem with the bench's systematic errors that the plant can have, estimated or as unmodelled effects."""
    priors = bench.systematic
    if priors.k_m is not None and "k_m" in question.names and not question.known:
        k_m = bench.brake.k_m
        question = freed(replace(question, known={"k_m": (k_m, priors.k_m * k_m)}), bench)
    timed = has_time_for_a_delay(plant) and "current_lag" not in question.names
    observed = plant.instruments.observer_bandwidth > 0.0  # its velocity is derived from the angle
    excluded = {*question.names, *(() if timed else ("delay",)), *(("velocity_gain",) if observed else ())}
    estimated = {name: float(getattr(priors, name)) for name in SYSTEMATIC if name not in excluded}
    unmodelled = {
        name: float(getattr(priors, row.prior))
        for name, row in EFFECTS.items()
        if row.prior and name not in question.names
    }
    return replace(
        question,
        systematic={name: deviation for name, deviation in estimated.items() if deviation > 0.0},
        unmodelled={name: deviation for name, deviation in unmodelled.items() if deviation > 0.0},
    )
