"""Suspects: effects that the model lacks or holds fixed, and how much of each the residuals ask for.

Rao's score test, of one effect at a time: the residuals along what the effect would add to the samples, beside all that
is estimated, are standard normal if the model is right. What an effect adds is the sensitivity where the plant has one,
and a secant from its null value where it has a threshold there. An effect that can only be positive is suspected on
that side only.

The same numbers give the uncertainty budget: what an effect that is not estimated may have moved each unknown by, given
the prior of the bench file and the residuals (:mod:`emb_bench.estimate.average`). A constant that is never exact is
there with certainty; an effect that a brake may not have at all, with the probability ``PRESENT``. Where a filter found
a disturbance, drifts may be larger, by ``DISTURBED``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy import special

from emb_bench.brake.motion import Floats, Integers, is_plain
from emb_bench.brake.parameters import (
    COMMAND,
    F_V,
    FEATURES,
    K_1,
    K_M,
    PARAMETERS,
    SI,
    T_C,
    Parameter,
    Quantity,
    quantity,
)
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.machine import Machine
from emb_bench.config.plants import DIRECTED, EXACT, Mechanics
from emb_bench.estimate.average import SHARES, Average, Effect, average, unaveraged
from emb_bench.estimate.derived_velocity import derived
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import (
    ANGLE_SCALE,
    CURRENT_SCALE,
    DRIFTS,
    FACTOR,
    SCALES,
    TIME_SCALE,
    Contribution,
    JointScore,
    Suspect,
    Unknown,
    has_time_for_a_delay,
    searched,
)
from emb_bench.experiment.simulate import Trajectory
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Limits

SLOW = 30.0  # Stribeck velocity with which friction at rest is suspected, where the plant has none [rad/s]

_OBSERVER = "estimate with a plant that has it: --model"

NEVER_EXACT = (
    "J",
    *SCALES,
    *PARAMETER_NAMES,
)  # Constants that are wrong by something in every brake
PRESENT = 0.5  # Probability, before any record, that a brake has a certain one of all other effects

DISTURBED = 10.0
"""Factor of what is known of drifts before a record in which something disturbs the brake: it may be a drift, which the
random walk of a filter follows without an alarm."""

ALIKE = 2.0  # Difference of two suspects' squared scores below which they are hardly distinguished

SMALLEST = 1e-12  # Share of a period that counts, per unit of an effect; a sensitivity is divided by it

DEPENDENT = 1e-6  # share of a regressor beside the others below which it is one of them


class Shown(Protocol):
    """Samples of each record as a model expects them at an estimate, in the standard deviations of its residuals."""

    def columns(self, record: int, names: tuple[str, ...]) -> Floats:
        """Derivatives of what is shown to other unknowns, shape (n, names, 2)."""

    def parts(self, record: int, unknowns: Integers, shares: Floats) -> Floats:
        """Derivatives to unknowns that count in each period by shares of the shape (n, m), shape (n, m, 2)."""

    def shown(self, record: int, mechanics: Mechanics) -> Floats:
        """Samples of another brake under the same currents, shape (n, 2)."""

    def whitened(self, record: int, shift: Floats) -> Floats:
        """A small change of what is shown [rad, rad/s], in the unit of the residuals, shape (n, 2)."""

    def motion(self, record: int) -> Floats:
        """Angle [rad] and velocity [rad/s] that are shown, shape (n, 2)."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """The simulation of output error."""

    problem: Problem
    z: Floats
    weights: Sequence[Floats]
    said: Sequence[Trajectory] | None = None  # Prediction of each record, where there is one

    @cached_property
    def _mechanics(self) -> Mechanics:
        return self.problem.mechanics(self.z)

    @cached_property
    def _motion(self) -> list[Floats]:
        said = self.said or [self.problem.motion(self.z, i) for i in range(len(self.problem.records))]
        return [one.samples for one in said]

    def columns(self, record: int, names: tuple[str, ...]) -> Floats:
        """As :class:`Shown`."""
        own = len(self.problem.columns(record))
        columns = self.problem.predict(self.z, record, names).sensitivities[:, own : own + len(names)]
        return columns * self.weights[record][:, None]

    def parts(self, record: int, unknowns: Integers, shares: Floats) -> Floats:
        """As :class:`Shown`."""
        return self.problem.parts(self.z, record, unknowns, shares) * self.weights[record][:, None]

    def shown(self, record: int, mechanics: Mechanics) -> Floats:
        """As :class:`Shown`."""
        nominal = mechanics == self._mechanics
        samples = self._motion[record] if nominal else self.problem.motion(self.z, record, mechanics).samples
        return samples * self.weights[record]

    def whitened(self, record: int, shift: Floats) -> Floats:
        """As :class:`Shown`."""
        return shift * self.weights[record]

    def motion(self, record: int) -> Floats:
        """As :class:`Shown`."""
        return self._motion[record]


_STRIBECK = PARAMETERS["break_away"].remedy
_SLOWER = f"{_STRIBECK}, or lower the velocity in [limits] of the bench file and excite again"
_WALKS = "allow for a disturbance: --method pem"
_CALIBRATE = "calibrate the current of the drive"
_COOL = "keep the motor cool, or use a shorter run"
_CLAMP = "clamp some times before the run, or use a shorter one"
_WARM = "begin when all that moves is warm, or use a shorter run"
LAGGING = "velocity_lag"  # Explains a misfit if the velocity itself shows an observer
EFFECTS: Mapping[str, Parameter] = {
    **{name: row for name, row in PARAMETERS.items() if row.effect},
    LAGGING: Parameter(
        "s", high=0.1, effect="a velocity that lags, as an observer's does", remedy=_OBSERVER, positive=True
    ),
    **{
        name: Parameter("", effect=f"a change of {name.removesuffix('_drift')} over the run", remedy=remedy)
        for name, remedy in zip(DRIFTS, (_COOL, _CLAMP, _WARM, _WARM), strict=True)
    },
    "friction_100": Parameter("", effect="a friction that decays over about 100 rad/s", remedy=_STRIBECK),
    "friction_200": Parameter("", effect="a friction that decays over about 200 rad/s", remedy=_STRIBECK),
    "drag": Parameter("", effect="a viscous friction that grows faster than the speed", remedy=_SLOWER),
    "ripple_sine": Parameter("", effect="a torque that changes over a turn", remedy=_WALKS),
    "ripple_cosine": Parameter("", effect="a torque that changes over a turn", remedy=_WALKS),
    "stiffness_sine": Parameter("", effect="a stiffness that changes over a turn", remedy=_WALKS),
    "stiffness_cosine": Parameter("", effect="a stiffness that changes over a turn", remedy=_WALKS),
    "current_gain": Parameter("", effect="a k_m that depends on the current", remedy=_CALIBRATE),
    "dead_current": Parameter("A", effect="a current that is smaller than the drive reports", remedy=_CALIBRATE),
}
"""Effects that a plant may lack, in the order of their tests."""
ALONE = (
    *DRIFTS[1:],
    *("friction_100", "friction_200", "drag", "ripple_sine", "ripple_cosine", "stiffness_sine", "stiffness_cosine"),
    *("current_gain", "dead_current"),
)
"""Effects that are no part of the test of all together, which noise with a slow colour would fail by them."""
OF_THE_SPRING = (
    *("k_1", "k_1_drift", "contact", "play", "f_l", "quadratic", "cubic", "hysteresis"),
    *("stiffness_sine", "stiffness_cosine"),
)
"""Effects that a machine without a spring cannot have."""


def possible(name: str, bench: Bench) -> tuple[float, float]:
    """Least and greatest amount of an effect that a brake can have.

    No constant changes its sign or by more than is searched, nor is any other torque larger than what it changes.
    Whole samples of a delay are not searched, yet possible.
    """
    if name in TORQUES and name != "play":
        return -1.0, 1.0
    row = EFFECTS[name]
    if row.positive:
        return 0.0, row.high - row.low
    if row.relative:
        return -1.0, FACTOR - 1.0
    low, high = searched(bench, Unknown(name))
    return low, math.inf if name == "delay" else high


def held(problem: Problem) -> tuple[str, ...]:
    """Effects with a sensitivity that the model does not estimate."""
    timed = has_time_for_a_delay(problem.plant)
    estimated = {u.name for u in problem.unknowns}
    observed = problem.plant.instruments.observer_bandwidth > 0.0
    directed = problem.bench.machine is not None and is_plain(problem.plant.mechanics) and not estimated & {*FEATURES}
    return tuple(
        name
        for name, effect in EFFECTS.items()
        if effect.step == 0.0
        and name not in estimated | {LAGGING, *TORQUES}
        and (name != "delay" or timed)
        and (name != "velocity_gain" or not observed)
        and (name != DIRECTED or directed)
    )


def secants(problem: Problem, z: Floats, model: Shown) -> dict[str, list[Floats]]:
    """Columns of the effects without a sensitivity: samples per unit in standard deviations, by record."""
    found, observed = features(problem, z, model), problem.plant.instruments.observer_bandwidth > 0.0
    for i, record in enumerate(problem.records):
        motion = model.motion(i)
        turned = turning(problem, z, i, motion)
        unknowns, shares = (list(of) for of in zip(*turned.values(), strict=True))
        moved = model.parts(i, np.array(unknowns), np.stack(shares, axis=1))
        for j, name in enumerate(turned):
            found.setdefault(name, []).append(moved[:, j])
        if not observed:
            slope = np.diff(motion[:, 1], prepend=record.velocity) / problem.bench.timing.sample_time
            lag = np.stack([np.zeros_like(slope), -slope], axis=1)
            found.setdefault(LAGGING, []).append(model.whitened(i, 1e-6 * lag) / 1e-6)
    return found


def features(problem: Problem, z: Floats, model: Shown) -> dict[str, list[Floats]]:
    """Columns of the features that the mechanics lack, as :func:`secants`."""
    mechanics, found = problem.mechanics(z), dict[str, list[Floats]]()
    estimated = {unknown.name for unknown in problem.unknowns}
    for i in range(len(problem.records)):
        shown = {mechanics.stribeck_velocity: model.shown(i, mechanics)}
        for name, effect in EFFECTS.items():
            lacking = effect.step > 0.0 and name not in estimated
            changed = _with(mechanics, name, effect.step) if lacking else None
            if changed is None:
                continue
            if (slow := changed.stribeck_velocity) not in shown:
                shown[slow] = model.shown(i, mechanics._replace(stribeck_velocity=slow))
            found.setdefault(name, []).append((model.shown(i, changed) - shown[slow]) / effect.step)
    return found


def turning(problem: Problem, z: Floats, record: int, motion: Floats) -> dict[str, tuple[int, Floats]]:
    """Unknowns that turn the motor as effects do, and their shares in each period, by name; ``motion`` is shown."""
    mechanics, at = problem.mechanics(z), _path(problem, z, record, motion)
    lacking = mechanics.play == 0.0 and mechanics.solver == EXACT
    found = {name: (unknown, share(at)) for name, (unknown, share) in TORQUES.items() if name != "play" or lacking}
    return {name: (unknown, np.where(np.abs(own) < SMALLEST, 0.0, own)) for name, (unknown, own) in found.items()}


class Path(NamedTuple):
    """A record as the model moves."""

    brake: BrakeParameters
    limits: Limits
    passed: Floats  # Share of the record that has passed, -½ to ½, shape (n,)
    current: Floats  # Shape (n,) [A]
    angles: Floats  # From contact, at the ends of the periods, shape (n + 1,) [rad]
    velocities: Floats  # At the same, shape (n + 1,) [rad/s]


def _path(problem: Problem, z: Floats, record: int, shown: Floats) -> Path:
    """The motion that is shown."""
    at, data = problem.at(z, record), problem.records[record]
    n, delay = len(shown), problem.plant.instruments.measurement_delay
    ends = np.concatenate([shown[delay:], np.repeat(shown[-1:], min(delay, n), axis=0)])[:n]
    return Path(
        at.brake,
        problem.bench.limits,
        (np.arange(n) + 0.5) / n - 0.5,
        data.currents + at.errors.current_offset,
        np.append(at.start[0], ends[:, 0] - at.offset(problem.plant)) - at.contact,
        np.append(at.start[1], ends[:, 1]),
    )


def _mean(of: Callable[[Floats], Floats], ends: Floats) -> Floats:
    """Means in the periods between these ends, in which a number changes evenly (Simpson)."""
    first, last = ends[:-1], ends[1:]
    mean: Floats = (of(first) + 4.0 * of(0.5 * (first + last)) + of(last)) / 6.0
    return mean


def _clearance(at: Path) -> Floats:
    """Torque by which the clamp acts less on the motor behind a clearance, per size of it, as a current [A/rad].

    Nut and force lag behind the screw.
    """
    play, behind = EFFECTS["play"].step, np.empty(len(at.angles))
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


TORQUES: Mapping[str, tuple[int, Callable[[Path], Floats]]] = {
    "play": (COMMAND, _clearance),
    "k_m_drift": (K_M, lambda at: at.passed),
    "k_1_drift": (K_1, lambda at: at.passed),
    "T_c_drift": (T_C, lambda at: at.passed),
    "f_v_drift": (F_V, lambda at: at.passed),
    "friction_100": (T_C, _decaying(100.0)),
    "friction_200": (T_C, _decaying(200.0)),
    "drag": (F_V, lambda at: _mean(np.abs, at.velocities) / at.limits.velocity),
    "ripple_sine": (COMMAND, _ripple(np.sin)),
    "ripple_cosine": (COMMAND, _ripple(np.cos)),
    "current_gain": (K_M, lambda at: np.abs(at.current) / at.limits.current),
    "dead_current": (COMMAND, lambda at: -np.sign(at.current)),
    "stiffness_sine": (K_1, lambda at: _mean(np.sin, at.angles)),
    "stiffness_cosine": (K_1, lambda at: _mean(np.cos, at.angles)),
}
"""Effects that turn the motor and that the brake has no sensitivity to: a share of the torque of a parameter, or a
current [A], in each period and per unit of their size.

A drift is by the whole parameter from the first period to the last, zero in the middle.
"""


def _with(m: Mechanics, name: str, step: float) -> Mechanics | None:
    """The mechanics with a small effect more; None for those that cannot have it, or have no play yet."""
    if m.solver != EXACT or name not in Mechanics._fields or (name == "play" and m.play == 0.0):
        return None
    if name == "hysteresis" and m.play > 0.0:
        return None
    changed = m._replace(**{name: getattr(m, name) + step})
    if name in ("break_away", "f_l") and m.stribeck_velocity == 0.0:
        changed = changed._replace(stribeck_velocity=SLOW)
    return changed


def score(
    problem: Problem,
    z: Floats,
    left: tuple[Floats, Floats],
    model: Floats,
    shown: Shown,
    ratio: float,
    *,
    disturbed: bool = False,
) -> tuple[tuple[Suspect, ...], tuple[Contribution, ...], JointScore | None]:
    """Score tests of all effects that are not estimated: most suspicious first, their budget, all of them together.

    Residuals and their derivatives to z are ``left`` at the estimate, ``model`` is a basis of what they are fitted
    with, orthonormal, and the noise may be larger than the bench says by the ``ratio`` χ²/n. ``disturbed`` says that a
    disturbance was found.
    """
    names, (errors, jacobian) = held(problem), left
    blocks = [shown.columns(i, names) for i in range(len(problem.records))] if names else []
    added = secants(problem, z, shown)
    every = {
        name: np.concatenate([block[:, k].ravel() for block in blocks]) for k, name in enumerate(names) if blocks
    } | {name: np.concatenate([column.ravel() for column in parts]) for name, parts in added.items()}
    if problem.bench.brake.k_1 == 0.0:
        every = {name: column for name, column in every.items() if name not in OF_THE_SPRING}
    _, pseudo = basis_and_inverse(jacobian)
    priors = _priors(problem, DISTURBED if disturbed else 1.0)
    found, beside_all, effects = [], [], dict[str, Effect]()
    untested = scales(problem, z, left[1], shown, every, priors)
    for name, column in (every | untested).items():
        whole, beside = beside_model(column, model)
        length = float(np.linalg.norm(beside))
        if length <= DEPENDENT * float(np.linalg.norm(whole)):
            length, beside = 0.0, np.zeros(len(errors))
        if name in priors:
            about = length**2, float(beside @ errors)
            effects[name] = effect_of(problem, name, priors[name], pseudo @ whole, *about)
        if length == 0.0 or name in untested:
            continue
        if name not in ALONE:
            beside_all.append(beside / length)
        amount, sigmas = float(beside @ errors) / length**2, float(beside @ errors) / length
        away = sigmas / max(ratio, 1.0) ** 0.5
        p = float(special.ndtr(-away) if EFFECTS[name].positive else 2.0 * special.ndtr(-abs(away)))
        low, high = possible(name, problem.bench)
        found.append(Suspect(name, amount, sigmas / max(ratio, 1e-300) ** 0.5, p, possible=low < amount < high))
    budget = budget_of(average(problem, z, left), effects, untested)
    if not found:
        return (), budget, None
    axes, values, _ = np.linalg.svd(np.stack(beside_all, axis=1), full_matrices=False)
    kept = axes[:, values > 1e-3]
    statistic, rank = float(np.sum((kept.T @ errors) ** 2)), kept.shape[1]
    p_value = float(special.chdtrc(rank, statistic / max(ratio, 1.0)))
    return _with_observer(_ranked(found), problem), budget, JointScore(statistic, rank, p_value)


def scales(
    problem: Problem, z: Floats, jacobian: Floats, shown: Shown, every: Mapping[str, Floats], priors: Container[str]
) -> dict[str, Floats]:
    """Columns of the scales of sensors and clock that the total allows for, beside ``every`` other effect's."""
    found = {ANGLE_SCALE: _angle_scaled(problem, z, shown)} if ANGLE_SCALE in priors else {}
    own, count = [u.name for u in problem.unknowns], sum(record.samples.size for record in problem.records)
    known = {name: every[name] if name in every else -jacobian[:count, own.index(name)] for name in ("k_m", "f_v", "J")}
    if CURRENT_SCALE in priors:  # a larger current acts as a larger k_m does
        found[CURRENT_SCALE] = known["k_m"]
    if TIME_SCALE in priors:  # torques go with s⁻², which is as a smaller J is, but for f_v, which goes with s⁻¹
        found[TIME_SCALE] = 2.0 * known["J"] + known["f_v"]
    return found


def beside_model(column: Floats, model: Floats) -> tuple[Floats, Floats]:
    """The column of an effect as long as all residuals, and what of it the ``model``, an orthonormal basis, lacks."""
    whole = np.zeros(len(model))
    whole[: len(column)] = column
    return whole, whole - model @ (model.T @ whole)


def basis_and_inverse(jacobian: Floats) -> tuple[Floats, Floats]:
    """An orthonormal basis and the pseudo-inverse of a tall matrix whose columns differ in scale."""
    lengths = np.linalg.norm(jacobian, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    basis, triangle = np.linalg.qr(jacobian / lengths)
    return basis, np.linalg.pinv(triangle) @ basis.T / lengths[:, None]


def effect_of(problem: Problem, name: str, prior: float, moved: Floats, information: float, score: float) -> Effect:
    """An effect with the deviation ``prior`` of its size: what it moves the unknowns by, per unit, and its score."""
    # What drifts is fitted as it is in the middle of a run, and meant from the begin to the end.
    ends = np.array([0.5 if f"{u.name}_drift" == name else 0.0 for u in problem.unknowns])
    if name == "J":  # all torques scale with it, those that are held as well: no trace is left
        moved, information, score = np.array([float(u.name in PARAMETER_NAMES) for u in problem.unknowns]), 0.0, 0.0
    sizes, present = (np.ones(len(SHARES)), 1.0) if name in NEVER_EXACT else (np.array(SHARES), PRESENT)
    return Effect(moved, information, score, prior * sizes, present, ends)


def budget_of(averaged: Average, effects: Mapping[str, Effect], in_full: Container[str]) -> tuple[Contribution, ...]:
    """The budget of effects, of some of them with all priors of systematic errors in full."""
    found = dict[str, Contribution]()
    for way, some in ((averaged, False), (unaveraged(averaged.step), True)):
        names = [name for name in effects if (name in in_full) is some]
        biases, sizes = way.biases([effects[name] for name in names]) if names else ((), ())
        for name, bias, size in zip(names, biases, sizes, strict=True):
            found[name] = Contribution(name, tuple(bias.tolist()), float(size))
    return tuple(found[name] for name in effects)


def _ranked(found: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """Most suspicious first; of those that are hardly distinguished, the one that comes first in ``EFFECTS``."""

    def rank(s: Suspect) -> tuple[float, float]:
        """Without the last digits, which differ between processors: two that act alike keep their order."""
        suspicion = s.sigmas if EFFECTS[s.name].positive else abs(s.sigmas)
        return float(f"{s.p_value:.6g}"), -float(f"{suspicion:.6g}")

    ordered = sorted(found, key=rank)
    least = ordered[0].sigmas ** 2 - ALIKE
    alike = [s for s in ordered if s.sigmas**2 >= least and s.p_value < 0.5]
    alike.sort(key=lambda s: list(EFFECTS).index(s.name))
    return (*alike, *(s for s in ordered if s not in alike))


def _with_observer(found: tuple[Suspect, ...], problem: Problem) -> tuple[Suspect, ...]:
    """Suspects with the observer that derives the velocity, if a record shows one: the lag of it comes first."""
    observed = problem.plant.instruments.observer_bandwidth > 0.0
    if observed or (observer := derived(problem.records, problem.bench.timing.sample_time)) is None:
        return found
    ordered = sorted(found, key=lambda s: s.name != LAGGING)
    return tuple(
        replace(s, p_value=observer.p_value, possible=True, observer=observer) if s.name == LAGGING else s
        for s in ordered
    )


def _angle_scaled(problem: Problem, z: Floats, shown: Shown) -> Floats:
    """Column of an error of the angle's scale: samples of all records, then angles at rest before them.

    A velocity by an observer follows the angle.
    """
    parts, observed = [], problem.plant.instruments.observer_bandwidth > 0.0
    offsets = [problem.at(z, i).offset(problem.plant) for i in range(len(problem.records))]
    for i, offset in enumerate(offsets):
        shift = (shown.motion(i) - [offset, 0.0]) * [1.0, observed]
        parts.append(shown.whitened(i, 1e-6 * shift).ravel() / 1e-6)
    rests = [(problem.records[i].angle - offsets[i]) / problem.records[i].slack for i in problem.rests()]
    return np.concatenate([*parts, rests])


def _priors(problem: Problem, drifting: float) -> dict[str, float]:
    """Standard deviations before any record of what the total allows for; drifts ``drifting`` times the bench's."""
    return {n: d * (drifting if n in DRIFTS else 1.0) for n, d in problem.asked.allowed.items()}


def shown_as(s: Suspect | Contribution, machine: Machine | None) -> Quantity:
    """Name and unit of an effect as they are shown; no unit for what is relative."""
    if s.name in SCALES:
        return Quantity(s.name.replace("_", " "), "")
    if s.name in DRIFTS:
        parameter = s.name.removesuffix("_drift")
        return Quantity(f"{quantity(machine, parameter).name}_drift", "")
    row = EFFECTS[s.name]
    found = quantity(machine, s.name) if s.name in SI else Quantity(s.name, row.unit)
    a_share = row.unit == "1" or (s.name in SI and row.relative and row.step == 0.0)
    return found._replace(unit="") if a_share else found
