"""Lemmas on what else a bench can declare: a lagging current, a drive that can only let go, an observer's velocity."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from emb_runtime.safety.shield import (
    PAST,
    _accelerated,
    _coasting_window,
    _flowing,
    _highest_current,
    _lagging_current,
    _lagging_window,
    _unseen,
    damped_current,
    successor,
)
from emb_runtime.safety.shield_design import OVERSHOOT
from proof.cases import Case
from proof.successors import any_box
from proof.terms import Answer, Facts, Real, Term, lifted_law, prove, together

FAR = 1e6  # In place of an end of the window that is not examined: cuts nothing off [A]


def coasting_window_is_kept(case: Case) -> Answer:
    """A current of the coasting window leaves the successor box within the energy that friction can take, or it is 0 A.

    The root stands for itself here: it is any number, and what it is the root of is stated. It is evaluated at angles
    beyond those of the box, where less is left.
    """
    ends = (prove(lambda facts, end=end: _coasting(facts, case, end)) for end in (0, 1))  # type: ignore[misc]
    return together((*ends, prove(lambda facts: _less_is_left_beyond(facts, case))))


def _left(law: Any, above: Real, below: Real, squeezed: Real) -> tuple[Real, Real]:
    """Half the squared speed from which friction and the softest spring stop it, up; from which friction does, down."""
    up = law.box.friction_low * (law.home.apex - above)
    up += 0.5 * law.box.spring_low * (law.home.apex * law.home.apex - squeezed * squeezed)
    return up, law.box.friction_low * (below - law.bottom) - 0.5 * law.box.spring_high * squeezed * squeezed


def _less_is_left_beyond(facts: Facts, case: Case) -> None:
    law = lifted_law(facts, case.law)
    above, below = facts.real("above"), facts.real("below")
    inner_above, inner_below = facts.real("inner", None, above), facts.real("inner", below)
    squeezed = above if above > 0.0 else facts.constant(0.0)
    inner_squeezed = inner_above if inner_above > 0.0 else facts.constant(0.0)
    outer, inner = _left(law, above, below, squeezed), _left(law, inner_above, inner_below, inner_squeezed)
    facts.claim("less is left up", inner[0], outer[0])
    facts.claim("less is left down", inner[1], outer[1])


def _coasting(facts: Facts, case: Case, end: int) -> None:
    law = lifted_law(facts, case.law)
    xl, xh, vl, vh = any_box(facts, case)
    fastest = case.bench.limits.velocity + law.velocity_noise
    facts.at_least(law.home.apex + (2.0 + law.age_high) * law.reach, xh)  # no brake of the set gets beyond the apex
    facts.at_least(vl, -fastest)
    facts.at_least(fastest, vh)
    roots: list[tuple[Real, ...]] = []
    ends: list[Term] = []
    plain = facts.lift(_highest_current)

    def watched(*args: Any) -> Any:
        ends.append(plain(*args) if len(ends) == end else facts.constant(0.0))
        return ends[-1]

    window = facts.lift(
        _coasting_window, math=SimpleNamespace(sqrt=facts.stand_in(0.0, roots)), _highest_current=watched
    )
    lowest, highest = window(law, xl, xh, vl, vh)
    root, square = roots[end]
    u = facts.real("u", -law.current, law.current)
    next_xl, next_xh, next_vl, next_vh = facts.lift(successor)(law, xl, xh, vl, vh, u)
    above = xh + law.sample_time * facts.greater(vh + law.change, 0.0)
    below = xl + law.sample_time * facts.smaller(vl - law.change, 0.0)
    up, down = _left(law, above, below, facts.greater(above, 0.0))
    facts.claim("beyond the box", above, next_xh)
    facts.claim("beyond the box", next_xl, below)
    facts.claim("energy", facts.greater(2.0 * (down if end else up), 0.0), square)
    if end == 0:
        facts.claim("upper cut", highest, 0.0)
        if highest > 0.0 and u <= highest:
            facts.claim("upper speed", facts.smaller(root, law.outward_speed), next_vh)
    else:
        facts.claim("lower cut", 0.0, lowest)
        if lowest < 0.0 and u >= lowest:
            facts.claim("lower speed", facts.smaller(root, law.homeward_speed), -next_vl)


def coasting_loses_energy(case: Case) -> Answer:
    """Under any current against the motion, along the flow, either sum of energy and friction's way only falls."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        x = facts.real("x", case.bottom, case.top)
        squeezed = facts.greater(x, 0.0)
        spring = facts.real("spring", law.box.spring_low, law.box.spring_high)
        friction = facts.real("friction", law.box.friction_low, law.box.friction_high)
        viscous = facts.real("viscous", law.box.viscous_low, law.box.viscous_high)
        against = facts.real("against", 0.0)
        v = facts.real("v", -law.homeward_speed, law.outward_speed)
        if v > 0.0:
            rate = v * (-against - spring * squeezed - friction - viscous * v)
            facts.claim("up", 0.0, rate + law.box.spring_low * squeezed * v + law.box.friction_low * v)
        else:
            rate = v * (against - spring * squeezed + friction - viscous * v)
            facts.claim("down", 0.0, rate + law.box.spring_high * squeezed * v - law.box.friction_low * v)

    return prove(statement)


def coasting_turns_inside(case: Case) -> Answer:
    """Wherever a brake turns, up to the apex, it has no more energy than friction takes before the bottom."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        facts.claim("apex", law.top, law.home.apex)
        x = facts.real("x", case.law.bottom, law.home.apex)
        squeezed = facts.greater(x, 0.0)
        facts.claim("turned", law.box.friction_low * (x - law.bottom), 0.5 * law.box.spring_high * squeezed * squeezed)

    return prove(statement)


def lagging_window_is_kept(case: Case) -> Answer:
    """The window's conditions hold for the weakest and the strongest motor, any lag and any current that may flow.

    Of e = v + m τ (i + I) and of y = v + m τ i, or homeward −v + τ (q − m i), after the sample; see the document.
    """
    return together(prove(lambda facts, part=part: _lagging(facts, case, part)) for part in range(4))  # type: ignore[misc]


def _lagging(facts: Facts, case: Case, part: int) -> None:
    """For the upper end with the weakest (0) and strongest motor (1), and the lower end (2, 3), mirrored."""
    law = lifted_law(facts, case.law)
    xl, xh, low, high = any_box(facts, case)
    fastest = case.bench.limits.velocity + law.velocity_noise
    facts.at_least(low, -fastest)
    facts.at_least(fastest, high)
    flowing = facts.real("flowing", -law.current, law.current)
    asked: list[tuple[Real, ...]] = []
    ends: list[Real] = []
    plain = facts.lift(_lagging_current, stoppable=facts.stand_in(-1.0, asked))

    def watched(*args: Any) -> Any:
        ends.append(plain(*args) if len(ends) == part else facts.constant(FAR))
        return ends[-1]

    window = facts.lift(_lagging_window, _flowing=lambda *_: flowing, _lagging_current=watched)
    lowest, highest = window(law, xl, xh, low, high, None)
    up = part < 2
    box = law.box
    motor, braking = (box.motor_low, box.braking) if part in (0, 2) else (box.motor_high, box.braking_high)
    end, limit = (highest, law.outward_speed) if up else (-lowest, law.homeward_speed)
    vl, vh = (low, high) if up else (-high, -low)
    allowed, room, stopping, counted, _ = asked[0]
    v = facts.real("v", vl, vh)
    current = facts.real("current", -law.current, flowing)
    lag = facts.real("lag", 0.0, law.delay.lag)
    u = facts.real("u", -law.current, law.current)
    soft = law.box.spring_low * facts.greater(xl - law.reach, 0.0)
    stiff = law.box.spring_high * facts.greater(xh + law.reach, 0.0)
    away = v - law.change
    resisted = law.box.friction_low + law.box.viscous_low * away
    if away <= 0.0:
        resisted = -law.box.friction_high + law.box.viscous_high * away
    gained = law.sample_time * (motor * u - resisted - (soft if up else -stiff))
    if end > -law.current and u <= end:
        e = v + motor * lag * (current + law.current)
        facts.claim("speed that is asked for", stopping, e)
        facts.claim("room", (law.top - xh) if up else (xl - law.bottom), room)
        facts.claim("braking", braking + (law.box.spring_low * facts.greater(xl, 0.0) if up else 0.0), counted)
        facts.claim("can be stopped", allowed, e + gained)
        driven = facts.greater(stiff - law.box.friction_low, 0.0) if not up else 0.0
        facts.claim("speed", limit, v + lag * (motor * current + driven) + gained)


def motors_between_stop_too(case: Case) -> Answer:
    """A motion that both extreme motors can stop within a room can be stopped by each motor between.

    e and A go with m along straight lines, and e²/A is convex: with e = ρ A at both ends, what is missing in between is
    a product of what is not negative.
    """

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        share, helped = facts.real("share", 0.0, 1.0), facts.real("helped", 0.0)
        rest = 1.0 - share
        weak, strong = facts.real("weak", 0.0), facts.real("strong", 0.0)
        a, b = law.box.braking + helped, law.box.braking_high + helped
        between, mixed = rest * a + share * b, rest * a * weak + share * b * strong
        counted = rest * a * weak * weak + share * b * strong * strong
        missing = share * rest * a * b * (weak - strong) * (weak - strong)
        facts.claim("convex", between * counted, mixed * mixed + missing)
        facts.claim("convex", mixed * mixed + missing, between * counted)
        facts.claim("motor", law.box.motor_high, law.box.motor_low)
        facts.claim("not negative", share * rest, 0.0)

    return prove(statement)


def flowing_is_bounded(case: Case) -> Answer:
    """No current flows beyond what the law assumes, with any lag, no matter which of the last commands were lost.

    Period by period: from a current within the bound of the period before to one within the next.
    """
    periods = range(PAST - 1, -1, -1)
    return together(prove(lambda facts, i=i: _flows(facts, case, i)) for i in periods)  # type: ignore[misc]


def _flows(facts: Facts, case: Case, i: int) -> None:
    law = lifted_law(facts, case.law)
    own = tuple(facts.real("own", -law.current, law.current) for _ in range(PAST))
    slowest = facts.real("slowest", -1e4, 1e4)

    def bound(periods: range) -> Real:
        """State of the law's loop after these periods."""
        return facts.lift(_flowing, range=lambda *_: periods)(law, own, slowest, 1.0)

    flowing = bound(range(PAST - 1, i, -1))
    current = facts.real("current", -law.current)
    facts.at_least(flowing, current)
    v = facts.real("v", slowest - (i + 1) * law.change)
    braked = facts.lift(damped_current)(v, law.current, law.damping_velocity)
    command = facts.real("command", -law.current, facts.greater(own[i], braked))
    kept = facts.real("kept", 0.0, law.delay.kept)  # grows with the lag
    facts.claim("flowing", bound(range(PAST - 1, i - 1, -1)), command + kept * (current - command))


def lagging_stop_stays(case: Case) -> Answer:
    """Along the flow of a stop with a lag x + P(e) falls, for every motor, while the brake moves on: v ≤ e."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        motor = facts.real("motor", law.box.motor_low, law.box.motor_high)
        friction = law.box.friction_low + facts.real("spring", 0.0, law.box.spring_low * case.bench.limits.angle[1])
        current = facts.real("current", -law.current, law.current)
        lag = facts.real("lag", 0.0, law.delay.lag)
        v = facts.real("v", 0.0, law.outward_speed)
        e = v + motor * lag * (current + law.current)
        facts.claim("behind", e, v)
        command = facts.smaller(law.current, law.current * v / law.damping_velocity)
        a = motor * law.current + friction
        steepness = e if e >= law.damping_velocity else law.damping_velocity
        half = 0.5 * law.sample_time
        facts.claim("falls", (steepness + half * a) * (motor * command + friction), v * a)

    return prove(statement)


def observer_is_bounded(case: Case) -> Answer:
    """The change that an observer does not show yet lies within what is assumed, whichever commands were lost.

    Period by period no acceleration is beyond the assumed one; and then the sum, with any share of each period up to
    the law's, and any rest: of what acted before, and of what overshoots.
    """
    sides = [(end, age) for end in (0, 1) for age in range(case.law.age_high + 1)]
    parts = [(end, age, i) for end, age in sides for i in range(PAST - age)]
    accelerations = (prove(lambda facts, p=part: _accelerates(facts, case, *p)) for part in parts)  # type: ignore[misc]
    return together((*accelerations, *(prove(lambda facts, s=s: _sums_up(facts, case, *s)) for s in sides)))  # type: ignore[misc]


def _observed(
    facts: Facts, case: Case, age: int, asked: Any, own: tuple[Real, ...], shown: Real
) -> tuple[Any, tuple[Real, Real], Real, Real]:
    """The law; least and greatest change by its :func:`_unseen`; least and greatest angle of the measurement."""
    law = lifted_law(facts, case.law)
    x = facts.real("angle", case.bottom, case.top)
    xl, xh = x - law.angle_noise, x + law.angle_noise
    run = facts.lift(_unseen, _accelerated=asked)
    vl, vh = shown - law.velocity_noise, shown + law.velocity_noise
    return law, run(law, xl, xh, vl, vh, own, age)[:2], xl, xh


def _accelerates(facts: Facts, case: Case, end: int, age: int, i: int) -> None:
    """Acceleration within the i-th period before the measurement, upwards (0) or downwards (1)."""
    plain = facts.lift(_accelerated)
    bounds: list[tuple[Real, ...]] = []

    def watched(*args: Any) -> tuple[Real, ...]:
        """Only the bounds of one period are examined, the others take no paths."""
        bounds.append(plain(*args) if len(bounds) == i else (facts.constant(0.0),) * 4)
        return bounds[-1]

    own = tuple(facts.real("own", -case.law.current, case.law.current) for _ in range(PAST))
    shown = facts.real("shown", -1e4, 1e4)
    law, _, xl, xh = _observed(facts, case, age, watched, own, shown)
    away = law.velocity_noise + (_total(case, 0) + i + 1) * law.change
    v, begun = facts.real("v", shown - away, shown + away), facts.real("begun", shown - away, shown + away)
    x = facts.real("x", xl - (i + 1) * law.reach, xh + (i + 1) * law.reach)
    motor = facts.real("motor", law.box.motor_low, law.box.motor_high)
    spring = facts.real("spring", law.box.spring_low, law.box.spring_high)
    viscous = facts.real("viscous", law.box.viscous_low, law.box.viscous_high)
    braked = facts.lift(damped_current)(begun, law.current, law.damping_velocity)
    current = facts.real("current", facts.smaller(own[age + i], braked), facts.greater(own[age + i], braked))
    friction = facts.real("friction", -law.box.friction_high, law.box.friction_high)
    if v > 0.0:
        facts.at_least(friction, law.box.friction_low)
    elif v < 0.0:
        facts.at_least(-law.box.friction_low, friction)
    a = motor * current - spring * facts.greater(x, 0.0) - friction - viscous * v
    down, up, _, _ = bounds[i]
    facts.claim("acceleration", down if end else up, -a if end else a)


def _total(case: Case, periods: int) -> float:
    """Samples by which an observer lags for what acted more than so many samples ago, and overshoots."""
    scaled = case.law.delay.observer
    return (2.0 + scaled * periods) * math.exp(-scaled * periods) / scaled + OVERSHOOT / min(scaled, 1.5)


def _sums_up(facts: Facts, case: Case, end: int, age: int) -> None:
    bounds: list[Term] = []

    def any_bound(*_: Any) -> tuple[Term, ...]:
        """Any number at the end that is examined."""
        bounds.append(facts.real("any", -1e6))
        nothing = facts.constant(0.0)
        return (bounds[-1], nothing, nothing, nothing) if end else (nothing, bounds[-1], nothing, nothing)

    own = tuple(facts.real("own", -case.law.current, case.law.current) for _ in range(PAST))
    law, changes, _, _ = _observed(facts, case, age, any_bound, own, facts.real("shown", -1e4, 1e4))
    rest = _total(case, PAST - age) * law.change
    total = facts.real("rest", -rest, rest)
    for i in range(PAST - age):
        facts.at_least(case.law.change / case.law.sample_time, bounds[i])
        a = facts.real("a", None, bounds[i])
        share = law.sample_time * (_total(case, i) - _total(case, i + 1))
        total += facts.real("share", 0.0, share) * a
    facts.claim("change", (-changes[0] if end else changes[1]) + 1e-9, total)
