"""The bounded currency against its lemmas in matrices: the same numbers after each sample, from runs at random.

The reference is written from B1 to B5 of ``docs/explanation/learning-shield.md``: boxes are cut by trying all corners,
sums over a window are taken anew each time, and the ρ of least volume is a root of its polynomial.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from emb_runtime.config.bench import load_bench
from emb_runtime.learning import bounded
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.known import ANGLE_LOW, BUDGET, FALSIFIED, HEARD, HIGH, LOW, VELOCITY_LOW

BENCH = load_bench()
Floats = NDArray[np.float64]
UPPER = np.triu_indices(4)
LIMITS = {"longest": 127, "short": 8, "long": 20}
"""Periods of a segment that are kept, and of the windows that the velocity is taken from in turns."""


class Impossible(Exception):  # noqa: N818 - it is no error: the samples contradict the assumptions
    """Nothing is left."""


class Reference:
    """What remains possible; parameters are k_m, k_1, T_c and f_v."""

    def __init__(self, a: Assumptions) -> None:
        self.a, self.heard = a, 0
        self.low, self.high = np.array(a.low), np.array(a.high)
        half = 0.5 * (self.high - self.low)
        self.n = int(np.count_nonzero(half))
        self.c, self.p = self.low + half, self.n * np.diag(half**2) * (1.0 + 1e-9)
        self.box = np.zeros((2, 2))  # rows: angle, velocity; columns: least, greatest
        self.scale = np.array([a.motor, a.spring, a.coulomb, a.viscous])
        self.follows = False
        self.direction = 0.0
        self.peak = 0.0
        self.samples: list[tuple[float, float, float]] = []  # of the unbroken record: angle, velocity, current before
        self.length = 0
        self.possible = True

    def hear(self, y: float, w: float, u: float) -> None:
        try:
            toward = self.advance(u, self.a.current_error) if self.heard else 0.0
            if not self.heard:
                self.box = np.array([[-math.inf, math.inf]] * 2)
            self.heard += 1
            for i, (value, off) in enumerate(((y, self.a.angle_noise), (w, self.a.velocity_noise))):
                self.intersect(i, value - off, value + off)
            if not self.follows:
                self.samples = []
            self.samples.append((y, w, u))
            self.learn(toward)
        except Impossible:
            self.possible = False

    def lose(self) -> None:
        self.follows, self.length = False, 0
        if self.heard:
            self.advance(0.0, self.a.current + self.a.current_error)

    def intersect(self, i: int, low: float, high: float) -> None:
        self.box[i] = max(self.box[i, 0], low - 1e-9), min(self.box[i, 1], high + 1e-9)
        if self.box[i, 0] > self.box[i, 1]:
            raise Impossible

    def advance(self, u: float, error: float) -> float:
        """B5: the extremes over all corners of brakes, states and currents; B1: the certain direction."""
        a, t = self.a, self.a.sample_time
        (xl, xh), (vl, vh) = self.box
        corners = list(product(*zip(self.low * self.scale, self.high * self.scale, strict=True)))
        drives = [
            k_m * (u + e) - k_1 * max(x, 0.0) + d
            for k_m, k_1, _, _ in corners
            for e in (-error, error)
            for x in (xl, xh)
            for d in (-a.model_error, a.model_error)
        ]
        above, below = max(drives), min(drives)
        friction, thick = self.high[2] * a.coulomb, self.high[3] * a.viscous
        pad = 0.0
        if a.flow:
            pulled = a.spring * self.high[1] * a.speed
            peak = max(above, -below) + friction + thick * a.speed + t * pulled
            self.peak = max(self.peak, peak)
            pad = t**2 / 2 * (pulled + thick * peak)
        ends = [
            after
            for drive in (below, above)
            for _, _, t_c, f_v in corners
            for v in {vl, vh, *((0.0,) if vl <= 0.0 <= vh else ())}
            for after in self.after(v, drive, t_c, f_v)
        ]
        least, fastest = min(ends) - pad, max(ends) + pad
        slowest_up = vl + t * (below - friction - thick * vl) - pad
        slowest_down = vh + t * (above + friction - thick * vh) + pad
        toward = 0.0
        if vl > 0.0 and (not a.flow or slowest_up > 0.0):
            toward = 1.0
        elif vh < 0.0 and (not a.flow or slowest_down < 0.0):
            toward = -1.0
        if not a.flow:
            self.box[0] += t * self.box[1]
        elif toward:
            rest = t * pad / 6.0
            self.box[0] += [t * (vl + least) / 2 - rest, t * (vh + fastest) / 2 + rest]
        else:
            self.box[0] += [t * min(vl, least), t * max(vh, fastest)]
        self.box[1] = least, fastest
        return toward

    def after(self, v: float, drive: float, t_c: float, f_v: float) -> list[float]:
        """Velocities one period on, for a brake that may stick where it would be turned around by friction."""
        t = self.a.sample_time
        if v == 0.0:
            return [t * (drive - t_c), t * (drive + t_c), 0.0]
        moved = v + t * (drive - math.copysign(t_c, v) - f_v * v)
        return [moved] if moved * v > 0.0 else [moved, 0.0]

    def learn(self, toward: float) -> None:
        followed, self.follows = self.follows, True
        if not toward or not followed:
            self.length, self.peak = 0, 0.0
            return
        if toward != self.direction:
            self.direction, self.length = toward, 0
        self.length = min(self.length + 1, LIMITS["longest"])
        n = self.length
        if n < 4:
            self.take(*self.rise(n))
        if n >= 2:
            self.take(*self.bend(n // 2))
        if n > 8:
            self.take(*self.bend(n // (3, 4, 6)[n % 3]))
        self.bound_velocity(min(n, LIMITS["short"] if n % 2 else LIMITS["long"]))

    def record(self, n: int) -> tuple[Floats, Floats, Floats]:
        """Angles, R and its integral of the last n periods, from 0 at the first of them (B2)."""
        t, last = self.a.sample_time, np.array(self.samples[-n - 1 :])
        x, u = last[:, 0], last[1:, 2]
        plus = np.maximum(x, 0.0)
        zero = np.zeros(1)
        q = np.concatenate([zero, np.cumsum(t * u)])
        if self.a.flow:
            s = np.concatenate([zero, np.cumsum(t / 2 * (plus[1:] + plus[:-1]))])
            sum_q = np.concatenate([zero, np.cumsum(t * q[:-1] + t**2 / 2 * u)])
            sum_s = np.concatenate([zero, np.cumsum(t / 2 * (s[1:] + s[:-1]))])
            sum_x = np.concatenate([zero, np.cumsum(t / 2 * (x[1:] + x[:-1]))])
            time = t * np.arange(n + 1)
            sum_time = time**2 / 2
        else:
            s = np.concatenate([zero, np.cumsum(t * plus[:-1])])
            sum_q, sum_s, sum_x = (np.concatenate([zero, np.cumsum(t * z[:-1])]) for z in (q, s, x))
            time = t * np.arange(n + 1)
            sum_time = np.concatenate([zero, np.cumsum(t * time[:-1])])
        signs = self.scale * [1.0, -1.0, -self.direction, -1.0]
        return x, signs * np.stack([q, s, time, x], 1), signs * np.stack([sum_q, sum_s, sum_time, sum_x], 1)

    def summed(self, n: int) -> float:
        """What is summed up over n periods (B3)."""
        a = self.a
        pulled = a.angle_noise * a.spring * self.high[1]
        return n * a.sample_time * float(pulled + a.model_error + a.motor * self.high[0] * a.current_error)

    def mean_pad(self) -> float:
        return 2.0 * self.a.angle_noise * self.a.viscous * float(self.high[3])

    def squeezed(self, n: int) -> float:
        """Trapezoids of x⁺ along the flow, and once where it is crossed."""
        a, t = self.a, self.a.sample_time
        return a.spring * float(self.high[1]) * (n * t**3 / 12 * self.peak + t**2 / 8 * a.speed) if a.flow else 0.0

    def mean_trapezoids(self) -> float:
        """Of one mean of ∫x⁺, and of x."""
        a, t = self.a, self.a.sample_time
        both = a.spring * self.high[1] * a.speed + a.viscous * self.high[3] * self.peak
        return t**2 / 12 * float(both) if a.flow else 0.0

    def rise(self, n: int) -> tuple[Floats, float, float]:
        _, r, _ = self.record(n)
        w = [sample[1] for sample in self.samples]
        pad = 2.0 * self.a.velocity_noise + self.mean_pad() + self.summed(n) + self.squeezed(n)
        return r[-1] - r[0], w[-1] - w[-1 - n], pad

    def bend(self, n: int) -> tuple[Floats, float, float]:
        nt = n * self.a.sample_time
        x, _, sums = self.record(2 * n)
        phi = (sums[-1] - 2.0 * sums[n] + sums[0]) / nt
        pad = 4.0 * self.a.angle_noise / nt + self.mean_pad() + self.summed(n)
        return phi, float(x[-1] - 2.0 * x[n] + x[0]) / nt, pad + self.squeezed(n) + 2.0 * self.mean_trapezoids()

    def bound_velocity(self, n: int) -> None:
        nt = n * self.a.sample_time
        x, r, sums = self.record(n)
        phi = r[-1] - sums[-1] / nt
        before = 0.5 * n if self.a.flow else 0.5 * (n + 1)
        pad = 2.0 * self.a.angle_noise / nt + self.mean_pad() + self.summed(1) * before
        pad += self.squeezed(n) + self.mean_trapezoids()
        middle = (x[-1] - x[0]) / nt + float(phi @ self.c)
        pad += math.sqrt(max(float(phi @ self.p @ phi), 0.0))
        self.intersect(1, middle - pad, middle + pad)

    def take(self, phi: Floats, value: float, pad: float) -> None:
        self.cut_box(phi, value - pad, value + pad)
        self.cut_ellipsoid(phi, value - pad, value + pad)

    def cut_box(self, phi: Floats, low: float, high: float) -> None:
        ends = np.stack([self.low, self.high], 1)
        corners = np.array(list(product(*ends))) * phi
        if corners.sum(1).max() < low or corners.sum(1).min() > high:
            raise Impossible
        for i in range(4):
            others = np.delete(corners, i, 1).sum(1)
            if phi[i] == 0.0:
                continue
            bounds = sorted([(low - others.max()) / phi[i], (high - others.min()) / phi[i]])
            self.low[i] = max(self.low[i], bounds[0] - 1e-9)
            self.high[i] = min(self.high[i], bounds[1] + 1e-9)

    def cut_ellipsoid(self, phi: Floats, low: float, high: float) -> None:
        square = float(phi @ self.p @ phi)
        if square <= 0.0:
            return
        reach, centre = math.sqrt(square), float(phi @ self.c)
        lowest, highest = max((low - centre) / reach, -1.0), min((high - centre) / reach, 1.0)
        if lowest > highest + 1e-9:
            raise Impossible
        nu, half, n = (lowest + highest) / 2, max(highest - lowest, 0.0) / 2, self.n
        slope = np.polynomial.Polynomial([-(n - 1) * half**2, 1 - half**2 - nu**2, (n + 1) * nu**2])  # of the volume
        if slope(1.0) <= 0.0:
            return
        left = 1e-4 if slope(1e-4) >= 0.0 else float(brentq(slope, 1e-4, 1.0, xtol=1e-16, rtol=1e-14))
        rho = square * left / (1.0 - left)
        miss, wide = nu * reach, half * reach
        scale = (1.0 + wide**2 / rho - miss**2 / (square + rho)) * (1.0 + 1e-9)
        if scale <= 0.0:
            raise Impossible
        turned = self.p @ phi
        self.c = self.c + turned * miss / (square + rho)
        self.p = scale * (self.p - np.outer(turned, turned) / (square + rho))
        out = np.sqrt(np.maximum(np.diag(self.p), 0.0)) + 1e-9
        self.low, self.high = np.maximum(self.low, self.c - out), np.minimum(self.high, self.c + out)
        if (self.low > self.high).any():
            raise Impossible


def same(state: list[float], r: Reference) -> None:
    found = [state[ANGLE_LOW : ANGLE_LOW + 2], state[VELOCITY_LOW : VELOCITY_LOW + 2]]
    assert np.array(found) == pytest.approx(r.box, rel=1e-8, abs=1e-10)
    assert state[LOW : LOW + 4] == pytest.approx(list(r.low), rel=3e-8, abs=0.0)
    assert state[HIGH : HIGH + 4] == pytest.approx(list(r.high), rel=3e-8, abs=0.0)
    assert state[bounded.CENTRE : bounded.CENTRE + 4] == pytest.approx(list(r.c), rel=3e-8, abs=0.0)
    size = np.sqrt(np.outer(np.diag(r.p), np.diag(r.p)))[UPPER] + 1e-300
    assert np.array(state[bounded.SHAPE : bounded.SHAPE + 10]) / size == pytest.approx(r.p[UPPER] / size, abs=1e-6)
    assert (state[HEARD], state[FALSIFIED], state[BUDGET]) == (r.heard, 0.0, 1.0)


def motion(a: Assumptions, dice: np.random.Generator) -> Iterator[tuple[float, float, float]]:
    """True angle, velocity and the current before: to and fro, slow and fast, on either side of contact."""
    x, v = (dice.uniform(-8.0, 60.0), dice.uniform(-400.0, 400.0))
    if dice.random() < 0.3:
        x, v = dice.uniform(-0.2, 0.2), dice.uniform(-30.0, 30.0)
    b, before, u = BENCH.brake, 0.0, 0.0
    pieces = 50 if a.flow else 1
    for k in range(10_000):
        yield x, v, before
        if k % 12 == 0:
            u = float(dice.uniform(-6.0, 6.0))
        if abs(v) > 440.0:
            u = -math.copysign(6.0, v)
        for _ in range(pieces):
            h = a.sample_time / pieces
            force = b.k_m * u - b.gamma * b.k_1 * max(x, 0.0) - math.copysign(b.T_c, v) - b.f_v * v
            x, v = x + h * v, v + h * force / b.J
        before = u


@pytest.mark.parametrize("flow", [True, False])
@pytest.mark.parametrize("seed", range(14))
def test_each_number_is_that_of_the_lemmas(flow: bool, seed: int) -> None:
    dice = np.random.default_rng(seed)
    bench = BENCH if seed % 4 else replace(BENCH, shield=replace(BENCH.shield, ranges="viscous"))
    shrunk = (1.0, 0.01)[seed % 2]  # with better sensors the pads of the flow count
    a: Any = make_assumptions(bench)
    a = a._replace(
        flow=flow,
        model_error=(0.0, 40.0)[seed % 3 == 1],
        current_error=(0.0, 0.02)[seed % 3 == 2],
        angle_noise=a.angle_noise * shrunk,
        velocity_noise=a.velocity_noise * shrunk,
    )
    state, reference = bounded.start(a), Reference(a)
    same(state, reference)
    rare = 0.02 if seed % 5 else 0.0
    for n, (x, v, before) in zip(range(150 if seed % 6 == 0 else 40), motion(a, dice), strict=False):
        if n and dice.random() < rare:
            bounded.lose(a, state)
            reference.lose()
        else:
            sample = (x + a.angle_noise * dice.uniform(-1, 1), v + a.velocity_noise * dice.uniform(-1, 1), before)
            bounded.hear(a, state, *sample)
            reference.hear(*sample)
        assert bool(state[FALSIFIED]) == (not reference.possible)
        if not reference.possible:
            break
        same(state, reference)
