"""Task of an excitation: the parameters, the criterion, the brakes and the shield."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.estimator.kalman import Four
from emb_train.envs.conditions import Conditions
from emb_train.envs.measure import MEASURES, Measure
from emb_train.envs.play import Draw, Outcome, fresh_draws
from emb_train.structured.learning import Shield
from emb_train.structured.trial import ANY_PRECISION, ReportedOutcome, Trials


@dataclass(frozen=True)
class Task:
    """One task, as it is tuned for and as it is evaluated."""

    name: str  # One of :data:`emb_train.names.TASKS`, which says what it is
    parameters: tuple[str, ...]  # Parameters whose information counts
    ranges: str  # Set of the bench that the brakes are drawn from
    shield_ranges: str  # Set of the bench that the shield covers; it contains ``ranges``
    criterion: str  # Name of a measure, see :data:`emb_train.envs.measure.MEASURES`
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    shield: Shield = "worst case"  # For all of that set at any time, or for what has been learnt of the brake
    command_delay: tuple[int, int] = (0, 0)  # Least and most samples that a command waits, drawn for each experiment
    precision: Four = ANY_PRECISION
    """Relative deviations of k_m, k_1, T_c and f_v: where these are asked for, the time until they are reached counts,
    and nothing else."""
    begin: tuple[float, ...] = (1.0, -1.0, -0.007, 0.3, 0.61)
    """Blind reference that learning begins with: levels, then switches, found by CMA-ES from many places."""

    @property
    def measure(self) -> Measure:
        """Measure of an experiment."""
        return MEASURES[self.criterion]

    @property
    def conditions(self) -> Conditions:
        """Conditions in which it is trained and played."""
        return Conditions(
            shield_ranges=self.shield_ranges, information=self.measure.kind, command_delay=self.command_delay
        )

    def draws(self, bench: Bench, seed: int, count: int) -> list[Draw]:
        """Brakes and noise."""
        return fresh_draws(bench.range_set(self.ranges), seed, count)

    def trials(self, bench: Bench, draws: list[Draw]) -> Trials:
        """Experiments with these brakes behind this task's shield.

        Raises:
            BenchFileError: the shield cannot guarantee the limits for its set, or the bench lacks a set or the plant.
            UsageError: the shield does not cover the brakes.
        """
        ranges = bench.range_set(self.ranges)
        return Trials(bench, ranges, self.parameters, draws, self.plant, self.conditions, self.shield, self.precision)

    def score(self, outcome: Outcome) -> Floats:
        """The criterion of each experiment, or minus its time until the precision, shape [N]; higher is better."""
        if isinstance(outcome, ReportedOutcome) and self.precision != ANY_PRECISION:
            return -outcome.known
        return self.measure.values(outcome.matrices)


_FOUR = Task(
    name="four-d",
    parameters=PARAMETER_NAMES,
    ranges="pm50",
    shield_ranges="envelope",
    criterion="D",
)
_CREEP_FIRST = (-0.2, -0.007, 1.0, -1.0, 0.005, 0.94, -0.23, 0.02, 0.21, 0.42, 0.71, 0.96, 0.965)
"""A probe, then k_1 and f_v by a creep, two full strokes, and what is left of the time."""
TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        Task(
            name="viscous",
            parameters=("f_v",),
            ranges="viscous",
            shield_ranges="viscous",
            criterion="weighted",
            begin=(1.0, -1.0, -0.006, 0.375, 0.9),
        ),
        Task(
            name="viscous-stiffness",
            parameters=("k_1", "f_v"),
            ranges="viscous-stiffness",
            shield_ranges="viscous-stiffness",
            criterion="weighted",
            begin=(1.0, -1.0, -0.007, 0.336, 0.92),
        ),
        _FOUR,
        replace(_FOUR, name="four-e", criterion="E", begin=_CREEP_FIRST),
        replace(_FOUR, name="four-a", criterion="A", begin=_CREEP_FIRST),
        replace(
            _FOUR,
            name="four-time",
            precision=(0.0065, 0.0065, 0.0065, 0.0065),
            begin=(-0.2, 1.0, -1.0, 0.032, 0.3),
        ),
    )
}
"""By name."""
