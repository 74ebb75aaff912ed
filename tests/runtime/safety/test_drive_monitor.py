"""What the drive reports must lie among the last commands that it says it obeyed."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.safety.drive_monitor import TOLERATED, DriveCheck

TOLERANCE = 0.5
LIMIT = 6.0


def obeyed(check: DriveCheck, commanded: float, applied: float, counter: int = 0) -> str:
    check.sent(counter, commanded)
    return check.current_problem(counter, applied)


@given(st.lists(st.floats(-6, 6), min_size=1, max_size=40), st.floats(-0.5, 0.5))
def test_a_drive_that_applies_what_it_is_told_within_the_tolerance_is_never_blamed(
    commands: list[float], error: float
) -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    assert [obeyed(check, u, u + error * 0.999, n % 15) for n, u in enumerate(commands)] == [""] * len(commands)
    assert check.errors == 0


@given(st.lists(st.sampled_from([-6.0, 0.0, 6.0]), min_size=1, max_size=60), st.floats(0.1, 2.0))
def test_a_current_loop_of_two_periods_is_not_blamed(commands: list[float], lag: float) -> None:
    check, applied = DriveCheck(TOLERANCE, LIMIT), 0.0
    for n, u in enumerate(commands):
        applied = u + (applied - u) * math.exp(-1.0 / lag)
        assert obeyed(check, u, applied, n % 15) == ""


def test_a_drive_that_ignores_its_commands_is_blamed_at_the_fifth_report() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    obeyed(check, 0.0, 0.0)
    said = [obeyed(check, 4.0, -1.0, n) for n in range(5)]
    assert said[:-1] == [""] * 4
    assert "reports -1.00 A, commanded were 0.00 to 4.00 A" in said[-1]


def test_a_command_that_was_never_sent_takes_no_place_among_those_obeyed() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    assert check.current_problem(9, 0.0) == ""
    before = check.errors
    assert before > 0
    assert obeyed(check, 0.0, 0.0, 1) == ""
    assert check.errors < before


def test_what_flowed_before_the_first_command_is_no_current_and_counts_as_one_of_the_six() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    for _ in range(4):
        obeyed(check, 5.0, 5.0)
    obeyed(check, 5.0, 0.0)
    assert check.errors == 0
    obeyed(check, 5.0, 0.0)
    assert check.errors == 4


def test_the_node_s_own_braking_is_judged_by_the_limit_alone_and_is_where_the_next_command_begins() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    obeyed(check, 6.0, 6.0)
    assert check.current_problem(NO_COUNTER, -6.0) == ""
    assert obeyed(check, 1.0, -5.0) == ""  # on its way from -6 A
    assert check.errors == 0
    obeyed(check, 1.0, 5.9)  # 6 A is forgotten
    assert check.errors == 4


@pytest.mark.parametrize("applied", [math.nan, math.inf, -math.inf])
def test_a_report_that_is_no_number_is_out_of_place(applied: float) -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    obeyed(check, 0.0, applied)
    assert check.errors == 4


def test_a_command_that_was_never_sent_cannot_have_been_obeyed() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    said = [check.current_problem(3, 0.0) for _ in range(TOLERATED)]
    assert "command 3, which was never sent" in said[-1]


@pytest.mark.parametrize(("applied", "possible"), [(6.5, True), (-6.5, True), (6.5 + 1e-9, False), (-20.0, False)])
def test_the_node_brakes_with_its_limit_at_most(applied: float, possible: bool) -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    said = [check.current_problem(NO_COUNTER, applied) for _ in range(TOLERATED)]
    assert said[:-1] == [""] * (TOLERATED - 1)
    assert (said[-1] == "") == possible
    assert check.errors == (0 if possible else 4 * TOLERATED)
    assert possible or said[-1] == f"it reports {applied:.2f} A of its own braking, at most 6 A"


@pytest.mark.parametrize("applied", [math.nan, math.inf, 20.0])
def test_an_impossible_braking_current_excuses_no_later_one(applied: float) -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    obeyed(check, 6.0, 6.0)
    check.current_problem(NO_COUNTER, applied)
    assert check.errors == 4
    obeyed(check, 1.0, 6.0)  # neither the command before it nor what it reported
    assert check.errors == 8
    obeyed(check, 1.0, 0.0)
    assert check.errors == 7


def test_a_possible_braking_current_forgives_nothing() -> None:
    check = DriveCheck(TOLERANCE, LIMIT)
    check.current_problem(NO_COUNTER, 20.0)
    check.current_problem(NO_COUNTER, 6.0)
    assert check.errors == 4


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_before_the_first_command_and_after_an_impossible_braking_current_there_were_0_ampere(side: float) -> None:
    for after_braking in (False, True):
        check = DriveCheck(TOLERANCE, LIMIT)
        before = 4 if after_braking else 0
        if after_braking:
            check.current_problem(NO_COUNTER, 20.0)
        obeyed(check, side * 3.0, side * -0.5)
        assert check.errors == max(before - 1, 0)
        obeyed(check, side * 3.0, side * -0.5 - side * 1e-9)
        assert check.errors == max(before - 1, 0) + 4
