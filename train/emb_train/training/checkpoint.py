"""The directory of a training: its files, each replaced in one move, so that none is ever half written.

* ``config.json``: the effective configuration.
* ``bench.toml``: the bench as it was read.
* ``checkpoint.safetensors``: both networks and Adam's state after the last whole iteration; replaced in one move.
* ``best.safetensors``: the same of the iteration that did best on brakes that no training draws.
* ``metrics.jsonl``: a line for each iteration.
* ``result.json``: the table of a finished training.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.config.plants import THESIS_PLANT
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
SCHEMA = 2  # Version of the metadata; 1 did not name the configuration and the bench


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
        text = read_text(path, MAX_CONFIG_BYTES)
    except (OSError, UnicodeDecodeError) as err:
        raise UsageError(f"{directory}: not the directory of a training: cannot read {CONFIG}") from err
    try:
        config = Configuration.from_json(text)
    except UsageError as err:
        raise UsageError(f"{path}: {err}") from err
    return config, load_bench(directory / BENCH)


@dataclass(frozen=True)
class Progress:
    """Iterations done, and the number of steps planned at each of them, which the learning rate depends on."""

    iteration: int  # Iterations done
    schedule: tuple[tuple[int, int], ...]
    """(iteration, steps): from which iteration on how many steps were planned. More than one if a resume changed it."""
    early: int = 0  # The last iterations in a row in which every experiment ended early
    score: float | None = None  # Mean return on the brakes of the evaluation, if it was evaluated after this iteration

    def towards(self, steps: int) -> Progress:
        """Returns this progress with another number of steps planned from here on."""
        if steps == self.schedule[-1][1]:
            return self
        earlier = tuple(entry for entry in self.schedule if entry[0] < self.iteration)
        if earlier and earlier[-1][1] == steps:
            return replace(self, schedule=earlier)
        return replace(self, schedule=(*earlier, (self.iteration, steps)))


def save_checkpoint(
    directory: Path,
    config: Configuration,
    bench: Bench,
    progress: Progress,
    actor: nn.Module,
    critic: nn.Module,
    *optimisers: torch.optim.Optimizer,
    name: str = CHECKPOINT,
) -> None:
    """Replace the checkpoint of this name in one move.

    Raises:
        UsageError: it cannot be written.
    """
    tensors = {f"actor.{k}": v for k, v in actor.state_dict().items()}
    tensors |= {f"critic.{k}": v for k, v in critic.state_dict().items()}
    for index, state in enumerate(state for o in optimisers for state in o.state_dict()["state"].values()):
        tensors |= {f"adam.{index}.{k}": v for k, v in state.items()}
    path = directory / name
    part = path.with_name(path.name + ".part")
    record = {"schema": SCHEMA, **asdict(progress), **_origin(config, bench)}
    # One entry: safetensors writes several in random order, and equal trainings should be equal files.
    metadata = {METADATA: json.dumps(record)}
    try:
        # As bytes: a file that safetensors writes by itself can be read by its owner alone, whatever the umask.
        part.write_bytes(save({k: v.cpu().contiguous() for k, v in tensors.items()}, metadata))
        part.replace(path)
    except (OSError, SafetensorError) as err:
        raise UsageError(f"{path}: cannot write the checkpoint: {err}") from err


def load_checkpoint(
    directory: Path,
    config: Configuration,
    bench: Bench,
    actor: nn.Module,
    critic: nn.Module | None = None,
    optimisers: Sequence[torch.optim.Optimizer] = (),
    name: str = CHECKPOINT,
) -> Progress:
    """Fill networks and optimisers with the checkpoint's state.

    Args:
        directory: of the training.
        config: of the training; its number of steps may differ from the checkpoint's.
        bench: of the training.
        actor: of the configured shape.
        critic: the same; left out for export.
        optimisers: of both networks, as they were saved; left out for export.
        name: of the checkpoint.

    Raises:
        UsageError: there is no checkpoint, it is damaged, or it is of another network, configuration or bench.
    """
    path = directory / name
    try:
        with open_regular(path) as opened, safe_open(_name_of(opened), framework="pt") as file:
            metadata = json.loads((file.metadata() or {})[METADATA])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  # the file is no dict
        progress = _progress(metadata, config, bench)
        for key, tensor in tensors.items():
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{key} is not finite")
        actor.load_state_dict(_part(tensors, "actor."))
        if critic is not None:
            critic.load_state_dict(_part(tensors, "critic."))
        if optimisers:
            _load_adam(optimisers, _part(tensors, "adam."), progress.iteration)
    except (OSError, SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as err:
        reason = str(err).split("\n")[0]
        raise UsageError(f"{path}: no usable checkpoint of this training: {reason}") from err
    return progress


def _origin(config: Configuration, bench: Bench) -> dict[str, str]:
    """Digests that tie a checkpoint to the two files beside it."""
    digest = bench.contract_hash
    if config.plant != THESIS_PLANT:  # what its name means is in the bench file, but not in the contract
        digest = hashlib.sha256(f"{digest} {bench.plant(config.plant)}".encode()).hexdigest()
    return {"config": config.identity, "bench": digest}


def _progress(metadata: Mapping[str, Any], config: Configuration, bench: Bench) -> Progress:
    """The checked metadata of a checkpoint; what is wrong with it is a ValueError, KeyError or TypeError."""
    if metadata["schema"] != SCHEMA:
        raise ValueError(
            f"expected schema {SCHEMA}, got {metadata['schema']!r}; the one before did not say which bench and "
            "configuration it belongs to: train again"
        )
    for name, digest in _origin(config, bench).items():
        if metadata[name] != digest:
            changed = CONFIG if name == "config" else BENCH
            raise ValueError(f"{changed} is not the one that it was trained with: restore it, or train anew")
    iteration = metadata["iteration"]
    schedule = tuple((since, steps) for since, steps in metadata["schedule"])
    numbers = [iteration, *(number for entry in schedule for number in entry)]
    if not schedule or not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError(f"expected counts in iteration and schedule, got {iteration!r} and {metadata['schedule']!r}")
    if iteration > config.ppo.iterations_for(schedule[-1][1]):
        raise ValueError(f"iteration {iteration} is beyond the {schedule[-1][1]} steps that were planned")
    return Progress(iteration, schedule, metadata.get("early", 0), metadata.get("score"))


def _part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _load_adam(optimisers: Sequence[torch.optim.Optimizer], tensors: Mapping[str, Tensor], iteration: int) -> None:
    """Fill Adam, which itself would take any state: none before the first iteration, then one for each parameter."""
    parameters = [p for o in optimisers for group in o.param_groups for p in group["params"]]
    expected: dict[str, torch.Size] = {}
    if iteration > 0:
        for index, parameter in enumerate(parameters):
            shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
            expected |= {f"{index}.{name}": shape for name, shape in shapes.items()}
    for key in sorted(expected.keys() | tensors.keys()):
        shape = tuple(tensors[key].shape) if key in tensors else None
        wanted = tuple(expected[key]) if key in expected else None
        if shape != wanted:
            raise ValueError(f"adam.{key}: expected shape {wanted}, got {shape}")
    first = 0
    for optimiser in optimisers:
        count = sum(len(group["params"]) for group in optimiser.param_groups)
        state = {
            number: {name: tensors[f"{first + number}.{name}"] for name in ("step", "exp_avg", "exp_avg_sq")}
            for number in (range(count) if iteration > 0 else ())
        }
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        first += count


def _name_of(opened: BinaryIO) -> str:
    """A name under which a file that is open can be opened again, whatever became of its own."""
    return f"/proc/self/fd/{opened.fileno()}" if sys.platform == "linux" else opened.name


def best_score(directory: Path) -> float | None:
    """Score of the best checkpoint so far; none if there is none, or it cannot be read.

    One that cannot be read is replaced by the next evaluation's.
    """
    try:
        with open_regular(directory / BEST) as opened, safe_open(_name_of(opened), framework="pt") as file:
            score = json.loads((file.metadata() or {})[METADATA])["score"]
    except (OSError, SafetensorError, KeyError, ValueError, TypeError):
        return None
    return float(score) if isinstance(score, float) else None


def untrained_actor(config: Configuration, bench: Bench) -> Actor:
    """The actor that a training begins with."""
    ppo = config.ppo
    start = (ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    return Actor(bench, *start, config.observation_size)


def load_actor(directory: Path, name: str = CHECKPOINT) -> tuple[Configuration, Bench, Actor, Progress]:
    """Configuration, bench, trained actor and progress of a training; ``name`` is :data:`BEST` for its best iteration.

    Raises:
        UsageError: see :func:`open_directory` and :func:`load_checkpoint`.
    """
    config, bench = open_directory(directory)
    actor = untrained_actor(config, bench)
    return config, bench, actor, load_checkpoint(directory, config, bench, actor, name=name)


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
