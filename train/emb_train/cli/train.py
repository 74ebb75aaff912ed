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
from typing import TYPE_CHECKING, Any

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError
from emb_runtime.system.terminal import complain, mention, show
from emb_train import CHECKPOINT
from emb_train.names import listed
from emb_train.presets import load_preset, preset_names, preset_summaries
from emb_train.training.bench_compatibility import unfit

if TYPE_CHECKING:
    from emb_train.envs.play import GridResult
    from emb_train.training.configuration import Configuration

DEVICES = ("auto", "cpu", "cuda")

COMMANDS: Mapping[str, str] = {
    "evaluate": "emb_train.cli.evaluate",
    "sweep": "emb_train.cli.sweep",
    "tune": "emb_train.cli.tune",
}

EPILOG = """\
further commands, each with its own --help:
  emb-train evaluate    what an actor is worth, beside the best known-parameter inputs and every reference excitation
  emb-train sweep       many trainings in parallel: seeds and hyper-parameters, on this machine or on Ray
  emb-train tune        learn the reference that a structured actor follows: the main way, in minutes; with estimates

presets, and what they learn:
{presets}

exit codes: 0 done, 1 training diverged, 2 usage, 130 interrupted (Ctrl-C); after 1, and after 130 once training has
begun, the directory holds the checkpoint of the last whole iteration, which --resume goes on from, and
best.safetensors, of the iteration that did best on brakes that no training draws, which emb-export takes
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
    p.add_argument("--resume", type=Path, metavar="DIR", help="go on with the training in DIR, to --steps if given")
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
    p.add_argument(
        "--device",
        choices=DEVICES,
        default="auto",
        help="where the networks learn; auto is the CPU for small ones. Only the CPU is deterministic",
    )
    p.add_argument("--tensorboard", action="store_true", help="also write what TensorBoard shows, into DIR/tensorboard")
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
    from emb_train.training.checkpoint import begin_directory, open_directory
    from emb_train.training.loop import chosen_device
    from emb_train.training.progress import require_tensorboard

    if arguments.tensorboard:
        require_tensorboard()
    if arguments.resume is not None:
        given = (arguments.preset, arguments.out, arguments.seed, arguments.bench, arguments.plant, arguments.randomise)
        if any(v is not None for v in given):
            raise UsageError(
                "--resume takes preset, seed, bench, plant and what is randomised from its directory; only --steps, "
                "--device and --tensorboard go with it"
            )
        config, bench = open_directory(arguments.resume)
        config = _lasting(config, arguments.steps)
        require_whole_experiments(config, bench)
        chosen_device(arguments.device, config.ppo)
        return arguments.resume, config, bench
    if arguments.preset is None or arguments.out is None:
        raise UsageError(f"expected --preset and --out, or --resume; presets: {', '.join(preset_names())}")
    bench = load_bench(arguments.bench)
    preset = load_preset(arguments.preset)
    if arguments.randomise:
        randomised = parse_randomisation(arguments.randomise)
        preset = replace(preset, conditions=replace(preset.conditions, randomised=randomised))
    config = configured(preset, bench, steps=arguments.steps, seed=arguments.seed or 0, plant=arguments.plant)
    chosen_device(arguments.device, config.ppo)
    begin_directory(arguments.out, config, bench)
    return arguments.out, config, bench


def configured(
    preset: Configuration, bench: Bench, *, steps: int | None, seed: int, plant: str | None, **setting: Any
) -> Configuration:
    """A preset with what a command line changes.

    Args:
        preset: to begin with.
        bench: that it is for.
        steps: environment steps in total, if not the preset's.
        seed: of everything random.
        plant: of the bench, if not the preset's.
        setting: hyper-parameters that are not the preset's.

    Raises:
        UsageError: a value is out of its range, or the bench has no such plant, or is none for this training.
    """
    from emb_train.envs.batch import require_covered, require_possible

    changed = replace(preset, ppo=replace(preset.ppo, **setting), seed=seed)
    config = _lasting(changed if plant is None else replace(changed, plant=plant), steps)
    require_possible(bench.plant(config.plant), config.conditions)
    require_covered(bench, bench.range_set(config.ranges), config.conditions)
    require_whole_experiments(config, bench)
    return config


def _lasting(config: Configuration, steps: int | None) -> Configuration:
    """Returns the configuration with this many environment steps, if a number is given."""
    from emb_train.ppo.ppo import LARGEST

    if steps is None:
        return config
    if not 1 <= steps <= LARGEST:
        raise UsageError(f"--steps: expected a whole number from 1 to {LARGEST}, got {steps}")
    return replace(config, ppo=replace(config.ppo, total_steps=steps))


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
        if train(directory, config, bench, device=arguments.device, tensorboard=arguments.tensorboard):
            show(_ended(directory, config))
        else:
            show(_had_ended(directory, config))
    except ModuleNotFoundError as err:
        return complain("emb-train", UsageError(f"{err.name} is not installed: pip install 'emb-excite[train]'"))
    except EmbError as err:
        return complain("emb-train", err)
    except KeyboardInterrupt:
        directory = arguments.resume or arguments.out
        saved = directory is not None and (directory / CHECKPOINT).exists()
        rest = f"--resume {directory} goes on after the last whole iteration" if saved else "nothing was saved"
        sys.stderr.write(f"emb-train: interrupted; {rest}\n")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _ended(directory: Path, config: Configuration) -> str:
    """Text after the last iteration."""
    if not config.conditions.shielded:
        return f"{directory}: trained without a shield, which no bench runs; the study of the thesis shows what it does"
    shown = f"{table(evaluate(directory))}\n" if len(config.parameters) == 1 else ""  # it knows one parameter only
    return f"{shown}{directory}: export it with emb-export {directory}; emb-train evaluate {directory} compares it"


def _had_ended(directory: Path, config: Configuration) -> str:
    """Text where nothing was left to do, with the table if the evaluation was interrupted."""
    from emb_train.training.checkpoint import RESULT

    steps = config.ppo.iterations * config.ppo.batch
    said = f"{directory}: finished before, nothing was trained; --steps with more than {steps} takes it further"
    evaluated = (directory / RESULT).exists() or not config.conditions.shielded or len(config.parameters) > 1
    return said if evaluated else f"{said}\n{_ended(directory, config)}"


def _further(command: str, words: list[str]) -> int:
    """Run one of :data:`COMMANDS`."""
    if command == "reproduce":  # this message is for version 0.2 only
        return complain("emb-train", UsageError("reproduce is a study now: in a clone, python -m studies.reproduce"))
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
