"""The problem that is put to an estimator, and records of its tests."""

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
FREE = 0.05  # Standard deviation of J, as a share of it, where a parameter tells it that is known beforehand
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
FEWEST_WINDOWS = 3  # For each unknown that they share: with fewer their scatter says little
SAME = 1.0  # Searches whose weighted sums of squares differ by less ended in the same minimum: a shift of one sigma
OUTLIER = 8.0  # Distance from the neighbours from which on a sample is an outlier, in standard deviations
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
    """Parameters to be estimated; a prior is taken as a Gaussian of the same mean and variance."""

    systematic: Mapping[str, float] = field(default_factory=dict)
    """Systematic errors that are estimated too: standard deviation of the prior, by name; inf without a prior."""
    allowed: Mapping[str, float] = field(default_factory=dict)
    """Effects that are not estimated and that the total allows for: standard deviation of the prior, by name."""
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Value and standard deviation of parameters that are known beforehand, SI units, by name."""
    window: float = 0.0
    """Length of the windows of the method ``windows`` [s]; 0 for what the bench says."""

    @property
    def along(self) -> tuple[str, ...]:
        """Unknowns that are estimated too without being asked for; with the encoder's offset, the true start."""
        named = dict.fromkeys(("x1_0", *self.systematic) if "offset" in self.systematic else self.systematic)
        return tuple(name for name in named if name not in self.names)

    def unknowns(self, count: int) -> tuple[Unknown, ...]:
        """The numbers to be estimated from ``count`` experiments: ``names`` in their order, then what is ``along``."""
        found: list[Unknown] = []
        for name in (*self.names, *self.along):
            found += [Unknown(name, i) for i in range(count)] if name in OF_AN_EXPERIMENT else [Unknown(name)]
        return tuple(found)


def searched(bench: Bench, unknown: Unknown) -> tuple[float, float]:
    """Search range of an unknown: lowest and highest value in SI units. No curvature alone lets the clamp pull."""
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
    """True if there is time between samples in which a command may be late, and no lag that looks like it."""
    return plant.mechanics.solver == EXACT and plant.mechanics.current_lag == 0.0


def freed(asked: EstimationProblem, bench: Bench) -> EstimationProblem:
    """The problem with J unknown too, where a parameter is known that tells it; else the same."""
    if not asked.known or "J" in asked.names:
        return asked
    inertia = bench.brake.J
    known = {**asked.known, "J": (inertia, max(FREE, bench.systematic.inertia) * inertia)}
    return replace(asked, nuisances=(*asked.nuisances, "J"), known=known)


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
        """The end of a search that went on from this one."""
        return replace(after, start=self.start, evaluations=self.evaluations + after.evaluations)


@dataclass(frozen=True)
class Whiteness:
    """Whiteness test: residuals of one output must not follow from each other (Ljung and Box 1978)."""

    statistic: float
    lags: int
    p_value: float


@dataclass(frozen=True)
class Independence:
    """Independence test: residuals of one output must not follow from the currents."""

    statistic: float  # F, of the share that the currents of the last periods explain
    p_value: float
    correlation: float  # Largest of the correlations with the current, of either sign
    lag: int  # At this many samples


class Derived(NamedTuple):
    """Observer that derives the velocity from the angle."""

    bandwidth: float  # [rad/s]
    least: float  # Least bandwidth that is not told apart from it [rad/s]
    is_known: bool  # False if it may be much larger
    p_value: float  # Chance of such a lag in a velocity that is measured


@dataclass(frozen=True)
class Suspect:
    """An effect that the model lacks, and how much of it the residuals ask for (Rao's score test)."""

    name: str
    value: float  # First-order estimate, in the unknown's unit; relative for a parameter
    sigmas: float
    p_value: float = 1.0  # Chance of as much of it if the model is right
    possible: bool = True  # A brake can have this amount
    observer: Derived | None = None  # What the velocity's lag comes from, if the experiment shows it
    fall: float = 0.0  # Of χ² with it, to first order; of a term of the clamping force's curve with both terms


class Cause(NamedTuple):
    """The effect that is most probably why the model does not fit."""

    suspect: Suspect
    sigmas: float  # Of its score; of a curve with both terms
    share: float | None
    """Part of the misfit that it takes, to first order: 1 where none is left, None where the residuals' size is no
    alarm."""
    is_curve: bool  # With the other term of the clamping force's curve
    possible: bool  # The brake can have it, as far as its amount can tell


@dataclass(frozen=True)
class JointScore:
    """Score test of all suspects together."""

    statistic: float  # χ² of the residuals in the space of the effects
    rank: int
    p_value: float


@dataclass(frozen=True)
class Contribution:
    """Entry of the uncertainty budget: an effect that is not estimated."""

    name: str
    bias: tuple[float, ...]
    """Root mean square of the bias of each unknown, with its sign for a positive effect: relative, or in the unknown's
    unit."""
    size: float = 0.0  # Root mean square of its size


class Disturbance(NamedTuple):
    """Disturbance that an estimator found in order to whiten the residuals."""

    walk: float  # Standard deviation of the velocity's random walk [rad/s per √s]
    load: float  # Standard deviation of the load's random walk, as a current [A per √s]
    ratio: float  # Twice the logarithm of the likelihood ratio against none

    @property
    def p_value(self) -> float:
        """Probability of such a ratio without a disturbance: half of the time it is zero then (Chernoff 1954)."""
        from scipy import special

        return 0.5 * float(special.chdtrc(1, self.ratio)) if self.ratio > 0.0 else 1.0


@dataclass(frozen=True)
class ModelValidation:
    """Model validation: tests on the residuals of whether the model explains the experiments."""

    chi2: float
    freedom: int  # Samples of both outputs less unknowns
    expected: tuple[float, float]  # χ²/n of the right model lies between these, but for one time in a hundred
    chi2_p: float
    whiteness: Mapping[str, Whiteness]  # By output
    independence: Mapping[str, Independence]  # By output
    suspects: tuple[Suspect, ...]  # Most suspicious first
    budget: tuple[Contribution, ...]  # Effects that the total allows for
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
