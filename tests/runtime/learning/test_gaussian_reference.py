"""The Gaussian currency against its lemmas in matrices: the same numbers after each sample, from states at random.

The reference is written from G1 to G4 of ``docs/explanation/learning-shield.md``; it shares no line with the module.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emb_runtime.config.bench import load_bench
from emb_runtime.learning import gaussian
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.known import (
    ANGLE_HIGH,
    ANGLE_LOW,
    BUDGET,
    FALSIFIED,
    HEAD,
    HEARD,
    HIGH,
    LOW,
    VELOCITY_HIGH,
    VELOCITY_LOW,
)

BENCH = load_bench()
Floats = NDArray[np.float64]
UPPER = np.triu_indices(6)


class Reference:
    """The recursion in matrices; angle and velocity are unknowns 0 and 1, then k_m, k_1, T_c and f_v."""

    def __init__(self, a: Assumptions) -> None:
        self.a, self.heard = a, 0
        self.low, self.high = np.array(a.low), np.array(a.high)
        self.paid = self.logs = self.surprise = self.count = 0.0
        self.c, self.p = np.zeros(6), np.zeros((6, 6))
        self.box = np.zeros((2, 2))  # rows: angle, velocity; columns: least, greatest
        self.budget = 1.0

    def hear(self, y: float, w: float, u: float) -> None:
        a = self.a
        noise = np.array([a.angle_noise, a.velocity_noise])
        if not self.heard:
            half = np.concatenate([noise, 0.5 * (self.high - self.low)])
            self.c = np.array([y, w, *(0.5 * (self.low + self.high))])
            self.p = np.diag(half**2)
            self.paid = 2.0 + np.count_nonzero(half[2:])
        else:
            self.predict(u, a.current_error)
            for i, value, sigma in ((0, y, a.angle_sigma), (1, w, a.velocity_sigma)):
                total = self.p[i, i] + sigma**2
                nu = value - self.c[i]
                gain = self.p[:, i] / total
                self.c, self.p = self.c + gain * nu, self.p - np.outer(gain, self.p[i])
                self.logs += math.log(total / sigma**2)
                self.surprise += nu**2 / total
                self.count += 1
        self.heard += 1
        self.enclose()
        measured = np.array([y, w])
        self.box = np.stack(
            [np.maximum(self.box[:, 0], measured - noise), np.minimum(self.box[:, 1], measured + noise)], 1
        )

    @property
    def possible(self) -> bool:
        boxes = [*self.box, *zip(self.low, self.high, strict=True)]
        return self.budget > 0.0 and all(low <= high for low, high in boxes)

    def lose(self) -> None:
        self.predict(0.0, self.a.current + self.a.current_error)
        self.enclose()

    def enclose(self) -> None:
        a = self.a
        rare = math.log(2 * 2 * a.samples / a.delta)
        ratio = self.paid + 2 * math.log(2 / a.delta) + self.logs
        energy = self.paid + self.count + 2 * math.sqrt(self.count * rare) + 2 * rare - self.surprise
        self.budget = min(ratio, energy) if self.count <= 2 * a.samples else ratio
        reach = np.sqrt((1 + 1e-9) * np.maximum(self.budget, 0.0) * np.diag(self.p)) + 1e-9 * np.abs(self.c)
        self.box = np.stack([self.c - reach, self.c + reach], 1)[:2]
        self.low = np.maximum(self.low, (self.c - reach)[2:])
        self.high = np.minimum(self.high, (self.c + reach)[2:])

    def predict(self, u: float, error: float) -> None:
        f, shift, rests = self.flow(u, error) if self.a.flow else self.euler(u, error)
        self.c, self.p = np.concatenate([shift, self.c[2:]]), f @ self.p @ f.T
        for i, q in enumerate(rests):
            if q > 0.0:
                y = max(0.5 * q * math.sqrt(6 * self.p[i, i] / self.budget), q**2)
                self.p[i, i] += y
                self.paid += q**2 / y

    def halves(self) -> tuple[Floats, Floats]:
        x = np.maximum(self.box[:, 1] - self.c[:2], self.c[:2] - self.box[:, 0])
        return x, np.maximum(self.high - self.c[2:], self.c[2:] - self.low)

    def slopes(self, u: float, direction: float, touching: bool) -> Floats:
        """Derivatives of the acceleration to the unknowns at c."""
        a, (x, v, _, k1, _, fv) = self.a, self.c
        w = a.spring if touching else 0.0
        return np.array([-w * k1, -a.viscous * fv, a.motor * u, -w * x, -a.coulomb * direction, -a.viscous * v])

    def euler(self, u: float, error: float) -> tuple[Floats, Floats, tuple[float, float]]:
        a, t = self.a, self.a.sample_time
        (xl, xh), (vl, vh) = self.box
        direction, touching = float(vl > 0.0) - float(vh < 0.0), bool(xl >= 0.0)
        (hx, hv), h = self.halves()
        middle = 0.5 * a.spring * self.high[1] * xh if xl < 0.0 < xh else 0.0
        off = a.model_error + a.motor * self.high[0] * error + middle
        off += a.coulomb * self.high[2] * (direction == 0.0)
        off += a.spring * touching * h[1] * hx + a.viscous * h[3] * hv
        g = self.slopes(u, direction, touching)
        acceleration = g[2:] @ self.c[2:] - middle
        f = np.eye(6)
        f[0, 1] = t
        f[1] += t * g
        return f, np.array([self.c[0] + t * self.c[1], self.c[1] + t * acceleration]), (0.0, t * off)

    def flow(self, u: float, error: float) -> tuple[Floats, Floats, tuple[float, float]]:
        a, t = self.a, self.a.sample_time
        (xl, xh), (vl, vh) = self.box
        m, w, d, c = self.high * [a.motor, a.spring, a.coulomb, a.viscous]
        off = a.model_error + m * error
        v0 = max(vh, -vl)
        top = (m * abs(u) + off + w * (max(xh, 0.0) + t * v0) + d + c * v0) / (1 - t * c - t**2 * w)
        x0, x1, fast = xl + t * min(vl - t * top, 0.0), xh + t * max(vh + t * top, 0.0), v0 + t * top
        weak, strong = sorted((a.motor * self.low[0] * u, m * u))
        against = d + c * fast + off
        direction = 0.0
        if vl > 0.0 and vl + t * min(weak - w * max(x1, 0.0) - against, 0.0) > 0.0:
            direction = 1.0
        if vh < 0.0 and vh + t * max(strong - a.spring * self.low[1] * max(x0, 0.0) + against, 0.0) < 0.0:
            direction = -1.0
        touching, middle = bool(x0 >= 0.0), 0.5 * w * x1 if x0 < 0.0 < x1 else 0.0
        off += middle + d * (direction == 0.0)
        (hx, hv), h = self.halves()
        spring = a.spring * touching
        g = self.slopes(u, direction, touching)
        acc = g[2:] @ self.c[2:] - middle
        c2, c4, v = self.c[3], self.c[5], self.c[1]
        jerk = -spring * c2 * v - a.viscous * c4 * acc
        g1 = -a.viscous * c4 * g
        g1[1] -= spring * c2
        g1[3] -= spring * v
        g1[5] -= a.viscous * acc
        r0 = spring * h[1] * hx + a.viscous * h[3] * hv
        change = np.abs(g) @ np.concatenate([[hx, hv], h]) + r0
        r1 = spring * h[1] * hv + a.viscous * h[3] * change + a.viscous * abs(c4) * r0
        snap = w * top + c * (w * fast + c * top)
        f = np.eye(6)
        f[0] += t**2 / 2 * g + t**3 / 6 * g1
        f[0, 1] += t
        f[1] += t * g + t**2 / 2 * g1
        shift = np.array([self.c[0] + t * v + t**2 / 2 * acc + t**3 / 6 * jerk, v + t * acc + t**2 / 2 * jerk])
        rests = (
            t**2 / 2 * (off + r0) + t**3 / 6 * r1 + t**4 / 24 * snap,
            t * (off + r0) + t**2 / 2 * r1 + t**3 / 6 * snap,
        )
        return f, shift, rests


def same(state: list[float], r: Reference) -> None:
    where = (ANGLE_LOW, ANGLE_HIGH, VELOCITY_LOW, VELOCITY_HIGH)
    assert [state[i] for i in where] == pytest.approx(list(r.box.ravel()), rel=1e-9, abs=1e-10)
    assert state[LOW : LOW + 4] == pytest.approx(list(r.low), rel=1e-9)
    assert state[HIGH : HIGH + 4] == pytest.approx(list(r.high), rel=1e-9)
    assert state[gaussian.CENTRE : gaussian.CENTRE + 6] == pytest.approx(list(r.c), rel=1e-9, abs=1e-10)
    size = np.sqrt(np.outer(np.diag(r.p), np.diag(r.p)))[UPPER] + 1e-300
    packed = np.array(state[gaussian.MATRIX : gaussian.MATRIX + 21])
    assert packed / size == pytest.approx(r.p[UPPER] / size, abs=1e-7)
    sums = [state[i] for i in (gaussian.PAID, gaussian.LOGS, gaussian.SURPRISE, gaussian.MEASURED, BUDGET, HEARD)]
    assert sums == pytest.approx([r.paid, r.logs, r.surprise, r.count, r.budget, r.heard], rel=1e-7, abs=1e-9)
    assert state[FALSIFIED] == 0.0


def motions(dice: np.random.Generator) -> Iterator[tuple[float, float, float]]:
    """True angle, velocity and current, sample by sample: to and fro, slow and fast, on either side of contact."""
    x, v = dice.uniform(-5.0, 60.0), dice.uniform(-400.0, 400.0)
    if dice.random() < 0.3:
        x, v = dice.uniform(-0.2, 0.2), dice.uniform(-30.0, 30.0)
    b = BENCH.brake
    while True:
        u = dice.uniform(-6.0, 6.0)
        yield x, v, u
        v += 1e-3 * (b.k_m * u - b.gamma * b.k_1 * max(x, 0.0) - math.copysign(b.T_c, v) - b.f_v * v) / b.J
        x += 1e-3 * v


@pytest.mark.parametrize("flow", [True, False])
@pytest.mark.parametrize("seed", range(30))
def test_each_number_is_that_of_the_lemmas(flow: bool, seed: int) -> None:
    dice = np.random.default_rng(seed)
    bench = BENCH if seed % 3 else replace(BENCH, shield=replace(BENCH.shield, ranges="viscous"))
    a: Any = make_assumptions(bench)._replace(
        flow=flow, model_error=float(dice.choice([0.0, 40.0])), current_error=float(dice.choice([0.0, 0.02]))
    )
    if seed % 7 == 6:
        a = a._replace(samples=5)  # the run is longer than its energy was summed over
    state, reference = gaussian.start(a), Reference(a)
    before = 0.0
    for n, (x, v, u) in zip(range(14), motions(dice), strict=False):
        if n and dice.random() < 0.12:
            gaussian.lose(a, state)
            reference.lose()
        else:
            sample = (x + 1e-3 * dice.normal(), v + dice.normal(), before)
            gaussian.hear(a, state, *sample)
            reference.hear(*sample)
        assert bool(state[FALSIFIED]) == (not reference.possible)
        if not reference.possible:
            break
        same(state, reference)
        before = u


def placed(a: Assumptions, dice: np.random.Generator, box: Floats) -> tuple[list[float], Reference]:
    """A state in the middle of a run, at random but for the box of angle and velocity, and the reference in it."""
    state, r = gaussian.start(a), Reference(a)
    r.heard, r.budget, r.box = 5, float(dice.uniform(60.0, 400.0)), box
    r.low, r.high = r.low + 0.4 * dice.random(4), r.high - 0.4 * dice.random(4)
    r.c = np.concatenate([box.mean(1) + 0.5 * np.ptp(box, 1) * dice.uniform(-1.5, 1.5, 2), dice.uniform(r.low, r.high)])
    root = np.array([1e-3, 1.0, 0.1, 0.1, 0.1, 0.1])[:, None] * dice.normal(size=(6, 6))
    r.p = root @ root.T
    r.paid, r.logs, r.surprise, r.count = 8.0, 30.0, 12.0, 12.0
    state[HEARD], state[BUDGET] = 5.0, r.budget
    state[ANGLE_LOW], state[ANGLE_HIGH], state[VELOCITY_LOW], state[VELOCITY_HIGH] = (float(b) for b in r.box.ravel())
    state[LOW : LOW + 4], state[HIGH : HIGH + 4] = list(map(float, r.low)), list(map(float, r.high))
    state[gaussian.CENTRE : gaussian.CENTRE + 6] = list(map(float, r.c))
    state[gaussian.MATRIX : gaussian.MATRIX + 21] = list(map(float, r.p[UPPER]))
    for i, value in ((gaussian.PAID, 8.0), (gaussian.LOGS, 30.0), (gaussian.SURPRISE, 12.0), (gaussian.MEASURED, 12.0)):
        state[i] = value
    return state, r


@pytest.mark.parametrize("flow", [True, False])
@pytest.mark.parametrize("seed", range(40))
def test_a_step_is_that_of_the_lemmas_from_a_state_that_many_samples_would_lead_to(flow: bool, seed: int) -> None:
    """Boxes and centres at random, where all directions, contacts and half widths come up."""
    dice = np.random.default_rng(1000 + seed)
    a = make_assumptions(BENCH)._replace(flow=flow, model_error=3.0)
    at = np.array(
        [dice.choice([0.0, 1.0]) * dice.uniform(-9.0, 99.0), dice.choice([0.0, 0.01, 1.0]) * dice.normal() * 200]
    )
    half = np.array([0.006, 6.0]) * dice.random(2)
    state, r = placed(a, dice, np.stack([at - half, at + half], 1))
    if seed % 4 == 0:
        gaussian.lose(a, state)
        r.lose()
    else:
        u = float(dice.uniform(-6.0, 6.0))
        r.predict(u, a.current_error)
        gaussian._predict(a, state, u, a.current_error)
        r.enclose()
        gaussian._enclose(a, state)
    same(state, r)


CORNERS = {
    "angle": [
        (-9.0, -8.99),
        (-0.01, 0.0),
        (-0.0005, 0.01),
        (-0.005, 0.005),
        (0.0, 0.01),
        (0.0004, 0.01),
        (50.0, 50.01),
    ],
    "velocity": [(-205.0, -200.0), (-3.2, -0.5), (-3.0, 0.0), (-1.0, 1.0), (0.0, 3.0), (0.5, 3.2), (200.0, 205.0)],
}
"""Boxes that end where a brake touches, or stands still."""


@pytest.mark.parametrize("flow", [True, False])
@pytest.mark.parametrize("angle", CORNERS["angle"])
@pytest.mark.parametrize("velocity", CORNERS["velocity"])
def test_a_prediction_is_that_of_the_lemmas_in_every_corner(
    flow: bool, angle: tuple[float, float], velocity: tuple[float, float]
) -> None:
    """The centre is anywhere, also where no brake is: the recursion does not know the boxes."""
    dice = np.random.default_rng(7)
    a = make_assumptions(BENCH)._replace(flow=flow, model_error=3.0)
    for _ in range(8):
        state, r = placed(a, dice, np.array([angle, velocity]))
        r.c[2:] = dice.uniform(-1.0, 2.0, 4)
        state[gaussian.CENTRE : gaussian.CENTRE + 6] = list(map(float, r.c))
        u = float(dice.uniform(-6.0, 6.0))
        step = (gaussian._flow if flow else gaussian._euler)(a, state, u, a.current_error)
        f, shift, rests = r.flow(u, a.current_error) if flow else r.euler(u, a.current_error)
        assert (step.angle, step.velocity) == pytest.approx(tuple(shift), rel=1e-10, abs=1e-12)
        assert step.by_angle == pytest.approx(tuple(f[0]), rel=1e-9, abs=1e-12)
        assert step.by_velocity == pytest.approx(tuple(f[1]), rel=1e-9, abs=1e-12)
        assert (step.angle_rest, step.velocity_rest) == pytest.approx(rests, rel=1e-9)


def direction(a: Assumptions, state: list[float], vl: float, vh: float, acting: tuple[float, ...]) -> float:
    """The certain direction of a box of velocities; what acts as for the function."""
    state[VELOCITY_LOW], state[VELOCITY_HIGH] = vl, vh
    u, off, lowest, highest, fastest = acting
    return gaussian._direction(a, state, u, off, lowest, highest, fastest)


def test_a_direction_is_certain_as_long_as_no_brake_of_the_box_can_be_stopped_within_the_period() -> None:
    """The slowest of all: over the corners of the box and of what may act; a hair on either side of it."""
    dice, a, seen = np.random.default_rng(3), make_assumptions(BENCH), set()
    t = a.sample_time
    for _ in range(200):
        state = gaussian.start(a)
        state[LOW : LOW + 4] = dice.uniform(0.3, 1.0, 4).tolist()
        state[HIGH : HIGH + 4] = dice.uniform(1.0, 2.0, 4).tolist()
        u, off, fastest = (float(dice.uniform(*ends)) for ends in ((-6.0, 6.0), (0.0, 500.0), (0.0, 400.0)))
        lowest, highest = (dice.choice([-20.0, 0.0, 40.0]) + [-0.9, 0.9] * dice.random(2)).tolist()
        drives = [
            a.motor * k_m * u - a.spring * k_1 * max(x, 0.0)
            for k_m in (state[LOW], state[HIGH])
            for k_1 in (state[LOW + 1], state[HIGH + 1])
            for x in (lowest, highest)
        ]
        against = a.coulomb * state[HIGH + 2] + a.viscous * state[HIGH + 3] * fastest + off
        slowing_up, slowing_down = min(drives) - against, max(drives) + against
        acting = u, off, lowest, highest, fastest
        least = max(-t * slowing_up, 0.0)
        assert direction(a, state, least + 1e-6, least + 9.0, acting) == 1.0
        assert direction(a, state, least - 1e-6 if least else 0.0, least + 9.0, acting) == 0.0
        assert direction(a, state, -0.5, 9.0, acting) == 0.0
        most = min(-t * slowing_down, 0.0)
        assert direction(a, state, most - 9.0, most - 1e-6, acting) == -1.0
        assert direction(a, state, most - 9.0, most + 1e-6 if most else 0.0, acting) == 0.0
        assert direction(a, state, -9.0, 0.5, acting) == 0.0
        seen |= {(slowing_up > 0.0, slowing_down < 0.0)}
    assert seen == {(False, False), (True, False), (False, True)}


def test_a_brake_that_may_be_stopped_just_at_the_end_of_the_period_has_no_certain_direction() -> None:
    """In binary numbers: 2048 − 512 − 5184 rad/s² for 2⁻¹⁰ s take 3.5625 rad/s, 5184 − 2048 − 64 take 3 rad/s."""
    a = make_assumptions(BENCH)._replace(sample_time=2.0**-10, motor=4096.0, spring=128.0, coulomb=2048.0, viscous=4.0)
    state = gaussian.start(a)
    state[LOW : LOW + 4], state[HIGH : HIGH + 4] = [0.5] * 4, [2.0] * 4
    for vl, vh, current, lowest, expected in (
        (3.5625, 9.0, 1.0, -1.0, 0.0),
        (math.nextafter(3.5625, 9.0), 9.0, 1.0, -1.0, 1.0),
        (-9.0, -3.0, -1.0, 1.0, 0.0),
        (-9.0, math.nextafter(-3.0, -9.0), -1.0, 1.0, -1.0),
    ):
        assert direction(a, state, vl, vh, (current, 64.0, lowest, 2.0, 128.0)) == expected


@pytest.mark.parametrize(("correct", "i"), [(gaussian._correct_angle, 0), (gaussian._correct_velocity, 1)])
def test_the_row_of_what_is_measured_keeps_its_digits_where_it_shrinks_by_twenty_orders(correct: Any, i: int) -> None:
    dice, state = np.random.default_rng(0), [0.0] * gaussian.STATE
    p = np.diag([1e10, 1e10, 1.0, 1.0, 1.0, 1.0])
    p[i, 1 - i :] = p[1 - i :, i] = dice.uniform(1.0, 2.0, 5 + i)
    p[i, i] = 1e10
    state[gaussian.MATRIX : gaussian.MATRIX + 21] = list(map(float, p[UPPER]))
    correct(state, 0.0, 1e-10)
    after = np.zeros((6, 6))
    after[UPPER] = state[gaussian.MATRIX : gaussian.MATRIX + 21]
    assert (after + np.triu(after, 1).T)[i] == pytest.approx(p[i] * 1e-20, rel=1e-9, abs=0.0)


@pytest.mark.parametrize(("correct", "diagonal"), [(gaussian._correct_angle, 0), (gaussian._correct_velocity, 6)])
def test_a_variance_that_rounding_has_made_negative_counts_as_none(correct: Any, diagonal: int) -> None:
    state = [0.0] * gaussian.STATE
    state[gaussian.MATRIX + diagonal] = -5.0
    correct(state, 3.0, 0.5)
    assert state[gaussian.LOGS] == 0.0
    assert state[gaussian.SURPRISE] == 18.0


def test_possible_is_what_has_a_budget_and_no_empty_box_and_nan_is_neither() -> None:
    def state(**numbers: float) -> list[float]:
        made = gaussian.start(make_assumptions(BENCH))
        for name, index in PLACES.items():
            made[index] = numbers.get(name, 1.0)
        return made

    assert gaussian._possible(state())  # boxes of one point each
    assert gaussian._possible(state(budget=1e-300))
    for budget in (0.0, -0.5, math.nan):
        assert not gaussian._possible(state(budget=budget))
    for name in PLACES:
        assert not gaussian._possible(state(**{name: math.nan}))
        if name != "budget":
            assert not gaussian._possible(state(**{name: 1.001 if name.endswith("low") else 0.999}))


PLACES = {"budget": BUDGET, "angle low": ANGLE_LOW, "angle high": ANGLE_HIGH}
PLACES |= {"velocity low": VELOCITY_LOW, "velocity high": VELOCITY_HIGH}
PLACES |= {f"{i} low": LOW + i for i in range(4)} | {f"{i} high": HIGH + i for i in range(4)}


def test_the_energy_counts_up_to_two_measurements_of_each_sample() -> None:
    a = make_assumptions(BENCH)
    state = gaussian.start(a)
    state[gaussian.PAID], state[gaussian.LOGS], state[gaussian.SURPRISE] = 6.0, 1e6, 30.0
    ratio = 6.0 + 2.0 * math.log(2.0 / a.delta) + 1e6
    for measured in (0.0, 40.0, 1002.0):
        state[gaussian.MEASURED] = measured
        rare = math.log(4.0 * 501.0 / a.delta)
        energy = 6.0 + measured + 2.0 * math.sqrt(measured * rare) + 2.0 * rare - 30.0
        assert gaussian.budget(a, state) == pytest.approx(energy, rel=1e-12)
    state[gaussian.MEASURED] = 1003.0
    assert gaussian.budget(a, state) == pytest.approx(ratio, rel=1e-12)


def test_a_state_has_no_number_that_is_not_used() -> None:
    a = make_assumptions(BENCH)
    state = gaussian.start(a)
    assert set(state[HEAD:]) == {0.0}
    gaussian.hear(a, state, 10.0, 100.0, 0.0)
    gaussian.hear(a, state, 10.1, 101.0, 3.0)
    assert 0.0 not in state[HEAD:]


def test_a_lost_period_before_the_first_sample_or_after_a_contradiction_changes_nothing() -> None:
    a = make_assumptions(BENCH)
    state = gaussian.start(a)
    gaussian.lose(a, state)
    assert state == gaussian.start(a)
    gaussian.hear(a, state, 0.0, 0.0, 0.0)
    gaussian.hear(a, state, 5.0, 0.0, 0.0)
    before = list(state)
    gaussian.lose(a, state)
    assert state == before


@pytest.mark.parametrize(
    "bad", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf), (1e308, 1e308, 0.0), (1e308, 0.0, 1e308)]
)
def test_a_sample_that_is_no_number_is_a_lost_one(bad: tuple[float, float, float]) -> None:
    a = make_assumptions(BENCH)
    one, two = gaussian.start(a), gaussian.start(a)
    for state in (one, two):
        gaussian.hear(a, state, 0.0, 0.0, 0.0)
    gaussian.hear(a, one, *bad)
    gaussian.lose(a, two)
    assert one == two


def test_sensors_that_jump_are_found_out() -> None:
    a = make_assumptions(BENCH)
    state = gaussian.start(a)
    for _ in range(5):
        gaussian.hear(a, state, 0.0, 0.0, 0.0)
    for angle in (0.5, 0.7):
        gaussian.hear(a, state, angle, 3.0, 0.0)
        assert (state[HEARD], state[FALSIFIED]) == (0.0, 1.0)
        assert state[ANGLE_LOW : ANGLE_HIGH + 1] == pytest.approx([angle - 0.006, angle + 0.006])
        assert state[VELOCITY_LOW : VELOCITY_HIGH + 1] == pytest.approx([-3.0, 9.0])
        if angle == 0.5:
            learnt = state[HEAD:]
    assert state[HEAD:] == learnt  # nothing more


def test_a_matrix_that_rounding_has_spoilt_is_not_believed() -> None:
    a = make_assumptions(BENCH)
    for diagonal in np.flatnonzero(UPPER[0] == UPPER[1]).tolist():
        state = gaussian.start(a)
        for _ in range(3):
            gaussian.hear(a, state, 0.0, 0.0, 0.0)
        state[gaussian.MATRIX + diagonal] = -1e3
        gaussian.hear(a, state, 0.0, 0.0, 0.0)
        assert state[FALSIFIED] == 1.0, diagonal
