"""Trainings that take a moment: a short experiment, tiny networks."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_train.play import Excitation
from emb_train.presets import preset_record
from emb_train.training import Training, training_from
from tests.benches import SENSOR_TEXT

HORIZON = 60
ENVS = 8
ITERATION = HORIZON * ENVS  # Environment steps in an iteration
PPO = {"envs": ENVS, "rollout": HORIZON, "minibatch": 160, "epochs": 2, "hidden": [8, 8], "initial_mean": 0.5}


SPEEDS = {"minibatch": 96, "clone_steps": 30}
PLAN = {"drawn": 8, "starts": 1, "steps": 2, "population": 4, "brakes": 1}


def tiny_record(name: str) -> dict[str, Any]:
    """The table of a preset with little to do: three iterations of eight experiments; of a training for speeds two."""
    record = preset_record(name)
    if "plan" not in record:
        return {**record, "ppo": {**PPO, "total_steps": 3 * ITERATION}}
    ppo = {**record["ppo"], **PPO, **SPEEDS, "initial_mean": 0.0, "total_steps": 2 * ITERATION}
    return {**record, "plants": ["exact", "stribeck"], "ppo": ppo, "plan": dict(PLAN)}


def tiny(**changes: Any) -> Training:
    """``single-viscous`` with little to do."""
    return training_from({**tiny_record("single-viscous"), **changes}, "tiny")


def make_tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every preset have little to do, in this process."""
    monkeypatch.setattr("emb_train.training.preset_record", tiny_record)
    monkeypatch.setattr("emb_train.training.processes", nullcontext)


def constant(current: float) -> Excitation:
    """The same current [A] at every step."""
    return lambda seen: np.full(len(seen), current)


def short_bench(directory: Path, old: str = "", new: str = "") -> Path:
    """A bench file with a sensor of the velocity, a short experiment, and ``old`` replaced by ``new``."""
    text = SENSOR_TEXT.replace("horizon     = 500", f"horizon     = {HORIZON}")
    assert f"= {HORIZON}" in text
    assert old in text
    path = directory / "short.toml"
    path.write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return path
