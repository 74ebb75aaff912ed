"""What all experiments of the thesis have in common: conditions (4.6) and hyper-parameters (5.2.2).

Printed: 4 environments, 2048 steps of each in a rollout, learning rate 0.001 that falls to zero, γ = 0.99, λ = 0.95,
ε = 0.2, and CleanRL's PPO (4.5.4), whose defaults stand for what is not printed: 10 epochs of 32 minibatches, two
hidden layers of 64, no entropy bonus, a standard deviation of 1 A at the start.

Two things differ. Observations have fixed scales in place of the running mean and variance, and rewards a fixed factor
in place of CleanRL's running one: neither changes what is optimal, and an actor stays a function of what it sees. And
each rollout begins new experiments, so that a training can be stopped and resumed bit for bit; the one that the rollout
cuts is bootstrapped.
"""

from __future__ import annotations

from emb_train.envs.conditions import EVERYTHING, Conditions
from emb_train.ppo.ppo import PpoConfig

SCALE = 3e-7
"""Of rewards whose returns are some 1e7."""
EXPLORING = 300
"""Steps of an experiment that need not come home (5.2, 6.2)."""

OBSERVED = Conditions(shielded=False, horizon=EXPLORING, observes=EVERYTHING)
"""300 steps, and the actor is told everything (5.2)."""
BLIND = Conditions(shielded=False, horizon=EXPLORING)
"""300 steps, and the actor sees what is measured (6.2)."""
RETURNING = Conditions(shielded=False)
"""500 steps, and the actor sees what is measured (5.3, 6.3)."""


def printed_hyper_parameters(total_steps: int) -> PpoConfig:
    """Those of 5.2.2 for a training of this length."""
    return PpoConfig(
        total_steps=total_steps,
        envs=4,
        rollout=2048,
        minibatch=256,
        epochs=10,
        learning_rate=1e-3,
        gamma=0.99,
        gae_lambda=0.95,
        clip=0.2,
        hidden=(64, 64),
        initial_deviation=1.0 / 6.0,
    )
