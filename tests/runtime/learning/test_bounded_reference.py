"""What is learnt against its lemmas in matrices: the same numbers after each sample, from runs at random.

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
from emb_runtime.learning.known import ANGLE_LOW, FALSIFIED, HEAD, HEARD, HIGH, LOW, VELOCITY_LOW, known

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
            return [t * (drive - t_c), t * (drive + t_c), *([0.0] if abs(drive) <= t_c else [])]
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
    assert (state[HEARD], state[FALSIFIED]) == (r.heard, 0.0)
    assert (state[bounded.FOLLOWS], state[bounded.LENGTH]) == (float(r.follows), r.length)


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
    bench = BENCH if seed % 4 else replace(BENCH, shield=BENCH.shield._replace(ranges="viscous"))
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


def assumed(flow: bool, shrunk: float = 1.0) -> Assumptions:
    a = make_assumptions(BENCH)
    return a._replace(flow=flow, angle_noise=shrunk * a.angle_noise, velocity_noise=shrunk * a.velocity_noise)


@pytest.mark.parametrize("flow", [True, False])
def test_a_motion_that_goes_on_in_one_direction_is_looked_at_as_far_as_the_record_reaches(flow: bool) -> None:
    """180 periods at about 60 rad/s; at its end the state has no number that is not used."""
    a, b = assumed(flow), BENCH.brake
    state, reference, dice = bounded.start(a), Reference(a), np.random.default_rng(0)
    x, v, before = 2.0, 60.0, 0.0
    for k in range(180):
        sample = (x + a.angle_noise * dice.uniform(-1, 1), v + a.velocity_noise * dice.uniform(-1, 1), before)
        bounded.hear(a, state, *sample)
        reference.hear(*sample)
        assert reference.possible
        same(state, reference)
        before = (b.gamma * b.k_1 * max(x, 0.0) + b.T_c + b.f_v * v) / b.k_m + 0.5 * math.sin(k)
        for _ in range(20 if flow else 1):
            h = a.sample_time / (20 if flow else 1)
            force = b.k_m * before - b.gamma * b.k_1 * max(x, 0.0) - b.T_c - b.f_v * v
            x, v = x + h * v, v + h * force / b.J
    assert reference.length == 127
    unused = {bounded.PEAK - HEAD} if not flow else set()
    assert {i for i, number in enumerate(state[HEAD:]) if number == 0.0} == unused


CORNERS = {
    "angle": [(-9.0, -8.99), (-0.01, 0.0), (-0.005, 0.005), (0.0, 0.01), (50.0, 50.01)],
    "velocity": [(-205.0, -200.0), (-3.2, -0.5), (-3.0, 0.0), (0.0, 0.0), (-1.0, 1.0), (0.0, 3.0), (200.0, 205.0)],
}
"""Boxes that end where a brake touches, or stands still."""


def placed(a: Assumptions, angle: tuple[float, float], velocity: tuple[float, float]) -> tuple[list[float], Reference]:
    state, r = bounded.start(a), Reference(a)
    r.box = np.array([angle, velocity])
    state[ANGLE_LOW : ANGLE_LOW + 2], state[VELOCITY_LOW : VELOCITY_LOW + 2] = list(angle), list(velocity)
    return state, r


@pytest.mark.parametrize("flow", [True, False])
def test_a_period_leads_to_the_extremes_over_all_brakes_in_every_corner(flow: bool) -> None:
    for angle, velocity, u in product(CORNERS["angle"], CORNERS["velocity"], (-6.0, -1.0, 0.0, 1.0, 6.0)):
        a = assumed(flow)._replace(model_error=3.0)
        state, r = placed(a, angle, velocity)
        assert bounded._advance(a, state, u, 0.02) == r.advance(u, 0.02)
        assert state[ANGLE_LOW : ANGLE_LOW + 2] == pytest.approx(list(r.box[0]), rel=1e-12, abs=1e-15)
        assert state[VELOCITY_LOW : VELOCITY_LOW + 2] == pytest.approx(list(r.box[1]), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("angle", CORNERS["angle"])
def test_along_the_flow_a_direction_is_certain_if_no_brake_can_be_stopped_within_the_period(
    angle: tuple[float, float],
) -> None:
    """From the speed on that the strongest friction, the model's error and the pad take; a hair on either side."""
    a = assumed(True)._replace(model_error=3.0)
    t, thick = a.sample_time, a.viscous * a.high[3]
    friction, pulled = a.coulomb * a.high[2], a.spring * a.high[1] * a.speed
    for u, sign in product((-5.0, -1.0, 0.0, 1.0, 5.0), (1.0, -1.0)):
        motor = [a.motor * k * u for k in (a.low[0], a.high[0])]
        above = max(motor) - a.spring * a.low[1] * max(angle[0], 0.0) + 3.0
        below = min(motor) - a.spring * a.high[1] * max(angle[1], 0.0) - 3.0
        peak = max(above, -below) + friction + thick * a.speed + t * pulled
        pad = 0.5 * t * t * (pulled + thick * peak)
        slowing = friction - below if sign > 0.0 else friction + above
        least = (pad + t * slowing) / (1.0 - t * thick)
        for speed, certain in ((least + 1e-6, least > 0.0), (least - 1e-6, False), (0.0, False), (-0.5, False)):
            ends = sorted([sign * speed, sign * (speed + 9.0)])
            state, _ = placed(a, angle, (ends[0], ends[1]))
            assert bounded._advance(a, state, u, 0.0) == (sign if certain else 0.0)


def test_a_brake_that_may_be_stopped_just_at_the_end_of_the_period_has_no_certain_direction() -> None:
    """In binary numbers, without viscous friction: 2048 to 8192 rad/s² of a motor against 4096 of friction."""
    a = assumed(True)._replace(sample_time=2.0**-10, motor=4096.0, spring=128.0, coulomb=2048.0, viscous=0.0)
    a = a._replace(low=(0.5,) * 4, high=(2.0,) * 4, speed=512.0, model_error=0.0)
    pad = 2.0**-21 * 128.0 * 2.0 * 512.0
    least = pad + 2.0**-10 * (4096.0 - 2048.0)
    for speed, certain in ((least, False), (math.nextafter(least, 9.0), True)):
        for sign in (1.0, -1.0):
            ends = sorted([sign * speed, sign * 9.0])
            state, _ = placed(a, (-9.0, -8.0), (ends[0], ends[1]))
            assert bounded._advance(a, state, sign, 0.0) == (sign if certain else 0.0)


def test_an_interval_of_one_point_is_possible_and_an_empty_one_is_not() -> None:
    state = bounded.start(assumed(True))
    state[VELOCITY_LOW] = state[VELOCITY_LOW + 1] = 1.0
    bounded._intersect(state, VELOCITY_LOW, -9.0, 9.0)
    assert (state[VELOCITY_LOW], state[VELOCITY_LOW + 1], state[FALSIFIED]) == (1.0, 1.0, 0.0)
    bounded._intersect(state, VELOCITY_LOW, 1.1, 9.0)
    assert state[FALSIFIED] == 1.0


def box_of(*ends: float) -> list[float]:
    state = bounded.start(assumed(True))
    state[LOW : LOW + 4], state[HIGH : HIGH + 4] = [ends[0]] * 4, [ends[1]] * 4
    return state


STRIPS = ((0.75, 9.0), (-9.0, 1.25), (0.75, 1.25), (0.5, 1.5), (-9.0, 9.0))


def test_a_side_of_the_box_is_cut_at_the_strip_and_a_rounding_beyond() -> None:
    for i, f, (least, most) in product(range(4), (-8.0, -0.5, 0.5, 8.0), STRIPS):
        f1, f2, f3, f4 = (f if j == i else 0.0 for j in range(4))
        state, ends = box_of(0.5, 1.5), sorted([f * least, f * most])
        bounded._cut_box(state, f1, f2, f3, f4, ends[0], ends[1])
        assert state[FALSIFIED] == 0.0
        cut = max(least - 1e-9, 0.5), min(most + 1e-9, 1.5)
        assert (state[LOW + i], state[HIGH + i]) == pytest.approx(cut, rel=0.0, abs=1e-12)
        others = [j for j in range(4) if j != i]
        assert [(state[LOW + j], state[HIGH + j]) for j in others] == [(0.5, 1.5)] * 3


@pytest.mark.parametrize(
    ("low", "high", "empty"), [(1.5, 9.0, 0.0), (1.6, 9.0, 1.0), (-9.0, 0.5, 0.0), (-9.0, 0.4, 1.0)]
)
def test_a_strip_that_misses_the_box_contradicts_and_one_that_touches_it_does_not(
    low: float, high: float, empty: float
) -> None:
    state = box_of(0.5, 1.5)
    bounded._cut_box(state, 1.0, 0.0, 0.0, 0.0, low, high)
    assert state[FALSIFIED] == empty


def ellipsoid(radius: float) -> list[float]:
    """Around 0, of a box that does not cut it."""
    state = box_of(-99.0, 99.0)
    state[bounded.CENTRE : bounded.CENTRE + 4] = [0.0] * 4
    state[bounded.SHAPE : bounded.SHAPE + 10] = [radius**2 * (i == j) for i, j in zip(*UPPER, strict=True)]
    return state


def test_a_strip_that_misses_the_ellipsoid_contradicts_and_one_within_rounding_does_not() -> None:
    for low, high, empty in (
        (1.0 + 1e-9, 9.0, 0.0),
        (1.0 + 1e-6, 9.0, 1.0),
        (-9.0, -1.0 - 1e-9, 0.0),
        (-9.0, -1.0 - 1e-6, 1.0),
    ):
        state = ellipsoid(1.0)
        bounded._cut_ellipsoid(state, 1.0, 0.0, 0.0, 0.0, low, high)
        assert state[FALSIFIED] == empty


def test_a_strip_that_leaves_the_ellipsoid_of_least_volume_as_it_is_changes_nothing() -> None:
    """Of four unknowns, ±1/2 of the reach: there the least volume is the one without the strip, and not a hair more."""
    state = ellipsoid(1.0)
    before = list(state)
    bounded._cut_ellipsoid(state, 1.0, 0.0, 0.0, 0.0, -0.5, 0.5)
    assert state == before
    bounded._cut_ellipsoid(state, 1.0, 0.0, 0.0, 0.0, -0.49, 0.49)
    assert state != before


@pytest.mark.parametrize("square", [0.0, -1e-6])
def test_an_ellipsoid_of_one_point_or_one_that_rounding_has_spoilt_is_not_cut(square: float) -> None:
    state = ellipsoid(1.0)
    state[bounded.SHAPE] = square
    before = list(state)
    bounded._cut_ellipsoid(state, 1.0, 0.0, 0.0, 0.0, 0.3, 0.4)
    assert state == before
    state[bounded.SHAPE : bounded.SHAPE + 10] = [square * (i == j) for i, j in zip(*UPPER, strict=True)]
    a = assumed(True)
    state[bounded.DIRECTION] = 1.0
    state[VELOCITY_LOW : VELOCITY_LOW + 2] = [194.0, 206.0]
    for angle in (9.8, 10.0, 10.2):
        bounded._record(a, state, angle, 200.0, 0.0)
    bounded._bound_velocity(a, state, 2)
    assert state[FALSIFIED] == 0.0


def test_a_box_that_does_not_meet_the_ellipsoid_contradicts() -> None:
    state = ellipsoid(1.0)
    state[LOW + 2], state[HIGH + 2] = 3.0, 4.0
    bounded._keep(state, 2, 0.0, 4.0)
    assert state[FALSIFIED] == 1.0


@pytest.mark.parametrize("square", [0.0, -0.5])
def test_an_ellipsoid_that_is_flat_or_less_by_rounding_leaves_its_centre_and_a_rounding(square: float) -> None:
    state = box_of(0.5, 1.5)
    bounded._keep(state, 2, 1.0, square)
    assert (state[LOW + 2], state[HIGH + 2]) == pytest.approx((1.0 - 1e-9, 1.0 + 1e-9), rel=0.0, abs=1e-12)
    assert state[FALSIFIED] == 0.0


def test_the_first_bend_is_taken_as_soon_as_there_are_two_periods() -> None:
    """With sensors without noise it tells what a rise cannot: from the third sample on, and no later."""
    a = assumed(False, 1e-7)
    state, reference, b = bounded.start(a), Reference(a), BENCH.brake
    x, v, before = 20.0, 300.0, 0.0
    for u in (5.0, -6.0, 3.0, 1.0):
        bounded.hear(a, state, x, v, before)
        reference.hear(x, v, before)
        same(state, reference)
        x, v, before = x + 1e-3 * v, v + 1e-3 * (b.k_m * u - b.gamma * b.k_1 * x - b.T_c - b.f_v * v) / b.J, u


@pytest.mark.parametrize("flow", [True, False])
def test_a_motion_that_no_brake_of_the_set_can_have_is_an_assumption_that_is_false(flow: bool) -> None:
    a = assumed(flow)
    state = bounded.start(a)
    bounded.hear(a, state, 0.0, 0.0, 0.0)
    bounded.hear(a, state, 0.0, 100.0, 0.0)
    for velocity in (100.0, 50.0):
        now = known(state)
        learnt = state[HEAD:]
        assert now.falsified
        assert (now.k_m_low, now.k_m_high) == (a.low[0], a.high[0])
        assert (now.velocity_low, now.velocity_high) == (velocity - a.velocity_noise, velocity + a.velocity_noise)
        bounded.hear(a, state, 0.0, 50.0, 0.0)
        assert state[HEAD:] == learnt  # nothing more
        bounded.lose(a, state)
        assert known(state)[:8] == now[:8]


@pytest.mark.parametrize("flow", [True, False])
def test_after_a_lost_period_any_current_may_have_acted(flow: bool) -> None:
    a = assumed(flow)
    state = bounded.start(a)
    bounded.lose(a, state)
    assert state == bounded.start(a)
    bounded.hear(a, state, 0.0, 0.0, 0.0)
    bounded.lose(a, state)
    now = known(state)
    assert now.velocity_high > 0.9 * a.sample_time * a.motor * a.current * a.high[0]
    assert now.velocity_low < -0.9 * a.sample_time * a.motor * a.current * a.high[0]


@pytest.mark.parametrize(
    "bad", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf), (1e308, 1e308, 0.0), (1e308, 0.0, 1e308)]
)
def test_a_sample_that_is_no_number_is_a_lost_one(bad: tuple[float, float, float]) -> None:
    a = assumed(True)
    heard, lost = bounded.start(a), bounded.start(a)
    for state in (heard, lost):
        bounded.hear(a, state, 0.0, 0.0, 0.0)
    bounded.hear(a, heard, *bad)
    bounded.lose(a, lost)
    assert heard == lost
