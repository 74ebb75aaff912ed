"""The shield's closed forms against the conditions that they solve, for laws and states drawn at random.

The reference enumerates brakes at the corners of the box, one forward-Euler step each, and searches roots. A law's
numbers are drawn independently of each other, so that none can stand in for another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.records import Reason
from emb_runtime.safety.shield import (
    LIMITED,
    NO_PAST,
    RETURNING,
    Past,
    States,
    _accelerated,
    _unseen,
    shield,
    successor,
    window,
)
from emb_runtime.safety.shield_design import CREEPS, VELOCITY_PAD, ShieldLaw, make_law
from tests.benches import SENSOR_BENCH
from tests.laws import with_numbers

Box = States
SHIPPED = make_law(SENSOR_BENCH)
SEEDS = range(10)
STATES = 80
CLOSE = 1e-6
AGES = [(0, 0), (0, 1), (1, 1), (2, 3), (4, 5)]


def drawn_law(rng: Random) -> ShieldLaw:
    """A braking law for fresh answers."""
    current = rng.uniform(3.0, 6.0)
    motor, spring, friction, viscous = (
        sorted((rng.uniform(low, high), rng.uniform(low, high)))
        for low, high in ((1500.0, 6000.0), (30.0, 140.0), (800.0, 3400.0), (2.0, 9.0))
    )
    return with_numbers(
        SHIPPED,
        sample_time=rng.uniform(0.8e-3, 1.2e-3),
        steps=500,
        current=current,
        angle_noise=rng.uniform(1e-3, 1e-2),
        velocity_noise=rng.choice([rng.uniform(1.0, 8.0), rng.uniform(0.1, 1.0)]),
        bottom=-rng.uniform(3.0, 9.7),
        top=rng.choice([rng.uniform(60.0, 99.0), rng.uniform(0.1, 2.0)]),
        outward_speed=rng.uniform(400.0, 499.0),
        homeward_speed=rng.uniform(200.0, 400.0),
        reach=rng.uniform(0.3, 0.6),
        motor_low=motor[0],
        motor_high=motor[1],
        spring_low=spring[0],
        spring_high=spring[1],
        friction_low=friction[0],
        friction_high=friction[1],
        viscous_low=viscous[0],
        viscous_high=viscous[1],
        braking=rng.uniform(8000.0, 16000.0),
        braking_high=rng.uniform(16000.0, 30000.0),
        damping_velocity=rng.uniform(40.0, 90.0),
        change=rng.uniform(10.0, 60.0),
        apex=rng.uniform(10.0, 50.0),
        creep=rng.choice([rng.uniform(1.0, 10.0), rng.uniform(0.05, 0.3)]),
        cruise=rng.choice([rng.uniform(100.0, 400.0), rng.uniform(30.0, 100.0)]),
        ramp=rng.uniform(5000.0, 9000.0),
        landing=rng.uniform(6000.0, 12000.0),
        gain=rng.uniform(0.2, 0.9),
        reserve=rng.uniform(5e-3, 2e-2),
        committed=rng.uniform(3e-2, 5e-2),
        settling=rng.uniform(5e-3, 2e-2),
        rest_zone=rng.uniform(0.1, 0.3),
        settled_zone=rng.uniform(0.4, 0.8),
        rest_velocity=rng.choice([rng.uniform(5.0, 20.0), rng.uniform(0.05, 0.5)]),
    )


def draws() -> Iterator[Random]:
    """A generator of numbers for each of so many states of each seed."""
    for seed in SEEDS:
        rng = Random(seed)
        for _ in range(STATES):
            yield rng


def drawn_state(rng: Random, law: ShieldLaw) -> tuple[float, float]:
    """Angle and velocity, often where something changes: at the limits, at contact, at rest."""
    angle = rng.choice(
        [
            rng.uniform(law.bottom, law.top),
            rng.uniform(law.bottom - 0.1, law.bottom + 1.0),
            rng.uniform(law.top - 2.0, law.top + 0.1),
            law.bottom + law.angle_noise + rng.uniform(-0.01, 0.05),
            law.top - law.angle_noise + rng.uniform(-0.05, 0.01),
            rng.uniform(-1.0, 1.0),
        ]
    )
    velocity = rng.choice(
        [
            rng.uniform(-500.0, 500.0),
            rng.uniform(-20.0, 20.0),
            rng.uniform(-4.0, 4.0),
            rng.choice([-law.velocity_noise, law.velocity_noise]),
            rng.choice([-1.0, 1.0]) * (law.velocity_noise + rng.uniform(0.0, 1.0)),
            rng.uniform(-10.0, 10.0) + law.outward_speed,
            rng.uniform(-10.0, 10.0) - law.homeward_speed,
        ]
    )
    return angle, velocity


def measured(law: ShieldLaw, angle: float, velocity: float) -> Box:
    dx, dv = law.angle_noise, law.velocity_noise
    return angle - dx, angle + dx, velocity - dv, velocity + dv


def corners(law: ShieldLaw, box: Box, u: float) -> Iterator[float]:
    """Velocities one sample later, without the pad, of brakes at the corners of the box."""
    xl, xh, vl, vh = box
    starts = [(vl, math.copysign(1.0, vl)), (vh, math.copysign(1.0, vh))]
    if vl <= 0.0 <= vh:
        starts += [(0.0, -1.0), (0.0, 1.0)]
    if vl < 0.0 < vh:
        yield 0.0  # it sticks
    for (v, sign), m, k, c, d, x in itertools.product(
        starts,
        (law.box.motor_low, law.box.motor_high),
        (law.box.spring_low, law.box.spring_high),
        (law.box.friction_low, law.box.friction_high),
        (law.box.viscous_low, law.box.viscous_high),
        (xl - law.reach, xh + law.reach),
    ):
        after = v + law.sample_time * (m * u - k * max(x, 0.0) - sign * c - d * v)
        yield after
        if v * after < 0.0:
            yield 0.0  # it comes to rest on the way, and sticks


def moved(law: ShieldLaw, box: Box, u_low: float, u_high: float) -> Box:
    """The box one sample later, for any current between two."""
    xl, xh, vl, vh = box
    low = min(itertools.chain(corners(law, box, u_low), corners(law, box, u_high))) - VELOCITY_PAD
    high = max(itertools.chain(corners(law, box, u_low), corners(law, box, u_high))) + VELOCITY_PAD
    return xl + law.sample_time * min(vl, low), xh + law.sample_time * max(vh, high), low, high


def test_the_successor_box_is_that_of_the_extreme_brakes() -> None:
    for rng in draws():
        law = drawn_law(rng)
        xl, xh, vl, vh = measured(law, *drawn_state(rng, law))
        box = rng.choice([(xl, xh, vl, vh), (xl, xh, vl := rng.uniform(-3.0, 3.0), vl + rng.uniform(0.01, 3.0))])
        u = rng.choice([0.0, rng.uniform(-law.current, law.current)])
        assert successor(law, *box, u) == pytest.approx(moved(law, box, u, u), rel=1e-12, abs=1e-9)


def way(law: ShieldLaw, braking: float, v: float, before: float) -> float:
    """What a brake that has ``v`` after this sample needs from its begin to rest, at most."""
    return v * v / (2.0 * braking) + 0.5 * v * law.sample_time + law.sample_time * max(v, before)


# --- The window: what its ends allow, and that a little more is too much --------------------------------------------


def speed_after(law: ShieldLaw, box: Box, u: float, sign: float) -> float:
    """Greatest velocity after this sample, upwards or downwards."""
    _, _, low, high = moved(law, box, u, u)
    return high if sign > 0.0 else -low


def held_by_braking(law: ShieldLaw, box: Box, u: float, sign: float) -> bool:
    """Whether every brake of the box is within speed and stopping distance after this command."""
    xl, xh, vl, vh = box
    v = speed_after(law, box, u, sign)
    if sign > 0.0:
        room, before, braking, fastest = (
            law.top - xh,
            vh,
            law.box.braking + law.box.spring_low * max(xl, 0.0),
            law.outward_speed,
        )
    else:
        room, before, braking, fastest = xl - law.bottom, -vl, law.box.braking, law.homeward_speed
    return v <= fastest and way(law, braking, max(v, VELOCITY_PAD), before) <= room


def held_by_friction(law: ShieldLaw, box: Box, u: float, sign: float) -> bool:
    """Whether every brake of the box comes to rest in time after this command without any further current."""
    xl, xh, vl, vh = box
    ts = law.sample_time
    v = max(speed_after(law, box, u, sign), VELOCITY_PAD)
    above, below = xh + ts * max(vh + law.change, 0.0), xl + ts * min(vl - law.change, 0.0)
    squeezed = max(above, 0.0) ** 2 / 2.0
    if sign > 0.0:
        taken = law.box.friction_low * (law.home.apex - above)
        taken += law.box.spring_low * (law.home.apex**2 / 2.0 - squeezed)
        return v <= law.outward_speed and v * v / 2.0 <= taken
    return v <= law.homeward_speed and v * v / 2.0 + law.box.spring_high * squeezed <= law.box.friction_low * (
        below - law.bottom
    )


Held = Callable[[ShieldLaw, Box, float, float], bool]


def assert_exact(
    law: ShieldLaw, boxes: list[Box], velocity: float, ends: tuple[float, float], full: float, held: Held
) -> None:
    """Each end is held in every box and a little more is not, unless it is the limit or all that can be done."""
    if ends[0] == ends[1] and full > 0.0:
        # Only full braking is left: against the side that asks for it, or against the motion where the other side asks
        # for something as well.
        asks, silent = (
            [all(held(law, box, sign * u, sign) for box in boxes) == answer for sign in (1.0, -1.0)]
            for u, answer in ((CLOSE - full, False), (full - CLOSE, True))
        )
        down = velocity > 0.0
        if asks[0] and silent[1]:
            down = True
        elif asks[1] and silent[0]:
            down = False
        assert ends[0] == (-full if down else full)
        return
    for sign, end in ((1.0, ends[1]), (-1.0, -ends[0])):
        if end > -full + CLOSE:
            assert all(held(law, box, sign * (end - CLOSE), sign) for box in boxes)
        if end < law.current - CLOSE:
            assert not all(held(law, box, sign * (end + CLOSE), sign) for box in boxes)
        assert -full <= end <= law.current


def test_the_window_is_what_every_brake_of_the_box_can_be_held_from() -> None:
    for rng in draws():
        law = drawn_law(rng)
        state = drawn_state(rng, law)
        ends = window(law, *state, NO_PAST)
        assert_exact(law, [measured(law, *state)], state[1], ends, law.current, held_by_braking)


def test_the_coasting_window_is_what_friction_alone_can_hold() -> None:
    for rng in draws():
        law = drawn_law(rng)._replace(coasting=True, homeward_speed=rng.uniform(50.0, 300.0))
        angle, velocity = drawn_state(rng, law._replace(top=law.home.apex))
        velocity *= rng.choice([1.0, 0.3])
        ends = window(law, angle, velocity, NO_PAST)
        assert ends[0] <= 0.0 <= ends[1]
        assert_exact(law, [measured(law, angle, velocity)], velocity, ends, 0.0, held_by_friction)


def damped(law: ShieldLaw, v: float) -> float:
    return max(-law.current, min(law.current, -law.current / law.damping_velocity * v))


def after_commands(law: ShieldLaw, box: Box, commands: tuple[float, ...], lost: bool) -> Box:
    """The box after commands, oldest first; any of them may have been lost, and the node has braked instead."""
    for u in commands:
        braked = [damped(law, box[2] - law.change), damped(law, box[3] + law.change)] if lost else []
        box = moved(law, box, min(u, *braked, u), max(u, *braked, u))
    return box


def integral(f: Callable[[float], float], low: float, high: float) -> float:
    """By Simpson's rule."""
    n = 400
    h = (high - low) / n
    inner = sum((4.0 if i % 2 else 2.0) * f(low + i * h) for i in range(1, n))
    return h / 3.0 * (f(low) + inner + f(high))


def observed(law: ShieldLaw, angle: float, velocity: float, past: Past, age: int, lost: bool) -> Box:
    """The box of a measurement whose velocity is an observer's, by what the brakes at the corners of the set did.

    At the time τ before, a critically damped observer of the bandwidth ω shows 1 − (1 + ωτ) exp(−ωτ) of a change.
    """
    scaled = law.delay.observer

    def hidden(first: int, end: float) -> float:
        """Samples that an acceleration between these samples before counts for."""
        return integral(lambda t: (1.0 + scaled * t) * math.exp(-scaled * t), float(first), end)

    overshot = max(0.125 / scaled, 0.125 / 1.5)
    known = 5 - age
    rest = (2.0 / scaled - sum(hidden(i, i + 1.0) for i in range(known)) + overshot) * law.change
    xl, xh, vl, vh = measured(law, angle, velocity)
    low, high = vl - rest, vh + rest
    for i in range(known):
        apart = rest + 2.0 / scaled * law.change + (i + 1) * law.change
        slowest, fastest = vl - apart, vh + apart
        own = past[age + i]
        u = [own, damped(law, slowest), damped(law, fastest)] if lost else [own]
        accelerations = [
            m * current - k * max(x, 0.0) - math.copysign(d, v) - c * v
            for m, current, k, x, d, c, v in itertools.product(
                (law.box.motor_low, law.box.motor_high),
                (min(u), max(u)),
                (law.box.spring_low, law.box.spring_high),
                (xl - (i + 1) * law.reach, xh + (i + 1) * law.reach),
                (law.box.friction_low, law.box.friction_high),
                (law.box.viscous_low, law.box.viscous_high),
                (slowest, fastest),
            )
        ]
        low += law.sample_time * hidden(i, i + 1.0) * min(*accelerations, 0.0)
        high += law.sample_time * hidden(i, i + 1.0) * max(*accelerations, 0.0)
    return xl, xh, low, high


OBSERVED_AGES = [(0, 0), (0, 1), (1, 1)]


@pytest.mark.parametrize("ages", OBSERVED_AGES)
def test_the_window_behind_an_observer_holds_whatever_it_does_not_show_yet(ages: tuple[int, int]) -> None:
    rng = Random(100 + 10 * ages[0] + ages[1])
    for _ in range(100):
        law = with_numbers(drawn_law(rng), age_low=ages[0], age_high=ages[1], observer=rng.uniform(0.5, 3.0))
        law = law._replace(change=rng.choice([law.change, 5.0]))
        angle, velocity = drawn_state(rng, law)
        past = drawn_past(rng, law)
        boxes = [
            after_commands(law, observed(law, angle, velocity, past, age, True), past[:age][::-1], lost=True)
            for age in range(ages[0], ages[1] + 1)
        ]
        assert_exact(law, boxes, velocity, window(law, angle, velocity, past), law.current, held_by_braking)


def test_a_brake_at_rest_may_be_pushed_by_its_friction_the_next_moment() -> None:
    law = drawn_law(Random(13))
    for slow, gained in ((0.0, law.box.friction_high), (0.5, -law.box.friction_low - law.box.viscous_low * 0.5)):
        _, _, _, up = _accelerated(law, -1.0, -1.0, slow, slow, 2.0)
        _, _, down, _ = _accelerated(law, -1.0, -1.0, -slow, -slow, -2.0)
        assert up == down == pytest.approx(2.0 * law.box.motor_high + gained, rel=1e-14)


def test_the_weakest_motor_brakes_least() -> None:
    law = drawn_law(Random(13))
    braked = -1.0 * law.box.motor_low - law.box.friction_low - law.box.viscous_low * 200.0
    _, up, _, obeyed_up = _accelerated(law, -5.0, -5.0, 200.0, 200.0, -1.0)
    down, _, obeyed_down, _ = _accelerated(law, -5.0, -5.0, -200.0, -200.0, 1.0)
    assert [up, obeyed_up, down, obeyed_down] == pytest.approx([braked] * 4, rel=1e-14)


def test_what_drives_a_little_counts_and_what_brakes_does_not() -> None:
    brake = {"motor": 2000.0, "spring": 0.0, "friction": 1000.0, "viscous": 0.0}
    same = {f"{name}_{end}": value for name, value in brake.items() for end in ("low", "high")}
    law = with_numbers(drawn_law(Random(5)), observer=1.5, change=10.0, damping_velocity=math.inf, **same)
    blind, counts = law.delay.hidden.before[0] * law.change, law.sample_time * sum(law.delay.hidden.periods)
    for sign, gained in itertools.product((1.0, -1.0), (0.5, -0.5)):
        own = sign * (1000.0 + gained) / 2000.0
        fallen, risen, fell, rose = _unseen(law, 0.0, 0.0, 400.0 * sign, 400.0 * sign, (own,) * 5, 0)
        found = (risen, rose) if sign > 0.0 else (-fallen, -fell)
        assert found == pytest.approx([blind + counts * max(gained, 0.0)] * 2, rel=1e-12)


def drawn_past(rng: Random, law: ShieldLaw) -> Past:
    one, two, three, four, five = (rng.uniform(-1.5, 1.5) * law.current for _ in range(5))
    return one, two, three, four, five


@pytest.mark.parametrize("ages", AGES[1:])
def test_the_window_after_late_measurements_holds_whatever_their_age_and_whatever_was_lost(
    ages: tuple[int, int],
) -> None:
    rng = Random(10 * ages[0] + ages[1])
    for _ in range(30):
        law = drawn_law(rng)._replace(age_low=ages[0], age_high=ages[1])
        angle, velocity = drawn_state(rng, law)
        past = drawn_past(rng, law)
        boxes = [
            after_commands(law, measured(law, angle, velocity), past[:age][::-1], lost=True)
            for age in range(ages[0], ages[1] + 1)
        ]
        assert_exact(law, boxes, velocity, window(law, angle, velocity, past), law.current, held_by_braking)


def flowing_at_most(law: ShieldLaw, past: Past, velocity: float) -> float:
    """Greatest current that may flow now: each of the last periods had its own command or the node's braking."""
    greatest = -math.inf
    for which in itertools.product([False, True], repeat=5):
        flowing = law.current
        for periods_ago in (5, 4, 3, 2, 1):
            own = max(-law.current, min(law.current, past[periods_ago - 1]))
            u = own if which[periods_ago - 1] else damped(law, velocity - periods_ago * law.change)
            flowing = max(u, u + (flowing - u) * law.delay.kept)
        greatest = max(greatest, flowing)
    return greatest


def held_with_lag(law: ShieldLaw, box: Box, u: float, sign: float, flowing: float) -> bool:
    """Whether a brake with either motor keeps its speed and can be stopped, though its current follows late."""
    xl, xh, vl, vh = box
    ts, lag = law.sample_time, law.delay.lag
    if sign > 0.0:
        begin, fastest, room = (vl, vh), law.outward_speed, law.top - xh
        soft, held = law.box.spring_low * max(xl - law.reach, 0.0), law.box.spring_low * max(xl, 0.0)
    else:
        begin, fastest, room = (-vh, -vl), law.homeward_speed, xl - law.bottom
        soft, held = -law.box.spring_high * max(xh + law.reach, 0.0), 0.0
    turns = begin[0] <= law.change
    going_back = law.box.viscous_high * max(law.change - begin[1], 0.0)
    friction = -law.box.friction_high - going_back if turns else law.box.friction_low + law.box.viscous_low * begin[1]
    weak, strong = (law.box.motor_low, law.box.braking), (law.box.motor_high, law.box.braking_high)
    for motor, unhelped in (weak, strong):
        braking = unhelped + held
        gained = ts * (motor * sign * u - friction - soft) + VELOCITY_PAD
        rises = lag * max(motor * flowing + max(-soft - law.box.friction_low, 0.0), 0.0)
        as_if = begin[1] + lag * motor * (flowing + law.current)
        if begin[1] + rises + gained > fastest or way(law, braking, max(as_if + gained, VELOCITY_PAD), as_if) > room:
            return False
    return True


def test_the_window_of_a_current_that_follows_late_is_what_either_motor_can_be_held_from() -> None:
    for rng in draws():
        law = with_numbers(drawn_law(rng), lag=rng.uniform(0.5e-3, 2e-3), kept=rng.uniform(0.3, 0.7))
        angle, velocity = drawn_state(rng, law)
        past = drawn_past(rng, law)
        near = abs(velocity) - law.velocity_noise
        law = law._replace(change=rng.choice([law.change, max(near, 0.0), max(near + rng.uniform(-2.0, 2.0), 0.0)]))
        box = measured(law, angle, velocity)
        up = flowing_at_most(law, past, box[2])
        down = flowing_at_most(law, (-past[0], -past[1], -past[2], -past[3], -past[4]), -box[3])
        ends = window(law, angle, velocity, past)

        def held(law: ShieldLaw, box: Box, u: float, sign: float, up: float = up, down: float = down) -> bool:
            return held_with_lag(law, box, u, sign, up if sign > 0.0 else down)

        assert_exact(law, [box], velocity, ends, law.current, held)


# --- The way home ---------------------------------------------------------------------------------------------------


def root(rising: Callable[[float], float], low: float, high: float) -> float:
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rising(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


def lost_by_creeping(law: ShieldLaw, x: float) -> float:
    """Trapezoids of what the slower speed of the coasting envelope costs on the way from ``x`` [s]."""
    begin, end = 2.0 * law.box.friction_low / law.box.spring_high, min(x, law.home.apex)
    if end <= begin:
        return 0.0

    def costs(at: float) -> float:
        energy = law.box.friction_low * (at - law.bottom) - 0.5 * law.box.spring_high * at**2
        fastest = math.sqrt(2.0 * energy) if energy > 0.0 else 0.0
        return max(0.0, 1.0 / (max(fastest, CREEPS * law.home.creep) - law.home.creep) - 1.0 / law.home.cruise)

    nodes = [begin + (end - begin) * i / 8.0 for i in range(9)]
    return sum(0.5 * (b - a) * (costs(a) + costs(b)) for a, b in itertools.pairwise(nodes))


def arrival(law: ShieldLaw, x: float, v: float) -> float:
    """Time of the way home from a corner of the box, phase by phase [s]."""
    time = 0.0
    inside = x >= 0.0
    spring = law.box.spring_low * x if inside else 0.0
    distance, homeward = abs(x), -v if inside else v
    if homeward < 0.0:  # away from home: stop first
        stop = -homeward / (law.box.braking + spring)
        time += stop
        distance += -homeward * stop / 2.0 + law.sample_time * -homeward / 2.0
        homeward = 0.0
    landing_way = homeward**2 / (2.0 * law.home.landing)
    if landing_way > distance:  # past the origin, and back from the other side, where there is no spring
        time += homeward / law.home.landing
        distance, homeward, spring = landing_way - distance, 0.0, 0.0
    ramp = law.home.ramp + spring / 2.0
    landing = law.home.landing
    peak = root(lambda p: (p**2 - homeward**2) / (2.0 * ramp) + p**2 / (2.0 * landing) - distance, homeward, 1e5)
    peak = max(min(peak, law.home.cruise), homeward)
    at_cruise = distance - (peak**2 - homeward**2) / (2.0 * ramp) - peak**2 / (2.0 * law.home.landing)
    time += (peak - homeward) / ramp + peak / law.home.landing + max(at_cruise, 0.0) / law.home.cruise
    return time + (lost_by_creeping(law, distance) if law.coasting else 0.0)


def inner_state(rng: Random, law: ShieldLaw) -> tuple[float, float]:
    """An angle and a velocity well inside, near home or far, slow or fast, on either side."""
    span = rng.choice([0.3, 2.0, 1.0])
    apex = law.home.apex
    x = rng.choice([rng.uniform(-span, span), rng.uniform(0.0, 1.3 * apex), rng.uniform(0.4 * law.bottom, 0.0)])
    v = rng.choice([rng.uniform(-15.0, 15.0), rng.uniform(-1.5, 1.5) * law.home.cruise, rng.uniform(-1.0, 1.0)])
    return x, v


def at_home_in_time(law: ShieldLaw, angle: float, velocity: float, wanted: float, past: Past, left: float) -> bool:
    step = law.steps - 1 - round(left / law.sample_time)
    return not shield(law, angle, velocity, wanted, past, step)[1] & RETURNING


def assert_returns_at(law: ShieldLaw, state: tuple[float, float], past: Past, box: Box) -> None:
    """The way home takes over when the reserve would not be left after the worst corner's way home."""
    lowest, highest = window(law, *state, past)
    wanted = 0.5 * (lowest + highest)
    xl, xh, vl, vh = moved(law, box, wanted, wanted)
    left = 400 * law.sample_time
    reserve = left - max(arrival(law, xl, vl), arrival(law, xh, vh))
    assert at_home_in_time(with_numbers(law, reserve=reserve - CLOSE), *state, wanted, past, left)
    assert not at_home_in_time(with_numbers(law, reserve=reserve + CLOSE), *state, wanted, past, left)


def test_the_way_home_takes_over_when_the_worst_brake_would_come_too_late() -> None:
    for coasting, seed in itertools.product([False, True], SEEDS):
        rng = Random(seed)
        for _ in range(STATES):
            law = drawn_law(rng)._replace(coasting=coasting)
            state = inner_state(rng, law)
            assert_returns_at(law, state, NO_PAST, measured(law, *state))


@pytest.mark.parametrize("ages", AGES[1:])
def test_late_measurements_are_rolled_on_to_where_the_way_home_begins(ages: tuple[int, int]) -> None:
    rng = Random(10 * ages[0] + ages[1])
    for _ in range(30):
        law = drawn_law(rng)._replace(age_low=ages[0], age_high=ages[1])
        state, past = inner_state(rng, law), drawn_past(rng, law)
        boxes = [
            after_commands(law, measured(law, *state), past[:age][::-1], lost=False)
            for age in range(ages[0], ages[1] + 1)
        ]
        xl, xh, vl, vh = zip(*boxes, strict=True)
        assert_returns_at(law, state, past, (min(xl), max(xh), min(vl), max(vh)))


@pytest.mark.parametrize("ages", OBSERVED_AGES)
def test_the_way_home_begins_with_what_an_observer_does_not_show_yet(ages: tuple[int, int]) -> None:
    rng = Random(200 + 10 * ages[0] + ages[1])
    for _ in range(40):
        law = with_numbers(drawn_law(rng), age_low=ages[0], age_high=ages[1], observer=rng.uniform(0.5, 3.0))
        state, past = inner_state(rng, law), drawn_past(rng, law)
        boxes = [
            after_commands(law, observed(law, *state, past, age, False), past[:age][::-1], lost=False)
            for age in range(ages[0], ages[1] + 1)
        ]
        xl, xh, vl, vh = zip(*boxes, strict=True)
        assert_returns_at(law, state, past, (min(xl), max(xh), min(vl), max(vh)))


def test_the_way_home_of_a_late_current_begins_after_what_flows_has_decayed() -> None:
    for rng in draws():
        law = with_numbers(drawn_law(rng), lag=rng.uniform(1e-3, 3e-3), kept=rng.uniform(0.2, 0.6))
        state, past = inner_state(rng, law), drawn_past(rng, law)
        flowing = sum((1.0 - law.delay.kept) * law.delay.kept**n * u for n, u in enumerate(past))
        more = [law.delay.lag * motor * flowing for motor in (law.box.motor_low, law.box.motor_high)]
        xl, xh, vl, vh = measured(law, *state)
        assert_returns_at(law, state, past, (xl, xh, vl + min(more), vh + max(more)))


def homeward_current(law: ShieldLaw, x: float, v: float, left: float) -> float:
    """Current of the middle brake on the planned course [A]."""

    motor = (law.box.motor_low + law.box.motor_high) / 2.0
    spring = (law.box.spring_low + law.box.spring_high) / 2.0
    friction = (law.box.friction_low + law.box.friction_high) / 2.0
    viscous = (law.box.viscous_low + law.box.viscous_high) / 2.0
    per_sample = law.home.gain / law.sample_time
    if abs(x) < (law.home.settled_zone if left < law.home.settling else law.home.rest_zone):
        speed = abs(v)
        allowed = law.home.rest_velocity - law.velocity_noise
        at_the_end = speed + law.velocity_noise - law.box.friction_low * left  # as fast as it may be, by friction alone
        late = at_the_end >= allowed and speed >= law.velocity_noise
        rests = speed < law.home.rest_velocity and not late
        acceleration = 0.0 if rests else per_sample * (law.velocity_noise - speed)
        return math.copysign(1.0, v) * acceleration / motor
    home = -1.0 if x > 0.0 else 1.0
    speed = home * v  # towards home
    planned = math.sqrt(2.0 * law.home.landing * abs(x))
    acceleration = friction + viscous * speed - spring * max(x, 0.0)
    if planned < law.homeward_speed:
        acceleration -= law.home.landing * (0.0 if speed < 0.0 else min(speed / planned, 1.0))
    acceleration += per_sample * (min(planned, law.homeward_speed) - speed)
    return home * acceleration / motor


def test_on_the_way_home_the_current_follows_the_planned_speed() -> None:
    for rng in draws():
        law = with_numbers(drawn_law(rng), committed=10.0, settling=0.1)
        law = law._replace(current=rng.choice([law.current, 500.0]))
        angle, velocity = inner_state(rng, law)
        left = rng.choice([2, 50, 200]) * law.sample_time
        step = law.steps - 1 - round(left / law.sample_time)
        lowest, highest = window(law, angle, velocity, NO_PAST)
        current, bits = shield(law, angle, velocity, 0.0, NO_PAST, step)
        wanted = homeward_current(law, angle, velocity, left)
        assert bits & RETURNING
        assert current == pytest.approx(max(lowest, min(highest, wanted)), rel=1e-9, abs=1e-9)


def test_from_the_committed_time_on_the_way_home_is_taken_wherever_the_brake_is() -> None:
    law, left = with_numbers(drawn_law(Random(1)), reserve=0.0), 0.25
    law = law._replace(sample_time=1.0 / 1024.0)
    for committed, home in ((left, False), (math.nextafter(left, 1.0), True)):
        _, bits = shield(with_numbers(law, committed=committed), 0.0, 0.0, 0.0, NO_PAST, law.steps - 1 - 256)
        assert bool(bits & RETURNING) == home


def returning(law: ShieldLaw, angle: float, velocity: float, left_samples: int = 99) -> float:
    """The current of the way home, wherever the window would cut it."""
    return shield(law, angle, velocity, 0.0, NO_PAST, law.steps - 1 - left_samples)[0]


def test_the_borders_of_the_rest_are_counted_as_outside() -> None:
    law = with_numbers(drawn_law(Random(2)), committed=10.0, top=80.0, current=1e4, rest_velocity=5.0)
    x, v = 0.5 * ((0.2 - law.angle_noise) + (0.2 + law.angle_noise)), 1.0
    at_zone = with_numbers(law, rest_zone=x, settling=0.0)
    assert returning(at_zone, 0.2, v) == pytest.approx(homeward_current(at_zone, x, v, 1.0)) != 0.0
    assert returning(with_numbers(at_zone, rest_zone=math.nextafter(x, 1.0)), 0.2, v) == 0.0
    moving = 0.5 * ((7.0 - law.velocity_noise) + (7.0 + law.velocity_noise))
    assert returning(with_numbers(law, rest_velocity=moving), 0.0, 7.0) != 0.0
    assert returning(with_numbers(law, rest_velocity=math.nextafter(moving, 9.0)), 0.0, 7.0) == 0.0
    left = 99 * law.sample_time
    near = with_numbers(law, rest_zone=0.1, settled_zone=0.5)
    assert returning(with_numbers(near, settling=left), 0.2, v) != 0.0
    assert returning(with_numbers(near, settling=math.nextafter(left, 1.0)), 0.2, v) == 0.0


def test_what_friction_cannot_stop_in_the_time_that_is_left_is_braked_as_far_as_it_is_certain() -> None:
    law = with_numbers(drawn_law(Random(3)), committed=10.0, top=80.0, current=1e4, sample_time=1.0 / 1024.0)
    law = with_numbers(law, angle_noise=0.0, friction_low=1024.0, velocity_noise=4.0, rest_velocity=9.0)
    assert returning(law, 0.0, 7.0, left_samples=6) != 0.0  # it may be 11 rad/s fast, friction takes 6, 5 are allowed
    assert returning(law, 0.0, 6.99, left_samples=6) == 0.0
    assert returning(law, 0.0, 8.5, left_samples=8) == 0.0
    assert returning(law, 0.0, 9.0, left_samples=8) != 0.0
    assert returning(law, 0.0, 4.5, left_samples=2) == returning(law, 0.0, 4.5, left_samples=1) != 0.0
    assert returning(law, 0.0, 3.99, left_samples=0) == 0.0


def test_at_the_greatest_homeward_speed_the_course_does_not_fall_yet() -> None:
    law = with_numbers(drawn_law(Random(4)), committed=10.0, top=80.0, current=1e4, gain=0.05)
    x = 0.5 * ((5.0 - law.angle_noise) + (5.0 + law.angle_noise))
    law = law._replace(homeward_speed=math.sqrt(2.0 * law.home.landing * x))
    assert returning(law, 5.0, -100.0) == pytest.approx(homeward_current(law, x, -100.0, 1.0))


# --- What no box can be made of, and where the window has closed ----------------------------------------------------


def full_stop(law: ShieldLaw, velocity: float) -> float:
    return damped(law, velocity) if abs(velocity) <= 1e6 else 0.0


BEYOND = math.nextafter(1e6, math.inf)


def test_without_a_believable_angle_the_node_s_stop_is_all_that_is_left() -> None:
    for angle, velocity in itertools.product(
        [math.nan, math.inf, -math.inf, BEYOND, -BEYOND],
        [20.0, -20.0, 1e6, -1e6, BEYOND, -BEYOND, math.nan, math.inf, -math.inf],
    ):
        law = drawn_law(Random(6))
        stop = full_stop(law, velocity)
        assert window(law, angle, velocity, NO_PAST) == (stop, stop)
        assert shield(law, angle, velocity, 1.0, NO_PAST, 0) == (stop, LIMITED)


@pytest.mark.parametrize("velocity", [BEYOND, -BEYOND, math.nan, math.inf, -math.inf])
def test_without_a_believable_velocity_there_is_no_current(velocity: float) -> None:
    law = drawn_law(Random(6))
    assert window(law, 5.0, velocity, NO_PAST) == (0.0, 0.0)
    assert shield(law, 5.0, velocity, 1.0, NO_PAST, 0) == (0.0, LIMITED)


@pytest.mark.parametrize(("angle", "velocity"), [(1e6, 20.0), (-1e6, -20.0), (5.0, 1e6), (5.0, -1e6)])
def test_the_last_believable_numbers_are_answered_with_full_braking(angle: float, velocity: float) -> None:
    law = drawn_law(Random(6))
    assert window(law, angle, velocity, NO_PAST) == (-math.copysign(law.current, velocity),) * 2


def test_own_commands_are_believed_together_with_the_angle_where_a_law_looks_at_them() -> None:
    kinds: list[dict[str, Any]] = [
        {"age_high": 1},
        {"age_low": 1, "age_high": 1},
        {"lag": 1e-3, "kept": 0.0},
        {"observer": 0.9},
    ]
    for which, kind in itertools.product(range(5), kinds):
        law = with_numbers(drawn_law(Random(7)), **kind)
        stop = damped(law, 20.0)
        for sign in (-1.0, 1.0):
            past = [0.0] * 5
            past[which] = sign * 999_999.0
            assert window(law, -1.5, 20.0, tuple(past)) == (stop, stop)  # type: ignore[arg-type]
            assert window(law, 1.5, 20.0, tuple(past)) == (stop, stop)  # type: ignore[arg-type]
            assert window(law, -1.0, 20.0, tuple(past)) != (stop, stop)  # type: ignore[arg-type]
            past[(which + 1) % 5] = sign * 1.5
            assert window(law, 0.0, 20.0, tuple(past)) == (stop, stop)  # type: ignore[arg-type]


def test_the_bits_are_those_of_the_record_and_no_past_is_no_current() -> None:
    assert (LIMITED, RETURNING) == (Reason.LIMITED, Reason.RETURNING)
    assert NO_PAST == (0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_law_for_fresh_answers_does_not_look_at_own_commands() -> None:
    law = drawn_law(Random(7))
    past = math.nan, math.inf, 1e9, 0.0, 0.0
    assert window(law, 5.0, 20.0, past) == window(law, 5.0, 20.0, NO_PAST)
    assert shield(law, 5.0, 20.0, 1.0, past, law.steps) == shield(law, 5.0, 20.0, 1.0, NO_PAST, law.steps)


@pytest.mark.parametrize("late", [{"age_low": 1, "age_high": 1}, {"lag": 2e-3, "kept": 0.6}])
def test_where_own_commands_are_no_numbers_a_law_for_late_answers_brakes_fully(late: dict[str, float]) -> None:
    law = with_numbers(SHIPPED, **late)
    for sign in (1.0, -1.0):
        assert window(law, 20.0, 100.0 * sign, (math.nan,) * 5) == (-sign * law.current,) * 2


@pytest.mark.parametrize("velocity", [500.0, 0.5, 0.0, -0.5, -500.0])
def test_where_both_sides_ask_for_full_braking_it_is_against_the_motion(velocity: float) -> None:
    law = drawn_law(Random(8))._replace(top=-1.0, bottom=1.0)
    full = -law.current if velocity > 0.0 else law.current
    assert window(law, 0.0, velocity, NO_PAST) == (full, full)


def test_what_is_wanted_is_cut_to_the_window_and_what_is_no_number_counts_as_zero() -> None:
    for rng in draws():
        law = with_numbers(drawn_law(rng), reserve=-1e9, committed=0.0)
        state = drawn_state(rng, law)
        lowest, highest = window(law, *state, NO_PAST)
        wanted = rng.choice([rng.uniform(-2.0, 2.0) * law.current, math.nan, math.inf, -math.inf, lowest, highest])
        number = wanted if math.isfinite(wanted) else 0.0
        sent = lowest if number < lowest else highest if number > highest else number
        assert shield(law, *state, wanted, NO_PAST, 100) == (sent, 0 if sent == wanted else LIMITED)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_window_is_exact_where_an_end_changes_its_sign(seed: int) -> None:
    law = drawn_law(Random(seed))._replace(top=5.0)
    for sign, end in ((1.0, 1), (-1.0, 0)):
        crossing = root(lambda v, s=sign, e=end: -s * window(law, 0.0, s * v, NO_PAST)[e], 0.0, 600.0)  # type: ignore[misc]
        for beside in (-0.5, 0.5):  # half a rad/s² of drive on either side
            state = (0.0, sign * (crossing + beside * law.sample_time))
            ends = window(law, *state, NO_PAST)
            assert_exact(law, [measured(law, *state)], state[1], ends, law.current, held_by_braking)


@pytest.mark.parametrize(("beside", "faster", "free"), [(-0.5, 0.9, False), (0.5, 0.1, True), (-0.5, 200.0, False)])
def test_a_coasting_brake_on_its_way_up_is_judged_where_it_is(beside: float, faster: float, free: bool) -> None:
    law = drawn_law(Random(9))._replace(coasting=True, change=30.0)
    angle = law.bottom + law.angle_noise + beside * law.sample_time
    lowest, _ = window(law, angle, law.change + law.velocity_noise + faster, NO_PAST)
    assert lowest == (-law.current if free else 0.0)


@pytest.mark.parametrize(("beside", "free"), [(0.5, False), (-0.5, True)])
def test_a_coasting_brake_on_its_way_down_is_judged_where_it_is(beside: float, free: bool) -> None:
    law = drawn_law(Random(9))._replace(coasting=True, change=30.0)
    angle = law.home.apex - law.angle_noise + beside * law.sample_time
    _, highest = window(law, angle, -(law.change + law.velocity_noise + 200.0), NO_PAST)
    assert highest == (law.current if free else 0.0)


def test_a_box_that_ends_at_rest_is_pulled_away_if_the_drive_is_stronger_than_the_friction() -> None:
    law = drawn_law(Random(10))
    weak, strong = law.box.motor_low * law.current, law.box.motor_high * law.current
    below = successor(law, -5.0, -5.0, -1.0, 0.0, -law.current)
    assert below[3] == pytest.approx(law.sample_time * (law.box.friction_high - weak) + VELOCITY_PAD)
    begun = successor(law, -5.0, -5.0, 0.0, 0.01, law.current)
    assert begun[3] == pytest.approx(law.sample_time * (law.box.friction_high + strong) + VELOCITY_PAD)


@pytest.mark.parametrize(("lag", "room"), [(0.0, 0.0085), (1e-4, 0.0095)])
def test_a_speed_that_the_noise_may_hide_is_braked_fully_though_the_brake_seems_to_go_away(
    lag: float, room: float
) -> None:
    law = with_numbers(drawn_law(Random(11)), sample_time=1e-3, current=3.0, velocity_noise=8.0, lag=lag, kept=1e-4)
    law = with_numbers(law, motor_low=1500.0, motor_high=1600.0, braking=1e4, braking_high=1e4)
    law = with_numbers(law, friction_low=900.0, friction_high=1000.0, spring_low=0.0, change=10.0)
    # From 7.5 rad/s to what the room allows takes more than full braking of the weakest motor.
    assert window(law, law.top - law.angle_noise - room, -0.5, NO_PAST) == (-3.0, -3.0)
    assert window(law, law.bottom + law.angle_noise + room, 0.5, NO_PAST) == (3.0, 3.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_greatest_believable_velocity_is_still_reasoned_about(sign: float) -> None:
    law = drawn_law(Random(12))
    full = -sign * law.current
    assert shield(law, 5.0, sign * 1e6, full, NO_PAST, 0) == (full, RETURNING)
    assert shield(law, 5.0, sign * BEYOND, full, NO_PAST, 0) == (0.0, LIMITED)


anything = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=400)
@given(
    st.sampled_from([(0, 0), *AGES]), anything, anything, anything, st.tuples(*[anything] * 5), st.integers(-10, 2000)
)
def test_whatever_comes_in_a_finite_current_within_the_limit_comes_out(
    ages: tuple[int, int], angle: float, velocity: float, wanted: float, past: Past, step: int
) -> None:
    law = with_numbers(SHIPPED, age_low=ages[0], age_high=ages[1], observer=1.6 if step % 2 else 0.0)
    current, bits = shield(law, angle, velocity, wanted, past, step)
    assert abs(current) <= law.current
    assert bits in {0, LIMITED, RETURNING, LIMITED | RETURNING}
