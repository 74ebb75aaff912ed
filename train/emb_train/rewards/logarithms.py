"""The project's own rewards for several parameters: what an optimality criterion grew by, from a prior on.

Meant for the *physical* information relative to the true parameters. The prior takes the place of the thesis's ε: 12 is
one over the variance of a parameter that is uniform within ±50 %, so that what is known beforehand earns nothing. An
experiment's rewards add up to its criterion minus the prior's.
"""

from __future__ import annotations

from dataclasses import dataclass

from emb_bench.information.symmetric import LOG_DET, LOG_LAMBDA_MIN, MINUS_LOG_TRACE, each
from emb_runtime.errors import UsageError
from emb_train.rewards.transition import Floats, Transition


@dataclass(frozen=True)
class _Gain:
    scale: float
    """Brings a return to a number that a network fits."""
    prior: float = 12.0
    """Information on each parameter before the experiment."""

    def __post_init__(self) -> None:
        """Refuse a prior without which a logarithm does not exist.

        Raises:
            UsageError: it is not positive.
        """
        if not self.prior > 0.0:
            raise UsageError(f"prior: expected a positive number, got {self.prior}")

    def check(self, parameters: tuple[str, ...]) -> None:
        """Any parameters will do."""


@dataclass(frozen=True)
class LogDeterminant(_Gain):
    """Increments of ln |M + prior I| (D, eq. 4.12-4.13)."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        after, before = (each(LOG_DET, m, self.prior) for m in (transition.after, transition.before))
        return self.scale * (after - before)


@dataclass(frozen=True)
class LogSmallest(_Gain):
    """Increments of ln λ_min(M + prior I) (E, eq. 4.14)."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        after, before = (each(LOG_LAMBDA_MIN, m, self.prior) for m in (transition.after, transition.before))
        return self.scale * (after - before)


@dataclass(frozen=True)
class LogTrace(_Gain):
    """Increments of −ln tr (M + prior I)⁻¹ (A, eq. 4.16)."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        after, before = (each(MINUS_LOG_TRACE, m, self.prior) for m in (transition.after, transition.before))
        return self.scale * (after - before)
