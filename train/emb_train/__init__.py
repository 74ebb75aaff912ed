"""Learning an excitation: environments, rewards, search for a plan, asymmetric PPO, evaluation."""

from __future__ import annotations

import sys


def emb_train() -> int:
    """Training of an excitation, and its evaluation; imported after the first handler of a Ctrl-C."""
    from emb_runtime.system.entry import run_command  # this package is also a library

    return run_command("emb_train.cli", "emb-train: interrupted")


def register_environments() -> None:
    """Registers the environments of this package by name."""
    from gymnasium.envs.registration import register, registry

    if (name := "EmbExcitation-v0") not in registry:
        env = "emb_train.env:EmbExcitation"
        register(name, entry_point=f"{env}Env", vector_entry_point=f"{env}VectorEnv")


if "gymnasium" in sys.modules:  # which imports this package for gymnasium.make("emb_train:EmbExcitation-v0")
    register_environments()
