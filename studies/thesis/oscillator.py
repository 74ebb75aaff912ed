"""Fig. 5.1: the sensitivity to viscous friction as a mass on a spring, driven by the motor's velocity (section 5.1.1).

The velocity is prescribed, as the thesis does it: no current, no angle limit and no Coulomb friction are in it. The
recursion is the brake's own (:func:`emb_bench.brake.euler.sensitivity_step`); the closed form of the damped oscillator
stands beside it as the answer without Euler's error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from emb_bench.brake.euler import sensitivity_step, stiffness
from emb_bench.brake.parameters import F_V
from emb_bench.config.bench import Bench
from emb_bench.information.fisher import Weights, physical_weights, thesis_weights
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters
from studies.thesis.facts import Statement

SWITCH = 0.2  # s, when input 2 stops
STARTS = 30  # Random beginnings of the search for a better velocity than a constant one


@dataclass(frozen=True, eq=False)
class Input:
    """One prescribed velocity and its information."""

    velocity: Floats  # In each period [rad/s], shape (n,)
    s: Floats  # a [rad] and b [rad/s] at the end of each period, shape (n, 2)
    increments: Floats  # Increments of the weighted FIM, shape (n,)


@dataclass(frozen=True, eq=False)
class Oscillator:
    """The mass-spring-damper with m = J, k = γ k_1, c = f_v (eq. 5.7)."""

    frequency: float  # Undamped [rad/s]
    damping: float  # Ratio ζ (eq. 5.9).

    @property
    def peak_time(self) -> float:
        """Peak time of the step response, π / (ω_0 √(1 − ζ²)) [s]."""
        return math.pi / (self.frequency * math.sqrt(1.0 - self.damping**2))

    @property
    def overshoot(self) -> float:
        """By which each half swing is smaller than the one before, exp(−π ζ / √(1 − ζ²))."""
        return math.exp(-math.pi * self.damping / math.sqrt(1.0 - self.damping**2))


def oscillator(p: BrakeParameters) -> Oscillator:
    """The one that a brake in contact makes."""
    spring = stiffness(p, 0.0)
    return Oscillator(math.sqrt(spring / p.J), p.f_v / (2.0 * math.sqrt(spring * p.J)))


def driven(bench: Bench, velocity: Floats) -> Input:
    """The sensitivity to f_v of a brake whose motor runs with a prescribed velocity, in contact (eq. 5.6, 5.12).

    Args:
        bench: brake, sample time, and the thesis's weights.
        velocity: in each period [rad/s], shape (n,).
    """
    a = b = 0.0
    s = np.empty((len(velocity), 2))
    for k, x2 in enumerate(velocity.tolist()):
        a, b = sensitivity_step(bench.brake, 0.0, x2, 0.0, bench.timing.sample_time, a, b, F_V)
        s[k] = a, b
    return Input(velocity, s, _increments(s, thesis_weights(bench.noise, bench.limits)))


def inputs(bench: Bench) -> tuple[Input, Input]:
    """Input 1, always as fast as allowed, and input 2, which stops after 0.2 s."""
    times = np.arange(bench.timing.horizon) * bench.timing.sample_time
    fast = bench.limits.velocity
    full = np.full(len(times), fast)
    return driven(bench, full), driven(bench, np.where(times < SWITCH - 1e-9, fast, 0.0))


def oscillator_facts(bench: Bench) -> list[Statement]:
    """Checks the statements of section 5.1, and of 5.2.1 about the same curve."""
    first, second = inputs(bench)
    return [*_constant_facts(bench, first), *_bound_facts(bench, first), *_stopped_facts(bench, second)]


def _constant_facts(bench: Bench, first: Input) -> list[Statement]:
    p, t_s = bench.brake, bench.timing.sample_time
    exact = oscillator(p)
    peak = int(np.argmax(np.abs(first.s[:, 0])))
    settled = p.f_v * bench.limits.velocity / stiffness(p, 0.0)
    top = settled * (1.0 + exact.overshoot)
    highest = thesis_weights(bench.noise, bench.limits).angle * top**2
    euler_peak, euler_highest = (peak + 1) * t_s, float(first.increments.max())
    after = first.increments[peak + 1 :]
    share = _angle_share(first, thesis_weights(bench.noise, bench.limits))
    share_physical = _angle_share(first, physical_weights(bench.noise))
    total = float((share * first.increments).sum() / first.increments.sum())
    return [
        (
            "eq. 5.9",
            "the damping ratio is 0.2407",
            f"{exact.damping:.4f}",
            abs(exact.damping - 0.2407) < 5e-5,
        ),
        (
            "5.1.1",
            "at a constant 500 rad/s the sensitivity a peaks at approximately 0.34 s",
            f"Euler at {euler_peak:.3f} s, the closed form pi / (w0 sqrt(1 - zeta^2)) at {exact.peak_time:.4f} s: "
            f"0.33 s rounded; the peaks are {abs(first.s[peak, 0]):.2f} and {top:.2f} rad",
            abs(euler_peak - 0.34) <= 0.01 and abs(exact.peak_time - 0.34) <= 0.01,
        ),
        (
            "5.1.1",
            "from the peak of a on, the increment falls as well",
            f"from {euler_highest:.4g} at {euler_peak:.3f} s to {after[-1]:.4g} at the end",
            bool((np.diff(first.increments[peak:]) < 0.0).all()),
        ),
        (
            "5.2.1",
            "the largest increment within 500 ms at full speed is about 1.3e5",
            f"Euler {euler_highest:.4g}, closed form {highest:.4g}",
            abs(euler_highest - 1.3e5) <= 0.05e5 and abs(highest - 1.3e5) <= 0.05e5,
        ),
        (
            "5.1.1",
            "the increment is decided by a far more than by b",
            f"of the sum, {100.0 * total:.5f} % come from a; b decides {int((share < 0.5).sum())} of {len(share)} "
            "samples, those in which a has not begun to move",
            total > 0.9,
        ),
        (
            "5.1.1",
            "that a counts for so much is due to the sensors' noise",
            f"of the ratio of the weights of a^2 and b^2 the noise makes {_noise_factor(bench):.3g}, and the division "
            f"of the outputs by their limits {_normalisation_factor(bench):.3g}; with the noise alone b decides "
            f"{int((share_physical < 0.5).sum())} samples",
            _noise_factor(bench) > _normalisation_factor(bench),
        ),
    ]


def _bound_facts(bench: Bench, first: Input) -> list[Statement]:
    fast = bench.limits.velocity
    response = response_matrix(bench)
    weights = thesis_weights(bench.noise, bench.limits)
    angle = response[:, :, 0]
    reach = fast * np.abs(angle).sum(axis=1)
    gain = weights.angle * float(reach[-1]) ** 2 / float(first.increments[-1])
    quadratic = weights.angle * angle.T @ angle + weights.velocity * response[:, :, 1].T @ response[:, :, 1]
    constant = float(first.increments.sum())
    best = max(float(v @ quadratic @ v) for v in _switched(quadratic, fast)) / constant
    ceiling = float(np.abs(quadratic).sum()) * fast**2 / constant
    later = int(np.argmax(reach > (1.0 + 1e-6) * np.abs(first.s[:, 0]))) + 1
    return [
        (
            "5.1.1",
            "the increments at constant full speed are the upper limit of what any input reaches",
            f"sample by sample only until {later * bench.timing.sample_time:.3f} s: a velocity that changes its sign "
            f"half a swing before the end has there an increment {gain:.3g} times as large",
            gain < 1.01,
        ),
        (
            "5.1.1",
            "constant full speed is the optimal velocity: the sum of the increments is largest",
            f"a search over switched velocities from {STARTS} beginnings ends at {best:.6f} of its sum at best; that "
            f"none reaches more than {ceiling:.3g} of it is certain",
            best < 1.0 + 1e-6,
        ),
    ]


def _stopped_facts(bench: Bench, second: Input) -> list[Statement]:
    t_s = bench.timing.sample_time
    stop = round(SWITCH / t_s)
    a, increments = np.abs(second.s[:, 0]), second.increments
    peak = int(np.argmax(increments))
    rest = driven(bench, np.concatenate((second.velocity, np.zeros(3 * len(second.velocity)))))
    swings = _swings(rest.s[:, 0])
    decay = [abs(later / earlier) for earlier, later in pairwise(swings)]
    decayed = float(np.mean(decay))
    expected = oscillator(bench.brake).overshoot
    return [
        (
            "5.1.1",
            "when input 2 stops at 0.2 s, a decreases rapidly",
            f"its size goes on growing for {1e3 * (peak + 1 - stop) * t_s:.0f} ms, from {a[stop - 1]:.1f} to "
            f"{a[peak]:.1f} rad, since b is not zero; else the increment could not grow either",
            bool(a[peak] <= a[stop - 1]),
        ),
        (
            "5.1.1",
            "after the stop the increment grows for a while before it decays",
            f"from {increments[stop - 1]:.4g} to {increments[peak]:.4g} at {(peak + 1) * t_s:.3f} s",
            bool(increments[peak] > increments[stop - 1]),
        ),
        (
            "5.1.1",
            "a then swings about zero, less and less",
            f"each swing is {decayed:.3f} of the one before; the closed form says {expected:.3f}",
            all(ratio < 1.0 for ratio in decay) and abs(decayed - expected) < 0.01,
        ),
        (
            "5.1.1",
            "the effect has not vanished when the 0.5 s are over",
            f"the last increment is {increments[-1]:.4g}, {100.0 * increments[-1] / increments[peak]:.2g} % of the "
            "largest",
            bool(increments[-1] > 0.01 * increments[peak]),
        ),
    ]


def response_matrix(bench: Bench) -> Floats:
    """Response of a and b to each period's velocity: the recursion is linear in it, and time-invariant.

    Returns:
        Shape (n, n, 2): [k, j] is the effect of the velocity in period j on the sample after period k.
    """
    count = bench.timing.horizon
    pulse = np.zeros(count)
    pulse[0] = 1.0
    impulse = driven(bench, pulse).s
    k, j = np.indices((count, count))
    return np.where((k >= j)[:, :, None], impulse[np.maximum(k - j, 0)], 0.0)


def _switched(quadratic: Floats, fast: float) -> list[Floats]:
    """Velocities of ± ``fast`` that no sign rule v = fast sign(Q v) improves any more.

    v^T Q v is convex, so that its maximum lies at a corner, and each step of the rule increases it.
    """
    rng = np.random.default_rng(0)
    found = []
    for _ in range(STARTS):
        v = np.where(np.cumsum(rng.standard_normal(len(quadratic))) < 0.0, -fast, fast)
        while not np.array_equal(v, improved := np.where(quadratic @ v < 0.0, -fast, fast)):
            v = improved
        found.append(v)
    return found


def _swings(a: Floats) -> list[float]:
    """The extremes of a swinging quantity."""
    turns = np.flatnonzero((a[1:-1] - a[:-2]) * (a[2:] - a[1:-1]) < 0.0) + 1
    values: list[float] = a[turns].tolist()
    return values


def _increments(s: Floats, weights: Weights) -> Floats:
    result: Floats = weights.angle * s[:, 0] ** 2 + weights.velocity * s[:, 1] ** 2
    return result


def _angle_share(driven_by: Input, weights: Weights) -> Floats:
    """Share of the angle in each increment; 0 for a sample without information."""
    angle = weights.angle * driven_by.s[:, 0] ** 2
    total = _increments(driven_by.s, weights)
    return np.divide(angle, total, out=np.zeros_like(angle), where=total > 0.0)


def _noise_factor(bench: Bench) -> float:
    weights = physical_weights(bench.noise)
    return weights.angle / weights.velocity


def _normalisation_factor(bench: Bench) -> float:
    weights = thesis_weights(bench.noise, bench.limits)
    return weights.angle / weights.velocity / _noise_factor(bench)
