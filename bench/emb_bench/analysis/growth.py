"""Growth of the Fisher information over a run, and the part of the run and the sensor that it came from."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import quantity
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Estimate
from emb_bench.information.criteria import criteria
from emb_bench.information.identifiability import Spectrum

PARTS = 10  # Equal parts that a run is divided into


@dataclass(frozen=True, eq=False)
class Growth:
    """The physical Fisher information of one run at an estimate, over time; p unknowns, n samples."""

    labels: tuple[str, ...]  # The unknowns of this run
    params: tuple[str, ...]  # Labels of those of interest
    units: tuple[str, ...]  # Of the unknowns; empty where deviations are relative
    time: Floats  # Of each sample since the run began [s], shape (n,)
    log_det: Floats  # log det of the parameters of interest after each sample, shape (n,)
    lambda_min: Floats  # Smallest eigenvalue for them after each sample, shape (n,)
    deviations: Floats  # Cramér-Rao bounds after each sample, relative or in ``units``, shape (n, p)
    outputs: Floats
    """Share of angle and of velocity in the information on each unknown alone, shape (p, 2); 0 without any."""
    borders: Floats  # Borders between the parts of the run, begin and end included [s], shape (parts + 1,)
    parts: Floats  # Share of each part in the information on each unknown alone, shape (parts, p)
    gains: Floats
    """Gain of log det in each part, shape (parts,); NaN for the first, and where log det is −inf before the part."""
    samples: Floats  # Information of all samples, without prior knowledge, shape (p, p)
    shown: Floats = field(repr=False)  # Angle [rad] and velocity [rad/s] that the model predicts, shape (n, 2)

    def document(self) -> dict[str, Any]:
        """Everything but the prediction, by unknown where it is of one."""
        by_label = zip(self.labels, self.outputs.tolist(), strict=True)
        return {
            "unknowns": self.labels,
            "time": self.time,
            "log_det": self.log_det,
            "lambda_min": self.lambda_min,
            "cramer_rao": dict(zip(self.labels, self.deviations.T, strict=True)),
            "share_of_outputs": {
                label: {"angle": angle, "velocity": velocity} for label, (angle, velocity) in by_label
            },
            "parts": {
                "borders": self.borders,
                "log_det_gain": self.gains,
                "share": dict(zip(self.labels, self.parts.T, strict=True)),
            },
            "information_of_samples": self.samples,
        }


def growth(e: Estimate, number: int) -> Growth:
    """The information of one of an estimate's records, from the very derivatives that the estimation uses.

    Args:
        e: the estimate; the information is that of its model at its values, as if the sensors alone were noisy.
        number: of the record.
    """
    whole = Problem(e.bench, e.plant, e.asked, e.records)
    problem = Problem(e.bench, e.plant, e.asked, (e.records[number],))
    z = (e.values / whole.units)[whole.columns(number)]
    weights = problem.weights(z)
    n, size = len(weights[0]), len(z)
    units = problem.scale(z)
    rows = problem.jacobian(z, weights)[1] * units
    before, own = rows[2 * n :], rows[: 2 * n].reshape(n, 2, size)
    added = np.einsum("koi,koj->kij", own, own)
    history = before.T @ before + np.cumsum(added, axis=0)
    names = tuple(unknown.name for unknown in problem.unknowns)
    quantities = tuple(quantity(e.bench.machine, name) for name in names)
    factors = np.array([1.0 if u.relative else q.factor for u, q in zip(problem.unknowns, quantities, strict=True)])
    series = [criteria(matrix, names, e.asked.params) for matrix in history]
    log_det = np.array([c.log_det for c in series])
    squares = own**2
    edges = np.unique(np.linspace(0, n, min(PARTS, n) + 1).round().astype(int))
    ends = np.concatenate([[-np.inf], log_det[edges[1:] - 1]])
    return Growth(
        labels=tuple(shown.name for shown in quantities),
        params=tuple(quantity(e.bench.machine, name).name for name in e.asked.params),
        units=tuple("" if u.relative else q.unit for u, q in zip(problem.unknowns, quantities, strict=True)),
        time=np.arange(1, n + 1, dtype=np.float64) * e.bench.timing.sample_time,
        log_det=log_det,
        lambda_min=np.array([c.lambda_min for c in series]),
        deviations=factors * np.array([np.sqrt(np.diag(Spectrum(matrix).inverse())) for matrix in history]),
        outputs=_shares(squares.sum(axis=0).T, axis=1),
        borders=edges * e.bench.timing.sample_time,
        parts=_shares(np.add.reduceat(squares.sum(axis=1), edges[:-1], axis=0), axis=0),
        gains=np.array([b - a if np.isfinite(a) else np.nan for a, b in pairwise(ends)]),
        samples=added.sum(axis=0),
        shown=problem.predict(z, 0).shown,
    )


def _shares(amounts: Floats, axis: int) -> Floats:
    total = amounts.sum(axis=axis, keepdims=True)
    result: Floats = amounts / np.where(total > 0.0, total, 1.0)
    return result
