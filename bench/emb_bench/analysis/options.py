"""Options of an information, an estimate, a report, an export: a record for each command."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.records import METHODS, STARTS, EstimationProblem, freed
from emb_bench.information.evaluation import Question
from emb_bench.options import Options, option
from emb_bench.sim.open_loop import check_unknowns
from emb_bench.sim.simulated_brake import check_near_nominal
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from emb_runtime.estimator.estimate import NORMAL_95

Names = str | Sequence[str]
"""Names, or one text with commas between them."""
MAP = "map file of a recording of others: meaning of its columns, known parameters of the machine"
NUMBER = r"(?:[0-9]+[.]?[0-9]*|[.][0-9]+)(?:[eE][-+]?[0-9]+)?"  # Without a sign


@dataclass(frozen=True, eq=False)
class QuestionOptions(Options):
    """Model, unknowns and prior; wrong names are refused before a log is read."""

    params: Names | None = option(
        None,
        "parameters of interest (default: the four of the brake; of a recording those that its map guesses)",
        "NAMES",
    )
    nuisance: Names | None = option(
        None, "further unknowns (default: none; of a recording those that its map names)", "NAMES"
    )
    model: str | None = option(
        None, "plant of the bench (default: the simulated plant that the log names, otherwise exact)", "MODEL"
    )
    prior: str | None = option(
        None, "name of ranges in the bench file in which the parameters are known to lie (default: none)", "PRIOR"
    )
    bench: str | Path | None = option(
        None,
        "bench file (default: that of the log; for several logs in one estimate, that of the first)",
        "FILE",
        kind=Path,
    )

    def __post_init__(self) -> None:
        """Check all that needs no bench."""
        super().__post_init__()
        nuisances = () if self.nuisance is None else names_of(self.nuisance)
        if self.params is None:
            check_unknowns(nuisances)  # parameters that are not named depend on the machine
        else:
            Question(names_of(self.params), nuisances)

    def names_on(self, bench: Bench | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Parameters and nuisances; those that are not given are the machine's of the bench, if it has one."""
        machine = None if bench is None else bench.machine
        default = (PARAMETER_NAMES, ()) if machine is None else (machine.unknown, machine.nuisances)
        given = zip((self.params, self.nuisance), default, strict=True)
        params, nuisances = (usual if names is None else names_of(names) for names, usual in given)
        return params, nuisances

    def question(self, bench: Bench) -> Question:
        """The unknowns and their prior."""
        return Question(*self.names_on(bench), None if self.prior is None else bench.range_set(self.prior))


@dataclass(frozen=True, eq=False)
class SearchOptions(QuestionOptions):
    """Unknowns, and the searches for them."""

    starts: int = option(STARTS, "local searches (default: 8)", "N", kind=int, least=1)
    seed: int = option(0, "seed of the starts of these searches (default: 0)", "N", kind=int, least=0)


@dataclass(frozen=True, eq=False)
class FitOptions(SearchOptions):
    """Options of the parameters that are estimated."""

    method: str | None = option(None, "see above (default: oem; windows for a recording)", choices=tuple(METHODS))
    model: str | None = option(
        None,
        "plant of the bench to estimate with, or 'all': each is fitted, and the best is used (default: the simulated "
        "plant that the log names, otherwise exact)",
        "MODEL",
    )
    systematic: str = option(
        "bench",
        "'bench' also estimates sensor offsets, gain and delay, with priors from [systematic] of the bench file; "
        "'none' assumes ideal sensors (default: bench)",
        choices=("bench", "none"),
    )
    known: Names | None = option(
        None,
        "parameters from a separate measurement, such as k_m=0.0217±0.1%; J is then estimated (default: none, or k_m "
        "if [systematic] of the bench file has its error)",
        "NAME=VALUE±HALF",
    )
    window: float = option(
        0.0, "length of the windows [s], with method windows (default: that of the map, or 0.5)", "X", kind=float
    )
    map: str | Path | None = option(None, MAP, "FILE", kind=Path)

    def __post_init__(self) -> None:
        """Check all that needs no bench."""
        super().__post_init__()
        if not (self.window == 0.0 or 1e-3 <= self.window <= 3600.0):
            raise UsageError(f"--window: expected a time from 0.001 to 3600 s, got {self.window:g}")
        known_values(self.known)

    def method_on(self, bench: Bench) -> str:
        """The given method, or the default for the bench's machine."""
        method = self.method or ("oem" if bench.machine is None else "windows")
        if self.window and method != "windows":
            raise UsageError(f"--window: the method {method} has no windows; leave it out, or add --method windows")
        return method

    def problem(self, bench: Bench, plant: Plant) -> EstimationProblem:
        """The problem for a plant, with the bench's systematic errors unless ``systematic`` is none."""
        from emb_bench.estimate.effects import with_systematic

        priors = known_values(self.known)
        problem = EstimationProblem(**vars(self.question(bench)), known=priors, window=self.window)
        if no_unknowns := [name for name in priors if name not in problem.names]:
            raise UsageError(f"--known {', '.join(no_unknowns)}: expected one of {', '.join(problem.names)}")
        for name in filter(priors.__contains__, PARAMETER_NAMES):
            check_near_nominal(bench, name, priors[name][0], "--known ")
        problem = freed(problem, bench)
        return with_systematic(problem, bench, plant) if self.systematic == "bench" else problem


@dataclass(frozen=True, eq=False)
class EstimateOptions(FitOptions):
    """Options of an estimate."""

    profile: bool = option(False, "likelihood profiles of all parameters (default: of weakly identified ones)")
    last: str | Path | None = option(
        None, "JSON of an earlier estimate or report, to report significant changes since then", "FILE", kind=Path
    )


@dataclass(frozen=True, eq=False)
class FileOptions(Options):
    """Options of an exported file."""

    topic: str | None = option(None, "of a table (default: /cycle, the control cycles)", "TOPIC")
    theta: str | Path | Mapping[str, float] | None = option(
        None, "parameters of a model, as for fim (default: those of the estimate, with intervals)", "THETA"
    )
    draw: int | None = option(
        None,
        "a model whose parameters are drawn from the joint distribution of the estimate",
        "SEED",
        kind=int,
        least=0,
    )


@dataclass(frozen=True, eq=False)
class ExportOptions(FitOptions, FileOptions):
    """Options of an export: those of its file first, then those of the fit, which are for a model."""

    method: str | None = option(
        None, "of the estimate (default: oem; windows for a recording)", choices=("oem", "pem", "windows")
    )  # by rls no model fits


@dataclass(frozen=True, eq=False)
class ReportOptions(EstimateOptions):
    """Options of a report; likelihood profiles are of all parameters."""

    profile: bool = True
    acceptance: str | Path | None = option(
        None,
        "TOML file with an [acceptance] table: tolerances, drift, budgets; each is passed, failed, or not decided",
        "FILE",
        kind=Path,
    )
    junit: str | Path | None = option(
        None, "XML file to write with the results of the acceptance criteria as test cases", "FILE", kind=Path
    )
    compare: bool = option(False, "two runs side by side, each estimated alone, and their differences")

    def __post_init__(self) -> None:
        """Refuse a comparison of two runs with options that need one estimate."""
        super().__post_init__()
        refused = [f"--{name}" for name in ("last", "acceptance", "junit") if getattr(self, name) is not None]
        if self.compare and refused:
            raise UsageError(f"--compare: expected it without {' and '.join(refused)}: report each run alone for these")


def names_of(names: Names) -> tuple[str, ...]:
    """Names, or a text with commas between them."""
    listed = names.split(",") if isinstance(names, str) else names
    return tuple(name for entry in listed if (name := entry.strip()))


def known_values(given: Names | None) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each parameter of ``--known`` [SI units]."""
    found = {}
    for text in () if given is None else names_of(given):
        parts = re.fullmatch(rf"(\w+)=({NUMBER})(?:±|\+-)({NUMBER})(%?)", text)
        value, half = (float(parts[2]), float(parts[3])) if parts else (0.0, 0.0)
        if parts is None or not (0.0 < value < math.inf and 0.0 < half < math.inf):
            raise UsageError(
                f"--known: expected a parameter with half of its 95 % interval, as k_m=0.0217±0.1%, got '{text}'"
            )
        found[parts[1]] = value, half * (0.01 * value if parts[4] else 1.0) / NORMAL_95
    return found
