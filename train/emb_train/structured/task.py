"""Task of an excitation: the parameters, the criterion, the brakes and the shield."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, Ranges
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_train.envs.conditions import Conditions, Randomisation
from emb_train.envs.measure import MEASURES, Measure
from emb_train.envs.play import Draw, Outcome, fresh_draws, grid_draws
from emb_train.structured.adaptive_shield import Shield
from emb_train.structured.estimator import Four
from emb_train.structured.trial import ANY_PRECISION, ReportedOutcome, Trials


@dataclass(frozen=True)
class Task:
    """One task, as it is tuned for and as it is evaluated."""

    name: str
    summary: str
    parameters: tuple[str, ...]  # Parameters whose information counts
    ranges: str  # Set of the bench that the brakes are drawn from
    shield_ranges: str  # Set of the bench that the shield covers; it contains ``ranges``
    criterion: str  # Name of a measure, see :data:`emb_train.envs.measure.MEASURES`
    count: int  # Brakes in an evaluation; 0 for the thesis's grid over the one parameter
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    shield: Shield = "worst case"  # For all of that set at any time, or for what the running estimate leaves of it
    command_delay: tuple[int, int] = (0, 0)  # Least and most samples that a command waits, drawn for each experiment
    precision: Four = ANY_PRECISION
    """Relative deviations of k_m, k_1, T_c and f_v: where these are asked for, the time until they are reached counts,
    and nothing else."""
    begin: tuple[float, ...] = (1.0, -1.0, -0.007, 0.3, 0.61)
    """Blind reference that learning begins with: levels, then switches."""
    share: float = 0.0
    """Half width of the set ``ranges``, of all four parameters as a share of nominal; 0 if the bench has that set."""

    @property
    def measure(self) -> Measure:
        """Measure of an experiment."""
        return MEASURES[self.criterion]

    @property
    def conditions(self) -> Conditions:
        """Conditions in which it is trained and played."""
        randomised = Randomisation(command_delay=self.command_delay)
        return Conditions(shield_ranges=self.shield_ranges, information=self.measure.kind, randomised=randomised)

    def on(self, bench: Bench) -> Bench:
        """The bench with the set that this task brings along, if it brings one."""
        if not self.share:
            return bench
        return replace(bench, ranges={**bench.ranges, self.ranges: around(bench.brake, self.share, self.ranges)})

    def draws(self, bench: Bench, seed: int, count: int | None = None) -> list[Draw]:
        """Brakes and noise; as many as an evaluation has without ``count``.

        The grid has always the same brakes: a ``count``, rounded up to whole grids, plays it again with other noise.
        """
        ranges = self.on(bench).range_set(self.ranges)
        if not self.count:
            grid = grid_draws(ranges, self.parameters[0], seed)
            while len(grid) < (count or 0):
                grid += grid_draws(ranges, self.parameters[0], seed + len(grid))
            return grid
        return fresh_draws(ranges, seed, count or self.count)

    def trials(self, bench: Bench, draws: list[Draw]) -> Trials:
        """Experiments with these brakes behind this task's shield.

        Raises:
            BenchFileError: the shield cannot guarantee the limits for its set, or the bench lacks a set or the plant.
            UsageError: the shield does not cover the brakes.
        """
        bench = self.on(bench)
        ranges = bench.range_set(self.ranges)
        return Trials(bench, ranges, self.parameters, draws, self.plant, self.conditions, self.shield, self.precision)

    @property
    def label(self) -> str:
        """Formula of what counts."""
        return self.measure.label if self.precision == ANY_PRECISION else "-s until known"

    def score(self, outcome: Outcome) -> Floats:
        """The criterion of each experiment, or minus its time until the precision, shape [N]; higher is better."""
        if isinstance(outcome, ReportedOutcome) and self.precision != ANY_PRECISION:
            return -outcome.known
        return self.measure.values(outcome.matrices)


def around(brake: BrakeParameters, share: float, name: str) -> Ranges:
    """All brakes whose four uncertain parameters are within ±share of this one's, as a set of that name."""
    low, high = (
        brake._replace(**{n: factor * getattr(brake, n) for n in PARAMETER_NAMES})
        for factor in (1.0 - share, 1.0 + share)
    )
    return Ranges(name, low, high)


_FOUR = Task(
    name="four-d",
    summary="k_m, k_1, T_c, f_v within 50 %, D",
    parameters=PARAMETER_NAMES,
    ranges="pm50",
    shield_ranges="envelope",
    criterion="D",
    count=500,
)
_CREEP_FIRST = (-0.2, -0.007, 1.0, -1.0, 0.005, 0.94, -0.23, 0.02, 0.21, 0.42, 0.71, 0.96, 0.965)
"""A probe, then k_1 and f_v by a creep, two full strokes, and what is left of the time."""
TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        Task(
            name="viscous",
            summary="f_v in 1e-5..5e-5, the others known, weighted",
            parameters=("f_v",),
            ranges="viscous",
            shield_ranges="viscous",
            criterion="weighted",
            count=0,
            begin=(1.0, -1.0, -0.006, 0.375, 0.9),
        ),
        Task(
            name="viscous-stiffness",
            summary="k_1 and f_v of Table 6.1, the others known, weighted E",
            parameters=("k_1", "f_v"),
            ranges="viscous-stiffness",
            shield_ranges="viscous-stiffness",
            criterion="weighted",
            count=100,
            begin=(1.0, -1.0, -0.007, 0.336, 0.92),
        ),
        _FOUR,
        replace(_FOUR, name="four-e", summary="k_m, k_1, T_c, f_v within 50 %, E", criterion="E", begin=_CREEP_FIRST),
        replace(_FOUR, name="four-a", summary="k_m, k_1, T_c, f_v within 50 %, A", criterion="A", begin=_CREEP_FIRST),
        replace(
            _FOUR,
            name="four-time",
            summary="k_m, k_1, T_c, f_v within 50 %, until 95 % of each are within 1.2 %",
            precision=(0.0065, 0.0065, 0.0065, 0.0065),
            begin=(-0.2, 1.0, -1.0, 0.032, 0.3),
        ),
        replace(
            _FOUR,
            name="four-d-wide",
            summary="k_m, k_1, T_c, f_v within 80 %, D",
            ranges="pm80",
            shield_ranges="pm80",
            share=0.8,
        ),
    )
}
"""By name."""
