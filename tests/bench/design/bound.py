"""A proved bound on the optimum of a design problem, to hold designs against; it shares no code with the search.

For the thesis's brake solved exactly and D, A or E: Hadamard's inequality log |M| ≤ Σ log M_ii, with bounds of the
single sensitivities. With ω² = γ k_1 / J, the quantity E² = ω² s_1² + s_2² of a sensitivity that is driven by a torque
of at most f obeys dE/dt ≤ f/J + (ω/2) E whether the brake is in contact or not; reversals and sticking only lower it.
The motion is homogeneous in the current and T_c, so that x = s_km + s_Tc (Euler's theorem), and the matrix in the
directions (x, k_1, T_c, f_v) has the same determinant.
"""

from __future__ import annotations

import math

import numpy as np

from emb_bench.config.plants import EXACT
from emb_bench.design.problem import Problem
from emb_bench.information.criteria import Criterion
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError


def ceiling(problem: Problem, criterion: Criterion) -> float:
    """A bound on φ that is proved.

    Raises:
        UsageError: the brake, the criterion or the parameters are not those it is proved for.
    """
    p, box, name = problem.brake, problem.box, criterion.name
    plain = problem.plant.mechanics.solver == EXACT and problem.plant.mechanics == type(problem.plant.mechanics)()
    if not plain or not set(problem.params) <= set(PARAMETER_NAMES):
        raise UsageError("the proved bound is for D, A and E of the thesis's parameters on the brake 'exact'")
    t_s, n = problem.sample_time, problem.horizon
    time = t_s * np.arange(n + 1)
    end = np.full(n + 1, math.inf) if math.isinf(box.home_angle) else box.home_angle + box.speed * (time[-1] - time)
    reach = np.minimum(box.speed * time, end)
    highest = np.minimum(reach, box.high)
    angle = np.maximum(highest, np.minimum(reach, -box.low))
    told = {
        "k_1": _driven(problem, p.gamma * p.k_1 * np.maximum(highest[1:], highest[:-1])),
        "T_c": _driven(problem, np.full(n, p.T_c)),
        "f_v": _driven(problem, np.full(n, p.f_v * box.speed)),
    }
    motion = _sum(problem, angle[1:], np.full(n, box.speed))
    root = math.sqrt(motion) + math.sqrt(told["T_c"])
    told["k_m"] = root * root
    single = {name: told[name] for name in problem.params}
    smallest = min(single.values())
    if {"k_m", "T_c"} <= set(single):
        single["k_m"] = motion
        smallest = min(smallest, 0.5 * motion)  # of the unit vector along k_m + T_c
    if name == "D":
        return sum(math.log(value) for value in single.values())
    return math.log(smallest)  # 1 / tr M⁻¹ is no more than λ_min


def _driven(problem: Problem, torque: Floats) -> float:
    """Bound of the element M_ii of a sensitivity driven by torques of at most ``torque`` in each period."""
    p = problem.brake
    omega = math.sqrt(p.gamma * p.k_1 / p.J)
    growth = math.expm1(0.5 * omega * problem.sample_time)
    size, travel, sizes, travels = 0.0, 0.0, [], []
    for f in torque:
        size += growth * (size + 2.0 * f / (p.J * omega))
        travel += problem.sample_time * size
        sizes.append(size)
        travels.append(min(travel, size / omega))
    return _sum(problem, np.array(travels), np.array(sizes))


def _sum(problem: Problem, angle: Floats, velocity: Floats) -> float:
    return float((problem.weights.angle * angle**2 + problem.weights.velocity * velocity**2).sum())
