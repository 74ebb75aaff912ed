from __future__ import annotations

import math
from collections import Counter
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from emb_bench.brake import exact
from emb_bench.brake.motion import Floats, no_sensitivity, rest
from emb_runtime.config.bench import BrakeParameters, load_bench
from tests.bench.flows import ALL, EXACT, T_S, changed, difference, events, marched, moved

BENCH = load_bench()
BRAKE = BENCH.brake
BOX = BENCH.range_set("pm50")

Case = tuple[BrakeParameters, Floats, tuple[float, float]]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Any brake of ±50 %, held currents of any size and length, and a start in motion or where the brake can rest."""
    p = BrakeParameters(*(draw(st.floats(low, high)) for low, high in zip(BOX.low, BOX.high, strict=True)))
    held = st.tuples(st.one_of(st.just(0.0), st.floats(-6.0, 6.0), st.floats(-1.5, 1.5)), st.integers(1, 25))
    currents = np.concatenate([np.full(n, u) for u, n in draw(st.lists(held, min_size=1, max_size=10))])
    resting = p.T_c / (p.gamma * p.k_1)
    start = draw(
        st.one_of(
            st.just((0.0, 0.0)),
            st.tuples(st.floats(-10.0, -0.1), st.just(0.0)),
            st.tuples(st.floats(0.1, 0.99 * resting), st.just(0.0)),
            st.tuples(st.floats(-10.0, 60.0), st.floats(5.0, 300.0)),
            st.tuples(st.floats(-10.0, 60.0), st.floats(-300.0, -5.0)),
        )
    )
    return p, currents, start


def differentiable(x0: tuple[float, float]) -> list[str]:
    """The unknowns at which the flow has a derivative from both sides.

    To push a brake at rest forward or backward are two things; and so is to move one at rest away from contact.
    """
    without = {"x2_0"} if x0[1] == 0.0 else set[str]()
    if x0 == (0.0, 0.0):
        without |= {"x1_0", "contact"}
    return [name for name in ALL if name not in without]


def test_sensitivities_are_the_finite_differences_of_the_flow_through_every_event() -> None:
    happened, compared = Counter[str](), Counter[str]()

    @settings(max_examples=600, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(cases())
    def property_holds(case: Case) -> None:
        states, s = marched(EXACT, *case)
        happened.update(events(states)._asdict())
        for name in differentiable(case[2]):
            expected, smooth = difference(EXACT, *case, name)
            compared["smooth" if smooth else "set aside"] += 1
            if not smooth:
                continue
            found = s[:, ALL.index(name)]
            # 1e-4 of the largest over the run; below a thousandth of the sensors' noise rounding says the rest.
            allowed = 1e-4 * np.abs(expected).max(axis=0) + [1e-6, 1e-4]
            worst = np.abs(found - expected).max(axis=0)
            assert (worst <= allowed).all(), (name, worst, allowed)

    property_holds()
    assert min(happened[kind] for kind in ("reversed", "stuck", "released", "contact_made", "contact_left")) > 18
    assert compared["smooth"] > 3600
    assert compared["set aside"] < 0.002 * compared["smooth"]


@pytest.mark.parametrize("current", [2.5, -2.5])
def test_the_difference_for_a_brake_that_rests_on_the_contact_point_shrinks_to_the_sensitivity(current: float) -> None:
    # On one side it starts in contact and leaves it after a time that goes with the root of the step.
    currents = np.full(40, current)
    s = marched(EXACT, BRAKE, currents, (0.0, 0.0))[1]
    for name in ("x1_0", "contact"):
        errors = []
        for h in (1e-4, 1e-6, 1e-8):
            above, below = (changed(EXACT, BRAKE, currents, (0.0, 0.0), name, by) for by in (h, -h))
            errors.append(np.abs((above - below)[1:] / (2.0 * h) - s[:, ALL.index(name)]).max())
        assert errors[0] < 0.5
        assert errors[2] < 0.02 * errors[0]


def oracle(p: BrakeParameters, currents: Floats, x0: tuple[float, float]) -> Floats:
    """States at the samples by a general integrator with events: one per stop and per passage of the contact point."""
    states, (x1, x2) = [x0], x0
    spring = p.gamma * p.k_1
    for u in currents:
        left = T_S
        while left > 0.0:
            pull = p.k_m * u - spring * max(x1, 0.0)
            if x2 == 0.0 and abs(pull) <= p.T_c:
                break
            direction = math.copysign(1.0, x2 if x2 != 0.0 else pull)
            w = spring if x1 > 0.0 or (x1 == 0.0 and direction > 0.0) else 0.0

            def slope(
                _t: float, x: Floats, u: float = u, w: float = w, direction: float = direction
            ) -> tuple[float, float]:
                return x[1], (p.k_m * u - w * x[0] - p.T_c * direction - p.f_v * x[1]) / p.J

            def stop(_t: float, x: Floats, direction: float = direction) -> float:
                return float(x[1] * direction)

            def contact(_t: float, x: Floats) -> float:
                return float(x[0])

            stop.terminal = contact.terminal = True  # type: ignore[attr-defined]
            stop.direction = -1.0  # type: ignore[attr-defined]
            contact.direction = -math.copysign(1.0, x1) if x1 != 0.0 else -direction  # type: ignore[attr-defined]
            done = solve_ivp(slope, (0.0, left), (x1, x2), "DOP853", events=(stop, contact), rtol=1e-11, atol=1e-12)
            x1, x2 = done.y[:, -1].tolist()
            left -= float(done.t[-1])
            if done.t_events[0].size:
                x2 = 0.0
            elif done.t_events[1].size:
                x1 = 0.0
            else:
                break
        states.append((x1, x2))
    return np.array(states)


def test_trajectories_are_those_of_a_general_integrator_with_events() -> None:
    happened = Counter[str]()

    @settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(cases())
    def property_holds(case: Case) -> None:
        p, currents, x0 = case
        expected = oracle(p, currents, x0)
        found = moved(EXACT, p, currents, x0)
        happened.update(events(found)._asdict())
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-7)
        assert ((found[:, 1] == 0.0) == (expected[:, 1] == 0.0)).all()

    property_holds()
    assert all(happened[kind] > 3 for kind in ("reversed", "stuck", "released", "contact_made", "contact_left"))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(cases())
def test_the_instants_of_all_events_of_a_period_are_found_by_few_evaluations_of_the_series(case: Case) -> None:
    # A simulated node has a part of its period for them: where a search went on by bisection, its sample came late.
    p, currents, (x1, x2) = case
    x, (chosen, s) = rest(), no_sensitivity(())
    x[0], x[1] = x1, x2
    with mock.patch.object(exact, "glide", wraps=exact.glide) as evaluated:
        for u in currents:
            evaluated.reset_mock()
            exact.advance_exact(p, x, u, T_S, chosen, s)
            assert evaluated.call_count <= 24
