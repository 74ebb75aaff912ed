"""Running normalisation of the Fisher information, and its start ε I (thesis eq. 4.28, 4.35-4.39)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emb_bench.information.symmetric import Floats, log_det, pack
from emb_runtime.errors import UsageError


def epsilon_identity(size: int, epsilon: float) -> Floats:
    """The thesis's start of the FIM, ε I (eq. 4.28): every eigenvalue of the sum grows by ε (eq. 4.34)."""
    return epsilon * np.eye(size)


@dataclass(frozen=True, eq=False)
class NormalisedFisher:
    """The running normalisation M̄_k = α_k M_k (eq. 4.35): |M̄_k| stays near |M_init|, the step rewards are unchanged.

    α_k is chosen so that |α_k M_{k−1}| = |M_init|. Eq. 4.39 prints this with M̄_{k−1} and α_k; it has to be the ratio
    α_k / α_{k−1} that equals (|M_init| / |M̄_{k−1}|)^{1/n}, else |M̄_k| grows as the square root of |M_k|. In eq. 4.36,
    third line, α_k|M_k| is meant as |α_k M_k|.
    """

    matrix: Floats  # M̄_k, shape (n, n)
    log_det: float  # log |M̄_k|
    log_alpha: float  # log α_k
    initial_log_det: float  # log |M_init|

    @classmethod
    def start(cls, initial: Floats) -> NormalisedFisher:
        """Begin at a non-singular FIM, ε I (eq. 4.28) or a prior.

        Raises:
            UsageError: it is singular, and so has no logarithm to start from.
        """
        value = _log_det(initial)
        if value == -math.inf:
            raise UsageError("the initial Fisher information is singular: begin at epsilon_identity or a prior")
        return cls(np.array(initial, dtype=np.float64), value, 0.0, value)

    def add(self, increment: Floats) -> tuple[NormalisedFisher, float]:
        """Add one sample's information (eq. 4.38).

        Args:
            increment: of the FIM itself, not normalised, shape (n, n).

        Returns:
            The next normalised FIM, and the step reward r_k = log |M_k| − log |M_{k−1}| (eq. 4.13, 4.36).
        """
        log_ratio = (self.initial_log_det - self.log_det) / len(self.matrix)
        log_alpha = self.log_alpha + log_ratio
        matrix = math.exp(log_ratio) * self.matrix + math.exp(log_alpha) * increment
        value = _log_det(matrix)
        return NormalisedFisher(matrix, value, log_alpha, self.initial_log_det), value - self.initial_log_det


def _log_det(matrix: Floats) -> float:
    return log_det(pack(matrix), np.empty(matrix.shape))
