"""``emb-train``: learn an excitation, and evaluate it.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT, EVERY
from emb_bench.output import make_empty_folder, progress, replacing
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError, needs
from emb_runtime.system.terminal import Parser, as_json, complain, mention, show, typed_command
from emb_train.presets import TASKS, listed, preset_summaries, reference_names, wrapped

if TYPE_CHECKING:
    from emb_bench.config.bench import Bench
    from emb_bench.information.symmetric import Floats
    from emb_train.evaluate import Settings, Subject
    from emb_train.trial import Task

CRITERIA = ("T", "I", "D", "A", "E", "weighted")
FORMS = ("blind", "quadratic")
REFERENCE, BENCH, METRICS = "reference.json", "bench.toml", "metrics.jsonl"  # Files of a folder of results
EPILOG = """\
examples:
  emb-train reference four-d --output mine && emb-export mine/reference.json --output mine/actor.onnx
  emb-train ppo single-viscous --output run && emb-export run
  emb-train evaluate mine/actor.onnx four-d-exact-blind --plant exact

Ctrl-C ends a command and keeps the best result so far.

exit codes: 0 done, 1 training diverged, 2 usage, 5 an ONNX file is refused, 130 interrupted (Ctrl-C)
"""
REFERENCE_EPILOG = """\
tasks:
{tasks}

DIR contains reference.json (the input of emb-export), bench.toml and metrics.jsonl. The search begins with the task's
blind reference, with other levels (--begin), or with an earlier reference (--start); that of four-t, which is blind,
with the best of 800 plans at random. Ctrl-C ends it and keeps the best reference so far.
"""
PPO_EPILOG = """\
presets:
{presets}

DIR contains actor.safetensors (the actor with the best validation), training.json, bench.toml and metrics.jsonl. The
validation uses brakes that no training draws. Ctrl-C ends the training and keeps the best actor so far.
"""
EVALUATE_EPILOG = """\
POLICY: the folder of a training, an ONNX file, 'actor' for the shipped one, a reference's .json file, or one of
{references}

criteria: T adds -2 ln of the interval between runs of each parameter that an estimate will have, as emb-replay fim
expects it, and I of its repeatability; D, A and E are those of the physical information of ideal sensors with the
prior of +-50 %; 'weighted' is the smallest eigenvalue of the thesis's weighted information. All are relative to the
true parameters.

The optimum is the result of emb-design for the known brake. It exists for the plants euler and exact; a plant that
differs from exact only in its instruments is compared with exact. It takes minutes for the first brake and 15 s for
each further one. Ctrl-C ends the evaluation and shows the plants so far.
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-train",
        description="Learn an excitation for brakes whose parameters are unknown.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = p.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, summary: str, epilog: str) -> argparse.ArgumentParser:
        return commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    c = command(
        "reference",
        "learn a reference: speeds that depend on the running estimate (the main way, takes minutes)",
        REFERENCE_EPILOG.format(tasks=listed(TASKS)),
    )
    _add_reference(c)
    c = command(
        "ppo",
        "train a network by proximal policy optimisation, the thesis's way",
        PPO_EPILOG.format(presets=listed(preset_summaries())),
    )
    _add_ppo(c)
    c = command(
        "evaluate",
        "compare policies with every reference excitation and the known-parameter optimum, on new brakes",
        EVALUATE_EPILOG.format(references=wrapped(reference_names())),
    )
    _add_evaluate(c)
    return p


def _add_common(p: argparse.ArgumentParser, seed: str) -> None:
    p.add_argument("--seed", type=_at_least(0), default=0, metavar="S", help=f"{seed} (default: %(default)s)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench file (default: the shipped drum brake)")


def _add_reference(p: argparse.ArgumentParser) -> None:
    p.add_argument("task", metavar="TASK", choices=TASKS, help="what the reference is for: one of those below")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="new folder for the results")
    p.add_argument(
        "--form",
        choices=FORMS,
        help="levels and switches that are constant, or quadratic in the estimate (default: quadratic; four-t: blind)",
    )
    p.add_argument("--start", metavar="NAME|FILE", help="reference to begin with: a packaged one, or a JSON file")
    p.add_argument(
        "--begin", type=_blind, metavar="NUMBERS", help="levels, then switching times: --begin=1,-1,-0.01,0.3,0.6"
    )
    p.add_argument("--steps", type=_at_least(1), metavar="N", help="steps of the search (default: 400; four-t: 80)")
    p.add_argument("--plant", default=DEFAULT_PLANT, metavar="NAME", help="plant of the brakes (default: %(default)s)")
    _add_late(p)
    p.add_argument(
        "--gain",
        type=_gain,
        default=1.0,
        metavar="X",
        help="gain of the speed loop; less than 1 if commands act late (default: %(default)s)",
    )
    _add_common(p, "seed of the search and of the brakes")


def _add_ppo(p: argparse.ArgumentParser) -> None:
    p.add_argument("preset", metavar="PRESET", help="what to learn: one of those below")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="new folder for the results")
    p.add_argument(
        "--steps",
        type=_at_least(1),
        metavar="N",
        help="environment steps in total, rounded up to whole iterations (default: the preset's)",
    )
    p.add_argument("--plant", metavar="NAME", help="plant of the brakes (default: the preset's)")
    _add_late(p)
    _add_common(p, "seed of everything random")


def _add_evaluate(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "policies", nargs="+", metavar="POLICY", help="policies to evaluate; the first is compared with the others"
    )
    p.add_argument("--criterion", choices=CRITERIA, default="T", help="measure of an experiment (default: %(default)s)")
    p.add_argument(
        "--ranges", metavar="NAME", help="name of the ranges that brakes are drawn from (default: the policy's)"
    )
    p.add_argument(
        "--draws", type=_at_least(2), default=200, metavar="N", help="number of brakes (default: %(default)s)"
    )
    p.add_argument(
        "--plant", default="euler,exact", metavar="NAMES", help="plants of the bench, or 'all' (default: %(default)s)"
    )
    p.add_argument(
        "--optimum",
        type=_at_least(0),
        default=0,
        metavar="N",
        help="search the optimum for the first N brakes, which takes minutes (default: %(default)s)",
    )
    p.add_argument("--json", action="store_true", help="print JSON, with the values of every draw")
    p.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="also write evaluation.txt and evaluation.json there"
    )
    _add_late(p)
    _add_common(p, "seed of brakes and noise, which no training uses")


def _add_late(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--command-delay",
        type=_at_least(0),
        nargs=2,
        metavar=("LEAST", "MOST"),
        default=(0, 0),
        help="delay of the commands, drawn for each experiment and covered by the shield [samples] (default: 0 0)",
    )


def _at_least(least: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least}, got '{text}'")
        return int(text)

    return number


def _gain(text: str) -> float:
    try:
        if 0.0 < (value := float(text)) <= 1.0:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"expected more than 0 and at most 1, got '{text}'")


def _blind(text: str) -> list[float]:
    try:
        numbers = [float(value) for value in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) % 2 == 0 or not all(math.isfinite(value) for value in numbers):
        raise argparse.ArgumentTypeError(f"expected levels and then switches, one less, got '{text}'")
    return numbers


def reference(arguments: argparse.Namespace) -> int:
    """``emb-train reference``.

    Raises:
        UsageError: the arguments do not go together, or a file cannot be read or written.
        BenchFileError: the bench lacks a set or the plant.
    """
    from emb_bench.estimate.expected import IntervalCriterion
    from emb_runtime.estimator.speed_loop import scale_of
    from emb_train.evolve import BATCH, Progress, evolve
    from emb_train.plan import BRAKES, SCREENINGS, search
    from emb_train.reference import Form, Stored
    from emb_train.trial import TASKS

    bench, (least, most) = load_bench(arguments.bench), arguments.command_delay
    task = replace(TASKS[arguments.task], plant=arguments.plant, command_delay=(least, most))
    planned = isinstance(task.measure.goal, IntervalCriterion)
    form: Form = arguments.form or task.form
    steps = arguments.steps or task.steps
    if planned and form != "blind":
        raise UsageError(f"--form: expected blind for {task.name}, whose plan does not depend on the estimate")
    begin = _beginning(arguments, task, blind=form == "blind")
    at_random = planned and arguments.begin is None and arguments.start is None
    task.trials(bench, task.draws(bench, 0, 1))  # what cannot be is refused before there is a folder
    folder = arguments.output
    make_empty_folder(folder)
    (folder / BENCH).write_text(bench.text, encoding="utf-8")
    with (
        (folder / METRICS).open("a", encoding="utf-8") as metrics,
        progress(task.name, steps + (SCREENINGS if at_random else 0)) as advance,
    ):

        def note(step: Progress) -> None:
            metrics.write(as_json(step._asdict()) + "\n")
            metrics.flush()
            advance(f"score {step.score:.6g}, left {step.left}, home {step.home} of {step.played}")

        scale, seed = scale_of(bench, arguments.gain), arguments.seed
        if planned:
            found = search(task, bench, scale, None if at_random else begin, steps=steps, seed=seed, show=note)
        else:
            found = evolve(task, bench, scale, begin, steps=steps, seed=seed, blind=form == "blind", show=note)
    kept = Stored(
        task=task.name,
        form=form,
        plant=task.plant,
        gain=arguments.gain,
        table=tuple(tuple(row) for row in found.table.tolist()),
        seed=arguments.seed,
        score=found.score,
        draws=BRAKES if planned else found.steps * BATCH,
        command=typed_command("emb-train", arguments.typed),
        command_delay=task.command_delay,
    )
    with replacing(folder / REFERENCE) as beside:
        beside.write_text(kept.to_json(), encoding="utf-8")
    show(f"{kept.task} {kept.form}: {kept.score:.6g} on brakes that no step had; {folder / REFERENCE}")
    return EXIT_DONE if found.steps == steps else EXIT_INTERRUPTED


def _beginning(arguments: argparse.Namespace, task: Task, *, blind: bool) -> Floats:
    """The table that the search begins with, shape [2 n − 1, TERMS]."""
    import numpy as np

    from emb_train.reference import TERMS, stored

    if arguments.start is not None:
        table = stored(arguments.start).array()
        if blind and table[:, 1:].any():
            raise UsageError("--start: expected a blind reference for --form blind")
        return table
    numbers = arguments.begin or task.begin
    table = np.zeros((len(numbers), TERMS))
    table[:, 0] = numbers
    return table


def ppo(arguments: argparse.Namespace) -> int:
    """``emb-train ppo``.

    Raises:
        EmbError: see :func:`emb_train.training.begin_training` and :func:`emb_train.training.run_training`.
    """
    import msgspec

    from emb_train.closed_loop import EVERYTHING
    from emb_train.ppo import Metrics
    from emb_train.training import ACTOR, begin_training, load_preset, run_training

    bench, folder = load_bench(arguments.bench), arguments.output
    changes = {"total_steps": arguments.steps, "plant": arguments.plant, "seed": arguments.seed}
    training = load_preset(arguments.preset, **{k: v for k, v in changes.items() if v is not None})
    conditions = msgspec.structs.replace(training.conditions, command_delay=tuple(arguments.command_delay))
    training = msgspec.structs.replace(training, conditions=conditions)
    if conditions.observes == EVERYTHING:
        raise UsageError(
            f"{training.preset}: its actor observes the parameters and the information, which no bench measures: it "
            "could be neither exported nor evaluated; python -m studies.thesis fig-5.2 fig-5.4 trains it and shows it"
        )
    begin_training(folder, training, bench)
    with progress(training.preset, training.ppo.iterations) as advance:

        def note(m: Metrics) -> None:
            advance(f"return {m.mean_return:.3f}, information {m.information:.3e}, left {m.violations}, home {m.home}")

        try:
            run_training(folder, training, bench, note)
        except KeyboardInterrupt:
            kept = f"the best actor so far is in {folder}" if (folder / ACTOR).exists() else "nothing was trained"
            raise KeyboardInterrupt(f"emb-train: interrupted; {kept}") from None
    alone = "" if conditions.shielded else "; trained without a shield, which changes its currents on a bench"
    show(f"{folder}: export it with emb-export {folder}; emb-train evaluate {folder} compares it{alone}")
    return EXIT_DONE


def evaluate(arguments: argparse.Namespace) -> int:
    """``emb-train evaluate``.

    Raises:
        EmbError: see :func:`prepare` and :func:`emb_train.evaluate.evaluate`.
    """
    from rich.console import Console

    from emb_train.evaluate import document, evaluate, text

    bench, settings, subjects = prepare(arguments)
    if arguments.output is not None:
        make_empty_folder(arguments.output)
    with Console(stderr=True).status("") as status:
        results = evaluate(bench, settings, subjects, status.update)
    table, record = text(settings, results), as_json(document(settings, results))
    if arguments.output is not None:
        (arguments.output / "evaluation.txt").write_text(table + "\n", encoding="utf-8")
        (arguments.output / "evaluation.json").write_text(record + "\n", encoding="utf-8")
    show(record if arguments.json else table)
    return EXIT_DONE if len(results) == len(settings.plants) else EXIT_INTERRUPTED


def prepare(arguments: argparse.Namespace) -> tuple[Bench, Settings, list[Subject]]:
    """Arguments of ``emb-train evaluate``, checked.

    Raises:
        UsageError: an argument is out of its range, or the policies do not go together.
        EmbError: a policy cannot be opened, or the bench has no such ranges or plant.
    """
    from emb_train.closed_loop import Batch, Conditions
    from emb_train.evaluate import Settings, open_subject
    from emb_train.evolve import TUNING_SEED
    from emb_train.play import MEASURES

    if arguments.seed >= TUNING_SEED:
        raise UsageError(f"--seed: expected less than {TUNING_SEED}, for references are tuned on what is from there on")
    if len(set(arguments.policies)) < len(arguments.policies):
        raise UsageError("a policy is named twice: expected each once")
    subjects = [open_subject(given, arguments.bench) for given in arguments.policies]
    bench = subjects[0].bench
    if any(s.bench.identity_hash != bench.identity_hash for s in subjects):
        raise UsageError("the policies are for different benches: evaluate them apart")
    plants = tuple(bench.plants) if arguments.plant == EVERY else tuple(arguments.plant.split(","))
    if len(set(plants)) < len(plants):
        raise UsageError(f"--plant: expected names of plants, each once, got '{arguments.plant}'")
    if any(s.shield != subjects[0].shield for s in subjects):
        raise UsageError("the policies were made behind different shields: evaluate them apart")
    named = {arguments.ranges} if arguments.ranges else {s.ranges for s in subjects}
    if len(named) > 1 or "" in named:
        raise UsageError("--ranges: the policies do not say which, or not the same: name it")
    ranges = bench.range_set(named.pop())
    measure = MEASURES[arguments.criterion]
    settings = Settings(
        measure=measure,
        parameters=tuple(n for n in PARAMETER_NAMES if getattr(ranges.low, n) < getattr(ranges.high, n)),
        ranges=ranges.name,
        plants=plants,
        draws=arguments.draws,
        seed=arguments.seed,
        optimum=min(arguments.optimum, arguments.draws),
        conditions=Conditions(
            information=measure.kind,
            shield_ranges=subjects[0].shield,
            command_delay=tuple(arguments.command_delay),
        ),
    )
    for name in plants:  # what no experiment can be made of is refused before anything is looked for
        Batch(bench, ranges, settings.parameters, 1, name, settings.conditions)
    return bench, settings, subjects


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"reference": reference, "ppo": ppo, "evaluate": evaluate}


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    name = "emb-train"
    try:
        arguments: Any = parser().parse_args(argv)
        name = f"emb-train {arguments.command}"
        with needs("training", "train"):
            return COMMANDS[arguments.command](arguments)
    except EmbError as err:
        return complain(name, err)
    except KeyboardInterrupt as err:
        mention(str(err) or f"{name}: interrupted")
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
