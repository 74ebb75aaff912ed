"""Learning an excitation: environments, rewards, asymmetric PPO."""

from __future__ import annotations

ENV_ID = "EmbExcitation-v0"
CHECKPOINT = "checkpoint.safetensors"
"""File name of a training's last checkpoint; here so that it is known without importing torch."""

try:
    from gymnasium.envs.registration import register
except ModuleNotFoundError:  # the base install has no gymnasium; the command line says what to install
    pass
else:
    register(
        id=ENV_ID,
        entry_point="emb_train.envs.env:EmbExcitationEnv",
        vector_entry_point="emb_train.envs.env:EmbExcitationVectorEnv",
    )
