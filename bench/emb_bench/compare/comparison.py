"""The comparison: what is asked, the runs that answer it, and what they amount to for each contestant."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context, resource_tracker
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.compare.contestants import Contestant
from emb_bench.compare.scores import (
    Indices,
    Score,
    mean,
    median,
    rate,
    ratio,
    resampling,
    root_mean_square,
    score,
    upper,
)
from emb_bench.compare.trials import Job, Played, Table, work
from emb_runtime.bench import PARAMETER_NAMES, Bench
from emb_runtime.errors import UsageError
from emb_runtime.plants import Instruments

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
"""One thread of linear algebra in each process: more of them wait for each other, and round differently."""


@dataclass(frozen=True)
class Asked:
    """What is compared, and on how much."""

    params: tuple[str, ...]
    """Unknown, and estimated."""
    ranges: str
    """Where brakes are drawn from."""
    plants: tuple[str, ...]
    """How they move; those that are not the model are what it does not match."""
    model: str
    """With which all is estimated."""
    brakes: int
    draws: int
    """Of the noise, on each brake; one where the model does not match, for there the noise hardly counts."""
    known: int
    """On so many brakes the optimum for the known brake is searched for."""
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
    """How well a contestant's runs tell one parameter; relative errors, of all runs, missed minima included."""

    bound: float
    """Median Cramér-Rao bound."""
    median: Score
    """|error|."""
    upper: Score
    """95th percentile of |error|."""
    efficiency: Score
    """Root mean square of the error over its bound: 1 if the estimator reaches it. Of the runs that tell it."""
    covered: Score
    """How often the 95 % interval holds the truth. Of the runs that tell it."""
    told: float
    """Share of runs whose bound is below the parameter itself."""


class Standing(NamedTuple):
    """One contestant on one plant."""

    contestant: Contestant
    log_det: float
    """Median; −inf if singular."""
    lambda_min: float
    """Median."""
    of_best: Score
    """D-efficiency against the best contestant in the same draw on the same brake, mean."""
    of_known: Score
    """D-efficiency against the optimum for the known brake, mean over the brakes where that was searched for."""
    left: Score
    """Share of brakes in which a run under the shield left the limits."""
    left_free: Score
    """The same without the shield, of one run for each brake."""
    home: float
    """Share of runs that ended at home, under the shield."""
    top_speed: float
    """[rad/s]."""
    angles: tuple[float, float]
    """Lowest and highest [rad]."""
    seconds: float
    """Mean time on the bench until the brake is found to rest [s]."""
    alarms: Score
    """How often the misfit test raises the alarm."""
    missed: float
    """Share of runs whose lowest minimum was not found, as far as the truth shows it."""
    parameters: tuple[Estimation, ...]


class Pair(NamedTuple):
    """The first contestant against another one, in one parameter."""

    other: str
    parameter: str
    ratio: Score
    """Its median |error| over the other's."""
    sign: int
    """−1: the first is better; 1: worse; 0: not told apart. One that does not tell the parameter is worse."""
    first_tells: bool
    """In most runs."""
    other_tells: bool


@dataclass(frozen=True, eq=False)
class Comparison:
    """All runs, and what follows from them."""

    bench: Bench
    asked: Asked
    contestants: tuple[Contestant, ...]
    tables: dict[str, Table]
    """By plant, runs of shape (contestants, brakes, draws)."""
    rulers: Floats
    """log det of the best design for each brake if it were known, NaN where not searched, shape (brakes,)."""

    @cached_property
    def indices(self) -> Indices:
        """Of the bootstrap."""
        return resampling(self.asked.brakes, self.asked.seed)

    @property
    def matched(self) -> Table | None:
        """Runs on the plant that is the model."""
        return self.tables.get(self.asked.model)

    @cached_property
    def standings(self) -> dict[str, tuple[Standing, ...]]:
        """By plant, in the order of the contestants."""
        return {
            name: tuple(self._standing(table, i, name == self.asked.model) for i in range(len(self.contestants)))
            for name, table in self.tables.items()
        }

    def errors(self, plant: str, contestant: int, parameter: int) -> Floats:
        """|relative error| of each run, shape (brakes, draws)."""
        result: Floats = np.abs(self.tables[plant]["error"][contestant, :, :, parameter])
        return result

    def _standing(self, table: Table, i: int, matched: bool) -> Standing:
        runs, size = table[i], len(self.asked.params)
        reference = table["log_det"].max(axis=0)
        known = np.isfinite(self.rulers) & matched
        left, left_free = ~runs["kept"].all(axis=1, keepdims=True), ~runs["kept_free"][:, :1]
        return Standing(
            contestant=self.contestants[i],
            log_det=float(np.median(runs["log_det"])),
            lambda_min=float(np.median(runs["lambda_min"])),
            of_best=score(efficiency(runs["log_det"], reference, size), mean, self.indices),
            of_known=self._of_known(runs["log_det"][known], self.rulers[known, None]),
            left=rate(left, self.indices),
            left_free=rate(left_free, self.indices),
            home=float(runs["home"].mean()),
            top_speed=float(runs["speed"].max()),
            angles=(float(runs["low"].min()), float(runs["high"].max())),
            seconds=float(runs["seconds"].mean()),
            alarms=rate(runs["alarm"], self.indices),
            missed=float(runs["missed"].mean()),
            parameters=tuple(self._estimation(runs, j) for j in range(size)),
        )

    def _of_known(self, log_det: Floats, rulers: Floats) -> Score:
        if not len(rulers):
            return Score(math.nan, math.nan, math.nan)
        indices = resampling(len(rulers), self.asked.seed)
        return score(efficiency(log_det, rulers, len(self.asked.params)), mean, indices)

    def _estimation(self, runs: Table, j: int) -> Estimation:
        error, bound, told = runs["error"][:, :, j], runs["bound"][:, :, j], runs["told"][:, :, j]
        size, brakes = np.abs(error), told.all(axis=1)  # a brake that some draw does not tell is left out as a whole
        nothing = Score(math.nan, math.nan, math.nan)
        reached, covered = nothing, nothing
        if brakes.any():
            indices = resampling(int(brakes.sum()), self.asked.seed)
            reached = score(error[brakes] / bound[brakes], root_mean_square, indices)
            covered = rate(runs["covered"][brakes, :, j], indices)
        return Estimation(
            bound=float(np.median(bound)),
            median=score(size, median, self.indices),
            upper=score(size, upper, self.indices),
            efficiency=reached,
            covered=covered,
            told=float(told.mean()),
        )

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The first contestant against each other one in each parameter, where the model is the brake's."""
        found = []
        for i in range(1, len(self.contestants)) if self.matched is not None else ():
            for j, name in enumerate(self.asked.params):
                ours, theirs = self.errors(self.asked.model, 0, j), self.errors(self.asked.model, i, j)
                between = ratio(ours, theirs, median, self.indices)
                sign = int(between.low > 1.0) - int(between.high < 1.0)
                tells = [self.standings[self.asked.model][n].parameters[j].told > 0.5 for n in (0, i)]
                if not all(tells):  # an error is where a search began, then, and may be small by chance
                    sign = int(tells[1]) - int(tells[0])
                found.append(Pair(self.contestants[i].name, name, between, sign, tells[0], tells[1]))
        return tuple(found)


def efficiency(log_det: Floats, reference: Floats, size: int) -> Floats:
    """D-efficiency: the square of the ratio of standard deviations, in the geometric mean; 0 if singular."""
    with np.errstate(invalid="ignore"):  # nothing against nothing
        result: Floats = np.nan_to_num(np.exp((log_det - reference) / size))
    return result


def compare(bench: Bench, asked: Asked, contestants: Sequence[Contestant], jobs: int) -> Comparison:
    """Play everything; the numbers do not depend on the number of processes.

    Args:
        bench: what is played on.
        asked: what is compared.
        contestants: the first one is what the others are compared with.
        jobs: processes.

    Raises:
        UsageError: it cannot be answered on this bench, or a process has died.
        PolicyRefusedError: an actor wants no finite current.
    """
    asked.check(bench)
    everything = [
        Job(
            bench=bench.text,
            contestants=tuple(contestants),
            plant=plant,
            model=asked.model,
            params=asked.params,
            ranges=asked.ranges,
            seed=asked.seed,
            brake=brake,
            draws=asked.draws if plant == asked.model else 1,
            ruler=plant == asked.model and brake < asked.known,
        )
        for plant in asked.plants
        for brake in range(asked.brakes)
    ]
    played = _shared_out(everything, jobs)
    tables = {
        plant: np.stack([one.table for one in played[n * asked.brakes : (n + 1) * asked.brakes]], axis=1)
        for n, plant in enumerate(asked.plants)
    }
    rulers = np.full(asked.brakes, math.nan)
    if asked.model in asked.plants:
        first = asked.plants.index(asked.model) * asked.brakes
        rulers = np.array([one.ruler for one in played[first : first + asked.brakes]])
    return Comparison(bench, asked, tuple(contestants), tables, rulers)


def _shared_out(everything: Iterable[Job], jobs: int) -> list[Played]:
    # Spawned: a forked child would inherit the threads' locks of numba and of ONNX Runtime without the threads.
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    pool = ProcessPoolExecutor(jobs, get_context("spawn"))
    resource_tracker.ensure_running()  # started along with the first process, it would end the blocking
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a Ctrl-C is for this process alone
    try:
        try:
            os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
            played = pool.map(work, everything)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        return list(played)
    except BrokenProcessPool as err:
        raise UsageError("a process ended before its work was done, out of memory perhaps: try fewer --jobs") from err
    finally:
        pool.shutdown(cancel_futures=True)
