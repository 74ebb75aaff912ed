"""What needs no learning, rung by rung, into the same shield; and what adapting the reference to the estimate adds.

    python benchmarks/ladder.py [TASK ...] [--draws N] [--plant PLANT] [--command-delay LEAST MOST] [--home ANGLE]
        [--oracle] [--no-design]

First come the rungs behind a shield for the whole set of brakes, then those behind one that follows the running
estimate; "mistaken" counts experiments in which the truth was ever not among what it believed. ``--oracle`` adds what
the same references reach behind a shield that knows each brake to ±0.2 %, which no bench does. ``--wide`` says what the
bench's shield answers to sets of up to ±80 %, and up to which angle there is one for them. ``--home`` asks it to
end nearer to the origin than the shipped bench does: the shield stops within 0.3 of that angle where there is time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from emb_bench.sim.plant_spec import DEFAULT_PLANT
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield_design import make_law
from emb_train.structured.adaptive_shield import narrowest
from emb_train.structured.stored import stored
from emb_train.structured.task import TASKS, Task, around
from studies.ladder import follow_all, ladder, oracle_laws, references_of, rung, shields_of, table

EVALUATION_SEED = 2026


def show(task: Task, bench: Bench, count: int | None, oracle: bool, designed: bool) -> None:
    """Print a ladder."""
    draws = task.draws(bench, EVALUATION_SEED, count)
    rungs = ladder(task, bench, draws, designed=designed)
    if oracle:
        laws = oracle_laws(task.conditions.applied(task.on(bench)), [draw.brake for draw in draws])
        for behind in shields_of(task, bench):
            for name in references_of(behind):
                rungs.append(rung(f"{name}, ORACLE shield", task, follow_all(stored(name), task, bench, draws, laws)))
    print(table(task, bench, rungs), flush=True)


def wide(bench: Bench, share: float) -> str:
    """What the shield says to a set of so much uncertainty."""
    ranges = {**bench.ranges, "wide": around(bench.brake, share, "wide")}
    bench = replace(bench, ranges=ranges, shield=replace(bench.shield, ranges="wide"))
    try:
        make_law(bench)
    except BenchFileError as err:
        nearer, _ = narrowest(bench)
        return f"±{share:.0%}: refused: {err}; covered up to {nearer.limits.angle[1]:.1f} rad"
    return f"±{share:.0%}: covered"


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; all without")
    options.add_argument("--draws", type=int, help="brakes, in place of each task's own number; "
                         "of a grid as many rounds as it takes")  # fmt: skip
    options.add_argument("--plant", default=DEFAULT_PLANT, help="of the bench; the references stay the same")
    options.add_argument("--command-delay", type=int, nargs=2, default=(0, 0), help="least and most samples, drawn")
    options.add_argument("--home", type=float, metavar="ANGLE", help="shield.home_angle [rad], in place of the bench's")
    options.add_argument("--oracle", action="store_true", help="also behind a shield that knows each brake")
    options.add_argument("--no-design", action="store_true", help="leave out the nominal optimal input")
    options.add_argument("--wide", action="store_true", help="say what the shield answers to wider sets, and stop")
    chosen = options.parse_args()
    shipped = load_bench()
    if chosen.home is not None:
        shipped = replace(shipped, shield=replace(shipped.shield, home_angle=chosen.home))
    if chosen.wide:
        for uncertainty in (0.5, 0.55, 0.6, 0.8):
            print(wide(shipped, uncertainty))
    else:
        for wanted in chosen.tasks or TASKS:
            asked = replace(TASKS[wanted], plant=chosen.plant, command_delay=tuple(chosen.command_delay))
            show(asked, shipped, chosen.draws, chosen.oracle, not chosen.no_design)
