"""One training by PPO: its configuration, and the folder of its results.

* ``actor.onnx``: the actor that did best on brakes that no training draws, as a policy.
* ``bench.toml``: the bench as it was read.
* ``plan.json``: the plan that an actor of speeds began with.
* ``training.json``, ``metrics.jsonl``: the configuration, and a line for each iteration, for people.

A training for speeds has a plan before: it searches a coarse one (:mod:`emb_train.plan`), lets the actor follow it
(:func:`emb_train.ppo.clone`), and improves that.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import torch

from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.estimate.expected import NUMBERS, IntervalCriterion
from emb_bench.figures import COLOURS, GREY, drawn
from emb_bench.output import make_empty_folder
from emb_bench.parallel import processes
from emb_runtime.config.schemas import write_schemas
from emb_runtime.config.typed import read
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_bytes
from emb_runtime.system.terminal import DOCUMENT_SCHEMA, json_document
from emb_train.closed_loop import BENCH_CONDITIONS, Conditions, Gain, Positive
from emb_train.env import EmbExcitationVectorEnv
from emb_train.plan import Compared, Found, PlanSearch, search, speeds_of
from emb_train.ppo import Actor, Metrics, Ppo, at_once, clone, collect, joined, train
from emb_train.presets import preset_record
from emb_train.rewards import (
    DEMANDS,
    PRECISION,
    REWARDS,
    AnyReward,
    Demands,
    ExpectedInterval,
    Precision,
    TimeToPrecision,
)

CONFIGURATION, BENCH, METRICS = "training.json", "bench.toml", "metrics.jsonl"
TIME = "time"  # Reward: until the estimates are precise
PLAN, CURVE, ONNX = "plan.json", "curve.png", "actor.onnx"
LARGEST_FILE = 1 << 26  # [bytes]
VALIDATION_BRAKES = 64  # In a validation
VALIDATIONS = 10  # Validations in a training, evenly spread
PLAN_STREAM = 0x6E756D73  # Spawn key of the plans
VALIDATION_STREAM = 0x6578616D  # Spawn key of the seeds of the validation; those of a training's iterations have none


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A plan as it is stored."""

    speeds: Annotated[tuple[Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)], ...], msgspec.Meta(min_length=1)]
    """Parts of the limit, one for each step."""
    ranges: str = ""  # Set of the bench that it was found for
    gain: Gain = BENCH_CONDITIONS.gain  # Of the speed loop
    schema: int = DOCUMENT_SCHEMA


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that determines a training, apart from the bench."""

    preset: str  # Name of the preset that it began with
    summary: str  # One line on what is learned
    ranges: str  # Set of the bench that brakes are drawn from, uniformly (thesis 4.7.2)
    parameters: tuple[str, ...]  # Parameters whose Fisher information is collected, in the order of ``PARAMETER_NAMES``
    reward: str  # One of :data:`emb_train.rewards.REWARDS`, a criterion of the expected interval, or ``time``
    scale: Positive  # Its factor: the thesis normalises, a fixed one needs no state
    ppo: Ppo  # The hyper-parameters
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0  # Seed of everything random
    plants: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)] = (DEFAULT_PLANT,)  # Of the bench, each alike
    conditions: Conditions = BENCH_CONDITIONS
    plan: PlanSearch | None = None  # What the actor begins with; None for a network that knows nothing
    demands: Demands = DEMANDS  # Of an experiment whose reward is a criterion of the expected interval
    precision: Precision = PRECISION  # At which a time ends

    @property
    def share(self) -> int:
        """Experiments side by side are a multiple of this: as many of each plant, in pairs if they come so."""
        return len(self.plants) * (2 if self.ppo.pairs else 1)

    def environments(self, bench: Bench, count: int, pool: Executor | None = None) -> list[EmbExcitationVectorEnv]:
        """Experiments under this training's conditions, as many with each plant; the ``pool`` has processes.

        Raises:
            UsageError: the reward is not defined for the parameters, or the bench is none for this training.
            BenchFileError: the bench lacks the ranges or a plant.
        """

        def reward() -> AnyReward:
            if self.reward == TIME:
                return TimeToPrecision(self.precision, pool)
            if self.reward in NUMBERS:
                return ExpectedInterval(IntervalCriterion(self.reward), self.demands, pool)
            return REWARDS[self.reward]

        where = (count, bench, self.ranges, self.parameters)
        return [EmbExcitationVectorEnv(*where, reward(), self.scale, p, self.conditions) for p in self.plants]

    def untrained_actor(self, bench: Bench) -> Actor:
        """The actor that the training begins with."""
        conditions = self.conditions
        inputs = conditions.observation_size(len(self.parameters))
        return Actor(bench, self.ppo, inputs, speed=conditions.acts == "speed")


Show = Callable[[Metrics | Found | None], object]


class Trained(NamedTuple):
    """The best actor of a training so far."""

    actor: Actor
    iteration: int  # After which it was the best
    score: float  # Mean return of an experiment with it on the brakes of the validation


def training_from(record: object, source: str) -> Training:
    """A configuration from a table of values.

    Raises:
        UsageError: a key is unknown or missing, or a value is of another type or impossible.
    """
    training = read(Training, record, source, UsageError)
    rewards = (*REWARDS, *NUMBERS, TIME)
    if training.reward not in rewards:
        raise UsageError(f"{source}: reward: expected one of {', '.join(rewards)}, got '{training.reward}'")
    if training.reward == TIME and not training.conditions.estimates:
        raise UsageError(f'{source}: reward: a time needs the conditions acts = "speed", observes = "estimate"')
    if (training.conditions.acts == "speed") != (training.conditions.observes == "estimate"):
        raise UsageError(f'{source}: conditions: expected acts = "speed" together with observes = "estimate"')
    if training.plan is not None and training.conditions.acts != "speed":
        raise UsageError(f"{source}: plan: expected none, for the actor's action is no speed")
    if training.ppo.noise_hold > training.ppo.rollout:
        raise UsageError(f"{source}: noise_hold: expected at most the rollout of {training.ppo.rollout} steps")
    if training.plan is not None and training.plan.starts > training.plan.brakes:
        raise UsageError(f"{source}: plan.starts: expected at most the plan.brakes of {training.plan.brakes}")
    if training.ppo.envs % training.share:
        raise UsageError(
            f"{source}: envs: expected a multiple of {training.share}, for as many of each plant, got "
            f"{training.ppo.envs}"
        )
    return training


def load_preset(name: str, **changes: Any) -> Training:
    """The configuration of a preset with some values changed.

    Those of ``ppo`` and ``conditions`` have their own names, those of the plan's search ``plan.`` before it, those of
    other tables likewise. Unless it is changed, the number of experiments is rounded up to as many for each plant.

    Raises:
        UsageError: there is no such preset, or a value is not possible.
    """
    record = preset_record(name)
    for key, value in changes.items():
        table, _, own = key.rpartition(".")
        table = table or next((of for of, kind in TABLES.items() if key in kind.__struct_fields__), "")
        (record.setdefault(table, {}) if table else record)[own] = value
    if "envs" not in changes:
        share = max(len(record["plants"]), 1) * (2 if record["ppo"].get("pairs") else 1)
        record["ppo"]["envs"] = -(-record["ppo"].get("envs", Ppo(total_steps=1).envs) // share) * share
    return training_from(record, name)


TABLES = {"ppo": Ppo, "conditions": Conditions}  # Their values have names of their own


def hyper_parameters(training: Training) -> dict[str, Any]:
    """The values of a training that have names of their own, by name."""
    tables = {
        "plan": training.plan,
        "demands": training.demands if training.reward in NUMBERS else None,
        "precision": training.precision if training.reward == TIME else None,
    }
    gain = {"gain": training.conditions.gain} if training.conditions.acts == "speed" else {}
    in_tables = {
        f"{table}.{name}": value
        for table, record in tables.items()
        if record is not None
        for name, value in msgspec.structs.asdict(record).items()
    }
    return {"scale": training.scale} | msgspec.structs.asdict(training.ppo) | gain | in_tables


def run_training(
    folder: Path, training: Training, bench: Bench, show: Show = lambda progress: None
) -> Iterator[Trained]:
    """Train, with progress in a folder that has begun.

    One that is interrupted while it searches or clones a plan first lets the actor follow the best plan so far.

    Args:
        folder: of the results.
        training: what is trained.
        bench: limits, noise, timing, shield.
        show: called after each step of the search for a plan, without one where the actor begins to follow it, and
            after each iteration.

    Yields:
        The actor, whenever it does better than before on the brakes of the validation.

    Raises:
        EmbError: see :func:`emb_train.ppo.train`; or the folder is not writable.
    """
    torch.manual_seed(training.seed)
    torch.set_num_threads(1)  # networks this small lose more by sharing out a product than they win
    shared = training.reward in (*NUMBERS, TIME)
    with processes() if shared else nullcontext() as pool:
        each = training.ppo.envs // len(training.plants)
        envs, actor = training.environments(bench, each, pool), training.untrained_actor(bench)
        stopped = False
        if training.plan is not None:
            stopped = follow_plan(folder, actor, training, training.plan, bench, pool, show)
        validation, best = Validation(training, bench, pool), -math.inf
        if training.plan is not None:
            best = validation.score(actor)
            write_progress(folder, {"iteration": 0, "steps": 0, "score": best})
            yield Trained(copy.deepcopy(actor), 0, best)
            if stopped:
                raise KeyboardInterrupt
        for metrics in train(envs, actor, training.ppo, training.seed):
            score = validation.score(actor) if validated(metrics.iteration, training.ppo.iterations) else None
            write_progress(folder, asdict(metrics) | {"score": score})
            show(metrics)
            if score is not None and score > best:
                best = score
                yield Trained(copy.deepcopy(actor), metrics.iteration, score)


def validated(iteration: int, iterations: int) -> bool:
    """True after the iterations of a training in which its actor is validated."""
    return iteration in (1, iterations) or iteration % max(1, iterations // VALIDATIONS) == 0


def write_progress(folder: Path, record: dict[str, Any]) -> None:
    """Write a line of a training's progress."""
    with (folder / METRICS).open("a", encoding="utf-8") as file:
        file.write(json_document(record) + "\n")


def follow_plan(
    folder: Path,
    actor: Actor,
    training: Training,
    options: PlanSearch,
    bench: Bench,
    pool: Executor | None,
    show: Show,
) -> bool:
    """Search a plan and let the actor follow it, in place; True if a Ctrl-C ended that, with the best plan so far.

    Raises:
        KeyboardInterrupt: there was no plan yet, or a second one came.
    """
    found: list[Found] = []

    def searched(one: Found) -> None:
        found[:] = [one]
        show(one)

    def follow() -> None:
        numbers = np.clip(found[0].numbers, -1.0, 1.0)
        speeds = speeds_of(numbers, training.ppo.rollout)
        plan = np.pad(speeds, (0, max(bench.timing.horizon - len(speeds), 0)), "edge").tolist()
        stored = Plan(tuple(plan), training.ranges, training.conditions.gain)
        (folder / PLAN).write_text(json_document(msgspec.to_builtins(stored)) + "\n", encoding="utf-8")
        show(None)
        clone(actor, plan, bench, training.ppo, torch.Generator().manual_seed(training.seed))

    hidden = training.demands.hidden if options.hidden is None else options.hidden
    searching = msgspec.structs.replace(training, demands=msgspec.structs.replace(training.demands, hidden=hidden))
    environments = searching.environments(bench, options.population * options.brakes, pool)
    compared = Compared(environments, training.ppo.rollout, training.seed)
    rng = np.random.default_rng(np.random.SeedSequence(training.seed, spawn_key=(PLAN_STREAM,)))
    try:
        search(compared, options, rng, show=searched)
        follow()
    except KeyboardInterrupt:
        if not found:
            raise
        follow()
        return True
    return False


class Validation:
    """Scores an actor on brakes that no training draws; they and their noise are drawn once."""

    def __init__(self, training: Training, bench: Bench, pool: Executor | None = None) -> None:
        """Prepare for actors of this training."""
        each = -(-VALIDATION_BRAKES // len(training.plants))
        self._envs = training.environments(bench, each, pool)
        stream = np.random.SeedSequence(training.seed, spawn_key=(VALIDATION_STREAM,))
        self._seeds = stream.generate_state(each, np.uint64).tolist()

    def score(self, actor: Actor) -> float:
        """Mean return of an experiment without exploration, in the reward of the training."""
        steps, count = self._envs[0].batch.bench.timing.horizon, len(self._seeds)
        each = len(self._envs)
        noise = [torch.zeros(steps, count, 1)] * each
        seen = joined(at_once(collect, self._envs, [actor] * each, noise, [self._seeds] * each))
        over = seen.terminals.cumsum(0) - seen.terminals
        return float(torch.where(over > 0.0, 0.0, seen.rewards).sum()) / seen.rewards.shape[1]


def load_plan(path: Path) -> Plan:
    """The plan that an actor began with.

    Raises:
        UsageError: the file cannot be read, or is something else.
    """
    try:
        return msgspec.json.decode(read_bytes(path, LARGEST_FILE), type=Plan)
    except OSError as err:
        raise UsageError(f"{path}: {err.strerror}") from err
    except msgspec.DecodeError as err:
        raise UsageError(f"{path}: expected the {PLAN} of emb-train ppo: {err}") from err


def begin_training(folder: Path, training: Training, bench: Bench) -> None:
    """Check that a bench is one for a training, and make its folder.

    Raises:
        UsageError: the shield does not cover its brakes, the plant has a delay beside the drawn one, or an iteration
            would not see the end of its experiments; or the folder holds something already, or cannot be written.
        BenchFileError: the bench lacks the ranges or the plant.
    """
    training.environments(bench, 1)
    rollout, horizon = training.ppo.rollout, training.conditions.applied(bench).timing.horizon
    timed = training.reward == TIME  # the steps after the estimates do not count
    if rollout > horizon and (training.plan is not None or timed):
        raise UsageError(f"rollout: expected at most the bench's horizon of {horizon} steps, got {rollout}")
    if not timed and (rollout < horizon or (training.conditions.shielded and rollout % horizon)):
        raise UsageError(  # else experiments end at any step
            f"expected a rollout of complete experiments, got {rollout} steps for the bench's horizon of {horizon}: "
            "use a bench file whose horizon divides it"
        )
    make_empty_folder(folder)
    try:
        (folder / BENCH).write_text(bench.text, encoding="utf-8")
        configuration = json_document(msgspec.to_builtins(training))
        (folder / CONFIGURATION).write_text(msgspec.json.format(configuration, indent=2) + "\n", encoding="utf-8")
        write_schemas(folder, "bench")
    except OSError as err:
        raise UsageError(f"{folder}: cannot write: {err.strerror}") from err


def draw_curve(folder: Path, path: Path) -> None:
    """Draw the learning curve of a training: mean return of an iteration, and the validations.

    Raises:
        UsageError: the results cannot be read, or the picture cannot be written.
    """
    try:
        records = [msgspec.json.decode(line) for line in (folder / METRICS).read_bytes().splitlines()]
    except (OSError, msgspec.DecodeError) as err:
        raise UsageError(f"{folder / METRICS}: cannot be read: {err}") from err
    steps = [1e-6 * record["steps"] for record in records]
    validated = [
        (at, record["score"]) for at, record in zip(steps, records, strict=True) if record["score"] is not None
    ]
    with drawn(path, 1, 1, "learning curve", (7.0, 4.0)) as axes:
        (plot,) = axes.flat
        returns = [record.get("mean_return", math.nan) for record in records]  # the plan's actor did not explore
        plot.plot(steps, returns, color=GREY, label="with exploration")
        plot.plot(*zip(*validated, strict=True), "o-", color=COLOURS[0], label="on brakes that no training draws")
        plot.set(xlabel="steps of the environment, million", ylabel="mean return of an experiment")
        plot.legend()
