"""The proof of the response beside least squares, and its verdicts and causes on brakes that are worked out here."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from emb_runtime.config.bench import Bench, Sensors
from emb_runtime.safety.response import (
    CONTRADICTED,
    OPEN,
    PROVEN,
    Row,
    begin_response,
    explains,
    overshoot,
    response_model,
    take,
    unproven_law,
)
from emb_runtime.safety.response_cause import cause, observer_bandwidth
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
LAW = make_law(BENCH)
MODEL = response_model(BENCH, LAW)
TS = BENCH.timing.sample_time
PIECES = 40  # of a period, in the brakes of this file
FULL = [6.0] * 40
REVERSING = [6.0] * 8 + [-6.0] * 12 + [6.0] * 12 + [-6.0] * 8


def declaring(bandwidth: float | None = None, **shield: Any) -> Bench:
    sensors = Sensors("observer", bandwidth) if bandwidth else BENCH.sensors
    return replace(BENCH, sensors=sensors, shield=BENCH.shield._replace(**shield))


def moved(
    commands: Sequence[float],
    *,
    late: int = 0,
    lag: float = 0.0,
    bandwidth: float = 0.0,
    motor: float = 1.0,
    noise: int | None = None,
    stop: int | None = None,
) -> list[Row]:
    """Samples of a brake at rest in the free stroke, in small steps of constant acceleration.

    After so many samples the node brakes by itself (``stop``), and its current takes the command's place.
    """
    p, h = BENCH.brake, TS / PIECES
    rng = np.random.default_rng(noise)
    x = v = i = tracked = seen = 0.0
    e = math.exp(-0.7 * bandwidth * TS)
    alpha, beta = 1.0 - e * e, 1.0 + e * e - 2.0 * e * math.cos(math.sqrt(0.51) * bandwidth * TS)
    rows = [Row(False, 0.0, 0.0, 0.0)]
    for k, command in enumerate(commands):
        u = commands[k - late] if k >= late else 0.0
        if stop is not None and k >= stop:
            u = command = max(min(-0.1 * v, 6.0), -6.0)
        for _ in range(PIECES):
            i = u + (i - u) * math.exp(-h / lag) if lag else u
            drive = motor * p.k_m * i - p.gamma * p.k_1 * max(x, 0.0)
            if v == 0.0 and abs(drive) <= p.T_c:
                continue
            way = math.copysign(1.0, v if v else drive)
            after = v + h * (drive - way * p.T_c - p.f_v * v) / p.J
            after = 0.0 if v * after < 0.0 else after
            x, v = x + 0.5 * h * (v + after), after
        wrong = rng.normal(0.0, [1e-3, 1.0]) if noise is not None else (0.0, 0.0)
        angle, velocity = x + wrong[0], v + wrong[1]
        if bandwidth:
            surprise = angle - tracked - TS * seen
            tracked, seen = tracked + TS * seen + alpha * surprise, seen + beta / TS * surprise
            velocity = seen
        rows.append(Row(True, angle, velocity, command))
    return rows


def judged(bench: Bench, rows: Sequence[Row]) -> tuple[int, int]:
    """First verdict that is not open, and after how many samples."""
    model = response_model(bench, make_law(bench))
    state = begin_response(model, rows[0].angle, rows[0].velocity)
    for k, row in enumerate(rows[1:], 1):
        state, verdict = take(model, state, *row)
        if verdict != OPEN:
            return verdict, k
    return OPEN, len(rows) - 1


def test_the_estimate_is_that_of_least_squares_with_a_prior() -> None:
    rows = moved([6.0] * 6 + [5.0] * 6 + [3.0] * 6, late=1, noise=4)
    state = begin_response(MODEL, rows[0].angle, rows[0].velocity)
    unknown = np.array([rows[0].velocity, *MODEL.prior, 0.0])
    deviations = np.array([MODEL.deviation, *MODEL.deviations, MODEL.widest])
    lines, measured = [np.diag(1.0 / deviations)], [unknown / deviations]
    total = np.zeros(4)
    for before, row in pairwise(rows):
        state, _ = take(MODEL, state, *row)
        pressed = 0.5 * (max(before.angle, 0.0) + max(row.angle, 0.0))
        total += TS * np.array([row.command, -1.0, -pressed, -0.5 * (before.velocity + row.velocity)])
        lines.append(np.array([[1.0, *total, -row.command / 6.0]]) / MODEL.deviation)
        measured.append(np.array([row.velocity]) / MODEL.deviation)
    matrix = np.concatenate(lines)
    found = np.linalg.lstsq(matrix, np.concatenate(measured), rcond=None)[0]
    now = np.eye(6)
    now[0, 1:5] = total  # from the velocity at the begin to the newest
    found = now @ found
    covariance = now @ np.linalg.inv(matrix.T @ matrix) @ now.T
    np.testing.assert_allclose(state.mean, found, rtol=1e-6)
    np.testing.assert_allclose(state.covariance, covariance[np.triu_indices(6)], rtol=1e-4, atol=1e-9)
    assert overshoot(MODEL, state, 0.0) == pytest.approx((found[5], math.sqrt(covariance[5, 5])), rel=1e-4)
    share = np.array([0.0, -6.0 * TS, 0.0, 0.0, 0.0, 1.0])
    assert overshoot(MODEL, state, TS) == pytest.approx(
        (share @ found, math.sqrt(share @ covariance @ share)), rel=1e-4
    )


def test_a_velocity_that_follows_at_once_is_proven_within_twenty_samples() -> None:
    for commands, motor, noise in product((FULL, REVERSING), (0.5, 1.0, 1.5), (None, 1, 2)):
        verdict, samples = judged(BENCH, moved(commands, motor=motor, noise=noise))
        assert verdict == PROVEN, (motor, noise)
        assert samples <= 20, (motor, noise)


OBSERVER = r"observer_bandwidth = (\d+) at most"
LAG = r"current_lag = ([\d.]+)$"
RESPONSES: dict[str, tuple[dict[str, float], str, float, float]] = {
    "observer 300": ({"bandwidth": 300.0}, OBSERVER, 270.0, 300.0),
    "observer 800": ({"bandwidth": 800.0}, OBSERVER, 740.0, 800.0),
    "observer 1520": ({"bandwidth": 1520.0}, OBSERVER, 1400.0, 1520.0),
    "lag 0.5 ms": ({"lag": 0.0005}, LAG, 0.0005, 0.001),
    "lag 1 ms": ({"lag": 0.001}, LAG, 0.001, 0.002),
    "lag 2 ms": ({"lag": 0.002}, LAG, 0.002, 0.002),
    "lag 3 ms": ({"lag": 0.003}, LAG, 0.003, 0.0051),
    "late 1": ({"late": 1}, r"frame_age = \[0, (\d)\]", 1.0, 1.0),
    "late 2": ({"late": 2}, r"frame_age = \[0, (\d)\]", 2.0, 2.0),
    "late 5": ({"late": 5}, r"frame_age = \[0, (\d)\]", 5.0, 5.0),
}
"""What is undeclared, and the key and the values that cover it."""


@pytest.mark.parametrize("name", RESPONSES)
def test_a_later_response_contradicts_and_its_cause_names_the_key_with_a_value_that_covers_it(name: str) -> None:
    response, key, least, most = RESPONSES[name]
    for commands, motor in product((FULL, REVERSING), (0.6, 1.0, 1.5)):
        verdict, n = judged(BENCH, moved(commands, motor=motor, noise=3, **response))  # type: ignore[arg-type]
        assert verdict == CONTRADICTED, motor
        assert n <= 30, motor
        rows = moved([*commands[:n], *[0.0] * 32], motor=motor, noise=3, stop=n, **response)  # type: ignore[arg-type]
        named = cause(BENCH, MODEL, rows[: n + 1], rows[n + 1 :])
        found = re.search(key, named)
        assert found is not None, (motor, named)
        assert least <= float(found[1]) <= most, motor


@pytest.mark.parametrize(
    ("response", "key", "least", "most"),
    [
        ({"lag": 0.002}, LAG, 0.002, 0.0026),
        ({"late": 2}, r"frame_age = \[0, (\d)\]", 2.0, 2.0),
        ({"late": 3}, r"frame_age = \[0, (\d)\]", 3.0, 3.0),
        ({"lag": 0.002, "bandwidth": 1520.0}, LAG, 0.002, 0.0026),
        ({"late": 2, "bandwidth": 1520.0}, r"frame_age = \[0, (\d)\]", 2.0, 2.0),
        ({"late": 3, "bandwidth": 2000.0}, r"frame_age = \[0, (\d)\]", 3.0, 3.0),
        ({"bandwidth": 800.0}, OBSERVER, 740.0, 800.0),
    ],
)
def test_where_an_observer_is_declared_the_newest_samples_and_the_stop_tell_what_else_is_late(
    response: dict[str, float], key: str, least: float, most: float
) -> None:
    bench = declaring(1520.0)
    for levels, motor in product((FULL[:16], [6.0] * 14 + [1.5] * 40 + [-2.0] * 6 + [1.5] * 6), (0.6, 1.0, 1.5)):
        n = len(levels)
        rows = moved([*levels, *[0.0] * 32], motor=motor, noise=3, stop=n, **response)  # type: ignore[arg-type]
        named = cause(bench, response_model(bench, make_law(bench)), rows[max(n - 31, 0) : n + 1], rows[n + 1 :])
        found = re.search(key, named)
        assert found is not None, (motor, named)
        assert least <= float(found[1]) <= most, motor


def test_measurements_that_are_late_are_named_as_late_frames() -> None:
    rows = moved([*[6.0] * 5, *[0.0] * 32], noise=3, stop=5)
    late = [Row(row.follows, seen.angle, seen.velocity, row.command) for seen, row in pairwise([rows[0], *rows])]
    assert "frame_age = [0, 1]" in cause(BENCH, MODEL, late[:6], late[6:])


def test_without_a_stop_that_fits_the_samples_before_it_tell() -> None:
    rows = moved([6.0] * 6, noise=3, late=2)
    stop = [row._replace(velocity=-3.0 * row.velocity) for row in rows]
    assert "frame_age = [0, 2]" in cause(BENCH, MODEL, rows, stop)


def test_a_missing_sample_does_not_change_the_bandwidth_that_is_found() -> None:
    rows = moved(REVERSING, bandwidth=1000.0, noise=1)
    rows[8:10] = [rows[9]._replace(follows=False)]
    assert observer_bandwidth(MODEL, rows) == pytest.approx(1000.0, rel=0.04)


@pytest.mark.parametrize(
    ("bench", "response"),
    [
        (declaring(current_lag=0.002), {"lag": 0.002}),
        (declaring(current_lag=0.002), {"lag": 0.001}),
        (declaring(frame_age=(2, 2)), {"late": 2}),
        (declaring(frame_age=(0, 2)), {"late": 0}),
        (declaring(frame_age=(0, 2)), {"late": 1}),
        (declaring(frame_age=(0, 2)), {"late": 2}),
        (declaring(frame_age=(5, 5)), {"late": 5}),
        (declaring(1520.0), {"bandwidth": 1520.0}),
        (declaring(1520.0), {"bandwidth": 3000.0}),
        (declaring(800.0), {"bandwidth": 800.0}),
    ],
)
def test_what_is_declared_is_no_contradiction(bench: Bench, response: dict[str, float]) -> None:
    for motor in (0.6, 1.0, 1.5):
        rows = moved(REVERSING, motor=motor, noise=5, **response)  # type: ignore[arg-type]
        assert judged(bench, rows)[0] == PROVEN


@pytest.mark.parametrize(
    ("bench", "response"),
    [
        (declaring(frame_age=(0, 1)), {"late": 2}),
        (declaring(frame_age=(0, 2)), {"late": 3}),
        (declaring(frame_age=(0, 2)), {"late": 5}),
        (declaring(frame_age=(1, 2)), {"late": 3}),
        (declaring(frame_age=(0, 1)), {"lag": 0.002}),
        (declaring(current_lag=0.002), {"lag": 0.004}),
        (declaring(frame_age=(0, 1)), {"bandwidth": 800.0}),
    ],
)
def test_right_after_a_change_of_the_current_a_later_response_than_the_longest_declared_one_is_not_proven(
    bench: Bench, response: dict[str, float]
) -> None:
    for seed in range(60):
        dice = np.random.default_rng(seed)
        levels = [0.0, dice.uniform(-1.0, 1.0), 6.0, -6.0, dice.uniform(-6.0, 6.0)]
        commands = [u for _ in range(9) for u in [float(dice.choice(levels))] * int(dice.integers(2, 20))]
        rows = moved(commands[:60], motor=dice.uniform(0.55, 1.5), noise=seed, **response)  # type: ignore[arg-type]
        assert judged(bench, rows)[0] != PROVEN


@pytest.mark.parametrize("bench", [declaring(frame_age=(0, 2)), declaring(current_lag=0.002), declaring(800.0)])
def test_a_velocity_that_follows_at_once_is_proven_soon_where_a_longer_response_is_declared(bench: Bench) -> None:
    found = [judged(bench, moved(REVERSING, motor=motor, noise=4)) for motor in (0.6, 0.8, 1.0, 1.2, 1.5)]
    assert [verdict for verdict, _ in found] == [PROVEN] * 5
    assert max(samples for _, samples in found) <= 15


def test_frames_that_are_younger_than_the_least_declared_age_contradict() -> None:
    bench = declaring(frame_age=(2, 2))
    rows = moved(REVERSING, noise=1)
    assert judged(bench, rows)[0] == CONTRADICTED
    assert "frame_age = [0, 2]" in cause(bench, response_model(bench, make_law(bench)), rows, ())


def test_what_does_not_move_proves_nothing() -> None:
    assert judged(BENCH, moved([0.0] * 40, noise=1))[0] == OPEN
    assert judged(BENCH, moved([0.2] * 40, noise=1))[0] == OPEN


def test_a_motor_outside_the_set_proves_nothing() -> None:
    assert judged(BENCH, moved(FULL, motor=3.0))[0] != PROVEN


def test_after_a_command_that_was_not_obeyed_more_periods_are_asked_for() -> None:
    rows = moved(FULL)
    _, samples = judged(BENCH, rows)
    lost = [*rows[:samples], rows[samples]._replace(follows=False), *rows[samples + 1 :]]
    verdict, later = judged(BENCH, lost)
    assert (verdict, later > samples + 4) == (PROVEN, True)


def test_until_then_the_speed_leaves_room_for_six_samples_of_full_current() -> None:
    slow = unproven_law(BENCH, LAW)
    strongest = 3.255e-2 / 4.624e-6 * 6.0
    assert slow.outward_speed == slow.homeward_speed == pytest.approx(500.0 - 6e-3 * strongest)
    assert slow.bottom == 0.5 * LAW.bottom
    assert slow.home.cruise == pytest.approx(
        LAW.home.cruise * (slow.homeward_speed - LAW.home.creep) / (LAW.homeward_speed - LAW.home.creep)
    )
    late = declaring(frame_age=(1, 2), current_lag=0.0)
    assert unproven_law(late, make_law(late)).outward_speed == pytest.approx(500.0 - 4e-3 * strongest)
    narrow = replace(BENCH, limits=replace(BENCH.limits, velocity=200.0))
    law = make_law(narrow)
    assert unproven_law(narrow, law).outward_speed == 0.25 * law.homeward_speed


def test_no_cause_is_named_where_none_explains_the_samples() -> None:
    assert cause(BENCH, MODEL, moved(REVERSING, noise=1), ()) == ""
    opposite = [row._replace(angle=-row.angle, velocity=-row.velocity) for row in moved(REVERSING, noise=1)]
    assert cause(BENCH, MODEL, opposite, ()) == ""
    scaled = [row._replace(velocity=0.5 * row.velocity) for row in moved(REVERSING, noise=1)]
    assert observer_bandwidth(MODEL, scaled) == 0.0
    assert cause(BENCH, MODEL, moved([0.0] * 20, noise=1), ()) == ""


def test_a_slower_observer_than_the_declared_one_is_named_and_a_faster_one_is_not() -> None:
    rows = moved(REVERSING, bandwidth=800.0, noise=1)
    bench = declaring(1520.0)
    model = response_model(bench, make_law(bench))
    assert "observer_bandwidth = 7" in cause(bench, model, rows, ())
    assert "observer_bandwidth = 7" in cause(bench, model, rows, (), proven=True)
    assert "observer" not in cause(declaring(800.0), model, moved(REVERSING, bandwidth=1520.0, noise=1), ())


def test_a_sample_that_does_not_follow_begins_the_observer_anew() -> None:
    rows = moved(REVERSING, bandwidth=1000.0, noise=1)
    rows[10] = rows[10]._replace(follows=False)
    assert observer_bandwidth(MODEL, rows) == pytest.approx(1000.0, rel=0.06)


def test_a_filter_whose_innovations_are_too_large_does_not_fit() -> None:
    state = begin_response(MODEL, 0.0, 0.0)
    assert explains(MODEL, state)
    for k in range(12):
        state, _ = take(MODEL, state, True, 0.0, 40.0 * (-1.0) ** k + 60.0, 0.0)
    assert not explains(MODEL, state)
