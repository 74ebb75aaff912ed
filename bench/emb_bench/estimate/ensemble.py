"""An ensemble of draws from the posterior: uncertainty that need not be Gaussian.

Where the data identify little, or only a bound on one side (a brake that sticks has at least so much friction), an
ellipse around the minimum is a poor description. Here the unknowns are drawn from their posterior density, −χ²/2 of
output error plus the prior: Gaussian for what the prior varies, and uniform for the rest, both within the bounds of the
search.

The sampler is an ensemble of walkers that propose from each other's places, so that no scale or correlation needs to be
known (Foreman-Mackey et al., emcee: The MCMC Hammer, PASP 125, 2013; differential evolution moves of ter Braak 2006 and
Nelson et al. 2014). Walkers begin around all minima within reach of the best one, as many as belong there if each were
Gaussian. The first part of the chains is left out, and the draws are thinned, by the autocorrelation time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from emb_bench.brake.motion import SENSITIVE, STATES, Floats
from emb_bench.compiled import compiled
from emb_bench.estimate import output_error
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import FEATURES, End, Estimate
from emb_bench.sim.open_loop import advance_period
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics
from emb_runtime.errors import UsageError

REACH = 25.0  # Minima whose sum of squares is larger by more than this have no walkers: five standard deviations
APART = 1.0
"""Ends of searches that lie closer, in standard deviations and by the root of the unknowns' number, are one minimum."""
WALKERS = 32  # At least; four for each unknown if that is more
BURN, ENOUGH = 5, 50  # Autocorrelation times that are left out at the beginning, and that the rest should last
STEP = 200  # Steps between looks at the autocorrelation time
PERIODS = 2.5e7  # Simulated periods after which the chains end in any case: 50000 records of 500


def estimate(problem: Problem, *, starts: int, seed: int) -> Estimate:
    """Draw parameters from their posterior. The values are the medians of the draws.

    Information, residuals and the verdict on the model are those of the best minimum.

    Args:
        problem: records, model and unknowns.
        starts: local searches for the minima.
        seed: of the random numbers.

    Raises:
        UsageError: ``starts`` is below 1, or emcee is missing.
    """
    try:
        import emcee
    except ImportError as err:
        raise UsageError("an ensemble of posterior draws needs emcee: pip install 'emb-excite[bench]'") from err
    if features := [name for name in problem.asked.names if name in FEATURES]:
        raise UsageError(f"an ensemble moves all its brakes by one plant: {', '.join(features)}: use --method oem")
    best = output_error.estimate(problem, starts=starts, seed=seed)
    problem = replace(problem, records=best.records)
    weights = problem.weights(best.values / problem.units)
    low, high = problem.bounds
    least = best.ends[0].cost

    def log_posterior(z: Floats) -> Floats:
        inside = ((z >= low) & (z <= high)).all(axis=1)
        result = np.full(len(z), -math.inf)
        result[inside] = -0.5 * (sums_of_squares(problem, z[inside], weights) - least)
        return result

    rng = np.random.default_rng(seed)
    begin = walkers(problem, minima(problem, best.ends, weights), rng)
    moves = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*begin.shape, log_posterior, moves=moves, vectorize=True)
    state = np.random.RandomState(seed % 2**32).get_state()
    longest = int(PERIODS / sum(len(r.currents) for r in problem.records) / len(begin))
    tau = _sample(sampler, emcee.State(begin, random_state=state), longest)
    steps = sampler.iteration
    burn = min(int(BURN * tau), steps // 2)
    z = sampler.get_chain(discard=burn, thin=max(1, int(0.5 * tau)), flat=True)
    values = np.median(z, axis=0)
    return replace(
        best,
        method="ensemble",
        values=values * problem.units,
        theta=problem.theta(values),
        draws=z * problem.units,
        caveats=_caveats(best, z, tau, steps - burn),
    )


def minima(problem: Problem, ends: Sequence[End], weights: Sequence[Floats]) -> list[tuple[Floats, Floats, float]]:
    """Minima within reach of the best: z, the covariance there, and the logarithm of the mass if it were Gaussian.

    Along directions that the data do not identify, the covariance is that of the bounds.
    """
    low, high = problem.bounds
    wide = np.diag(12.0 / (high - low) ** 2)
    found: list[tuple[Floats, Floats, float]] = []
    for end in ends:
        if end.cost - ends[0].cost > REACH:
            break
        z = np.array(end.values) / problem.units
        _, jacobian = problem.jacobian(z, weights)
        information = jacobian.T @ jacobian + wide
        if any((z - other) @ information @ (z - other) < APART * len(z) for other, _, _ in found):
            continue
        covariance = np.linalg.inv(information)
        mass = -0.5 * end.cost - 0.5 * float(np.linalg.slogdet(information)[1])
        found.append((z, 0.5 * (covariance + covariance.T), mass))
    return found


def walkers(problem: Problem, places: Sequence[tuple[Floats, Floats, float]], rng: np.random.Generator) -> Floats:
    """Starts of the walkers, shape (walkers, unknowns): around the minima by their mass, within the bounds."""
    count = max(WALKERS, 4 * len(problem.unknowns))
    masses = np.exp(np.array([mass for _, _, mass in places]) - max(mass for _, _, mass in places))
    edges = np.round(count * np.cumsum(masses) / masses.sum()).astype(int)
    low, high = problem.bounds
    begin = np.empty((count, len(low)))
    for (z, covariance, _), first, last in zip(places, [0, *edges[:-1].tolist()], edges.tolist(), strict=True):
        begin[first:last] = rng.multivariate_normal(z, covariance, last - first, method="eigh")
    folded = np.mod(begin - low, 2.0 * (high - low))  # at the borders as in a mirror
    return np.asarray(low + np.minimum(folded, 2.0 * (high - low) - folded), dtype=np.float64)


def _sample(sampler: Any, state: Any, longest: int) -> float:
    """Run until the chains last long enough, or as long as they may. Gives their autocorrelation time in steps."""
    tau = math.inf
    while sampler.iteration < longest and sampler.iteration < (BURN + ENOUGH) * tau:
        steps = min(STEP, longest - sampler.iteration)
        state = sampler.run_mcmc(state, steps, skip_initial_state_check=True)
        with np.errstate(divide="ignore", invalid="ignore"):  # of chains that never moved
            times = sampler.get_autocorr_time(tol=0)
        tau = float(np.max(np.where(np.isfinite(times), times, sampler.iteration)))
        tau = max(tau, 1.0)
    return tau


def _caveats(best: Estimate, z: Floats, tau: float, steps: int) -> tuple[str, ...]:
    prior = "flat within the bounds of the search"
    if best.asked.prior is not None:
        prior += f", but Gaussian from the ranges '{best.asked.prior.name}' for {', '.join(best.asked.varied)}"
    said = [f"values and intervals are medians and quantiles of {len(z)} draws from a posterior; the prior is {prior}"]
    if steps < ENOUGH * tau:
        said.append(
            f"the chains may not have converged: they last {steps / tau:.0f} autocorrelation times, "
            f"expected at least {ENOUGH}"
        )
    return tuple(said)


# --- The density without derivatives --------------------------------------------------------------------------------


def sums_of_squares(problem: Problem, places: Floats, weights: Sequence[Floats]) -> Floats:
    """Sums of the squares of what :meth:`Problem.jacobian` calls residuals.

    Args:
        problem: records, model and unknowns.
        places: z of each place, shape (m, unknowns).
        weights: inverse standard deviations of the samples of each record, zero where one does not count.

    Returns:
        Shape (m,).
    """
    if any(record.open for record in problem.records):
        return np.array([float(np.sum(problem.jacobian(z, weights)[0] ** 2)) for z in places])
    totals = np.array([float(np.sum(problem.known(z)[0] ** 2)) for z in places])
    for i, (record, root) in enumerate(zip(problem.records, weights, strict=True)):
        starts = [problem.opening(z, i, ()) for z in places]
        compiled(add_squares)(
            problem.plant.mechanics,
            np.array([start.p for start in starts]),
            np.array([start.x[:2] for start in starts]),
            np.array([start.contact + start.offset for start in starts]),
            np.array([start.late for start in starts]),
            record.currents,
            problem.bench.timing.sample_time,
            problem.plant.instruments.measurement_delay,
            np.nan_to_num(record.samples),
            np.zeros(len(root)) if record.late is None else record.late,
            root,
            totals,
        )
    return totals


def add_squares(
    mechanics: Mechanics,
    brakes: Floats,
    starts: Floats,
    biases: Floats,
    lates: Floats,
    currents: Floats,
    t_s: float,
    delay: int,
    samples: Floats,
    stamps: Floats,
    root: Floats,
    totals: Floats,
) -> None:
    """Adds the sums of squares of one record; runs as it is or compiled.

    Args:
        mechanics: how the brakes move.
        brakes: their parameters, shape (m, 6).
        starts: angle [rad], from the contact on, and velocity [rad/s], shape (m, 2).
        biases: what is shown of a brake at the angle zero [rad], shape (m,).
        lates: shares of the period in which the command before still acts, shape (m,).
        currents: shape (n,) [A].
        t_s: period [s].
        delay: periods that a sample waits before it is sent.
        samples: angle [rad] and velocity [rad/s], shape (n, 2).
        stamps: how much later than on the grid each was taken [s], shape (n,).
        root: inverse standard deviations, shape (n, 2).
        totals: grow by the sums of squares, shape (m,).
    """
    # A loop of its own: keeping the states of every place would cost the ensemble a fifth of its time.
    n, chosen, s = currents.shape[0], np.zeros(0, np.int64), np.zeros((0, SENSITIVE))
    for m in range(brakes.shape[0]):
        b, bias = brakes[m], biases[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        x = np.zeros(STATES)
        x[0], x[1] = starts[m, 0], starts[m, 1]
        before = 0.0
        for i in range(n):
            k, acceleration, tau = i - delay, 0.0, stamps[i]
            if k >= 0:  # the first samples are of the brake at its start
                u, velocity = float(currents[k]), float(x[1])
                advance_period(mechanics, p, x, before, u, t_s, lates[m], chosen, s)
                before = u
                acceleration = (x[1] - velocity) / t_s
            # The brake goes on to the sample's stamp as it went through the period.
            first = (samples[i, 0] - x[0] - bias - tau * (x[1] + 0.5 * tau * acceleration)) * root[i, 0]
            second = (samples[i, 1] - x[1] - tau * acceleration) * root[i, 1]
            totals[m] += first * first + second * second
