from __future__ import annotations

import math
from dataclasses import replace

import pytest

from emb_runtime.config.bench import Bench, Ranges, load_bench
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.end_stop import end_stop_speed
from emb_runtime.safety.shield_design import make_law

SHIPPED = load_bench()
FREEWHEEL = replace(SHIPPED, node=replace(SHIPPED.node, stop="freewheel"))


def without_viscous_friction(bench: Bench) -> Bench:
    box = bench.range_set("envelope")
    return replace(
        bench,
        ranges={"envelope": Ranges("envelope", box.low._replace(f_v=1e-12), box.high._replace(f_v=2e-12))},
    )


def test_a_node_that_brakes_hits_no_stop() -> None:
    assert end_stop_speed(SHIPPED) == 0.0


def test_nor_does_a_drive_that_lets_go_inside_the_coasting_envelope() -> None:
    coasting = replace(SHIPPED.shield, envelope="coasting", angle_margin=1.1)
    assert end_stop_speed(replace(FREEWHEEL, shield=coasting)) == 0


def test_without_viscous_friction_the_speed_is_what_the_wound_spring_and_the_speed_limit_give() -> None:
    bench = without_viscous_friction(FREEWHEEL)
    law = make_law(bench)
    # Energy over the inertia: from the speed limit at 100 rad, the stiffest spring in, the least friction out.
    by_hand = math.sqrt(law.homeward_speed**2 + law.spring_high * 100.0**2 - 2.0 * law.friction_low * 110.0)
    assert math.isclose(end_stop_speed(bench), by_hand, rel_tol=1e-6)


def test_viscous_friction_and_a_narrower_set_make_it_slower_and_a_lag_faster() -> None:
    speed = end_stop_speed(FREEWHEEL)
    assert 930.0 < speed < end_stop_speed(without_viscous_friction(FREEWHEEL))  # a search saw 930 rad/s
    assert end_stop_speed(replace(FREEWHEEL, shield=replace(SHIPPED.shield, ranges="viscous"))) < 0.7 * speed
    assert end_stop_speed(replace(FREEWHEEL, shield=replace(SHIPPED.shield, current_lag=0.002))) > speed


def test_without_a_spring_it_is_the_speed_from_which_full_braking_would_just_have_stopped() -> None:
    box = SHIPPED.range_set("envelope")
    soft = Ranges("envelope", box.low._replace(k_1=1e-6, f_v=1e-12), box.high._replace(k_1=1e-5, f_v=2e-12))
    bench = replace(FREEWHEEL, ranges={"envelope": soft})
    law = make_law(bench)
    # At the speed limit as near to a stop as the grid has it; then friction is all.
    nearest = max(100.0 - i for i in range(100) if 2.0 * law.braking * i >= law.outward_speed**2)
    by_hand = math.sqrt(law.outward_speed**2 - 2.0 * law.friction_low * (100.0 - nearest))
    assert math.isclose(end_stop_speed(bench), by_hand, rel_tol=1e-3)


def test_a_bench_that_cannot_be_shielded_is_refused() -> None:
    with pytest.raises(BenchFileError, match="angle_margin"):
        end_stop_speed(replace(SHIPPED, shield=replace(SHIPPED.shield, angle_margin=0.05)))
