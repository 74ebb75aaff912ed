"""Problem of an estimator, and records of its tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from emb_bench.brake.motion import Floats, is_plain
from emb_bench.brake.parameters import CURVED, FEATURES, OF_AN_EXPERIMENT, PARAMETERS
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DIRECTED, EXACT, Plant
from emb_bench.experiment.simulate import SystematicErrors
from emb_bench.information.evaluation import Question
from emb_runtime.errors import UsageError
from emb_runtime.estimator import estimate

SYSTEMATIC = SystematicErrors._fields
"""Systematic errors that are estimated too by default, each with the prior of the bench file."""
FREE = 0.05  # Standard deviation of J, relative, where a measured parameter determines it
FACTOR = 10.0  # Brakes beyond nominal by this factor are not searched
METHODS: Mapping[str, str] = {
    "oem": "output error",
    "pem": "prediction error",
    "rls": "recursive least squares",
    "windows": "output error over windows",
}
"""Estimation methods by their names."""
WITHOUT_GAPS = ("windows",)  # Methods that assume the currents of periods without a report
OUTPUTS = ("angle", "velocity")
FEWEST_WINDOWS = 3  # For each shared unknown; fewer give no usable covariance
SAME = 1.0  # Difference of χ² below which two searches ended in the same minimum: a shift of one sigma
OUTLIER = 8.0  # Distance from the neighbours beyond which a sample is an outlier [standard deviations]
STARTS = 8  # Default number of local searches
DONE = "DONE"  # Exit reason of a run that came to its planned end
NORMAL_95 = estimate.NORMAL_95  # Standard deviations that 95 % of a Gaussian lie within


class Unknown(NamedTuple):
    """One number to be estimated."""

    name: str  # Key of ``PARAMETERS``
    experiment: int | None = None  # Number of the experiment that it belongs to; None if all share it

    @property
    def relative(self) -> bool:
        """True if sensitivities to it are relative to its value."""
        return PARAMETERS[self.name].relative


@dataclass(frozen=True)
class EstimationProblem(Question):
    """Parameters to be estimated; a prior becomes a Gaussian of the same mean and variance."""

    systematic: Mapping[str, float] = field(default_factory=dict)
    """Systematic errors that are estimated too: standard deviation of the prior, by name; inf without a prior."""
    unmodelled: Mapping[str, float] = field(default_factory=dict)
    """Effects that are not estimated and widen the total: standard deviation of the prior, by name."""
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Gaussian priors of parameters measured otherwise: mean and standard deviation [SI units], by name."""
    window: float = 0.0
    """Length of the windows of the method ``windows`` [s]; 0 for the bench's default."""

    @property
    def default_nuisances(self) -> tuple[str, ...]:
        """Nuisance parameters added by default: the systematic errors; the encoder's offset adds the start x1_0."""
        named = dict.fromkeys(("x1_0", *self.systematic) if "offset" in self.systematic else self.systematic)
        return tuple(name for name in named if name not in self.names)

    def unknowns(self, count: int) -> tuple[Unknown, ...]:
        """The numbers to be estimated from ``count`` experiments: ``names``, then ``default_nuisances``."""
        found: list[Unknown] = []
        for name in (*self.names, *self.default_nuisances):
            found += [Unknown(name, i) for i in range(count)] if name in OF_AN_EXPERIMENT else [Unknown(name)]
        return tuple(found)


def searched(bench: Bench, unknown: Unknown) -> tuple[float, float]:
    """Search range of an unknown [SI units]. A negative curvature alone must not make the clamping force negative."""
    row, limits = PARAMETERS[unknown.name], bench.limits
    if unknown.name in CURVED:
        return -(max(map(abs, limits.angle)) ** -CURVED[unknown.name]), row.high
    if row.low < row.high:
        return row.low, row.high
    if row.relative:
        nominal = getattr(bench.brake, unknown.name)
        return nominal / FACTOR, nominal * FACTOR
    low, high = limits.angle
    return {"rad": (low, high), "rad/s": (-limits.velocity, limits.velocity), "A": (-limits.current, limits.current)}[
        row.unit
    ]


def has_time_for_a_delay(plant: Plant) -> bool:
    """True if the solver has time between samples for a delay, and no current lag that acts like one."""
    return plant.mechanics.solver == EXACT and plant.mechanics.current_lag == 0.0


def freed(question: EstimationProblem, bench: Bench) -> EstimationProblem:
    """The problem with J as a further unknown, if a measured parameter determines it; else the same."""
    if not question.known or "J" in question.names:
        return question
    inertia = bench.brake.J
    priors = {**question.known, "J": (inertia, max(FREE, bench.systematic.inertia) * inertia)}
    return replace(question, nuisances=(*question.nuisances, "J"), known=priors)


def check_model(plant: Plant, names: Sequence[str]) -> None:
    """Refuses unknowns that a model cannot estimate.

    Raises:
        UsageError: a delay of a stepped brake, or of one whose current lags; a feature of a stepped brake; play of a
            brake with a hysteresis, or the other way round; or a Stribeck velocity of a brake without static friction.
    """
    features = [name for name in names if name in FEATURES]
    if features and plant.mechanics.solver != EXACT:
        raise UsageError(
            f"plant '{plant.name}': {', '.join(features)}: expected a plant that is solved exactly, for others do not "
            "have it"
        )
    m = plant.mechanics
    if DIRECTED in names and (m.solver != EXACT or features or not is_plain(m._replace(viscous_asymmetry=0.0))):
        raise UsageError(
            f"plant '{plant.name}': {DIRECTED}: expected a plant that is solved exactly and has no other feature"
        )
    with_play, with_hysteresis = (getattr(m, name) > 0.0 or name in features for name in ("play", "hysteresis"))
    if with_play and with_hysteresis and {"play", "hysteresis"} & {*features}:
        raise UsageError(
            f"plant '{plant.name}': play does not go with hysteresis, which looks much like it: expected one of the two"
        )
    if (
        "stribeck_velocity" in features
        and m.break_away == 1.0
        and m.f_l == 0.0
        and not {"break_away", "f_l"} & {*names}
    ):
        raise UsageError(
            f"plant '{plant.name}': a Stribeck velocity has no effect without static friction: estimate break_away too"
        )
    if "delay" in names and not (has_time_for_a_delay(plant) and "current_lag" not in names):
        raise UsageError(
            f"plant '{plant.name}': a delay is estimated with brakes that are solved exactly and whose current does "
            "not lag: others have no time between samples, or cannot be told from a delay"
        )


@dataclass(frozen=True, eq=False)
class End:
    """End of a local search, and its start."""

    z: Floats  # The unknowns, in the coordinates of :class:`~emb_bench.estimate.prediction.Problem`
    cost: float
    """Weighted sum of squares, prior included; under a disturbance, minus twice the logarithm of the likelihood."""
    start: Floats  # Start, in the form of ``z``
    converged: bool
    evaluations: int

    def then(self, after: End) -> End:
        """The end of a search that was continued from this one."""
        return replace(after, start=self.start, evaluations=self.evaluations + after.evaluations)


@dataclass(frozen=True)
class Whiteness:
    """Whiteness test: autocorrelation of one output's residuals (Ljung and Box 1978)."""

    statistic: float
    lags: int
    p_value: float


@dataclass(frozen=True)
class Independence:
    """Independence test: correlation of one output's residuals with past currents."""

    statistic: float  # F, of the part that the last currents explain
    p_value: float
    correlation: float  # Largest of the correlations with the current, of either sign
    lag: int  # At this many samples


class Derived(NamedTuple):
    """Observer that derives the velocity from the angle."""

    bandwidth: float  # [rad/s]
    least: float  # Least bandwidth that fits as well [rad/s]
    is_known: bool  # False if much larger ones fit as well
    p_value: float  # Chance of such a lag in a velocity that is measured


@dataclass(frozen=True)
class Suspect:
    """An effect that the model lacks, and its amount by Rao's score test."""

    name: str
    value: float  # First-order estimate, in the unknown's unit; relative for a parameter
    sigmas: float
    p_value: float = 1.0  # Chance of as much of it if the model is right
    possible: bool = True  # The amount is physically possible
    observer: Derived | None = None  # Observer behind a lag of the velocity, if the experiment shows one
    fall: float = 0.0  # Of χ², to first order; a term of the clamping force's curve counts with the other term


class Cause(NamedTuple):
    """The most probable reason that the model does not fit."""

    suspect: Suspect
    sigmas: float  # Of the score; of a curve, with both terms
    share: float | None
    """Share of the misfit that it explains, to first order: 1 if it explains all of it, None if χ² is no alarm."""
    is_curve: bool  # With the other term of the clamping force's curve
    possible: bool  # Its amount is physically possible, as far as that can be judged
    fixed: tuple[str, ...] = ()  # Parameters without an estimate, each of which may explain the misfit


@dataclass(frozen=True)
class JointScore:
    """Score test of all suspects together."""

    statistic: float  # χ² of the residuals projected on the effects
    rank: int
    p_value: float


@dataclass(frozen=True)
class Contribution:
    """Entry of the uncertainty budget: one unmodelled effect."""

    name: str
    bias: tuple[float, ...]
    """Root mean square of the bias of each unknown, with its sign for a positive effect: relative, or in the unknown's
    unit."""
    size: float = 0.0  # Root mean square of its size


class Disturbance(NamedTuple):
    """Process noise that an estimator found to whiten the residuals."""

    walk: float  # Standard deviation of the velocity's random walk [rad/s per √s]
    load: float  # Standard deviation of the load's random walk, as a current [A per √s]
    ratio: float  # Twice the logarithm of the likelihood ratio against none

    @property
    def p_value(self) -> float:
        """Probability of such a ratio without a disturbance, when it is zero half of the time (Chernoff 1954)."""
        from scipy import special

        return 0.5 * float(special.chdtrc(1, self.ratio)) if self.ratio > 0.0 else 1.0


@dataclass(frozen=True)
class ModelValidation:
    """Residual tests of the model."""

    chi2: float
    freedom: int  # Samples of both outputs less unknowns
    expected: tuple[float, float]  # χ²/n of a right model lies between these in 99 of 100 cases
    chi2_p: float
    whiteness: Mapping[str, Whiteness]  # By output
    independence: Mapping[str, Independence]  # By output
    suspects: tuple[Suspect, ...]  # Most significant first
    budget: tuple[Contribution, ...]  # Unmodelled effects
    together: JointScore | None  # None without a suspect
    alarming: frozenset[str] = frozenset()
    """Tests that reject the model: ``size``, ``scores``, and ``current of``, ``whiteness of``, ``score of`` a name."""
    cause: Cause | None = None  # None without an alarm about an effect
    coloured: tuple[str, ...] = ()  # Outputs whose residuals are correlated in time
    disturbance: Disturbance | None = None  # A significant one, of a method that whitens the residuals

    @property
    def ratio(self) -> float:
        """χ²/n."""
        return self.chi2 / max(self.freedom, 1)

    @property
    def fits(self) -> bool:
        """True if no test rejects the model."""
        return not self.alarming
