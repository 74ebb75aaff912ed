"""The search for an informative sequence of currents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from emb_bench.api.arguments import Names, check, names_of, text_of
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.design.kernel import COARSE_SEARCHES
from emb_bench.output import progress, say_if_compiling
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import needs

if TYPE_CHECKING:
    from emb_bench.design.report import Report


def design(
    *,
    criterion: Literal["T", "I", "D", "A", "E", "k_m", "k_1", "T_c", "f_v"] = "T",
    params: Names = PARAMETER_NAMES,
    theta: str | Path | Mapping[str, float] | None = None,
    model: str = DEFAULT_PLANT,
    kind: Literal["physical", "weighted"] = "physical",
    return_home: bool = True,
    starts: int = COARSE_SEARCHES,
    seed: int = 0,
    bench: str | Path | None = None,
    told: Callable[[str], object] | None = None,
) -> Report:
    """The current sequence with most information about parameters that are known, under the limits of the bench.

    Args:
        criterion: what is optimised (default: T); for a parameter, its share in T.
        params: unknown parameters (default: the four of the brake).
        theta: the brake's parameters, as name=value,...; the others are nominal.
        model: plant of the bench (default: exact).
        kind: which Fisher information (default: physical).
        return_home: the brake returns home at the end; without, it may end anywhere within the limits.
        starts: coarse searches (default: 18).
        seed: seed of the random starts (default: 0).
        bench: bench file (default: the shipped one).
        told: called after each step of the search with what was done (default: a bar on a terminal).

    Returns:
        The report; ``report.found.best.currents`` are the currents [A], one per sample period.

    Raises:
        UsageError: an argument is wrong, no design was found, or scipy and numba are missing.
    """
    from emb_bench.information.criteria import Criterion
    from emb_bench.sim.simulated_brake import parse_assignments, true_parameters

    check({"--starts": (starts, 1), "--seed": (seed, 0)})
    its, names = load_bench(bench), names_of(params)
    with needs("a design", "bench"):
        from emb_bench.design.problem import make_problem
        from emb_bench.design.report import make_report
        from emb_bench.design.search import steps_of
        from emb_bench.estimate.expected import IntervalCriterion
    goal = Criterion(criterion) if criterion in ("D", "A", "E") else IntervalCriterion(criterion)
    given = parse_assignments(text_of(theta).replace("nominal", ""), "--theta: ")
    brake = true_parameters(its, given, option="--theta: ")
    problem = make_problem(its, goal, names, model=model, kind=kind, brake=brake, returns=return_home)
    say_if_compiling()
    with progress("design", steps_of(goal, starts)) as advance:
        return make_report(its, problem, kind, starts=starts, seed=seed, told=told or advance)
