"""Comparison of excitations: its plan, its runs, and the scores of each candidate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import Floats
from emb_bench.numbers import Score
from emb_bench.parallel.processes import Lost, shared_out
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.config.plants import Instruments
from emb_runtime.errors import UsageError
from studies.comparison.candidates import Candidate
from studies.comparison.intervals import Indices, mean, median, rate, ratio, resampling, root_mean_square, score, upper
from studies.comparison.trials import Job, Played, Table, work

NOTHING = Score(math.nan, math.nan, math.nan)  # Score where there is no run


@dataclass(frozen=True)
class ComparisonPlan:
    """Plan of a comparison: parameters, brakes, plants and numbers of draws."""

    params: tuple[str, ...]  # Parameters that are unknown and estimated
    ranges: str  # Ranges that brakes are drawn from
    plants: tuple[str, ...]  # Plants; those other than the model are mismatched
    model: str  # Plant that all runs are estimated with
    brakes: int
    draws: int  # Draws of the noise on each brake; one on a mismatched plant, for there the noise hardly counts
    known: int  # On so many brakes the optimum for the known brake is searched for
    seed: int

    def check(self, bench: Bench) -> None:
        """Refuse what cannot be answered on a bench.

        Raises:
            UsageError: a parameter varies in the ranges but is not estimated, or a plant's instruments are not ideal.
            BenchFileError: the bench has no such ranges or plant.
        """
        ranges = bench.range_set(self.ranges)
        unknown = [n for n in self.params if n not in PARAMETER_NAMES]
        if unknown or not self.params or len(set(self.params)) < len(self.params):
            raise UsageError(f"--params: expected some of {', '.join(PARAMETER_NAMES)}, got {', '.join(self.params)}")
        hidden = [n for n in varied(bench, self.ranges) if n not in self.params]
        if hidden:
            raise UsageError(
                f"{', '.join(hidden)} varies in the ranges '{ranges.name}' and is not estimated: the others would be "
                "wrong by what it is: add it to --params or choose other --ranges"
            )
        for name in (self.model, *self.plants):
            if bench.plant(name).instruments != Instruments():
                ideal = ", ".join(n for n, plant in bench.plants.items() if plant.instruments == Instruments())
                raise UsageError(f"'{name}' has instruments that are not played here: expected some of {ideal}")
        if len(set(self.plants)) < len(self.plants):
            raise UsageError(f"a plant is named twice in {', '.join(self.plants)}: expected each once")


def varied(bench: Bench, ranges: str) -> tuple[str, ...]:
    """Names of the parameters that vary in a set of ranges.

    Raises:
        BenchFileError: the bench has no such ranges.
    """
    found = bench.range_set(ranges)
    return tuple(n for n in PARAMETER_NAMES if getattr(found.low, n) < getattr(found.high, n))


class Estimation(NamedTuple):
    """Accuracy of one parameter over a candidate's runs; relative errors, missed minima included.

    NaN where the candidate was stopped on every brake.
    """

    bound: float  # Median Cramér-Rao bound
    median: Score  # |error|
    upper: Score  # 95th percentile of |error|
    efficiency: Score
    """Root mean square of the error over its bound: 1 if the estimator reaches it. Of the runs that identify it."""
    covered: Score  # Coverage of the 95 % interval. Of the runs that identify it.
    told: float  # Share of all runs whose bound is below the parameter itself; none on a brake where one was stopped


class Standing(NamedTuple):
    """One candidate on one plant; information and estimates are of the brakes on which no run of it was stopped."""

    candidate: Candidate
    log_det: float  # Median; −inf if singular
    lambda_min: float  # Median
    of_best: Score  # D-efficiency against the best candidate in the same draw on the same brake, mean
    of_known: Score
    """D-efficiency against the optimum for the known brake, mean over the brakes where that was searched for."""
    stopped: Score  # Share of brakes on which a run under the shield left the limits, where the bench stops it
    stopped_free: Score  # Share of brakes on which a run without the shield left the limits, of one run for each brake
    home: float  # Share of runs that came to their end, and that at home, under the shield
    top_speed: float  # [rad/s]
    angles: tuple[float, float]  # Lowest and highest [rad]
    seconds: float  # Mean time on the bench until the brake is found to rest, runs that were stopped included [s]
    alarms: Score  # Share of runs in which the model validation raises the alarm
    missed: float  # Share of runs whose lowest minimum was not found, as far as the truth shows it
    parameters: tuple[Estimation, ...]


class Pair(NamedTuple):
    """The first candidate against another one, in one parameter, on the brakes on which neither was stopped."""

    other: str
    parameter: str
    ratio: Score  # Its median |error| over the other's
    sign: int
    """−1: first better; 1: first worse; 0: not significantly different. One that does not identify it is worse."""
    first_tells: bool  # In most runs
    other_tells: bool


@dataclass(frozen=True, eq=False)
class Comparison:
    """All runs, and what follows from them."""

    bench: Bench
    asked: ComparisonPlan
    candidates: tuple[Candidate, ...]
    tables: dict[str, Table]  # By plant, runs of shape (candidates, brakes, draws)
    optima: Floats
    """log det of the best design for each brake if it were known, NaN where not searched, shape (brakes,)."""

    @cached_property
    def indices(self) -> Indices:
        """Indices of the bootstrap."""
        return resampling(self.asked.brakes, self.asked.seed)

    @property
    def matched(self) -> Table | None:
        """Runs on the plant that is the model."""
        return self.tables.get(self.asked.model)

    @cached_property
    def standings(self) -> dict[str, tuple[Standing, ...]]:
        """By plant, in the order of the candidates."""
        return {
            name: tuple(self._standing(name, table, i) for i in range(len(self.candidates)))
            for name, table in self.tables.items()
        }

    def completed(self, plant: str, *candidates: int) -> NDArray[np.bool_]:
        """Mask of the brakes on which no run of these candidates was stopped, shape (brakes,)."""
        return ~np.asarray(self.tables[plant]["stopped"][list(candidates)].any(axis=(0, 2)))

    def errors(self, plant: str, candidate: int, parameter: int) -> Floats:
        """|relative error| of each run, NaN of one that was stopped, shape (brakes, draws)."""
        result: Floats = np.abs(self.tables[plant]["error"][candidate, :, :, parameter])
        return result

    def _standing(self, plant: str, table: Table, i: int) -> Standing:
        runs, size, completed = table[i], len(self.asked.params), self.completed(plant, i)
        whole, reference = runs[completed], table["log_det"].max(axis=0)[completed]
        known = np.isfinite(self.optima) & completed & (plant == self.asked.model)
        some = bool(completed.any())
        indices = self._resampled(completed)
        return Standing(
            candidate=self.candidates[i],
            log_det=float(np.median(whole["log_det"])) if some else math.nan,
            lambda_min=float(np.median(whole["lambda_min"])) if some else math.nan,
            of_best=score(efficiency(whole["log_det"], reference, size), mean, indices) if some else NOTHING,
            of_known=self._of_known(runs["log_det"][known], self.optima[known, None]),
            stopped=rate(~completed[:, None], self.indices),
            stopped_free=rate(runs["stopped_free"][:, :1], self.indices),
            home=float(runs["home"].mean()),
            top_speed=float(runs["speed"].max()),
            angles=(float(runs["low"].min()), float(runs["high"].max())),
            seconds=float(runs["seconds"].mean()),
            alarms=rate(whole["alarm"], indices) if some else NOTHING,
            missed=float(whole["missed"].mean()) if some else math.nan,
            parameters=tuple(self._estimation(runs, completed, j) for j in range(size)),
        )

    def _resampled(self, brakes: NDArray[np.bool_]) -> Indices:
        """Indices of a bootstrap over some of the brakes; of no use if there is none."""
        return resampling(max(1, int(brakes.sum())), self.asked.seed)

    def _of_known(self, log_det: Floats, optima: Floats) -> Score:
        if not len(optima):
            return NOTHING
        indices = resampling(len(optima), self.asked.seed)
        return score(efficiency(log_det, optima, len(self.asked.params)), mean, indices)

    def _estimation(self, runs: Table, completed: NDArray[np.bool_], j: int) -> Estimation:
        error, bound, told = runs["error"][:, :, j], runs["bound"][:, :, j], runs["told"][:, :, j]
        size = np.abs(error)
        brakes = np.asarray(told.all(axis=1))  # one that is not identified in some draw is left out as a whole
        reached, covered = NOTHING, NOTHING
        if brakes.any():
            indices = self._resampled(brakes)
            reached = score(error[brakes] / bound[brakes], root_mean_square, indices)
            covered = rate(runs["covered"][brakes, :, j], indices)
        some, indices = bool(completed.any()), self._resampled(completed)
        return Estimation(
            bound=float(np.median(bound[completed])) if some else math.nan,
            median=score(size[completed], median, indices) if some else NOTHING,
            upper=score(size[completed], upper, indices) if some else NOTHING,
            efficiency=reached,
            covered=covered,
            told=float((told & completed[:, None]).mean()),
        )

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The first candidate against each other one in each parameter, where the model is the brake's."""
        found = []
        for i in range(1, len(self.candidates)) if self.matched is not None else ():
            for j, name in enumerate(self.asked.params):
                ours, theirs = self.errors(self.asked.model, 0, j), self.errors(self.asked.model, i, j)
                both = self.completed(self.asked.model, 0, i)
                between = ratio(ours[both], theirs[both], median, self._resampled(both)) if both.any() else NOTHING
                sign = int(between.low > 1.0) - int(between.high < 1.0)
                tells = [self.standings[self.asked.model][n].parameters[j].told > 0.5 for n in (0, i)]
                if not all(tells):  # an error is where a search began, then, and may be small by chance
                    sign = int(tells[1]) - int(tells[0])
                found.append(Pair(self.candidates[i].name, name, between, sign, tells[0], tells[1]))
        return tuple(found)


def efficiency(log_det: Floats, reference: Floats, size: int) -> Floats:
    """D-efficiency: the square of the ratio of standard deviations, in the geometric mean; 0 if singular."""
    with np.errstate(invalid="ignore"):  # nothing against nothing
        result: Floats = np.nan_to_num(np.exp((log_det - reference) / size))
    return result


def compare(bench: Bench, asked: ComparisonPlan, candidates: Sequence[Candidate], jobs: int) -> Comparison:
    """Play everything; the numbers do not depend on the number of processes.

    Args:
        bench: what is played on.
        asked: plan of the comparison.
        candidates: the first one is compared with each other one.
        jobs: processes.

    Raises:
        UsageError: it cannot be answered on this bench, or a process has died.
        PolicyRefusedError: an actor requests a current that is not finite.
    """
    asked.check(bench)
    everything = [
        Job(
            bench=bench.text,
            candidates=tuple(candidates),
            plant=plant,
            model=asked.model,
            params=asked.params,
            ranges=asked.ranges,
            seed=asked.seed,
            brake=brake,
            draws=asked.draws if plant == asked.model else 1,
            optimum=plant == asked.model and brake < asked.known,
        )
        for plant in asked.plants
        for brake in range(asked.brakes)
    ]
    played = _shared_out(everything, jobs)
    tables = {
        plant: np.stack([one.table for one in played[n * asked.brakes : (n + 1) * asked.brakes]], axis=1)
        for n, plant in enumerate(asked.plants)
    }
    optima = np.full(asked.brakes, math.nan)
    if asked.model in asked.plants:
        first = asked.plants.index(asked.model) * asked.brakes
        optima = np.array([one.optimum for one in played[first : first + asked.brakes]])
    return Comparison(bench, asked, tuple(candidates), tables, optima)


def _shared_out(everything: Sequence[Job], jobs: int) -> list[Played]:
    found = dict[int, Played]()
    with closing(shared_out(work, everything, jobs)) as results:
        for number, played in results:
            if isinstance(played, Lost):
                raise UsageError(
                    f"a process {played.how} before its work was done, out of memory perhaps: fewer --jobs"
                )
            found[number] = played
    return [found[number] for number in range(len(everything))]
