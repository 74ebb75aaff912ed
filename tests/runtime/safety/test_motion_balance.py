"""The motion balance against least squares by numpy, written from ``docs/explanation/sensor-monitor.md``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from random import Random
from typing import Any, NamedTuple

import numpy as np
import pytest

from emb_runtime.config.bench import Bench, BrakeParameters, Sensors
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety import motion_balance
from emb_runtime.safety.motion_balance import (
    COEFFICIENTS,
    REST_SAMPLES,
    BalanceModel,
    MotionBalance,
    State,
    balance_model,
    begin_balance,
    origin,
    solve,
    steady_motion,
    take,
    unexplained,
    unheld_motion,
)
from emb_runtime.safety.state_machine import Fault, StopError
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
OTHER = replace(
    BENCH,
    brake=BrakeParameters(J=5e-6, gamma=2e-5, k_m=0.03, k_1=30.0, T_c=0.012, f_v=3e-5),
    noise=replace(BENCH.noise, velocity=1.5),
    limits=replace(BENCH.limits, velocity=400.0, angle=(-8.0, 80.0)),
)
QUIET = replace(OTHER, noise=replace(BENCH.noise, velocity=0.4))
OBSERVED = replace(
    OTHER, noise=replace(BENCH.noise, angle=1.1e-3, velocity=0.1), sensors=Sensors("observer", observer_bandwidth=900.0)
)
BENCHES = {"shipped": BENCH, "other": OTHER, "quiet": QUIET, "observer": OBSERVED}
of_each_bench = pytest.mark.parametrize("bench", BENCHES.values(), ids=BENCHES)


class Row(NamedTuple):
    """What is taken in."""

    follows: bool
    angle: float
    velocity: float
    current: float


def played(bench: Bench, seed: int, samples: int, *, gain: float = 1.0, lost: float = 0.1, since: int = 0) -> list[Row]:
    """A brake of no bench under a square wave; from a sample on, or half of the time, its current acts by a gain."""
    draw, b, t = Random(seed), bench.brake, bench.timing.sample_time
    x, v, rows = 0.0, 0.0, []
    for k in range(samples + 1):
        rows.append(Row(draw.random() >= lost, x + draw.gauss(0, 1e-3), v + draw.gauss(0, bench.noise.velocity), 0.0))
        u = 6.0 if k % 97 < 50 else -6.0 + draw.uniform(0.0, 1.0)
        acts = u * (gain if k > (since or samples // 2) else 1.0)
        drive = 0.9 * b.k_m * acts - 1.1 * b.gamma * b.k_1 * max(x, 0.0) - 0.8 * b.f_v * v
        before, v = v, v + t * (drive - math.copysign(1.2 * b.T_c, v)) / b.J
        x += 0.5 * t * (before + v)
        rows[-1] = rows[-1]._replace(current=u)
    return [rows[0], *(row._replace(current=before.current) for before, row in pairwise(rows))]


class Slide(NamedTuple):
    """A period that counts: the sample at its end, whether a stretch begins, two velocities, angle and eight terms."""

    at: int
    begins: bool
    before: float
    after: float
    angle: float
    terms: list[float]


def sigma_of(bench: Bench) -> float:
    """Standard deviation of a velocity [rad/s]."""
    observed = bench.sensors.velocity == "observer"
    return math.sqrt(2.0) * bench.noise.angle / bench.timing.sample_time if observed else bench.noise.velocity


def slides_of(bench: Bench, rows: list[Row]) -> Iterator[Slide]:
    """By the page."""
    b, t, run, slid = bench.brake, bench.timing.sample_time, 0, False
    observed = bench.sensors.velocity == "observer"
    for k in range(1, len(rows)):
        run = run + 1 if rows[k].follows else 0
        x0, x1, v0, v1 = rows[k - 1].angle, rows[k].angle, rows[k - 1].velocity, rows[k].velocity
        if observed:
            v0, v1 = (x0 - rows[max(k - 2, 0)].angle) / t, (x1 - x0) / t
        slides = run >= 3 and min(abs(v0), abs(v1)) > 12.0 * sigma_of(bench) and v0 * v1 > 0.0
        if slides:
            i, i1, i2 = rows[k].current, rows[k - 1].current, rows[k - 2].current
            x, v, acts = max(x0 if observed else 0.5 * (x0 + x1), 0.0), 0.5 * (v0 + v1), i
            if observed:
                acts = 0.5 * (i + i1)
            force, s = b.gamma * b.k_1 * x, math.copysign(1.0, v)
            physical = [b.k_m * acts, -force, -b.T_c * s, -b.f_v * v, b.k_m * (i1 - i), b.k_m * (i2 - i1)]
            physical += [-force * x / bench.limits.angle[1], -force * s]
            yield Slide(k, not slid, v0, v1, x, [t / b.J * part for part in physical])
        slid = slides


class Reference:
    """The page's balance of all rows so far, by numpy."""

    def __init__(self, bench: Bench, rows: list[Row]) -> None:
        self.bench, slides = bench, list(slides_of(bench, rows))
        self.at, self.stretches = [s.at for s in slides], sum(s.begins for s in slides)
        self.x = np.array([s.terms for s in slides]).reshape(-1, 8)
        self.y = np.array([s.after - s.before for s in slides])

    def coefficients(self, count: int) -> Any:
        nominal = np.array([1.0] * 4 + [0.0] * 4)[:count]
        weight = math.sqrt(2.0) * sigma_of(self.bench)
        x = np.vstack([self.x[:, :count], weight * np.eye(count)])
        found: np.ndarray = np.linalg.lstsq(x, np.concatenate([self.y, weight * nominal]), rcond=None)[0]
        return found

    def range(self, count: int, entries: list[int]) -> float:
        left = self.y - self.x[:, :count] @ self.coefficients(count)
        sums = [0.0, *(sum(r for at, r in zip(self.at, left, strict=True) if at <= entry) for entry in entries)]
        return float(max(sums) - min(sums))

    def unexplained(self, entries: list[int]) -> float:
        return max(self.range(8, entries), self.range(7, entries) - 0.03 * self.bench.limits.velocity)

    def allowed(self) -> float:
        sigma, fastest = sigma_of(self.bench), self.bench.limits.velocity
        late = np.abs(self.coefficients(8)[4:6]).sum()
        return float(max(25.0 * sigma, 0.05 * fastest) + 0.6 * sigma * self.stretches + 0.16 * fastest * late)


def taken(bench: Bench, rows: list[Row]) -> tuple[State, list[int]]:
    """The state after all rows, and the samples with which an entry was made."""
    model, state = balance_model(bench), begin_balance(rows[0].angle, rows[0].velocity)
    entries = []
    for k, row in enumerate(rows[1:], 1):
        state = take(model, state, *row)
        entries += [k] if state.samples == 0 else []
    return state, entries


def coefficients(model: BalanceModel, state: State, count: int) -> list[float]:
    return solve(state.equations, count, model.prior)[0]


@of_each_bench
@pytest.mark.parametrize(("seed", "samples", "gain"), [(1, 17, 1.0), (2, 230, 1.0), (3, 500, 1.4), (4, 333, 0.6)])
def test_coefficients_range_and_allowance_are_those_of_the_page(
    bench: Bench, seed: int, samples: int, gain: float
) -> None:
    rows = played(bench, seed, samples, gain=gain)
    model, (state, entries) = balance_model(bench), taken(bench, rows)
    assert entries == list(range(20, samples + 1, 20))
    reference = Reference(bench, rows)
    assert (state.periods, state.stretches) == (len(reference.y), reference.stretches)
    found, allowed = unexplained(model, state)
    assert found == pytest.approx(reference.unexplained([*entries, samples]), rel=1e-7, abs=1e-7)
    assert allowed == pytest.approx(reference.allowed() if len(reference.y) >= 40 else math.inf, rel=1e-7)
    for count in (COEFFICIENTS, 7):
        expected = pytest.approx(reference.coefficients(count), rel=1e-6, abs=1e-6)
        assert coefficients(model, state, count) == expected


def test_both_ways_to_explain_decide_in_the_rows_above() -> None:
    """With friction by the load, and without it but for its part."""
    entries = [*range(20, 501, 20)]
    references = [Reference(BENCH, played(BENCH, seed, 500, gain=gain)) for seed, gain in ((2, 1.0), (3, 1.4))]
    assert {r.range(8, entries) < r.range(7, entries) - 15.0 for r in references} == {False, True}


def test_before_the_first_entry_it_is_what_is_left_now() -> None:
    for seed in range(20):
        rows = played(BENCH, seed, 19, lost=0.0)
        if seed % 2:
            rows = [Row(row.follows, -row.angle, -row.velocity, -row.current) for row in rows]
        state, entries = taken(BENCH, rows)
        assert entries == []
        expected = Reference(BENCH, rows).unexplained([19])
        assert unexplained(balance_model(BENCH), state)[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("samples", "since"), [(639, 320), (641, 320), (660, 320), (660, 360), (720, 380), (2000, 1000)]
)
def test_a_long_run_keeps_a_coarser_table(samples: int, since: int) -> None:
    """Also where what was dropped is the extreme."""
    rows = played(BENCH, 5, samples, gain=1.2, since=since)
    state, entries = taken(BENCH, rows)
    spacing, at = 20, 0
    kept: list[int] = []
    while (at := at + spacing) <= samples:
        if len(kept) == 32:
            kept, spacing = kept[1::2], 2 * spacing
        kept.append(at)
    assert len(state.entries) == len(kept) + 1  # and the one at the begin
    assert set(kept) <= set(entries)
    expected = Reference(BENCH, rows).unexplained([*kept, samples])
    assert unexplained(balance_model(BENCH), state)[0] == pytest.approx(expected, rel=1e-7)


EDGES = {
    (12.0, 13.0): 0, (13.0, 12.0): 0, (12.1, 12.1): 1, (-12.1, -12.1): 1, (-12.0, -13.0): 0, (-13.0, -12.0): 0,
    (13.0, -13.0): 0,
}  # fmt: skip


def test_the_edges_of_a_period_that_counts() -> None:
    model = balance_model(BENCH)
    for velocities, counts in EDGES.items():
        state = begin_balance(0.0, velocities[0])
        for _ in range(2):
            state = take(model, state, True, 0.0, velocities[0], 1.0)
        assert take(model, state, True, 0.0, velocities[1], 1.0).periods - state.periods == counts, velocities


@pytest.mark.parametrize(
    ("changes", "judged"),
    [({}, True), ({"frame_age": (0, 2)}, True), ({"frame_age": (0, 3)}, False), ({"current_lag": 0.0005}, False)],
)
def test_what_the_bench_declares_decides_whether_it_is_judged(changes: dict[str, Any], judged: bool) -> None:
    bench = replace(BENCH, shield=BENCH.shield._replace(**changes))
    assert math.isfinite(balance_model(bench).allowed) == judged


def test_a_declared_observer_is_not_blamed_for_its_lag_of_three_samples_and_an_undeclared_one_is() -> None:
    shown, late = 0.0, []
    for row in played(BENCH, 7, 500, lost=0.0):
        shown += (row.velocity - shown) / 4.0
        late.append(row._replace(velocity=shown))
    shares = []
    for bench in (BENCH, replace(BENCH, sensors=Sensors("observer", 800.0))):
        found, allowed = unexplained(balance_model(bench), taken(bench, late)[0])
        shares.append(found / allowed)
    assert shares[0] > 1.0
    assert shares[1] < 0.3


def test_too_little_motion_is_not_judged() -> None:
    model, state = balance_model(BENCH), taken(BENCH, played(BENCH, 2, 230))[0]
    assert math.isfinite(unexplained(model, state._replace(periods=40))[1])
    assert unexplained(model, state._replace(periods=39))[1] == math.inf


def sample(row: Row) -> SensorSample:
    return SensorSample(0, row.angle, row.velocity, 0, 0, row.current, 0, NodeState.ACTIVE)


def feed(balance: MotionBalance, rows: Iterator[Row]) -> None:
    for row in rows:
        balance.add_sample(sample(row), row.follows)


def test_an_honest_run_is_explained_and_a_gain_that_changes_ends_it_with_the_next_entry() -> None:
    honest = played(BENCH, 6, 500, lost=0.0)
    balance, first, rows = MotionBalance(BENCH), *split(honest)
    balance.begin_run(first)
    feed(balance, rows)
    found, most = balance.check_motion()
    reference = Reference(BENCH, honest)
    assert found == pytest.approx(reference.unexplained([*range(20, 501, 20)]), rel=1e-7)
    assert most == pytest.approx(reference.allowed(), rel=1e-7)
    assert 0.0 < found < 0.7 * most
    first, rows = split(played(BENCH, 6, 500, gain=1.4, lost=0.0))
    balance.begin_run(first)
    with pytest.raises(StopError) as stopped:
        feed(balance, rows)
    left = len(list(rows))
    assert left % 20 == 0
    assert 100 < left < 250
    assert stopped.value.fault is Fault.MOTION_UNEXPLAINED
    said = [float(word) for word in stopped.value.detail.split() if word.isdigit()]
    assert said[0] > said[1] > 25.0
    balance.begin_run(first)
    assert balance.check_motion() == (0.0, math.inf)


def split(rows: list[Row]) -> tuple[SensorSample, Iterator[Row]]:
    return sample(rows[0]), iter(rows[1:])


@pytest.mark.parametrize(
    ("velocities", "found"),
    [
        ([5.0] * REST_SAMPLES, 5.0),
        ([-5.0] * REST_SAMPLES, -5.0),
        ([5.0] * (REST_SAMPLES - 1), 0.0),
        ([2.0] * REST_SAMPLES, 0.0),
        ([2.1] * REST_SAMPLES, 2.1),
        ([6.0] * 10 + [4.0] * 10, 5.0),
        ([4.0] * 10 + [6.0] * 10, 5.0),
        ([6.0] * 10 + [3.9] * 10, 0.0),
        ([5.0, -5.0] * 10, 0.0),
    ],
)
def test_a_velocity_that_stays_at_rest_is_an_error(velocities: list[float], found: float) -> None:
    assert steady_motion(velocities, 1.0) == pytest.approx(found)
    assert steady_motion([2.0 * v for v in velocities], 2.0) == pytest.approx(2.0 * found)


def ending(angle: float, velocity: float, current: float, bench: Bench = BENCH) -> float:
    """What is found where the last samples of a stop are all like this."""
    one = SensorSample(0, angle, velocity, 0, 0, current, 0, NodeState.STOPPING)
    return unheld_motion(bench, [one._replace(velocity=-velocity), *[one] * REST_SAMPLES])


def test_a_velocity_is_an_error_only_where_friction_holds_every_brake_of_the_ranges() -> None:
    low, high = BENCH.range_set(BENCH.shield.ranges).low, BENCH.range_set(BENCH.shield.ranges).high
    farthest = low.T_c / (high.gamma * high.k_1)  # at which the least friction holds the stiffest spring [rad]
    for sign in (1.0, -1.0):
        assert ending(0.0, sign * 5.0, 0.0) == pytest.approx(sign * 5.0)
        assert ending(-sign * farthest * 0.999, sign * 5.0, 0.0) == pytest.approx(sign * 5.0)
        assert ending(-sign * farthest * 1.001, sign * 5.0, 0.0) == 0.0  # the spring brings it home
        assert ending(sign * farthest * 10.0, sign * 5.0, 0.0) == pytest.approx(sign * 5.0)  # nothing drives it away
        most = low.T_c / high.k_m
        assert ending(0.0, sign * 5.0, sign * most * 0.999) == pytest.approx(sign * 5.0)
        assert ending(0.0, sign * 5.0, sign * most * 1.001) == 0.0
        assert ending(sign * 30.0, sign * 5.0, sign * most * 1.001) == 0.0  # the softest spring may press less
        braking = (high.gamma * high.k_1 * 30.0 - low.T_c) / low.k_m  # holds every brake at 30 rad, with friction
        assert ending(-sign * 30.0, sign * 5.0, -sign * braking * 1.001) == pytest.approx(sign * 5.0)
        assert ending(-sign * 30.0, sign * 5.0, -sign * braking * 0.999) == 0.0
    assert ending(0.0, 1.0, 0.0) == 0.0


# --- the spring's origin: least squares with an unknown velocity at the begin of each stretch -------------------------


def origin_reference(bench: Bench, rows: list[Row]) -> tuple[float, float]:
    """Origin, and how far from 0 it may be [rad]."""
    b, t, sigma, travel = bench.brake, bench.timing.sample_time, sigma_of(bench), bench.limits.angle[1]
    lines: list[Any] = []
    velocities: list[float] = []
    stretches = 0
    for slide in slides_of(bench, rows):
        terms = [*slide.terms, -t / b.J * b.gamma * b.k_1 * travel * (slide.angle > 0.0)]
        if slide.begins:
            stretches += 1
            lines.append((stretches, np.zeros(9)))
            velocities.append(slide.before)
        lines.append((stretches, lines[-1][1] + np.array(terms)))
        velocities.append(slide.after)
    first = np.array([[n == m + 1 for m in range(stretches)] for n, _ in lines], float)
    design = np.vstack([np.hstack([[sums for _, sums in lines], first]), sigma * np.eye(9, 9 + stretches)])
    y = np.concatenate([velocities, sigma * np.array([1.0] * 4 + [0.0] * 5)])
    found: Any = np.linalg.lstsq(design, y, rcond=None)[0]
    error = travel * sigma * math.sqrt(np.linalg.inv(design.T @ design)[8, 8])
    return -travel * float(found[8]), 2.2 + 6.0 * error + 20.0 * float(np.abs(found[4:6]).sum())


@of_each_bench
@pytest.mark.parametrize(("seed", "samples", "lost"), [(1, 60, 0.0), (2, 230, 0.1), (3, 500, 0.1), (4, 333, 0.0)])
def test_origin_and_what_is_allowed_are_those_of_least_squares(
    bench: Bench, seed: int, samples: int, lost: float
) -> None:
    rows = played(bench, seed, samples, gain=0.8, lost=lost)
    released = [row._replace(angle=row.angle - rows[samples // 2].angle) for row in rows]
    for case in (rows, released):
        state, _ = taken(bench, case)
        expected = pytest.approx(origin_reference(bench, case), rel=1e-6, abs=1e-6)
        assert origin(balance_model(bench), state) == expected


def run(bench: Bench, zero: float, seed: int = 1, samples: int = 500) -> MotionBalance:
    """A balance of a brake that reports its angle less a zero, on a bench so fast that all else is explained."""
    bench = replace(bench, limits=replace(bench.limits, velocity=2000.0))
    draw, b, t = Random(seed), bench.brake, bench.timing.sample_time
    balance, x, v, u = MotionBalance(bench), zero, 0.0, 0.0
    balance.begin_run(sample(Row(True, 0.0, 0.0, 0.0)))
    for k in range(samples):
        u = (4.0 if k % 200 < 100 else -4.0) + draw.uniform(-1.0, 1.0)
        drive = 0.9 * b.k_m * u - 1.1 * b.gamma * b.k_1 * max(x, 0.0) - 0.8 * b.f_v * v
        before, v = v, v + t * (drive - math.copysign(1.2 * b.T_c, v)) / b.J
        x += 0.5 * t * (before + v)
        noise = draw.gauss(0.0, 1e-3), draw.gauss(0.0, bench.noise.velocity)
        feed(balance, iter([Row(k % 50 > 0, x - zero + noise[0], v + noise[1], u)]))
    return balance


@of_each_bench
def test_a_zero_that_is_wrong_by_6_rad_is_found_and_one_by_less_than_is_allowed_is_not(bench: Bench) -> None:
    for zero in (0.0, 1.0, -1.0):
        run(bench, zero).check_origin()
    for zero in (6.0, -6.0):
        with pytest.raises(StopError) as stopped:
            run(bench, zero).check_origin()
        assert stopped.value.fault is Fault.MOTION_UNEXPLAINED
        place = float(stopped.value.detail.split("begins at ")[1].split()[0])
        assert place == pytest.approx(-zero, abs=2.0)  # of the nominal spring, whose begin is an edge


def test_what_is_not_judged_by_the_balance_has_no_origin_to_judge(bench: Bench) -> None:
    lagging = replace(bench, shield=bench.shield._replace(current_lag=0.0005))
    run(lagging, 6.0).check_origin()
    few = MotionBalance(bench)
    few.begin_run(sample(Row(True, 0.0, 0.0, 0.0)))
    few.check_origin()


def test_the_origin_may_be_as_far_off_as_is_allowed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    balance = run(bench, 0.0)
    monkeypatch.setattr(motion_balance, "origin", lambda *_: (3.0, 3.0))
    balance.check_origin()
