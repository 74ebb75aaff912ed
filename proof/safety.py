"""Lemmas on the safe set: the envelope lies in it, and damped stop and full braking keep it.

A brake at angle x and velocity v is *safe* if v lies within the law's speed limits, and

- above: x + P(a, v) ≤ top where it moves up, a = braking + spring_low · max(x, 0), and x ≤ top where it does not;
- below, in the free stroke, x < 0: −x + P(braking, −v) ≤ −bottom where it moves down, and x ≥ bottom;

with top and bottom ``ANGLE_PAD`` inside the limits. Forward Euler's sign() throws a brake that comes
to rest to the other side by up to t_s T_c/J. Above, the spring is stronger than T_c and no brake is thrown up. In the
free stroke the set for Euler is therefore a little other, see :class:`Thrown`.
"""

from __future__ import annotations

from typing import Any

from emb_bench.brake.euler import step as euler_step
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.safety.shield import damped_current
from proof.cases import Case, reserve
from proof.terms import Answer, Facts, Real, Term, lifted_law, prove, together

FULL, DAMPED = "full braking", "damped stop"

ROUNDING = 1e-12
"""The law's floats are the nearest to sums and quotients: so much may a sample cost beyond; a billion, a mrad [rad]."""


def _euler_law(facts: Facts, case: Case) -> Any:
    """The law of brakes as forward Euler's are: the thesis's, with no friction beyond T_c."""
    law = lifted_law(facts, case.law)
    return law._replace(box=law.box._replace(friction_high=facts.constant(case.coulomb)))


def _braking_current(facts: Facts, law: Any, v: Term, how: str) -> Real:
    """Braking current: full braking against the motion, or what the node does [A]."""
    if how == DAMPED:
        return facts.lift(damped_current)(v, law.current, law.damping_velocity)
    return -law.current if v > 0.0 else law.current


def _least_brake(facts: Facts, law: Any, speed: Term) -> Real:
    """Least deceleration by the damped stop of the weakest motor at that speed [rad/s²]."""
    return law.box.motor_low * facts.smaller(law.current, law.current * speed / law.damping_velocity)


def set_is_covered(case: Case) -> Answer:
    """Every brake of the bench's set lies within the law's bounds, to 1e-12 of them."""

    def statement(facts: Facts) -> None:
        for name, (low, high) in case.bounds().items():
            given_low, given_high = getattr(case.law.box, f"{name}_low"), getattr(case.law.box, f"{name}_high")
            facts.claim(f"{name} low", facts.constant(low), facts.constant(given_low) * facts.constant(1.0 - 1e-12))
            facts.claim(f"{name} high", facts.constant(given_high) * facts.constant(1.0 + 1e-12), facts.constant(high))

    return prove(statement)


def envelope_is_safe(case: Case) -> Answer:
    """A state that can be stopped by the envelope's count is safe, and the margin covers the difference.

    The envelope counts the spring at the angle before the sample. A brake that went down before the sample may be up to
    one sample's way lower, and then it is slow.
    """

    def above(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        v = facts.real("v", 0.0, law.outward_speed)
        turned = law.sample_time * (law.box.motor_high * law.current + law.box.friction_high)
        now = facts.real("now", law.box.braking)
        counted = facts.real("counted", now, now + (law.box.spring_high * law.reach if v <= turned else 0.0))
        facts.claim("above", case.top - law.top, reserve(law, now, v) - _counted_way(law, counted, v))

    def below(facts: Facts, euler: bool) -> None:
        law = _euler_law(facts, case)
        down = facts.real("down", 0.0, law.homeward_speed)
        way = Thrown(facts, law).down(down) if euler else reserve(law, law.box.braking, down)
        facts.claim("below", law.bottom - case.bottom, way - _counted_way(law, law.box.braking, down))

    def moving_up(facts: Facts) -> None:
        law = _euler_law(facts, case)
        up = Thrown(facts, law).up(facts.real("up", 0.0, law.outward_speed))
        facts.claim("below, moving up", law.bottom - case.bottom, up)

    parts = (above, lambda f: below(f, False), lambda f: below(f, True), moving_up)
    return together(prove(part) for part in parts)


def _counted_way(law: Any, braking: Real, v: Real) -> Real:
    """Way of full braking from a speed v ≥ 0, as the envelope counts it [rad]."""
    return v * v * 0.5 / braking + 0.5 * law.sample_time * v


def braking_is_enough(case: Case) -> Answer:
    """Damped stop and full braking slow every brake, under Euler, at least as the weakest motor and friction do."""

    def statement(facts: Facts) -> None:
        for how in (FULL, DAMPED):
            law = lifted_law(facts, case.law)
            brake, x = _any_brake(facts, law), facts.real("x", case.bottom, case.top)
            v = facts.real("v", -law.homeward_speed, law.outward_speed)
            if v == 0.0:
                continue
            u = _braking_current(facts, law, v, how)
            _, after = facts.lift(euler_step)(brake, x, v, u, law.sample_time)
            squeezed = facts.greater(x, 0.0)
            if v > 0.0:
                least = _least_brake(facts, law, v) + law.box.friction_low + law.box.spring_low * squeezed
                facts.claim(f"{how} up", v - law.sample_time * least, after)
            else:
                least = _least_brake(facts, law, -v) + law.box.friction_low - law.box.spring_high * squeezed
                facts.claim(f"{how} down", after, v + law.sample_time * least)

    return prove(statement)


def _any_brake(facts: Facts, law: Any) -> BrakeParameters:
    names = {"k_m": "motor", "k_1": "spring", "T_c": "friction", "f_v": "viscous"}
    values = {p: facts.real(n, getattr(law.box, f"{n}_low"), getattr(law.box, f"{n}_high")) for p, n in names.items()}
    return BrakeParameters(J=1.0, gamma=1.0, **values)  # type: ignore[arg-type]


def euler_stop_stays_above(case: Case) -> Answer:
    """A sample of the slowest stop takes at least as much of the reserve as it goes: x + P does not grow, going up."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        helped = facts.real("spring", 0.0, law.box.spring_low * case.bench.limits.angle[1])
        a = law.box.braking + helped
        v = facts.real("v", 0.0, law.outward_speed)
        after = v - law.sample_time * (_least_brake(facts, law, v) + law.box.friction_low + helped)
        left = reserve(law, a, after) if after > 0.0 else facts.constant(0.0)
        facts.claim("reserve", reserve(law, a, v) + ROUNDING, law.sample_time * v + left)
        stronger = facts.real("stronger", a)  # the angle has grown, so has the spring
        facts.claim("grows with the spring", reserve(law, a, v), reserve(law, stronger, v))
        faster = facts.real("faster", v)
        facts.claim("grows with the speed", reserve(law, a, faster), reserve(law, a, v))

    return prove(statement)


def flow_of_a_stop_stays(case: Case) -> Answer:
    """Along the exact flow of the slowest stop x + P falls, while the brake moves towards either limit.

    The current may be held since the begin of the period: it was no smaller then.
    """

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        helped = facts.real("spring", 0.0, law.box.spring_low * case.bench.limits.angle[1])
        a = law.box.braking + helped
        v = facts.real("v", 0.0, law.outward_speed)
        slowing = _least_brake(facts, law, v) + law.box.friction_low + helped
        steepness = facts.greater(v, 0.0) / a if v >= law.damping_velocity else law.damping_velocity / a
        facts.claim("falls", (steepness + 0.5 * law.sample_time) * slowing, v)

    return prove(statement)


class Thrown:
    """The reserve for forward Euler in the free stroke, for one brake and its damped stop.

    w = t_s T_c/J throws it, r = 1 − t_s (c + f_v/J) is what a sample of damping leaves of a speed. From a speed v down
    it may go on by P(max(v, w/(1+r))): to and fro it goes between ± w/(1+r). From a speed δ up it is thrown down by at
    most w − r δ if that is positive, and otherwise by at most w, later.

    Args:
        facts: of this path.
        law: of the set of brakes that it is one of.
    """

    def __init__(self, facts: Facts, law: Any) -> None:
        self.law = law
        self.motor: Real = facts.real("motor", law.box.motor_low, law.box.motor_high)
        self.friction: Real = facts.real("friction", law.box.friction_low, law.box.friction_high)
        self.viscous: Real = facts.real("viscous", law.box.viscous_low, law.box.viscous_high)
        facts.assume(self.r.z >= 0)  # a lemma of its own
        self.turning = self.w / (1.0 + self.r)

    @property
    def w(self) -> Real:
        """Change of speed by friction [rad/s]."""
        return self.law.sample_time * self.friction

    @property
    def r(self) -> Real:
        """Share of a speed that is left after one sample of damping."""
        slope = self.motor * self.law.current / self.law.damping_velocity + self.viscous
        return 1.0 - self.law.sample_time * slope

    def down(self, v: Real) -> Real:
        """Reserve from a speed down, v ≥ 0 [rad]."""
        return reserve(self.law, self.law.box.braking, self.turning if v <= self.turning else v)

    def up(self, v: Real) -> Real:
        """Reserve from a speed up, v ≥ 0; may be negative [rad]."""
        thrown = self.w - self.r * v
        landing = self.down(thrown) if thrown > 0.0 else reserve(self.law, self.law.box.braking, self.w)
        return landing - self.law.sample_time * v

    def damped(self, v: Real) -> Real:
        """Velocity after one Euler sample of the damped stop, v from 0 to where it brakes fully [rad/s]."""
        return self.r * v - self.w

    def after(self, v: Real) -> Real:
        """Velocity after one Euler sample of full braking, v > 0 [rad/s]."""
        return v - self.law.sample_time * (self.motor * self.law.current + self.friction + self.viscous * v)


def euler_stop_stays_below(case: Case) -> Answer:
    """A sample of a stop in the free stroke takes at least as much of the reserve as it goes down.

    Euler's sign() may throw the brake to and fro there.
    """
    return together(prove(lambda facts, part=part: part(facts, case)) for part in _BELOW)  # type: ignore[misc]


def _damped_down(facts: Facts, case: Case) -> None:
    law = _euler_law(facts, case)
    brake = Thrown(facts, law)
    v = facts.real("v", 0.0, law.damping_velocity)
    after = brake.damped(v)
    left = brake.down(after) if after > 0.0 else brake.up(-after)
    facts.claim("damped stop down", brake.down(v), law.sample_time * v + left)


def _damped_up(facts: Facts, case: Case) -> None:
    law = _euler_law(facts, case)
    brake = Thrown(facts, law)
    v = facts.real("v", 0.0, law.damping_velocity)
    after = brake.damped(v)
    left = brake.up(after) if after > 0.0 else brake.down(-after)
    facts.claim("damped stop up", brake.up(v), left - law.sample_time * v)


def _full_down(facts: Facts, case: Case) -> None:
    law = _euler_law(facts, case)
    brake = Thrown(facts, law)
    v = facts.real("v", 0.0, law.homeward_speed)
    after = brake.after(v)
    left = brake.down(after) if after > 0.0 else brake.up(-after)
    facts.claim("full braking down", brake.down(v) + ROUNDING, law.sample_time * v + left)


def _damped_fast_up(facts: Facts, case: Case) -> None:
    law = _euler_law(facts, case)
    brake = Thrown(facts, law)
    v = facts.real("v", law.damping_velocity, law.outward_speed)
    after = brake.after(v)
    left = brake.up(after) if after > 0.0 else brake.down(-after)
    facts.claim("damped stop up", brake.up(v), left - law.sample_time * v)


def _full_up(facts: Facts, case: Case) -> None:
    """Full braking of a fall that is none: it drives the brake up."""
    law = _euler_law(facts, case)
    brake = Thrown(facts, law)
    v = facts.real("v", 0.0, law.outward_speed)
    after = v + law.sample_time * (brake.motor * law.current - brake.friction - brake.viscous * v)
    facts.claim("away", after, 0.0)
    facts.claim("full braking up", brake.up(v), brake.up(after) - law.sample_time * v)


_BELOW = (_damped_down, _damped_up, _full_down, _damped_fast_up, _full_up)


def damping_does_not_reverse(case: Case) -> Answer:
    """One sample of damping takes less than the whole speed, of any brake: with r below 0 it would throw it back."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        slope = law.box.motor_high * law.current / law.damping_velocity + law.box.viscous_high
        facts.claim("r", 1.0, law.sample_time * slope)

    return prove(statement)


def nothing_is_thrown_up(case: Case) -> Answer:
    """Under Euler a brake that does not move up goes on so near the top, or is too slow to get there.

    In the flow it is only a held current that turns it around, see the next lemma, and full braking turns none up.
    """

    def euler(facts: Facts, how: str) -> None:
        law = _euler_law(facts, case)
        brake, x = _any_brake(facts, law), facts.real("x", case.bottom, case.top)
        v = facts.real("v", -law.homeward_speed, 0.0)
        u = facts.lift(damped_current)(v, law.current, law.damping_velocity) if how == DAMPED else -law.current
        x_after, after = facts.lift(euler_step)(brake, x, v, u, law.sample_time)
        if after > 0.0:
            facts.claim(f"{how} thrown up", case.top, x_after + reserve(law, law.box.braking, after))

    def flow(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        facts.claim("motor above friction", law.box.motor_low * law.current, law.box.friction_high)

    return together(prove(part) for part in (lambda f: euler(f, DAMPED), lambda f: euler(f, FULL), flow))


def flow_may_turn(case: Case) -> Answer:
    """A damped current that is held turns a slow motion around within the sample, by less than it had gone.

    δ away from a limit stops not before τ = δ/((c + f_v/J) δ + friction), has then gone δ τ/2 at least, and comes back
    with c δ − friction at most. A spring lets it go on for longer, and come back less.
    """

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        brake = Thrown(facts, law)
        up = facts.real("up", 0.0, law.damping_velocity)
        if up > 0.0:
            held = brake.motor * law.current / law.damping_velocity * up
            stopped = Term(facts, (up / (held + brake.viscous * up + brake.friction)).z)  # an unknown of its own
            rest, fall = law.sample_time - stopped, held - brake.friction
            if rest > 0.0 and fall > 0.0:
                after = fall * rest
                claimed = 0.5 * after * rest + reserve(law, law.box.braking, after)
                facts.claim("turned", 0.5 * up * stopped, claimed)

    return prove(statement)


def entering_the_stroke(case: Case) -> Answer:
    """A brake that leaves contact at a permitted speed can be stopped in the free stroke."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        # Where it moved up before.
        turned = law.sample_time * (law.box.motor_high * law.current + law.box.friction_high)
        fastest = facts.greater(law.homeward_speed, turned) + law.sample_time * law.box.spring_high * law.reach
        facts.claim("stop", -case.bottom, reserve(law, law.box.braking, fastest) + law.sample_time * fastest)

    return prove(statement)


def speeds_stay(case: Case) -> Answer:
    """Damped stop and full braking let no brake pass the law's speeds, whatever the spring does."""

    def euler(facts: Facts, how: str) -> None:
        law = lifted_law(facts, case.law)
        brake, x = _any_brake(facts, law), facts.real("x", case.bottom, case.top)
        v = facts.real("v", -law.homeward_speed, law.outward_speed)
        u = _braking_current(facts, law, v, how)
        _, after = facts.lift(euler_step)(brake, x, v, u, law.sample_time)
        facts.claim(f"{how} homeward", after, -law.homeward_speed)
        facts.claim(f"{how} outward", law.outward_speed, after)

    def flow(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        home = law.homeward_speed
        change = law.box.motor_high * law.current + law.box.friction_high + law.box.spring_high * case.top
        begun = home - law.sample_time * (change + law.box.viscous_high * home)
        slowing = _least_brake(facts, law, begun) + law.box.friction_low + law.box.viscous_low * home
        facts.claim("flow homeward", slowing, law.box.spring_high * case.top)

    return together(prove(part) for part in (lambda f: euler(f, DAMPED), lambda f: euler(f, FULL), flow))


def rest_is_safe(case: Case) -> Answer:
    """A brake at rest at the origin is safe, and the safe set lies within the limits."""

    def statement(facts: Facts) -> None:
        law = lifted_law(facts, case.law)
        limits = case.bench.limits
        facts.claim("above", case.top, 0.0)
        facts.claim("below", -case.bottom, facts.greater(Thrown(facts, law).down(facts.constant(0.0)), 0.0))
        facts.claim("top", limits.angle[1], facts.constant(case.top))
        facts.claim("bottom", facts.constant(case.bottom), limits.angle[0])
        facts.claim("out", limits.velocity, law.outward_speed)
        facts.claim("home", limits.velocity, law.homeward_speed)

    return prove(statement)
