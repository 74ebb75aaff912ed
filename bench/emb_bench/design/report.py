"""Report on a design, computed independently of the search, and its files."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import EXACT
from emb_bench.design.problem import PARTS, Problem
from emb_bench.design.search import Found, search
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.information.criteria import Criterion, criteria
from emb_bench.information.fisher import Kind, information_over_time, weights_along
from emb_bench.information.symmetric import Floats
from emb_bench.output import replacing
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_bytes
from emb_runtime.system.terminal import json_document

COLUMNS = ("time", "current", "angle", "velocity")
MAX_DESIGN_BYTES = 64 << 20  # Of a design's file
CHECKED = ("euler", "exact")  # Brakes on which every design is simulated again, besides that of its problem


@dataclass(frozen=True)
class Check:
    """A design on one brake, in plain Python from the brake's equations."""

    plant: str
    value: float  # The criterion, in its unit
    log_det: float
    lambda_min: float
    trace_inverse: float
    lowest_angle: float  # [rad]; all extremes also between the samples, for a solver with states there
    highest_angle: float  # [rad]
    largest_speed: float  # [rad/s]
    largest_current: float  # [A]
    end_angle: float  # [rad]
    end_velocity: float  # [rad/s]
    limits_held: bool
    home: bool


def check(bench: Bench, problem: Problem, kind: Kind, currents: Floats, plant_name: str) -> Check:
    """Checks a sequence of currents on a brake: its criteria, and whether it keeps the bench's limits there."""
    plant = bench.model(plant_name)
    # The motion, not delayed samples of it: the last periods count as well.
    plant = replace(plant, instruments=plant.instruments._replace(measurement_delay=0))
    t_s, p = problem.sample_time, problem.brake
    parts = PARTS if plant.mechanics.solver == EXACT else 1
    states = simulate(plant, Theta(p), planned(np.repeat(currents, parts)), t_s / parts).states
    run = simulate(plant, Theta(p), planned(currents), t_s, problem.params)
    matrix = information_over_time(run.sensitivities, weights_along(bench, kind, plant.instruments, run.states))[-1]
    found = criteria(matrix, problem.params)
    limits, home = bench.limits, bench.shield
    low, high, speed = float(states[:, 0].min()), float(states[:, 0].max()), float(np.abs(states[:, 1]).max())
    current = float(np.abs(currents).max(initial=0.0))
    return Check(
        plant=plant_name,
        value=problem.goal.value(replace(problem, plant=plant).phi(currents, matrix)),
        log_det=found.log_det,
        lambda_min=found.lambda_min,
        trace_inverse=found.trace_inverse,
        lowest_angle=low,
        highest_angle=high,
        largest_speed=speed,
        largest_current=current,
        end_angle=float(states[-1, 0]),
        end_velocity=float(states[-1, 1]),
        limits_held=limits.angle[0] <= low
        and high <= limits.angle[1]
        and speed <= limits.velocity
        and current <= limits.current,
        home=bool(abs(states[-1, 0]) <= home.home_angle and abs(states[-1, 1]) <= home.home_velocity),
    )


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """A search with its result."""

    bench: Bench
    problem: Problem
    kind: Kind
    seed: int
    starts: int
    version: str
    found: Found
    checks: tuple[Check, ...]  # On the brake of its problem first

    @property
    def criterion(self) -> Criterion | IntervalCriterion:
        """The criterion that was optimised."""
        return self.problem.goal

    def __repr__(self) -> str:
        """Criterion and value in one line."""
        value = self.criterion.value(self.found.best.phi)
        return f"<Report of a {self.criterion.name}-optimal design: {self.criterion.label} {value:.6g}>"

    def bounds(self) -> dict[str, float] | None:
        """Cramér-Rao bounds of the unknowns, if the information is physical."""
        if self.kind != "physical":
            return None
        deviations = np.sqrt(np.diag(np.linalg.inv(self.found.best.matrix)))
        return dict(zip(self.problem.params, deviations.tolist(), strict=True))

    def metadata(self) -> dict[str, Any]:
        """Metadata of the design for its files; equal for the same problem and seed, unless Ctrl-C ended the search."""
        p, criterion = self.problem, self.criterion
        return {
            "command": "emb-design",
            "version": self.version,
            "bench": self.bench.name,
            "identity_hash": self.bench.identity_hash,
            "bench_sha256": hashlib.sha256(self.bench.text.encode()).hexdigest(),
            "criterion": criterion.name,
            "value": criterion.value(self.found.best.phi),
            "value_is": criterion.label,
            "params": list(p.params),
            "kind": self.kind,
            "model": p.plant.name,
            "theta": p.brake._asdict(),
            "returns": bool(np.isfinite(p.box.home_angle)),
            "sample_time": p.sample_time,
            "horizon": p.horizon,
            "seed": self.seed,
            "starts": self.starts,
            "interrupted": self.found.interrupted,
            "local_optima": [criterion.value(d.phi) for d in self.found.designs],
            "cramer_rao": self.bounds(),
            "checks": [asdict(c) for c in self.checks],
        }

    def json(self) -> str:
        """The metadata as one line; a number that is not finite is null."""
        return json_document(self.metadata())

    def columns(self) -> dict[str, Floats]:
        """Rows at the instants 0..n: the current acts from there on; the last one is 0."""
        design = self.found.best
        return {
            "time": self.problem.sample_time * np.arange(len(design.states)),
            "current": np.append(design.currents, 0.0),
            "angle": design.states[:, 0],
            "velocity": design.states[:, 1],
        }


def make_report(
    bench: Bench,
    problem: Problem,
    kind: Kind,
    *,
    starts: int,
    seed: int,
    told: Callable[[str], object] = str,
) -> Report:
    """Search for a design, and simulate it again on the brake of its problem and on ``CHECKED``."""
    found = search(problem, starts=starts, seed=seed, told=told)
    plants = dict.fromkeys((problem.plant.name, *CHECKED))
    return Report(
        bench=bench,
        problem=problem,
        kind=kind,
        seed=seed,
        starts=starts,
        version=metadata.version("emb-excite"),
        found=found,
        checks=tuple(check(bench, problem, kind, found.best.currents, plant) for plant in plants),
    )


def write(report: Report, path: Path) -> None:
    """Write the design as CSV: the metadata as one line of JSON behind ``#``, then the columns."""
    columns, text = report.columns(), io.StringIO(newline="")
    text.write(f"# {report.json()}\n")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    rows.writerows(zip(*(columns[name].tolist() for name in COLUMNS), strict=True))
    with replacing(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8", newline="")


def read_design(path: Path, bench: Bench) -> tuple[Floats, str]:
    """Currents of a design that :func:`write` wrote [A], shape (horizon,); and a description with a hash."""
    try:
        head, *rows = read_bytes(path, MAX_DESIGN_BYTES).decode().splitlines()
        metadata = json.loads(head.removeprefix("#"))
        made_for, label = str(metadata["identity_hash"]), f"{metadata['criterion']}-optimal design"
        current = np.array([float(row["current"]) for row in csv.DictReader(rows)])
    except OSError as err:
        raise UsageError(f"{path}: cannot read the design: {err.strerror}") from err
    except (ValueError, KeyError, TypeError, RecursionError, csv.Error) as err:
        raise UsageError(f"{path}: expected a design that emb-design wrote, and it is none") from err
    if made_for != bench.identity_hash:
        raise UsageError(f"{path}: made for another bench: pass it with --bench, or search the design again")
    if current.shape != (bench.timing.horizon + 1,) or not np.isfinite(current).all():
        raise UsageError(f"{path}: expected {bench.timing.horizon + 1} finite currents, got shape {current.shape}")
    return current[:-1], f"{label}, sha256 {hashlib.sha256(current.tobytes()).hexdigest()[:12]}"
