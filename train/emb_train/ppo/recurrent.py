"""How an actor with a memory improves on a rollout: from whole experiments, back through all of their steps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from emb_train.ppo.gradients import Chain
from emb_train.ppo.learning import Improvement, Losses, Student, Study
from emb_train.ppo.networks import RecurrentActor
from emb_train.ppo.recurrence import Recurrence
from emb_train.ppo.rollout import Rollout

NONE = -1
"""In place of a sample, after the end of an experiment that is shorter than others."""


def experiments_of(terminals: Tensor, heard: Tensor) -> Tensor:
    """Which samples of a rollout make each of its experiments.

    Args:
        terminals: 1 where a step ended its experiment, shape [T, N].
        heard: whether its sample arrived: where it did not, the actor was not asked, shape [T, N].

    Returns:
        Shape [L, E], L the steps of the longest: sample t N + i is step t of row i; :data:`NONE` after an end.
    """
    steps, rows = terminals.shape
    columns = []
    for i in range(rows):
        ends = sorted({*(terminals[:, i].nonzero().flatten() + 1).tolist(), steps})
        for a, b in zip([0, *ends[:-1]], ends, strict=True):
            columns.append((a + heard[a:b, i].nonzero().flatten()) * rows + i)
    return torch.nn.utils.rnn.pad_sequence(columns, padding_value=NONE)


class Lesson(NamedTuple):
    """A rollout as experiments."""

    samples: Tensor
    """See :func:`experiments_of`, shape [L, E]."""
    seen: Tensor
    """Normalised observations, shape [B, I]."""
    actions: Tensor
    """Shape [B, 1]."""


class RecurrentStudent(Student):
    """The actor with a memory."""

    def __init__(self, actor: RecurrentActor, study: Study, learning_rate: float, longest: int) -> None:
        """Prepare to train ``actor`` on experiments of at most ``longest`` steps."""
        super().__init__(actor, study, learning_rate)
        self._actor, self._improvement = actor, Improvement(actor, study)
        self._recurrence = Recurrence(actor.unit)
        self._chain = Chain(actor.layers, max(study.minibatch, longest))

    @torch.no_grad()
    def log_densities(self, rollout: Rollout) -> Tensor:
        """Of a rollout's B actions, shape [B]."""
        lesson = self._lesson(rollout)
        old = torch.zeros(len(lesson.actions))
        for samples, there in self._parts(lesson, torch.arange(lesson.samples.shape[1])):
            index = samples[there]
            old[index] = self._improvement.log_density(self._means(lesson, samples)[there], lesson.actions[index])
        return old

    @torch.no_grad()
    def learn(self, shuffles: list[Tensor], rollout: Rollout, old: Tensor, advantages: Tensor) -> Losses:
        """One gradient step for as many experiments as a minibatch has samples for, in each epoch.

        Args:
            shuffles: an order of the B samples for each epoch; the first E of these, wherever they come, order the E
                experiments.
            rollout: these samples.
            old: log densities of the actions under the policy that chose them, shape [B].
            advantages: shape [B].
        """
        lesson, records = self._lesson(rollout), []
        for epoch, shuffle in enumerate(shuffles):
            for samples, there in self._parts(lesson, shuffle[shuffle < lesson.samples.shape[1]]):
                index = samples[there]
                means = self._means(lesson, samples)
                part = means[there]
                slope, loss, log_ratio = self._improvement.slope(
                    part, lesson.actions[index], old[index], advantages[index]
                )
                if epoch == len(shuffles) - 1:
                    records.append(self._improvement.record(part, loss, log_ratio))
                slopes = torch.zeros_like(means)
                slopes[there] = slope
                through = self._chain.backward(slopes.flatten(0, 1), through=True)
                self._recurrence.backward(through[:, -self._actor.memory :].view(*samples.shape, -1))
                self.descend()
        return Losses(*torch.stack(records).mean(0).tolist())

    def _parts(self, lesson: Lesson, order: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Samples of some experiments at a time, shape [L, M], and which of these there are, the same."""
        at_once = max(1, self.study.minibatch // len(lesson.samples))
        for chosen in torch.split(order, at_once):
            samples = lesson.samples[:, chosen]
            there = samples != NONE
            steps = int(there.sum(0).max())
            yield samples[:steps], there[:steps]

    def _means(self, lesson: Lesson, samples: Tensor) -> Tensor:
        """Of the actions, shape [L, M, 1], until the next ones."""
        seen = lesson.seen[samples]  # where there is none, the last one of all, which nothing comes of
        inputs = torch.cat((seen, self._recurrence.forward(seen)), dim=-1)
        return self._chain.forward(inputs.flatten(0, 1)).view(*samples.shape, 1)

    def _lesson(self, rollout: Rollout) -> Lesson:
        heard = ~rollout.actor_seen[..., 0].isnan()
        seen = self._actor.normalised(rollout.actor_seen.flatten(0, 1).nan_to_num())
        return Lesson(experiments_of(rollout.terminals, heard), seen, rollout.actions.flatten(0, 1))
