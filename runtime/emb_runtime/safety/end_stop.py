"""Speed of a brake that is let go at the worst moment."""

from __future__ import annotations

import math

from emb_runtime.config.bench import Bench
from emb_runtime.safety.shield_design import make_law

ANGLES = 110  # Pieces of the travel in which the envelope is bounded


def end_stop_speed(bench: Bench) -> float:
    """Bound on the speed into an end stop after a loss of all commands, for any brake of the shield's set [rad/s].

    A node that brakes, and an envelope made for coasting, stop every brake before: 0 then, as argued in
    ``docs/explanation/shield.md``. A node that lets go inside the braking envelope leaves the brake to its spring.
    """
    stops = bench.node.stop == "damped" or bench.shield.envelope == "coasting"
    return 0.0 if stops else released_speed(bench, 0.0)


def released_speed(bench: Bench, hold: float) -> float:
    """Bound on the speed of a brake whose drive holds its last current for ``hold`` [s], and then lets go [rad/s].

    Let w² = v² + (γ k_1 / J) max(x, 0)²: twice the energy over the inertia. Motion and spring only exchange it and
    friction takes of it, so a current i raises w by |k_m i| / J a second at most, and without a current w never rises.
    So |v| <= w stays below the largest w inside the envelope plus what hold and lag of the current add: at every angle,
    the end stops among them, and for every brake of the shield's set.
    """
    law = make_law(bench)
    box, (low, high) = law.box, bench.limits.angle
    most = 0.0
    for i in range(ANGLES):  # in each piece the fastest of either direction, and the spring of its upper end
        begin, end = low + (high - low) * i / ANGLES, low + (high - low) * (i + 1) / ANGLES
        up = min(law.outward_speed, math.sqrt(2.0 * (box.braking + box.spring_low * max(end, 0.0)) * (high - begin)))
        down = min(law.homeward_speed, math.sqrt(2.0 * box.braking * (end - low)))
        most = max(most, max(up, down) ** 2 + box.spring_high * max(end, 0.0) ** 2)
    return math.sqrt(most) + (hold + law.delay.lag) * box.motor_high * law.current
