"""The estimator of a run: what the loop calls at each sample, whatever the policy is."""

from __future__ import annotations

import math

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.estimator.kalman import Four, State, believed, deviations, fits, follow, initial_state, make_model


def estimated(bench: Bench) -> tuple[str, ...]:
    """Names of the parameters that are estimated on a bench: those that its prior leaves open."""
    ranges = bench.range_set(bench.prior)
    return tuple(name for name in PARAMETER_NAMES if getattr(ranges.low, name) < getattr(ranges.high, name))


class Estimator:
    """Kalman filter with the noise, the ranges and the model of brake of a bench."""

    def __init__(self, bench: Bench) -> None:
        """Make the model, and begin."""
        self.model = make_model(bench, bench.range_set(bench.prior))
        self.state: State = initial_state(self.model)
        self._computed: tuple[State | None, tuple[float, ...]] = None, ()  # the parameters, and the state they are of

    def begin_run(self) -> None:
        """Begin anew: the next sample is the first one of a run."""
        self.state = initial_state(self.model)

    def add_sample(self, angle: float, velocity: float, step: float, applied: float) -> None:
        """Add one sample; arguments as of :func:`emb_runtime.estimator.kalman.follow`."""
        self.state = follow(self.model, self.state, angle, velocity, step, applied)

    @property
    def relative(self) -> Four:
        """k_m, k_1, T_c and f_v relative to their nominal values, within their ranges."""
        return believed(self.model, self.state)

    def in_si(self, relative: Four) -> Four:
        """Relative parameters, or their deviations, in SI units."""
        k_m, k_1, t_c, f_v = relative
        nominal = self.model.nominal
        return k_m * nominal[0], k_1 * nominal[1], t_c * nominal[2], f_v * nominal[3]

    @property
    def parameters(self) -> tuple[float, ...]:
        """k_m, k_1, T_c and f_v in SI units, then their standard deviations: 0 of one that the prior does not open.

        Computed once a sample: the policy takes them before the command leaves, the log after it.
        """
        state, parameters = self._computed
        if state is not self.state:
            relative = self.relative
            parameters = self.in_si(relative) + self.in_si(deviations(self.model, self.state, relative))
            self._computed = self.state, parameters
        return parameters

    @property
    def fits(self) -> bool:
        """True if the model explains the measurements, up to now."""
        return fits(self.state)

    @property
    def estimate(self) -> tuple[float, ...]:
        """The :attr:`parameters`; empty if one is not finite."""
        numbers = self.parameters
        return numbers if all(map(math.isfinite, numbers)) else ()
