"""Actors to evaluate: a training's network, an exported file, or both; and the references beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from emb_bench.excitation.reference import ACTOR, COMPARED, parse_excitation
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges, load_bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.policy.trial import admit_policy
from emb_train import CHECKPOINT
from emb_train.envs.conditions import EVERYTHING, randomisation_texts
from emb_train.envs.excitations import Excitation, Network, OnnxFile, StatefulNetwork, reference_excitation
from emb_train.names import reference_names
from emb_train.ppo.networks import DeployedActor
from emb_train.structured.actor import actor_of
from emb_train.structured.stored import stored
from emb_train.training.checkpoint import BEST, chosen_checkpoint, load_actor

EXPORTED = "actor.onnx"  # Default name of the file that ``emb-export`` writes for a training

Make = Callable[[], Excitation]


@dataclass(frozen=True)
class Subject:
    """An actor, in one or two forms, with what it was trained for."""

    name: str  # Name as it was given
    bench: Bench
    ranges: str  # Set of the bench that it was trained on; empty if none of the bench's sets is that
    parameters: tuple[str, ...]  # Parameters that it was trained for
    network: Make | None  # The network of a training
    file: Make | None  # The exported file
    shield: str = ""  # Set of the bench that the shield covered when it learned; empty for the one that the bench names
    origin: str = ""  # Checkpoint of the training, in words; empty if it is not from one


def open_subject(given: str, bench_file: Path | None, last: bool = False) -> Subject:
    """Opens a training, a checkpoint, an ONNX file or a structured actor.

    Args:
        given: directory of a training, one of its checkpoints, an ONNX file, ``actor`` for the shipped one, or the
            reference of a structured actor: its name, or a ``.json`` file.
        bench_file: bench of what has none of its own; the shipped one without.
        last: of a training's directory, take the last checkpoint although there is a best one.

    Raises:
        UsageError: there is nothing of that kind, or it sees what no bench measures, or is damaged.
        PolicyRefusedError: the file is damaged or does not fit the bench.
        BenchFileError: the bench file is not valid.
    """
    path = Path(given)
    if given == ACTOR or path.suffix == ".onnx":
        return _file(given, shipped_actor_path() if given == ACTOR else path, load_bench(bench_file))
    torch.set_num_threads(1)  # more would get into each other's way at this size, and change the last digits
    if path.suffix == ".json" or given in reference_names():
        return _structured(given, load_bench(bench_file))
    if not path.exists():
        raise UsageError(
            f"{given}: no such file or directory, and no reference of that name; there are: {ACTOR}, "
            f"{', '.join(reference_names())}"
        )
    if bench_file is not None:
        raise UsageError(f"--bench: {given} is evaluated on the bench that it was trained on; leave it out")
    is_checkpoint = path.name in (CHECKPOINT, BEST)
    directory = path.parent if is_checkpoint else path
    name = path.name if is_checkpoint else chosen_checkpoint(directory, last)
    config, bench, actor, progress = load_actor(directory, name)
    if config.conditions.observes == EVERYTHING:
        raise UsageError(f"{given}: sees the parameters and the information, which no bench measures: it cannot be run")
    limit, varied = bench.limits.current, randomisation_texts(config.conditions.randomised)
    learned = f"; it learned with {', '.join(varied)}" if varied else ""
    file = None if is_checkpoint else _beside(directory / EXPORTED, bench)
    return Subject(
        name=given,
        bench=bench,
        ranges=config.ranges,
        parameters=config.parameters,
        network=lambda: Network(DeployedActor(actor, limit)),
        file=file,
        shield=_own_shield(config.conditions.shield_ranges, bench),
        origin=f"{name}, iteration {progress.iteration} of {config.ppo.iterations}{learned}",
    )


def _own_shield(name: str, bench: Bench) -> str:
    """The set that a shield covers, unless it is the bench's own."""
    return "" if name == bench.shield.ranges else name


def _structured(given: str, bench: Bench) -> Subject:
    path = Path(given)
    kept = stored(given)
    task = kept.asked()
    actor = actor_of(kept, bench).eval()
    file = _beside(path.with_suffix(".onnx"), bench) if path.suffix == ".json" else None
    return Subject(
        name=given,
        bench=bench,
        ranges=task.ranges,
        parameters=task.parameters,
        network=lambda: StatefulNetwork(actor),
        file=file,
        shield=_own_shield(task.conditions.shield_ranges, bench),
        origin=""
        if task.shield == "worst case"
        else f"a reference for the shield '{task.shield}', behind the worst case",
    )


def _beside(path: Path, bench: Bench) -> Make | None:
    """The exported file, where there is one."""
    return _file(str(path), path, bench).file if path.exists() else None


def _file(name: str, path: Path, bench: Bench) -> Subject:
    try:
        policy = load_policy(path, bench) if path == shipped_actor_path() else admit_policy(path, bench)
    except PolicyRefusedError as err:
        raise PolicyRefusedError(f"{path}: {err}") from err
    contract = policy.contract
    sets = [s.name for s in bench.ranges.values() if trained_on(contract.ranges, s)]
    varied = tuple(n for n in PARAMETER_NAMES if contract.ranges[n][0] < contract.ranges[n][1])
    return Subject(
        name, bench, sets[0] if sets else "", varied, None, lambda: OnnxFile(policy.data, contract.initial_state)
    )


def trained_on(ranges: object, drawn: Ranges) -> bool:
    """Returns True if a contract's ranges are those of a set."""
    return ranges == {n: (getattr(drawn.low, n), getattr(drawn.high, n)) for n in PARAMETER_NAMES}


def references(bench: Bench) -> dict[str, Excitation]:
    """Every reference excitation, some of them twice; constant current of either sign among them. By name."""
    limit = bench.limits.current
    names = [*COMPARED, *(f"step:amplitude={u:g}" for u in (limit, -limit))]
    return {name: reference_excitation(parse_excitation(name, bench)) for name in names}
