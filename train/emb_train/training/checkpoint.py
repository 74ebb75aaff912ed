"""The directory of a training: its files, each replaced in one move, so that none is ever half written.

* ``config.json``: the effective configuration.
* ``bench.toml``: the bench as it was read.
* ``checkpoint.safetensors``: the actor after the last whole iteration.
* ``best.safetensors``: the actor of the iteration that did best on brakes that no training draws.
* ``metrics.jsonl``: a line for each iteration.
* ``result.json``: the table of a finished training.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import open_regular, read_text
from emb_train import CHECKPOINT
from emb_train.ppo.networks import Actor
from emb_train.training.configuration import Configuration

BEST = "best.safetensors"
CONFIG = "config.json"
BENCH = "bench.toml"
METRICS = "metrics.jsonl"
RESULT = "result.json"

MAX_CONFIG_BYTES = 1 << 20
METADATA = "training"


@dataclass(frozen=True)
class Progress:
    """Iterations that a checkpoint has, and its score."""

    iteration: int  # Iterations done
    score: float | None = None  # Mean return on the brakes of the validation, if it was judged after this iteration


def write_text(path: Path, text: str) -> None:
    """Write a file in one move: whoever reads it sees the old one or the new one.

    Raises:
        UsageError: it cannot be written.
    """
    _write(path, text.encode("utf-8"))


def _write(path: Path, data: bytes) -> None:
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(data)
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
        raise UsageError(f"{directory}: holds {what} already: choose another")
    write_text(directory / BENCH, bench.text)
    write_text(directory / CONFIG, config.to_json())


def open_directory(directory: Path) -> tuple[Configuration, Bench]:
    """Configuration and bench of an existing training.

    Raises:
        UsageError: it is not a training's directory, or a file in it is damaged.
    """
    path = directory / CONFIG
    try:
        text = read_text(path, MAX_CONFIG_BYTES)
    except (OSError, UnicodeDecodeError) as err:
        raise UsageError(f"{directory}: not the directory of a training: cannot read {CONFIG}") from err
    try:
        config = Configuration.from_json(text)
    except UsageError as err:
        raise UsageError(f"{path}: {err}") from err
    return config, load_bench(directory / BENCH)


def save_checkpoint(directory: Path, progress: Progress, actor: Actor, name: str = CHECKPOINT) -> None:
    """Replace the checkpoint of this name in one move.

    Raises:
        UsageError: it cannot be written.
    """
    tensors = {k: v.contiguous() for k, v in actor.state_dict().items()}
    # As bytes: a file that safetensors writes by itself can be read by its owner alone, whatever the umask.
    record = {**asdict(progress), "origin": _origin(directory)}
    _write(directory / name, save(tensors, {METADATA: json.dumps(record)}))


def _origin(directory: Path) -> str:
    """Digest that ties a checkpoint to the two files beside it."""
    return hashlib.sha256((directory / CONFIG).read_bytes() + (directory / BENCH).read_bytes()).hexdigest()


def untrained_actor(config: Configuration, bench: Bench) -> Actor:
    """The actor that a training begins with."""
    ppo = config.ppo
    start = (ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    return Actor(bench, *start, config.observation_size)


def load_actor(directory: Path, name: str = CHECKPOINT) -> tuple[Configuration, Bench, Actor, Progress]:
    """Configuration, bench, trained actor and progress of a training; ``name`` is :data:`BEST` for its best iteration.

    Raises:
        UsageError: see :func:`open_directory`; or there is no checkpoint, or it is damaged or of another training.
    """
    config, bench = open_directory(directory)
    actor, path = untrained_actor(config, bench), directory / name
    try:
        with open_regular(path) as opened, safe_open(_name_of(opened), framework="pt") as file:
            record = json.loads((file.metadata() or {})[METADATA])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  # the file is no dict
        if record.pop("origin") != _origin(directory):
            raise ValueError(f"{CONFIG} or {BENCH} is not the one that it was trained with")
        progress = Progress(**record)
        for key, tensor in tensors.items():
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{key} is not finite")
        actor.load_state_dict(tensors)
    except (OSError, SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as err:
        reason = str(err).split("\n")[0]
        raise UsageError(f"{path}: no usable checkpoint of this training: {reason}") from err
    return config, bench, actor, progress


def _name_of(opened: BinaryIO) -> str:
    """A name under which a file that is open can be opened again, whatever became of its own."""
    return f"/proc/self/fd/{opened.fileno()}" if sys.platform == "linux" else opened.name


def chosen_checkpoint(directory: Path, last: bool = False) -> str:
    """Name of the checkpoint that is taken from a training: the best one where there is one, or else the last."""
    return BEST if not last and (directory / BEST).exists() else CHECKPOINT


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
