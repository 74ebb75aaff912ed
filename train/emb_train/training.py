"""One training by PPO: its configuration, and the folder of its results.

* ``training.json``: the configuration.
* ``bench.toml``: the bench as it was read.
* ``actor.safetensors``: the actor of the iteration that did best on brakes that no training draws.
* ``metrics.jsonl``: a line for each iteration.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.output import make_empty_folder, replacing
from emb_runtime.config.typed import read
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_bytes
from emb_runtime.system.terminal import as_json
from emb_train.closed_loop import BENCH_CONDITIONS, Conditions, require_covered, require_possible
from emb_train.env import EmbExcitationVectorEnv
from emb_train.ppo import Actor, Metrics, Ppo, collect, train
from emb_train.presets import preset_record
from emb_train.rewards import REWARDS

ACTOR, CONFIGURATION, BENCH, METRICS = "actor.safetensors", "training.json", "bench.toml", "metrics.jsonl"
LARGEST_FILE = 1 << 26  # [bytes]
VALIDATION_BRAKES = 64  # In a validation
VALIDATIONS = 10  # Validations in a training, evenly spread
VALIDATION_STREAM = 0x6578616D  # Spawn key of the seeds of the validation; those of a training's iterations have none


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that determines a training, apart from the bench."""

    preset: str  # Name of the preset that it began with
    summary: str  # One line on what is learned
    ranges: str  # Set of the bench that brakes are drawn from, uniformly (thesis 4.7.2)
    parameters: tuple[str, ...]  # Parameters whose Fisher information is collected, in the order of ``PARAMETER_NAMES``
    reward: str  # Name of a reward of :data:`emb_train.rewards.REWARDS`
    scale: Annotated[float, msgspec.Meta(gt=0.0)]  # Its factor: the thesis normalises, a fixed one needs no state
    ppo: Ppo  # The hyper-parameters
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0  # Seed of everything random
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    conditions: Conditions = BENCH_CONDITIONS

    def environment(self, bench: Bench, count: int) -> EmbExcitationVectorEnv:
        """N experiments under this training's conditions.

        Raises:
            UsageError: the reward is not defined for the parameters, or the bench is none for this training.
            BenchFileError: the bench lacks the ranges or the plant.
        """
        reward = REWARDS[self.reward]
        where = (bench, self.ranges, self.parameters)
        return EmbExcitationVectorEnv(count, *where, reward, self.scale, self.plant, self.conditions)

    def untrained_actor(self, bench: Bench) -> Actor:
        """The actor that the training begins with."""
        ppo, inputs = self.ppo, self.conditions.observation_size(len(self.parameters))
        return Actor(bench, ppo.hidden, ppo.initial_mean, ppo.initial_deviation, inputs)


class Trained(NamedTuple):
    """A training's result."""

    training: Training
    bench: Bench
    actor: Actor
    iteration: int  # Iteration after which it was the best
    score: float  # Mean return of an experiment with it on the brakes of the validation


def training_from(record: object, source: str) -> Training:
    """A configuration from a table of values.

    Raises:
        UsageError: a key is unknown or missing, or a value is of another type or impossible.
    """
    training = read(Training, record, source, UsageError)
    if training.reward not in REWARDS:
        raise UsageError(f"{source}: reward: expected one of {', '.join(REWARDS)}, got '{training.reward}'")
    return training


def load_preset(name: str, **changes: Any) -> Training:
    """The configuration of a preset, with some values changed; ``total_steps`` is one of them.

    Raises:
        UsageError: there is no such preset, or a value is not possible.
    """
    record = preset_record(name)
    if "total_steps" in changes:
        record["ppo"]["total_steps"] = changes.pop("total_steps")
    return training_from({**record, **changes}, name)


def require_trainable(training: Training, bench: Bench) -> None:
    """Check that a bench is one for a training.

    Raises:
        UsageError: the shield does not cover its brakes, the plant has a delay beside the drawn one, or an iteration
            would not see the end of its experiments.
        BenchFileError: the bench lacks the ranges or the plant.
    """
    require_possible(bench.plant(training.plant), training.conditions)
    require_covered(bench, bench.range_set(training.ranges), training.conditions)
    rollout, horizon = training.ppo.rollout, training.conditions.applied(bench).timing.horizon
    if rollout < horizon or (training.conditions.shielded and rollout % horizon):  # else experiments end at any step
        raise UsageError(
            f"expected a rollout of whole experiments, got {rollout} steps for the bench's horizon of {horizon}: "
            "use a bench file whose horizon divides it"
        )


def run_training(
    folder: Path, training: Training, bench: Bench, show: Callable[[Metrics], object] = lambda metrics: None
) -> None:
    """Train in a folder that has begun. It has the best actor so far at any time: a training can be interrupted.

    Args:
        folder: of the results.
        training: what is trained.
        bench: limits, noise, timing, shield.
        show: called after each iteration.

    Raises:
        EmbError: see :func:`emb_train.ppo.train`; or the folder is not writable.
    """
    torch.manual_seed(training.seed)
    env, actor = training.environment(bench, training.ppo.envs), training.untrained_actor(bench)
    validation, best = Validation(training, bench), -math.inf
    every, last = max(1, training.ppo.iterations // VALIDATIONS), training.ppo.iterations
    for metrics in train(env, actor, training.ppo, training.seed):
        score = None
        if metrics.iteration in (1, last) or metrics.iteration % every == 0:
            score = validation.score(actor)
            if score > best:
                save_actor(folder, actor, metrics.iteration, score)
                best = score
        with (folder / METRICS).open("a", encoding="utf-8") as file:
            file.write(as_json(asdict(metrics) | {"score": score}) + "\n")
        show(metrics)


class Validation:
    """Scores an actor on brakes that no training draws; they and their noise are drawn once."""

    def __init__(self, training: Training, bench: Bench) -> None:
        """Prepare for actors of this training."""
        self._env = training.environment(bench, VALIDATION_BRAKES)
        stream = np.random.SeedSequence(training.seed, spawn_key=(VALIDATION_STREAM,))
        self._seeds = stream.generate_state(VALIDATION_BRAKES, np.uint64).tolist()

    def score(self, actor: Actor) -> float:
        """Mean return of an experiment without exploration, in the training's own reward."""
        steps = self._env.batch.setup.rules.horizon
        seen = collect(self._env, actor, steps, 0.0, self._seeds, torch.Generator(), exploration=0.0)
        over = seen.terminals.cumsum(0) - seen.terminals
        return float(torch.where(over > 0.0, 0.0, seen.rewards).sum()) / VALIDATION_BRAKES


def begin_training(folder: Path, training: Training, bench: Bench) -> None:
    """Check that a training can be, and make its folder.

    Raises:
        EmbError: see :func:`require_trainable`; or the folder holds something already, or cannot be written.
    """
    require_trainable(training, bench)
    make_empty_folder(folder)
    try:
        (folder / BENCH).write_text(bench.text, encoding="utf-8")
        (folder / CONFIGURATION).write_bytes(msgspec.json.format(msgspec.json.encode(training), indent=2) + b"\n")
    except OSError as err:
        raise UsageError(f"{folder}: cannot write: {err.strerror}") from err


def save_actor(folder: Path, actor: Actor, iteration: int, score: float) -> None:
    """Replace the actor of a training in one move.

    Raises:
        UsageError: it cannot be written.
    """
    tensors = {name: tensor.contiguous() for name, tensor in actor.state_dict().items()}
    record = json.dumps({"iteration": iteration, "score": score, "origin": _origin(folder)})
    with replacing(folder / ACTOR) as beside:  # as bytes: a file that safetensors writes can be read by its owner alone
        beside.write_bytes(save(tensors, {"training": record}))


def load_training(folder: Path) -> Trained:
    """Configuration, bench and actor of a training.

    Raises:
        UsageError: it is not a training's folder, or a file in it is damaged or of another training.
    """
    try:
        training = training_from(
            msgspec.json.decode(read_bytes(folder / CONFIGURATION, LARGEST_FILE)), f"{folder / CONFIGURATION}"
        )
    except (OSError, msgspec.DecodeError) as err:
        why = err.strerror if isinstance(err, OSError) else err
        raise UsageError(f"{folder}: not the folder of a training: cannot read {CONFIGURATION}: {why}") from err
    bench = load_bench(folder / BENCH)
    actor = training.untrained_actor(bench)
    try:
        data = read_bytes(folder / ACTOR, LARGEST_FILE)
        tensors = load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        record = json.loads(header["__metadata__"]["training"])
        if record["origin"] != _origin(folder):
            raise ValueError(f"{CONFIGURATION} or {BENCH} is not the one that it was trained with")
        if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
            raise ValueError("a weight is not finite")
        actor.load_state_dict(tensors)
        return Trained(training, bench, actor, int(record["iteration"]), float(record["score"]))
    except (OSError, SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as err:
        reason = str(err).split("\n")[0]
        raise UsageError(f"{folder / ACTOR}: no usable actor of this training: {reason}") from err


def _origin(folder: Path) -> str:
    """Digest that ties an actor to the two files beside it."""
    return hashlib.sha256((folder / CONFIGURATION).read_bytes() + (folder / BENCH).read_bytes()).hexdigest()
