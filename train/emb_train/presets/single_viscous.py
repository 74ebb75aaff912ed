"""f_v unknown in [1, 5]·10⁻⁵, and back home after 500 ms (thesis 5.2-5.3), with the braking shield in the environment.

The thesis's task with its reward (eq. 5.13) but without its penalties: the shield holds the limits and returns.
What decides whether training finds more than "full current for ever" is exploration that lasts as long as the brake
needs to notice (``noise_memory``), credit for the whole rest of the experiment (γ = λ = 1), and a start that leaves the
origin into the clamping direction: from a zero mean, training may park at the lower angle limit.
"""

from __future__ import annotations

from emb_train.ppo.ppo import PpoConfig
from emb_train.rewards import InformationIncrement
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="single-viscous",
    summary="viscous friction unknown in the thesis's range; weighted Fisher information by the true value",
    ranges="viscous",
    parameters=("f_v",),
    reward=InformationIncrement(scale=3e-7),
    ppo=PpoConfig(
        total_steps=4_000_000,
        minibatch=4096,
        learning_rate=2e-3,
        gae_lambda=1.0,
        entropy=0.01,
        initial_mean=0.5,
        initial_deviation=1.0,
        noise_memory=0.99,
    ),
)
