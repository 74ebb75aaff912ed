"""What the learner asks of experiments that are not on the brake."""

from __future__ import annotations

from typing import Protocol

import torch

from emb_train.ppo.networks import Actor
from emb_train.ppo.rollout import Rollout


class Collects(Protocol):
    """Experiments that follow an actor by themselves."""

    def collect(
        self, actor: Actor, steps: int, noise_memory: float, seeds: list[int], generator: torch.Generator, threads: int
    ) -> Rollout:
        """See :func:`emb_train.ppo.rollout.collect`."""
        ...
