"""``emb-train tune TASK``: learn a reference of the structured actor and keep it as JSON."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.estimator.speed_loop import scale_of
from emb_runtime.system.terminal import complain, show
from emb_train.names import listed
from emb_train.structured.evolution import BATCH, Progress, evolve
from emb_train.structured.law import TERMS
from emb_train.structured.learning import SHIELDS
from emb_train.structured.stored import FORMS, Stored, stored
from emb_train.structured.task import TASKS, Task

PROG = "emb-train tune"
EPILOG = """\
tasks:
{tasks}

exit codes: 0 done; 2 usage; 130 interrupted, nothing is written
"""
DESCRIPTION = """Learn a reference of the structured actor by contextual evolution, in minutes, and keep it as JSON.

It begins with a blind reference: the task's own, or --begin; or with a kept one: --start."""


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    p = argparse.ArgumentParser(
        prog=PROG,
        description=DESCRIPTION,
        epilog=EPILOG.format(tasks=listed({task.name: task.summary for task in TASKS.values()})),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("task", metavar="TASK", choices=TASKS, help="what the reference is for: one of those below")
    p.add_argument(
        "--form",
        choices=FORMS,
        default="quadratic",
        help="levels and switches that are constant, or quadratic in the estimate (default: %(default)s)",
    )
    p.add_argument("--start", metavar="NAME|FILE", help="kept reference to begin with: a packaged one, or a JSON file")
    p.add_argument(
        "--begin",
        metavar="NUMBERS",
        help="blind reference to begin with: levels, then switches, such as --begin=1,-1,-0.01,0.3,0.6",
    )
    p.add_argument(
        "--steps",
        type=int,
        default=400,
        metavar="N",
        help=f"of evolution, {2 * BATCH} experiments each (default: %(default)s)",
    )
    p.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of the search and of the brakes (default: %(default)s)"
    )
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped drum brake)")
    p.add_argument(
        "--plant", default=DEFAULT_PLANT, metavar="NAME", help="one of the bench's plants (default: %(default)s)"
    )
    p.add_argument(
        "--shield",
        choices=SHIELDS,
        default=SHIELDS[0],
        help="law for the whole set (worst case), or for what has been learnt (bounded), as emb-run has them "
        "(default: %(default)s)",
    )
    p.add_argument(
        "--command-delay",
        type=int,
        nargs=2,
        metavar=("LEAST", "MOST"),
        default=(0, 0),
        help="drawn per brake, samples (default: 0 0)",
    )
    p.add_argument(
        "--gain",
        type=float,
        default=1.0,
        metavar="X",
        help="of the speed loop; less than 1 where commands act late (default: %(default)s)",
    )
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON file to write")
    return p


def run(arguments: argparse.Namespace) -> Stored:
    """Search.

    Raises:
        UsageError: the arguments do not go together, or a file cannot be read.
        BenchFileError: the bench lacks a set or the plant.
    """
    if arguments.steps < 1 or arguments.seed < 0:
        raise UsageError("expected --steps of at least 1 and a --seed of at least 0")
    if not 0.0 < arguments.gain <= 1.0:
        raise UsageError(f"--gain: expected more than 0 and at most 1, got {arguments.gain:g}")
    if not arguments.out.parent.is_dir() or arguments.out.is_dir():
        raise UsageError(f"--out {arguments.out}: expected a file in a folder that is there")
    bench, (least, most) = load_bench(arguments.bench), arguments.command_delay
    task = replace(TASKS[arguments.task], plant=arguments.plant, shield=arguments.shield, command_delay=(least, most))
    found = evolve(
        task,
        bench,
        scale_of(bench, arguments.gain),
        _begin(arguments, task),
        steps=arguments.steps,
        seed=arguments.seed,
        blind=arguments.form == "blind",
        show=lambda progress: _tell(progress, arguments.steps),
    )
    return Stored(
        task=task.name,
        form=arguments.form,
        plant=task.plant,
        gain=arguments.gain,
        table=tuple(tuple(row) for row in found.table.tolist()),
        seed=arguments.seed,
        score=found.score,
        draws=arguments.steps * BATCH,
        command=f"{PROG} {' '.join(arguments.given)}",
        shield=task.shield,
        command_delay=task.command_delay,
    )


def _tell(progress: Progress, steps: int) -> None:
    sys.stderr.write(
        f"step {progress.steps}/{steps}: score {progress.score:.6g}, left the limits {progress.left}, "
        f"home {progress.home}\n"
    )


def _begin(arguments: argparse.Namespace, task: Task) -> Floats:
    """The table that the search begins with, shape [2 n − 1, TERMS]."""
    if arguments.start is not None:
        table = stored(arguments.start).array()
        if arguments.form == "blind" and table[:, 1:].any():
            raise UsageError("--start: expected a blind reference for --form blind")
        return table
    numbers = list(task.begin)
    if arguments.begin is not None:
        try:
            numbers = [float(value) for value in arguments.begin.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) % 2 == 0 or not all(math.isfinite(value) for value in numbers):
            raise UsageError(f"--begin: expected levels and then switches, one less, got '{arguments.begin}'")
    table = np.zeros((len(numbers), TERMS))
    table[:, 0] = numbers
    return table


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    given = sys.argv[1:] if argv is None else argv
    arguments = parser().parse_args(given)
    arguments.given = given
    try:
        found = run(arguments)
        try:
            arguments.out.write_text(found.to_json(), encoding="utf-8")
        except OSError as err:
            raise UsageError(f"{arguments.out}: {err.strerror}") from err
        show(f"{found.task} {found.form}: {found.score:.6g} on brakes that no step had")
    except EmbError as err:
        return complain(PROG, err)
    return EXIT_DONE
