"""Section 6.1: viscous friction and stiffness together, a, b, c, d and their information, on the Euler brake."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from emb_bench.brake.euler import sensitivity_step
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import F_V, K_1
from emb_bench.config.bench import Bench
from emb_bench.excitation import Response, parse_excitation, run_excitation
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.information.criteria import criteria
from emb_bench.information.fisher import information_over_time, thesis_weights
from studies.thesis.facts import Statement

PARAMS = ("f_v", "k_1")
FASTEST = "constant-speed:turn=0.2"
EXCITATIONS = (FASTEST, "square", "chirp", "multisine")
"""Texts for :func:`emb_bench.excitation.parse_excitation`."""
HELD = (30.0, 60.0, 90.0)  # rad
FREE = 300  # Samples of an experiment without a return (section 5.2)
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Excited:
    """One excitation of the nominal brake, limits kept and home at the end, and its information."""

    name: str
    response: Response
    s: Floats  # a, b in [:, 0], c, d in [:, 1]: sensitivities to f_v and k_1 (eq. 6.2), shape (n, 2, 2).
    increments: Floats  # Increments of the weighted FIM (eq. 6.3), shape (n, 2, 2).

    @property
    def fim(self) -> Floats:
        """Matrix of the whole experiment, shape (2, 2)."""
        total: Floats = self.increments.sum(axis=0)
        return total

    @property
    def correlation(self) -> float:
        """Correlation of the two parameters' estimates, from M⁻¹."""
        m = self.fim
        return float(-m[0, 1] / np.sqrt(m[0, 0] * m[1, 1]))


def excited(bench: Bench, text: str) -> Excited:
    """Run a reference excitation, without noise."""
    excitation = parse_excitation(text, bench)
    plant, t_s = bench.plant("euler"), bench.timing.sample_time
    response = run_excitation(bench, excitation, plant.mechanics, bench.brake, shielded=True)
    s = simulate(plant, Theta(bench.brake), planned(response.currents), t_s, PARAMS).sensitivities
    history = information_over_time(s, thesis_weights(bench.noise, bench.limits))
    return Excited(excitation.name, response, s, np.diff(history, axis=0, prepend=np.zeros((1, 2, 2))))


def two_parameter_facts(bench: Bench) -> list[Statement]:
    """Checks the statements of section 6.1."""
    runs = [excited(bench, name) for name in EXCITATIONS]
    weights = thesis_weights(bench.noise, bench.limits)
    printed = max(_relative(_printed_increments(run.s), run.increments) for run in runs)
    held = {angle: _held_increment(bench, angle) for angle in HELD}
    outside = {run.name: int((run.response.states[:-1, 0] < 0.0).sum()) for run in runs}
    literal = {run.name: _relative_diagonal(_as_printed(bench, run), run.fim) for run in runs}
    worst = max(literal, key=lambda name: literal[name])
    correlations = {run.name: run.correlation for run in runs}
    dets = {name: _free_log_det(bench, name) for name in (FASTEST, "square")}
    return [
        (
            "eq. 6.3",
            "the product of the matrices is the printed increment, 100 a^2 + b^2 / 250000 and so on",
            f"the two differ by {printed:.1g} of the largest element, over {len(runs)} excitations",
            printed < ROUNDING,
        ),
        (
            "6.1",
            "the stiffness is told better at a greater angle",
            "held at rest, the increment of k_1 settles at "
            + ", ".join(f"{value:.4g} at {angle:g} rad" for angle, value in held.items())
            + ": 100 x1^2, for c settles at -x1",
            all(abs(value / (weights.angle * angle**2) - 1.0) < 0.01 for angle, value in held.items()),
        ),
        (
            "eq. 6.1",
            "out of contact only the input of c and d vanishes; the matrix keeps its spring",
            f"by eq. 3.13 the spring goes as well. Kept, it changes the diagonal of the FIM by "
            f"{100.0 * literal[worst]:.2g} % with {worst}, which is out of contact in {outside[worst]} samples, and by "
            f"{100.0 * literal['constant-speed']:.2g} % with constant-speed",
            literal[worst] < 0.01,
        ),
        (
            "6.1",
            "the two parameters are correlated through 100 a c + b d / 250000",
            "of the two estimates, " + ", ".join(f"{value:+.3f} with {name}" for name, value in correlations.items()),
            max(map(abs, correlations.values())) > 0.1,
        ),
        (
            "6.2.2",
            "it can be suggested that periodic inputs help these two parameters efficiently; compared for this: the "
            "20 ms, 6 A square wave",
            f"log |M| after {FREE} samples without a return is "
            + ", ".join(f"{value:.1f} with {name}" for name, value in dets.items()),
            None,
        ),
    ]


def _printed_increments(s: Floats) -> Floats:
    """The last line of eq. 6.3, with its own numbers."""
    a, b, c, d = s[:, 0, 0], s[:, 0, 1], s[:, 1, 0], s[:, 1, 1]
    cross = 100.0 * a * c + b * d / 250000.0
    rows = [[100.0 * a**2 + b**2 / 250000.0, cross], [cross, 100.0 * c**2 + d**2 / 250000.0]]
    return np.moveaxis(np.array(rows), 2, 0)


def _held_increment(bench: Bench, angle: float) -> float:
    """The increment for k_1 of a brake that has been held at an angle for long."""
    weights = thesis_weights(bench.noise, bench.limits)
    c = d = 0.0
    for _ in range(10 * bench.timing.horizon):
        c, d = sensitivity_step(bench.brake, angle, 0.0, 0.0, bench.timing.sample_time, c, d, K_1)
    return weights.angle * c**2 + weights.velocity * d**2


def _free_log_det(bench: Bench, name: str) -> float:
    """Information in the thesis's 300 samples where the limits are kept but no return is asked for."""
    unhurried = replace(bench, timing=replace(bench.timing, horizon=FREE + bench.timing.horizon))
    history = np.cumsum(excited(unhurried, name).increments, axis=0)
    return criteria(history[FREE - 1], PARAMS).log_det


def _as_printed(bench: Bench, run: Excited) -> Floats:
    """The FIM by eq. 6.1 as printed: out of contact the spring's torque is zero, its stiffness is not.

    The recursion at x1 = 0 is just that.
    """
    t_s = bench.timing.sample_time
    s = np.zeros((len(run.s), 2, 2))
    now = [(0.0, 0.0), (0.0, 0.0)]
    for k, (u, (x1, x2)) in enumerate(zip(run.response.currents.tolist(), run.response.states.tolist(), strict=False)):
        now = [
            sensitivity_step(bench.brake, max(x1, 0.0), x2, u, t_s, *pair, i)
            for i, pair in zip((F_V, K_1), now, strict=True)
        ]
        s[k] = now
    total: Floats = information_over_time(s, thesis_weights(bench.noise, bench.limits))[-1]
    return total


def _relative(value: Floats, reference: Floats) -> float:
    return float(np.abs(value - reference).max() / np.abs(reference).max())


def _relative_diagonal(value: Floats, reference: Floats) -> float:
    return float(np.abs(np.diag(value) / np.diag(reference) - 1.0).max())
