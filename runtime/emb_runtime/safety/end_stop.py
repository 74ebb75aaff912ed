"""End-stop speed of a brake when the commands stop coming at the worst moment."""

from __future__ import annotations

import math

from emb_runtime.config.bench import Bench
from emb_runtime.safety.shield_design import ShieldLaw, make_law

ANGLES = 110  # Angles at which a run may be let go
STEP = 0.25  # Step of the integration along the way [rad]


def end_stop_speed(bench: Bench) -> float:
    """The worst end-stop speed that a loss of all commands may give, for any brake of the shield's set [rad/s].

    A node that brakes, and an envelope made for coasting, stop every brake before: 0 then, as argued in
    ``docs/explanation/shield.md``. A node that lets go inside the braking envelope leaves the brake to spring and
    friction. From ``ANGLES`` angles on the border of that envelope, the speed is integrated along the way to either
    stop, with the least friction, and with the spring that makes it worst: the stiffest on the way home, the softest on
    the way up.
    A computed worst case on that grid, in steps that leave friction out rather than in on the way home.
    """
    law = make_law(bench)
    if bench.node.stop == "damped" or law.coasting:
        return 0.0
    low, high = bench.limits.angle
    pushed = law.lag * law.motor_high * law.current  # by a current that is still there
    worst = 0.0
    for i in range(ANGLES + 1):
        x = low + (high - low) * i / ANGLES
        braking = law.braking + law.spring_low * max(x, 0.0)
        up = min(law.outward_speed, math.sqrt(2.0 * braking * (high - x)))
        down = min(law.homeward_speed, math.sqrt(2.0 * law.braking * (x - low)))
        worst = max(
            worst,
            _arriving(law, law.spring_low, x, up + pushed, high),
            _arriving(law, law.spring_high, x, down + pushed, low),
        )
    return worst


def released_speed(bench: Bench, hold: float) -> float:
    """Bound on the speed of a brake whose drive holds its last current for ``hold`` [s], and then lets go [rad/s].

    Let w² = v² + (γ k_1 / J) max(x, 0)²: twice the energy over the inertia. Motion and spring only exchange it and
    friction takes of it, so a current i raises w by |k_m i| / J a second at most, and without a current w never rises.
    So |v| <= w stays below the largest w inside the envelope plus what hold and lag of the current add: at every angle,
    the end stops among them, and for every brake of the shield's set.
    """
    law = make_law(bench)
    low, high = bench.limits.angle
    most = 0.0
    for i in range(ANGLES):  # in each piece the fastest of either direction, and the spring of its upper end
        begin, end = low + (high - low) * i / ANGLES, low + (high - low) * (i + 1) / ANGLES
        up = min(law.outward_speed, math.sqrt(2.0 * (law.braking + law.spring_low * max(end, 0.0)) * (high - begin)))
        down = min(law.homeward_speed, math.sqrt(2.0 * law.braking * (end - low)))
        most = max(most, max(up, down) ** 2 + law.spring_high * max(end, 0.0) ** 2)
    return math.sqrt(most) + (hold + law.lag) * law.motor_high * law.current


def _arriving(law: ShieldLaw, spring: float, x: float, speed: float, end: float) -> float:
    """Speed at ``end`` of a brake that moves towards it without a current, 0 if friction stops it before [rad/s]."""
    count = max(1, math.ceil(abs(end - x) / STEP))
    step = (end - x) / count
    energy = 0.5 * speed * speed
    for i in range(count):
        force = spring * max(x + (i + 0.5) * step, 0.0) * math.copysign(1.0, step)
        energy -= abs(step) * (force + law.friction_low + law.viscous_low * math.sqrt(2.0 * energy))
        if energy <= 0.0:
            return 0.0
    return math.sqrt(2.0 * energy)
