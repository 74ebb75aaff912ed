"""Statements of sections 4.3 and 4.4 about Fig. 4.2 and 4.3, checked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from studies.thesis.determinant import AMPLITUDE, EPSILON, SETTLED, SPIKE, protected, unprotected
from studies.thesis.facts import Statement

SIZE = len(PARAMETER_NAMES)
LARGEST_SINGLE = math.log10(float(np.finfo(np.float32).max))
LARGEST_DOUBLE = math.log10(float(np.finfo(np.float64).max))
ROUNDING = 1e-9  # Relative difference that rounding may leave between two ways to compute the same


def unprotected_facts(bench: Bench) -> list[Statement]:
    """Fig. 4.2, and the same with the largest current allowed."""
    f, strongest = unprotected(bench, AMPLITUDE), unprotected(bench, bench.limits.current)
    regular = f.ranks == SIZE
    negative = f.determinants_single < 0.0
    late = np.flatnonzero(negative & regular) + 1
    negative_double, negative_exact = int((f.determinants < 0.0)[regular].sum()), int((f.signs_exact < 0).sum())
    first = int(np.argmax(regular)) + 1
    ratio = (f.conditions_single[SETTLED:] / f.conditions[SETTLED:]).max()
    jump = _largest_jump(f.conditions)
    jump_single = _largest_jump(f.conditions_single)
    decades = float(strongest.log_exact[-1]) / math.log(10.0)
    return [
        (
            "4.4",
            "the determinant is negative at some samples, where its logarithm is no number: log |M| has gaps",
            f"at {f.amplitude:g} A in single precision, PyTorch's default, {len(late)} samples have |M| < 0 after |M| "
            f"has become regular ({_spans(late)}); in double precision {negative_double}",
            len(late) > 0,
        ),
        (
            "4.4",
            "a determinant of a Fisher information cannot be negative: these come from rounding",
            f"computed in rational numbers, {negative_exact} of {len(f.signs_exact)} determinants are negative",
            negative_exact == 0,
        ),
        (
            "4.4",
            "at several intervals the condition number spikes: there the matrix is nearly singular",
            f"the spikes are {'there without rounding' if jump > SPIKE else 'rounding'} too: from one sample to the "
            f"next the condition number changes by up to {jump_single:.3g} times in single precision and by {jump:.3g} "
            f"in double; the two differ by up to {ratio:.3g} times (after sample {SETTLED})",
            bool(jump > SPIKE),
        ),
        (
            "4.4",
            "each sample updates the Fisher information by a matrix of rank one",
            f"there are two outputs: the rank of an increment is {f.increment_rank}",
            f.increment_rank == 1,
        ),
        (
            "4.4",
            "the determinant cannot be other than zero before n samples, n the number of parameters",
            f"from rest |M| is first regular at sample {first} of n = {SIZE}; not for the rank of the increments, but "
            "because each of the first samples tells one combination of parameters more",
            first >= SIZE,
        ),
        (
            "4.4",
            "the determinant grows so fast that this could lead to an overflow",
            f"{len(strongest.log_exact)} samples at {strongest.amplitude:g} A reach 1e{decades:.1f}; single precision "
            f"ends at 1e{LARGEST_SINGLE:.1f}, double at 1e{LARGEST_DOUBLE:.1f}",
            None,
        ),
    ]


def protected_facts(bench: Bench) -> list[Statement]:
    """Fig. 4.3, and the equations behind it."""
    f, cured = unprotected(bench, AMPLITUDE), protected(bench, AMPLITUDE, EPSILON)
    start = SIZE * math.log(cured.epsilon)
    gaps = int((~np.isfinite(cured.log_normalised)).sum())
    failing = {epsilon: count for epsilon, count in cured.failures_single.items() if count}
    raised = np.linalg.eigvalsh(f.fims + cured.epsilon * np.eye(SIZE)) - np.linalg.eigvalsh(f.fims)
    scale = np.linalg.eigvalsh(f.fims)[:, -1:]
    shift = float(np.abs((raised - cured.epsilon) / scale).max())
    effect = float(cured.log_det[-1] - f.log_exact[-1])
    direct = np.diff([start, *_log_dets(f.fims + cured.epsilon * np.eye(SIZE))])
    unchanged = float(np.abs(cured.rewards - direct)[SETTLED:].max())
    printed = _printed_normalisation(cured.log_det, start)
    drift, drift_printed = float(np.abs(cured.log_normalised[-1] - start)), float(np.abs(printed[-1] - start))
    peak = int(np.argmax(cured.conditions))
    third = float(cured.log_normalised[-1] - cured.log_alpha[-1] - cured.log_det[-1])
    total, final = float(cured.rewards.sum()), float(cured.log_det[-1])
    return [
        (
            "4.4.2",
            "initialised and normalised, |M| is positive and its logarithm continuous",
            f"in double precision, with epsilon = {cured.epsilon:g}, {gaps} of {len(cured.rewards)} samples have no "
            "logarithm",
            gaps == 0,
        ),
        (
            "4.4.1",
            "a sufficiently small epsilon I keeps the matrix from being singular to the computer",
            "in single precision it does not: |M| is not positive at "
            + "; ".join(f"{count} samples with {epsilon:g}" for epsilon, count in cured.failures_single.items())
            + ". It has to be larger than the rounding of the largest element; in double precision any serves",
            not failing,
        ),
        (
            "4.4.2",
            "the condition number grows continuously as the experiment goes on",
            f"it rises to {cured.conditions[peak]:.2g} at sample {peak + 1} and falls to {cured.conditions[-1]:.2g} at "
            "the end: every sample tells more of the worst-known direction",
            bool((np.diff(cured.conditions) > 0.0).all()),
        ),
        (
            "eq. 4.34",
            "every eigenvalue of the sum grows by epsilon",
            f"to {shift:.1g} of the largest eigenvalue, which is rounding",
            shift < ROUNDING,
        ),
        (
            "4.4.1",
            "the initialisation hardly changes the result",
            f"log |M| at the end grows by {effect:.1g}",
            abs(effect) < 1e-3,
        ),
        (
            "eq. 4.36",
            "the normalisation leaves the step rewards unchanged",
            f"they differ from log |M_k| - log |M_(k-1)| by {unchanged:.1g} at most (after sample {SETTLED})",
            unchanged < 1e-6,
        ),
        (
            "eq. 4.36, third line",
            "alpha_k |M_k| stands for the normalised determinant",
            f"that is |alpha_k M_k| = alpha_k^n |M_k|: at the end their logarithms differ by {third:.3g}",
            abs(third) < ROUNDING,
        ),
        (
            "eq. 4.39",
            "with alpha_k as printed the normalised determinant stays near that of the initial matrix",
            f"its logarithm ends {drift_printed:.3g} away from it, half of what |M| has grown; with the ratio "
            f"alpha_k / alpha_(k-1) in place of alpha_k it ends {drift:.2g} away",
            drift_printed < 1.0,
        ),
        (
            "eq. 4.12",
            "the step rewards add up to log |M_n|",
            f"they add up to {total:.4g}, log |M_n| is {final:.4g}: what they begin from, log |M_init| = {start:.4g}, "
            "is missing",
            abs(total - final) < 1e-6 * abs(final),
        ),
    ]


def _largest_jump(conditions: Floats) -> float:
    """Largest factor between neighbours once every parameter is identified."""
    return float(np.exp(np.abs(np.diff(np.log(conditions[SETTLED:]))).max()))


def _spans(samples: NDArray[np.int64]) -> str:
    """``340-351, 354`` for a person; ``none`` if there are none."""
    if not len(samples):
        return "none"
    runs = np.split(samples, np.flatnonzero(np.diff(samples) > 1) + 1)
    return "samples " + ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _log_dets(fims: Floats) -> list[float]:
    return [float(v) for v in np.linalg.slogdet(fims)[1]]


def _printed_normalisation(log_det: Floats, start: float) -> Floats:
    """Logarithms of |M̄_k| under eq. 4.39 as printed: α_k^n = |M_init| / |M̄_{k−1}|, |M̄_k| = α_k^n |M_k|."""
    values = [start]
    for value in log_det.tolist():
        values.append(start - values[-1] + value)
    return np.array(values[1:])
