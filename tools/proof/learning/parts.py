"""Lemmas on switching laws: what holds for the law of the whole set holds for that of any part of it (M1 to M3).

The law of a part is one whose bounds are unknowns within those of the whole set, and a brake is any brake of the part.
The safe set of one brake is that of its own law: see :mod:`tools.proof.safety`.
"""

from __future__ import annotations

from typing import Any

from emb_bench.brake.euler import step as euler_step
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.learning.assumptions import EXACT
from emb_runtime.learning.law import COVERED
from emb_runtime.safety.shield import fastest_next
from emb_runtime.safety.shield_design import VELOCITY_PAD, damped_excess, stoppable
from tools.proof import safety, successors, windows
from tools.proof.boxes import Covered, Slack, cover
from tools.proof.cases import ONE, PART, Case, law_terms, law_within
from tools.proof.exhaustive import MOST, interval_law
from tools.proof.intervals import Boxes
from tools.proof.terms import Answer, Facts, Real, Term, lifted_law, prove, solver_module, together

SAME = 1e-6  # Within this of the bound, two ways count as the same [rad]; a five thousandth of ``ANGLE_PAD``


def of_part(case: Case) -> Case:
    """Case of the law of any part of the set."""
    return case._replace(brakes=PART)


def of_one(case: Case) -> Case:
    """Case of the law of any one brake."""
    return case._replace(brakes=ONE)


def envelopes_grow(case: Case) -> Answer:
    """A part's envelope contains the whole's: it brakes at least as much, and may come home at least as fast (M1)."""

    def statement(facts: Facts) -> None:
        outer = law_within(facts, case, lifted_law(facts, case.law), one=False)
        inner = law_within(facts, case, outer, one=False)
        facts.claim("braking", inner.braking, outer.braking)
        facts.claim("spring", inner.spring_low, outer.spring_low)

    def homeward(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        weaker = facts.real("weaker", law.braking)
        stronger = facts.real("stronger", weaker)
        fast = facts.lift(stoppable)
        stops = [fast(-law.bottom, facts.constant(0.0), a, law.sample_time) for a in (weaker, stronger)]
        facts.claim("homeward", stops[1], stops[0])

    return together(prove(part) for part in (statement, homeward))


def one_margin_serves(case: Case) -> Covered:
    """No brake of the set needs more beyond its envelope than the margin of the whole set (M2); the slack is a way."""
    law = case.law

    def statement(boxes: Boxes) -> Slack:
        exact = interval_law(boxes, law)
        excess = boxes.lift(damped_excess)
        whole = excess(exact.motor_low, exact.friction_low, exact.current, exact.damping_velocity, exact.sample_time)

        def slack(motor: Any, friction: Any) -> Any:
            one = excess(motor, friction, exact.current, exact.damping_velocity, exact.sample_time)
            return whole + SAME - one

        return slack

    region = {"motor": (law.motor_low, law.motor_high), "friction": (law.friction_low, law.friction_high)}
    return cover(statement, region, MOST)


def part_encloses_euler(case: Case) -> Answer:
    """The successor of a part's law contains forward Euler's map of each of its brakes, on either side (L1c).

    Here motor and spring are one number, ``drive``: L1b bounds it.
    """

    def statement(facts: Facts) -> None:
        law = law_terms(facts, of_part(case))
        vl, vh = _any_velocities(facts, case)
        drive = facts.real("drive")
        friction = facts.real("coulomb", law.friction_low, law.friction_high)
        viscous = facts.real("viscous", law.viscous_low, law.viscous_high)
        v = facts.real("v", vl, vh)
        brake = BrakeParameters(J=1.0, gamma=1.0, k_m=1.0, k_1=0.0, T_c=friction, f_v=viscous)  # type: ignore[arg-type]
        driven = drive + case.law.motor_high * case.rounding
        _, after = facts.lift(euler_step)(brake, facts.constant(0.0), v, driven, law.sample_time)
        facts.claim("velocity", facts.lift(fastest_next)(law, vl, vh, drive) + VELOCITY_PAD, after)

    return prove(statement)


def _any_velocities(facts: Facts, case: Case) -> tuple[Term, Term]:
    fastest = case.bench.limits.velocity + case.law.velocity_noise + case.law.change
    vl = facts.real("vl", -fastest, fastest)
    return vl, facts.real("vh", vl, fastest)


def part_encloses_flow(case: Case) -> Answer:
    """The flow grows no faster than the line of :func:`tools.proof.successors.flow_is_contained`, for a part's law.

    Neither is the line beyond the velocities from which the law takes the angles (L1d, L1e).

    Here motor and spring are one number, ``drive``: L1b bounds it. It slows the brake by at most full braking and the
    softest spring of the part, and that is what the part's viscous friction is cut to the pad for.
    """
    return together((prove(lambda facts: _grows(facts, case)), prove(lambda facts: _slowed(facts, case))))


def _grows(facts: Facts, case: Case) -> None:
    law = law_terms(facts, of_part(case))
    ts = facts.constant(case.law.sample_time)
    vl, vh = _any_velocities(facts, case)
    slowing = facts.real("slowing", 0.0)  # by motor and spring, at most
    drive = facts.real("drive", -slowing)
    squared = case.law.sample_time * case.law.sample_time
    least, most = law.viscous_low, law.viscous_high
    beside = law.friction_low + least * case.bench.limits.velocity
    facts.at_least(2.0 * COVERED * VELOCITY_PAD, squared * least * (slowing + beside))
    facts.at_least(2.0 * EXACT * VELOCITY_PAD, squared * most * (slowing - law.friction_high))  # see unmet_assumption
    share = facts.real("share", 0.0, 1.0)
    # A path per branch, so that on each the line is straight in the sample time.
    begun = facts.constant(0.0) + facts.lift(fastest_next, max=max)(law._replace(sample_time=ts * share), vl, vh, drive)
    z3 = solver_module()
    early, late = (Term(facts, z3.substitute(begun.z, (share.z, z3.RealVal(at)))) for at in (0, 1))
    facts.claim("straight", begun, early + share * (late - early))
    facts.claim("straight", early + share * (late - early), begun)
    facts.claim("angle", facts.greater(vh, late + VELOCITY_PAD), begun + successors.grown(share))
    facts.claim("begin", facts.lift(fastest_next)(law._replace(sample_time=facts.constant(0.0)), vl, vh, drive), vh)
    friction = facts.real("coulomb", law.friction_low, law.friction_high)
    viscous = facts.real("viscous", least, most)
    v = facts.real("v", begun + successors.grown(share))
    rounding = case.law.motor_high * case.rounding
    forward, backward = drive + rounding - friction, drive + rounding + friction
    moving = forward if v > 0.0 else backward
    if v == 0.0:
        moving = forward if forward > 0.0 else backward if backward < 0.0 else facts.constant(0.0)
    facts.claim("growth", late - early + successors.grown_rate(share), ts * (moving - viscous * v))


def _slowed(facts: Facts, case: Case) -> None:
    """The law of a part grants ``slowing`` and the two assumptions on it."""
    law = law_terms(facts, of_part(case))
    box = successors.Box(facts, of_part(case))
    farthest = case.bench.limits.angle[1]
    slowing = law.motor_low * law.current + law.spring_low * farthest
    facts.claim("towards home", box.drive_high, -slowing)
    facts.claim("outward", -box.drive_low, -slowing)
    squared = case.law.sample_time * case.law.sample_time
    least = law.viscous_low
    beside = law.friction_low + least * case.bench.limits.velocity
    facts.claim("pad forward", 2.0 * COVERED * VELOCITY_PAD, squared * least * (slowing + beside))
    facts.claim("pad backward", 2.0 * EXACT * VELOCITY_PAD, squared * law.viscous_high * (slowing - law.friction_high))


def part_window_is_kept(case: Case) -> Answer:
    """A current of a part's window leaves any box in the part's envelope, or brakes fully (L1b, L2)."""
    part, one = of_part(case), of_one(case)
    return together((successors.drive_is_bounded(part), windows.window_is_kept(part), windows.stoppable_stops(one)))


def one_envelope_is_safe(case: Case) -> Answer:
    """The envelope of one brake lies in its safe set, within the margin of the whole (L4b)."""
    return safety.envelope_is_safe(of_one(case))


def one_stop_keeps(case: Case) -> Answer:
    """Damped stop and full braking keep the safe set of one brake (L3, L5 but the next two)."""
    one = of_one(case)
    lemmas = (
        safety.damping_does_not_reverse,
        safety.braking_is_enough,
        safety.euler_stop_stays_above,
        safety.nothing_is_thrown_up,
        safety.flow_of_a_stop_stays,
        safety.entering_the_stroke,
        safety.speeds_stay,
        safety.rest_is_safe,
    )
    return together(lemma(one) for lemma in lemmas)


def one_stop_keeps_below(case: Case) -> Answer:
    """Stops keep it going down under Euler too, sign() and all (L5b)."""
    return safety.euler_stop_stays_below(of_one(case))


def one_flow_may_turn(case: Case) -> Answer:
    """A current that is held too long keeps it too (L5e)."""
    return safety.flow_may_turn(of_one(case))


def safe_set_holds_envelopes(case: Case) -> Answer:
    """The envelope of a part lies in that of each of its brakes (M3), so in its safe set."""

    def statement(facts: Facts) -> None:
        part = law_within(facts, case, lifted_law(facts, case.law), one=False)
        brake = law_within(facts, case, part, one=True)
        x, v = facts.real("x", case.bottom, case.top), facts.real("v", 0.0, part.outward_speed)
        squeezed = facts.greater(x, 0.0)
        ways = [_way(law, law.braking + law.spring_low * squeezed, v) for law in (part, brake)]
        facts.claim("above", ways[0], ways[1])
        ways = [_way(law, law.braking, v) for law in (part, brake)]
        facts.claim("below", ways[0], ways[1])
        facts.claim("homeward", brake.homeward_speed, part.homeward_speed)

    return prove(statement)


def _way(law: Any, braking: Real, v: Real) -> Real:
    return v * v * 0.5 / braking + 0.5 * law.sample_time * v
