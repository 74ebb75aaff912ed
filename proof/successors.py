"""Lemmas on the shield's ``successor``: the box contains what any brake of the set does in one sample."""

from __future__ import annotations

from typing import Any

from emb_bench.brake.euler import step as euler_step
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.safety.shield import _moved, _rolled, fastest_next
from emb_runtime.safety.shield_design import VELOCITY_PAD, unseen
from proof.cases import Case
from proof.terms import Answer, Facts, Real, Term, lifted_law, prove, solver_module, together

AT_ONCE = 0.004
"""Share of the pad that grows with the time in a sample, for a command's rounding; the rest grows with its square."""
STEEPEST = 1e9  # Far beyond any acceleration: what falls faster is a jump [rad/s²]


def any_box(facts: Facts, case: Case) -> tuple[Term, Term, Term, Term]:
    """A box of states at the begin of a period, whatever was measured and how long ago."""
    law = case.law
    low, high = case.bench.limits.angle
    widest = (1 + law.age_high) * law.reach
    fastest = case.bench.limits.velocity + law.velocity_noise + (1 + law.age_high) * law.change
    if law.delay.observer > 0.0:
        fastest += (2.0 / law.delay.observer + unseen(law.delay.observer, 0)) * law.change
    xl = facts.real("xl", low - widest, high + widest)
    xh = facts.real("xh", xl, high + widest)
    vl = facts.real("vl", -fastest, fastest)
    return xl, xh, vl, facts.real("vh", vl, fastest)


class Box:
    """A box of states with the current that acts, and what ``successor`` makes of it.

    Args:
        facts: of this path.
        case: what is proved for.
        sample_time: in place of the law's [s].
        only: 0 for the greatest velocity alone, 1 for the least: the other is then nothing, and takes no paths.
    """

    def __init__(self, facts: Facts, case: Case, sample_time: Real = None, only: int | None = None) -> None:
        plain = lifted_law(facts, case.law)
        self.law = plain if sample_time is None else plain._replace(sample_time=sample_time)
        self.xl, self.xh, self.vl, self.vh = any_box(facts, case)
        self.least = least = facts.real("least", -plain.current)
        self.most = most = facts.real("most", least, plain.current)
        self.u = facts.real("u", least, most)  # what acts lies in between; the same twice is one command
        self.drives: list[Term] = []
        straight = {} if sample_time is None else {"max": max}  # a path per branch: straight in the sample time
        fast = facts.lift(fastest_next, **straight)

        def watched(law: Any, vl: Real, vh: Real, drive: Term) -> Any:
            self.drives.append(drive)
            return fast(law, vl, vh, drive) if only in (None, len(self.drives) - 1) else facts.constant(0.0)

        run = facts.lift(_moved, fastest_next=watched)
        self.next_xl, self.next_xh, self.next_vl, self.next_vh = run(
            self.law, self.xl, self.xh, self.vl, self.vh, least, most
        )
        self.drive_high, self.drive_low = self.drives[0], -self.drives[1]


def drive_is_bounded(case: Case) -> Answer:
    """Motor and spring of any brake, at any angle within one sample, lie between what ``successor`` assumes."""

    def statement(facts: Facts) -> None:
        box = Box(facts, case)
        law = box.law
        x = facts.real("x", box.xl - law.reach, box.xh + law.reach)
        motor = facts.real("motor", law.box.motor_low, law.box.motor_high)
        spring = facts.real("spring", law.box.spring_low, law.box.spring_high)
        error = facts.real("error", -case.rounding, case.rounding)
        drive = motor * (box.u + error) - spring * facts.greater(x, 0.0)
        facts.claim("from above", box.drive_high + law.box.motor_high * case.rounding, drive)
        facts.claim("from below", drive, box.drive_low - law.box.motor_high * case.rounding)

    return prove(statement)


def _friction(facts: Facts, law: Any) -> tuple[Term, Term]:
    return (
        facts.real("friction", law.box.friction_low, law.box.friction_high),
        facts.real("viscous", law.box.viscous_low, law.box.viscous_high),
    )


def euler_is_contained(case: Case) -> Answer:
    """Forward Euler's next state of every brake lies in the box."""

    def statement(facts: Facts) -> None:
        box = Box(facts, case)
        law = box.law
        slack = law.box.motor_high * case.rounding
        drive = facts.real("drive", box.drive_low - slack, box.drive_high + slack)
        friction, viscous = _friction(facts, law)
        x = facts.real("x", box.xl, box.xh)
        v = facts.real("v", box.vl, box.vh)
        brake = BrakeParameters(J=1.0, gamma=1.0, k_m=1.0, k_1=0.0, T_c=friction, f_v=viscous)  # type: ignore[arg-type]
        x_next, v_next = facts.lift(euler_step)(brake, x, v, drive, law.sample_time)
        facts.claim("velocity from above", box.next_vh, v_next)
        facts.claim("velocity from below", v_next, box.next_vl)
        facts.claim("angle from above", box.next_xh, x_next)
        facts.claim("angle from below", x_next, box.next_xl)

    return prove(statement)


def flow_is_contained(case: Case) -> Answer:
    """The exact flow stays below a line that grows to the box's bound within the sample, and above its mirror image.

    The line is W(t) = ``successor`` with sample time t, its pad growing about with t². It begins above the flow, has no
    jump down, and at W and above the flow grows no faster than W: for v on any side of zero, and at rest, where
    friction holds as far as it can.
    """
    upper, lower = (lambda facts, side=side: _growth(facts, case, side) for side in (0, 1))
    return together(prove(part) for part in (upper, lower, lambda facts: _begin(facts, case)))


def _growth(facts: Facts, case: Case, side: int) -> None:
    z3 = solver_module()
    t = facts.real("t", 0.0, case.law.sample_time)
    box = Box(facts, case, sample_time=t, only=side)
    law = box.law
    friction, viscous = _friction(facts, law)
    line, drive = (-box.next_vl, -box.drive_low) if side else (box.next_vh, box.drive_high)
    ts = facts.constant(case.law.sample_time)
    line += facts.constant(-VELOCITY_PAD)
    drive += law.box.motor_high * case.rounding
    begin = Term(facts, z3.substitute(line.z, (t.z, z3.RealVal(0))))
    slope = Term(facts, z3.substitute(line.z, (t.z, z3.RealVal(1)))) - begin
    facts.claim("straight", begin + slope * t, line)
    facts.claim("straight", line, begin + slope * t)
    share = t / ts
    v = facts.real("v", line + grown(share))  # towards this side
    forward, backward = drive - friction, drive + friction
    moving = forward if v > 0.0 else backward
    if v == 0.0:  # at rest it goes where it is driven harder than friction holds
        moving = forward if forward > 0.0 else backward if backward < 0.0 else facts.constant(0.0)
    facts.claim("growth", slope + grown_rate(share) / ts, moving - viscous * v)


def grown(share: Real) -> Real:
    """Pad after that share of the sample [rad/s]."""
    return VELOCITY_PAD * share * (AT_ONCE + (1.0 - AT_ONCE) * share)


def grown_rate(share: Real) -> Real:
    """Rate at which the pad grows then [rad/s per sample]."""
    return VELOCITY_PAD * (AT_ONCE + 2.0 * (1.0 - AT_ONCE) * share)


def _begin(facts: Facts, case: Case) -> None:
    box = Box(facts, case, sample_time=facts.constant(0.0))
    facts.claim("begin above", box.next_vh - VELOCITY_PAD, box.vh)
    facts.claim("begin below", box.vl, box.next_vl + VELOCITY_PAD)
    early = facts.real("early", 0.0, case.law.sample_time)
    late = facts.real("late", early, case.law.sample_time)
    drive = box.drive_high
    first, second = (
        facts.lift(fastest_next)(box.law._replace(sample_time=t), box.vl, box.vh, drive) for t in (early, late)
    )
    facts.claim("no jump down", second, first - STEEPEST * (late - early))


def angles_are_contained(case: Case) -> Answer:
    """Within a sample no velocity of the flow is beyond the box's or the one before, so neither is the angle."""
    return together(prove(lambda facts, side=side: _angle(facts, case, side)) for side in (0, 1))  # type: ignore[misc]


def _angle(facts: Facts, case: Case, side: int) -> None:
    ts = case.law.sample_time
    t = facts.real("t", 0.0, ts)
    part = Box(facts, case, sample_time=t, only=side)
    law = lifted_law(facts, case.law)
    xl, xh, vl, vh = facts.lift(_moved)(law, part.xl, part.xh, part.vl, part.vh, part.least, part.most)
    unused = VELOCITY_PAD - grown(t / facts.constant(ts))
    if side == 0:
        fastest = facts.greater(part.vh, vh)
        facts.claim("velocity from above", fastest, part.next_vh - unused)
        facts.claim("angle from above", xh, part.xh + ts * fastest)
    else:
        slowest = facts.smaller(part.vl, vl)
        facts.claim("velocity from below", part.next_vl + unused, slowest)
        facts.claim("angle from below", part.xl + ts * slowest, xl)


def lost_commands_are_contained(case: Case) -> Answer:
    """The node's damped stop, for any velocity within one sample of the box's, lies between the currents assumed."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)._replace(age_low=1, age_high=1)
        measured = facts.real("velocity")
        seen: list[tuple[Real, Real]] = []

        def watched(_law: Any, xl: Real, xh: Real, _vl: Real, _vh: Real, least: Real, most: Real) -> tuple[Real, ...]:
            seen.append((least, most))
            return xl, xh, xl, xh

        own = facts.real("own", -law.current, law.current)
        roll = facts.lift(_rolled, _moved=watched, _unseen=lambda *_: (0.0,) * 4)  # an observer widens the box
        roll(law, facts.real("angle"), measured, (own, 0.0, 0.0, 0.0, 0.0), 1)
        (least, most), _ = seen
        room = law.velocity_noise + law.change
        v = facts.real("v", measured - room, measured + room)
        stop = -law.current * v / law.damping_velocity
        braked = facts.greater(facts.smaller(stop, law.current), -law.current)
        if case.bench.node.stop == "freewheel":
            braked = facts.constant(0.0)
        for label, acting in (("own", own), ("braked", braked)):
            facts.claim(f"{label} from above", most, acting)
            facts.claim(f"{label} from below", acting, least)

    return prove(statement)


def change_is_bounded(case: Case) -> Answer:
    """In one sample no velocity changes by more than the law's ``change``: no torque is greater."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        fastest = case.bench.limits.velocity
        highest = law.home.apex if case.law.coasting else case.top
        motor = facts.real("motor", law.box.motor_low, law.box.motor_high)
        spring = facts.real("spring", law.box.spring_low, law.box.spring_high)
        friction, viscous = _friction(facts, law)
        drive = motor * facts.real("u", -law.current, law.current)
        drive -= spring * facts.greater(facts.real("x", case.bottom, highest), 0.0)
        drive -= viscous * facts.real("v", -fastest, fastest)
        facts.claim("up", law.change, law.sample_time * (drive + friction))
        facts.claim("down", law.sample_time * (drive - friction), -law.change)

    return prove(statement)
