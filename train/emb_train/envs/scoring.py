"""Rewards of the steps of a batch, with the record from before a step that a reward needs."""

from __future__ import annotations

import numpy as np

from emb_train.envs.batch import Batch
from emb_train.rewards import Floats, Mark, Returning, Reward, Transition


class Scoring:
    """A batch and the reward of its steps."""

    def __init__(self, batch: Batch, reward: Reward) -> None:
        """Score the steps that :meth:`advance` makes, and no others."""
        self._batch = batch
        self._reward = reward
        self._outward = reward.outward if isinstance(reward, Returning) else 0
        self._mark = Mark(np.zeros_like(batch.x[:, :2]), np.zeros(len(batch.k)), np.zeros_like(batch.m))

    def advance(self, wanted: Floats) -> Floats:
        """One sample period with the requested currents [A], shape [N]; its rewards, shape [N].

        Raises:
            UsageError: see :meth:`emb_train.envs.batch.Batch.advance`.
        """
        batch, mark = self._batch, self._mark
        before, velocity = batch.m.copy(), batch.x[:, 1].copy()
        batch.advance(wanted)
        sample_time = batch.setup.rules.sample_time
        turning = batch.k == self._outward
        if turning.any():
            mark.x[turning] = batch.x[turning, :2]
            mark.acceleration[turning] = (batch.x[turning, 1] - velocity[turning]) / sample_time
            mark.m[turning] = batch.m[turning]
        state = batch.x[:, :2]
        return self._reward(
            Transition(before, batch.m, state, batch.k, batch.violated, mark, batch.setup.rules.horizon, sample_time)
        )
