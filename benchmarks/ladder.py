"""What needs no learning, rung by rung, into the same shield; and what adapting the reference to the estimate adds.

    python benchmarks/ladder.py [TASK ...] [--draws N] [--plant PLANT] [--oracle] [--no-design]

``--oracle`` adds what the same references reach behind a shield that knows each brake to ±0.2 %, which no bench does.
``--wide`` says what the shield answers to a set of ±80 %.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from emb_bench.plant import DEFAULT_PLANT
from emb_runtime.bench import PARAMETER_NAMES, Bench, Ranges, load_bench
from emb_runtime.envelope import make_law
from emb_runtime.errors import BenchFileError
from emb_train.ladder import follow_all, ladder, oracle_laws, references_of, rung, table
from emb_train.structured.stored import stored
from emb_train.structured.task import TASKS, Task

EVALUATION_SEED = 2026


def show(task: Task, bench: Bench, count: int | None, oracle: bool, designed: bool) -> None:
    """Print a ladder."""
    draws = task.draws(bench, EVALUATION_SEED, count)
    rungs = ladder(task, bench, draws, designed=designed)
    if oracle:
        laws = oracle_laws(bench, [draw.brake for draw in draws])
        for name in references_of(task):
            rungs.append(rung(f"{name}, ORACLE shield", task, follow_all(stored(name), task, bench, draws, laws)))
    print(table(task, rungs), flush=True)


def wide(bench: Bench, share: float) -> str:
    """What the shield says to a set of so much uncertainty."""
    ends = (
        bench.brake._replace(**{n: factor * getattr(bench.brake, n) for n in PARAMETER_NAMES})
        for factor in (1.0 - share, 1.0 + share)
    )
    ranges = {**bench.ranges, "wide": Ranges("wide", *ends)}
    try:
        make_law(replace(bench, ranges=ranges, shield=replace(bench.shield, ranges="wide")))
    except BenchFileError as err:
        return f"±{share:.0%}: refused: {err}"
    return f"±{share:.0%}: covered"


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; all without")
    options.add_argument("--draws", type=int, help="brakes, in place of each task's own number")
    options.add_argument("--plant", default=DEFAULT_PLANT, help="of the bench; the references stay the same")
    options.add_argument("--oracle", action="store_true", help="also behind a shield that knows each brake")
    options.add_argument("--no-design", action="store_true", help="leave out the nominal optimal input")
    options.add_argument("--wide", action="store_true", help="say what the shield answers to wider sets, and stop")
    chosen = options.parse_args()
    shipped = load_bench()
    if chosen.wide:
        for uncertainty in (0.5, 0.55, 0.6, 0.8):
            print(wide(shipped, uncertainty))
    else:
        for wanted in chosen.tasks or TASKS:
            show(replace(TASKS[wanted], plant=chosen.plant), shipped, chosen.draws, chosen.oracle, not chosen.no_design)
