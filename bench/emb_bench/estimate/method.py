"""Base of the estimation methods: options in the constructor, ``fit`` gives the estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import STARTS, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_runtime.errors import UsageError


@dataclass(frozen=True)
class Method(ABC):
    """One method with its options."""

    bench: Bench  # Noise, sample time, nominal brake, and ranges in which searches begin where there is no prior
    plant: Plant  # The model
    question: EstimationProblem = field(default_factory=EstimationProblem)  # Unknowns and priors
    starts: int = STARTS  # Local searches; recursive least squares needs none
    seed: int = 0  # Of the random numbers
    systematic: ClassVar[bool] = False  # Systematic errors are among its unknowns

    def fit(self, experiments: Sequence[Experiment]) -> Estimate:
        """Estimate from one experiment, or from several of the same brake."""
        question, ideal_sensors = self.question, False
        if question.known and not self.systematic:
            raise UsageError(
                "this method takes no known parameter: leave out --known, or k_m in [systematic]; or use --method oem"
            )
        if (question.systematic or question.unmodelled) and not self.systematic:
            question, ideal_sensors = replace(question, systematic={}, unmodelled={}), True
        if absent := [name for name in question.names if getattr(self.bench.brake, name, 1.0) == 0.0]:
            others = () if self.bench.machine is None else self.bench.machine.unknown
            raise UsageError(
                f"{', '.join(absent)}: zero in this bench, and a share of zero says nothing: expected --params "
                f"{','.join(others) or 'without it'}"
            )
        return replace(
            self.solve(make_problem(self.bench, self.plant, experiments, question)), ideal_sensors=ideal_sensors
        )

    @abstractmethod
    def solve(self, problem: Problem) -> Estimate:
        """Estimate the unknowns of a problem that has been checked."""
