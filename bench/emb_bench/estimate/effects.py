"""Effects that a model lacks or holds fixed: a row for each, with what one unit of it adds to the samples.

Score tests (:mod:`emb_bench.estimate.suspects`), the uncertainty budget, the average over effects that may be there
(:mod:`emb_bench.estimate.average`) and the expected interval (:mod:`emb_bench.estimate.expected`) come from these rows.
A new effect is a row in :data:`EFFECTS`, and a field of ``[systematic]`` of the bench file for its prior.

What an effect adds is the sensitivity where the plant has one; a secant from its null value where it has a threshold
there; and the sensitivity to a torque that counts in each period by a share, where the brake has none.
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

SLOW = 30.0  # Stribeck velocity with which friction at rest is suspected, where the plant has none [rad/s]
SMALLEST = 1e-12  # Share of a period that counts, per unit of an effect; a sensitivity is divided by it
SMALL = 1e-6  # Size of a change of what is shown, of which there is a difference

DRIFTS = tuple(f"{name}_drift" for name in PARAMETER_NAMES)
"""Linear changes of the parameters, as shares of them from the begin of a run to its end."""
ANGLE_SCALE, CURRENT_SCALE, TIME_SCALE = SCALES = "angle_scale", "current_scale", "time_scale"
"""Relative errors of the scales of angle and current, and of the clock."""
LAGGING = "velocity_lag"  # Explains a misfit if the velocity itself shows an observer


# ---- the model at an estimate ----


class Shown(Protocol):
    """Samples of each experiment as a model expects them at an estimate, in standard deviations of its residuals."""

    def columns(self, experiment: int, names: tuple[str, ...]) -> Floats:
        """Derivatives of what is shown to other unknowns, shape (n, names, 2)."""

    def parts(self, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """Derivatives to unknowns that count in each period by shares of the shape (n, m), shape (n, m, 2)."""

    def shown(self, experiment: int, mechanics: Mechanics) -> Floats:
        """Samples of another brake under the same currents, shape (n, 2)."""

    def whitened(self, experiment: int, shift: Floats) -> Floats:
        """A small change of what is shown [rad, rad/s], in the unit of the residuals, shape (n, 2)."""

    def motion(self, experiment: int) -> Floats:
        """Angle [rad] and velocity [rad/s] that are shown, shape (n, 2)."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """The simulation of output error."""

    problem: Problem
    z: Floats
    weights: Sequence[Floats]
    said: Sequence[Trajectory] | None = None  # Prediction of each experiment, where there is one,
    besides: tuple[str, ...] = ()  # and the unknowns whose sensitivities are in it besides those of the problem

    @cached_property
    def _mechanics(self) -> Mechanics:
        return self.problem.mechanics(self.z)

    @cached_property
    def _motion(self) -> list[Floats]:
        said = self.said or [self.problem.motion(self.z, i) for i in range(len(self.problem.experiments))]
        return [one.samples for one in said]

    def columns(self, experiment: int, names: tuple[str, ...]) -> Floats:
        """As :class:`Shown`."""
        own = len(self.problem.columns(experiment))
        is_said = self.said is not None and names == self.besides
        at = self.said[experiment] if self.said and is_said else self.problem.predict(self.z, experiment, names)
        return at.sensitivities[:, own : own + len(names)] * self.weights[experiment][:, None]

    def parts(self, experiment: int, unknowns: Integers, shares: Floats) -> Floats:
        """As :class:`Shown`."""
        return self.problem.parts(self.z, experiment, unknowns, shares) * self.weights[experiment][:, None]

    def shown(self, experiment: int, mechanics: Mechanics) -> Floats:
        """As :class:`Shown`."""
        nominal = mechanics == self._mechanics
        samples = self._motion[experiment] if nominal else self.problem.motion(self.z, experiment, mechanics).samples
        return samples * self.weights[experiment]

    def whitened(self, experiment: int, shift: Floats) -> Floats:
        """As :class:`Shown`."""
        return shift * self.weights[experiment]

    def motion(self, experiment: int) -> Floats:
        """As :class:`Shown`."""
        return self._motion[experiment]


class Path(NamedTuple):
    """An experiment as the model moves."""

    brake: BrakeParameters
    limits: Limits
    passed: Floats  # Share of the experiment that has passed, -½ to ½, shape (n,)
    current: Floats  # Shape (n,) [A]
    angles: Floats  # From contact, at the ends of the periods, shape (n + 1,) [rad]
    velocities: Floats  # At the same, shape (n + 1,) [rad/s]


def columns(problem: Problem, z: Floats, shown: Shown, jacobian: Floats, names: tuple[str, ...]) -> dict[str, Floats]:
    """Column of each effect, of some, that the model lacks: samples per unit in standard deviations, by name.

    As long as all residuals, whose derivatives to z are the ``jacobian``.
    """
    ends = np.cumsum([0, *(experiment.samples.size for experiment in problem.experiments)]).tolist()
    at = [Linearised(problem, z, shown, i, jacobian[begin:end], names) for i, (begin, end) in enumerate(pairwise(ends))]
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
    """A model at an estimate along an experiment; its regressors are of samples, shape (n, 2), in standard deviations.

    None of an effect that the model has, or that its brake cannot have.
    """

    problem: Problem
    z: Floats
    shown: Shown
    experiment: int
    jacobian: Floats  # Derivatives of the residuals of its samples to z, shape (2 n, p)
    names: tuple[str, ...]  # Effects that are asked for

    def sensitivity(self, name: str) -> Floats | None:
        """The sensitivity to an unknown of the brake or of its instruments."""
        return None if name in _estimated(self.problem) else self._sensitivities.get(name)

    def secant(self, name: str) -> Floats | None:
        """The secant from a feature's own value to a little more."""
        step, before = PARAMETERS[name].step, self.mechanics
        after = None if name in _estimated(self.problem) else _with(before, name, step)
        if after is None:
            return self._turned.get(name)
        slow = after.stribeck_velocity
        if slow not in self._slowed:
            self._slowed[slow] = self.shown.shown(self.experiment, before._replace(stribeck_velocity=slow))
        return (self.shown.shown(self.experiment, after) - self._slowed[slow]) / step

    def turned(self, name: str) -> Floats | None:
        """The sensitivity to a torque that counts in each period by a share."""
        return self._turned[name]

    def lag(self, _: str) -> Floats | None:
        """A lag of the velocity, where it is no observer's anyway."""
        if self._is_observed:
            return None
        before, velocity = self.problem.experiments[self.experiment].velocity, self.shown.motion(self.experiment)[:, 1]
        slope = np.diff(velocity, prepend=before) / self.problem.bench.timing.sample_time
        return self._small(np.stack([np.zeros_like(slope), -slope], axis=1))

    def angle_scale(self, _: str) -> Floats:
        """A larger angle; a velocity by an observer follows it."""
        return self._small((self.shown.motion(self.experiment) - [self.offset, 0.0]) * [1.0, self._is_observed])

    def current_scale(self, _: str) -> Floats:
        """A larger current, which acts as a larger k_m does."""
        return self._sensitivities["k_m"]

    def time_scale(self, _: str) -> Floats:
        """A faster clock: torques go with s⁻², as with a smaller J, but for f_v, which goes with s⁻¹."""
        return 2.0 * self._sensitivities["J"] + self._sensitivities["f_v"]

    def _small(self, shift: Floats) -> Floats:
        """A change of what is shown [rad, rad/s], to first order."""
        return self.shown.whitened(self.experiment, SMALL * shift) / SMALL

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
        """Samples that are shown with a Stribeck velocity and no more static friction, by that velocity."""
        return {self.mechanics.stribeck_velocity: self.shown.shown(self.experiment, self.mechanics)}

    @cached_property
    def _sensitivities(self) -> dict[str, Floats]:
        """Sensitivities to what is held, and those to k_m, f_v and J even if they are estimated."""
        names, own = lacked_sensitivities(self.problem, self.names), [u.name for u in self.problem.unknowns]
        found: dict[str, Floats] = {
            n: -self.jacobian[:, own.index(n)].reshape(-1, 2) for n in ("k_m", "f_v", "J") if n in own
        }
        if names:
            found |= zip(names, self.shown.columns(self.experiment, names).transpose(1, 0, 2), strict=True)
        return found

    @cached_property
    def _turned(self) -> dict[str, Floats]:
        shares = self.shares()
        if not shares:
            return {}
        unknowns, counted = zip(*shares.values(), strict=True)
        moved = self.shown.parts(self.experiment, np.array(unknowns), np.stack(counted, axis=1))
        return dict(zip(shares, moved.transpose(1, 0, 2), strict=True))

    def shares(self) -> dict[str, tuple[int, Floats]]:
        """Unknowns that turn the motor as effects do, and their shares in each period, by name."""
        path, m, found = self._path(), self.mechanics, dict[str, tuple[int, Floats]]()
        for name in self.names:
            torque = EFFECTS[name].torque
            if torque is not None and (name != "play" or (m.play == 0.0 and m.solver == EXACT)):
                share = torque[1](path)
                found[name] = torque[0], np.where(np.abs(share) < SMALLEST, 0.0, share)
        return found

    def _path(self) -> Path:
        """The motion that is shown."""
        at, shown = self.problem.at(self.z, self.experiment), self.shown.motion(self.experiment)
        n, delay = len(shown), self.problem.plant.instruments.measurement_delay
        ends = np.concatenate([shown[delay:], np.repeat(shown[-1:], min(delay, n), axis=0)])[:n]
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
    """Those of some effects that have a sensitivity, and of k_m, f_v and J, that a model can have and holds fixed."""
    plant, lacked = problem.plant, {"k_m", "f_v", "J", *names} - _estimated(problem)
    if not has_time_for_a_delay(plant):
        lacked -= {"delay"}
    if plant.instruments.observer_bandwidth > 0.0:
        lacked -= {"velocity_gain"}
    if problem.bench.machine is None or not is_plain(plant.mechanics) or _estimated(problem) & {*FEATURES}:
        lacked -= {DIRECTED}
    return tuple(name for name, row in EFFECTS.items() if row.regressor is Linearised.sensitivity and name in lacked)


def _with(m: Mechanics, name: str, step: float) -> Mechanics | None:
    """The mechanics with a small effect more; None for those that cannot have it, or have no play yet."""
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
    prior: str = ""  # Key of ``[systematic]``: standard deviation without any experiment; empty where none is allowed
    positive: bool = False  # It is suspected on one side only
    torque: tuple[int, Callable[[Path], Floats]] | None = None
    """Unknown, and its share in each period per unit of the effect."""
    alone: bool = False
    """No part of the test of all together, which noise with a slow colour would fail by it."""
    tested: bool = True  # The residuals can tell it
    is_certain: bool = False  # Constants that are wrong by something in every brake
    of_the_spring: bool = False  # A machine without a spring cannot have it


def _mean(of: Callable[[Floats], Floats], ends: Floats) -> Floats:
    """Means in the periods between these ends, in which a number changes evenly (Simpson)."""
    first, last = ends[:-1], ends[1:]
    mean: Floats = (of(first) + 4.0 * of(0.5 * (first + last)) + of(last)) / 6.0
    return mean


def _clearance(at: Path) -> Floats:
    """Torque by which the clamp acts less on the motor behind a clearance, per size of it, as a current [A/rad].

    Nut and force lag behind the screw.
    """
    play, behind = PARAMETERS["play"].step, np.empty(len(at.angles))
    compiled(_behind)(at.angles, play, behind)
    result: Floats = at.brake.gamma * at.brake.k_1 / at.brake.k_m * 0.5 * (behind[1:] + behind[:-1]) / play
    return result


def _behind(angles: Floats, play: float, behind: Floats) -> None:
    """Fills in by how much less the nut is in contact than the screw [rad]."""
    nut = angles[0]
    for k in range(len(angles)):
        nut = min(max(nut, angles[k] - 0.5 * play), angles[k] + 0.5 * play)
        behind[k] = max(angles[k], 0.0) - max(nut, 0.0)


def _decaying(speed: float) -> Callable[[Path], Floats]:
    return lambda at: _mean(lambda v: np.exp(-((v / speed) ** 2)), at.velocities)


def _ripple(wave: Callable[[Floats], Floats]) -> Callable[[Path], Floats]:
    return lambda at: at.brake.T_c / at.brake.k_m * _mean(wave, at.angles)


def _turning(effect: str, remedy: str, prior: str, unknown: int, share: Callable[[Path], Floats]) -> Effect:
    """An effect that turns the motor by a share of a parameter's torque, or as a current [A]."""
    return Effect(effect, remedy, Linearised.turned, prior=prior, torque=(unknown, share), alone=True)


def _drift(name: str, unknown: int, remedy: str) -> Effect:
    """A drift by the whole parameter from the first period to the last, zero in the middle."""
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
"""Keys of priors that are not the name of the parameter, or that it has none."""
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
    """Least and greatest amount of an effect that a brake can have.

    No constant changes its sign or by more than is searched, nor is any other torque larger than what it changes.
    Whole samples of a delay are not searched, yet possible.
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
    """Name and unit of an effect as they are shown; no unit for what is relative."""
    if s.name in SCALES:
        return Quantity(s.name.replace("_", " "), "")
    if s.name in DRIFTS:
        parameter = s.name.removesuffix("_drift")
        return Quantity(f"{quantity(machine, parameter).name}_drift", "")
    found = quantity(machine, s.name) if s.name in SI else Quantity(s.name, EFFECTS[s.name].unit)
    row = PARAMETERS.get(s.name)
    is_share = row is not None and (row.unit == "1" or (row.relative and row.step == 0.0))
    return found._replace(unit="") if is_share else found


def with_systematic(asked: EstimationProblem, bench: Bench, plant: Plant) -> EstimationProblem:
    """The problem with what the bench cannot exclude and the plant can have: estimated too, or allowed for."""
    priors = bench.systematic
    if priors.k_m is not None and "k_m" in asked.names and not asked.known:
        k_m = bench.brake.k_m
        asked = freed(replace(asked, known={"k_m": (k_m, priors.k_m * k_m)}), bench)
    timed = has_time_for_a_delay(plant) and "current_lag" not in asked.names
    observed = plant.instruments.observer_bandwidth > 0.0  # its velocity is no measurement of its own
    excluded = {*asked.names, *(() if timed else ("delay",)), *(("velocity_gain",) if observed else ())}
    estimated = {name: float(getattr(priors, name)) for name in SYSTEMATIC if name not in excluded}
    allowed = {
        name: float(getattr(priors, row.prior))
        for name, row in EFFECTS.items()
        if row.prior and name not in asked.names
    }
    return replace(
        asked,
        systematic={name: deviation for name, deviation in estimated.items() if deviation > 0.0},
        allowed={name: deviation for name, deviation in allowed.items() if deviation > 0.0},
    )
