"""``emb-train evaluate``: evaluation of an actor against the known-parameter optimum and baselines without learning."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.output import replacing
from emb_bench.parallel.progress import StatusLine
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.config.plants import EVERY
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError
from emb_runtime.system.terminal import as_json, complain, show
from emb_train.names import reference_names, wrapped

if TYPE_CHECKING:
    from emb_train.envs.conditions import Randomisation
    from emb_train.evaluation.actors import Subject
    from emb_train.evaluation.evaluation import Evaluation, Settings

PROG = "emb-train evaluate"
DRAWS = 200
OPTIMUM_DRAWS = 20
CRITERIA = ("D", "A", "E", "weighted")
DESCRIPTION = """\
Play an actor on brakes that it never saw, beside every reference excitation, all behind the same shield, and say how
much of the known-parameter optimum it reaches, whether it keeps the limits, and where it ends.

ACTOR is the directory of a training, one of its checkpoints, an ONNX file, 'actor' for the shipped one, or the
reference of a structured actor, such as four-e-exact-quadratic or a .json file. Of a training's directory the best
checkpoint is played, as emb-export takes it; with actor.onnx in it, network and file are both played, and compared.
Several ACTORs, trained with different seeds for one thing, give an interval over them as well.

references of structured actors:
{references}
"""
EPILOG = """\
criteria: D, A and E of the physical information with the prior of +-50 %; 'weighted' is the smallest eigenvalue of the
thesis's weighted information, for one parameter that information itself. All relative to the true parameters.

The optimum is found by the search of emb-design, on the thesis's brakes (euler, exact; a plant that differs from
exact in its instruments alone is held against exact), for the first --optimum-draws brakes: minutes for the first
one and a quarter of a minute for each other. What is found is kept in the --optimum-file, so that it is there the next
time, and an evaluation that was interrupted goes on.

exit codes: 0 done, 1 a network and its exported file do not give the same currents, 2 usage, 5 the ONNX file is
refused, 130 interrupted (Ctrl-C)
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROG,
        description=DESCRIPTION.format(references=wrapped(reference_names())),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("actors", nargs="+", metavar="ACTOR", help="what is evaluated")
    p.add_argument("--criterion", choices=CRITERIA, default="D", help="by what (default: %(default)s)")
    p.add_argument("--parameters", metavar="NAMES", help="unknown ones, such as f_v,k_1 (default: the actor's)")
    p.add_argument("--ranges", metavar="NAME", help="where brakes are drawn from, by name (default: the actor's)")
    p.add_argument(
        "--shield",
        metavar="NAME",
        help="ranges that the shield covers (default: those that it covered when the actor learned; of an ONNX file "
        "those that the bench names)",
    )
    p.add_argument(
        "--randomise",
        action="append",
        default=[],
        metavar="NAME=LEAST,MOST",
        help="give each experiment its own command_delay or measurement_delay [samples], frame_loss [probability], "
        "current_lag [s] or encoder_offset [rad], uniform from LEAST to MOST, on top of the plant's; repeatable. The "
        "shield is widened to cover delay or lag",
    )
    p.add_argument("--last", action="store_true", help="of a training, play the last checkpoint, not the best one")
    p.add_argument("--draws", type=int, default=DRAWS, metavar="N", help="brakes (default: %(default)s)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of brakes and noise; never those of a training")
    p.add_argument(
        "--plant", default="euler,exact", metavar="NAMES", help="of the bench, or 'all' (default: %(default)s)"
    )
    p.add_argument(
        "--optimum-draws",
        type=int,
        default=OPTIMUM_DRAWS,
        metavar="N",
        help="search the optimum for the first N brakes; 0 for none (default: %(default)s)",
    )
    p.add_argument(
        "--optimum-file", type=Path, metavar="FILE", help="where optima are kept (default: the user's cache)"
    )
    p.add_argument(
        "--jobs", type=int, metavar="N", help="processes that search for optima (default: one per processor)"
    )
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench of what has none with it (default: the shipped)")
    p.add_argument("--json", action="store_true", help="print JSON, with the values of every draw; what is not is null")
    p.add_argument("-o", "--out", type=Path, metavar="DIR", help="also write evaluation.txt and evaluation.json there")
    return p


def prepare(arguments: argparse.Namespace) -> tuple[Bench, Settings, list[Subject]]:
    """Parsed arguments, checked.

    Raises:
        UsageError: an argument is out of its range, or the actors do not go together.
        EmbError: an actor cannot be opened, or the bench has no such ranges or plant.
    """
    from emb_train.envs.batch import Batch
    from emb_train.envs.measure import MEASURES
    from emb_train.evaluation.actors import open_subject
    from emb_train.evaluation.evaluation import Settings
    from emb_train.structured.evolution import TUNING_SEED

    for option, value, least in (
        ("--draws", arguments.draws, 2),
        ("--seed", arguments.seed, 0),
        ("--optimum-draws", arguments.optimum_draws, 0),
        ("--jobs", 1 if arguments.jobs is None else arguments.jobs, 1),
    ):
        if value < least:
            raise UsageError(f"{option}: expected a whole number from {least}, got {value}")
    if arguments.seed >= TUNING_SEED:
        raise UsageError(f"--seed: expected less than {TUNING_SEED}, for references are tuned on what is from there on")
    if len(set(arguments.actors)) < len(arguments.actors):
        raise UsageError("an actor is named twice: expected each once")
    randomised = _randomised(arguments.randomise)
    if arguments.last and not any(Path(given).is_dir() for given in arguments.actors):
        raise UsageError("--last: only the directory of a training has several checkpoints; leave it out")
    subjects = [open_subject(given, arguments.bench, arguments.last) for given in arguments.actors]
    bench = subjects[0].bench
    if any(s.bench.contract_hash != bench.contract_hash for s in subjects):
        raise UsageError("the actors are for different benches: evaluate them apart")
    parameters = _one("--parameters", _names(arguments.parameters), [s.parameters for s in subjects])
    ranges = _one("--ranges", arguments.ranges, [s.ranges for s in subjects])
    if tuple(p for p in PARAMETER_NAMES if p in parameters) != parameters:
        parameters = tuple(sorted(set(parameters), key=_place))
    plants = tuple(bench.plants) if arguments.plant == EVERY else _names(arguments.plant) or ()
    for name in plants:
        bench.plant(name)
    if not plants or len(set(plants)) < len(plants):
        raise UsageError(f"--plant: expected names of plants, each once, got '{arguments.plant}'")
    draws, optimum_draws = arguments.draws, min(arguments.optimum_draws, arguments.draws)
    measure, shield = MEASURES[arguments.criterion], _shield(arguments.shield, subjects)
    settings = Settings(measure, parameters, ranges, plants, draws, arguments.seed, optimum_draws, shield, randomised)
    for name in plants:  # what no experiment can be made of is refused before anything is looked for
        Batch(bench, bench.range_set(ranges), parameters, 1, plant=name, conditions=settings.conditions)
    return bench, settings, subjects


def _shield(given: str | None, subjects: list[Subject]) -> str:
    """The set that the shield covers: what was given, or else what all actors had when they learned."""
    if given:
        return given
    if any(s.shield != subjects[0].shield for s in subjects):
        raise UsageError("--shield: the actors learned behind different ones: name the ranges that it covers")
    return subjects[0].shield


def _randomised(given: list[str]) -> Randomisation:
    from emb_train.envs.conditions import parse_randomisation

    try:
        return parse_randomisation(given)
    except UsageError as err:
        raise UsageError(f"--randomise: {err}") from err


def _place(name: str) -> int:
    if name not in PARAMETER_NAMES:
        raise UsageError(f"--parameters: expected some of {', '.join(PARAMETER_NAMES)}, got '{name}'")
    return PARAMETER_NAMES.index(name)


def _names(given: str | None) -> tuple[str, ...] | None:
    return None if given is None else tuple(name.strip() for name in given.split(",") if name.strip())


def _one(option: str, given: Any, of_actors: list[Any]) -> Any:
    """The given value, or else the one that all actors share."""
    if given:
        return given
    if not of_actors[0] or any(other != of_actors[0] for other in of_actors):
        raise UsageError(f"{option}: the actors do not say which, or not the same: name it")
    return of_actors[0]


def run(arguments: argparse.Namespace) -> tuple[Evaluation, Path | None]:
    """Evaluate, and the directory to write to.

    Raises:
        EmbError: see :func:`prepare` and :func:`emb_train.evaluation.evaluation.evaluate`.
    """
    from emb_train.evaluation.evaluation import evaluate
    from emb_train.evaluation.known_optimum import KnownOptimum, default_path, require_place

    bench, settings, subjects = prepare(arguments)
    if settings.optimum_draws and arguments.optimum_file is not None:
        require_place(arguments.optimum_file)
    if arguments.out is not None:
        try:
            arguments.out.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise UsageError(f"--out {arguments.out}: cannot use this directory: {err.strerror}") from err
    known = None
    if settings.optimum_draws:
        known = KnownOptimum(bench, settings.measure, settings.parameters, arguments.optimum_file or default_path())
    jobs = arguments.jobs or os.cpu_count() or 1
    line = StatusLine(sys.stderr, prefix=f"{PROG}: ")
    try:
        found = evaluate(bench, settings, subjects, known, jobs, lambda said: line.say(said, time.monotonic()))
    finally:
        line.end()
    return found, arguments.out


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        found, directory = run(arguments)
        from emb_train.evaluation.report import document, text

        table, record = text(found), as_json(document(found))
        if directory is not None:
            for name, content in (("evaluation.txt", table), ("evaluation.json", record)):
                with replacing(directory / name) as beside:
                    beside.write_text(content + "\n", encoding="utf-8")
        show(record if arguments.json else table)
    except EmbError as err:
        return complain(PROG, err)
    except KeyboardInterrupt:
        sys.stderr.write(f"{PROG}: interrupted; the optima that were found are kept\n")
        return EXIT_INTERRUPTED
    return EXIT_DONE if found.agree else EXIT_CHECK_FAILED
