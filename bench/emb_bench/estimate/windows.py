"""Output error over windows: multiple shooting in which each window begins where its own samples say.

A machine without a spring has no place that it returns to: an error of its friction adds up over a recording, and after
seconds the simulation is elsewhere. So a recording is cut into windows, each with the angle and the velocity at its
start as unknowns of its own. What all windows share is left with a small system: the normal equations are block-arrow,
and the starts are eliminated window by window (Bock, Numerical treatment of inverse problems in chemical reaction
kinetics, 1981; Golub and Pereyra's projection for the linear step). A step costs as much as one simulation.

**Uncertainty.** A machine is disturbed by what no parameter stands for: ripple, friction that depends on the place.
Such residuals follow from each other for as long as a window lasts, so that a window is the unit that counts: the
covariance is H⁻¹ (Σ g g^T) H⁻¹ with the scores g of whole windows (Liang and Zeger, Biometrika 73, 1986), those of
neighbours counted together (Newey and West 1987). What is wrong in all windows alike does not show in their scatter.
But a wrong model weighs its errors otherwise in longer windows, and the right one does not (Hausman, Econometrica 46,
1978): the estimate is made again from windows of another length, and what it moves by counts as a deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.model_validation import examine
from emb_bench.estimate.output_error import by_record, estimate_at, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import OF_A_RECORD, WINDOW, End, Estimate, ModelValidation, Record
from emb_bench.information.identifiability import Spectrum
from emb_runtime.errors import UsageError

SHORTEST = 10
"""Fewest samples of a window."""
FEWEST = 3
"""Fewest windows for each unknown that they share: with fewer their scatter says little."""
JUDGED = 5000
"""Samples, in whole windows, that the model is validated on: an hour has millions, and these see as much."""
OTHER = 4.0
"""Ratio of the lengths of the windows in two estimates whose difference is counted."""
REFINED = 2
"""Searches that are carried to their ends: those whose first steps led lowest."""
SHORT = 6
"""Simulations of a search that is only begun."""
AROUND = 8
"""Samples on each side of a window's start from which its velocity is taken, where none is measured."""
ITERATIONS = 60
"""Most steps of a search."""
RESTARTS = 4
"""Most times that a search goes on from better starts of the windows."""
RESTARTED = 1e-3
"""Share of the cost by which a restart has to lower it to be followed by another."""
SETTLED = 4
"""Steps in which the starts of windows settle for given parameters."""
CONVERGED = 1e-6
"""Share of the cost by which a last step lowers it, at most."""
START = ("x1_0", "x2_0")
_LOST = 1e-9  # share of a start's largest singular value below which the samples do not tell it
_DAMPING = 1e-3
_MOST_DAMPING = 1e12


@dataclass(frozen=True, eq=False)
class _Window:
    """One window at a point: what it adds to the normal equations once its start is eliminated."""

    errors: Floats
    """Of its samples in standard deviations, shape (m,)."""
    shared: Floats
    """Derivatives of what is shown to the shared unknowns, shape (m, p)."""
    inverse: Floats
    """Pseudo-inverse of the derivatives to the start, shape (2, m)."""
    own: Floats
    """Derivatives to the start, shape (m, 2)."""

    @property
    def cost(self) -> float:
        """Weighted sum of squares."""
        return float(self.errors @ self.errors)

    def projected(self) -> tuple[Floats, Floats]:
        """Errors and derivatives beside what the start takes up."""
        return self._beside(self.errors), self._beside(self.shared)

    def _beside(self, columns: Floats) -> Floats:
        result: Floats = columns - self.own @ (self.inverse @ columns)
        return result


def estimate(problem: Problem, *, starts: int, seed: int) -> Estimate:
    """Estimates what all windows of the records share.

    Args:
        problem: records, model and unknowns, none of which belongs to a record.
        starts: local searches.
        seed: of where they begin.

    Raises:
        UsageError: an unknown belongs to a record, or there are too few windows for the unknowns.
    """
    shared = problem.unknowns
    if any(unknown.record is not None for unknown in shared):
        raise UsageError(f"method windows: each window has a start of its own: leave out {', '.join(OF_A_RECORD)}")
    cut = windowed(problem)
    if len(cut) < FEWEST * len(shared):
        raise UsageError(
            f"method windows: {len(cut)} windows of {window_of(problem):g} s are too few for {len(shared)} "
            f"unknowns, expected at least {FEWEST * len(shared)}: shorter windows (--window) or a longer recording"
        )
    begun = _begun(cut, problem.nominal())
    weights = _weights(cut, begun)
    points = [replace(begun, shared=z) for z in start_points(problem, starts, seed)]
    if len(points) > REFINED:  # most searches are only begun
        short = [_descended(cut, point, weights, SHORT) for point in points]
        order = sorted(range(len(points)), key=lambda i: short[i][1].cost)
        points = [points[i] for i in order[:REFINED]]
    searches = sorted((_search(cut, point, weights) for point in points), key=lambda pair: pair[1].cost)
    at = searches[0][0]
    return _finished(
        problem, cut, at, weights, tuple(end for _, end in searches), _other(problem, at.shared) - at.shared
    )


def _other(problem: Problem, shared: Floats) -> Floats:
    """The shared unknowns from windows of another length: longer ones, or shorter where those would be too few."""
    longer = replace(problem, asked=replace(problem.asked, window=OTHER * window_of(problem)))
    shorter = replace(problem, asked=replace(problem.asked, window=window_of(problem) / OTHER))
    enough = FEWEST * len(shared) * window_of(longer) <= _seconds(problem)
    cut = windowed(longer if enough else shorter)
    begun = _begun(cut, shared)
    at, _ = _search(cut, begun, _weights(cut, begun))
    return at.shared


def _seconds(problem: Problem) -> float:
    return sum(len(record.currents) for record in problem.records) * problem.bench.timing.sample_time


def predict_windows(problem: Problem, values: Floats) -> tuple[float, float, int]:
    """Prediction of the windows of records with given parameters, each from the start that fits it best.

    Args:
        problem: records, model and unknowns.
        values: of the unknowns, SI units.

    Returns:
        Root mean square of the angle's error [rad], χ² of the samples, and its degrees of freedom.
    """
    cut = windowed(problem)
    begun = _begun(cut, values / problem.units)
    weights = _weights(cut, begun)
    at = _restarted(cut, _settled(cut, begun, weights), begun, weights)
    squares, samples, chi2, freedom = 0.0, 0, 0.0, 0
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        record = window.records[0]
        errors = (record.samples - window.predict(z, 0).shown)[record.measured]
        squares, samples = squares + float(errors[:, 0] @ errors[:, 0]), samples + len(errors)
        chi2 += float(np.sum((errors * root[record.measured]) ** 2))
        freedom += int((root > 0.0).sum()) - len(START)
    return math.sqrt(squares / samples), chi2, freedom


def window_of(problem: Problem) -> float:
    """Length of the windows [s]."""
    machine = problem.bench.machine
    return problem.asked.window or (machine.window if machine is not None else WINDOW)


def windowed(problem: Problem) -> list[Problem]:
    """The windows, each as a problem of its own with the angle and the velocity at its start as the last unknowns."""
    t_s = problem.bench.timing.sample_time
    length = max(round(window_of(problem) / t_s), SHORTEST)
    asked = replace(problem.asked, nuisances=(*problem.asked.nuisances, *START))
    derived = problem.plant.instruments.observer_bandwidth > 0.0
    cut = [window for record in problem.records for window in _cut(record, length, t_s if derived else 0.0)]
    if not cut:
        raise UsageError(f"method windows: no window of {length} periods has {SHORTEST} samples: expected longer ones")
    return [Problem(problem.bench, problem.plant, asked, (window,)) for window in cut]


def _cut(record: Record, length: int, t_s: float) -> list[Record]:
    """The windows of a record; one that begins with lost samples starts from the last that was received.

    An observer's velocity lags. Where it is one, and ``t_s`` is not 0, a window starts with the slope of a parabola
    through the angles around its start: a window that starts too slow may stick where the machine did not, and then
    nothing says which way to go.
    """
    found, angle, velocity = [], record.angle, record.velocity
    every = np.concatenate([[record.angle], record.samples[:, 0]])
    for begin in range(0, len(record.currents), length):
        end = min(begin + length, len(record.currents))
        samples = record.samples[begin:end]
        received = np.flatnonzero(np.isfinite(samples).all(axis=1))
        if len(received) >= min(SHORTEST, length) and (end - begin) * 2 >= length:
            late = None if record.late is None else record.late[begin:end]
            before = float(record.currents[begin - 1]) if begin else record.before
            currents = record.currents[begin:end]
            name = f"{record.name}[{begin}:{end}]"
            speed = _slope(every, begin, t_s) if t_s else velocity
            found.append(Record(name, currents, samples, angle, speed, 0.0, False, late, before=before))
        if len(received):
            angle, velocity = samples[received[-1]].tolist()
    return found


def _slope(angles: Floats, at: int, t_s: float) -> float:
    """Slope of a parabola through the angles around one of them [rad/s]."""
    near = np.arange(max(at - AROUND, 0), min(at + AROUND + 1, len(angles)))
    near = near[np.isfinite(angles[near])]
    if len(near) < 3:
        return 0.0
    return float(np.polyfit((near - at) * t_s, angles[near], 2)[1])


@dataclass(frozen=True, eq=False)
class _Point:
    """Values of all unknowns, scaled as in :class:`Problem`."""

    shared: Floats
    """Shape (p,)."""
    starts: Floats
    """Angle and velocity at the start of each window, shape (m, 2)."""

    def all(self) -> list[Floats]:
        """The unknowns of each window's problem."""
        return [np.concatenate([self.shared, start]) for start in self.starts]


def _begun(cut: Sequence[Problem], shared: Floats) -> _Point:
    """Each window at the start where it was seen."""
    return _Point(shared, np.array([window.nominal()[-len(START) :] for window in cut]))


def _weights(cut: Sequence[Problem], at: _Point) -> list[Floats]:
    """Inverse standard deviations of the samples of each window, zero where they do not count, shape (n, 2)."""
    return [window.weights(z)[0] for window, z in zip(cut, at.all(), strict=True)]


def _linearised(cut: Sequence[Problem], at: _Point, weights: Sequence[Floats]) -> list[_Window]:
    found = []
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        said = window.predict(z, 0)
        counts = root.ravel() > 0.0
        errors = (np.nan_to_num(window.records[0].samples - said.shown) * root).ravel()[counts]
        scale = np.array([1.0 / v if u.relative else 1.0 for u, v in zip(window.unknowns, z, strict=True)])
        rows = (said.sensitivities * root[:, None]).transpose(0, 2, 1).reshape(-1, len(z))[counts] * scale
        shared, own = rows[:, : -len(START)], rows[:, -len(START) :]
        lengths = np.linalg.norm(own, axis=0)
        unit = np.where(lengths > 0.0, lengths, 1.0)
        found.append(_Window(errors, shared, np.linalg.pinv(own / unit, rcond=_LOST) / unit[:, None], own))
    return found


def _cost(windows: Sequence[_Window]) -> float:
    return math.fsum(window.cost for window in windows)


def _moved(at: _Point, shared: Floats, windows: Sequence[_Window]) -> _Point:
    """The shared unknowns moved, and each start to where it fits best then, to first order."""
    change = shared - at.shared
    steps = [window.inverse @ (window.errors - window.shared @ change) for window in windows]
    return _Point(shared, at.starts + np.array(steps))


def _settled(cut: Sequence[Problem], at: _Point, weights: Sequence[Floats]) -> _Point:
    """The starts moved to where they fit best, the shared unknowns as they are."""
    for _ in range(SETTLED):
        at = _moved(at, at.shared, _linearised(cut, at, weights))
    return at


def _search(cut: Sequence[Problem], begun: _Point, weights: Sequence[Floats]) -> tuple[_Point, End]:
    """One local search, again from better starts of the windows as long as there are any."""
    at, end = _descended(cut, begun, weights)
    evaluations = end.evaluations
    for _ in range(RESTARTS):
        again, lower = _descended(cut, _restarted(cut, at, begun, weights), weights)
        evaluations += lower.evaluations
        better = lower.cost < (1.0 - RESTARTED) * end.cost
        if lower.cost < end.cost:
            at, end = again, lower
        if not better:
            break
    origin = tuple((begun.shared * _units(cut)).tolist())
    return at, replace(end, start=origin, evaluations=evaluations)


def _restarted(cut: Sequence[Problem], at: _Point, begun: _Point, weights: Sequence[Floats]) -> _Point:
    """Each window at the better one of its start and of where it was seen to start, parameters unchanged.

    A window may have come to stick, or to move where the machine stuck, and nothing at its own start leads it back.
    """
    fresh = _settled(cut, _Point(at.shared, begun.starts), weights)
    pairs = zip(_linearised(cut, at, weights), _linearised(cut, fresh, weights), strict=True)
    better = np.array([new.cost < old.cost for old, new in pairs])
    return _Point(at.shared, np.where(better[:, None], fresh.starts, at.starts))


def _descended(
    cut: Sequence[Problem], begun: _Point, weights: Sequence[Floats], most: int = ITERATIONS
) -> tuple[_Point, End]:
    """One descent by Levenberg and Marquardt, damped in what the windows share."""
    at, damping, converged, evaluations, p = begun, _DAMPING, False, 1, len(begun.shared)
    low, high = (bounds[:p] for bounds in cut[0].bounds)
    windows = _linearised(cut, at, weights)
    cost = _cost(windows)
    while evaluations < most and not converged:
        normal, score = np.zeros((p, p)), np.zeros(p)
        for window in windows:
            errors, columns = window.projected()
            normal += columns.T @ columns
            score += columns.T @ errors
        diagonal = np.diag(normal)
        shift = np.diag(np.where(diagonal > 0.0, diagonal, 1.0))
        lower = math.inf
        while evaluations < most and damping < _MOST_DAMPING:
            step = np.linalg.solve(normal + damping * shift, score)
            after = _moved(at, np.clip(at.shared + step, low, high), windows)
            trial = _linearised(cut, after, weights)
            evaluations += 1
            lower = _cost(trial)
            if lower <= cost:
                break
            damping *= 10.0
        if not lower <= cost:
            break
        converged = cost - lower <= CONVERGED * cost
        at, windows, cost, damping = after, trial, lower, max(damping / 10.0, 1e-12)
    units = _units(cut)
    values, origin = (tuple((z * units).tolist()) for z in (at.shared, begun.shared))
    return at, End(cost, values, origin, converged or damping >= _MOST_DAMPING, evaluations)


def _units(cut: Sequence[Problem]) -> Floats:
    result: Floats = cut[0].units[: -len(START)]
    return result


def _finished(
    problem: Problem,
    cut: Sequence[Problem],
    at: _Point,
    weights: Sequence[Floats],
    ends: tuple[End, ...],
    moved: Floats,
) -> Estimate:
    """Estimate of what the windows share, with its information, covariance and validation."""
    p = len(problem.unknowns)
    shared = at.shared
    scale = np.array([v if u.relative else 1.0 for u, v in zip(problem.unknowns, shared, strict=True)])
    parts = [window.projected() for window in _linearised(cut, at, weights)]
    information = sum((columns.T @ columns for _, columns in parts), np.zeros((p, p))) * np.outer(scale, scale)
    scores = np.array([columns.T @ errors for errors, columns in parts]) * scale
    change = moved / scale
    return estimate_at(
        problem,
        shared,
        information=information,
        prior=None,
        sandwich=by_windows(information, scores, _follows(cut)) + np.outer(change, change),
        validation=_validated(cut, at, weights),
        ends=ends,
        residuals=_residuals(problem, cut, at, weights),
        method="windows",
        caveats=_caveats(problem, len(cut)),
    )


def by_windows(information: Floats, scores: Floats, follows: Sequence[bool]) -> Floats:
    """Covariance from the scatter of the windows: H⁻¹ (Σ g g^T) H⁻¹, neighbours counted together.

    Args:
        information: H, shape (p, p).
        scores: g of each window, shape (m, p).
        follows: True for a window that begins where the one before it ends, length m.

    Returns:
        Shape (p, p); inf on the diagonal of unknowns that the windows do not identify.
    """
    m, p = scores.shape
    meat = scores.T @ scores
    reach = math.floor(4.0 * (m / 100.0) ** (2.0 / 9.0))
    run = np.cumsum(~np.asarray(follows, dtype=np.bool_))
    for lag in range(1, min(reach, m - 1) + 1):
        together = run[lag:] == run[:-lag]
        cross = scores[lag:][together].T @ scores[:-lag][together]
        meat += (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    spectrum = Spectrum(information)
    inverse = spectrum.inverse()
    inverse[spectrum.lost, spectrum.lost] = 0.0
    result: Floats = inverse @ meat @ inverse * (m / max(m - p, 1))
    result[spectrum.lost, spectrum.lost] = math.inf
    return result


def _span(window: Problem) -> tuple[str, int, int]:
    """Name of the record that a window is of, and its first period and the one after its last."""
    name, _, span = window.records[0].name.removesuffix("]").rpartition("[")
    begin, end = map(int, span.split(":"))
    return name, begin, end


def _follows(cut: Sequence[Problem]) -> list[bool]:
    """True for each window that begins where the one before it ends."""
    spans = [_span(window) for window in cut]
    return [False, *(a[0] == b[0] and a[2] == b[1] for a, b in pairwise(spans))]


def _validated(cut: Sequence[Problem], at: _Point, weights: Sequence[Floats]) -> ModelValidation:
    """Tests of the model on windows spread over the records."""
    p, count = len(at.shared), len(cut)
    few_enough = max(JUDGED // len(cut[0].records[0].currents), 2)
    chosen = sorted({round(k) for k in np.linspace(0, count - 1, min(count, few_enough)).tolist()})
    few = replace(cut[0], records=tuple(cut[i].records[0] for i in chosen))
    z, roots = np.concatenate([at.shared, at.starts[chosen].T.ravel()]), [weights[i] for i in chosen]
    errors, jacobian = few.jacobian(z, roots)
    found = examine(few, z, roots, by_record(errors, roots), jacobian, errors=errors)
    suspects = {s.name: replace(s, moves=s.moves[:p]) for s in found.suspects}
    return replace(found, suspects=tuple(suspects.values()), suspected=tuple(suspects[s.name] for s in found.suspected))


def _residuals(problem: Problem, cut: Sequence[Problem], at: _Point, weights: Sequence[Floats]) -> tuple[Floats, ...]:
    """Residuals of each record in standard deviations, NaN where lost or in no window, shape (n, 2)."""
    found = {record.name: np.full(record.samples.shape, np.nan) for record in problem.records}
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        name, begin, end = _span(window)
        errors = (window.records[0].samples - window.predict(z, 0).shown) * root
        found[name][begin:end] = np.where(root > 0.0, errors, np.nan)
    return tuple(found[record.name] for record in problem.records)


def _caveats(problem: Problem, windows: int) -> tuple[str, ...]:
    names = problem.asked.names
    said = [f"each of the {windows} windows of {window_of(problem):g} s has a start of its own"]
    if {"coulomb_asymmetry", "current_offset"} <= {*names}:
        said.append(
            "while the machine moves, a Coulomb friction by direction and an offset of the current are one and the "
            "same number: only standstill tells them apart"
        )
    return tuple(said)
