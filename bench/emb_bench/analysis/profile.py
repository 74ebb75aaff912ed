"""Likelihood profiles: rise of χ² over one unknown, with all the others refitted at each of its values.

The Fisher information is a parabola at the estimate; a profile follows the likelihood itself, however curved, up to the
border of the search (Raue et al., Structural and practical identifiability analysis of partially observed dynamical
models by exploiting the profile likelihood, Bioinformatics 25, 2009, section 2.2). The unknown is fixed at points of a
grid that begins at the minimum and widens while the rise is small; at each the others are refitted, from an
extrapolation of the last points. For an estimate by any method the likelihood is that of output error, with all priors
in full.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.records import LEVEL, Profile
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import least
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.intervals import bounded
from emb_bench.estimate.output_error import search
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, End, searched
from emb_bench.estimate.search import minimise
from emb_bench.information.identifiability import GROSS, Doubt
from emb_runtime.errors import UsageError

STEP = 0.4  # First distance from the minimum [standard deviations]
SHARE = 0.05  # Largest first distance from the minimum, as a share of the way to the border
SMALL, LARGE = 0.1, 2.5
"""Rise from one point of the grid to the next below which the grid widens, and above which it narrows."""
SEARCHES = 60  # Most searches on one side
BETTER = 0.01  # Fall of χ² below its minimum that exceeds the error of the search
MINIMA = 3  # Most minima that a profile moves on to
CLIFF = 1e-9  # Least step, over the way to the border: a larger rise than ``LARGE`` is then a jump
DOUBTFUL = 0.05
"""Deviation, over the value or the gross error, above which the Gaussian approximation is doubtful."""


class _Point(NamedTuple):
    """Point of a profile: the unknowns, and the rise of χ² there."""

    z: Floats
    rise: float


class _Side(NamedTuple):
    """Profile on one side of the minimum."""

    points: list[_Point]  # Points from the minimum outwards, the minimum first
    closed: bool  # True if the rise reached ``LEVEL`` while no other unknown had moved to its border


def profiles(e: Estimate, *, of_all: bool) -> tuple[Profile, ...]:
    """Profiles of the shared requested unknowns: ``of_all``, or only if the Gaussian approximation is doubtful.

    If it is doubtful for one of them, the curvature may affect each. An unknown that the information does not identify
    needs no profile for its verdict.
    """
    index = [i for i in e.shared() if i in e.requested()]
    if not of_all:
        unidentified = {finding.name for finding in e.identifiability().findings if not finding.identified}
        bent = any(_bent(e, i) for i in index)
        index = [i for i in index if bent and e.labels[i] not in unidentified]
    return tuple(profile(e, e.labels[i]) for i in index)


def _bent(e: Estimate, i: int) -> bool:
    """Returns True if the Gaussian approximation is doubtful for one unknown."""
    (low, high), (first, last) = searched(e.bench, e.unknowns[i]), e.intervals()[i].tolist()
    deviation = float(e.deviations()[i])
    return deviation > DOUBTFUL * GROSS.get(e.unknowns[i].name, 1.0) or first < low or last > high


def profile(e: Estimate, label: str) -> Profile:
    """The likelihood profile of one unknown, by its label."""
    if label not in e.labels:
        raise UsageError(f"no profile of '{label}': expected one of {', '.join(e.labels)}")
    i = e.labels.index(label)
    problem, start = e.problem, np.clip(e.z, *e.problem.bounds)
    weights = problem.weights(start)
    first = end = search(problem, start, weights)
    sides = _sides(e, problem, weights, i, end)
    for _ in range(MINIMA):
        lowest = min((side.points[-1] for side in sides), key=lambda point: point.rise)
        if lowest.rise > -BETTER:
            break
        end = search(problem, lowest.z, weights)
        sides = _sides(e, problem, weights, i, end)
    below, above = sides
    points = [*below.points[:0:-1], *above.points]

    def value(z: Floats) -> float:
        return float(problem.values(z)[i])

    interval = (_crossing(below, value, -math.inf), _crossing(above, value, math.inf))
    doubt = {
        (True, True): None,
        (False, True): Doubt.OPEN_BELOW,
        (True, False): Doubt.OPEN_ABOVE,
        (False, False): Doubt.FLAT,
    }[below.closed, above.closed]
    if doubt is not None and all(side.closed or side.points[-1].rise >= LEVEL for side in sides):
        doubt = Doubt.CUT
    minimum = value(end.z)
    half = NORMAL_95 * float(e.with_full_priors()[i] * e.scale[i])
    return Profile(
        label=label,
        values=np.array([value(point.z) for point in points]),
        rise=np.array([point.rise for point in points]),
        interval=interval,
        doubt=doubt,
        fisher=bounded((minimum - half, minimum + half), minimum, least(e.unknowns[i].name)),
        minimum=minimum,
        fell=first.cost - end.cost if end.cost < first.cost - BETTER else 0.0,
    )


def _sides(e: Estimate, problem: Problem, weights: Sequence[Floats], i: int, minimum: End) -> tuple[_Side, _Side]:
    z, cost = minimum.z, minimum.cost
    deviation = float(e.with_full_priors()[i])
    low, high = (float(border[i]) for border in problem.bounds)
    below = _walk(problem, weights, i, z, cost, low, min(STEP * deviation, SHARE * (z[i] - low)))
    above = _walk(problem, weights, i, z, cost, high, min(STEP * deviation, SHARE * (high - z[i])))
    return below, above


def _walk(
    problem: Problem, weights: Sequence[Floats], i: int, z: Floats, cost: float, border: float, step: float
) -> _Side:
    """Fix unknown ``i`` at values from the minimum ``z`` towards the border, until the rise reaches ``LEVEL``."""
    unit_row = np.eye(len(z))[i : i + 1]

    def with_fixed(z: Floats) -> tuple[Floats, Floats]:
        residuals, rows = problem.jacobian(z, weights)
        rows[:, i] = 0.0  # fixes unknown i: a zero column and a unit row
        return np.append(residuals, 0.0), np.concatenate([rows, unit_row])

    points = [_Point(z, 0.0)]
    for _ in range(SEARCHES):
        here, rise = points[-1]
        distance = border - float(here[i])
        if distance == 0.0 or step <= 0.0:
            break
        move = math.copysign(min(step, abs(distance)), distance)
        if here[i] + move == here[i]:  # at the border, but for rounding
            break
        start = here.copy()
        if len(points) > 1:  # extrapolated along the last step
            before = points[-2].z
            start += (here - before) * (move / (here[i] - before[i]))
        start[i] = border if move == distance else here[i] + move
        end = minimise(problem, np.clip(start, *problem.bounds), with_fixed)
        found = end.z
        found[i] = start[i]  # a search begins strictly inside its bounds
        grown = end.cost - cost - rise
        if grown > LARGE and abs(move) > CLIFF * abs(border - float(z[i])):
            step = 0.5 * abs(move)
            continue
        points.append(_Point(found, end.cost - cost))
        if end.cost - cost >= LEVEL:
            return _Side(points, not (_at_border(problem, found, i) & ~_at_border(problem, z, i)).any())
        if end.cost - cost < -BETTER:
            break
        if grown < SMALL:
            step *= 2.0
    return _Side(points, False)


def _at_border(problem: Problem, z: Floats, i: int) -> NDArray[np.bool_]:
    """Mask of the unknowns other than ``i`` that are at a border of the search, shape (p,)."""
    result = problem.at_border(z)
    result[i] = False
    return result


def _crossing(side: _Side, value: Callable[[Floats], float], otherwise: float) -> float:
    """Value where the rise reaches ``LEVEL``, interpolated linearly in its root; else ``otherwise``."""
    if not side.closed:
        return otherwise
    inner, outer = side.points[-2:]
    low, high = math.sqrt(max(inner.rise, 0.0)), math.sqrt(outer.rise)
    share = (math.sqrt(LEVEL) - low) / (high - low)
    return value(inner.z) + share * (value(outer.z) - value(inner.z))
