"""Known-parameter optimum: the best currents for each brake if its parameters were known.

A search takes a quarter of a minute for a brake, and minutes for the first one, in the middle of the ranges. The others
start from the optimum of that one: its speeds, or its table of journeys where the search polishes none, are followed on
the other brake, and the search goes on from there. The result is the best that was found, not proved to be the best
there is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from emb_bench.brake.euler import sign, stiffness
from emb_bench.brake.motion import is_plain
from emb_bench.config.bench import Bench
from emb_bench.config.plants import EULER, EXACT, Plant
from emb_bench.design.problem import Problem, make_problem
from emb_bench.design.search import search
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.symmetric import Floats
from emb_bench.sim.open_loop import feedback
from emb_runtime.config.bench import BrakeParameters, Sensors
from emb_train.play import Measure

FIRST_STARTS = 24  # Coarse searches for the brake in the middle
STARTS = 3  # Coarse searches for each other brake, besides the warm start
SEED = 0  # Seed of the searches


def searchable(plant: Plant) -> str:
    """The plant for the search: the same mechanics behind ideal instruments; "" if not one of the thesis's.

    With the parameters known and nothing to react to, instruments cost nothing: for a plant that has some, it is what
    could be reached without them.
    """
    if plant.mechanics.solver == EULER:
        return "euler"
    return "exact" if plant.mechanics.solver == EXACT and is_plain(plant.mechanics) else ""


def optima(
    bench: Bench,
    measure: Measure,
    parameters: tuple[str, ...],
    plant: str,
    brakes: Sequence[BrakeParameters],
    tell: Callable[[str], object],
) -> Floats:
    """The measure of the best known currents for each brake.

    Args:
        bench: limits, noise, timing.
        measure: what is optimised.
        parameters: whose information counts.
        plant: ``euler`` or ``exact``.
        brakes: the first is searched for from many starts, and the others from its optimum too.
        tell: called with a line on the progress.

    Returns:
        Shape [len(brakes)].

    Raises:
        UsageError: nothing that was found for a brake keeps the limits.
    """
    begun: Floats | None = None  # What the search for the first brake found
    values: list[float] = []
    of_interval = isinstance(measure.goal, IntervalCriterion)  # which an estimate has with the bench's instruments
    ideal = bench if of_interval else replace(bench, sensors=Sensors())
    for number, brake in enumerate(brakes, 1):
        tell(f"optimum on {plant}, brake {number} of {len(brakes)}")
        goal = measure.goal
        problem = make_problem(ideal, goal, parameters, model=plant, kind=measure.kind, brake=brake, returns=True)
        warm = [] if begun is None else [begun if of_interval else followed(problem, begun)]
        found = search(problem, starts=FIRST_STARTS if begun is None else STARTS, seed=SEED, warm=warm)
        design = problem.design(found.best.currents)
        if begun is None:
            begun = found.genes if of_interval else design.states[1:, 1]
        values.append(design.phi if of_interval else float(measure.values(design.matrix[None])[0]))
    return np.array(values)


def followed(problem: Problem, speeds: Floats) -> Floats:
    """Currents [A] that give a known brake these speeds [rad/s] at the samples' ends, within the current limit."""
    p, t_s, limit = problem.brake, problem.sample_time, problem.box.current

    def law(x1: float, x2: float, k: int) -> float:
        torque = p.T_c * sign(x2 or speeds[k]) + p.f_v * x2 + stiffness(p, x1) * x1 + p.J * (speeds[k] - x2) / t_s
        current: float = min(max(torque / p.k_m, -limit), limit)
        return current

    motion = feedback(problem.plant.mechanics, p, law, t_s)
    return np.array([current for current, _, _ in islice(motion, len(speeds))])
