"""Lemmas by boxes of intervals: statements with a logarithm, and those about every measurement."""

from __future__ import annotations

import math
from typing import Any

from emb_runtime.safety.shield import PAST, _highest_current, braking_window
from emb_runtime.safety.shield_design import ANGLE_PAD, ShieldLaw, damped_excess, unseen
from proof.boxes import Covered, Slack, cover
from proof.cases import Case
from proof.intervals import Boxes, Interval, greater
from proof.terms import with_floats

MOST = 2_000_000  # Boxes for one lemma


def interval_law(boxes: Boxes, law: ShieldLaw) -> Any:
    """A law whose floats are intervals, so that sums of them are rounded outward as well."""
    return with_floats(law, boxes.constant)


def some_current_is_left(case: Case) -> Covered:
    """Full braking cannot turn the brake around within the sample where the two ends of the window pass each other.

    Holds for any measurement within the limits and the noise, possible or not, of any age. The slack is that of the
    ends [A], or that of the speed over what a sample can change [rad/s].
    """
    hidden = _most_unseen(case)

    def statement(boxes: Boxes) -> Slack:
        law = interval_law(boxes, case.law)
        ends: list[Interval] = []
        plain = boxes.lift(_highest_current)

        def watched(*args: Any) -> Any:
            ends.append(plain(*args))
            return ends[-1]

        window = boxes.lift(braking_window, _highest_current=watched)

        def slack(angle: Interval, velocity: Interval) -> Any:
            # Older measurements, and those of an observer, leave wider boxes.
            wide = law.angle_noise + case.law.age_high * law.reach
            fast = law.velocity_noise + case.law.age_high * law.change + hidden
            window(law, angle - wide, angle + wide, velocity - fast, velocity + fast)
            top, bottom = ends[-2], -ends[-1]
            left = greater(top - bottom, greater(-law.current - bottom, top - law.current))
            return greater(left, abs(velocity) - fast - law.change)

        return slack

    law = case.law
    region = {
        "angle": (case.bottom - law.angle_noise, case.top + law.angle_noise),
        "velocity": (-law.homeward_speed - law.velocity_noise, law.outward_speed + law.velocity_noise),
    }
    return cover(statement, region, MOST)


def _most_unseen(case: Case) -> float:
    """Greatest change of the velocity that :func:`emb_runtime.safety.shield._unseen` reckons with [rad/s]."""
    law = case.law
    if law.delay.observer == 0.0:
        return 0.0
    rest = unseen(law.delay.observer, PAST - law.age_high) * law.change
    away = rest + (2.0 / law.delay.observer + PAST) * law.change
    fastest = law.outward_speed + 2.0 * law.velocity_noise + away
    farthest = case.top + 2.0 * law.angle_noise + PAST * law.reach
    accelerated = law.box.motor_high * law.current + law.box.friction_high
    accelerated += law.box.viscous_high * fastest + law.box.spring_high * farthest
    return rest + 2.0 / law.delay.observer * law.sample_time * accelerated


def damped_stop_is_counted(case: Case) -> Covered:
    """The damped stop needs at most ``damped_excess`` beyond full braking; the slack is a way [rad].

    For any speed, and friction with any help of the spring. Where they agree, ``ANGLE_PAD`` is the slack.
    """
    law = case.law

    def statement(boxes: Boxes) -> Slack:
        exact = interval_law(boxes, law)
        counted = boxes.lift(damped_excess)(
            exact.box.motor_low, exact.box.friction_low, exact.current, exact.damping_velocity, exact.sample_time
        )
        way = boxes.lift(damped_way)

        def slack(speed: Interval, helped: Interval) -> Any:
            friction = exact.box.friction_low + helped
            full = exact.box.motor_low * exact.current + friction
            envelope = speed * speed * 0.5 / full + speed * 0.5 * exact.sample_time
            return counted + ANGLE_PAD - (way(exact, friction, speed) - envelope)

        return slack

    fastest = max(law.outward_speed, law.homeward_speed)
    region = {"speed": (0.0, fastest), "helped": (0.0, law.box.spring_low * case.bench.limits.angle[1])}
    return cover(statement, region, MOST)


def damped_way(law: Any, friction: Any, v: Any) -> Any:
    """Way of the weakest motor's damped stop from a speed v ≥ 0, in its sampled form [rad]."""
    slope = law.box.motor_low * law.current / law.damping_velocity
    slow = min(v, law.damping_velocity)
    way = slow / slope - friction / (slope * slope) * math.log1p(slope * slow / friction) + law.sample_time * slow
    if v > slow:
        full = slope * law.damping_velocity + friction
        way = way + (v * v - slow * slow) * 0.5 / full + (v - slow) * 0.5 * law.sample_time
    return way
