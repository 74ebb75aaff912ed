"""What the project's own recipes for more than the shipped task have in common.

The shield is part of the environment, the discount is 1 for a horizon that is a true end, exploration lasts as long as
the brake needs to notice, and the untrained actor leaves the origin into the clamping direction. See single-viscous.

Actions are clipped: in version 0.1, which could squash them by tanh, with ``--steps 1000000`` and on 500 fresh draws,
best-four-d has 99.78 and 99.97 clipped, 99.74 and 99.59 squashed with seeds 0 and 1 (95 % intervals over draws of
±0.07), single-viscous 2.72e7 and 2.70e7 with seed 0 (±0.10e7).
"""

from __future__ import annotations

from emb_train.envs.conditions import Conditions
from emb_train.ppo.ppo import PpoConfig

PHYSICAL = Conditions(information="physical")
"""The information that bounds an estimate, relative to the true parameters."""


def own_hyper_parameters(total_steps: int) -> PpoConfig:
    """Those of single-viscous for a training of this length."""
    return PpoConfig(
        total_steps=total_steps,
        minibatch=4096,
        learning_rate=2e-3,
        gae_lambda=1.0,
        entropy=0.01,
        initial_mean=0.5,
        initial_deviation=1.0,
        noise_memory=0.99,
    )
