"""``emb-train sweep``: many trainings in parallel, over seeds and hyper-parameters, and their joint result."""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from emb_bench.report.text import Table
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError
from emb_runtime.system.realtime import processors
from emb_runtime.system.terminal import as_json, complain, mention, show

PROGRAM = "emb-train sweep"
RESULT = "sweep.json"
LOG = "progress.txt"
DESCRIPTION = """\
Train a preset once for each seed and each combination of hyper-parameters, each training in a directory of its own, as
many at a time as there are processors, and print mean and 95 % interval over the seeds for each combination. What is
finished already is not trained again, what was interrupted goes on: repeat the same command. A training that fails
costs the others nothing.
"""
EPILOG = """\
The score is the mean return on brakes that no training draws, in the training's own reward; 'best' is that of the best
iteration. Exit codes: 0 done, 1 a training failed, 2 usage, 130 interrupted (Ctrl-C). On a cluster (--ray ADDRESS) all
machines need emb-excite and the same directory DIR.
"""


READ: Mapping[object, tuple[str, Callable[[str], Any]]] = {
    int: ("a whole number", int),
    float: ("a number", float),
    str: ("a word", str),
}
"""Name and reader of the values of a type."""


class Trial(NamedTuple):
    """One training of a sweep."""

    setting: str  # The hyper-parameters that differ from the preset's, as on the command line
    seed: int
    directory: str


class Outcome(NamedTuple):
    """Result of one training of a sweep."""

    score: float | None = None  # Mean return after the last iteration on brakes that no training draws
    best: float | None = None  # Mean return of the best iteration
    information: float | None = None  # Mean information of the last iteration's experiments, exploration included
    violations: int | None = None  # Experiments of the last iteration that left the limits
    error: str = ""  # Reason, if the training failed


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM, description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--preset", required=True, metavar="NAME", help="what to learn: one that emb-train --help lists")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="a directory for each training comes in here")
    p.add_argument("--seeds", default="0", metavar="A-B|A,B", help="seeds, for example 0-4 or 0,3,7 (default: 0)")
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=V,V",
        help="values of a hyper-parameter, for example learning_rate=1e-3,2e-3 or hidden=32x32,64x64; may be repeated",
    )
    p.add_argument("--steps", type=int, metavar="N", help="environment steps of each training (default: the preset's)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped drum brake)")
    p.add_argument("--plant", metavar="NAME", help="plant of the bench that the brakes are (default: the preset's)")
    p.add_argument("--jobs", type=int, metavar="N", help="trainings at a time (default: one for each processor)")
    p.add_argument(
        "--ray",
        nargs="?",
        const="local",
        metavar="ADDRESS",
        help="use Ray: the cluster at this address, without one a Ray of its own on this machine",
    )
    p.add_argument("--json", action="store_true", help=f"print what is written to DIR/{RESULT}")
    return p


def seeds_of(text: str) -> list[int]:
    """Seeds of ``0-4`` or ``0,3,7``.

    Raises:
        UsageError: it is neither, or one of them comes twice.
    """
    seeds: list[int] = []
    for part in text.split(","):
        low, dash, high = part.partition("-")
        if not low.isdecimal() or not (high if dash else low).isdecimal():
            raise UsageError(f"--seeds: expected for example 0-4 or 0,3,7, got '{text}'")
        seeds += range(int(low), int(high or low) + 1)
    if not seeds or len(set(seeds)) != len(seeds):
        raise UsageError(f"--seeds: expected different seeds, got '{text}'")
    return seeds


def settings_of(sets: Sequence[str]) -> list[dict[str, Any]]:
    """Every combination of the values in texts like ``learning_rate=1e-3,2e-3``.

    Raises:
        UsageError: there is no such hyper-parameter, it comes twice, or a value is none.
    """
    from emb_train.ppo.ppo import PpoConfig

    hints, names = get_type_hints(PpoConfig), {f.name for f in fields(PpoConfig)} - {"total_steps"}
    values: dict[str, list[Any]] = {}
    for text in sets:
        name, _, listed = text.partition("=")
        if name not in names or name in values or not listed:
            raise UsageError(f"--set: expected NAME=VALUE,VALUE with one of {', '.join(sorted(names))}, got '{text}'")
        values[name] = [_value(name, hints[name], word) for word in listed.split(",")]
    return [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())]


def _value(name: str, hint: object, word: str) -> Any:
    expected, read = READ.get(hint, ("widths such as 64x64", _widths))
    try:
        return read(word)
    except ValueError:
        raise UsageError(f"--set: {name}: expected {expected}, got '{word}'") from None


def _widths(word: str) -> tuple[int, ...]:
    return tuple(int(width) for width in word.split("x"))


def begin(arguments: argparse.Namespace, bench: Bench) -> list[Trial]:
    """The trainings, each with its directory begun or found as it was left.

    Raises:
        UsageError: see :func:`seeds_of`, :func:`settings_of` and :mod:`emb_train.training.checkpoint`; or a directory
        holds
            another training.
    """
    from emb_train.cli.train import configured
    from emb_train.presets import load_preset
    from emb_train.training.checkpoint import CONFIG, begin_directory, open_directory

    preset = load_preset(arguments.preset)
    seeds, settings = seeds_of(arguments.seeds), settings_of(arguments.set)
    wanted = {}
    for setting, seed in itertools.product(settings, seeds):
        name = ",".join(f"{k}={_said(v)}" for k, v in setting.items())
        config = configured(preset, bench, steps=arguments.steps, seed=seed, plant=arguments.plant, **setting)
        directory = arguments.out / f"{name + ',' if name else ''}seed={seed}"
        wanted[Trial(name, seed, str(directory))] = config
    if len({trial.directory for trial in wanted}) < len(settings) * len(seeds):
        raise UsageError("--set: the same value comes twice")
    for trial, config in wanted.items():
        directory = Path(trial.directory)
        if not (directory / CONFIG).exists():
            begin_directory(directory, config, bench)
        found, its_bench = open_directory(directory)
        if (found, its_bench.text) != (config, bench.text):
            raise UsageError(
                f"{directory}: holds another training, of other steps, plant or bench: choose another --out"
            )
    return list(wanted)


def _said(value: object) -> str:
    return (
        "x".join(map(str, value))
        if isinstance(value, tuple)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


def trained(trial: Trial) -> Outcome:
    """Train, or go on; what goes wrong is in the outcome."""
    from emb_train.training.checkpoint import METRICS, best_score, open_directory
    from emb_train.training.loop import train

    directory = Path(trial.directory)
    try:
        config, bench = open_directory(directory)
        with (directory / LOG).open("a", encoding="utf-8") as out:
            train(directory, config, bench, device="cpu", out=out)
        last = json.loads((directory / METRICS).read_text(encoding="utf-8").splitlines()[-1])
        return Outcome(last["score"], best_score(directory), last["mean_fim"], last["violations"])
    except EmbError as err:
        return Outcome(error=" ".join(str(err).split()))
    except OSError as err:
        return Outcome(error=f"{directory}: {err.strerror}")
    except (ValueError, LookupError, TypeError) as err:
        return Outcome(error=f"{directory / METRICS}: the last line is not that of an iteration: {err}")


def outcomes(trials: Sequence[Trial], jobs: int | None, ray: str | None) -> Iterator[tuple[Trial, Outcome]]:
    """Every training with its outcome, as they come.

    Raises:
        UsageError: Ray cannot be used.
    """
    from emb_bench.parallel.processes import Lost, shared_out
    from emb_bench.parallel.ray_tasks import shared_out_on_ray

    numbered: Generator[tuple[int, Outcome | Lost], None, None]
    if ray is None:
        numbered = shared_out(trained, trials, jobs or len(processors()))
    else:
        numbered = shared_out_on_ray(trained, trials, jobs, ray, PROGRAM)
    with closing(numbered):  # processes end here, whatever happens
        for number, outcome in numbered:
            if isinstance(outcome, Lost):
                outcome = Outcome(error=f"its process {outcome.how}")
            yield trials[number], outcome


def document(results: Mapping[Trial, Outcome]) -> dict[str, Any]:
    """All of it as JSON: trainings, and for each setting mean and 95 % interval over the seeds that did not fail."""
    import numpy as np

    from emb_train.envs.measure import mean_score

    groups = []
    for setting in dict.fromkeys(trial.setting for trial in results):
        of_it = [outcome for trial, outcome in results.items() if trial.setting == setting]
        group: dict[str, Any] = {
            "setting": setting,
            "trainings": len(of_it),
            "failed": sum(bool(o.error) for o in of_it),
        }
        for name in ("score", "best", "information"):
            values = [v for o in of_it if (v := getattr(o, name)) is not None]
            group[name] = list(mean_score(np.array(values))) if values else None
        group["violations"] = sum(o.violations or 0 for o in of_it)
        groups.append(group)
    trainings = [trial._asdict() | outcome._asdict() for trial, outcome in results.items()]
    return {"settings": groups, "trainings": trainings}


def table(said: Mapping[str, Any]) -> str:
    """The settings as lines of text, and every failure."""
    rows = [
        [
            group["setting"] or "preset",
            f"{group['trainings'] - group['failed']}/{group['trainings']}",
            *(_interval(group["score"], "g"), _interval(group["best"], "g"), _interval(group["information"], "e")),
            str(group["violations"]),
        ]
        for group in said["settings"]
    ]
    title = "mean ± half its 95 % interval over the seeds"
    lines = Table(title, ["setting", "seeds", "score", "best", "information", "left"], rows).text()[:-1]
    return "\n".join([*lines, *(f"FAILED {t['directory']}: {t['error']}" for t in said["trainings"] if t["error"])])


def _interval(score: Sequence[float] | None, kind: str) -> str:
    if score is None:
        return "-"
    value, low, high = score
    said = _number(value, f".4{kind}" if kind == "g" else ".3e")
    return said + ("" if math.isnan(low) else f" ± {0.5 * (high - low):.2{kind}}")


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        return _run(arguments)
    except EmbError as err:
        return complain(PROGRAM, err)
    except KeyboardInterrupt:
        mention(f"{PROGRAM}: interrupted; the same command goes on after each training's last whole iteration")
        return EXIT_INTERRUPTED


def _run(arguments: argparse.Namespace) -> int:
    from emb_train.training.checkpoint import write_text

    if arguments.jobs is not None and arguments.jobs < 1:
        raise UsageError(f"--jobs: expected 1 or more, got {arguments.jobs}")
    trials = begin(arguments, load_bench(arguments.bench))
    found: dict[Trial, Outcome] = {}
    for trial, outcome in outcomes(trials, arguments.jobs, arguments.ray):
        found[trial] = outcome
        ended = f"FAILED: {outcome.error}" if outcome.error else f"score {_number(outcome.score, '.4g')}"
        mention(f"{len(found)}/{len(trials)} {trial.directory}: {ended}")
    said = document({trial: found[trial] for trial in trials})
    write_text(arguments.out / RESULT, as_json(said) + "\n")
    show(as_json(said) if arguments.json else f"{table(said)}\n{arguments.out / RESULT}")
    return EXIT_CHECK_FAILED if any(outcome.error for outcome in found.values()) else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
