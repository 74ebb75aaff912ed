"""The spring's origin against least squares by numpy with an unknown velocity at the begin of each stretch."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest

from emb_runtime.config.bench import Bench
from emb_runtime.safety.motion_balance import MotionBalance
from emb_runtime.safety.spring_origin import MEMORY, add, begin, end_stretch, origin
from emb_runtime.safety.state_machine import Fault, StopError
from tests.runtime.safety.test_motion_balance import BENCHES, Row, feed, sample

Period = tuple[tuple[float, ...], float, float]  # Regressors, constant torque, change of the velocity


def drawn(draw: Random, periods: int) -> list[Period]:
    """A stretch of periods of a brake with drawn coefficients, none of them nominal."""
    rows = []
    for _ in range(periods):
        regressors = tuple(draw.gauss(0.0, 5.0) for _ in range(8))
        constant = draw.choice([0.0, -9.0])
        change = sum(r * c for r, c in zip(regressors, (0.9, 1.2, 0.8, 1.1, 0.2, -0.1, 0.3, 0.1), strict=True))
        rows.append((regressors, constant, change - 0.04 * constant + draw.gauss(0.0, 1.0)))
    return rows


def reference(stretches: list[list[Period]], deviation: float, travel: float) -> tuple[float, float]:
    """Origin, and how far from 0 it may be [rad]."""
    lines: list[list[float]] = []
    velocities: list[float] = []
    for n, stretch in enumerate(stretches):
        first = [float(n == m) for m in range(len(stretches))]
        lines.append([0.0] * 9 + first)
        velocities.append(0.0)
        for k in range(1, len(stretch) + 1):
            sums = [sum(row[0][i] for row in stretch[:k]) for i in range(8)]
            lines.append([*sums, sum(row[1] for row in stretch[:k]), *first])
            velocities.append(sum(row[2] for row in stretch[:k]))
    prior = deviation * np.eye(9, 9 + len(stretches))
    x = np.vstack([np.array(lines), prior])
    y = np.concatenate([velocities, deviation * np.array([1.0] * 4 + [0.0] * 5)])
    found: Any = np.linalg.lstsq(x, y, rcond=None)[0]
    error = travel * deviation * math.sqrt(np.linalg.inv(x.T @ x)[8, 8])
    return -travel * float(found[8]), 2.2 + 6.0 * error + 20.0 * float(np.abs(found[4:6]).sum())


@pytest.mark.parametrize("seed", range(6))
def test_origin_and_error_are_those_of_least_squares(seed: int) -> None:
    draw = Random(seed)
    stretches = [drawn(draw, draw.randrange(1, 40)) for _ in range(seed + 1)]
    memory = [7.0] * MEMORY
    begin(memory)
    for stretch in stretches:
        for period in stretch:
            add(memory, *period)
        for _ in range(draw.randrange(1, 3)):
            end_stretch(memory)
    deviation, travel = draw.uniform(0.5, 2.0), draw.uniform(50.0, 100.0)
    assert origin(memory, deviation, travel) == pytest.approx(reference(stretches, deviation, travel), rel=1e-6)


def test_the_last_stretch_counts_before_it_has_ended() -> None:
    rows, memories = drawn(Random(9), 30), ([0.0] * MEMORY, [0.0] * MEMORY)
    for memory in memories:
        for row in rows:
            add(memory, *row)
    end_stretch(memories[1])
    assert origin(memories[0], 1.0, 100.0) == origin(memories[1], 1.0, 100.0)


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
