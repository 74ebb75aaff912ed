"""The directory of a training: what is in it, and how it gets there without ever being half written.

* ``config.json``: the effective configuration.
* ``bench.toml``: the bench as it was read.
* ``checkpoint.safetensors``: both networks and Adam's state after the last whole iteration; replaced in one move.
* ``metrics.jsonl``: a line for each iteration.
* ``result.json``: the table of a finished training.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from emb_runtime.bench import Bench, load_bench
from emb_runtime.errors import UsageError
from emb_train.configuration import Configuration
from emb_train.networks import Actor

CONFIG = "config.json"
BENCH = "bench.toml"
CHECKPOINT = "checkpoint.safetensors"
METRICS = "metrics.jsonl"
RESULT = "result.json"

METADATA = "training"
SCHEMA = 1


def write_text(path: Path, text: str) -> None:
    """Write a file in one move: whoever reads it sees the old one or the new one.

    Raises:
        UsageError: it cannot be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as err:
        raise UsageError(f"{path}: cannot write: {err.strerror}") from err


def begin_directory(directory: Path, config: Configuration, bench: Bench) -> None:
    """Make a new training's directory.

    Raises:
        UsageError: it holds something already, or cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        taken = any(directory.iterdir())
    except OSError as err:
        raise UsageError(f"{directory}: cannot use this directory: {err.strerror}") from err
    if taken:
        what = "a training" if (directory / CONFIG).exists() else "other files"
        raise UsageError(f"{directory}: holds {what} already: go on with --resume {directory}, or choose another")
    write_text(directory / BENCH, bench.text)
    write_text(directory / CONFIG, config.to_json())


def open_directory(directory: Path) -> tuple[Configuration, Bench]:
    """Configuration and bench of an existing training.

    Raises:
        UsageError: it is not a training's directory, or a file in it is damaged.
    """
    path = directory / CONFIG
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as err:
        raise UsageError(f"{directory}: not the directory of a training: cannot read {CONFIG}") from err
    try:
        config = Configuration.from_json(text)
    except UsageError as err:
        raise UsageError(f"{path}: {err}") from err
    return config, load_bench(directory / BENCH)


def save_checkpoint(
    directory: Path, actor: nn.Module, critic: nn.Module, optimiser: torch.optim.Optimizer, iteration: int
) -> None:
    """Replace the checkpoint in one move.

    Raises:
        UsageError: it cannot be written.
    """
    tensors = {f"actor.{k}": v for k, v in actor.state_dict().items()}
    tensors |= {f"critic.{k}": v for k, v in critic.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{k}": v for k, v in state.items()}
    path = directory / CHECKPOINT
    part = path.with_name(path.name + ".part")
    # One entry: safetensors writes several in random order, and equal trainings should be equal files.
    metadata = {METADATA: json.dumps({"schema": SCHEMA, "iteration": iteration})}
    try:
        save_file({k: v.contiguous() for k, v in tensors.items()}, part, metadata)
        part.replace(path)
    except (OSError, SafetensorError) as err:
        raise UsageError(f"{path}: cannot write the checkpoint: {err}") from err


def load_checkpoint(
    directory: Path, actor: nn.Module, critic: nn.Module | None = None, optimiser: torch.optim.Optimizer | None = None
) -> int:
    """Fill networks and optimiser with the checkpoint's state.

    Args:
        directory: of the training.
        actor: of the configured shape.
        critic: the same; left out for export.
        optimiser: of both networks, in the order in which they were given to it; left out for export.

    Returns:
        Iterations done.

    Raises:
        UsageError: there is no checkpoint, or it is damaged or another network's.
    """
    path = directory / CHECKPOINT
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {})[METADATA])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  # the file is no dict
        if metadata["schema"] != SCHEMA:
            raise UsageError(f"{path}: expected schema {SCHEMA}, got {metadata['schema']}")
        actor.load_state_dict(_part(tensors, "actor."))
        if critic is not None:
            critic.load_state_dict(_part(tensors, "critic."))
        if optimiser is not None:
            _load_adam(optimiser, _part(tensors, "adam."))
        return int(metadata["iteration"])
    except (OSError, SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as err:
        reason = str(err).split("\n")[0]
        raise UsageError(f"{path}: no usable checkpoint of this training: {reason}") from err


def _part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _load_adam(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".")
        state.setdefault(int(index), {})[name] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def load_actor(directory: Path) -> tuple[Configuration, Bench, Actor, int]:
    """Configuration, bench, trained actor and number of environment steps of a training.

    Raises:
        UsageError: see :func:`open_directory` and :func:`load_checkpoint`.
    """
    config, bench = open_directory(directory)
    actor = Actor(bench, config.ppo.hidden, config.ppo.initial_mean, config.ppo.initial_deviation)
    iteration = load_checkpoint(directory, actor)
    return config, bench, actor, iteration * config.ppo.batch


def append_metrics(directory: Path, record: Mapping[str, Any]) -> None:
    """Add a line to ``metrics.jsonl``; what is not finite becomes null, for JSON has no such numbers.

    Raises:
        UsageError: it cannot be written.
    """
    clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
    path = directory / METRICS
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(clean, allow_nan=False) + "\n")
    except OSError as err:
        raise UsageError(f"{path}: cannot write: {err.strerror}") from err


def trim_metrics(directory: Path, iteration: int) -> None:
    """Drop the lines of iterations that the checkpoint does not have, and a line that was cut."""
    path = directory / METRICS
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            if json.loads(line)["iteration"] <= iteration:
                kept.append(line)
        except (ValueError, KeyError, TypeError):
            break
    write_text(path, "".join(line + "\n" for line in kept))
