"""The identified brake that is exported as a model: its parameters, with the 95 % interval of each."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, get_type_hints

import numpy as np
from msgspec import Meta

from emb_bench.analysis.options import ExportOptions
from emb_bench.brake.motion import Floats, is_plain
from emb_bench.brake.parameters import SI
from emb_bench.config.plants import DEFAULT_PLANT, EULER, Mechanics
from emb_bench.estimate.records import NORMAL_95, Unknown, searched
from emb_bench.experiment.theta import read_theta
from emb_bench.information.evaluation import bench_for, default_model
from emb_bench.information.identifiability import Spectrum
from emb_bench.logs.log import RunLog
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.config.typed import LARGEST, SMALLEST
from emb_runtime.errors import CheckFailedError, UsageError

if TYPE_CHECKING:  # scipy comes with the extra [bench]
    from emb_bench.analysis.study import Study
    from emb_bench.estimate.estimate import Estimate


START = ("contact", "x1_0", "x2_0")  # Place of contact, angle and velocity at the start
ABOUT: Mapping[str, str] = {
    "J": "moment of inertia",
    "gamma": "travel of the clamp per angle of the motor",
    "k_m": "motor constant",
    "k_1": "stiffness of the clamp over the angle of the motor",
    "T_c": "Coulomb friction",
    "f_v": "viscous friction",
    "break_away": "static friction as a multiple of T_c",
    "stribeck_velocity": "speed at which the static friction has decayed; 0: it acts at rest only",
    "stribeck_exponent": "exponent of that decay",
    "f_l": "static friction that grows with the load",
    "quadratic": "curvature of the clamping force, k_1 x (1 + quadratic x + cubic x^2)",
    "cubic": "the next term of that curve",
    "hysteresis": "share by which the clamping force is larger while tightening, smaller while releasing",
    "hysteresis_travel": "angle from the middle of the hysteresis to one side",
    "current_lag": "time constant of the current; 0: none",
    "play": "travel of the motor after a reversal until the clamp follows; not together with hysteresis",
    "viscous_asymmetry": "share by which f_v is larger in the positive direction, smaller in the negative",
    "tolerance": "local error of the velocity per step",
    "contact": "angle at which the clamping begins",
    "x1_0": "angle at the start",
    "x2_0": "velocity at the start",
}
"""Parameters of an exported brake."""
CHOSEN = ("x1_0", "x2_0", "tolerance")  # What is of a simulation, not of the brake
UNITS = SI | {"gamma": "m", "stribeck_exponent": "1", "hysteresis_travel": "rad", "tolerance": "rad/s"}
_HINTS = get_type_hints(BrakeParameters, include_extras=True) | get_type_hints(Mechanics, include_extras=True)
_UNSAFE = re.compile(r"[^\w .,=+-]", re.ASCII)  # What a name must not bring into comments of C, XML and DCM


class Parameter(NamedTuple):
    """A parameter of an exported brake."""

    name: str
    value: float
    unit: str  # SI, as FMI writes it: ``N.m.s/rad``, ``kg.m2``
    about: str  # What it is, in ASCII
    uncertainty: str  # Its 95 % interval, or why it has none, in ASCII
    least: float
    greatest: float


@dataclass(frozen=True)
class Identified:
    """A brake that is exported."""

    source: str  # Where the parameters are from
    bench: Bench
    brake: BrakeParameters
    mechanics: Mechanics
    contact: float = 0.0  # Angle at which the clamping begins [rad]
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # 95 % in total, SI units

    @property
    def plain(self) -> bool:
        """True for a brake without a feature that has to be integrated."""
        return is_plain(self.mechanics._replace(viscous_asymmetry=0.0))

    @property
    def features(self) -> tuple[str, ...]:
        """Names of its features beyond the thesis's equations."""
        usual = Mechanics()._asdict() | {"contact": 0.0, "tolerance": self.mechanics.tolerance}
        values = self.mechanics._asdict() | {"contact": self.contact}
        return tuple(name for name, value in values.items() if value != usual[name])

    def parameters(self) -> list[Parameter]:
        """All parameters of the equations that the brake is solved by, and its start at rest at the origin."""
        if self.mechanics.solver == EULER:
            raise UsageError(
                f"expected a plant that is solved exactly, and this one is stepped: --model {DEFAULT_PLANT}"
            )
        of_plant = {n: v for n, v in self.mechanics._asdict().items() if (n == "viscous_asymmetry") is self.plain}
        values = self.brake._asdict() | of_plant | dict.fromkeys(START, 0.0) | {"contact": self.contact}
        found = []
        for name in (name for name in ABOUT if name in values):
            uncertainty = "chosen" if name in CHOSEN else "not estimated"
            if name in self.intervals:
                uncertainty = "95 %: {:.5g} to {:.5g}".format(*self.intervals[name])
            unit = UNITS[name].replace("·", ".").replace("²", "2")
            found.append(Parameter(name, values[name], unit, ABOUT[name], uncertainty, *bounds(name)))
        return found


def bounds(name: str) -> tuple[float, float]:
    """Least and greatest value of a parameter: those of a bench file, and 0 where that stands for none."""
    hint = _HINTS.get(name)
    meta = Meta(ge=-LARGEST) if hint is None else next(iter(hint.__metadata__))
    low = SMALLEST if name == "J" else meta.ge or 0.0
    return min(low, Mechanics._field_defaults.get(name, low)), meta.le or LARGEST


def identified(log: RunLog, options: ExportOptions, estimate: Callable[[], Study]) -> Identified:
    """The brake of a log, by its estimate or by values that are given.

    Raises:
        CheckFailedError: the model of the estimate does not fit, or a parameter is not identified.
        UsageError: two options contradict each other, or this is a machine that is no brake.
    """
    if options.theta is not None:
        if options.draw is not None:
            raise UsageError("--draw: expected the estimate of the log, whose uncertainty is known, got --theta too")
        bench = bench_for(log, options.bench)
        name, brake, _ = read_theta(options.theta, log, bench)
        plant = bench.model(options.model or default_model(log)[0])
        return Identified(_UNSAFE.sub("?", name), bench, brake, plant.mechanics)
    study = estimate()
    _check(study)
    e = study.estimate
    if e.bench.machine is not None and (e.bench.machine.linear or e.bench.machine.command != "A"):
        raise UsageError(f"{log.path}: expected a brake that turns and is driven by a current, for its model has these")
    intervals = {c.label: c.interval for c in study}
    for effect in e.validation.budget:
        if effect.name == "J":
            half = NORMAL_95 * effect.size * e.theta.J
            intervals["J"] = (e.theta.J - half, e.theta.J + half)
    z, inertia = (e.z, 1.0) if options.draw is None else drawn(e, options.draw)
    brake = e.problem.theta(z)
    values = dict(zip(e.unknowns, e.problem.values(z).tolist(), strict=True))
    how = "" if options.draw is None else f", drawn with seed {options.draw}"
    source = _UNSAFE.sub("?", f"estimate of {log.path.name}{how}")
    mechanics, contact = e.problem.mechanics(z), values.get(Unknown("contact"), 0.0)
    return Identified(source, e.bench, brake._replace(J=brake.J * inertia), mechanics, contact, intervals)


def _check(study: Study) -> None:
    from emb_bench.analysis.study import verdict

    found, why = verdict(study), f"not identified: {', '.join(study.unidentified)}"
    remedy = "--params names those that are estimated"
    if not found.holds:
        why = f"the model '{study.estimate.plant.name}' {found.standing}"
        remedy = "emb-replay estimate says why; --nuisance or --model changes the model"
    if study.unidentified or not found.holds:
        names = ", ".join(study.names)
        raise CheckFailedError(f"{names}: {why}, so that nothing is written: {remedy}, --theta gives parameters")


def drawn(e: Estimate, seed: int) -> tuple[Floats, float]:
    """Unknowns drawn from the joint distribution of their total errors, and a factor of J.

    By the information, and by each effect of the budget, which moves all unknowns together; an error of J moves J, too.
    Values are within what is searched.
    """
    rng, inertia = np.random.default_rng(seed), 1.0
    covariance = Spectrum(e.information).inverse()
    if not np.isfinite(covariance).all():
        raise CheckFailedError("--draw: expected that every unknown is identified: leave out a --nuisance")
    errors = rng.multivariate_normal(np.zeros(len(e.z)), covariance, method="cholesky")
    for effect in e.validation.budget:
        size = rng.standard_normal()
        errors += size * np.array(effect.bias)
        inertia += size * effect.size if effect.name == "J" else 0.0
    low, high = (e.problem.values(end) for end in e.problem.bounds)
    least_inertia, most = searched(e.bench, Unknown("J"))
    inertia = min(max(inertia, least_inertia / e.theta.J), most / e.theta.J)
    return e.problem.coordinates(np.clip(e.values + e.scale * errors, low, high)), inertia
