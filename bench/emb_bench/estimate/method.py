"""Base of the estimation methods: options in the constructor, ``fit`` gives the estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from emb_bench.brake.parameters import quantity
from emb_bench.config.bench import Bench
from emb_bench.config.machine import LOADS
from emb_bench.config.plants import Plant
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import STARTS, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_runtime.errors import UsageError

IDEAL_SENSORS = (
    "the bench's systematic errors ([systematic]) are not estimated by this method, and its intervals do not "
    "allow for them; --method oem does so"
)
"""Caveat of a method that has no unknowns for systematic errors."""


@dataclass(frozen=True)
class Method(ABC):
    """One method with its options."""

    bench: Bench  # Noise, sample time, nominal brake, and ranges in which searches begin where there is no prior
    plant: Plant  # The model
    asked: EstimationProblem = field(default_factory=EstimationProblem)  # The parameters to estimate
    starts: int = STARTS  # Local searches; recursive least squares needs none
    seed: int = 0  # Of the random numbers
    systematic: ClassVar[bool] = False  # Systematic errors are among its unknowns
    gaps: ClassVar[bool] = True  # Currents of periods without a report are unknown to it, or left out

    def fit(self, experiments: Sequence[Experiment]) -> Estimate:
        """Estimate from one experiment, or from several of the same brake."""
        asked, caveats = self.asked, tuple[str, ...]()
        if (asked.systematic or asked.allowed) and not self.systematic:
            asked, caveats = replace(asked, systematic={}, allowed={}), (IDEAL_SENSORS,)
        if absent := [name for name in asked.names if getattr(self.bench.brake, name, 1.0) == 0.0]:
            others = () if self.bench.machine is None else self.bench.machine.unknown
            raise UsageError(
                f"{', '.join(absent)}: zero in this bench, and a share of zero says nothing: expected --params "
                f"{','.join(others) or 'without it'}"
            )
        e = self.solve(make_problem(self.bench, self.plant, experiments, asked))
        return replace(e, caveats=(*e.caveats, *_scale(e), *caveats))

    @abstractmethod
    def solve(self, problem: Problem) -> Estimate:
        """Estimate the unknowns of a problem that has been checked."""


def _scale(e: Estimate) -> tuple[str, ...]:
    """Words for the scale that all parameters of a machine that is no brake share."""
    machine, names = e.bench.machine, [u.name for u in e.unknowns]
    if machine is None:
        return ()
    others = ", ".join(quantity(machine, name).name for name in ("J", "T_c", "f_v", "k_1") if name in names)
    if "k_m" in names:
        held = [name for name in ("J", "T_c", "f_v", "k_1") if name not in names and getattr(e.bench.brake, name)]
        known = ", ".join(quantity(machine, name).name for name in held)
        if not known:
            return (f"k_m, {others} scale together: without a known load only their ratios are in the recording",)
        return (f"k_m{f', {others}' if others else ''} are as right as what was given as known: {known}",)
    if machine.command not in LOADS:
        return (f"{others}: only their ratios to k_m are in the recording, and k_m was given",)
    commanded = quantity(machine, "current").name
    return (f"{others} are as right as the scale of the commanded {commanded}: only ratios do without it",)
