"""Branch and bound: a statement about every point of a box, by boxes that are halved until each is decided."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from proof.intervals import Boxes, Floats, Interval
from proof.symbolic_execution import DeadEnd, walk

Slack = Callable[..., Any]
"""Function of one interval per dimension: the excess over what is required; None where nothing is required."""

AT_ONCE = 50_000


class Covered(NamedTuple):
    """Result of the search."""

    proved: bool
    boxes: int  # Number of boxes examined
    slack: float  # Least found, in the unit of the statement; of the boxes that are decided
    breaks: str  # A point that breaks it, or a box that could not be decided


def cover(statement: Callable[[Boxes], Slack], region: Mapping[str, tuple[float, float]], most: int) -> Covered:
    """Show that a slack is nowhere negative.

    Args:
        statement: for the boxes of a path, the function that gives their slack.
        region: least and greatest value of each dimension, by its name.
        most: boxes that may be examined.
    """
    names = list(region)
    scale = np.array([max(high - low, 1e-300) for low, high in region.values()])
    waiting = [(np.array([[region[n][0] for n in names]]), np.array([[region[n][1] for n in names]]))]
    looked, least = 0, np.inf
    while waiting:
        low, high = waiting.pop()
        looked += len(low)
        found = slack_of(statement, names, low, high)
        good = found >= 0.0
        if good.any():
            least = min(least, float(found[good].min()))
        low, high = low[~good], high[~good]
        if not len(low):
            continue
        middle = 0.5 * (low + high)
        broken = slack_of(statement, names, middle, middle, at_most=True) < 0.0
        if broken.any():
            point = middle[int(np.argmax(broken))]
            return Covered(False, looked, least, "broken at " + _shown(names, point, point))
        axis = np.argmax((high - low) / scale, axis=1)
        rows = np.arange(len(low))
        stuck = (middle[rows, axis] <= low[rows, axis]) | (middle[rows, axis] >= high[rows, axis])
        if looked + 2 * len(low) > most or stuck.any():
            return Covered(False, looked, least, "undecided, for one, " + _shown(names, low[0], high[0]))
        upper_low, lower_high = low.copy(), high.copy()
        upper_low[rows, axis] = lower_high[rows, axis] = middle[rows, axis]
        halves = np.concatenate([low, upper_low]), np.concatenate([lower_high, high])
        parts = (slice(first, first + AT_ONCE) for first in range(0, len(halves[0]), AT_ONCE))
        waiting.extend((halves[0][part], halves[1][part]) for part in parts)
    return Covered(True, looked, least, "")


def slack_of(
    statement: Callable[[Boxes], Slack], names: list[str], low: Floats, high: Floats, *, at_most: bool = False
) -> Floats:
    """The least slack of each box over every path it may take; with ``at_most`` the greatest that it can be.

    A box that takes no path with anything to show has infinite slack.
    """
    found: Floats = np.full(len(low), -np.inf if at_most else np.inf)
    shown = np.zeros(len(low), dtype=np.bool_)

    def start(decisions: tuple[bool, ...]) -> tuple[Boxes, tuple[Boxes, Any]]:
        boxes = Boxes(decisions, len(low))
        values = [Interval(boxes, low[:, i].copy(), high[:, i].copy()) for i in range(len(names))]
        try:
            return boxes, (boxes, statement(boxes)(*values))
        except DeadEnd:
            boxes.living[:] = False
            return boxes, (boxes, None)

    for boxes, slack in walk(start):
        living = boxes.living
        if at_most:
            value = np.inf if slack is None else slack.high
            found[living] = np.maximum(found, value)[living]
        elif slack is not None:
            found[living] = np.minimum(found, slack.low)[living]
        shown |= living
    found[~shown] = np.inf
    return found


def _shown(names: list[str], low: Floats, high: Floats) -> str:
    parts = (
        f"{n} = {a:.9g}" if a == b else f"{n} in {a:.9g}..{b:.9g}" for n, a, b in zip(names, low, high, strict=True)
    )
    return ", ".join(parts)
