"""The configuration of a training, as it is written beside its results and read back.

A preset is such a configuration with a name; the command line changes its seed and its number of steps.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, TypeVar, get_args, get_type_hints

from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import UsageError
from emb_train.envs.conditions import BENCH_CONDITIONS, Conditions, Randomisation
from emb_train.ppo.ppo import LARGEST, PpoConfig
from emb_train.rewards import REWARDS, Reward

SCHEMA = 1
T = TypeVar("T")


@dataclass(frozen=True)
class Configuration:
    """Everything that determines a training, apart from the bench."""

    preset: str  # Name of the preset that it began with
    summary: str  # One line on what is learned
    ranges: str  # Set of the bench that brakes are drawn from, uniformly (thesis 4.7.2)
    parameters: tuple[str, ...]  # Parameters whose Fisher information is collected, in the order of ``PARAMETER_NAMES``
    reward: Reward  # Reward of a step
    ppo: PpoConfig  # The hyper-parameters
    seed: int = 0  # Seed of everything random
    plant: str = DEFAULT_PLANT  # Name of the bench's plant that the brakes are
    conditions: Conditions = BENCH_CONDITIONS
    """Shield or none, number of steps, the actor's observation, kind of information."""

    def __post_init__(self) -> None:
        """Refuse a seed that torch does not take.

        Raises:
            UsageError: the seed is out of its range.
        """
        if not 0 <= self.seed <= LARGEST:
            raise UsageError(f"seed: expected an integer from 0 to {LARGEST}, got {self.seed}")

    @property
    def observation_size(self) -> int:
        """Length of the actor's observation."""
        return self.conditions.observation_size(len(self.parameters))

    def to_json(self) -> str:
        """The configuration as readable JSON."""
        record: dict[str, Any] = {
            "schema": SCHEMA,
            "preset": self.preset,
            "summary": self.summary,
            "ranges": self.ranges,
            "parameters": self.parameters,
            "reward": {"name": type(self.reward).__name__, **vars(self.reward)},
            "ppo": asdict(self.ppo),
            "seed": self.seed,
            "plant": self.plant,
            "conditions": asdict(self.conditions),
        }
        return json.dumps(record, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Configuration:
        """Read back what :meth:`to_json` wrote.

        Raises:
            UsageError: it is something else; the message names the key.
        """
        try:
            record = json.loads(text)
        except (ValueError, RecursionError) as err:
            raise UsageError(f"not valid JSON: {err}") from err
        if not isinstance(record, dict) or record.pop("schema", None) != SCHEMA:
            raise UsageError(f"expected a configuration with schema {SCHEMA}")
        return cls.from_record(record)

    @classmethod
    def from_record(cls, record: Mapping[str, Any], defaults: bool = False) -> Configuration:
        """Build a configuration from tables of values.

        Args:
            record: a value for each field; ``reward`` has its ``name`` beside its parameters.
            defaults: True if a missing value takes its default, instead of being refused.

        Raises:
            UsageError: a key is unknown or missing, or a value is of another type or impossible; the message names it.
        """
        reward = record.get("reward")
        if not isinstance(reward, dict) or reward.get("name") not in list(REWARDS):
            raise UsageError(f"reward: expected a name of {', '.join(REWARDS)}")
        kind = REWARDS[reward["name"]]
        conditions = _table(record, "conditions")
        varied = _build(
            Randomisation, _table(conditions, "randomised", "conditions."), defaults, "conditions.randomised."
        )
        built = {
            "reward": _build(kind, {k: v for k, v in reward.items() if k != "name"}, defaults, "reward."),
            "ppo": _build(PpoConfig, _table(record, "ppo"), defaults, "ppo."),
            "conditions": _build(Conditions, {**conditions, "randomised": varied}, defaults, "conditions."),
        }
        return _build(cls, {**record, **built}, defaults)


def _table(record: Mapping[str, Any], name: str, place: str = "") -> dict[str, Any]:
    if not isinstance(table := record.get(name, {}), dict):
        raise UsageError(f"{place}{name}: expected a table")
    return table


def _build(kind: type[T], record: Mapping[str, Any], defaults: bool, place: str = "") -> T:
    """A dataclass from a table with exactly its fields, of its types; with ``defaults``, some may be left out."""
    optional = {f.name: f.default is not MISSING for f in fields(kind)}  # type: ignore[arg-type]  # a dataclass
    for name in record:
        if name not in optional:
            raise UsageError(f"{place}{name}: unknown key")
    hints = get_type_hints(kind)
    values = {}
    for name in optional:
        if name in record:
            values[name] = _typed(place + name, record[name], hints[name])
        elif not (defaults and optional[name]):
            raise UsageError(
                f"{place}{name}: missing: expected {getattr(hints[name], '__name__', hints[name])}; add it"
            )
    return kind(**values)


def _typed(key: str, value: object, hint: object) -> object:
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if abs(value) <= sys.float_info.max:  # also compares an integer that no float holds; false for NaN
            return float(value)
        raise UsageError(f"{key}: expected a finite number")
    if hint in (int, str, bool) and type(value) is hint:
        return value
    if hint == tuple[int, ...] and isinstance(value, list) and all(type(v) is int for v in value):
        return tuple(value)
    if hint == tuple[str, ...] and isinstance(value, list) and all(type(v) is str for v in value):
        return tuple(value)
    if hint in (tuple[int, int], tuple[float, float]) and isinstance(value, list | tuple) and len(value) == 2:
        return tuple(_typed(key, v, get_args(hint)[0]) for v in value)
    if hint in (Reward, PpoConfig, Conditions, Randomisation):
        return value  # built by the caller
    raise UsageError(f"{key}: expected {getattr(hint, '__name__', hint)}, got {value!r}")
