"""A design problem, and one design with everything that is computed from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from emb_bench.brake.motion import STATES, Floats, no_sensitivity, rest
from emb_bench.brake.parameters import OFFSET, PARAMETERS
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EXACT, Plant
from emb_bench.design import kernel
from emb_bench.design.kernel import Box, Task
from emb_bench.estimate.expected import NUMBERS, IntervalCriterion, of_experiment, sampled
from emb_bench.estimate.records import check_model
from emb_bench.information.criteria import Criterion
from emb_bench.information.evaluation import Question
from emb_bench.information.fisher import Kind, Weights, weights_along
from emb_bench.information.symmetric import packed_size, unpack
from emb_bench.sim.open_loop import check_unknowns, march, trajectory, zero_order_hold
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import EmbError, UsageError

MARGIN = 1e-5  # Margin of the box inside the limits [rad, rad/s]: more than rounding takes

PARTS = 20  # Of a period, at whose ends the limits are checked where the brake moves between samples


@dataclass(frozen=True)
class Problem:
    """Design problem: a brake, a criterion, and limits to keep."""

    bench: Bench
    plant: Plant
    brake: BrakeParameters
    params: tuple[str, ...]
    goal: Criterion | IntervalCriterion
    weights: Weights
    box: Box
    sample_time: float  # [s]
    horizon: int  # Periods

    @cached_property
    def task(self) -> Task:
        """The problem for compiled loops."""
        unknowns, start = no_sensitivity(self.params)
        bias = (unknowns == OFFSET).astype(np.float64)
        return Task(self.plant.mechanics, self.brake, self.box, self.sample_time, unknowns, start, bias, *self.weights)

    @property
    def criterion(self) -> Criterion:
        """The goal, where it is one of the information and has a slope to climb."""
        assert isinstance(self.goal, Criterion)
        return self.goal

    def phi(self, currents: Floats, matrix: Floats) -> float:
        """The goal of currents [A], which have this Fisher information; −inf where they say nothing."""
        if isinstance(self.goal, Criterion):
            return float(self.goal.phi(matrix)) if np.isfinite(matrix).all() else -np.inf
        experiment = sampled(self.bench, self.plant, currents)
        try:
            found = self.goal.of(of_experiment(self.bench, self.plant, self.brake, experiment, Question(self.params)))
        except (EmbError, np.linalg.LinAlgError):
            return -np.inf
        return found if np.isfinite(found) else -np.inf

    def narrowed(self, angle: float, speed: float) -> Problem:
        """Returns the problem with limits tighter by an angle [rad] and a speed [rad/s]."""
        box = self.box
        inner = box._replace(low=box.low + angle, high=box.high - angle, speed=box.speed - speed)
        return replace(self, box=inner)

    def design(self, currents: Floats) -> Design:
        """Simulate a sequence of currents [A], one per sample, shape (n,)."""
        task = self.task
        acting = zero_order_hold(currents, self.sample_time)
        x, s = trajectory(compiled(march), task.mechanics, task.brake, acting, task.unknowns, rest(), task.start)
        y = s[1:, :, :2].copy()
        y[:, :, 0] += task.bias
        root = np.sqrt(self.weights)
        scaled = (y * root).transpose(1, 0, 2).reshape(len(task.unknowns), -1)
        price, worst = compiled(kernel.excess)(x, self.box)
        matrix = scaled @ scaled.T
        return Design(currents, x, s, matrix, self.phi(currents, matrix), price, worst)

    def beyond(self, design: Design) -> tuple[float, float]:
        """Largest excess over the box in angle [rad] and speed [rad/s], between samples too.

        A brake that is stepped has nothing between its samples.
        """
        x = design.states
        if self.plant.mechanics.solver == EXACT:
            fine = replace(self, sample_time=self.sample_time / PARTS)
            x = fine.design(np.repeat(design.currents, PARTS)).states
        angle = max(self.box.low - x[:, 0].min(), x[:, 0].max() - self.box.high)
        return max(0.0, float(angle)), max(0.0, float(np.abs(x[:, 1]).max()) - self.box.speed)

    def jacobian(self, design: Design) -> Floats:
        """Derivatives of each period's map of state and sensitivities, shape (n, Z, Z + 1)."""
        size = STATES + self.task.start.size
        jacobian = np.empty((len(design.currents), size, size + 1))
        compiled(kernel.linearise)(self.task, design.currents, design.states, design.sensitivities, jacobian)
        return jacobian

    def gradients(self, design: Design, jacobian: Floats) -> Floats:
        """Derivatives of the FIM with respect to the currents, shape (n, p, p)."""
        size = len(self.params)
        result = np.empty((packed_size(size), len(design.currents)))
        compiled(kernel.gradients)(self.task, jacobian, design.sensitivities, result)
        return unpack(result.T, size)

    def explore(self, genes: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Coarse designs: currents (count, n), FIM (count, p, p), φ (count,), price of leaving the box (count,)."""
        count, size = len(genes), len(self.params)
        u, m, price = np.empty((count, self.horizon)), np.empty((count, packed_size(size))), np.empty(count)
        compiled(kernel.explore)(self.task, genes, u, m, price)
        matrices = unpack(m, size)
        if isinstance(self.goal, Criterion):
            return u, matrices, self.goal.phi(matrices), price
        return u, matrices, np.array([self.phi(*each) for each in zip(u, matrices, strict=True)]), price


@dataclass(frozen=True, eq=False)
class Design:
    """A sequence of currents and what it does."""

    currents: Floats  # [A], shape (n,)
    states: Floats  # Shape (n + 1, STATES), the start first
    sensitivities: Floats  # Shape (n + 1, p, SENSITIVE)
    matrix: Floats  # Fisher information, shape (p, p)
    phi: float  # The goal: a criterion's logarithm
    price: float  # Of leaving the box, in the unit of ``phi``
    outside: float  # By how much it leaves the box at most [rad, rad/s]

    @property
    def feasible(self) -> bool:
        """True if it keeps the limits at every sample."""
        return self.outside <= MARGIN


def make_problem(
    bench: Bench,
    goal: Criterion | IntervalCriterion,
    params: tuple[str, ...],
    *,
    model: str = DEFAULT_PLANT,
    kind: Kind = "physical",
    brake: BrakeParameters | None = None,
    returns: bool = True,
) -> Problem:
    """A design problem on a bench, of the nominal brake without another one; with ``returns`` it has to come home."""
    if not params:
        raise UsageError(f"expected at least one parameter of {', '.join(PARAMETERS)}")
    check_unknowns(params)
    plant = bench.model(model)
    if kind == "physical" and plant.instruments.clock_jitter > 0.0:
        raise UsageError(f"plant '{model}': a design is for exact sample times")
    limits, home = bench.limits, bench.shield
    (weights,) = weights_along(bench, kind, plant.instruments, np.zeros((2, STATES)))
    if not isinstance(goal, Criterion):
        if kind != "physical":
            raise UsageError(f"criterion {goal.name}: expected the physical information, got '{kind}'")
        if goal.name not in (*NUMBERS, *params):
            raise UsageError(f"criterion {goal.name}: expected {goal.name} among the parameters, {', '.join(params)}")
        check_model(plant, params)
    return Problem(
        bench=bench,
        plant=plant,
        brake=bench.brake if brake is None else brake,
        params=params,
        goal=goal,
        weights=Weights(*weights.tolist()),
        box=Box(
            limits.current,
            limits.angle[0] + MARGIN,
            limits.angle[1] - MARGIN,
            limits.velocity - MARGIN,
            home.home_angle - MARGIN if returns else np.inf,
            home.home_velocity - MARGIN if returns else np.inf,
        ),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
    )
