"""The lemmas of ``docs/explanation/shield.md``, each with what checks it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from proof import exhaustive, extensions, safety, successors, windows
from proof.boxes import Covered
from proof.cases import Case
from proof.terms import Answer

SOLVER, BOXES = "solver", "boxes"


class Lemma(NamedTuple):
    """One statement and what checks it."""

    key: str  # The lemma of the document, and a letter where it has parts
    check: Callable[[Case], Answer | Covered]
    statement: str


class Verdict(NamedTuple):
    """Result of one lemma."""

    key: str
    statement: str
    method: str
    looked: int  # Ways through the functions, or boxes
    proved: bool
    slack: float | None  # Least, of the boxes; the solver's inequalities are exact, and have none
    reason: str  # Reason that it is not proved: a point that breaks it, or what could not be decided
    seconds: float


BOX = (
    Lemma("L1a", safety.set_is_covered, "the law's bounds enclose every brake of the set"),
    Lemma("L1b", successors.drive_is_bounded, "motor and spring lie between the drives that successor assumes"),
    Lemma("L1c", successors.euler_is_contained, "successor contains forward Euler's map"),
    Lemma("L1d", successors.flow_is_contained, "successor contains the exact flow, rest and reversal included"),
    Lemma("L1e", successors.angles_are_contained, "successor contains the angles within the sample"),
)
ROLLED = (
    Lemma("L9a", successors.change_is_bounded, "no velocity changes by more than the law's change in one sample"),
    Lemma("L9b", successors.lost_commands_are_contained, "what acts where a command was lost is among what is assumed"),
)
STOPPABLE = Lemma("L2a", windows.stoppable_stops, "from what stoppable allows, full braking stops within the room")
BRAKING = (
    *BOX,
    STOPPABLE,
    Lemma("L2b", windows.window_is_kept, "a current of the window keeps the box in the envelope, or brakes fully"),
    Lemma("L3a", safety.damping_does_not_reverse, "one sample of the damped stop does not reverse the speed"),
    Lemma("L3b", safety.braking_is_enough, "damped stop and full braking slow as the weakest brake's do, or more"),
    Lemma("L4a", exhaustive.damped_stop_is_counted, "damped_excess bounds what the damped stop needs beyond"),
    Lemma("L4b", safety.envelope_is_safe, "the envelope lies in the safe set, within the margin"),
    Lemma("L5a", safety.euler_stop_stays_above, "under Euler a stop keeps the safe set, going up"),
    Lemma("L5b", safety.euler_stop_stays_below, "under Euler a stop keeps the safe set, going down, sign() and all"),
    Lemma("L5c", safety.nothing_is_thrown_up, "what does not go up is not thrown up: sign() or full braking"),
    Lemma("L5d", safety.flow_of_a_stop_stays, "along the flow a stop keeps the safe set"),
    Lemma("L5e", safety.flow_may_turn, "a current held too long turns no brake back beyond where it was"),
    Lemma("L5f", safety.entering_the_stroke, "who leaves contact at a permitted speed is in the safe set"),
    Lemma("L5g", safety.speeds_stay, "a stop passes no speed limit, whatever the spring does"),
    Lemma("L5h", safety.rest_is_safe, "rest at the origin is safe, and what is safe is within the limits"),
    Lemma("L6", exhaustive.some_current_is_left, "a window is left, or the brake is too fast to be turned by braking"),
    *ROLLED,
)
LAGGING = (
    BOX[0],
    STOPPABLE,
    Lemma("L10a", extensions.flowing_is_bounded, "no current flows beyond what the law assumes"),
    Lemma("L10b", extensions.lagging_window_is_kept, "what the window asks of speed and e holds after the sample"),
    Lemma("L11a", extensions.motors_between_stop_too, "the motors in between stop where the two extreme ones do"),
    Lemma("L11b", extensions.lagging_stop_stays, "along the flow a stop uses up e's reserve as it goes"),
    ROLLED[0],
)
OBSERVED = (
    *BRAKING,
    Lemma("L13", extensions.observer_is_bounded, "what an observer does not show yet is within what is assumed"),
)
COASTING = (
    *BOX,
    Lemma("L12a", extensions.coasting_window_is_kept, "a current of the window leaves what friction can take, or is 0"),
    Lemma("L12b", extensions.coasting_loses_energy, "along the flow, against the motion, the energy left only falls"),
    Lemma("L12c", extensions.coasting_turns_inside, "whoever turns before the apex can coast home"),
    ROLLED[0],
)


def lemmas(case: Case) -> tuple[Lemma, ...]:
    """Returns the lemmas for a law."""
    if case.law.coasting:
        return COASTING
    if case.law.delay.lag > 0.0:
        return LAGGING
    return OBSERVED if case.law.delay.observer > 0.0 else BRAKING


def judge(lemma: Lemma, case: Case) -> Verdict:
    """Check one lemma."""
    begun = time.perf_counter()
    try:
        found: Answer | Covered = lemma.check(case)
    except ArithmeticError as err:  # for such a law a formula has no value
        found = Answer(False, 0, str(err))
    seconds = time.perf_counter() - begun
    if isinstance(found, Covered):
        method, looked, slack = BOXES, found.boxes, found.slack
        return Verdict(lemma.key, lemma.statement, method, looked, found.proved, slack, found.breaks, seconds)
    return Verdict(lemma.key, lemma.statement, SOLVER, found.paths, found.proved, None, found.breaks, seconds)
