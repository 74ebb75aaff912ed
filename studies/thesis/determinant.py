"""Fig. 4.2 and 4.3: the determinant of the weighted FIM under a constant current, before and after the cure of 4.4.

The same sums and the same elimination are carried out in three arithmetics: in single precision, which is what PyTorch
computes in by default; in double precision; and exactly, in rational numbers. What differs is rounding.

The thesis states neither the current of Fig. 4.2 nor ε. Here both are chosen. 0.7 A, for four parameters, shows in
single precision what the text says that the figure shows: gaps at several intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.config.bench import Bench
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.information.criteria import criteria
from emb_bench.information.fisher import Weights, information_over_time, thesis_weights
from emb_bench.information.symmetric import Floats, information, log_det, pack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters

AMPLITUDE = 0.7  # A
EPSILON = 1e-6
SETTLED = 20  # Samples after which no further parameter is identified, which would be a jump of the condition number
SPIKE = 3.0  # Factor by which rounding must change a condition number to be called a spike

Number = Callable[[Any], Any]  # Makes a number of one arithmetic: ``numpy.float32``, ``float``, ``fractions.Fraction``


@dataclass(frozen=True, eq=False)
class Unprotected:
    """Content of Fig. 4.2: 500 samples of a constant current, the FIM started at zero."""

    amplitude: float  # Current [A]
    states: Floats  # Angle [rad] and velocity [rad/s], shape (n + 1, 2)
    fims: Floats  # In double precision, shape (n, p, p)
    fims_single: Floats  # Sums in single precision of sensitivities in single precision, shape (n, p, p)
    determinants: Floats  # Determinants of ``fims`` by elimination in double precision, shape (n,)
    determinants_single: Floats  # Determinants of ``fims_single`` by elimination in single precision, shape (n,)
    signs_exact: NDArray[np.int64]
    """Sign of the determinant that the sensitivities in double precision have exactly, shape (n,)."""
    log_exact: Floats  # Its logarithm, −inf where it is zero, shape (n,)
    conditions: Floats  # Condition number of ``fims``, shape (n,)
    conditions_single: Floats  # Condition number of ``fims_single``, computed in double precision, shape (n,)
    ranks: NDArray[np.int64]  # Number of parameters or combinations of them identified after each sample, shape (n,)
    increment_rank: int  # Largest rank that one sample adds


@dataclass(frozen=True, eq=False)
class Protected:
    """Content of Fig. 4.3: the FIM started at ε I and normalised while it runs, in double precision."""

    epsilon: float
    rewards: Floats  # Step rewards of the running normalisation, shape (n,)
    log_normalised: Floats  # log |M̄_k|, shape (n,)
    log_alpha: Floats  # log α_k, shape (n,)
    conditions: Floats  # Condition number of M̄_k, shape (n,)
    failures_single: dict[float, int]
    """By ε: how many determinants in single precision are not positive with the initialisation alone."""

    @property
    def log_det(self) -> Floats:
        """Logarithm of |M_k|, recovered from the rewards, shape (n,)."""
        return len(PARAMETER_NAMES) * math.log(self.epsilon) + np.cumsum(self.rewards)


def unprotected(bench: Bench, amplitude: float) -> Unprotected:
    """Compute Fig. 4.2 for a constant current [A]."""
    currents = np.full(bench.timing.horizon, amplitude)
    t_s = bench.timing.sample_time
    weights = thesis_weights(bench.noise, bench.limits)
    run = simulate(bench.plant("euler"), Theta(bench.brake), planned(currents), t_s, PARAMETER_NAMES)
    s = run.sensitivities
    single = np.float32
    rows = s.tolist()
    fims = information_over_time(s, weights)
    sums_single = _sums(_sensitivities_in(single, bench.brake, currents, t_s), weights, single)
    exact = [determinant(m, Fraction) for m in _sums(rows, weights, Fraction)]
    fims_single = np.array(sums_single, dtype=np.float64)
    size = len(PARAMETER_NAMES)
    return Unprotected(
        amplitude=amplitude,
        states=run.states,
        fims=fims,
        fims_single=fims_single,
        determinants=np.array([determinant(m, float) for m in fims.tolist()]),
        determinants_single=np.array([float(determinant(m, single)) for m in sums_single]),
        signs_exact=np.array([(d > 0) - (d < 0) for d in exact]),
        log_exact=np.array([_log(d) for d in exact]),
        conditions=np.linalg.cond(fims),
        conditions_single=np.linalg.cond(fims_single),
        ranks=np.array([size - len(criteria(m, PARAMETER_NAMES).flat) for m in fims]),
        increment_rank=int(np.linalg.matrix_rank(information_over_time(s[-1:], weights)[0], rtol=1e-14)),
    )


def protected(bench: Bench, amplitude: float, epsilon: float) -> Protected:
    """Compute Fig. 4.3 for a constant current [A] and ε."""
    currents = np.full(bench.timing.horizon, amplitude)
    t_s = bench.timing.sample_time
    weights = thesis_weights(bench.noise, bench.limits)
    s = simulate(bench.plant("euler"), Theta(bench.brake), planned(currents), t_s, PARAMETER_NAMES).sensitivities
    increments = np.array([information_over_time(s[k : k + 1], weights)[0] for k in range(len(s))])
    rewards, logs, alphas, matrices = normalised(increments, epsilon)
    return Protected(
        epsilon=epsilon,
        rewards=rewards,
        log_normalised=logs,
        log_alpha=alphas,
        conditions=np.linalg.cond(matrices),
        failures_single=_failures_single(bench, currents, weights),
    )


def normalised(increments: Floats, epsilon: float) -> tuple[Floats, Floats, Floats, Floats]:
    """The running normalisation M̄_k = α_k M_k of a FIM that begins at ε I (eq. 4.28, 4.35-4.39).

    α_k is chosen so that |α_k M_{k−1}| = |M_init|. Eq. 4.39 prints this with M̄_{k−1} and α_k; it has to be the ratio
    α_k / α_{k−1} that equals (|M_init| / |M̄_{k−1}|)^{1/n}, else |M̄_k| grows as the square root of |M_k|. In eq. 4.36,
    third line, α_k|M_k| is meant as |α_k M_k|.

    Args:
        increments: of the FIM itself, shape (T, n, n).
        epsilon: ε, greater than 0.

    Returns:
        The step rewards r_k = log |M_k| − log |M_{k−1}| (eq. 4.13, 4.36), log |M̄_k| and log α_k, each of shape (T,),
        and M̄_k, shape (T, n, n).
    """
    size = increments.shape[-1]
    matrix, begun, log_alpha = epsilon * np.eye(size), size * math.log(epsilon), 0.0
    last, rows, matrices = begun, [], []
    for increment in increments:
        log_ratio = (begun - last) / size
        log_alpha += log_ratio
        matrix = math.exp(log_ratio) * matrix + math.exp(log_alpha) * increment  # eq. 4.38
        last = log_det(pack(matrix), np.empty(matrix.shape))
        rows.append((last - begun, last, log_alpha))
        matrices.append(matrix)
    rewards, logs, alphas = np.array(rows).T
    return rewards, logs, alphas, np.array(matrices)


def determinant(matrix: Sequence[Sequence[Any]], number: Number) -> Any:
    """By elimination with partial pivoting, in the arithmetic of its elements: exact for fractions.

    Args:
        matrix: square.
        number: makes a number of that arithmetic.
    """
    rows = [list(row) for row in matrix]
    result = number(1)
    for i in range(len(rows)):
        pivot = max(range(i, len(rows)), key=lambda r: abs(rows[r][i]))
        if rows[pivot][i] == 0:
            return number(0)
        if pivot != i:
            rows[i], rows[pivot] = rows[pivot], rows[i]
            result = -result
        result = result * rows[i][i]
        for r in range(i + 1, len(rows)):
            factor = rows[r][i] / rows[i][i]
            for c in range(i + 1, len(rows)):
                rows[r][c] = rows[r][c] - factor * rows[i][c]
    return result


def _sensitivities_in(number: Number, p: BrakeParameters, currents: Floats, t_s: float) -> list[Any]:
    """The sensitivities of all parameters after each sample, computed in another arithmetic than double precision."""
    theta: Any = BrakeParameters(*map(number, p))
    step_time: Any = number(t_s)
    x1 = x2 = number(0)
    now = [(number(0), number(0))] * len(PARAMETER_NAMES)
    history = []
    for u in map(number, currents.tolist()):
        now = [sensitivity_step(theta, x1, x2, u, step_time, a, b, i) for i, (a, b) in enumerate(now)]
        x1, x2 = step(theta, x1, x2, u, step_time)
        history.append(now)
    return history


def _sums(
    s: Sequence[Sequence[Sequence[Any]]], weights: Weights, number: Number, epsilon: float = 0.0
) -> list[list[list[Any]]]:
    """The FIM after each sample in the arithmetic of ``number``, started at ε I."""
    w1, w2 = map(number, weights)
    size = len(s[0])
    total = [[number(epsilon if i == j else 0.0) for j in range(size)] for i in range(size)]
    history = []
    for row in s:
        values = [[number(v) for v in pair] for pair in row]
        for i in range(size):
            for j in range(i, size):
                (a1, a2), (b1, b2) = values[i], values[j]
                total[i][j] = total[i][j] + information(a1, a2, b1, b2, w1, w2)
                total[j][i] = total[i][j]
        history.append([list(line) for line in total])
    return history


def _failures_single(bench: Bench, currents: Floats, weights: Weights) -> dict[float, int]:
    s = _sensitivities_in(np.float32, bench.brake, currents, bench.timing.sample_time)
    return {
        epsilon: sum(not determinant(m, np.float32) > 0 for m in _sums(s, weights, np.float32, epsilon))
        for epsilon in (1e-6, 1e-4, 1e-2, 1.0)
    }


def _log(value: Fraction) -> float:
    return math.log(value.numerator) - math.log(value.denominator) if value > 0 else -math.inf
