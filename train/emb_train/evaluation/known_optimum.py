"""Known-parameter optimum: the best currents for each brake if its parameters were known, kept in a file.

A search takes up to a minute for a brake, and minutes for the first one, in the middle of the ranges. The others
start from the optimum of that one: its speeds are followed on the other brake, and the search goes on from there. The
result is the best that was found, not proved to be the best there is.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emb_bench.brake.euler import sign, stiffness
from emb_bench.brake.motion import is_plain
from emb_bench.design.problem import Problem, make_problem
from emb_bench.design.search import search
from emb_bench.parallel.processes import Lost, shared_out
from emb_bench.sim.open_loop import feedback
from emb_runtime.config.bench import Bench, BrakeParameters, parse_bench
from emb_runtime.config.plants import EULER, EXACT, Plant
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import open_regular
from emb_train.envs.measure import MEASURES, Floats, Measure

FIRST_STARTS = 24  # Coarse searches for the brake in the middle
STARTS = 3  # Coarse searches for each other brake, besides the warm start
SEED = 0  # Seed of the searches
GENERATION = 4  # Number of the search itself: what an earlier one found is not taken for the best that is known


class OptimumTask(NamedTuple):
    """One brake and the criterion of its optimum; it travels to another process."""

    bench: str  # Text of the bench file
    plant: str
    measure: str  # Name of the measure
    parameters: tuple[str, ...]
    brake: BrakeParameters
    speeds: tuple[float, ...] = ()
    """Speeds of the middle brake's optimum at the end of each sample [rad/s]; none for that brake itself."""

    def problem(self) -> Problem:
        """Returns the problem for the search of a design."""
        measure, bench = MEASURES[self.measure], parse_bench(self.bench, "the bench")
        goal = measure.goal(len(self.parameters))
        return make_problem(
            bench, goal, self.parameters, model=self.plant, kind=measure.kind, brake=self.brake, returns=True
        )


def plant_of(plant: Plant) -> str | None:
    """Returns the plant for the search: the same mechanics behind ideal instruments, None if not one of the thesis's.

    With the parameters known and nothing to react to, instruments cost nothing: for a plant that has some, it is what
    could be reached without them.
    """
    if plant.mechanics.solver == EULER:
        return "euler"
    return "exact" if plant.mechanics.solver == EXACT and is_plain(plant.mechanics) else None


def best_currents(task: OptimumTask) -> Floats:
    """Searches the best currents for one brake [A], shape [horizon].

    Raises:
        UsageError: none keep the limits.
    """
    problem = task.problem()
    if not task.speeds:
        return search(problem, starts=FIRST_STARTS, seed=SEED, workers=1).best.currents
    warm = [followed(problem, task.speeds)]
    return search(problem, starts=STARTS, seed=SEED, workers=1, warm=warm).best.currents


def followed(problem: Problem, speeds: Sequence[float]) -> Floats:
    """Currents with which a known brake has these speeds at the ends of the samples, as far as the limit lets it."""
    p, t_s, limit = problem.brake, problem.sample_time, problem.box.current

    def law(x1: float, x2: float, k: int) -> float:
        torque = p.T_c * sign(x2 or speeds[k]) + p.f_v * x2 + stiffness(p, x1) * x1 + p.J * (speeds[k] - x2) / t_s
        return min(max(torque / p.k_m, -limit), limit)

    motion = feedback(problem.plant.mechanics, p, law, t_s)
    return np.array([current for current, _, _ in islice(motion, len(speeds))])


@dataclass(frozen=True)
class KnownOptimum:
    """Optima by brake, found once and kept."""

    bench: Bench
    measure: Measure
    parameters: tuple[str, ...]
    path: Path | None  # File for the optima; None to keep none

    def optima(
        self,
        plant: str,
        middle: BrakeParameters,
        brakes: Sequence[BrakeParameters],
        jobs: int,
        tell: Callable[[str], None],
    ) -> Floats:
        """Computes the measure of the best known design for each brake, shape [len(brakes)].

        Args:
            plant: ``euler`` or ``exact``.
            middle: the brake that is searched for first.
            brakes: the others.
            jobs: processes.
            tell: called with lines on the progress.

        Raises:
            UsageError: nothing found keeps the limits, a process was lost, or the file cannot be written.
        """
        tell(f"optimum on {plant}: the brake in the middle, up to minutes unless it is known")
        (first,) = self._found(
            [OptimumTask(self.bench.text, plant, self.measure.name, self.parameters, middle)], 1, tell
        )
        speeds = tuple(first.problem.design(first.currents).states[1:, 1].tolist())
        tasks = [OptimumTask(self.bench.text, plant, self.measure.name, self.parameters, b, speeds) for b in brakes]
        found = self._found(tasks, jobs, tell)
        return self.measure.values(np.array([f.problem.design(f.currents).matrix for f in found]))

    def _found(self, tasks: Sequence[OptimumTask], jobs: int, tell: Callable[[str], None]) -> list[Optimum]:
        known = dict(read(self.path)) if self.path is not None else {}
        keys = [key_of(task) for task in tasks]
        missing = [i for i, key in enumerate(keys) if key not in known]
        with closing(shared_out(best_currents, [tasks[i] for i in missing], jobs)) as results:
            for done, (number, currents) in enumerate(results, 1):
                if isinstance(currents, Lost):
                    raise UsageError(f"a process that looked for an optimum {currents.how}, out of memory perhaps")
                key, task = keys[missing[number]], tasks[missing[number]]
                known[key] = currents
                if self.path is not None:
                    append(self.path, key, task, currents)
                if len(tasks) > 1:
                    tell(f"optimum on {task.plant}: brake {len(tasks) - len(missing) + done} of {len(tasks)}")
        return [Optimum(task.problem(), known[key]) for task, key in zip(tasks, keys, strict=True)]


class Optimum(NamedTuple):
    """The best that is known for a brake."""

    problem: Problem
    currents: Floats  # [A], shape [horizon]


def default_path() -> Path | None:
    """Default file for optima, in the user's cache; None for a user without a home."""
    try:
        chosen = os.environ.get("XDG_CACHE_HOME")
        return (Path(chosen) if chosen else Path.home() / ".cache") / "emb-excite" / "optima.jsonl"
    except RuntimeError:
        return None


def key_of(task: OptimumTask) -> str:
    """Digest of all that an optimum depends on: another bench, brake or search is another entry."""
    problem = task.problem()
    starts = STARTS if task.speeds else FIRST_STARTS
    parts = (problem.plant.mechanics, problem.brake, problem.params, problem.goal, problem.weights, problem.box)
    search_ = (problem.sample_time, problem.horizon, starts, SEED, GENERATION, task.speeds)
    return hashlib.sha256(repr((parts, search_)).encode()).hexdigest()


def require_place(path: Path) -> None:
    """Checks, before any search, that optima can be kept in this file.

    Raises:
        UsageError: its directory is not there or not writable, or it holds something else.
    """
    folder = path.parent
    if not folder.is_dir():
        raise UsageError(
            f"{path}: cannot keep the optima: there is no directory {folder}: make it, or name another file"
        )
    if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise UsageError(f"{path}: cannot keep the optima: expected a file that can be written to")
    read(path)


def read(path: Path) -> list[tuple[str, Floats]]:
    """Reads the entries of a file; none if it is not there. A line that was cut is left out.

    Raises:
        UsageError: the file cannot be read, or holds something else.
    """
    try:
        with open_regular(path) as file:
            lines = file.read().decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as err:
        raise UsageError(f"{path}: cannot read the optima: {err.strerror}") from err
    found = []
    for line in lines:
        try:
            entry = json.loads(line)
            currents = np.asarray(entry["currents"], np.float64)
            if currents.ndim == 1 and np.isfinite(currents).all():
                found.append((str(entry["key"]), currents))
        except (ValueError, KeyError, TypeError):
            continue
    if any(line.strip() for line in lines) and not found:
        raise UsageError(
            f"{path}: holds no optima, but something else: name another file, or one that is not there yet"
        )
    return found


def append(path: Path, key: str, task: OptimumTask, currents: Floats) -> None:
    """Adds an entry, on a line of its own whatever was cut before it.

    Raises:
        UsageError: it cannot be written.
    """
    entry: dict[str, Any] = {
        "key": key,
        "plant": task.plant,
        "measure": task.measure,
        "parameters": task.parameters,
        "brake": task.brake._asdict(),
        "currents": currents.tolist(),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps(entry) + "\n")
    except OSError as err:
        raise UsageError(f"{path}: cannot keep the optima: {err.strerror}") from err
