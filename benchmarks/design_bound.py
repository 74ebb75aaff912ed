"""Bounds on the optimum of a design problem: one is proved and loose, one is searched for and close.

**Proved** (:func:`ceiling`), for the thesis's brake solved exactly and D, A or E: Hadamard's inequality
log |M| ≤ Σ log M_ii, with bounds of the single sensitivities. With ω² = γ k_1 / J, the quantity E² = ω² s_1² + s_2² of
a sensitivity that is driven by a torque of at most f obeys dE/dt ≤ f/J + (ω/2) E whether the brake is in contact or
not; reversals and sticking only lower it. The motion is homogeneous in the current and T_c, so that x = s_km + s_Tc
(Euler's theorem), and the matrix in the directions (x, k_1, T_c, f_v) has the same determinant.

**Searched for** (:func:`estimate`): φ is the logarithm of a concave function that is homogeneous of degree one, to the
power q. So φ(M) ≤ φ(M₀) + q log(tr(∇φ(M₀) M) / q) for every M₀. The largest tr(∇φ(M₀) M) over all designs bounds them
all, and all mixtures of them as well: what several different experiments together can reach per experiment (Kiefer and
Wolfowitz 1960), which is more than any single one can. That largest value is found by the same search, so that this
bound is an estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from emb_bench.design.problem import Problem
from emb_bench.design.search import search
from emb_bench.information.criteria import Criterion, Tangent
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.plants import EXACT
from emb_runtime.errors import UsageError

MIXING = 3000  # Rounds of the multiplicative algorithm
SMOOTH = 20.0  # Power mean of the eigenvalues that stands for the smallest one when a mixture is sought


@dataclass(frozen=True)
class Estimate:
    """Estimate of a bound on φ."""

    mixture: float  # φ of the best mixture of what was found: between the best single design and the bound
    bound: float  # On φ of every design and every mixture, as far as the search sees


def estimate(
    problem: Problem,
    criterion: Criterion,
    found: Sequence[tuple[Floats, Floats]],
    *,
    rounds: int,
    starts: int,
    seed: int,
) -> Estimate:
    """Mix what was found, look for what would improve the mixture most, and again.

    Args:
        problem: what was designed.
        criterion: that of the problem.
        found: currents and FIM of designs.
        rounds: of mixing and looking.
        starts: coarse searches in each.
        seed: of their random numbers.
    """
    pool = list(found)
    degree = {"D": len(problem.params), "Ds": len(criterion.wanted)}.get(criterion.name, 1)
    mixture, bound = -math.inf, math.inf
    for number in range(rounds):
        mixed = _mixture(criterion, np.array([matrix for _, matrix in pool]), degree)
        slope, base = _slope(criterion, mixed)
        warm = sorted(pool, key=lambda pair: -float((pair[1] * slope).sum()))[:2]
        steepest = search(
            replace(problem, goal=Tangent(slope)), starts=starts, seed=seed + number, warm=[u for u, _ in warm]
        ).best
        pool.append((steepest.currents, steepest.matrix))
        mixture = max(mixture, float(criterion.phi(mixed)))
        largest = max(float((matrix * slope).sum()) for _, matrix in pool)
        bound = min(bound, base + degree * math.log(largest / degree))
    return Estimate(mixture, bound)


def _slope(criterion: Criterion, m: Floats) -> tuple[Floats, float]:
    """W and c such that φ(M') ≤ c + q log(tr(W M') / q) for every M'."""
    if criterion.name != "E":
        return criterion.gradient(m), float(criterion.phi(m))
    slope = _smooth_gradient(m)  # any W of trace one bounds λ_min
    return slope / np.trace(slope), 0.0


def _smooth_gradient(m: Floats) -> Floats:
    values, vectors = np.linalg.eigh(m)
    shares = (values / values[0]) ** (-SMOOTH - 1.0)
    result: Floats = (vectors * (shares / (shares * values).sum())) @ vectors.T
    return result


def _mixture(criterion: Criterion, matrices: Floats, degree: int) -> Floats:
    """The best convex combination, by the multiplicative algorithm (Silvey, Titterington and Torsney 1978)."""
    shares = np.full(len(matrices), 1.0 / len(matrices))
    smooth = criterion.name == "E"
    power = 1.0 if criterion.name in ("D", "Ds") else 1.0 / (1.0 + (SMOOTH if smooth else 1.0))
    for _ in range(MIXING):
        mixed = np.einsum("e,eij->ij", shares, matrices)
        slope = _smooth_gradient(mixed) if smooth else criterion.gradient(mixed) / degree
        shares *= np.einsum("eij,ij->e", matrices, slope) ** power
        shares /= shares.sum()
    result: Floats = np.einsum("e,eij->ij", shares, matrices)
    return result


def ceiling(problem: Problem, criterion: Criterion) -> float:
    """A bound on φ that is proved.

    Raises:
        UsageError: the brake, the criterion or the parameters are not those it is proved for.
    """
    p, box, name = problem.brake, problem.box, criterion.name
    plain = problem.plant.mechanics.solver == EXACT and problem.plant.mechanics == type(problem.plant.mechanics)()
    if not plain or name == "Ds" or not set(problem.params) <= set(PARAMETER_NAMES):
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
