"""The spring's origin against least squares by numpy with an unknown velocity at the begin of each stretch."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest

from emb_runtime.config.bench import Bench
from emb_runtime.safety import motion_balance
from emb_runtime.safety.motion_balance import MotionBalance, balance_model, origin
from emb_runtime.safety.state_machine import Fault, StopError
from tests.runtime.safety.test_motion_balance import BENCHES, Row, feed, played, sample, taken


def reference(bench: Bench, rows: list[Row]) -> tuple[float, float]:
    """Origin, and how far from 0 it may be [rad]."""
    b, t, sigma, travel = bench.brake, bench.timing.sample_time, bench.noise.velocity, bench.limits.angle[1]
    lines: list[Any] = []
    velocities: list[float] = []
    stretches, run, slid = 0, 0, False
    for k in range(1, len(rows)):
        run = run + 1 if rows[k].follows else 0
        v0, v1 = rows[k - 1].velocity, rows[k].velocity
        slides = run >= 3 and min(abs(v0), abs(v1)) > 12.0 * sigma and v0 * v1 > 0.0
        if slides:
            x, v = max(0.5 * (rows[k - 1].angle + rows[k].angle), 0.0), 0.5 * (v0 + v1)
            i, i1, i2 = rows[k].current, rows[k - 1].current, rows[k - 2].current
            force, s = b.gamma * b.k_1 * x, math.copysign(1.0, v)
            parts = [
                b.k_m * i,
                -force,
                -b.T_c * s,
                -b.f_v * v,
                b.k_m * (i1 - i),
                b.k_m * (i2 - i1),
                -force * x / travel,
            ]
            parts += [-force * s, -b.gamma * b.k_1 * travel * (x > 0.0)]
            if not slid:
                stretches += 1
                lines.append((stretches, np.zeros(9)))
                velocities.append(v0)
            lines.append((stretches, lines[-1][1] + t / b.J * np.array(parts)))
            velocities.append(v1)
        slid = slides
    first = np.array([[n == m + 1 for m in range(stretches)] for n, _ in lines], float)
    design = np.vstack([np.hstack([[sums for _, sums in lines], first]), sigma * np.eye(9, 9 + stretches)])
    y = np.concatenate([velocities, sigma * np.array([1.0] * 4 + [0.0] * 5)])
    found: Any = np.linalg.lstsq(design, y, rcond=None)[0]
    error = travel * sigma * math.sqrt(np.linalg.inv(design.T @ design)[8, 8])
    return -travel * float(found[8]), 2.2 + 6.0 * error + 20.0 * float(np.abs(found[4:6]).sum())


@pytest.mark.parametrize("bench", BENCHES, ids=["shipped", "other", "quiet"])
@pytest.mark.parametrize(("seed", "samples", "lost"), [(1, 60, 0.0), (2, 230, 0.1), (3, 500, 0.1), (4, 333, 0.0)])
def test_origin_and_what_is_allowed_are_those_of_least_squares(
    bench: Bench, seed: int, samples: int, lost: float
) -> None:
    rows = played(bench, seed, samples, gain=0.8, lost=lost)
    released = [row._replace(angle=row.angle - rows[samples // 2].angle) for row in rows]
    for case in (rows, released):
        memory, _ = taken(bench, case)
        for _ in range(2):
            assert origin(balance_model(bench), memory) == pytest.approx(reference(bench, case), rel=1e-6, abs=1e-6)


def run(bench: Bench, zero: float, seed: int = 1, samples: int = 500) -> MotionBalance:
    """A balance of a brake that reports its angle less a zero, on a bench so fast that all else is explained."""
    bench = replace(bench, limits=replace(bench.limits, velocity=2000.0))
    draw, b, t = Random(seed), bench.brake, bench.timing.sample_time
    balance, x, v, u = MotionBalance(bench), zero, 0.0, 0.0
    balance.begin(sample(Row(True, 0.0, 0.0, 0.0)))
    for k in range(samples):
        u = (4.0 if k % 200 < 100 else -4.0) + draw.uniform(-1.0, 1.0)
        drive = 0.9 * b.k_m * u - 1.1 * b.gamma * b.k_1 * max(x, 0.0) - 0.8 * b.f_v * v
        before, v = v, v + t * (drive - math.copysign(1.2 * b.T_c, v)) / b.J
        x += 0.5 * t * (before + v)
        noise = draw.gauss(0.0, 1e-3), draw.gauss(0.0, bench.noise.velocity)
        feed(balance, iter([Row(k % 50 > 0, x - zero + noise[0], v + noise[1], u)]))
    return balance


@pytest.mark.parametrize("bench", BENCHES, ids=["shipped", "other", "quiet"])
def test_a_zero_that_is_wrong_by_6_rad_is_found_and_one_by_less_than_is_allowed_is_not(bench: Bench) -> None:
    for zero in (0.0, 1.0, -1.0):
        run(bench, zero).judge_zero()
    for zero in (6.0, -6.0):
        with pytest.raises(StopError) as stopped:
            run(bench, zero).judge_zero()
        assert stopped.value.fault is Fault.MOTION_UNEXPLAINED
        place = float(stopped.value.detail.split("begins at ")[1].split()[0])
        assert place == pytest.approx(-zero, abs=2.0)  # of the nominal spring, whose begin is an edge


def test_what_is_not_judged_by_the_balance_has_no_origin_to_judge(bench: Bench) -> None:
    lagging = replace(bench, shield=bench.shield._replace(current_lag=0.0005))
    run(lagging, 6.0).judge_zero()
    few = MotionBalance(bench)
    few.begin(sample(Row(True, 0.0, 0.0, 0.0)))
    few.judge_zero()


def test_the_origin_may_be_as_far_off_as_is_allowed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    balance = run(bench, 0.0)
    monkeypatch.setattr(motion_balance, "origin", lambda *_: (3.0, 3.0))
    balance.judge_zero()
