"""Every sample of a design to its local optimum: sequential linear programming with a trust region.

The motion and the Fisher information are linearised in the currents: the maps of the single periods are differentiated,
and an adjoint sweep gives every element of M. The criterion is concave in M, so that its tangents at a few matrices
bound it from above (Kelley's cutting planes). The result is a sparse linear program over changes of currents and states
within the limits, which HiGHS solves. A step counts if the simulated criterion grows. Optima of this problem lie on
corners: currents and speeds at their limits, the end at the edge of home. So do the solutions of linear programs
(Fletcher and Sainz de la Maza, Mathematical Programming 43, 1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, hstack

from emb_bench.config.plants import EXACT
from emb_bench.design.problem import Design, Problem
from emb_bench.information.symmetric import Floats

FIRST_RADIUS = 2.0  # Largest change of a current in the first step [A]
SMALLEST_RADIUS = 1e-4  # Largest change of a current in a step at which a polish ends [A]
PATIENCE = 10  # Rounds over which the gain is judged
CLOSE = 0.2  # Share of the gain by which the tangents may exceed the criterion when no more are added
SLACKS = (0.0, 0.5, 1.0)
"""Shares of the present excess over the box that may remain, tried in this order; the last one is always feasible."""
SLOWEST = 1.0
"""Speed below which a step leaves no sample that moves [rad/s], unless it is slower already. A step keeps the direction
of motion of every sample, for the information of a sample jumps or bends where that changes; the annealing finds the
best pattern. Without a floor designs slide at 1e-6 rad/s for a third of the experiment, which no real brake does; a
floor of one sigma of the velocity costs 0.003 in log det."""
SLOWEST_STEPPED = 0.1
"""SLOWEST for solvers other than ``EXACT``, whose periods are linear as long as no direction changes [rad/s]."""
NEAREST = 1e-6  # Distance from contact below which a step leaves no sample [rad]; for solvers other than ``EXACT``


@dataclass(frozen=True)
class Settings:
    """Limits of a polish."""

    steps: int  # Largest number of rounds
    tolerance: float  # Gain over the last PATIENCE rounds at which it ends
    cuts: int  # Tangents in one round at most


def merit(design: Design) -> float:
    """The criterion less the price of leaving the box."""
    return design.phi - design.price


def polish(problem: Problem, currents: Floats, settings: Settings) -> Design:
    """A local optimum near a sequence of currents [A], shape (n,)."""
    largest = problem.box.current
    best = problem.design(np.clip(currents, -largest, largest))
    step = _Step(problem, best)
    radius = FIRST_RADIUS
    history = [merit(best)]
    for _ in range(settings.steps):
        change, promised = step.solve(radius, settings.cuts)
        trial = problem.design(np.clip(best.currents + change, -largest, largest))
        gain = merit(trial) - merit(best)
        if gain > 0.5 * promised:
            radius = min(2.0 * radius, 2.0 * largest)
        elif gain < 0.2 * promised:
            radius *= 0.5 if gain > 0.0 else 0.35
        if gain > 0.0:
            best, step = trial, _Step(problem, trial)
        history.append(merit(best))
        tired = len(history) > PATIENCE and history[-1] - history[-1 - PATIENCE] < settings.tolerance
        if tired or radius < SMALLEST_RADIUS:
            break
    return best


class _Step:
    """The linear program around one design."""

    def __init__(self, problem: Problem, design: Design) -> None:
        self.problem, self.design = problem, design
        jacobian = problem.jacobian(design)
        self.slopes = problem.gradients(design, jacobian)
        # Position in hysteresis or play and the motor's current move the brake only where a plant has them.
        self.states = 4 if jacobian[:, :2, 2:4].any() else 2
        self.motion = _motion(jacobian[:, : self.states, : self.states], jacobian[:, : self.states, -1])
        self.cuts = [design.matrix]

    def solve(self, radius: float, cuts: int) -> tuple[Floats, float]:
        """Change of the currents within a radius [A], and the predicted gain in :func:`merit`."""
        now, phi = self.design, self.problem.criterion.phi
        change, gain = np.zeros(len(now.currents)), 0.0
        for _ in range(cuts):
            change, bound, slack = self._program(radius)
            if not change.any():
                break
            matrix = now.matrix + np.einsum("k,kij->ij", change, self.slopes)
            if np.linalg.eigvalsh(matrix)[0] <= 0.0:  # beyond the linear range: halve the step
                matrix = 0.5 * (matrix + now.matrix)
                if np.linalg.eigvalsh(matrix)[0] <= 0.0:
                    break
            promise = float(phi(matrix)) - now.phi
            gain = promise + (1.0 - slack) * now.price
            if bound - promise < CLOSE * abs(bound):
                break
            self.cuts.append(matrix)
        return change, gain

    def _program(self, radius: float) -> tuple[Floats, float, float]:
        """Solve the linear program: change of the currents, least tangent there, share of the price that stays."""
        n, states = len(self.design.currents), self.states
        rows, right = [], []
        for matrix in self.cuts:  # t <= phi(matrix) + <gradient, M + dM - matrix> - phi
            slope = self.problem.criterion.gradient(matrix)
            rows.append(-np.einsum("kij,ij->k", self.slopes, slope))
            ahead = float(self.problem.criterion.phi(matrix)) - self.design.phi
            right.append(ahead + float((slope * (self.design.matrix - matrix)).sum()))
        scale = max(float(np.abs(rows[0]).max()), 1e-12)
        cuts = np.zeros((len(rows), n + states * n + 1))
        cuts[:, :n] = np.array(rows) / scale
        cuts[:, -1] = 1.0
        cost = np.zeros(n + states * n + 1)
        cost[-1] = -1.0
        if not (np.isfinite(cuts).all() and np.isfinite(right).all()):
            return np.zeros(n), 0.0, 1.0  # the information is singular, or has overflowed
        for slack in SLACKS:
            found = linprog(
                cost,
                A_ub=csr_array(cuts),
                b_ub=np.array(right) / scale,
                A_eq=self.motion,
                b_eq=np.zeros(states * n),
                bounds=self._bounds(radius, slack),
                method="highs-ds",
                options={"primal_feasibility_tolerance": 1e-9, "dual_feasibility_tolerance": 1e-9},
            )
            if found.status == 0:
                return found.x[:n], float(found.x[-1]) * scale, slack
        return np.zeros(n), 0.0, 1.0

    def _bounds(self, radius: float, slack: float) -> Floats:
        """Lowest and highest change of each variable, shape (n + states n + 1, 2)."""
        box, u, x = self.problem.box, self.design.currents, self.design.states[1:]
        exact = self.problem.plant.mechanics.solver == EXACT
        lowest, highest = np.full((len(u), self.states), -np.inf), np.full((len(u), self.states), np.inf)
        lowest[:, 0], highest[:, 0] = box.low, box.high
        lowest[:, 1], highest[:, 1] = -box.speed, box.speed
        slowest = np.minimum(np.abs(x[:, 1]), SLOWEST if exact else SLOWEST_STEPPED)
        lowest[x[:, 1] > 0.0, 1] = slowest[x[:, 1] > 0.0]
        highest[x[:, 1] < 0.0, 1] = -slowest[x[:, 1] < 0.0]
        if not exact:
            nearest = np.minimum(np.abs(x[:, 0]), NEAREST)
            lowest[x[:, 0] >= 0.0, 0] = nearest[x[:, 0] >= 0.0]
            highest[x[:, 0] < 0.0, 0] = -nearest[x[:, 0] < 0.0]
        end = np.array([box.home_angle, box.home_velocity])
        lowest[-1, :2] = np.maximum(lowest[-1, :2], -end)
        highest[-1, :2] = np.minimum(highest[-1, :2], end)
        below, above = lowest - x[:, : self.states], highest - x[:, : self.states]
        below = np.where(below > 0.0, (1.0 - slack) * below, below)
        above = np.where(above < 0.0, (1.0 - slack) * above, above)
        low = np.concatenate([np.maximum(-radius, -box.current - u), below.ravel(), [-np.inf]])
        high = np.concatenate([np.minimum(radius, box.current - u), above.ravel(), [np.inf]])
        return np.column_stack([low, high])


def _motion(a: Floats, b: Floats) -> csr_array:
    """Rows dx_{k+1} − A_k dx_k − b_k du_k = 0 over the variables (du, dx, t), for A (n, d, d) and b (n, d)."""
    n, d = b.shape
    row = np.arange(n * d).reshape(n, d)
    drive = csr_array((-b.ravel(), (row.ravel(), np.repeat(np.arange(n), d))), shape=(n * d, n))
    back = np.broadcast_to(row[1:, :, None], (n - 1, d, d)).ravel()
    front = np.broadcast_to(row[:-1, None, :], (n - 1, d, d)).ravel()
    chain = csr_array((-a[1:].ravel(), (back, front)), shape=(n * d, n * d))
    identity = csr_array((np.ones(n * d), (row.ravel(), row.ravel())), shape=(n * d, n * d))
    bound = csr_array((n * d, 1))  # the variable t that the cuts bound
    return hstack([drive, chain + identity, bound], format="csr")
