"""Trainings that take a moment: a short experiment, tiny networks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from emb_runtime.config.bench import shipped_bench_text
from emb_train import presets
from emb_train.ppo.ppo import PpoConfig
from emb_train.training.configuration import Configuration

HORIZON = 60
ENVS = 8
ITERATION = HORIZON * ENVS  # Environment steps in an iteration

TINY = dataclasses.replace(
    presets.load_preset("single-viscous"),
    ppo=PpoConfig(
        total_steps=3 * ITERATION,
        envs=ENVS,
        rollout=HORIZON,
        minibatch=160,
        epochs=2,
        hidden=(8, 8),
        initial_mean=0.5,
    ),
)


def make_tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ``--preset single-viscous`` be :data:`TINY`."""
    load_preset = presets.load_preset

    def tiny(name: str) -> Configuration:
        return TINY if name == "single-viscous" else load_preset(name)

    for module in ("presets", "cli.train"):
        monkeypatch.setattr(f"emb_train.{module}.load_preset", tiny)


def short_bench(directory: Path, old: str = "", new: str = "") -> Path:
    """A bench file with a short experiment, and ``old`` replaced by ``new``."""
    text = shipped_bench_text().replace("horizon     = 500", f"horizon     = {HORIZON}")
    assert f"= {HORIZON}" in text
    assert old in text
    path = directory / "short.toml"
    path.write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return path
