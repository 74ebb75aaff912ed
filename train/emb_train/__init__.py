"""Learning an excitation: environments, rewards, asymmetric PPO."""

from __future__ import annotations

ENV_ID = "EmbExcitation-v0"
CHECKPOINT = "checkpoint.safetensors"
"""Of a training, in its directory; named here for what must not wait for torch."""

try:
    from gymnasium.envs.registration import register
except ModuleNotFoundError:  # the base install has no gymnasium; the command line says what to install
    pass
else:
    register(
        id=ENV_ID,
        entry_point="emb_train.envs.env:EmbExcitationEnv",
        vector_entry_point="emb_train.envs.vector_env:EmbExcitationVectorEnv",
    )
