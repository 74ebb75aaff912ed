"""``emb-train``: learn an excitation.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError
from emb_runtime.system.terminal import complain, mention, show
from emb_train.names import listed
from emb_train.presets import load_preset, preset_names, preset_summaries
from emb_train.training.bench_compatibility import unfit

if TYPE_CHECKING:
    from emb_train.envs.play import GridResult
    from emb_train.training.configuration import Configuration

COMMANDS: Mapping[str, str] = {
    "evaluate": "emb_train.cli.evaluate",
    "tune": "emb_train.cli.tune",
}

EPILOG = """\
further commands, each with its own --help:
  emb-train evaluate    what an actor is worth, beside the best known-parameter inputs and every reference excitation
  emb-train tune        learn the reference that a structured actor follows: the main way, in minutes; with estimates

presets, and what they learn:
{presets}

exit codes: 0 done, 1 training diverged, 2 usage, 130 interrupted (Ctrl-C); after 1 or 130 the directory holds the
actor of the last whole iteration and best.safetensors, of the iteration that did best on brakes that no training draws,
which emb-export takes
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-train",
        description="Learn an excitation for brakes whose parameters are unknown within a range.",
        epilog=EPILOG.format(presets=listed(preset_summaries())),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"%(prog)s {version('emb-excite')}")
    p.add_argument("--preset", metavar="NAME", help="what to learn: one of those below")
    p.add_argument("--out", type=Path, metavar="DIR", help="new directory for checkpoint, configuration and metrics")
    p.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="environment steps in total, rounded up to whole iterations (default: the preset's)",
    )
    p.add_argument("--seed", type=int, metavar="S", help="seed of everything random (default: 0)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped drum brake)")
    p.add_argument("--plant", metavar="NAME", help="plant of the bench that the brakes are (default: the preset's)")
    p.add_argument(
        "--randomise",
        action="append",
        metavar="NAME=LEAST,MOST",
        help="give each experiment its own command_delay or measurement_delay [samples], frame_loss [probability], "
        "current_lag [s] or encoder_offset [rad], uniform from LEAST to MOST; repeatable (default: the preset's)",
    )
    return p


def evaluate(directory: Path) -> list[GridResult]:
    """The actor that is exported, on the grid, beside what needs no learning; also written to ``result.json``."""
    import torch

    from emb_train.envs.excitations import Network
    from emb_train.envs.play import GridResult, reference_ladder, run_grid
    from emb_train.ppo.networks import DeployedActor
    from emb_train.training.checkpoint import RESULT, chosen_checkpoint, load_actor, write_text

    config, bench, actor, _ = load_actor(directory, chosen_checkpoint(directory))
    bench = config.conditions.applied(bench)
    torch.set_num_threads(1)
    ranges, parameter = bench.range_set(config.ranges), config.parameters[0]
    excitation = Network(DeployedActor(actor, bench.limits.current))
    (own,) = run_grid(bench, ranges, parameter, [excitation], config.seed, config.plant)
    results = [
        GridResult("trained actor", own.fim, own.violations, own.home),
        *reference_ladder(bench, ranges, parameter, config.seed, config.plant),
    ]
    rows = [{"name": r.name, "mean_fim": r.mean, "violations": r.violations, "home": r.home} for r in results]
    write_text(directory / RESULT, json.dumps(rows, indent=2) + "\n")
    return results


def table(results: list[GridResult]) -> str:
    """Results as lines of text."""
    lines = [f"{'on the grid, same shield':<44}{'mean information':>18}{'violations':>12}{'home':>8}"]
    lines += [f"{r.name:<44}{r.mean:>18.4e}{r.violations:>12}{f'{r.home}/{len(r.fim)}':>8}" for r in results]
    return "\n".join(lines)


def prepare(arguments: argparse.Namespace) -> tuple[Path, Configuration, Bench]:
    """The directory, configuration and bench that the command line requests.

    Raises:
        UsageError: the arguments contradict each other, or the directory is not usable.
        BenchFileError: the bench file is not valid.
    """
    from emb_train.envs.conditions import parse_randomisation
    from emb_train.training.checkpoint import begin_directory

    if arguments.preset is None or arguments.out is None:
        raise UsageError(f"expected --preset and --out; presets: {', '.join(preset_names())}")
    bench = load_bench(arguments.bench)
    preset = load_preset(arguments.preset)
    if arguments.randomise:
        randomised = parse_randomisation(arguments.randomise)
        preset = replace(preset, conditions=replace(preset.conditions, randomised=randomised))
    config = configured(preset, bench, steps=arguments.steps, seed=arguments.seed or 0, plant=arguments.plant)
    begin_directory(arguments.out, config, bench)
    return arguments.out, config, bench


def configured(
    preset: Configuration, bench: Bench, *, steps: int | None, seed: int, plant: str | None
) -> Configuration:
    """A preset with what a command line changes.

    Raises:
        UsageError: a value is out of its range, or the bench has no such plant, or is none for this training.
    """
    from emb_train.envs.batch import require_covered, require_possible

    config = replace(preset, seed=seed, plant=plant or preset.plant)
    if steps is not None:
        config = replace(config, ppo=replace(preset.ppo, total_steps=steps))
    require_possible(bench.plant(config.plant), config.conditions)
    require_covered(bench, bench.range_set(config.ranges), config.conditions)
    require_whole_experiments(config, bench)
    return config


def require_whole_experiments(config: Configuration, bench: Bench) -> None:
    """Check that an iteration ends where its experiments end.

    Raises:
        UsageError: it does not, so that training would never see, or seldom see, the end of an experiment.
    """
    rollout, horizon = config.ppo.rollout, config.conditions.applied(bench).timing.horizon
    if rollout < horizon or (config.conditions.shielded and rollout % horizon):  # else experiments end at any step
        raise UsageError(
            f"expected a rollout of whole experiments, got {rollout} steps for the bench's horizon of {horizon}: "
            "use a bench file whose horizon divides it"
        )


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and not words[0].startswith("-"):
        return _further(words[0], words[1:])
    arguments = parser().parse_args(words)
    try:
        directory, config, bench = prepare(arguments)
        from emb_train.training.loop import train

        if config.conditions.shielded and (said := unfit(bench, bench.range_set(config.ranges))):
            mention(f"emb-train: this actor cannot be exported for this bench: {said}")
        train(directory, config, bench)
        show(_ended(directory, config))
    except ModuleNotFoundError as err:
        return complain("emb-train", UsageError(f"{err.name} is not installed: pip install 'emb-excite[train]'"))
    except EmbError as err:
        return complain("emb-train", err)
    except KeyboardInterrupt:
        mention("emb-train: interrupted; what was trained is as the last whole iteration left it")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _ended(directory: Path, config: Configuration) -> str:
    """Text after the last iteration."""
    if not config.conditions.shielded:
        return f"{directory}: trained without a shield, which no bench runs; the study of the thesis shows what it does"
    shown = f"{table(evaluate(directory))}\n" if len(config.parameters) == 1 else ""  # it knows one parameter only
    return f"{shown}{directory}: export it with emb-export {directory}; emb-train evaluate {directory} compares it"


def _further(command: str, words: list[str]) -> int:
    """Run one of :data:`COMMANDS`."""
    if command not in COMMANDS:
        there = ", ".join(COMMANDS)
        return complain("emb-train", UsageError(f"no command is called '{command}'; there are: {there}; or --preset"))
    try:
        return int(importlib.import_module(COMMANDS[command]).main(words))
    except ModuleNotFoundError as err:
        missing = UsageError(f"{err.name} is not installed: pip install 'emb-excite[train]'")
        return complain(f"emb-train {command}", missing)
    except KeyboardInterrupt:
        mention(f"emb-train {command}: interrupted")
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
