"""``emb-train``: learn an excitation, and evaluate it.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.config.bench import load_bench
from emb_bench.config.plants import EVERY
from emb_bench.output import progress, replacing
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError, near, needs
from emb_runtime.system.terminal import Parser, as_json, complain, json_document, mention, show
from emb_train.presets import DEFAULT_PRESET, listed, preset_summaries

if TYPE_CHECKING:
    from emb_bench.config.bench import Bench
    from emb_train.evaluate import Settings, Subject

CRITERIA = ("T", "I", "D", "A", "E", "weighted")

EPILOG = """\
examples:
  emb-train ppo -o mine && emb-run --iface sim --policy mine/actor.onnx
  emb-train ppo -o small --steps 2000000 --set hidden=[32,32]
  emb-train evaluate mine actor --plant exact,observer

Ctrl-C ends a command and keeps the best result so far.

exit codes: 0 done, 1 training diverged, 2 usage, 5 an ONNX file is refused, 130 interrupted (Ctrl-C)
"""
PPO_EPILOG = """\
example:
  emb-train ppo -o mine && emb-run --iface sim --policy mine/actor.onnx

presets:
{presets}

DIR contains actor.onnx (what emb-run takes: the actor with the best validation so far), training.json, bench.toml,
metrics.jsonl and curve.png. The validation uses brakes that no training draws. A training for speeds finds a plan,
lets the actor follow it, and improves that. Ctrl-C ends the training and keeps the best actor so far, or the actor that
follows the best plan so far.

exit codes: 0 done, 1 training diverged, 2 usage, 5 an ONNX file is refused, 130 interrupted (Ctrl-C)
"""
EVALUATE_EPILOG = """\
example:
  emb-train evaluate mine actor --plant exact,observer --draws 20

POLICY: the folder of a training, its plan.json, an ONNX file, or 'actor' for the shipped one

criteria: T adds -2 ln of the between-run interval of each parameter that an estimate will have, as emb-replay fim
expects it, and I of its repeatability; D, A and E are those of the physical information of ideal sensors with the
prior of +-50 %; 'weighted' is the smallest eigenvalue of the thesis's weighted information. All are relative to the
true parameters.

The optimum is the result of emb-design for the known brake. It exists for the plants euler and exact; a plant that
differs from exact only in its instruments is compared with exact. It takes minutes for the first brake and 15 s for
each further one. Ctrl-C ends the evaluation and shows the plants so far.

exit codes: 0 done, 2 usage, 5 a policy is refused, 130 interrupted (Ctrl-C)
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-train",
        description="Learn an excitation for brakes whose parameters are unknown.",
        epilog=EPILOG,
    )
    commands = p.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, add, summary, epilog in (
        (
            "ppo",
            _add_ppo,
            "train an actor by proximal policy optimisation, and write it as actor.onnx",
            PPO_EPILOG.format(presets=listed(preset_summaries())),
        ),
        (
            "evaluate",
            _add_evaluate,
            "compare policies with every reference excitation and the known-parameter optimum, on new brakes",
            EVALUATE_EPILOG,
        ),
    ):
        description = f"{summary[0].upper()}{summary[1:]}."
        add(commands.add_parser(name, help=summary, description=description, epilog=epilog))
    return p


def _add_common(p: argparse.ArgumentParser, plants: str | None, seed: str) -> None:
    default = plants or "the preset's"
    p.add_argument(
        "--plant", default=plants, metavar="NAMES", help=f"plants of the bench, or 'all' (default: {default})"
    )
    p.add_argument(
        "--command-delay",
        type=_at_least(0),
        nargs=2,
        metavar=("LEAST", "MOST"),
        default=(0, 0),
        help="delay of the commands, drawn for each experiment and covered by the shield [samples] (default: 0 0)",
    )
    p.add_argument("--seed", type=_at_least(0), default=0, metavar="S", help=f"{seed} (default: %(default)s)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench file (default: the shipped drum brake)")


def _add_ppo(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "preset",
        metavar="PRESET",
        nargs="?",
        default=DEFAULT_PRESET,
        help="what to learn: one of those below (default: %(default)s)",
    )
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="new folder for the results")
    p.add_argument(
        "--steps",
        type=_at_least(1),
        metavar="N",
        help="environment steps in total, rounded up to whole iterations (default: the preset's)",
    )
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a hyper-parameter, such as envs=448 or hidden=[32,32]; as often as needed",
    )
    _add_common(p, None, "seed of everything random")


def _add_evaluate(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "policies", nargs="+", metavar="POLICY", help="policies to evaluate; the first is compared with the others"
    )
    p.add_argument("--criterion", choices=CRITERIA, default="T", help="measure of an experiment (default: %(default)s)")
    p.add_argument("--ranges", metavar="NAME", help="ranges that brakes are drawn from (default: the policy's)")
    p.add_argument("--draws", type=_at_least(2), default=200, metavar="N", help="brakes (default: %(default)s)")
    p.add_argument(
        "--optimum",
        type=_at_least(0),
        default=0,
        metavar="N",
        help="search the optimum for the first N brakes, which takes minutes (default: %(default)s)",
    )
    p.add_argument("--json", action="store_true", help="print JSON, with the values of every draw")
    _add_common(p, "euler,exact", "seed of brakes and noise, which no training uses")


def _at_least(least: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least}, got '{text}'")
        return int(text)

    return number


def ppo(arguments: argparse.Namespace) -> int:
    """``emb-train ppo``.

    Raises:
        EmbError: see :func:`emb_train.training.begin_training` and :func:`emb_train.training.run_training`.
    """
    from emb_train.network import network_file
    from emb_train.plan import Found
    from emb_train.ppo import Metrics
    from emb_train.training import CURVE, ONNX, begin_training, draw_curve, load_preset, run_training

    bench, folder = load_bench(arguments.bench), arguments.output
    changes = _settings(arguments.preset, arguments.set)
    if arguments.steps is not None:
        if "total_steps" in changes:
            raise UsageError("--steps and --set total_steps: give one of them")
        changes["total_steps"] = arguments.steps
    if arguments.plant is not None:
        changes["plants"] = list(_plants(arguments.plant, bench))
    training = load_preset(
        arguments.preset, seed=arguments.seed, command_delay=list(arguments.command_delay), **changes
    )
    conditions = training.conditions
    if conditions.observes == "everything":
        raise UsageError(
            f"{training.preset}: its actor observes the parameters and the information, which no bench measures: it "
            "could be neither exported nor evaluated; python -m studies.thesis fig-5.2 fig-5.4 trains it and shows it"
        )
    begin_training(folder, training, bench)
    plans = 0 if training.plan is None else training.plan.rounds + 1
    with progress(training.preset, plans + training.ppo.iterations) as advance:

        def note(m: Metrics | Found | None) -> None:
            if m is None:
                advance("the actor learns the best plan")
            elif isinstance(m, Found):
                advance(f"plan {m.plans}, best {m.best:.3f}")
            else:
                advance(f"return {m.mean_return:.3f}, left {m.violations}, home {m.home} of {m.ended}")

        what, ended = "", EXIT_DONE
        try:
            for best in run_training(folder, training, bench, note):
                data, learned = network_file(best, training, bench)
                with replacing(folder / ONNX) as beside:
                    beside.write_bytes(data)
                what = learned
        except KeyboardInterrupt:
            if not what:  # and so the files of the beginning are of no use
                for path in folder.iterdir():
                    path.unlink()
                message = f"emb-train: interrupted; nothing was trained, {folder} is empty"
                raise KeyboardInterrupt(message) from None
            ended = EXIT_INTERRUPTED
    draw_curve(folder, folder / CURVE)
    alone = "" if conditions.shielded else "; trained without a shield, which changes its currents on a bench"
    show(
        f"{folder / ONNX}: {what}{alone}; emb-run --policy {folder / ONNX} plays it, emb-train evaluate {folder} "
        f"compares it, {folder / CURVE} shows the training"
    )
    return ended


def _settings(preset: str, given: list[str]) -> dict[str, Any]:
    """Hyper-parameters as ``NAME=VALUE``, the value as in a TOML file."""
    import tomllib

    from emb_train.training import hyper_parameters, load_preset

    values, found = hyper_parameters(load_preset(preset)), dict[str, Any]()
    for text in given:
        name, _, value = text.partition("=")
        if name in found:
            raise UsageError(f"--set: {name} is given twice: give it once")
        if name not in values:
            there = ", ".join(f"{n}={as_json(v)}" for n, v in values.items())
            raise UsageError(f"--set: no hyper-parameter is called '{name}'{near(name, values)}; there are: {there}")
        try:
            found[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            raise UsageError(
                f"--set: expected {name}=VALUE, such as {name}={as_json(values[name])}, got '{text}'"
            ) from None
    return found


def _plants(given: str, bench: Bench) -> tuple[str, ...]:
    """Names of plants with commas between them, or ``all`` of a bench."""
    plants = tuple(bench.plants) if given == EVERY else tuple(given.split(","))
    if len(set(plants)) < len(plants):
        raise UsageError(f"--plant: expected names of plants, each once, got '{given}'")
    return plants


def evaluate(arguments: argparse.Namespace) -> int:
    """``emb-train evaluate``.

    Raises:
        EmbError: see :func:`prepare` and :func:`emb_train.evaluate.evaluate`.
    """
    from rich.console import Console

    from emb_train.evaluate import evaluate, evaluation_document, evaluation_text

    bench, settings, subjects = prepare(arguments)
    with Console(stderr=True).status("") as status:
        results = evaluate(bench, settings, subjects, status.update)
    show(
        json_document(evaluation_document(settings, results)) if arguments.json else evaluation_text(settings, results)
    )
    return EXIT_DONE if len(results) == len(settings.plants) else EXIT_INTERRUPTED


def prepare(arguments: argparse.Namespace) -> tuple[Bench, Settings, list[Subject]]:
    """Arguments of ``emb-train evaluate``, checked.

    Raises:
        UsageError: an argument is out of its range, or the policies do not go together.
        EmbError: a policy cannot be opened, or the bench has no such ranges or plant.
    """
    from emb_train.closed_loop import Batch, Conditions
    from emb_train.evaluate import Settings, open_subject
    from emb_train.play import MEASURES

    if len(set(arguments.policies)) < len(arguments.policies):
        raise UsageError("a policy is named twice: expected each once")
    subjects = [open_subject(given, arguments.bench) for given in arguments.policies]
    bench = subjects[0].bench
    if any(s.bench.identity_hash != bench.identity_hash for s in subjects):
        raise UsageError("the policies are for different benches: evaluate them apart")
    plants = _plants(arguments.plant, bench)
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
        conditions=Conditions(information=measure.kind, command_delay=tuple(arguments.command_delay)),
    )
    for name in plants:  # what no experiment can be made of is refused before anything is looked for
        Batch(bench, ranges, settings.parameters, 1, name, settings.conditions)
    return bench, settings, subjects


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"ppo": ppo, "evaluate": evaluate}


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
