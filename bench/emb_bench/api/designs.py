"""The search for an informative sequence of currents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from emb_bench.analysis.options import Names, names_of
from emb_bench.api.arguments import options_of
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.design.kernel import COARSE_SEARCHES
from emb_bench.options import Options, option
from emb_bench.output import progress, say_if_compiling
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import needs

if TYPE_CHECKING:
    from emb_bench.design.report import Report
    from emb_bench.information.fisher import Kind


@dataclass(frozen=True, eq=False)
class DesignOptions(Options):
    """Options of a design."""

    criterion: str = option(
        "T",
        "what is optimised (default: T); for a parameter, its share in T",
        choices=("T", "I", "D", "A", "E", *PARAMETER_NAMES),
    )
    params: Names = option(PARAMETER_NAMES, "unknown parameters (default: the four of the brake)", "NAMES")
    theta: str | Path | Mapping[str, float] | None = option(
        None, "the brake's parameters, as 'name=value,...' or the JSON of an estimate; the others are nominal", "THETA"
    )
    model: str = option(DEFAULT_PLANT, "plant of the bench (default: exact)", "MODEL")
    kind: str = option("physical", "which Fisher information (default: physical)", choices=("physical", "weighted"))
    return_home: bool = option(True, "it may end anywhere within the limits")
    starts: int = option(COARSE_SEARCHES, "coarse searches (default: 18)", "N", kind=int, least=1)
    seed: int = option(0, "seed of the random starts (default: 0)", "N", kind=int, least=0)
    bench: str | Path | None = option(None, "bench file (default: the shipped one)", "FILE", kind=Path)


def design(options: DesignOptions | None = None, *, told: Callable[[str], object] | None = None, **more: Any) -> Report:
    """Optimal current sequence for known parameters, within the limits of the bench.

    Args:
        options: a record of options.
        told: called after each step of the search with what was done (default: a bar on a terminal).
        more: fields of the record as keywords: ``design(criterion="A")``; without ``return_home`` the brake may end
            anywhere within the limits.

    Returns:
        The report; ``report.found.best.currents`` are the currents [A], one per sample period.

    Raises:
        UsageError: an argument is wrong, no design was found, or scipy and numba are missing.
    """
    from emb_bench.experiment.theta import read_theta
    from emb_bench.information.criteria import Criterion

    settings = options_of("design", DesignOptions, options, more)
    its, names = load_bench(settings.bench), names_of(settings.params)
    with needs("a design", "bench"):
        from emb_bench.design.problem import make_problem
        from emb_bench.design.report import make_report
        from emb_bench.design.search import steps_of
        from emb_bench.estimate.expected import IntervalCriterion
    name: Any = settings.criterion
    goal = Criterion(name) if name in ("D", "A", "E") else IntervalCriterion(name)
    _, brake, _ = read_theta(settings.theta, None, its)
    kind = cast("Kind", settings.kind)
    problem = make_problem(its, goal, names, model=settings.model, kind=kind, brake=brake, returns=settings.return_home)
    say_if_compiling()
    with progress("design", steps_of(goal, settings.starts)) as advance:
        return make_report(its, problem, kind, starts=settings.starts, seed=settings.seed, told=told or advance)
