from __future__ import annotations

import math
import random
from dataclasses import replace

from emb_runtime.config.bench import Bench
from emb_runtime.safety.end_stop import end_stop_speed, released_speed
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_BENCH

SHIPPED = SENSOR_BENCH
FREEWHEEL = replace(SHIPPED, node=replace(SHIPPED.node, stop="freewheel"))


def test_a_node_that_brakes_and_a_drive_inside_the_coasting_envelope_hit_no_stop() -> None:
    coasting = SHIPPED.shield._replace(envelope="coasting", angle_margin=1.1)
    assert end_stop_speed(SHIPPED) == end_stop_speed(replace(FREEWHEEL, shield=coasting)) == 0.0


def test_a_narrower_set_makes_it_slower_and_a_lag_faster() -> None:
    speed = end_stop_speed(FREEWHEEL)
    assert speed > 930.0  # a search saw that
    assert end_stop_speed(replace(FREEWHEEL, shield=SHIPPED.shield._replace(ranges="viscous"))) < 0.9 * speed
    assert end_stop_speed(replace(FREEWHEEL, shield=SHIPPED.shield._replace(current_lag=0.002))) > speed


def coasted(bench: Bench, hold: float, dice: random.Random) -> float:
    """Largest speed of a random brake from a random state of the envelope: full current for the hold, then none."""
    law, box = make_law(bench), bench.range_set("envelope")
    spring, friction, viscous, motor = (
        dice.choice((low, high)) / bench.brake.J
        for low, high in (
            (box.low.k_1 * bench.brake.gamma, box.high.k_1 * bench.brake.gamma),
            (box.low.T_c, box.high.T_c),
            (box.low.f_v, box.high.f_v),
            (box.low.k_m, box.high.k_m),
        )
    )
    low, high = bench.limits.angle
    x = dice.uniform(low, high)
    up = min(law.outward_speed, math.sqrt(2.0 * (law.box.braking + law.box.spring_low * max(x, 0.0)) * (high - x)))
    down = min(law.homeward_speed, math.sqrt(2.0 * law.box.braking * (x - low)))
    v = dice.choice((up, -down))
    pull, fastest, t = math.copysign(motor * law.current, v), 0.0, 0.0
    while low - 20.0 < x < high + 50.0 and t < 0.5:
        driven = pull if t < hold else 0.0
        v += 1e-5 * (driven - spring * max(x, 0.0) - viscous * v - math.copysign(friction, v))
        x += 1e-5 * v
        t, fastest = t + 1e-5, max(fastest, abs(v))
        if abs(v) < 0.1 and t > hold and spring * max(x, 0.0) <= friction:
            break
    return fastest


def test_no_brake_that_is_held_and_let_go_is_faster_than_the_bound_and_some_come_near_it() -> None:
    dice = random.Random(7)
    for hold in (0.0, 0.005):
        bound = released_speed(SHIPPED, hold)
        fastest = max(coasted(SHIPPED, hold, dice) for _ in range(100))
        assert 0.7 * bound < fastest <= bound
