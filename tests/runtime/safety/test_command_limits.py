"""From a wish to what is sent: finite first, then the clip, the shield, and what is within reach."""

from __future__ import annotations

import math
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.config.bench import load_bench
from emb_runtime.records import Reason
from emb_runtime.safety.command_limits import CommandLimits, checked, decide
from emb_runtime.safety.shield import NO_PAST, shield, window
from emb_runtime.safety.shield_design import make_law
from emb_runtime.safety.state_machine import Fault, StopError

BENCH = load_bench()
LAW = make_law(BENCH)
FULL = CommandLimits(6.0, 12.0)

angles = st.floats(-10, 100)
velocities = st.floats(-500, 500)
currents = st.floats(-6, 6)
steps = st.integers(0, 499)


@pytest.mark.parametrize("wanted", [math.nan, math.inf, -math.inf])
def test_a_wish_that_is_no_number_ends_the_run(wanted: float) -> None:
    with pytest.raises(StopError) as caught:
        checked(wanted, 6.0)
    assert caught.value.fault is Fault.POLICY_NOT_FINITE
    assert str(wanted) in caught.value.detail


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_wish_may_pass_its_contract_by_a_millionth_of_rounding_and_no_more(sign: float) -> None:
    most = sign * 3.0 * (1.0 + 1e-6)
    assert checked(most, 3.0) == most
    with pytest.raises(StopError) as caught:
        checked(math.nextafter(most, sign * 4.0), 3.0)
    assert caught.value.fault is Fault.POLICY_BEYOND_CONTRACT
    with pytest.raises(StopError) as caught:
        checked(sign * 4.5, 3.0)
    assert caught.value.detail == "it requested 1.5 times what its contract allows"


@given(angles, velocities, st.floats(-9, 9), currents, steps)
def test_with_everything_in_reach_the_shield_has_the_last_word(
    angle: float, velocity: float, wanted: float, last: float, step: int
) -> None:
    decision = decide(LAW, FULL, angle, velocity, wanted, NO_PAST, last, step)
    clipped = min(max(wanted, -6.0), 6.0)
    current, bits = shield(LAW, angle, velocity, clipped, NO_PAST, step)
    assert decision.clipped == clipped
    assert decision.current == current
    assert decision.reasons == bits | (Reason.CLIPPED if clipped != wanted else 0)


@given(angles, velocities, st.floats(-9, 9), currents, st.floats(0, 6), st.floats(0, 12), steps)
def test_what_is_sent_is_in_reach_and_in_the_shield_s_window_or_it_is_not_sent(
    angle: float, velocity: float, wanted: float, last: float, limit: float, slew: float, step: int
) -> None:
    last = min(max(last, -limit), limit)
    decision = decide(LAW, CommandLimits(limit, slew), angle, velocity, wanted, NO_PAST, last, step)
    lowest, highest = window(LAW, angle, velocity, NO_PAST)
    if math.isnan(decision.current):
        assert decision.reasons & Reason.LEFT
        reachable = max(-limit, last - slew), min(limit, last + slew)
        assert reachable[1] < lowest or reachable[0] > highest
        return
    assert not decision.reasons & Reason.LEFT
    assert abs(decision.current) <= limit
    assert abs(decision.current - last) <= slew * (1 + 1e-12) + 1e-12
    assert lowest <= decision.current <= highest


@pytest.mark.parametrize(("angle", "velocity"), [(99.0, 200.0), (-9.3, -200.0)])
@pytest.mark.parametrize("limit", [1.0, 6.0])
def test_what_the_shield_needs_beyond_the_operator_s_limit_is_left_to_the_node(
    angle: float, velocity: float, limit: float
) -> None:
    decision = decide(LAW, CommandLimits(limit, 12.0), angle, velocity, 0.0, NO_PAST, 0.0, 100)
    if limit < 6.0:
        assert math.isnan(decision.current)
        assert decision.reasons & Reason.LEFT
    else:
        assert decision.current == -math.copysign(6.0, velocity)


@pytest.mark.parametrize("up", [True, False])
def test_a_command_held_back_by_the_slew_may_lie_on_the_end_of_the_window(up: bool) -> None:
    """The end is as good as what lies inside; the last command is such that it can just be reached."""
    for n in count():
        velocity = (480.0 if up else -480.0) * (1.0 + 1e-3 * n)
        lowest, highest = window(LAW, 40.0, velocity, NO_PAST)
        end = highest if up else lowest
        last = end + (1.0 if up else -1.0)
        if abs(end) < 4.0 and (last - 1.0 if up else last + 1.0) == end:
            break
    decision = decide(LAW, CommandLimits(6.0, 1.0), 40.0, velocity, -6.0 if up else 6.0, NO_PAST, last, 20)
    assert decision.current == end


DECIDED = [
    # limit, slew, angle, wanted, last → decision
    (6.0, 12.0, 20.0, 6.0, 0.0, (6.0, 6.0, Reason.NONE)),
    (6.0, 12.0, 20.0, -6.0, 0.0, (-6.0, -6.0, Reason.NONE)),
    (6.0, 2.0, 10.0, 6.0, 1.0, (6.0, 3.0, Reason.LIMITED)),
    (6.0, 2.0, 10.0, -6.0, 1.0, (-6.0, -1.0, Reason.LIMITED)),
    (1.5, 12.0, 0.0, 4.0, 0.0, (1.5, 1.5, Reason.CLIPPED)),
    (1.5, 12.0, 0.0, -4.0, 0.0, (-1.5, -1.5, Reason.CLIPPED)),
]


def test_limit_and_slew_hold_a_wish_back_and_say_so() -> None:
    for limit, slew, angle, wanted, last, expected in DECIDED:
        assert decide(LAW, CommandLimits(limit, slew), angle, 0.0, wanted, NO_PAST, last, 10) == (wanted, *expected)
