"""A decision at the borders of what may be sent."""

from __future__ import annotations

import math
from itertools import count

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.safety.command_limits import Reach, checked, decide
from emb_runtime.safety.shield import NO_PAST, window
from emb_runtime.safety.shield_design import make_law
from emb_runtime.safety.state_machine import StopError

LAW = make_law(load_bench())


def test_a_wish_may_pass_its_contract_by_a_millionth_and_no_more() -> None:
    most = 3.0 * (1.0 + 1e-6)
    assert checked(most, 3.0) == most
    with pytest.raises(StopError):
        checked(math.nextafter(most, 4.0), 3.0)


@pytest.mark.parametrize(("angle", "velocity"), [(99.0, 200.0), (-9.3, -200.0)])
@pytest.mark.parametrize("limit", [1.0, 6.0])
def test_what_the_shield_needs_beyond_the_operator_s_limit_is_left_to_the_node(
    angle: float, velocity: float, limit: float
) -> None:
    decision = decide(LAW, Reach(limit, 12.0), angle, velocity, 0.0, NO_PAST, 0.0, 100)
    if limit < 6.0:
        assert math.isnan(decision.current)
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
    decision = decide(LAW, Reach(6.0, 1.0), 40.0, velocity, -6.0 if up else 6.0, NO_PAST, last, 20)
    assert decision.current == end
