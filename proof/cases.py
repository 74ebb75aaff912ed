"""Subject of the lemmas: one bench, its law, and the numbers of the safe set that the law must keep a brake in.

The safe set is made of a *reserve*: an upper bound of the way to a stop from a speed v, when full braking takes
a = braking + help of the spring, and the damped stop brakes fully above V = ``damping_velocity`` only:

    P(a, v) = (v + V) t_s/2 + (v² + V²)/2a above V,    v t_s + v V/a below.

That is the envelope's v²/2a + v t_s/2, and at most V²/2a + V t_s/2 more. Below V it is straight: the damped stop
without friction takes 1/c of way per speed, c = k_m I/(J V), and friction only helps.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import Bench
from emb_runtime.safety.shield_design import ANGLE_PAD, ShieldLaw, make_law
from proof.terms import Real


class Case(NamedTuple):
    """Bench, law and safe set of the lemmas."""

    bench: Bench
    law: ShieldLaw
    rounding: float
    """A command that arrives lies within this of the one that was computed: half a step of its signal [A]."""

    @property
    def top(self) -> float:
        """End of a stop going up [rad]."""
        return self.bench.limits.angle[1] - ANGLE_PAD

    @property
    def bottom(self) -> float:
        """End of a stop going down [rad]."""
        return self.bench.limits.angle[0] + ANGLE_PAD

    @property
    def coulomb(self) -> float:
        """Greatest T_c / J: forward Euler is of the thesis's brake, and has no other friction [rad/s²]."""
        shield = self.bench.shield
        more = shield.break_away > 1.0 or shield.f_l > 0.0
        return float(self.bounds()["friction"][1]) if more else self.law.box.friction_high

    def bounds(self) -> dict[str, tuple[Fraction, Fraction]]:
        """Torques over the inertia of every brake of the bench's set, exactly: motor, spring, friction, viscous."""
        box = self.bench.range_set(self.bench.shield.ranges)
        low = {name: Fraction(value) for name, value in box.low._asdict().items()}
        high = {name: Fraction(value) for name, value in box.high._asdict().items()}
        torque = {"motor": "k_m", "friction": "T_c", "viscous": "f_v"}
        found = {name: (low[p] / high["J"], high[p] / low["J"]) for name, p in torque.items()}
        spring = low["gamma"] * low["k_1"] / high["J"], high["gamma"] * high["k_1"] / low["J"]
        return {**found, "spring": spring}


def case_of(bench: Bench) -> Case:
    """Returns the case of a bench.

    Raises:
        BenchFileError: the law refuses the bench.
    """
    return Case(bench, make_law(bench), 0.5 * load_layout().command.signal("Current").factor)


def reserve(law: ShieldLaw, braking: Real, v: Real) -> Real:
    """P(a, v), v ≥ 0 [rad]."""
    limit = law.damping_velocity
    way = (v * v + limit * limit) * 0.5 if v >= limit else v * limit
    sampled = v + limit if v >= limit else v + v
    return way / braking + 0.5 * law.sample_time * sampled
