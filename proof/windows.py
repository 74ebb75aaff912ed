"""Lemmas on the shield's ``window``: its currents keep the successor in the envelope, and there is one."""

from __future__ import annotations

from typing import Any

from emb_runtime.safety.shield import _highest_current, braking_window, successor
from emb_runtime.safety.shield_design import stoppable
from proof.cases import Case
from proof.successors import any_box
from proof.terms import Answer, Facts, Real, Term, lifted_law, prove, together


def window_is_kept(case: Case) -> Answer:
    """A current of the window leaves the successor box below what can be stopped, or it is full braking.

    ``stoppable`` may return any number here; the room, speed and braking that it is called with are checked.
    """
    return together(prove(lambda facts, end=end: _kept(facts, case, end)) for end in (0, 1))  # type: ignore[misc]


def _kept(facts: Facts, case: Case, end: int) -> None:
    """Statement for the upper (0) or the lower (1) end of the window; the other one takes no paths."""
    law = lifted_law(facts, case.law)
    xl, xh, vl, vh = any_box(facts, case)
    asked: list[tuple[Real, ...]] = []
    ends: list[Term] = []
    plain = facts.lift(_highest_current)

    def watched(*args: Any) -> Any:
        ends.append(plain(*args) if len(ends) == end else facts.constant(0.0))
        return ends[-1]

    window = facts.lift(braking_window, stoppable=facts.stand_in(-1.0, asked), _highest_current=watched)
    lowest, highest = window(law, xl, xh, vl, vh)
    allowed, room, speed, braking, sampled = asked[end]
    facts.claim("sampled", sampled, law.sample_time)
    u = facts.real("u", -law.current, law.current)
    _, _, next_vl, next_vh = facts.lift(successor)(law, xl, xh, vl, vh, u)
    if end == 0:
        facts.claim("upper room", law.top - xh, room)
        facts.claim("upper speed", speed, vh)
        facts.claim("upper braking", law.box.braking + law.box.spring_low * facts.greater(xl, 0.0), braking)
        facts.claim("highest is a current", highest, -law.current)
        if highest > -law.current and u <= highest:
            facts.claim("upper", facts.smaller(allowed, law.outward_speed), next_vh)
    else:
        facts.claim("lower room", xl - law.bottom, room)
        facts.claim("lower speed", speed, -vl)
        facts.claim("lower braking", law.box.braking, braking)
        facts.claim("lowest is a current", law.current, lowest)
        if lowest < law.current and u >= lowest:
            facts.claim("lower", facts.smaller(allowed, law.homeward_speed), -next_vl)


def stoppable_stops(case: Case) -> Answer:
    """Full braking from what :func:`emb_runtime.safety.shield_design.stoppable` allows ends within the room.

    Next speed V, at most what is allowed, and next angle, at most t_s max(v, V) further: V²/2a + V t_s/2 is left.
    """

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        low, high = case.bench.limits.angle
        room = facts.real("room", -5.0, high - low + 5.0)
        fastest = case.bench.limits.velocity + law.velocity_noise + (1.0 + law.age_high) * law.change
        v = facts.real("v", -fastest, fastest)
        braking = facts.real("braking", law.box.braking, law.box.braking + law.box.spring_low * (high + 1.0))
        ts = law.sample_time
        allowed = facts.lift(stoppable)(room, v, braking, ts)
        if allowed >= 0.0:
            after = facts.real("after", 0.0, allowed)
            left = room - ts * facts.greater(v, after)
            facts.claim("room for the stop", 2.0 * braking * left, after * after + braking * ts * after)

    return prove(statement)
