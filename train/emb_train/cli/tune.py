"""``emb-train tune TASK``: search for a reference of the structured actor and keep it as JSON."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.system.terminal import complain, show
from emb_train.structured.adaptive_shield import SHIELDS
from emb_train.structured.evolution import BATCH, Progress, evolve
from emb_train.structured.law import QUADRATIC_TERMS, TERMS, Loop, no_loop, speed_loop
from emb_train.structured.stored import FORMS, Stored, read_hashed
from emb_train.structured.task import TASKS, Task
from emb_train.structured.tuning import COARSE, FINE, TUNING_SEED, Tuned, blind, climb
from emb_train.training.progress import open_display

PROG = "emb-train tune"
EPILOG = "exit codes: 0 done; 2 usage; 130 interrupted, nothing is written"
DESCRIPTION = """Search for a reference of the structured actor, and keep it as JSON.

A form that adapts to the estimate (affine, quadratic) learns by contextual evolution, in minutes; it begins with a
blind reference: the task's own, or --start or --begin. A blind one (current, speed) is searched for by CMA-ES."""


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    p = argparse.ArgumentParser(
        prog=PROG, description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tasks = ", ".join(TASKS)
    p.add_argument("task", metavar="TASK", choices=TASKS, help=f"what the reference is for: one of {tasks}")
    p.add_argument(
        "--form",
        choices=FORMS,
        default="quadratic",
        help="what the levels are, and how they adapt (default: %(default)s)",
    )
    p.add_argument("--levels", type=int, default=3, metavar="N", help="levels in the reference (default: %(default)s)")
    p.add_argument(
        "--start",
        type=Path,
        metavar="FILE",
        help="JSON of a kept reference to begin with (default: the task's blind one, or a search from many places)",
    )
    p.add_argument(
        "--begin",
        metavar="NUMBERS",
        help="reference to begin with, as numbers: levels, then switches, such as 1,-1,-0.01,0.3,0.6",
    )
    p.add_argument(
        "--spread",
        type=float,
        default=FINE,
        metavar="X",
        help="first standard deviation of the last search (default: %(default)s)",
    )
    p.add_argument(
        "--generations",
        type=int,
        default=100,
        metavar="N",
        help="generations of the last search (default: %(default)s)",
    )
    p.add_argument(
        "--steps",
        type=int,
        default=400,
        metavar="N",
        help=f"of contextual evolution, {2 * BATCH} experiments each (default: %(default)s)",
    )
    p.add_argument(
        "--draws", type=int, default=128, metavar="N", help="brakes to tune on, of a grid all (default: %(default)s)"
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
        help="law for the whole set (worst case), for what has been learnt for sure (bounded) or almost (gaussian), as "
        "emb-run has them, or for what the filter believes (belief; in simulation only) (default: %(default)s)",
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
    counts = (arguments.levels, arguments.draws, arguments.generations, arguments.steps)
    if min(counts) < 1 or arguments.seed < 0:
        raise UsageError("expected --levels, --draws, --generations, --steps of at least 1 and a --seed of at least 0")
    if not 0.0 < arguments.spread <= 1.0:
        raise UsageError(f"--spread: expected more than 0 and at most 1, got {arguments.spread:g}")
    if not 0.0 < arguments.gain <= 1.0:
        raise UsageError(f"--gain: expected more than 0 and at most 1, got {arguments.gain:g}")
    if not arguments.out.parent.is_dir() or arguments.out.is_dir():
        raise UsageError(f"--out {arguments.out}: expected a file in a folder that is there")
    begin, digest = _begin(arguments)
    bench = load_bench(arguments.bench)
    least, most = arguments.command_delay
    task = replace(TASKS[arguments.task], plant=arguments.plant, shield=arguments.shield, command_delay=(least, most))
    loop = no_loop(bench) if arguments.form == "current" else speed_loop(bench, arguments.gain)
    adapts = arguments.form in ("affine", "quadratic")
    found, draws = (_evolved if adapts else _searched)(arguments, task, bench, loop, begin)
    command = f"{PROG} {' '.join(arguments.given)}"
    rows = tuple(tuple(row) for row in found.table.tolist())
    return Stored(
        task.name,
        arguments.form,
        arguments.plant,
        arguments.gain,
        rows,
        arguments.seed,
        found.score,
        draws,
        command,
        arguments.shield,
        (least, most),
        "" if arguments.start is None else arguments.start.name,
        digest,
    )


def _evolved(
    arguments: argparse.Namespace, task: Task, bench: Bench, loop: Loop, begin: Floats | None
) -> tuple[Tuned, int]:
    """A reference that adapts, and on how many brakes it was tuned."""
    numbers = np.zeros((len(task.begin), TERMS))
    numbers[:, 0] = task.begin
    blind_start = numbers if begin is None else begin
    terms = TERMS if arguments.form == "affine" else QUADRATIC_TERMS
    if blind_start.shape[1] > terms:
        raise UsageError("--start: expected a blind or an affine reference for --form affine, got a quadratic one")
    if blind_start.shape[1] < terms and blind_start[:, 1:].any():
        raise UsageError("--start: expected a blind or a quadratic reference for --form quadratic, got an affine one")
    table = np.zeros((len(blind_start), terms))
    table[:, : blind_start.shape[1]] = blind_start
    with open_display(sys.stderr, 0, arguments.steps, _described) as display:
        found = evolve(task, bench, loop, table, steps=arguments.steps, seed=arguments.seed, show=display.show)
    return found, arguments.steps * BATCH


def _described(progress: Progress, speed: float) -> str:
    return f"{speed:.1f} steps/s · score {progress.score:.6g} · left the limits {progress.left} · home {progress.home}"


def _searched(
    arguments: argparse.Namespace, task: Task, bench: Bench, loop: Loop, begin: Floats | None
) -> tuple[Tuned, int]:
    """A blind reference, and on how many brakes it was tuned."""
    seed = TUNING_SEED + arguments.seed
    trials = task.trials(bench, task.draws(bench, seed, arguments.draws if task.count else None))  # a grid once
    search = {"generations": arguments.generations, "seed": arguments.seed, "spread": arguments.spread}
    if begin is not None:
        return climb(task, trials, loop, begin, **search), len(trials.k)
    few = min(COARSE, arguments.draws) if task.count else None
    coarse = task.trials(bench, task.draws(bench, seed, few))
    found = blind(
        task,
        coarse,
        trials,
        loop,
        levels=arguments.levels,
        tell=lambda line: sys.stderr.write(f"{line}\n"),
        **search,
    )
    return found, len(trials.k)


def _begin(arguments: argparse.Namespace) -> tuple[Floats | None, str]:
    """The table that a search is to begin with, if one is given, and the SHA-256 of its file, if it is from one."""
    if arguments.start is not None:
        kept, digest = read_hashed(arguments.start)
        return kept.array(), digest
    if arguments.begin is None:
        return None, ""
    try:
        numbers = [float(value) for value in arguments.begin.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) % 2 == 0 or not all(math.isfinite(value) for value in numbers):
        raise UsageError(f"--begin: expected levels and then switches, one less, got '{arguments.begin}'")
    table = np.zeros((len(numbers), TERMS))
    table[:, 0] = numbers
    return table, ""


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
        show(f"{found.task} {found.form}: {found.score:.6g} on the {found.draws} brakes it was tuned on")
    except EmbError as err:
        return complain(PROG, err)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
