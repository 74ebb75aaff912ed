"""Command line of the baselines without learning: ``python -m studies.ladder``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

from emb_bench.cli.estimate import at_least
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.config.plants import THESIS_PLANT
from emb_runtime.errors import EXIT_DONE, BenchFileError, EmbError, UsageError
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.terminal import complain, show
from emb_train.structured.adaptive_shield import SHIELDS, narrowest
from emb_train.structured.task import TASKS, Task, around
from studies.ladder.ladder import (
    beside,
    follow,
    follow_all,
    ladder,
    optima,
    oracle_laws,
    reference,
    references_of,
    rung,
    shields_of,
    table,
)

PROGRAM = "python -m studies.ladder"
EVALUATION_SEED = 2026
SHARES = (0.5, 0.55, 0.6, 0.8)  # Uncertainties of all four parameters for ``--wide``, relative to nominal
DESCRIPTION = """\
Baselines without learning behind the shield for the whole set of brakes, then behind one that follows the running
estimate. All meet the same brakes with the same noise. "mistaken" counts experiments in which the true brake was ever
outside what the shield believed. docs/studies/ladder.md has the results.
"""


def parser() -> argparse.ArgumentParser:
    """Returns the command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description=DESCRIPTION,
        epilog="exit codes: 0 done; 2 wrong usage, or a bench on which there is no shield; 130 Ctrl-C",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; all without")
    p.add_argument("--draws", type=int, metavar="N", help="brakes, in place of each task's own number; "
                   "of a grid as many rounds as it takes")  # fmt: skip
    p.add_argument("--plant", default=THESIS_PLANT, help="of the bench; the references stay the same")
    p.add_argument("--command-delay", type=int, nargs=2, default=(0, 0), metavar=("LEAST", "MOST"),
                   help="samples, drawn for each experiment")  # fmt: skip
    p.add_argument("--references", nargs="+", metavar="NAME", help="play these only, compared with the first")
    p.add_argument("--shield", choices=SHIELDS, default=SHIELDS[0], help="of --references (default: %(default)s)")
    p.add_argument("--shield-ranges", metavar="SET", help="set that the shield holds the limits for, in place of the "
                   "task's")  # fmt: skip
    p.add_argument("--no-first-move", action="store_true", help="play --references as if the polarity were known "
                   "from the start")  # fmt: skip
    p.add_argument("--optimum-draws", type=int, default=0, metavar="N", help="compare --references with the optimum of "
                   "each of the first N brakes, as if it were known: up to a minute each")  # fmt: skip
    p.add_argument("--home", type=float, metavar="ANGLE", help="shield.home_angle [rad], in place of the bench's: the "
                   "shield stops within 0.3 of it where there is time")  # fmt: skip
    p.add_argument("--oracle", action="store_true", help="also behind a shield that knows each brake to ±0.2 %%")
    p.add_argument("--no-design", action="store_true", help="leave out the nominal optimal input")
    p.add_argument("--wide", action="store_true", help="print which sets of up to ±80 %% the bench's shield covers, "
                   "and up to which angle, and stop")  # fmt: skip
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``python -m studies.ladder``."""
    args = parser().parse_args(argv)
    try:
        for text in _tables(args):
            show(text)
    except EmbError as err:
        return complain(PROGRAM, err)
    return EXIT_DONE


def _tables(args: argparse.Namespace) -> Iterator[str]:
    unknown = [name for name in args.tasks if name not in TASKS]
    if unknown:
        raise UsageError(f"no task is called '{unknown[0]}'; there are: {', '.join(TASKS)}")
    if args.draws is not None:
        at_least({"--draws": (args.draws, 1)})
    at_least({"--optimum-draws": (args.optimum_draws, 0)})
    bench = load_bench()
    if args.home is not None:
        bench = replace(bench, shield=replace(bench.shield, home_angle=args.home))
    if args.wide:
        yield from (covered(bench, share) for share in SHARES)
        return
    for name in args.tasks or TASKS:
        task = replace(TASKS[name], plant=args.plant, command_delay=tuple(args.command_delay))
        if args.shield_ranges is not None:
            task = replace(task, shield_ranges=args.shield_ranges)
        if args.references is not None:
            task = replace(task, shield=args.shield)
            draws = task.draws(bench, EVALUATION_SEED, args.draws)
            rungs = [follow(name, task, bench, draws, not args.no_first_move) for name in args.references]
            yield f"shield: {task.shield}\n{table(task, bench, rungs, rungs[0].name)}"
            if args.optimum_draws:
                yield beside(task, rungs, optima(task, bench, draws[: args.optimum_draws]))
            continue
        yield evaluated(task, bench, args.draws, args.oracle, not args.no_design)


def evaluated(task: Task, bench: Bench, count: int | None, oracle: bool, designed: bool) -> str:
    """Returns the table of one task, with the references behind an oracle's shield where asked for."""
    draws = task.draws(bench, EVALUATION_SEED, count)
    rungs = ladder(task, bench, draws, designed=designed)
    if oracle:
        laws = oracle_laws(task.conditions.applied(task.on(bench)), [draw.brake for draw in draws])
        for behind in shields_of(task, bench):
            for name in references_of(behind):
                outcome = follow_all(reference(name), task, bench, draws, laws)
                rungs.append(rung(f"{name}, ORACLE shield", task, outcome))
    return table(task, bench, rungs)


def covered(bench: Bench, share: float) -> str:
    """Coverage of all brakes within ±share of nominal by the bench's shield, as text; else the covered angle [rad]."""
    ranges = {**bench.ranges, "wide": around(bench.brake, share, "wide")}
    bench = replace(bench, ranges=ranges, shield=replace(bench.shield, ranges="wide"))
    try:
        make_law(bench)
    except BenchFileError as err:
        nearer, _ = narrowest(bench)
        return f"±{share:.0%}: refused: {err}; covered up to {nearer.limits.angle[1]:.1f} rad"
    return f"±{share:.0%}: covered"
